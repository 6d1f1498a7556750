"""What a training shows on a terminal while it goes on."""

import math
from collections import deque
from collections.abc import Iterable
from contextlib import contextmanager, nullcontext
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from telebip.rl.train import Trainer

LENGTHS = 60
"""Iterations in the sparkline of the episodes' length, as a share of the longest."""


@contextmanager
def training_progress(console, trainer, walking=None):
    """Yield a function that shows an iteration's scalars: three live lines on a terminal, else a line per fiftieth of the run.

    Iteration, time left, whether it walks and the speed error come first, and are whole on 60 columns.
    """
    from rich.console import Group
    from rich.live import Live
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.text import Text

    total = trainer.env.cfg.ppo.max_iterations
    every, lengths, below = max(1, total // 50), deque(maxlen=LENGTHS), Text("starting", overflow="ellipsis", no_wrap=True)
    columns = (MofNCompleteColumn(), TextColumn("eta"), TimeRemainingColumn(), BarColumn(20), TimeElapsedColumn())
    progress = Progress(*columns, console=console, speed_estimate_period=600)
    task = progress.add_task("", total=total, completed=trainer.iteration)

    def show(scalars: dict[str, float]) -> None:
        if math.isfinite(scalars["train/episode_length"]):  # until an episode has ended there is none
            lengths.append(scalars["train/episode_length"] / trainer.env.max_episode_length)
        lines = _progress_lines(scalars, trainer, walking)
        below.plain = "\n".join([*lines, f"length {sparkline(lengths)}"])
        progress.update(task, completed=trainer.iteration)
        if not console.is_terminal and (trainer.iteration % every == 0 or trainer.iteration == total):
            console.print(f"{trainer.iteration:5d}/{total}  {' | '.join(lines)}", soft_wrap=True)

    with Live(Group(progress, below), console=console, refresh_per_second=4) if console.is_terminal else nullcontext():
        yield show


def _progress_lines(scalars: dict[str, float], trainer: "Trainer", walking) -> list[str]:
    """Return what an iteration has brought, in lines of less than 60 characters, as a rule."""
    lines = [
        f"error {scalars['error/lin_vel_mps']:.2f} m/s | {scalars['walk/falls_per_minute']:.1f} falls/min | "
        f"length {scalars['train/episode_length']:.0f}/{trainer.env.max_episode_length}",
        f"{trainer.samples / 1e6:.2f} M samples at {scalars['speed/samples_per_s'] / 1e3:.1f} k/s | "
        f"return {scalars['train/episode_return']:.1f}",
    ]
    if walking and walking.last:
        lines.insert(0, f"{'walks' if walking.last.passed else 'not yet'}: {walking.last}")
    return lines


def sparkline(shares: Iterable[float]) -> str:
    """Return a bar of an eighth to eight eighths for each share from 0 to 1."""
    return "".join("▁▂▃▄▅▆▇█"[min(7, max(0, int(8.0 * share)))] for share in shares)
