"""A race between telebip's training and rsl-rl's own PPO: who learns what from the same samples, and in what time.

Both start from scratch with the same seed in worlds of their own, and their iterations alternate in one process, so that a
slow moment of the machine hits both. Of every pair of iterations the ratio of the times is taken, and of every training the
return that its episodes have after so many samples; several seeds show how much of a difference is chance.
"""

import math
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import torch

from telebip.config import TaskConfig
from telebip.env import TelebipEnv
from telebip.rl.process import random_state, set_random_state
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.sim import Backend

Curve = dict[str, list[float | None]]
RACERS = {"telebip": None, "stock": "ppo"}
"""Whose algorithm a racer has: the task's own, or rsl-rl's as it stands."""


def race(
    cfg: TaskConfig,
    robot: Robot,
    device: torch.device,
    backend: Backend,
    samples: int,
    progress: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Train with both for `samples` environment steps each, rounded up to whole iterations.

    Args:
        cfg: the task, with the seed.
        robot: from `telebip.robot.load_robot(cfg.sim.robot)`.
        device: where to train.
        backend: physics engine, see `telebip.sim.make_simulator`.
        samples: length of each training.
        progress: called after each iteration of both.

    Returns:
        Ready for JSON: `seed`, the engine `backend`, the `arithmetic` of both, `samples` after each iteration, and
        for both racers `episode_return`, `episode_length` [policy steps], which are None before an episode has ended, and
        `seconds` of each iteration.

    Raises:
        UserError: a training cannot go on, see `Trainer.learn`.
    """
    racers: dict[str, Trainer] = {}
    random = {}  # each racer's own random numbers
    for name, algorithm in RACERS.items():
        faults = Path(tempfile.gettempdir(), f"telebip_race_{name}")  # where they would be dumped
        racers[name] = Trainer(TelebipEnv(cfg, robot, device, backend), "", faults, algorithm=algorithm)
        random[name] = random_state(device)
    curves: dict[str, Curve] = {name: {"episode_return": [], "episode_length": [], "seconds": []} for name in racers}
    at: list[int] = []
    while not at or at[-1] < samples:
        for name, racer in racers.items():
            set_random_state(random[name], device)
            scalars = racer.iterate()
            random[name] = random_state(device)
            for key in ("episode_return", "episode_length"):
                value = scalars[f"train/{key}"]
                curves[name][key].append(None if math.isnan(value) else value)
            curves[name]["seconds"].append(scalars["speed/collect_s"] + scalars["speed/learn_s"])
        at.append(racers["telebip"].samples)
        progress()
    own = racers["telebip"]
    return {"seed": cfg.seed, "backend": own.env.sim.backend, "arithmetic": own.arithmetic, "samples": at, **curves}


def verdict(races: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what the races of one or several seeds come to.

    Returns:
        `samples` of each training; `episode_return`, for both racers the lowest and the highest of the seeds' last; `overlap`,
        whether these intervals have a point in common; and `train_over_stock`, the median over all pairs of iterations of
        rsl-rl's time over telebip's. A race's first pair, which allocates, counts only where there is no other.
    """
    last = {name: [race[name]["episode_return"][-1] for race in races] for name in RACERS}
    interval = {name: (min(values), max(values)) for name, values in last.items()}
    ratios = []
    for race in races:
        times = zip(race["stock"]["seconds"], race["telebip"]["seconds"], strict=True)
        pairs = [stock / own for stock, own in times]
        ratios += pairs[1:] or pairs
    return {
        "samples": races[0]["samples"][-1],
        "episode_return": interval,
        "overlap": max(low for low, _ in interval.values()) <= min(high for _, high in interval.values()),
        "train_over_stock": median(ratios),
    }


def sentence(found: dict[str, Any]) -> str:
    """Return a verdict in words."""
    intervals = found["episode_return"].values()
    own, stock = (f"{low:.2f}" if low == high else f"{low:.2f} to {high:.2f}" for low, high in intervals)
    meet = "they overlap" if found["overlap"] else "they do not overlap"
    meet = f" ({meet})" if any(low < high for low, high in intervals) else ""
    return f"return {own}, rsl-rl's {stock}{meet}; {found['train_over_stock']:.2f} times as fast"
