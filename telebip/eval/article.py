"""The article's own numbers, for the same tables and plots. Its robot is another one."""

from typing import Any

RL, ALIP, DCM = "article: RL", "article: angular momentum", "article: DCM"

TRACKING: dict[str, dict[float, tuple[float, float]]] = {
    RL: {0.5: (0.532, 0.465), 0.7: (0.693, 0.427), 1.0: (0.961, 0.484)},
    ALIP: {0.5: (0.556, 0.582), 0.7: (0.767, 0.534), 1.0: (1.102, 0.547)},
    DCM: {0.5: (0.547, 0.503), 0.7: (0.741, 0.471), 1.0: (1.086, 0.489)},
}
"""Commanded speed [m/s] to mean speed [m/s] and cost of transport (its own formula)."""

PUSH: dict[str, dict[str, tuple[float, float, float]]] = {
    RL: {"10s": (75, 90, 25), "20s": (65, 60, 30)},
    ALIP: {"10s": (70, 100, 30), "20s": (65, 65, 30)},
    DCM: {"10s": (65, 100, 25), "20s": (50, 60, 20)},
}
"""Seconds of walking to the largest push forward, backward and to the side [N]."""


def as_results(label: str) -> dict[str, Any]:
    """Return the article's numbers for one of its walkers in the form of the evaluator's results, with what it reports."""
    return {
        "label": label,
        "tracking": [
            {"command_mps": command, "mean_speed_mps": speed, "cot_article": cot}
            for command, (speed, cot) in TRACKING[label].items()
        ],
        "push": {
            horizon: dict(zip(("forward_n", "backward_n", "lateral_n"), forces, strict=True))
            for horizon, forces in PUSH[label].items()
        },
    }
