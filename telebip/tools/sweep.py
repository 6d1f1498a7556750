"""Settings x seeds: how fast each setting of a task learns to walk, and what its policy is like at the end.

Seconds are of collecting and learning alone: start-up, logs, checkpoints and looks at the policy do not count. A policy walks
once it has passed two looks in a row, see `telebip.eval.walking`; the time is that of the second one.
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
from telebip.eval.suites import Candidate, Protocol, evaluate
from telebip.eval.walking import UntilWalking
from telebip.rl.policy import load_network
from telebip.rl.train import Trainer
from telebip.robot import Robot
from telebip.sim import Backend

CURVES = {
    "velocity_error_mps": "error/lin_vel_mps",
    "falls_per_minute": "walk/falls_per_minute",
    "episode_length": "train/episode_length",
    "cost_of_transport": "walk/cost_of_transport",
    "action_std": "train/action_std",
    "learning_rate": "train/learning_rate",
}
"""Name in a result -> name of the training's scalar."""


def train_once(
    task: str,
    cfg: TaskConfig,
    robot: Robot,
    device: torch.device,
    backend: Backend,
    stop_when_walking: bool,
    progress: Callable[[str, int, int], None] = lambda *args: None,
) -> dict[str, Any]:
    """Train once from scratch.

    Args:
        task: its name.
        cfg: the task, with the seed.
        robot: from `telebip.robot.load_robot(cfg.sim.robot)`.
        device: where to train.
        backend: physics engine, see `telebip.sim.make_simulator`.
        stop_when_walking: whether the training ends when the policy walks, or after `ppo.max_iterations`.
        progress: called with what is running, finished iterations and their total.

    Returns:
        Ready for JSON: `seed`; `arithmetic`; `walks`, with `seconds` and `samples`, or None; after each iteration `samples`,
        `seconds` and each of `CURVES`, which is None before it has a value; `looks`, as (samples, text); and, after all
        iterations, `tracking`, as the evaluator has it.

    Raises:
        UserError: the training cannot go on, see `Trainer.learn`.
    """
    trainer = Trainer(TelebipEnv(cfg, robot, device, backend), task, Path(tempfile.gettempdir(), "telebip_sweep"))
    walking = UntilWalking(trainer)
    result: dict[str, Any] = {"seed": cfg.seed, "arithmetic": trainer.arithmetic, "walks": None, "samples": [], "seconds": []}
    result |= {"looks": [], **{name: [] for name in CURVES}}
    seconds, total = 0.0, cfg.ppo.max_iterations
    while trainer.iteration < total and not (stop_when_walking and result["walks"]):
        scalars = trainer.iterate()
        seconds += scalars["speed/collect_s"] + scalars["speed/learn_s"]
        result["samples"].append(trainer.samples)
        result["seconds"].append(seconds)
        for name, key in CURVES.items():
            result[name].append(None if math.isnan(scalars[key]) else scalars[key])
        before = walking.last
        if walking.walks() and not result["walks"]:
            result["walks"] = {"seconds": seconds, "samples": trainer.samples}
        if walking.last is not before:
            result["looks"].append((trainer.samples, str(walking.last)))
        progress("training", trainer.iteration, total)
    if not stop_when_walking:
        network = load_network(trainer.policy(), device)
        candidate = Candidate(task, cfg, lambda env: network)
        result["tracking"] = evaluate(candidate, robot, ["tracking"], Protocol(device=device, backend=backend), progress)[
            "tracking"
        ]
    return result


def verdict(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return what the seeds of one setting come to.

    Returns:
        `seeds` and `walked`, how many; `seconds` and `samples` to walk, None where a seed did not. After whole trainings
        also `end_seconds`, `speed_error` (relative, the largest of the speeds), `cost_of_transport` (mean over the speeds) and
        `falls` (of all seeds). What is not a number of seeds or falls is (median, worst).
    """
    walks = [result["walks"] or {"seconds": math.inf, "samples": math.inf} for result in results]
    found: dict[str, Any] = {"seeds": len(results), "walked": sum(result["walks"] is not None for result in results)}
    found |= {key: _median_and_worst([walk[key] for walk in walks]) for key in ("seconds", "samples")}
    if all("tracking" in result for result in results):
        rows = [result["tracking"] for result in results]
        errors = [max(abs(row["mean_speed_mps"] / row["command_mps"] - 1.0) for row in seed) for seed in rows]
        costs = [sum(row["cot_mechanical"] for row in seed) / len(seed) for seed in rows]
        found["end_seconds"] = _median_and_worst([result["seconds"][-1] for result in results])
        found["speed_error"], found["cost_of_transport"] = _median_and_worst(errors), _median_and_worst(costs)
        found["falls"] = sum(row["falls"] for seed in rows for row in seed)
    return found


def _median_and_worst(values: Sequence[float]) -> tuple[float | None, float | None]:
    middle, worst = (None if math.isinf(value) else value for value in (median(values), max(values)))
    return middle, worst
