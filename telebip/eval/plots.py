"""The report's plots. Each takes results as `telebip.eval.suites.evaluate` returns them and draws what they hold."""

import io
from collections.abc import Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

Results = dict[str, Any]

COLORS = ("#e8731f", "#29598f", "#3f8f5f", "#8a5aa8", "#c2455a", "#7a6a3a", "#2f9fa8", "#555b66", "#d9b02c", "#7fb3e0")
GREYS = ("#9aa0a8", "#b6bac0", "#ced1d6")
STYLE: Any = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e6ea",
    "grid.linewidth": 0.8,
    "axes.edgecolor": "#8b9099",
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "svg.hashsalt": "telebip",  # the same numbers give the same file
}


def svg(figure: Figure) -> str:
    """Return a figure as an SVG element, and close it."""
    buffer = io.StringIO()
    with plt.rc_context(STYLE):
        figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    plt.close(figure)
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def close(figure: Figure) -> None:
    """Forget a figure that is not to be drawn."""
    plt.close(figure)


def named(results: Results) -> str:
    """Return the label as matplotlib shows it: `$` opens no formula, and a leading `_` does not hide it from legends."""
    label = results["label"].replace("$", r"\$")
    return f" {label}" if label.startswith("_") else label


def color(index: int, label: str) -> str:
    """Colour of the method at a position of the whole list, the same in every plot: a grey for the article's own numbers."""
    return GREYS[index % len(GREYS)] if label.startswith("article") else COLORS[index % len(COLORS)]


def speed(results: Results) -> Figure:
    """Mean forward speed against time, with the command."""
    series = results["series"]["speed"]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.8))
        commands = [name for name in series if name != "time_s"]
        for i, name in enumerate(commands):
            axes.plot(series["time_s"], series[name], color=COLORS[i % len(COLORS)], lw=1.4, label=f"{float(name):g} m/s")
            axes.axhline(float(name), color=COLORS[i % len(COLORS)], lw=0.9, ls=(0, (4, 3)))
        axes.axvspan(0, results["protocol"]["skip_s"], color="#f3f4f6", zorder=0)
        axes.set(xlabel="time [s]", ylabel="speed [m/s]", title=f"{named(results)}: speed, and what was commanded (dashed)")
        axes.set_xlim(0, series["time_s"][-1])
        axes.legend(ncols=len(commands), loc="lower right")
    return figure


def feet(results: Results) -> Figure:
    """Force on each foot over two seconds, with the half periods in which the phase signal asks for it."""
    s = results["series"]["feet"]
    time = np.array(s["time_s"])
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 2.3))
        phase = np.array(s["phase_right"])
        top = 1.25 * max(*s["right_bw"], *s["left_bw"], 0.1)  # room for the legend
        axes.fill_between(time, 0, top, where=(phase > 0).tolist(), step="mid", color=COLORS[0], alpha=0.08, lw=0)
        axes.fill_between(time, 0, top, where=(phase < 0).tolist(), step="mid", color=COLORS[1], alpha=0.08, lw=0)
        axes.plot(time, s["right_bw"], color=COLORS[0], lw=1.5, label="right foot")
        axes.plot(time, s["left_bw"], color=COLORS[1], lw=1.5, label="left foot")
        axes.set(xlabel="time [s]", ylabel="force [body weights]", ylim=(0, top))
        axes.set_title(f"{named(results)}: forces on the feet at {s['command_mps']:g} m/s (shaded: whose turn it is)")
        axes.set_xlim(time[0], time[-1])
        axes.legend(ncols=2, loc="upper right")
    return figure


def cost_of_transport(all_results: Sequence[Results], commands: Sequence[float] = (0.5, 0.7, 1.0)) -> Figure:
    """Cost of transport by method and commanded speed, where most worlds walk on; by the formula that the article reports."""

    def walks_on(row: dict[str, Any]) -> bool:
        return row.get("falls", 0) <= row.get("worlds", 0) / 2

    costs_of = [{row["command_mps"]: row["cot_article"] for row in r.get("tracking", ()) if walks_on(row)} for r in all_results]
    shown = [k for k, costs in enumerate(costs_of) if costs.keys() & set(commands)]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2 + 0.6 * max(0, len(shown) - 6), 3.0))
        width = 0.84 / max(1, len(shown))
        for i, k in enumerate(shown):
            results, costs = all_results[k], costs_of[k]
            x = [at + (i - 0.5 * (len(shown) - 1)) * width for at, command in enumerate(commands) if command in costs]
            y = [costs[command] for command in commands if command in costs]
            bars = axes.bar(x, y, 0.92 * width, color=color(k, results["label"]), label=named(results))
            axes.bar_label(bars, fmt="%.2f", fontsize=7, padding=1)
        axes.set_xticks(range(len(commands)), [f"{command:.1f} m/s" for command in commands])
        axes.grid(axis="x", visible=False)
        axes.set(ylabel="cost of transport [-]", title="Cost of transport (lower is better)")
        if shown:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def push(all_results: Sequence[Results], horizon: str = "10s") -> Figure:
    """Largest push survived, by method and direction."""
    shown = [(k, r) for k, r in enumerate(all_results) if horizon in (r.get("push") or {})]
    directions = ("forward", "backward", "lateral")
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.0))
        width = 0.84 / max(1, len(shown))
        for i, (k, results) in enumerate(shown):
            x = [at + (i - 0.5 * (len(shown) - 1)) * width for at in range(3)]
            values = [results["push"][horizon][f"{name}_n"] for name in directions]
            bars = axes.bar(x, values, 0.92 * width, color=color(k, results["label"]), label=named(results))
            axes.bar_label(bars, fmt="%.0f", fontsize=7, padding=1)
        axes.set_xticks(range(3), ["forward", "backward", "lateral (worse side)"])
        axes.grid(axis="x", visible=False)
        axes.set(ylabel="force for 0.1 s [N]", title=f"Largest push survived during {horizon.removesuffix('s')} s of walking")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def joints(results: Results) -> Figure:
    """Where the energy goes: each actuator's share of the cost of transport."""
    rows = results["tracking"]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 0.7 + 0.42 * len(rows)))
        names = list(rows[0]["cot_joints"])
        left = np.zeros(len(rows))
        kinds = list(dict.fromkeys(name.removeprefix("right_").removeprefix("left_") for name in names))
        for name in names:
            cost = np.array([row["cot_joints"][name] or 0.0 for row in rows])
            tone = COLORS[kinds.index(name.removeprefix("right_").removeprefix("left_")) % len(COLORS)]
            alpha = 0.55 if name.startswith("left_") else 1.0
            axes.barh(range(len(rows)), cost, left=left, color=tone, alpha=alpha, label=name.replace("_", " "))
            left += cost
        axes.set_yticks(range(len(rows)), [f"{row['command_mps']:g} m/s" for row in rows])
        axes.invert_yaxis()
        axes.grid(axis="y", visible=False)
        axes.set(xlabel="cost of transport [-]", title=f"{named(results)}: which actuator pays")
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=7)
    return figure


def learning(all_results: Sequence[Results]) -> Figure:
    """Episode length and velocity error against samples."""
    shown = [(i, r) for i, r in enumerate(all_results) if r.get("learning")]
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.2, 2.8))
        for i, results in shown:
            curve = results["learning"]
            samples = np.array(curve["samples"]) / 1e6
            for axes, name in ((left, "episode_length"), (right, "velocity_error_mps")):
                values = np.array([np.nan if v is None else v for v in curve[name]], dtype=float)
                axes.plot(samples, values, color=color(i, results["label"]), lw=1.4, label=named(results))
        left.set(xlabel="million samples", ylabel="policy steps", title="Length of training episodes")
        right.set(xlabel="million samples", ylabel="m/s", title="Velocity error in training")
        for axes in (left, right):
            axes.set_ylim(bottom=0)
        right.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def throughput(rows: Sequence[dict[str, Any]], title: str) -> Figure:
    """Environment steps per second against the number of worlds, as `telebip.tools.benchmark.measure` returns them."""
    stages = {"engine": "physics engine alone", "env": "environment", "collect": "with the policy", "train": "training"}
    worlds = [row["num_envs"] for row in rows]
    with plt.rc_context(STYLE):
        figure, axes = plt.subplots(figsize=(7.2, 3.4))
        for i, (stage, label) in enumerate(stages.items()):
            rates = [row[f"{stage}_env_steps_per_s"] for row in rows]
            axes.plot(worlds, rates, "o-", color=COLORS[i], lw=1.4, ms=4, label=label)
        axes.set_xscale("log", base=2)
        axes.set_xticks(worlds, [str(number) for number in worlds])
        axes.minorticks_off()
        axes.set(xlabel="worlds", ylabel="environment steps per second", title=title)
        axes.set_ylim(bottom=0)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def race(races: Sequence[dict[str, Any]], title: str) -> Figure:
    """Return of the episodes against samples and against time, one line a seed, of `telebip.tools.race.race`."""
    with plt.rc_context(STYLE):
        figure, (left, right) = plt.subplots(1, 2, figsize=(9.2, 2.8), sharey=True)
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
