"""The report's plots. Each takes results as `telebip.eval.suites.evaluate` returns them and draws what they hold."""

import io
from collections.abc import Mapping, Sequence
from typing import Any, cast

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.projections.polar import PolarAxes

from telebip.eval.statistics import estimate

Results = dict[str, Any]
Group = Sequence[Results]  # of a walker's seeds

COLORS = ("#e8731f", "#29598f", "#3f8f5f", "#8a5aa8", "#c2455a", "#7a6a3a", "#2f9fa8", "#555b66", "#d9b02c", "#7fb3e0")
GREY = "#b6bac0"  # of the article's own numbers
SIGNS = ("positive", "negative")  # of work
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
BESIDE: Any = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0)}  # a legend's place


@rc_context(STYLE)
def svg(figure: Figure) -> str:
    """Return a figure as an SVG element."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def named(results: Results) -> str:
    """Return the label as matplotlib shows it: a leading `_` does not hide it from legends."""
    label = plain(results["label"])
    return f" {label}" if label.startswith("_") else label


def plain(text: str) -> str:
    """Return text in which `$` opens no formula of matplotlib's."""
    return text.replace("$", r"\$")


def lighter(tone: str, shade: float) -> tuple[float, ...]:
    """Return a colour mixed with white, of which there is none where `shade` is 1; grid lines do not shine through."""
    return tuple(1.0 - shade * (1.0 - part) for part in to_rgb(tone))


@rc_context(STYLE)
def speed(results: Results) -> Figure:
    """Mean forward speed against time, with the command."""
    figure = Figure((7.2, 2.8))
    axes, series = figure.subplots(), results["series"]["speed"]
    commands = [name for name in series if name != "time_s"]
    for i, name in enumerate(commands):
        axes.plot(series["time_s"], series[name], color=COLORS[i % len(COLORS)], lw=1.4, label=f"{float(name):g} m/s")
        axes.axhline(float(name), color=COLORS[i % len(COLORS)], lw=0.9, ls=(0, (4, 3)))
    axes.axvspan(0, results["protocol"]["skip_s"], color="#f3f4f6", zorder=0)
    axes.set(xlabel="time [s]", ylabel="speed [m/s]", xlim=(0, series["time_s"][-1]))
    axes.set_title(f"{named(results)}: speed (dashed: commanded; grey: left out of means)")
    axes.legend(**BESIDE)
    return figure


@rc_context(STYLE)
def feet(results: Results) -> Figure:
    """Force on each foot over two seconds, with the half periods in which the phase signal asks for it."""
    figure = Figure((7.2, 2.3))
    axes, s = figure.subplots(), results["series"]["feet"]
    time, phase = np.array(s["time_s"]), np.array(s["phase_right"])
    top = 1.25 * max(*s["right_bw"], *s["left_bw"], 0.1)  # room for the legend
    for foot, turn, tone in (("right", phase > 0, COLORS[0]), ("left", phase < 0, COLORS[1])):
        axes.fill_between(time, 0, top, where=turn.tolist(), step="mid", color=tone, alpha=0.08, lw=0)
        axes.plot(time, s[f"{foot}_bw"], color=tone, lw=1.5, label=f"{foot} foot")
    axes.set(xlabel="time [s]", ylabel="force [body weights]", xlim=(time[0], time[-1]), ylim=(0, top))
    axes.set_title(f"{named(results)}: forces on the feet at {s['command_mps']:g} m/s (shaded: whose turn it is)")
    axes.legend(ncols=2, loc="upper right")
    return figure


@rc_context(STYLE)
def cost_of_transport(groups: Sequence[Group], commands: Sequence[float] = (0.5, 0.7, 1.0)) -> Figure:
    """Cost of transport by method and commanded speed, where most worlds walk on; by the formula that the article reports."""
    costs: list[dict[int, list[float]]] = []
    for group in groups:
        cost: dict[int, list[float]] = {}
        for row in (row for results in group for row in results.get("tracking", ())):
            walks_on = row.get("falls", 0) <= row.get("worlds", 0) / 2 and row["cot_article"] is not None
            if walks_on and row["command_mps"] in commands:
                cost.setdefault(commands.index(row["command_mps"]), []).append(row["cot_article"])
        costs.append(cost)
    xlabel, title = "cost of transport, the article's formula [-]", "Cost of transport (lower is better)"
    return _bars(groups, costs, [f"{command:.1f} m/s" for command in commands], "%.2f", xlabel, title)


@rc_context(STYLE)
def push(groups: Sequence[Group], horizon: str = "10s") -> Figure:
    """Largest push that all worlds survive, by method and direction; the article reports no other."""
    directions = ("forward", "backward", "lateral")
    limits = [[limit for results in group if (limit := (results.get("push") or {}).get(horizon))] for group in groups]
    forces = [{at: [limit[f"{name}_n"] for limit in of_it] for at, name in enumerate(directions) if of_it} for of_it in limits]
    title = f"Largest push that all worlds survive for {horizon.removesuffix('s')} s"
    return _bars(groups, forces, ["forward", "backward", "lateral (worse side)"], "%.0f", "force for 0.1 s [N]", title)


def _bars(
    groups: Sequence[Group],
    found: Sequence[Mapping[int, Sequence[float]]],
    panels: list[str],
    digits: str,
    xlabel: str,
    title: str,
) -> Figure:
    """Draw a bar for each method in every panel: its interquartile mean with its interval, and a dot for each seed.

    `found` holds each method's values by the panel's index; a method without any is left out.
    """
    shown = [(group, values) for group, values in zip(groups, found, strict=True) if values]
    figure = Figure((9.6, 1.1 + 0.22 * len(shown)), layout="constrained")
    figure.suptitle(title, x=0.0, ha="left", fontsize=10, fontweight="bold")
    figure.supxlabel(xlabel, fontsize=9)
    for panel, axes in enumerate(figure.subplots(1, len(panels), sharex=True, sharey=True)):
        for row, (group, values) in enumerate(shown):
            tone = GREY if group[0]["label"].startswith("article") else COLORS[1]
            _bar(axes, row, values.get(panel, ()), tone, digits)
        axes.set_yticks(range(len(shown)), [named(group[0]) for group, _ in shown])
        axes.set(ylim=(max(1, len(shown)) - 0.5, -0.5))
        axes.set_title(panels[panel], fontweight="normal")
        axes.grid(axis="y", visible=False)
        axes.margins(x=0.15)  # room for the numbers
    return figure


def _bar(axes: Axes, row: int, values: Sequence[float], tone: str, digits: str) -> None:
    """Draw one method's bar, with its number beside it; a dash where there is none."""
    one = estimate(values)
    place = {"xytext": (3, 0), "textcoords": "offset points", "va": "center", "fontsize": 7}
    if not values:
        axes.annotate("-", (0.0, row), **place)
        return
    axes.barh(row, one.value, 0.8, color=tone)
    axes.annotate(digits % one.value, (max(values), row), **place)
    if len(values) > 1:
        axes.plot(values, [row] * len(values), "o", color="black", ms=2.0, alpha=0.6)
    if np.isfinite(one.low):
        axes.plot([one.low, one.high], [row, row], color="black", lw=1.2)


@rc_context(STYLE)
def omni(results: Results) -> Figure:
    """Errors over vx and vy and over vx and the yaw rate, the worst over the third, and the cost of transport by direction."""
    rows = results["omni"]["grid"]
    figure = Figure((9.6, 5.2), layout="constrained")
    figure.suptitle(f"{named(results)}: what it follows (the worst over the third command; x: a world fell)", fontsize=10)
    axes = figure.subplot_mosaic([["xy", "xw", "cost"], ["wy", "ww", "cost"]], per_subplot_kw={"cost": {"projection": "polar"}})
    errors = {"x": ("lin_vel_error_mps", "velocity error [m/s]"), "w": ("yaw_rate_error_radps", "yaw rate error [rad/s]")}
    for first, (name, title) in errors.items():
        for second, column, label in (("y", 1, "vy [m/s]"), ("w", 2, "yaw rate [rad/s]")):
            _map(axes[first + second], rows, column, name)
            axes[first + second].set(xlabel="vx [m/s]", ylabel=label, title=title)
    around = results["omni"]["directions"]
    angle = [np.arctan2(row["command"][1], row["command"][0]) for row in around]
    cost = [np.nan if row["cot_mechanical"] is None else row["cot_mechanical"] for row in around]
    polar = cast(PolarAxes, axes["cost"])
    polar.plot([*angle, angle[0]], [*cost, cost[0]], "o-", color=COLORS[0], lw=1.4, ms=4)
    polar.set_theta_zero_location("N")  # forward is up, left is left
    polar.set_thetagrids((0, 90, 180, 270), ("forward", "left", "backward", "right"))
    polar.set_title(f"cost of transport at {results['omni']['protocol']['direction_speed']:g} m/s", pad=14)
    polar.set_ylim(0.0)
    return figure


def _map(axes: Axes, rows: Sequence[dict[str, Any]], column: int, error: str) -> None:
    """Draw the largest error over vx (across) and the command in `column` (upwards), with its value in each cell."""
    across, up = (sorted({row["command"][i] for row in rows}) for i in (0, column))
    worst = np.zeros((len(up), len(across)))
    for row in rows:
        at = up.index(row["command"][column]), across.index(row["command"][0])
        worst[at] = np.fmax(worst[at], np.array(row[error], dtype=float))  # a NaN changes nothing
        if row["falls"]:
            axes.plot(at[1], at[0] - 0.3, "x", color="black", ms=4)
    axes.imshow(worst, origin="lower", aspect="auto", cmap="YlOrRd", vmin=0.0, vmax=0.15)
    for (i, k), value in np.ndenumerate(worst):
        axes.text(k, i, f"{value:.2f}", ha="center", va="center", fontsize=7, color="white" if value > 0.1 else "black")
    axes.set_xticks(range(len(across)), [f"{value:g}" for value in across])
    axes.set_yticks(range(len(up)), [f"{value:g}" for value in up])
    axes.grid(visible=False)


@rc_context(STYLE)
def terrain(results: Results) -> Figure:
    """Share of the robots that leave their tile on foot, by type and level of the terrain."""
    rows = results["terrain"]["levels"]
    kinds = list(dict.fromkeys(row["type"] for row in rows))
    figure = Figure((9.6, 0.8 + 0.42 * len(kinds)), layout="constrained")
    axes = figure.subplots()
    for i, kind in enumerate(kinds):
        of_kind = [row for row in rows if row["type"] == kind]
        axes.imshow(
            np.array([[row["success"] for row in of_kind]]),
            extent=(-0.5, len(of_kind) - 0.5, i + 0.46, i - 0.46),
            aspect="auto",
            cmap="RdYlGn",
            vmin=0.0,
            vmax=1.0,
        )
        for k, row in enumerate(of_kind):
            text, ink = (
                f"{100.0 * row['success']:.0f} %\n{obstacle(row)}",
                "white" if abs(row["success"] - 0.5) > 0.35 else "black",
            )
            axes.text(k, i, text, color=ink, ha="center", va="center", fontsize=6.5)
    axes.set_yticks(range(len(kinds)), [kind.replace("_", " ") for kind in kinds])
    axes.set(xlim=(-0.5, len(rows) / len(kinds) - 0.5), ylim=(len(kinds) - 0.5, -0.5), xticks=[])
    axes.grid(visible=False)
    speed = f"{results['terrain']['protocol']['command']:g} m/s"
    axes.set_title(
        f"{named(results)}: share of the robots that leave their tile on foot, and size of the obstacles, at {speed}"
    )
    return figure


@rc_context(STYLE)
def transfer(results: Results) -> Figure:
    """Share of the worlds without a fall, with its 95 % interval, and the speed error of the median one, factor by factor."""
    factors, protocol = results["transfer"]["factors"], results["transfer"]["protocol"]
    columns = 4
    rows = -(-len(factors) // columns)
    figure = Figure((9.6, 0.9 + 1.5 * rows), layout="constrained")
    what = f"one factor of {plain(protocol['task'])} at a time, at {protocol['command']:g} m/s"
    figure.suptitle(f"{named(results)}: {what} (dotted: nominal; shaded: 95 % interval)", fontsize=10)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    for axes, factor in zip(grid.flat, factors, strict=False):
        unit, points = factor["unit"], factor["points"]
        scale = 1000.0 * results["transfer"]["physics_dt"] if unit == "physics steps" else 1.0
        value = [scale * row["value"] for row in points]
        shares = [[row[name] for row in points] for name in ("success_low", "success_high", "success")]
        axes.fill_between(value, shares[0], shares[1], color=COLORS[1], alpha=0.15, lw=0)
        axes.plot(value, shares[2], "o-", color=COLORS[1], lw=1.3, ms=3, label="share without a fall")
        error = np.array([row["speed_error"] for row in points], dtype=float)
        axes.plot(value, error, "s--", color=COLORS[0], lw=1.1, ms=2.5, label="median speed error, of the command")
        axes.axvline(scale * factor["nominal"], color="#8b9099", lw=0.9, ls=":")
        shown = "ms" if unit == "physics steps" else unit
        axes.set(ylim=(-0.04, 1.04))
        axes.locator_params(axis="x", nbins=4)
        axes.set_title(
            factor["name"].removesuffix(".range").replace("_", " ") + (f" [{shown}]" if shown else ""),
            fontsize=8,
            fontweight="normal",
        )
        axes.tick_params(labelsize=7)
    for axes in grid.flat[len(factors) :]:
        axes.set_visible(False)
    if factors:
        figure.legend(*grid.flat[0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def obstacle(row: Mapping[str, Any]) -> str:
    """Return the size of a level's obstacles as people say it: "12 cm", "7.5°"."""
    return f"{np.degrees(row['size']):.3g}°" if row["unit"] == "rad" else f"{100.0 * row['size']:.3g} cm"


@rc_context(STYLE)
def joints(results: Results) -> Figure:
    """Where the energy goes: each actuator's share of the cost of transport."""
    rows = results["tracking"]
    figure = Figure((7.2, 0.7 + 0.42 * len(rows)))
    axes, left = figure.subplots(), np.zeros(len(rows))
    kinds: list[str] = []
    for name in rows[0]["cot_joints"]:
        kind = name.removeprefix("right_").removeprefix("left_")
        kinds += [] if kind in kinds else [kind]
        cost = np.array([row["cot_joints"][name] or 0.0 for row in rows])
        tone = lighter(COLORS[kinds.index(kind) % len(COLORS)], 0.55 if name.startswith("left_") else 1.0)
        axes.barh(range(len(rows)), cost, left=left, color=tone, label=name.replace("_", " "))
        left += cost
    axes.set_yticks(range(len(rows)), [f"{row['command_mps']:g} m/s" for row in rows])
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set(xlabel="cost of transport [-]", title=f"{named(results)}: which actuator pays")
    axes.legend(**BESIDE, fontsize=7)
    return figure


@rc_context(STYLE)
def energy(all_results: Sequence[Results]) -> Figure:
    """Where the energy goes at the speed nearest to 0.7 m/s, by walker: joints and phases, driving right, braking left."""
    labels, shares = [], []
    for results in all_results:
        if rows := results.get("tracking"):
            row = min(rows, key=lambda row: abs(row["command_mps"] - 0.7))
            total = sum(part[sign] or 0.0 for part in row["energy"] for sign in SIGNS)
            labels.append(f"{named(results)}, {row['command_mps']:g} m/s, COT {total:.3f}")
            shares.append(
                [part | {sign: 100.0 * (part[sign] or 0.0) / (total or 1.0) for sign in SIGNS} for part in row["energy"]]
            )
    figure = _energy_bars(labels, shares, "share of the cost of transport [%]")
    figure.axes[0].set_title("Where the energy goes (left: brakes, right: drives)")
    return figure


@rc_context(STYLE)
def energy_by_speed(results: Results) -> Figure:
    """Where the energy of one walker goes, by speed."""
    rows = results["tracking"]
    labels = [f"{row['command_mps']:g} m/s" for row in rows]
    figure = _energy_bars(labels, [row["energy"] for row in rows], "part of the cost of transport [-]")
    figure.axes[0].set_title(f"{named(results)}: where the energy goes (left: brakes, right: drives)")
    return figure


def _energy_bars(labels: Sequence[str], rows: Sequence[Sequence[dict[str, Any]]], xlabel: str) -> Figure:
    """Draw a bar for each of `rows`: joints by colour, phases by shade, positive work to the right and negative to the left."""
    figure = Figure((8.6, 1.1 + 0.3 * len(rows)))
    axes, shades = figure.subplots(), {"stance": 1.0, "double_support": 0.65, "swing": 0.35}
    parts = list(dict.fromkeys((part["joint"], part["phase"]) for row in rows for part in row))
    joints = list(dict.fromkeys(joint for joint, _ in parts))
    for sign, way in zip(SIGNS, (1.0, -1.0), strict=True):
        left = np.zeros(len(rows))
        for joint, phase in parts:
            found = [{(part["joint"], part["phase"]): part[sign] or 0.0 for part in row} for row in rows]
            width = way * np.array([part.get((joint, phase), 0.0) for part in found])
            label = f"{joint}, {phase}".replace("_", " ") if sign == "positive" else None
            tone = lighter(COLORS[joints.index(joint) % len(COLORS)], shades[phase])
            axes.barh(range(len(rows)), width, left=left, color=tone, label=label)
            left += width
    axes.axvline(0.0, color="#22262c", lw=0.8)
    axes.set_yticks(range(len(rows)), list(labels))
    axes.xaxis.set_major_formatter(lambda value, _: f"{abs(value):g}")  # work has no sign here
    axes.invert_yaxis()
    axes.grid(axis="y", visible=False)
    axes.set(xlabel=xlabel)
    axes.legend(**BESIDE, fontsize=7)
    return figure


@rc_context(STYLE)
def learning(groups: Sequence[Group]) -> Figure:
    """Episode length and velocity error against samples; a line for each seed."""
    figure = Figure((9.2, 2.8))
    left, right = figure.subplots(1, 2)
    for i, group in enumerate(groups):
        curves = [curve for results in group if (curve := results.get("learning"))]
        for k, curve in enumerate(curves):
            samples = np.array(curve["samples"]) / 1e6
            for axes, name in ((left, "episode_length"), (right, "velocity_error_mps")):
                values = np.array(curve[name], dtype=float)  # None becomes NaN
                label = named(group[0]) if k == 0 else None
                style = {"color": COLORS[i % len(COLORS)], "ls": ("-", "--", ":")[i // len(COLORS) % 3]}
                axes.plot(samples, values, **style, lw=1.4 / len(curves) ** 0.5, label=label)
    left.set(xlabel="million samples", ylabel="episode length [policy steps]", title="Length of episodes in training")
    right.set(xlabel="million samples", ylabel="velocity error [m/s]", title="Velocity error in training")
    for axes in (left, right):
        axes.set_ylim(bottom=0.0)
    right.legend(**BESIDE)
    return figure
