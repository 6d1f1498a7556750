"""What the environment tells about a step: means over the worlds."""

import torch
from torch import Tensor, stack

from telebip.math import norm
from telebip.mdp.faults import KINDS
from telebip.mdp.step import Step


def names(rewards: tuple[str, ...], terminations: tuple[str, ...], terrain_types: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Return what `means` returns, in its order."""
    return (
        *(f"reward/{name}" for name in rewards),
        *(f"termination/{name}_per_minute" for name in terminations),
        *("error/lin_vel_mps", "error/yaw_rate_radps", "walk/cost_of_transport", "walk/falls_per_minute", "fault/worlds"),
        *(f"fault/{kind}" for kind in KINDS),
        *(f"terrain/{name}_level" for name in terrain_types),
    )


def means(step: Step, rewards: Tensor, terminations: Tensor, faults: Tensor) -> Tensor:
    """Return means over the worlds, and numbers of faults; faulty worlds are left out of all but their own numbers.

    Args:
        step: the present step, with `fallen`.
        rewards: (terms, num_envs).
        terminations: bool, (terms, num_envs).
        faults: bool, (kinds, num_envs).
    """
    state, fault = step.state, faults.any(0)
    error = step.command_error
    rows = [norm(error[:, :2]), error[:, 2].abs(), state.joint_power.sum(1), norm(step.base_lin_vel_b[:, :2])]
    table = torch.cat([rewards, terminations.float(), stack([*rows, step.fallen.float()])])
    mean = table.masked_fill(fault, 0.0).sum(1) / (~fault).sum()
    n, per_minute = len(rewards), 60.0 / step.world.step_dt
    lin_error, yaw_error, power, speed, falls = mean[-5:]
    walk = stack([lin_error, yaw_error, power / (step.world.weight * speed), per_minute * falls, fault.sum()])
    return torch.cat([mean[:n], per_minute * mean[n:-5], walk, faults.sum(1), _levels(step)])


def _levels(step: Step) -> Tensor:
    """Return the mean level of the worlds of each type of terrain, from 0 on, (types,)."""
    ground, (type_, level) = step.world.ground, step.env.tile.unbind(1)
    if ground is None:
        return level[:0]
    is_of = type_ == torch.arange(len(ground.types), device=level.device)[:, None]
    return (is_of * level).sum(1) / is_of.sum(1)
