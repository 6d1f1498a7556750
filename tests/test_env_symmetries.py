"""The environment does not know which way x points, nor right from left."""

import math

import pytest
import torch
from torch import Tensor
from worlds import MakeEnv, observe, put, quat_mul, random_actions

from telebip.env import TelebipEnv
from telebip.math import quat_from_yaw, wrap_angle


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
    a, b = (make_env("episode.reset_heading=0", calm=True, num_envs=8) for _ in range(2))
    for env, by in ((a, 0.0), (b, angle)):
        qpos, qvel = turned(env, by)
        qpos[:, 2] += height
        put(env, list(range(8)), qpos, qvel)
        env.reference_heading.copy_(wrap_angle(env.reference_heading + by))
    torch.testing.assert_close(observe(b), observe(a), atol=1e-5, rtol=0.0)
    for action in random_actions(20, 8, 0.3):
        obs_a, rewards_a, dones_a, _ = a.step(action)
        obs_b, rewards_b, dones_b, _ = b.step(action)
        assert not dones_a.any()
        assert not dones_b.any()
        torch.testing.assert_close(obs_b["policy"], obs_a["policy"], atol=1e-4, rtol=0.0)
        torch.testing.assert_close(rewards_b, rewards_a, atol=1e-4, rtol=0.0)


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


def test_a_mirrored_world_moves_mirrored_half_a_period_later(make_env: MakeEnv) -> None:
    overrides = ("gait.period=0.48", "episode.reset_heading=0.5")  # half a period is 12 steps
    a, b = (make_env(*overrides, calm=True, num_envs=8) for _ in range(2))
    a.set_command(0.6, 0.1, 0.2)
    b.set_command(0.6, -0.1, -0.2)
    put(b, list(range(8)), *mirrored_state(a.sim.state.qpos, a.sim.state.qvel))
    b.reference_heading.copy_(-a.reference_heading)
    b.episode_length_buf += 12
    for action in random_actions(20, 8, 0.3):
        obs_a, rewards_a, dones_a, _ = a.step(action)
        obs_b, rewards_b, dones_b, _ = b.step(mirrored_joints(action))
        assert not dones_a.any()
        assert not dones_b.any()
        torch.testing.assert_close(obs_b["policy"], mirrored_observation(obs_a["policy"]), atol=1e-4, rtol=0.0)
        torch.testing.assert_close(rewards_b, rewards_a, atol=1e-4, rtol=0.0)
        qpos, qvel = mirrored_state(a.sim.state.qpos, a.sim.state.qvel)
        torch.testing.assert_close(b.sim.state.qpos, qpos, atol=1e-4, rtol=0.0)
        torch.testing.assert_close(b.sim.state.qvel, qvel, atol=1e-3, rtol=0.0)
