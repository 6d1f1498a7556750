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


QUIET = ("actions.jitter=[0,0]", "actions.loss=0", "observations.policy.loss=0", "observations.policy.noise=false")


@pytest.fixture
def real(tmp_path: Path) -> Path:
    """A policy of telebip_real with random weights."""
    task = load_task("telebip_real", ["num_envs=4"])
    export(Trainer(telebip.make(task), "telebip_real", tmp_path).policy(), tmp_path / "real.onnx", samples=100)
    return tmp_path / "real.onnx"


@pytest.mark.parametrize("late", [0, 3, 8])
def test_a_policy_for_a_real_robot_and_a_delay(deploy: SimpleNamespace, real: Path, robot: Robot, late: int) -> None:
    task = load_task("telebip_real", ["num_envs=1", *QUIET, f"actions.physics_delay=[{late},{late}]", "episode.length=60"])
    task = replace(task, events={"start_pose": {"joint_pos": 0.0, "heading": 1.0}})
    env, command = TelebipEnv(task, robot, "cpu", "native"), np.array([0.6, 0.0, 0.1])
    env.set_command(*command.tolist())
    walker, obs = load_policy(load_checkpoint(real), "cpu"), env.get_observations()
    expected = [env.sim.state.qpos[0].double().numpy()]
    with torch.inference_mode():
        for _ in range(20):
            obs, *_ = env.step(walker(obs))
            expected.append(env.sim.state.qpos[0].double().numpy())
    policy = deploy.Policy(real)
    simulated = deploy.SimulatedRobot(robot.path, policy.about, delay=0.005 * late)
    simulated.data.qpos[:] = expected[0]
    trajectory = deploy.walk(policy, simulated, command, 0.4)
    np.testing.assert_allclose(trajectory, np.stack(expected[1:]), atol=2e-4)


def test_what_a_robot_must_measure_is_told_and_checked(deploy: SimpleNamespace, real: Path, exported: Path) -> None:
    policy = deploy.Policy(real)
    measures = {part["name"]: part for part in policy.about["measures"]}
    assert set(measures) == {"joint_pos", "joint_vel", "ang_vel", "quat"}  # no velocity of the base
    assert measures["ang_vel"]["unit"] == "rad/s"
    assert measures["ang_vel"]["frame"] == "of the trunk, in its frame"
    assert measures["quat"]["for"] == ["projected_gravity", "heading hold"]
    assert measures["joint_vel"]["noise"] == 0.2
    assert (policy.about["history"], policy.about["action_delay"]) == (5, [0.0, 0.04])
    policy.require({"joint_pos", "joint_vel", "ang_vel", "quat"})
    line = r"the robot does not measure 'quat' \[w x y z, of the trunk in .*\], .* for: projected_gravity, heading hold$"
    with pytest.raises(SystemExit, match=line):
        policy.require({"joint_pos", "joint_vel", "ang_vel"})
    with pytest.raises(SystemExit, match=r"the robot does not measure 'lin_vel' \[m/s, .*\], .* for: base_lin_vel$"):
        deploy.Policy(exported).require({"joint_pos", "joint_vel", "ang_vel", "quat"})


def test_a_model_with_names_and_limits_of_its_own(deploy: SimpleNamespace, tmp_path: Path, robot: Robot) -> None:
    text = robot.path.read_text().replace('forcerange="-400 400"', 'forcerange="-300 60"')
    (tmp_path / "own.xml").write_text(text)
    task = load_task("telebip_real", ["num_envs=4", f"sim.robot={tmp_path / 'own.xml'}"])
    export(Trainer(telebip.make(task), "own", tmp_path / "run").policy(), tmp_path / "own.onnx", samples=100)
    policy = deploy.Policy(tmp_path / "own.onnx")
    assert policy.about["force_range"][2] == [-300.0, 60.0]
    for name, its_own in (("right_knee", "RK"), ("gyro", "imu_w"), ("orientation", "imu_q")):
        text = text.replace(f'"{name}"', f'"{its_own}"')
    (tmp_path / "other.xml").write_text(text)
    names, sensors = {"right_knee": "RK"}, {"ang_vel": "imu_w", "quat": "imu_q"}
    trajectories = []
    for file, about in (("own.xml", ({}, {})), ("other.xml", (names, sensors))):
        policy = deploy.Policy(tmp_path / "own.onnx")
        simulated = deploy.SimulatedRobot(tmp_path / file, policy.about, *about)
        trajectories.append(deploy.walk(policy, simulated, np.array([0.5, 0.0, 0.0]), 1.0))
    np.testing.assert_allclose(*trajectories, atol=1e-6)
    assert simulated.model.actuator_forcerange[2].tolist() == [-300.0, 60.0]


@pytest.mark.parametrize(
    ("names", "sensors", "line"),
    [
        ({"right_knee": "RK"}, {}, "no joint named 'RK', which the policy moves"),
        ({}, {"quat": "imu"}, "no sensor named 'imu', which is to measure 'quat'"),
        ({}, {"quat": "gyro"}, "sensor 'gyro' has 3 numbers, and 'quat' has 4"),
        ({}, {"joint_pos": "gyro"}, "no sensor is needed for 'joint_pos'"),
    ],
)
def test_names_that_are_not_there_are_one_line(
    deploy: SimpleNamespace, exported: Path, robot: Robot, names: dict, sensors: dict, line: str
) -> None:
    with pytest.raises(SystemExit, match=line):
        deploy.SimulatedRobot(robot.path, deploy.Policy(exported).about, names, sensors)


def test_a_term_that_it_does_not_know_is_one_line(deploy: SimpleNamespace, untrained: Callable[..., Path]) -> None:
    file = untrained("four_joints", {"joint_pos": {"noise": 0.0}, "base_height": {"noise": 0.0}})
    with pytest.raises(SystemExit, match=r"policy.onnx: the policy sees 'base_height', which this example does not know"):
        deploy.Policy(file)


def test_its_command_line(
    exported: Path, robot: Robot, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        sys, "argv", [EXAMPLE.name, str(exported), str(robot.path), "--duration", "4", "--sensor", "quat=orientation"]
    )
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
