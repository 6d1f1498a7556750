"""How well a robot follows commands in all directions: a grid of them, changes, and the fastest."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.math import columns, wrap_angle
from telebip.rollout import judge_faults, walk

Array = NDArray[np.floating]
Command = tuple[float, float, float]
"""vx and vy along and to the left of the heading [m/s], and the yaw rate [rad/s]."""

LIMITS: dict[str, tuple[Command, float, float]] = {
    "forward": ((1.0, 0.0, 0.0), 0.1, 2.0),
    "backward": ((-1.0, 0.0, 0.0), 0.1, 1.5),
    "left": ((0.0, 1.0, 0.0), 0.1, 1.0),
    "right": ((0.0, -1.0, 0.0), 0.1, 1.0),
    "turn_left": ((0.0, 0.0, 1.0), 0.2, 3.0),
    "turn_right": ((0.0, 0.0, -1.0), 0.2, 3.0),
}
"""Commands of growing size: direction, step and largest size [m/s | rad/s]."""

FOLLOWED = 0.1  # of a command of `LIMITS`, by which the mean may differ


@dataclass(frozen=True)
class OmniProtocol:
    """All combinations of the grid, steady walks in other commands, random changes, and the ladders of `LIMITS`."""

    lin_vel_x: tuple[float, ...] = (-0.6, -0.3, 0.0, 0.3, 0.6, 0.9, 1.2)  # m/s
    lin_vel_y: tuple[float, ...] = (-0.4, -0.2, 0.0, 0.2, 0.4)  # m/s
    ang_vel_z: tuple[float, ...] = (-0.8, -0.4, 0.0, 0.4, 0.8)  # rad/s
    straight: tuple[float, ...] = (0.5, 0.7, 1.0)  # m/s, forward
    direction_speed: float = 0.4  # m/s, in each of the directions
    directions: int = 12  # of a whole circle
    changes: int = 20  # random commands of the grid's ranges, each followed by another
    worlds: int = 16  # for each command
    duration: float = 15.0  # s
    change_at: float = 5.0  # s
    skip: float = 5.0  # s, left out of all means after the start, and after a change
    seed: int = 1  # of the random commands

    @property
    def grid(self) -> list[Command]:
        """All combinations."""
        return [(x, y, w) for x in self.lin_vel_x for y in self.lin_vel_y for w in self.ang_vel_z]

    @property
    def circle(self) -> list[Command]:
        """One speed in all directions, from forward on to the left."""
        angles = [2.0 * math.pi * i / self.directions for i in range(self.directions)]
        return [(self.direction_speed * math.cos(a), self.direction_speed * math.sin(a), 0.0) for a in angles]

    @property
    def num_envs(self) -> int:
        """Worlds in all: every command at once."""
        steady = len(self.grid) + len(self.straight) + self.directions + sum(len(ladder(name)) for name in LIMITS)
        return self.worlds * (steady + self.changes)

    def random_commands(self) -> list[Command]:
        """Two for each change, one after the other."""
        draw = np.random.default_rng(self.seed).uniform
        ranges = [(min(values), max(values)) for values in (self.lin_vel_x, self.lin_vel_y, self.ang_vel_z)]
        return [(draw(*ranges[0]), draw(*ranges[1]), draw(*ranges[2])) for _ in range(2 * self.changes)]


def ladder(name: str) -> list[Command]:
    """Return the commands of one of `LIMITS`, from the smallest on."""
    (x, y, w), step, largest = LIMITS[name]
    sizes = [round(step * i, 6) for i in range(1, round(largest / step) + 1)]
    return [(size * x, size * y, size * w) for size in sizes]


def omni_results(
    env: TelebipEnv, policy: Policy, protocol: OmniProtocol, progress: Callable[[int], None] = lambda step: None
) -> dict[str, Any]:
    """Walk all commands of a protocol as one batch.

    Args:
        env: `protocol.num_envs` undisturbed worlds.
        policy: what walks.
        protocol: which commands, and for how long.
        progress: called with the number of finished policy steps.

    Returns:
        `grid`, `straight`, `directions` and `changes`: lists of what `_row` measures for each command; `limits`: the largest of
        each of `LIMITS`; and the worst of the grid. docs/evaluation.md describes the fields.

    Raises:
        UserError: the engine had no room for a world's contacts or constraints.
    """
    pairs = protocol.random_commands()
    parts = {
        "grid": protocol.grid,
        "straight": [(speed, 0.0, 0.0) for speed in protocol.straight],
        "directions": protocol.circle,
        **{name: ladder(name) for name in LIMITS},
        "changes": pairs[1::2],
    }
    commands = [command for part in parts.values() for command in part]
    first = commands[: len(commands) - protocol.changes] + pairs[0::2]
    rows = iter(_walk_commands(env, policy, first, commands, protocol, progress))
    results: dict[str, list[dict[str, Any]]] = {name: [next(rows) for _ in part] for name, part in parts.items()}
    changes = [{"before": _rounded(before), **row} for before, row in zip(pairs[0::2], results["changes"], strict=True)]
    return {
        **{name: results[name] for name in ("grid", "straight", "directions")},
        "changes": changes,
        "limits": {f"{name}_{'radps' if 'turn' in name else 'mps'}": fastest(results[name]) for name in LIMITS},
        "worst": {
            "lin_vel_error_mps": _worst(results["grid"], "lin_vel_error_mps"),
            "yaw_rate_error_radps": _worst(results["grid"], "yaw_rate_error_radps"),
            "falls": sum(row["falls"] for row in results["grid"]),
            "change_falls": sum(row["falls"] for row in changes),
        },
    }


def fastest(rows: Sequence[dict[str, Any]]) -> float:
    """Return the size of the largest command up to which every world follows all, 0 if none [m/s | rad/s].

    A command is followed where no world falls and the mean velocity, or yaw rate, differs by at most a tenth of it.
    """
    size = 0.0
    for row in rows:
        asked = float(np.linalg.norm(row["command"]))
        error = row["yaw_rate_error_radps"] if row["command"][2] else row["lin_vel_error_mps"]
        if row["falls"] or not error <= FOLLOWED * asked:
            break
        size = round(asked, 6)
    return size


def _worst(rows: Sequence[dict[str, Any]], name: str) -> float:
    """Return the largest error of all, NaN if one could not be measured."""
    return float(np.max([row[name] for row in rows]))


def _walk_commands(
    env: TelebipEnv,
    policy: Policy,
    first: Sequence[Command],
    then: Sequence[Command],
    protocol: OmniProtocol,
    progress: Callable[[int], None],
) -> list[dict[str, Any]]:
    """Walk each command of `first`, and from `change_at` on that of `then`, in `worlds` worlds; return a row for each."""
    n, device = protocol.worlds, env.device
    before, after = (torch.tensor(list(part), device=device).float().repeat_interleave(n, dim=0) for part in (first, then))
    begin = protocol.skip + torch.where((before != after).any(1), protocol.change_at, 0.0)  # of the means, in each world [s]
    velocity, power = torch.zeros(env.num_envs, 3, device=device), torch.zeros(env.num_envs, device=device)
    fallen, measured = torch.zeros_like(power, dtype=torch.bool), torch.zeros_like(power)
    env.set_commands(before)
    walking, heading = walk(env, policy), env.view().heading
    steps, change = round(protocol.duration / env.step_dt), round(protocol.change_at / env.step_dt)
    for step in range(steps):
        if step == change:
            env.set_commands(after)
        fallen |= next(walking).dones
        now = env.view()
        counts = ((step + 0.5) * env.step_dt > begin).float()
        velocity += counts[:, None] * columns(now.heading_lin_vel, wrap_angle(now.heading - heading) / env.step_dt)
        power += counts * now.state.joint_power.sum(1)
        measured += counts
        heading = now.heading
        progress(step + 1)
    judge_faults(env)
    return [
        _row(command, *part)
        for command, *part in zip(
            then,
            (velocity / measured[:, None]).reshape(-1, n, 3).cpu().double().numpy(),
            (power / measured / env.robot.weight).reshape(-1, n).cpu().double().numpy(),
            fallen.reshape(-1, n).cpu().numpy(),
            strict=True,
        )
    ]


def _row(command: Command, velocity: Array, power: Array, fallen: NDArray[np.bool_]) -> dict[str, Any]:
    r"""Measure how a command was followed by its worlds; those that fell count as falls, and in no mean.

        error = mean_worlds || mean_t v - v_cmd ||,    cost of transport = mean_worlds P / (m g mean_worlds ||mean_t v||)

    Args:
        command: vx, vy and the yaw rate.
        velocity: means over time of the same [m/s, m/s, rad/s], (worlds, 3).
        power: mean of sum_i |tau_i qd_i| over m g [m/s], (worlds,).
        fallen: which worlds fell, (worlds,).
    """
    kept, speed = velocity[~fallen], math.hypot(*command[:2])
    error, nothing = kept - np.array(command), {"mean": [math.nan] * 3, "lin_vel_error_mps": math.nan}
    row = nothing | {"yaw_rate_error_radps": math.nan, "power_mps": math.nan, "cot_mechanical": math.nan}
    if len(kept):
        cost = power[~fallen].mean()
        row = {
            "mean": _rounded(kept.mean(0)),
            "lin_vel_error_mps": round(float(np.linalg.norm(error[:, :2], axis=1).mean()), 5),
            "yaw_rate_error_radps": round(float(np.abs(error[:, 2]).mean()), 5),
            "power_mps": round(float(cost), 5),
            "cot_mechanical": round(float(cost / np.linalg.norm(kept[:, :2], axis=1).mean()), 5) if speed else math.nan,
        }
    return {"command": _rounded(command), **row, "falls": int(fallen.sum()), "worlds": len(fallen)}


def _rounded(values: Any) -> list[float]:
    return [round(float(value), 5) for value in values]
