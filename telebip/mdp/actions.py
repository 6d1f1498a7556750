"""From actions to joint targets."""

import torch
from torch import Tensor

from telebip.config.schema import ActionConfig


def action_scale(cfg: ActionConfig) -> Tensor:
    """Return the displacement of each joint target per unit of action [rad | m], (6,)."""
    return torch.tensor([cfg.hip_roll, cfg.hip_pitch, cfg.knee] * 2)


def joint_targets(action: Tensor, nominal: Tensor, scale: Tensor) -> Tensor:
    r"""Setpoints of the six position actuators.

        q_target = q_nominal + action_scale * action

    The engine evaluates tau = kp (q_target - q) - kv qd at every physics step and clips it to the actuator's force limit.

    Args:
        action: the policy's output [-], (num_envs, 6).
        nominal: joint positions of the home pose [rad | m], (6,).
        scale: displacement per unit of action [rad | m], (6,).

    Returns:
        Joint targets [rad | m], (num_envs, 6).
    """
    return nominal + scale * action
