# pyright: reportAttributeAccessIssue=false
"""The single-file example walks an exported policy as the environment does, with nothing of ours."""

import ast
import runpy
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
import torch
from worlds import CALM

import telebip
from telebip import ROOT
from telebip.config import load_task
from telebip.config.schema import ObservationGroup
from telebip.env import TelebipEnv
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.export import export
from telebip.rl.policy import load_policy
from telebip.rl.train import Trainer
from telebip.robot import Robot, load_robot

EXAMPLE = ROOT / "examples" / "deploy_mujoco.py"
STILL = ("events.start_pose.joint_pos=0", "events.start_velocity=null")


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "policy.onnx"
    export(load_checkpoint("telebip_flat"), path, samples=100)
    return path


@pytest.fixture(scope="module")
def deploy() -> SimpleNamespace:
    return SimpleNamespace(**runpy.run_path(str(EXAMPLE)))


@pytest.fixture
def untrained(tmp_path: Path) -> Callable[[str, dict, int], Path]:
    """Return a function that exports a policy with random weights for a robot of the tests."""

    def make(name: str, terms: dict, history: int = 1) -> Path:
        task = load_task(str(ROOT / "tests" / "robots" / f"{name}.yaml"), ["num_envs=4", "commands.velocity_gain=0.5"])
        task = replace(task, observations={"policy": ObservationGroup(terms, history)})
        export(Trainer(telebip.make(task), name, tmp_path).policy(), tmp_path / "policy.onnx", samples=100)
        return tmp_path / "policy.onnx"

    return make


def walk_env(robot: Robot, exported: Path, command: tuple[float, float, float], seconds: float) -> np.ndarray:
    """Return the environment's trajectory, (1 + steps, nq), from a random heading."""
    checkpoint = load_checkpoint(exported)
    env = TelebipEnv(load_task(checkpoint.config, ["num_envs=1", "episode.length=60", "seed=4", *CALM, *STILL]), robot, "cpu")
    env.set_command(*command)
    policy, obs = load_policy(checkpoint, "cpu"), env.get_observations()
    trajectory = [env.sim.state.qpos[0].double().numpy()]
    with torch.inference_mode():
        for _ in range(round(seconds / env.step_dt)):
            obs, *_ = env.step(policy(obs))
            trajectory.append(env.sim.state.qpos[0].double().numpy())
    return np.stack(trajectory)


@pytest.mark.parametrize(("command", "seconds"), [((0.7, 0.0, 0.0), 20.0), ((0.5, 0.0, 0.2), 5.0)], ids=["straight", "turning"])
def test_it_walks_the_environments_trajectory(
    deploy: SimpleNamespace, exported: Path, robot: Robot, command: tuple[float, float, float], seconds: float
) -> None:
    expected = walk_env(robot, exported, command, seconds)
    policy = deploy.Policy(exported)
    simulated = deploy.SimulatedRobot(robot.path, policy.about)
    simulated.data.qpos[:] = expected[0]
    mujoco.mj_forward(simulated.model, simulated.data)
    trajectory = deploy.walk(policy, simulated, np.array(command), seconds)
    np.testing.assert_allclose(trajectory, expected[1:], atol=2e-4)  # 2e-6 was seen; the environment computes in float32
    if seconds > 10.0:
        distance = np.linalg.norm(trajectory[-1, :2] - trajectory[500, :2])
        assert distance / (seconds - 10.02) == pytest.approx(command[0], rel=0.05)


@pytest.mark.parametrize("name", ["four_joints", "ten_joints"])
def test_another_robot_and_another_observation(deploy: SimpleNamespace, untrained: Callable[..., Path], name: str) -> None:
    terms = ("projected_gravity", "phase", "joint_vel", "joint_pos", "command", "last_action")
    file = untrained(name, {term: {"noise": 0.0} for term in terms}, history=3)
    robot = load_robot(ROOT / "tests" / "robots" / f"{name}.xml")
    expected = walk_env(robot, file, (0.5, 0.0, 0.1), seconds=0.4)
    policy = deploy.Policy(file)
    simulated = deploy.SimulatedRobot(robot.path, policy.about)
    simulated.data.qpos[:] = expected[0]
    trajectory = deploy.walk(policy, simulated, np.array([0.5, 0.0, 0.1]), 0.4)
    np.testing.assert_allclose(trajectory, expected[1:], atol=2e-4)
    assert np.abs(trajectory[-1, 7:] - expected[0, 7:]).max() > 0.01  # it does move


def test_a_term_that_it_does_not_know_is_one_line(deploy: SimpleNamespace, untrained: Callable[..., Path]) -> None:
    file = untrained("four_joints", {"joint_pos": {"noise": 0.0}, "base_height": {"noise": 0.0}})
    with pytest.raises(SystemExit, match=r"policy.onnx: the policy sees 'base_height', which this example does not know"):
        deploy.Policy(file)


def test_its_command_line(
    exported: Path, robot: Robot, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", [EXAMPLE.name, str(exported), str(robot.path), "--duration", "4"])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["2.0", "4.0"]
    speed = float(lines[-1].split()[-2])
    assert 0.55 < speed < 0.75  # from a standing start


def test_it_needs_only_three_packages() -> None:
    tree = ast.parse(EXAMPLE.read_text(encoding="utf-8"))
    nodes = list(ast.walk(tree))
    imported = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    imported |= {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    packages = {name.split(".")[0] for name in imported} - sys.stdlib_module_names
    assert packages == {"numpy", "onnxruntime", "mujoco"}
