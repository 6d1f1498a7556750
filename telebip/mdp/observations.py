"""What the policy sees: 33 numbers."""

import torch
from torch import Tensor

from telebip.config.schema import NoiseConfig
from telebip.math import columns, turn
from telebip.sim.base import SimState

LAYOUT: dict[str, int] = {
    "joint_pos": 6,  # relative to the nominal pose [rad | m]
    "joint_vel": 6,  # [rad/s | m/s]
    "last_action": 6,  # [-]
    "base_lin_vel": 3,  # body frame [m/s]
    "base_ang_vel": 3,  # body frame [rad/s]
    "base_quat": 4,  # w x y z, relative to the reference heading
    "command": 3,  # vx, vy, yaw rate [m/s, m/s, rad/s]
    "phase": 2,  # p_r, p_l [-]
}
"""Parts of the observation in their order, with their sizes."""


def heading_relative_quat(base_quat: Tensor, reference_heading: Tensor) -> Tensor:
    r"""Orientation of the trunk relative to the reference heading, with w >= 0.

        q_rel = q_z(-psi_ref) q

    The reference heading starts at the robot's own at reset and turns with the commanded yaw rate. It equals the article's
    base quaternion where the robot starts facing x and walks straight, and does not tell the policy which way x points.

    Args:
        base_quat: orientation in the world, (num_envs, 4).
        reference_heading: psi_ref [rad], (num_envs,).

    Returns:
        Unit quaternion w x y z, (num_envs, 4); q and -q are the same rotation and give the same result.
    """
    quat = turn(base_quat, -reference_heading)
    return torch.where(quat[:, :1] < 0.0, -quat, quat)


def observation(
    state: SimState,
    nominal: Tensor,
    last_action: Tensor,
    base_lin_vel_b: Tensor,
    quat: Tensor,
    command: Tensor,
    phase: Tensor,
) -> Tensor:
    """Concatenate the parts of `LAYOUT`, (num_envs, 33); see there for order, units and frames."""
    parts = (
        state.joint_pos - nominal,
        state.joint_vel,
        last_action,
        base_lin_vel_b,
        state.base_ang_vel_b,
        quat,
        command,
        phase,
    )
    return columns(*parts)


def noise_amplitude(cfg: NoiseConfig) -> Tensor:
    """Amplitude of the uniform noise on each entry of the observation, (33,): zero for what the policy knows exactly."""
    amplitude = {
        "joint_pos": cfg.joint_pos,
        "joint_vel": cfg.joint_vel,
        "base_lin_vel": cfg.base_lin_vel,
        "base_ang_vel": cfg.base_ang_vel,
        "base_quat": cfg.base_quat,
    }
    return torch.cat([torch.full((size,), amplitude.get(part, 0.0)) for part, size in LAYOUT.items()])
