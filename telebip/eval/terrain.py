"""How rough a ground a policy walks on: the share of robots that leave their tile on foot, by type and level of the terrain."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from telebip.config import TaskConfig, check
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.rollout import judge_faults, walk

DEGREE = math.pi / 180.0
HEIGHT = (0.02, 0.24)  # m; twelve levels, 2 cm apart
ANGLE = (2.5 * DEGREE, 30.0 * DEGREE)  # rad; 2.5 degrees apart
TYPES: dict[str, dict[str, Any]] = {
    "slope_up": {"angle": ANGLE},
    "slope_down": {"angle": ANGLE},
    "stairs_up": {"rise": HEIGHT, "tread": 0.3},
    "stairs_down": {"rise": HEIGHT, "tread": 0.3},
    "boxes": {"height": HEIGHT, "width": 0.4},
    "noise": {"height": HEIGHT, "spacing": 0.2},
    "waves": {"height": HEIGHT, "length": 1.0},
}
"""The grounds of the suite, the same for every policy."""
LEVELS, SIZE = 12, 6.0  # rows of tiles, and the side of a tile [m]
SKIP = 1.0  # s, left out of speed and cost
SLACK = 1.25  # how many times the commanded time a robot may take
PASSED = 0.95  # share of the robots that makes a level one that the policy walks on


@dataclass(frozen=True)
class Crossing:
    """What became of every world, (num_envs,) each, after `SKIP` seconds where it is a mean."""

    arrived: Tensor  # bool: it left its tile on foot, in time
    speed: Tensor  # mean, along the heading [m/s]
    cost_of_transport: Tensor  # mean power over weight and speed [-]


def on_test_ground(config: TaskConfig) -> TaskConfig:
    """Return a task of `as_evaluated` on the grounds of this suite, its robots facing anywhere; worlds keep their tiles."""
    terrain = replace(config.terrain, types=TYPES, levels=LEVELS, start_level=(0, LEVELS - 1), size=SIZE, platform=1.0, seed=1)
    events = {name: params for name, params in config.events.items() if params.get("term", name) != "terrain_level"}
    if "start_pose" in events:
        events["start_pose"] = {**events["start_pose"], "heading": math.pi}
    room = replace(
        config.sim, max_contacts=max(16, config.sim.max_contacts), max_constraints=max(96, config.sim.max_constraints)
    )
    return check(replace(config, terrain=terrain, events=events, sim=room))


def seconds(speed: float) -> float:
    """Return how long the slowest robot that counts as arrived may take: to a corner of its tile [s]."""
    return SLACK * math.sqrt(0.5) * SIZE / speed


def cross(env: TelebipEnv, policy: Policy, speed: float, progress: Callable[[int, int], None] = lambda *args: None) -> Crossing:
    """Walk `policy` straight ahead at `speed` [m/s] from the middle of each world's tile until every world's time is over.

    A robot has arrived if it has left its tile without a fall in `SLACK` times the time that its way takes at this speed.

    Raises:
        UserError: the engine had no room for a world's contacts.
    """
    env.set_command(speed, 0.0, 0.0)
    heading = env.view().heading
    way = 0.5 * SIZE / torch.maximum(torch.cos(heading).abs(), torch.sin(heading).abs())
    steps = math.ceil(seconds(speed) / env.step_dt)
    walking, arrived = torch.ones_like(heading, dtype=torch.bool), torch.zeros_like(heading, dtype=torch.bool)
    distance, energy, time = (torch.zeros_like(heading) for _ in range(3))
    for step, stride in zip(range(1, steps + 1), walk(env, policy), strict=False):
        state, psi, now = env.sim.state, env.view().heading, step * env.step_dt
        arrived |= walking & stride.extras["time_outs"]
        walking &= ~stride.dones & (now <= SLACK * way / speed)
        if now > SKIP:
            ahead = torch.cos(psi) * state.base_lin_vel_w[:, 0] + torch.sin(psi) * state.base_lin_vel_w[:, 1]
            for total, rate in ((distance, ahead), (energy, state.joint_power.sum(1)), (time, torch.ones_like(ahead))):
                total += env.step_dt * rate * walking
        progress(step, steps)
    judge_faults(env)
    return Crossing(arrived, distance / time, energy / (env.robot.weight * distance))


def levels_of(config: TaskConfig, env: TelebipEnv, crossing: Crossing) -> list[dict[str, Any]]:
    """Return a row for each type and level, from the easiest on: what it is, the share that arrived, its speed and its cost."""
    tile, rows = env.state.tile.cpu(), []
    for column, (name, params) in enumerate(config.terrain.types.items()):
        unit, (low, high) = ("rad", params["angle"]) if "angle" in params else ("m", params.get("rise") or params["height"])
        for level in range(LEVELS):
            here = (tile == torch.tensor([column, level])).all(1)
            arrived = crossing.arrived.cpu()[here].numpy()
            share, (least, most) = arrived.mean(), wilson(int(arrived.sum()), len(arrived))
            row = {"type": name, "size": low + level / (LEVELS - 1) * (high - low), "unit": unit, "worlds": len(arrived)}
            row |= {"success": float(share), "success_low": least, "success_high": most}
            for key, values in (("speed_mps", crossing.speed), ("cot_mechanical", crossing.cost_of_transport)):
                kept = values.cpu()[here].numpy()[arrived]
                row[key] = float(np.median(kept)) if len(kept) else math.nan
            rows.append({key: round(value, 5) if isinstance(value, float) else value for key, value in row.items()})
    return rows


def limits(rows: list[dict[str, Any]]) -> dict[str, float]:
    """Return for each type the size of the hardest level up to which at least `PASSED` of the robots arrive; 0 if on none."""
    found: dict[str, float] = {}
    for name in dict.fromkeys(row["type"] for row in rows):
        found[name] = 0.0
        for row in (row for row in rows if row["type"] == name):
            if row["success"] < PASSED:
                break
            found[name] = row["size"]
    return found


def wilson(successes: int, number: int) -> tuple[float, float]:
    """Return the 95 % interval of a share, by Wilson's score (1927), which holds at shares of 0 and 1 too."""
    z, share = 1.959964, successes / number
    middle = (share + z * z / (2 * number)) / (1 + z * z / number)
    half = z / (1 + z * z / number) * math.sqrt(share * (1 - share) / number + z * z / (4 * number**2))
    return max(0.0, middle - half), min(1.0, middle + half)
