"""How hard a walking robot can be pushed: the largest force that every world survives, in each direction."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.rollout import judge_faults, walk

DIRECTIONS = {"forward": (1.0, 0.0), "backward": (-1.0, 0.0), "left": (0.0, 1.0), "right": (0.0, -1.0)}
"""Unit vectors in the plane, x forward and y left of a robot that faces x."""


@dataclass(frozen=True)
class PushProtocol:
    """A force on the trunk's centre of mass, again and again while the robot walks.

    The first push comes a random part of the interval after the warm-up: with an interval that is no multiple of the gait
    period, pushes meet all phases of the gait.
    """

    command: float = 0.7  # m/s, forward
    duration: float = 0.1  # s, of one push
    interval: float = 1.1  # s, from the start of one push to the next
    warmup: float = 2.0  # s
    horizons: tuple[float, ...] = (10.0, 20.0)  # s of walking under pushes
    force_step: float = 5.0  # N
    max_force: float = 300.0  # N
    worlds: int = 32  # for each force and direction

    @property
    def forces(self) -> NDArray[np.floating]:
        """All forces, from the smallest up [N], (forces,)."""
        return self.force_step * np.arange(1, round(self.max_force / self.force_step) + 1)

    @property
    def num_envs(self) -> int:
        """Worlds in all: every force in every direction at once."""
        return len(self.forces) * len(DIRECTIONS) * self.worlds

    @property
    def seconds(self) -> float:
        """Length of the whole trial [s]."""
        return self.warmup + max(self.horizons)


def largest_survived(survived: NDArray[np.bool_], forces: NDArray[np.floating]) -> float:
    """Return the largest of `forces` (ascending) below which no world falls [N], 0 if none; `survived` is (forces, worlds)."""
    passed = int(np.cumprod(survived.all(1)).sum())
    return float(forces[passed - 1]) if passed else 0.0


def push_limits(survival_s: NDArray[np.floating], protocol: PushProtocol, weight: float) -> dict[str, dict[str, Any]]:
    """Reduce the survival times of `push_trial` to limits; `weight` is m g [N].

    Returns:
        For each horizon ("10s"): `forward_n`, `backward_n`, `lateral_n` (of left and right the worse) [N], the same as impulses
        (`forward_ns` [N s]) and as fractions of the weight (`forward_bw` [-]); and `survivors`, how many worlds survive each
        force, by direction.
    """
    table = {}
    for horizon in protocol.horizons:
        survived = {name: survival_s[:, i] >= horizon for i, name in enumerate(DIRECTIONS)}
        limit = {name: largest_survived(worlds, protocol.forces) for name, worlds in survived.items()}
        force = {"forward": limit["forward"], "backward": limit["backward"], "lateral": min(limit["left"], limit["right"])}
        table[f"{horizon:g}s"] = {
            **{f"{name}_n": value for name, value in force.items()},
            **{f"{name}_ns": round(value * protocol.duration, 6) for name, value in force.items()},
            **{f"{name}_bw": round(value / weight, 4) for name, value in force.items()},
            "survivors": {name: worlds.sum(1).tolist() for name, worlds in survived.items()},
        }
    return table


def push_trial(
    env: TelebipEnv, policy: Policy, protocol: PushProtocol, progress: Callable[[int], None] = lambda step: None
) -> NDArray[np.floating]:
    """Push every world of `env` and return how long each walked, (forces, directions, worlds) [s], infinite if to the end.

    Args:
        env: `protocol.num_envs` worlds of a task whose own pushes are off, and whose robots start facing x.
        policy: what walks.
        protocol: when and how hard.
        progress: called with the number of finished policy steps.

    Raises:
        UserError: the engine had no room for a world's contacts or constraints.
    """
    shape = (len(protocol.forces), len(DIRECTIONS), protocol.worlds)
    force = torch.as_tensor(protocol.forces, dtype=torch.float32, device=env.device)[:, None, None, None]
    direction = torch.tensor(list(DIRECTIONS.values()), device=env.device)[None, :, None]
    push = torch.nn.functional.pad((force * direction).expand(*shape, 2).reshape(-1, 2), (0, 1))  # (num_envs, 3)
    first = protocol.warmup + protocol.interval * torch.rand(env.num_envs, generator=env.generator, device=env.device)
    survival = torch.full((env.num_envs,), torch.inf, device=env.device)
    env.set_command(protocol.command, 0.0, 0.0)
    walking = walk(env, policy)
    for step in range(round(protocol.seconds / env.step_dt)):
        since = step * env.step_dt - first
        pushing = (since > -1e-6) & (torch.remainder(since + 1e-6, protocol.interval) < protocol.duration)
        env.push(push * pushing[:, None])
        dones = next(walking).dones
        walked = max(0.0, (step + 1) * env.step_dt - protocol.warmup)
        survival = torch.where(dones & survival.isinf(), walked, survival)
        progress(step + 1)
    judge_faults(env)
    return survival.reshape(shape).cpu().numpy()
