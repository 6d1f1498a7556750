"""The study: which policies are trained, what they are compared with, and which of a policy's seeds is shipped."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Training:
    """One policy of the study, trained by `train.py --task NAME --seed S`. All else about it stands in the task's YAML file."""

    name: str  # of its task, its folders, and its shipped policy
    label: str  # in tables and plots
    suites: tuple[str, ...] = ("tracking", "gait", "learning")


@dataclass(frozen=True)
class Baseline:
    """One model-based walker of the study."""

    name: str
    label: str
    controller: str
    overrides: tuple[str, ...] = ()
    suites: tuple[str, ...] = ("tracking", "push", "gait")


ALL = ("tracking", "push", "gait", "learning")

TRAININGS = (
    Training("telebip_efficient", "RL, efficient", ALL),
    Training("telebip_robust", "RL, robust", ALL),
    Training("telebip_flat", "RL, article's rewards", ALL),
    Training("telebip_rotary", "RL, rotary knees", ALL),
    Training("efficient_float32", "RL, efficient, float32"),
    Training("telebip_slow", "RL, slow"),
    Training("telebip_fast", "RL, fast"),
    Training("telebip_backward", "RL, backward"),
    Training("no_foot_reward", "RL, no foot reward"),
    Training("period_04", "RL, period 0.4 s"),
    Training("period_05", "RL, period 0.5 s"),
    Training("period_06", "RL, period 0.6 s"),
    Training("period_07", "RL, period 0.7 s"),
    Training("period_08", "RL, period 0.8 s"),
    Training("telebip_rough", "RL, rough ground", ("tracking", "gait", "learning", "terrain")),
    Training("telebip_stairs", "RL, stairs", ("tracking", "gait", "learning", "terrain")),
    Training("telebip_omni", "RL, all directions", ("tracking", "gait", "learning", "omni")),
    Training("telebip_real", "RL, for a real robot", ("tracking", "gait", "learning", "transfer")),
)

BASELINES = (Baseline("alip", "angular momentum", "alip"), Baseline("dcm", "DCM", "dcm"))

IN_README = ("telebip_efficient", "telebip_robust", "telebip_flat", "alip", "dcm")


def median_seed(results: Mapping[int, Mapping[str, Any]]) -> int:
    """Return which of a policy's seeds is shipped: the median of the mean cost of transport, of the seeds without a fall.

    The mean is over the commands of the tracking suite. Of an even number of seeds it is the cheaper one of the two in the
    middle. Where every seed falls, all take part.

    Args:
        results: by seed, as `telebip.eval.suites.evaluate` returns them.
    """
    without_falls = [seed for seed, found in results.items() if not any(row["falls"] for row in found["tracking"])]
    costs = sorted((mean_cost(results[seed]), seed) for seed in without_falls or results)
    return costs[(len(costs) - 1) // 2][1]


def mean_cost(results: Mapping[str, Any]) -> float:
    """Return the mean of the mechanical cost of transport over the commands, infinite where one has none [-]."""
    costs = [row["cot_mechanical"] for row in results["tracking"]]
    return math.fsum(costs) / len(costs) if None not in costs else math.inf
