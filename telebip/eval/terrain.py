"""How rough a ground a policy walks on: the share of robots that leave their tile on foot, by type and level of the terrain."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from telebip.config import TaskConfig, check
from telebip.control.policy import Policy
from telebip.env import TelebipEnv
from telebip.eval.conditions import on_levels
from telebip.eval.statistics import share_interval
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


@dataclass(frozen=True)
class TerrainProtocol:
    """Robots that walk straight ahead from the middle of a tile of every type and level, each in a random direction."""

    worlds: int = 64  # for each type and level
    command: float = 0.5  # m/s, forward
    slack: float = 1.25  # how many times the commanded time a robot may take to the edge of its tile
    skip: float = 1.0  # s, left out of speed and cost
    passed: float = 0.95  # share of the robots that makes a level one that the policy walks on

    @property
    def num_envs(self) -> int:
        """Worlds in all: every tile at once."""
        return self.worlds * LEVELS * len(TYPES)

    @property
    def seconds(self) -> float:
        """How long the slowest robot that counts may take: to a corner of its tile [s]."""
        return self.slack * math.sqrt(0.5) * SIZE / self.command


def on_test_ground(config: TaskConfig) -> TaskConfig:
    """Return a task of `as_evaluated` on the grounds of this suite, its robots facing anywhere; worlds keep their tiles."""
    terrain = replace(config.terrain, types=TYPES, levels=LEVELS, size=SIZE, platform=1.0, seed=1)
    config = on_levels(replace(config, terrain=terrain), 0, LEVELS - 1)
    events = dict(config.events)
    if "start_pose" in events:
        events["start_pose"] = {**events["start_pose"], "heading": math.pi}
    contacts, constraints = max(16, config.sim.max_contacts), max(96, config.sim.max_constraints)
    sim = replace(config.sim, max_contacts=contacts, max_constraints=constraints)
    return check(replace(config, events=events, sim=sim))


def terrain_results(
    env: TelebipEnv, policy: Policy, protocol: TerrainProtocol, progress: Callable[[int], None] = lambda step: None
) -> dict[str, Any]:
    """Walk every type and level of the terrain as one batch.

    A robot arrives if it leaves its tile without a fall in `slack` times the time that its way takes at the commanded speed.

    Args:
        env: `protocol.num_envs` undisturbed worlds `on_test_ground`.
        policy: what walks.
        protocol: how.
        progress: called with the number of finished policy steps.

    Returns:
        `levels`: of each type and level the size of its obstacles, the share that arrived with its 95 % interval, and the
        median speed and cost of transport of those; `limits`: of each type the size of the hardest level up to which at least
        `passed` arrive. docs/evaluation.md describes the fields.

    Raises:
        UserError: the engine had no room for a world's contacts or constraints.
    """
    env.set_command(protocol.command, 0.0, 0.0)
    heading = env.view().heading
    way = 0.5 * SIZE / torch.maximum(torch.cos(heading).abs(), torch.sin(heading).abs())
    walks, arrived = torch.ones_like(heading, dtype=torch.bool), torch.zeros_like(heading, dtype=torch.bool)
    distance, energy, time = (torch.zeros_like(heading) for _ in range(3))
    steps = math.ceil(protocol.seconds / env.step_dt)
    for step, stride in zip(range(1, steps + 1), walk(env, policy), strict=False):
        view, now = env.view(), step * env.step_dt
        arrived |= walks & stride.extras["time_outs"]
        walks &= ~stride.dones & (now <= protocol.slack * way / protocol.command)
        if now > protocol.skip:
            distance += env.step_dt * view.heading_lin_vel[:, 0] * walks
            energy += env.step_dt * view.state.joint_power.sum(1) * walks
            time += env.step_dt * walks
        progress(step)
    judge_faults(env)
    measured = {"speed_mps": distance / time, "cot": energy / (env.robot.weight * distance)}
    measured = {name: values.cpu().numpy() for name, values in measured.items()}
    tile, there, levels = env.state.tile.cpu().numpy(), arrived.cpu().numpy(), {}
    for kind, (name, params) in enumerate(TYPES.items()):
        unit, ends = ("rad", ANGLE) if "angle" in params else ("m", HEIGHT)
        worlds = [(tile == [kind, level]).all(1) for level in range(LEVELS)]
        rows = [_row(there[here], {key: values[here] for key, values in measured.items()}) for here in worlds]
        sizes = np.linspace(*ends, LEVELS).round(5).tolist()
        levels[name] = [{"type": name, "size": size, "unit": unit, **row} for size, row in zip(sizes, rows, strict=True)]
    return {
        "limits": {name: limit(rows, protocol.passed) for name, rows in levels.items()},
        "levels": [row for rows in levels.values() for row in rows],
    }


def _row(arrived: NDArray[np.bool_], measured: Mapping[str, NDArray[np.floating]]) -> dict[str, Any]:
    """Return the share of a tile's robots (n,) that arrived, and the medians of what was measured of these."""
    number, interval = int(arrived.sum()), share_interval(int(arrived.sum()), len(arrived))
    medians = {key: float(np.median(values[arrived])) if number else math.nan for key, values in measured.items()}
    row = {"success": number / len(arrived), "success_low": interval[0], "success_high": interval[1], **medians}
    return {"worlds": len(arrived), **{key: round(value, 5) for key, value in row.items()}}


def limit(rows: Sequence[dict[str, Any]], passed: float) -> float:
    """Return the size of the hardest level up to which at least the share `passed` arrives; 0 if on none."""
    size = 0.0
    for row in rows:
        if row["success"] < passed:
            break
        size = row["size"]
    return size
