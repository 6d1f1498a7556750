"""The plots of the benchmark, the race and the sweep."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from telebip.eval.plots import BESIDE, COLORS, STYLE


@rc_context(STYLE)
def throughput(rows: Sequence[dict[str, Any]], title: str) -> Figure:
    """Environment steps per second against the number of worlds, as `telebip.tools.benchmark.measure` returns them."""
    stages = {"engine": "physics engine alone", "env": "environment", "collect": "with the policy", "train": "training"}
    worlds = [row["num_envs"] for row in rows]
    figure = Figure((7.2, 3.4))
    axes = figure.subplots()
    for i, (stage, label) in enumerate(stages.items()):
        rates = [row[f"{stage}_env_steps_per_s"] for row in rows]
        axes.plot(worlds, rates, "o-", color=COLORS[i], lw=1.4, ms=4, label=label)
    axes.set_xscale("log", base=2)
    axes.set_xticks(worlds, [str(number) for number in worlds])
    axes.minorticks_off()
    axes.set(xlabel="worlds", ylabel="environment steps per second", title=title, ylim=(0, None))
    axes.legend(**BESIDE)
    return figure


@rc_context(STYLE)
def race(races: Sequence[dict[str, Any]], title: str) -> Figure:
    """Return of the episodes against samples and against time, one line a seed, of `telebip.tools.race.race`."""
    figure = Figure((9.2, 2.8))
    left, right = figure.subplots(1, 2, sharey=True)
    for i, (name, label) in enumerate({"telebip": "telebip", "stock": "rsl-rl's PPO in float32"}.items()):
        for k, result in enumerate(races):
            returns = np.array(result[name]["episode_return"], dtype=float)
            minutes = np.cumsum(result[name]["seconds"]) / 60.0
            left.plot(np.array(result["samples"]) / 1e6, returns, color=COLORS[i], lw=1.1, label=label if k == 0 else None)
            right.plot(minutes, returns, color=COLORS[i], lw=1.1)
    left.set(xlabel="million samples", ylabel="return of an episode", title=title)
    right.set(xlabel="minutes of collecting and learning")
    left.legend(loc="upper left")
    return figure


@rc_context(STYLE)
def sweep(results: Mapping[str, Sequence[dict[str, Any]]], title: str) -> Figure:
    """Velocity error and falls of each setting's trainings against samples and seconds, of `telebip.tools.sweep.train_once`.

    A line is a seed, a dot where it walks.
    """
    figure = Figure((9.2, 4.6), layout="constrained")
    grid = figure.subplots(2, 2, sharex="col", sharey="row")
    rows = {"velocity_error_mps": "velocity error [m/s]", "falls_per_minute": "falls per minute"}
    columns = {"samples": "million samples", "seconds": "seconds of collecting and learning"}
    for axes_row, (name, ylabel) in zip(grid, rows.items(), strict=True):
        for axes, time in zip(axes_row, columns, strict=True):
            for i, (label, seeds) in enumerate(results.items()):
                for k, seed in enumerate(seeds):
                    unit = 1e-6 if time == "samples" else 1.0
                    x, y = unit * np.array(seed[time]), np.array(seed[name], dtype=float)
                    axes.plot(x, y, color=COLORS[i % len(COLORS)], lw=1.0, label=label if k == 0 else None)
                    if seed["walks"]:
                        at = unit * seed["walks"][time]
                        axes.plot(at, np.interp(at, x, y), "o", color=COLORS[i % len(COLORS)], ms=4)
            axes.set_ylim(bottom=0.0)
        axes_row[0].set_ylabel(ylabel)
    for axes, xlabel in zip(grid[-1], columns.values(), strict=True):
        axes.set_xlabel(xlabel)
    grid[0, 0].set_title(title)
    grid[0, 1].legend(loc="upper right")
    return figure
