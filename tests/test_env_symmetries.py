"""The environment does not know which way x points, nor right from left."""

import math

import pytest
import torch
from torch import Tensor
from worlds import CALM, MakeEnv, observe, put, quat_mul, random_actions

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.math import quat_from_yaw, wrap_angle
from telebip.robot import load_robot
from telebip.sim.base import shifted


def turned(env: TelebipEnv, angle: float) -> tuple[Tensor, Tensor]:
    """Return the state turned about the world's z axis; the angular velocity is in the body frame and stays."""
    qpos, qvel = env.sim.state.qpos.clone(), env.sim.state.qvel.clone()
    c, s = math.cos(angle), math.sin(angle)
    rotation = torch.tensor([[c, -s], [s, c]])
    qpos[:, :2], qvel[:, :2] = qpos[:, :2] @ rotation.T, qvel[:, :2] @ rotation.T
    qpos[:, 3:7] = quat_mul(quat_from_yaw(torch.full((env.num_envs,), angle)), qpos[:, 3:7])
    return qpos, qvel


@pytest.mark.parametrize("height", [0.0, 2.0], ids=["on the ground", "in the air"])
@pytest.mark.parametrize("angle", [math.pi / 2, 2.0])
def test_a_turned_world_looks_the_same(make_env: MakeEnv, angle: float, height: float) -> None:
    a, b = (make_env("events.start_pose.heading=0", calm=True, num_envs=8) for _ in range(2))
    for env, by in ((a, 0.0), (b, angle)):
        qpos, qvel = turned(env, by)
        qpos[:, 2] += height
        put(env, list(range(8)), qpos, qvel)
        env.state.reference_heading.copy_(wrap_angle(env.state.reference_heading + by))
    torch.testing.assert_close(observe(b), observe(a), atol=1e-5, rtol=0.0)
    for action in random_actions(20, 8, 0.3):
        obs_a, rewards_a, dones_a, _ = a.step(action)
        obs_b, rewards_b, dones_b, _ = b.step(action)
        assert not dones_a.any()
        assert not dones_b.any()
        torch.testing.assert_close(obs_b["policy"], obs_a["policy"], atol=1e-4, rtol=0.0)
        torch.testing.assert_close(rewards_b, rewards_a, atol=1e-4, rtol=0.0)


UNSEEN = "observations.critic={foot_force: {}, push_force: {}, base_height: {}, friction: {}, projected_gravity: {}}"
"""All terms that the policy of the published task does not see."""
GYRO = "observations.critic.gyro={term: sensor, sensor: gyro, mirror: axial}"
SWAP = [3, 4, 5, 0, 1, 2]  # right leg <-> left leg
JOINT_SIGN = torch.tensor([-1.0, 1.0, 1.0] * 2)  # a roll to the right becomes one to the left
POLAR, AXIAL = torch.tensor([1.0, -1.0, 1.0]), torch.tensor([-1.0, 1.0, -1.0])  # vectors and rotations at the plane y = 0


def mirrored_joints(joints: Tensor) -> Tensor:
    return joints[:, SWAP] * JOINT_SIGN


def mirrored_quat(quat: Tensor) -> Tensor:
    return torch.cat([quat[:, :1], quat[:, 1:] * AXIAL], dim=1)


def mirrored_state(qpos: Tensor, qvel: Tensor) -> tuple[Tensor, Tensor]:
    return (
        torch.cat([qpos[:, :3] * POLAR, mirrored_quat(qpos[:, 3:7]), mirrored_joints(qpos[:, 7:])], dim=1),
        torch.cat([qvel[:, :3] * POLAR, qvel[:, 3:6] * AXIAL, mirrored_joints(qvel[:, 6:])], dim=1),
    )


def mirrored_observation(obs: Tensor) -> Tensor:
    joints = [mirrored_joints(obs[:, i : i + 6]) for i in (0, 6, 12)]
    command = obs[:, 28:31] * torch.tensor([1.0, -1.0, -1.0])
    base = [obs[:, 18:21] * POLAR, obs[:, 21:24] * AXIAL, mirrored_quat(obs[:, 24:28])]
    return torch.cat([*joints, *base, command, obs[:, 31:33].flip(1)], dim=1)


def declared_image(env: TelebipEnv, group: str, obs: Tensor) -> Tensor:
    """The image that the terms of a group declare for what they show."""
    parts, sizes = env.layout()[group], [part["size"] for part in env.layout()[group]]
    images = [
        seen[:, part["mirror"][0]] * torch.tensor(part["mirror"][1])
        for part, seen in zip(parts, obs.split(sizes, dim=1), strict=True)
    ]
    return torch.cat(images, dim=1)


def test_a_mirrored_world_moves_mirrored_half_a_period_later(make_env: MakeEnv) -> None:
    overrides = ("gait.period=0.48", "events.start_pose.heading=0.5", UNSEEN, GYRO)  # half a period is 12 steps
    a, b = (make_env(*overrides, calm=True, num_envs=8) for _ in range(2))
    a.set_command(0.6, 0.1, 0.2)
    b.set_command(0.6, -0.1, -0.2)
    a.push(torch.tensor([5.0, 8.0, -3.0]))
    b.push(torch.tensor([5.0, -8.0, -3.0]))
    put(b, list(range(8)), *mirrored_state(a.sim.state.qpos, a.sim.state.qvel))
    b.state.reference_heading.copy_(-a.state.reference_heading)
    b.episode_length_buf += 12
    for action in random_actions(20, 8, 0.3):
        obs_a, rewards_a, dones_a, _ = a.step(action)
        obs_b, rewards_b, dones_b, _ = b.step(mirrored_joints(action))
        assert not dones_a.any()
        assert not dones_b.any()
        torch.testing.assert_close(obs_b["policy"], mirrored_observation(obs_a["policy"]), atol=1e-4, rtol=0.0)
        torch.testing.assert_close(obs_b["policy"], declared_image(a, "policy", obs_a["policy"]), atol=1e-4, rtol=0.0)
        torch.testing.assert_close(obs_b["critic"], declared_image(a, "critic", obs_a["critic"]), atol=1e-3, rtol=0.0)
        assert obs_a["critic"][:, :2].amax() > 0.2  # feet are on the ground
        torch.testing.assert_close(rewards_b, rewards_a, atol=1e-4, rtol=0.0)
        qpos, qvel = mirrored_state(a.sim.state.qpos, a.sim.state.qvel)
        torch.testing.assert_close(b.sim.state.qpos, qpos, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(b.sim.state.qvel, qvel, atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("name", ["rotary_knee", "ten_joints", "four_joints"])
def test_any_robot_mirrors_as_its_mjcf_says(name: str) -> None:
    task = str(ROOT / "tests" / "robots" / f"{name}.yaml")
    config = load_task(task, ["num_envs=4", "gait.period=0.48", *CALM, UNSEEN])
    robot = load_robot(config.sim.robot)
    a, b = (TelebipEnv(config, robot, "cpu", "native") for _ in range(2))
    assert not isinstance(robot.mirror, str)
    order, sign = robot.mirror.order, torch.tensor(robot.mirror.sign)
    a.set_command(0.6, 0.1, 0.2)
    b.set_command(0.6, -0.1, -0.2)
    qpos, qvel, columns = a.sim.state.qpos.clone(), a.sim.state.qvel.clone(), a.sim.state.joint_columns
    qpos[:, :7] = torch.cat([qpos[:, :3] * POLAR, mirrored_quat(qpos[:, 3:7])], dim=1)
    qvel[:, :6] = torch.cat([qvel[:, :3] * POLAR, qvel[:, 3:6] * AXIAL], dim=1)
    qpos[:, columns] = qpos[:, columns][:, order] * sign
    qvel[:, shifted(columns)] = qvel[:, shifted(columns)][:, order] * sign
    put(b, [0, 1, 2, 3], qpos, qvel)
    b.state.reference_heading.copy_(-a.state.reference_heading)
    b.episode_length_buf += 12
    for action in 0.2 * torch.randn(15, 4, a.num_actions, generator=torch.Generator().manual_seed(0)):
        obs_a, rewards_a, dones_a, _ = a.step(action)
        obs_b, rewards_b, dones_b, _ = b.step(action[:, order] * sign)
        assert not dones_a.any()
        assert not dones_b.any()
        for group in ("policy", "critic"):
            torch.testing.assert_close(obs_b[group], declared_image(a, group, obs_a[group]), atol=1e-3, rtol=0.0)
        torch.testing.assert_close(rewards_b, rewards_a, atol=1e-3, rtol=0.0)
