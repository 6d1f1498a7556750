"""Random draws: initial states, pushes, ground friction. All from one seeded generator per environment."""

import math

import torch
from torch import Tensor

from telebip.config import EpisodeConfig, PushConfig
from telebip.math import quat_from_yaw

KNEES = slice(2, None, 3)


def uniform(shape: tuple[int, ...], low: float, high: float, generator: torch.Generator) -> Tensor:
    """Draw from [low, high) on the generator's device."""
    return low + (high - low) * torch.rand(shape, generator=generator, device=generator.device)


def initial_state(home_qpos: Tensor, num_envs: int, cfg: EpisodeConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Draw standing states about the home pose, with small velocities and any heading.

    Where a leg comes out longer than at home, the robot is lifted by the difference, so that no foot starts in the ground. (A
    rotary knee is taken for one that lengthens the leg by 1 m per rad: more than it does.)

    Args:
        home_qpos: (13,).
        num_envs: number of states.
        cfg: amplitudes.
        generator: source of randomness.

    Returns:
        qpos (num_envs, 13) and qvel (num_envs, 12), as in `SimState`.
    """

    def symmetric(size: int, amplitude: float) -> Tensor:
        return uniform((num_envs, size), -amplitude, amplitude, generator)

    joint_offset = symmetric(6, cfg.reset_joint_pos)
    lift = (-joint_offset[:, KNEES]).amax(dim=1).clamp(min=0.0)
    position = home_qpos[:3].repeat(num_envs, 1)
    position[:, 2] += lift
    heading = quat_from_yaw(symmetric(1, cfg.reset_heading)[:, 0])
    qpos = torch.cat([position, heading, home_qpos[7:] + joint_offset], dim=1)
    lin_vel = torch.cat([symmetric(2, cfg.reset_lin_vel), torch.zeros_like(lift)[:, None]], dim=1)
    return qpos, torch.cat([lin_vel, symmetric(3, cfg.reset_ang_vel), symmetric(6, cfg.reset_joint_vel)], dim=1)


def sample_pushes(num_envs: int, cfg: PushConfig, generator: torch.Generator) -> Tensor:
    """Draw horizontal forces, uniform in magnitude and direction [N], (num_envs, 2)."""
    force = uniform((num_envs,), 0.0, cfg.force, generator)
    angle = uniform((num_envs,), -math.pi, math.pi, generator)
    return force[:, None] * torch.stack([torch.cos(angle), torch.sin(angle)], dim=1)
