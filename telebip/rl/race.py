"""A race between telebip's training and rsl-rl's own PPO: who learns what from the same samples, and in what time.

Both start from scratch with the same seed in worlds of their own, and their iterations alternate in one process, so that a
slow moment of the machine hits both. Of every pair of iterations the ratio of the times is taken, and of every training the
return that its episodes have after so many samples; several seeds show how much of a difference is chance.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

import torch

from telebip.config import TaskConfig
from telebip.env import TelebipEnv
from telebip.rl.benchmark import StockTrainer
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.sim import Backend

Curve = dict[str, list[float]]
RACERS = {"telebip": Trainer, "stock": StockTrainer}


def race(
    cfg: TaskConfig,
    robot: Robot,
    device: torch.device,
    backend: Backend,
    samples: int,
    stock_threads: int,
    progress: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Train with both for `samples` environment steps each, rounded up to whole iterations.

    Args:
        cfg: the task, with the seed.
        robot: from `telebip.robot.load_robot(cfg.sim.robot)`.
        device: where to train.
        backend: physics engine, see `telebip.sim.make_simulator`.
        samples: length of each training.
        stock_threads: threads of torch for rsl-rl's PPO.
        progress: called after each iteration of both.

    Returns:
        Ready for JSON: `seed`, `samples` after each iteration, and for both racers a curve of `episode_return`,
        `episode_length` [policy steps] and `seconds` of each iteration.
    """
    threads = {"telebip": torch.get_num_threads(), "stock": stock_threads}
    racers = {name: trainer(TelebipEnv(cfg, robot, device, backend), "", Path()) for name, trainer in RACERS.items()}
    curves: dict[str, Curve] = {name: {"episode_return": [], "episode_length": [], "seconds": []} for name in racers}
    at: list[int] = []
    while not at or at[-1] < samples:
        for name, racer in racers.items():
            torch.set_num_threads(threads[name])
            scalars = racer.iterate()
            curves[name]["episode_return"].append(scalars["train/episode_return"])
            curves[name]["episode_length"].append(scalars["train/episode_length"])
            curves[name]["seconds"].append(scalars["speed/collect_s"] + scalars["speed/learn_s"])
        torch.set_num_threads(threads["telebip"])
        at.append(racers["telebip"].samples)
        progress()
    return {"seed": cfg.seed, "samples": at, **curves}
