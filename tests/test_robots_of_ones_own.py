# pyright: reportAttributeAccessIssue=false
"""What robots may have that the shipped ones have not: gears, forces of unlike limits, any trunk, any orientation at home."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.mdp import rewards
from telebip.rl.export import describe
from telebip.rl.train import Trainer
from telebip.robot import Robot, load_robot

MJCF = (ROOT / "assets" / "telebip.xml").read_text(encoding="utf-8")
HELD = ("events.start_pose.heading=0", "events.start_pose.joint_pos=0", "events.start_velocity=null", "events.push=null")


def robot_of(folder: Path, edits: dict[str, str]) -> Robot:
    """The shipped robot with the keys of `edits` replaced by their values."""
    text = MJCF
    for old, new in edits.items():
        assert old in text
        text = text.replace(old, new)
    (folder / "mine.xml").write_text(text, encoding="utf-8")
    return load_robot(folder / "mine.xml")


def motion(robot: Robot, targets: np.ndarray) -> np.ndarray:
    """The trajectory of the engine's model under joint targets, (steps, nq)."""
    model = robot.engine_model()
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = robot.home_qpos
    for target in targets:
        data.ctrl[:] = target
        mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows)


@pytest.mark.parametrize("gear", [2.0, 10.0, -4.0, 0.5])
def test_a_gear_is_the_same_as_gains_and_limits_at_the_joint(tmp_path: Path, robot: Robot, gear: float) -> None:
    """A motor with kp and kv over gear^2 and limits over gear moves the joint as the shipped one does."""
    limit = 400.0 / abs(gear)
    motor = f'gear="{gear}" kp="{6000 / gear**2}" kv="{200 / gear**2}" forcerange="{-limit} {limit}"'
    geared = robot_of(tmp_path, {'kp="6000" kv="200" forcerange="-400 400"': motor})
    np.testing.assert_allclose(geared.model.actuator_gainprm, robot.model.actuator_gainprm)
    np.testing.assert_allclose(geared.force_range, robot.force_range)
    targets = robot.nominal + np.random.default_rng(0).uniform(-0.1, 0.1, (100, 6))
    np.testing.assert_allclose(motion(geared, targets), motion(robot, targets), atol=1e-9)


def test_a_gear_moves_as_mujoco_moves_it(tmp_path: Path) -> None:
    """The rewritten actuator and the file's own, whose control is gear times the joint target: the same motion."""
    geared = robot_of(
        tmp_path, {'kp="6000" kv="200" forcerange="-400 400"': 'gear="-3" kp="700" kv="20" forcerange="-100 130"'}
    )
    own = mujoco.MjModel.from_xml_path(str(geared.path))
    data, rows = mujoco.MjData(own), []
    data.qpos[:] = geared.home_qpos
    targets = geared.nominal + np.random.default_rng(0).uniform(-0.1, 0.1, (100, 6))
    for target in targets:
        data.ctrl[:] = target * [1, 1, -3, 1, 1, -3]
        mujoco.mj_step(own, data)
        rows.append(data.qpos.copy())
    np.testing.assert_allclose(motion(geared, targets), rows, atol=1e-9)
    np.testing.assert_allclose(geared.force_range[2], [-390.0, 300.0])


def test_forces_of_unlike_limits_are_kept_whole(tmp_path: Path) -> None:
    robot = robot_of(tmp_path, {'forcerange="-400 400"': 'forcerange="-100 400"'})
    np.testing.assert_allclose(robot.force_range, [[-50, 50], [-50, 50], [-100, 400]] * 2)
    np.testing.assert_allclose(robot.force_limit, [50, 50, 400] * 2)
    assert not isinstance(robot.mirror, str)
    world = SimpleNamespace(force_range=torch.as_tensor(robot.force_range).float())
    step: Any = SimpleNamespace(
        state=SimpleNamespace(joint_force=torch.tensor([[0.0, 0.0, -100.0, 0.0, 0.0, 400.0]])), world=world
    )
    torch.testing.assert_close(rewards.tq(step, k_tq=-1.0), torch.tensor([-(2.0**0.5)]))  # both knees saturated
    config = load_task("telebip_flat", ["num_envs=2", "ppo.hidden_dims=[8]", f"sim.robot={robot.path}"])
    about = describe(Trainer(TelebipEnv(config, robot, "cpu"), "mine", tmp_path).policy(), robot)
    assert about["force_range"] == [[-50.0, 50.0], [-50.0, 50.0], [-100.0, 400.0]] * 2


def test_the_limit_of_a_joint_narrows_that_of_its_actuator(tmp_path: Path) -> None:
    robot = robot_of(tmp_path, {'range="-0.15 0.20"': 'range="-0.15 0.20" actuatorfrcrange="-120 500"'})
    np.testing.assert_allclose(robot.force_range[2], [-120, 400])
    robot = robot_of(
        tmp_path, {'range="-0.15 0.20"': 'range="-0.15 0.20" actuatorfrcrange="-120 500"', ' forcerange="-400 400"': ""}
    )
    np.testing.assert_allclose(robot.force_range[2], [-120, 500])


@pytest.mark.parametrize("name", ["pelvis", "base_link"])
def test_the_trunk_is_the_body_that_is_free_whatever_its_name(tmp_path: Path, name: str) -> None:
    robot = robot_of(tmp_path, {'body name="trunk"': f'body name="{name}"'})
    assert robot.trunk_name == name
    for backend in ("native", "warp"):
        env = TelebipEnv(load_task("telebip_flat", ["num_envs=2", *HELD]), robot, "cpu", backend)
        env.push(torch.tensor([0.0, 100.0, 0.0]))
        for _ in range(5):
            env.step(torch.zeros(2, 6))
        assert (env.sim.state.qvel[:, 1] > 0.3).all()  # 100 N on 13.6 kg for 0.1 s


@pytest.mark.parametrize("pitch", [0.157, -0.2])
def test_the_orientation_at_home_is_that_of_a_new_episode(tmp_path: Path, pitch: float) -> None:
    w, y = np.cos(0.5 * pitch), np.sin(0.5 * pitch)
    robot = robot_of(
        tmp_path,
        {'qpos="0 0 0.66  1 0 0 0  0 0 0.04  0 0 0.04"': f'qpos="0 0 0.66  {w} 0 {y} 0  0 {-pitch} 0.04  0 {-pitch} 0.04"'},
    )
    env = TelebipEnv(load_task("telebip_flat", ["num_envs=3", *HELD]), robot, "cpu")
    torch.testing.assert_close(env.view().projected_gravity[:, 0], torch.full((3,), float(np.sin(pitch))), atol=1e-5, rtol=0.0)
    turned = TelebipEnv(load_task("telebip_flat", ["num_envs=3", *HELD[1:]]), robot, "cpu")
    assert turned.view().heading.std() > 0.1
    torch.testing.assert_close(turned.view().projected_gravity, env.view().projected_gravity, atol=1e-5, rtol=0.0)
