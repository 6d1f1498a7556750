"""How fast a policy was learned, from the `learning.csv` of its run."""

from pathlib import Path
from typing import Any

from telebip.errors import UserError
from telebip.rl.curve import FILE, read_curve

COLUMNS = {
    "episode_length": "train/episode_length",  # policy steps
    "episode_return": "train/episode_return",
    "velocity_error_mps": "error/lin_vel_mps",
    "cost_of_transport": "walk/cost_of_transport",
    "falls_per_minute": "walk/falls_per_minute",
    "action_std": "train/action_std",
}


def learning_curve(run_dir: Path, points: int = 200) -> dict[str, Any] | None:
    """Return a run's curves, thinned to at most `points` rows, and the samples that 95 % of the final value took.

    Returns:
        `samples` and one list for each of `COLUMNS`, the last row among them; `samples_to_95_length` and
        `samples_to_95_return`. None if the folder has no learning curve, or an empty one.

    Raises:
        UserError: the file is damaged.
    """
    if not (run_dir / FILE).is_file():
        return None
    rows = read_curve(run_dir)
    try:
        samples = [row["samples"] for row in rows]
        curves = {name: [row[column] for row in rows] for name, column in COLUMNS.items()}
    except KeyError as error:
        raise UserError(f"{run_dir / FILE} is damaged: it has no column {error}") from error
    if not rows:
        return None
    every = max(1, -(-len(rows) // points))
    kept = slice((len(rows) - 1) % every, None, every)
    return {
        "samples": samples[kept],
        **{name: curve[kept] for name, curve in curves.items()},
        "samples_to_95_length": samples_to(samples, curves["episode_length"]),
        "samples_to_95_return": samples_to(samples, curves["episode_return"]),
    }


def samples_to(samples: list[float], curve: list[float], share: float = 0.95, final: int = 10) -> float | None:
    """Return the samples after which a curve first reached a share of its final value, the mean of its last `final` rows.

    None for an empty curve or one whose final value is not positive.
    """
    last = [value for value in curve[-final:] if value == value]
    goal = share * sum(last) / len(last) if last else 0.0
    return next((s for s, value in zip(samples, curve, strict=True) if value >= goal > 0.0), None)
