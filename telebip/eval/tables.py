"""The numbers of a report: tables of walkers, with interquartile means and intervals where a walker has several seeds."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from telebip.eval.energy import PHASES
from telebip.eval.push import DIRECTIONS
from telebip.eval.statistics import estimate, share_interval

Results = dict[str, Any]
Group = Sequence[Results]  # of a walker's seeds
Table = tuple[str, list[str], list[list[str]]]  # title, header and rows

WHO = ("walker", "seeds")
SIDES = ("forward", "backward", "lateral")


def tables(groups: Sequence[Group]) -> list[Table]:
    """Return the report's tables; one without rows has nothing to say."""
    tracking = [*WHO, "command [m/s]", "mean speed [m/s]", "error", "RMS error [m/s]", "falls", "yaw drift [deg]"]
    tracking += ["COT mechanical", "COT article", "COT positive"]
    push = [*WHO, *(f"all: {name} [N]" for name in SIDES), *(f"95 %: {name} [N]" for name in SIDES)]
    push += [*(f"share at that limit, {name}" for name in DIRECTIONS), "all: as impulse [N s]", "all: of body weight"]
    gait = [*WHO, "command [m/s]", "period [s]", "regularity", "symmetry", "duty factor", "double support", "flight"]
    gait += ["peak force [body weights]", "stride [m]", "knee stroke [m]"]
    learning = [*WHO, "samples", "to 95 % of the final episode length", "to 95 % of the final return"]
    omni = [*WHO, "largest error [m/s]", "[rad/s]", "falls", "falls after changes", "COT straight ahead"]
    omni += ["forward [m/s]", "backward [m/s]", "sideways [m/s]", "turning [rad/s]"]
    transfer = [*WHO, "width of the ranges", "without a fall", "share", "its 95 % interval in worlds"]
    transfer += ["speed error, median", "95 % of worlds", "COT, median"]
    rough = _with("terrain", groups)
    kinds = [name.replace("_", " ") for name in rough[0][1][0]["limits"]] if rough else []
    pushed = _with("push", groups)
    horizons = sorted({name for _, parts in pushed for name in parts[0] if _is_horizon(name)}, key=_seconds)
    return [
        (
            "Tracking and cost of transport",
            tracking,
            [
                [*_who(group), *_tracking_cells(rows)]
                for group, parts in _with("tracking", groups)
                for rows in _by_command(parts)
            ],
        ),
        *(
            (
                f"Largest push survived, {horizon.removesuffix('s')} s of walking",
                push,
                [
                    [*_who(group), *_push_cells([part[horizon] for part in parts])]
                    for group, parts in pushed
                    if horizon in parts[0]
                ],
            )
            for horizon in horizons
        ),
        _energy_table(groups),
        ("All directions", omni, [[*_who(group), *_omni_cells(parts)] for group, parts in _with("omni", groups)]),
        ("Hardest terrain passed", [*WHO, *kinds], [[*_who(group), *_terrain_cells(parts)] for group, parts in rough]),
        (
            "Transfer: worlds of drawn robots",
            transfer,
            [
                [*_who(group), *_transfer_cells(rows)]
                for group, parts in _with("transfer", groups)
                for rows in zip(*(part["worlds"] for part in parts), strict=True)
            ],
        ),
        _factors_table([(group[0]["label"], parts[0]) for group, parts in _with("transfer", groups)]),
        ("Gait", gait, [[*_who(group), *_gait_cells(parts)] for group, parts in _with("gait", groups)]),
        ("Learning", learning, [[*_who(group), *_learning_cells(parts)] for group, parts in _with("learning", groups)]),
        (
            "Processor, arithmetic and engine",
            ["walker", "seeds", "trained on", "networks in", "engine", "measured on", "engine"],
            [[*_who(group), *_machine_cells(group)] for group in groups if "engine" in group[0]],
        ),
    ]


def _factors_table(measured: Sequence[tuple[str, Any]]) -> Table:
    """Return what each factor does at worst over its range: a row for each, a column for each walker, its first seed."""
    swept = [(label, {factor["name"]: factor["points"] for factor in part["factors"]}) for label, part in measured]
    names = list(dict.fromkeys(name for _, factors in swept for name in factors))

    def worst(points: Sequence[dict[str, Any]]) -> str:
        error = max((row["speed_error"] for row in points if row["speed_error"] is not None), default=math.nan)
        falls = max(points, key=lambda row: row["falls"] / row["worlds"])
        return f"{falls['falls']} of {falls['worlds']} / {number(100.0 * error, 1)} %"

    rows = [[name, *(worst(factors[name]) if name in factors else "-" for _, factors in swept)] for name in names]
    return "Transfer: most falls and largest median speed error over the range of one factor", ["factor", *dict(swept)], rows


def overview(groups: Sequence[Group]) -> list[Table]:
    """Return the tables of docs/results.md: cost of transport, speed errors and falls; and pushes."""
    tracked, pushed = _with("tracking", groups), _with("push", groups)
    measured = {row["command_mps"] for _, parts in tracked for part in parts for row in part}
    commands = sorted(measured, key=lambda command: (command < 0.0, abs(command)))
    walking = [*WHO, *(f"COT at {command:g} m/s" for command in commands), "largest error of the mean speed", "falls"]
    horizons = sorted({name for _, parts in pushed for name in parts[0] if _is_horizon(name)}, key=_seconds)
    header = [f"{name}, {horizon.removesuffix('s')} s" for horizon in horizons for name in ("95 % survive", "all survive")]
    return [
        ("Walking", walking, [[*_who(group), *_walking_cells(parts, commands)] for group, parts in tracked]),
        (
            "Pushes survived, forward / backward / lateral [N]",
            [*WHO, *header],
            [
                [*_who(group), *(_limits(parts, horizon, suffix) for horizon in horizons for suffix in ("_95_n", "_n"))]
                for group, parts in pushed
            ],
        ),
    ]


def short_overview(walkers: Mapping[str, Group]) -> Table:
    """Return the table of the README: walkers by name, at 0.7 m/s, and the pushes that all worlds survive for 10 s."""
    header = [*WHO, "cost of transport", "largest speed error", "falls", *(f"push {name} [N]" for name in SIDES)]
    rows = []
    for name, group in walkers.items():
        tracked = [results["tracking"] for results in group if results.get("tracking")]
        pushed = [part["10s"] for results in group if "10s" in (part := results.get("push") or {})]
        limits = (over_seeds([part[f"{side}_n"] for part in pushed], 0) for side in SIDES)
        rows.append([f"`{name}`", _who(group)[1], *_walking_cells(tracked, [0.7]), *limits])
    return "", header, rows


def _walking_cells(parts: Sequence[list[dict[str, Any]]], commands: Sequence[float]) -> list[str]:
    by_command = {rows[0]["command_mps"]: rows for rows in _by_command(parts)}
    errors = [
        max(abs(row["mean_speed_mps"] / row["command_mps"] - 1.0) for row in part if row["command_mps"]) for part in parts
    ]
    costs = [[_cost(row) for row in by_command.get(command, [])] for command in commands]
    return [*(over_seeds(cost, 3) for cost in costs), over_seeds([100.0 * error for error in errors], 1, " %"), _falls(parts)]


def _cost(row: dict[str, Any]) -> float | None:
    """Return a command's cost of transport, of the article's formula where a reference has no other."""
    return row.get("cot_mechanical", row["cot_article"])


def _falls(parts: Sequence[list[dict[str, Any]]]) -> str:
    rows = [row for part in parts for row in part if "falls" in row]
    return f"{sum(row['falls'] for row in rows)} of {sum(row['worlds'] for row in rows)}" if rows else "-"


def _limits(parts: Sequence[dict[str, Any]], horizon: str, suffix: str) -> str:
    return " / ".join(over_seeds([part.get(horizon, {}).get(name + suffix) for part in parts], 0) for name in SIDES)


def over_seeds(values: Sequence[float | None], digits: int, unit: str = "") -> str:
    """Return an interquartile mean over seeds with its interval in brackets; a seed without a value is counted out."""
    known = [value for value in values if value is not None and math.isfinite(value)]
    found = estimate(known)
    text = number(found.value, digits) + (unit if known else "")
    if math.isfinite(found.low):
        text += f" [{number(found.low, digits)}, {number(found.high, digits)}]"
    return f"{text} ({len(known)} of {len(values)} seeds)" if 0 < len(known) < len(values) else text


def _with(suite: str, groups: Sequence[Group]) -> list[tuple[Group, list[Any]]]:
    """Return the walkers of which a suite was measured, with its results for each of their seeds."""
    found = [(group, [results[suite] for results in group if results.get(suite)]) for group in groups]
    return [(group, parts) for group, parts in found if parts]


def _who(group: Group) -> list[str]:
    """Return a walker's label, and the number of its seeds; none is known of what was not trained here."""
    number = len(group)
    return [group[0]["label"], (f"{number} seed" + "s" * (number > 1)) if group[0].get("training") else "-"]


def _by_command(parts: Sequence[list[dict[str, Any]]]) -> list[list[dict[str, Any]]]:
    """Return the rows of all seeds for each command."""
    commands = dict.fromkeys(row["command_mps"] for part in parts for row in part)
    return [[row for part in parts for row in part if row["command_mps"] == command] for command in commands]


def _is_horizon(name: str) -> bool:
    return name.endswith("s") and name[0].isdigit()


def _seconds(horizon: str) -> float:
    return float(horizon.removesuffix("s"))


def _tracking_cells(rows: Sequence[dict[str, Any]]) -> list[str]:
    command = rows[0]["command_mps"]
    errors = [100.0 * (row["mean_speed_mps"] / command - 1.0) if command else math.nan for row in rows]
    over_worlds = rows[0].get("ci95_mps") if len(rows) == 1 else None
    return [
        number(command, 2),
        over_seeds([row["mean_speed_mps"] for row in rows], 3) + (f" ± {over_worlds:.3f}" if _is_finite(over_worlds) else ""),
        over_seeds(errors, 1, " %"),
        over_seeds([row.get("rms_error_mps") for row in rows], 3),
        _falls([list(rows)]),
        over_seeds([row.get("yaw_drift_deg") for row in rows], 1),
        *(over_seeds([row.get(f"cot_{formula}") for row in rows], 3) for formula in ("mechanical", "article", "positive")),
    ]


def _push_cells(parts: Sequence[dict[str, Any]]) -> list[str]:
    shares = [(parts[0].get("shares") or {}).get(name) if len(parts) == 1 else None for name in DIRECTIONS]
    return [
        *(over_seeds([part[f"{name}_n"] for part in parts], 0) for name in SIDES),
        *(over_seeds([part.get(f"{name}_95_n") for part in parts], 0) for name in SIDES),
        *(f"{s['share']:.3f} [{s['share_low']:.3f}, {s['share_high']:.3f}]" if s else "-" for s in shares),
        " / ".join(over_seeds([part.get(f"{name}_ns") for part in parts], 1) for name in SIDES),
        " / ".join(over_seeds([part.get(f"{name}_bw") for part in parts], 2) for name in SIDES),
    ]


def _energy_table(groups: Sequence[Group]) -> Table:
    """Return where the energy goes, at the speed nearest to 0.7 m/s: three ways to split the cost of transport."""
    rows = [(group, [part["energy"] for part in parts]) for group in groups if (parts := _nearest_rows(group))]
    joints = list(dict.fromkeys(entry["joint"] for _, parts in rows for part in parts for entry in part))
    header = [*WHO, *(joint.replace("_", " ") for joint in joints), "stance", "double support", "swing", "positive", "negative"]
    cells = []
    for group, parts in rows:
        shares = [over_seeds([_share(part, joint=joint) for part in parts], 3) for joint in joints]
        shares += [over_seeds([_share(part, phase=phase) for part in parts], 3) for phase in PHASES]
        shares += [over_seeds([sum(entry[sign] for entry in part) for part in parts], 3) for sign in ("positive", "negative")]
        cells.append([*_who(group), *shares])
    return (
        "Where the energy goes: cost of transport at about 0.7 m/s",
        header,
        cells,
    )


def _nearest_rows(group: Group) -> list[dict[str, Any]]:
    """Return, of each seed, the row of the command nearest to 0.7 m/s that tells where the energy goes."""
    measured = [[row for row in results.get("tracking", ()) if row.get("energy")] for results in group]
    return [min(rows, key=lambda row: abs(row["command_mps"] - 0.7)) for rows in measured if rows]


def _share(part: Sequence[dict[str, Any]], **of: str) -> float:
    ((key, value),) = of.items()
    return math.fsum(entry["positive"] + entry["negative"] for entry in part if entry[key] == value)


def _omni_cells(parts: Sequence[dict[str, Any]]) -> list[str]:
    def fell(of: str, rows: str) -> str:
        return f"{sum(part['worst'][of] for part in parts)} of {sum(row['worlds'] for part in parts for row in part[rows])}"

    limits = [part["limits"] for part in parts]
    straight = zip(*(part["straight"] for part in parts), strict=True)
    return [
        over_seeds([part["worst"]["lin_vel_error_mps"] for part in parts], 3),
        over_seeds([part["worst"]["yaw_rate_error_radps"] for part in parts], 3),
        fell("falls", "grid"),
        fell("change_falls", "changes"),
        " / ".join(over_seeds([row["cot_mechanical"] for row in rows], 3) for rows in straight),
        over_seeds([limit["forward_mps"] for limit in limits], 1),
        over_seeds([limit["backward_mps"] for limit in limits], 1),
        over_seeds([min(limit["left_mps"], limit["right_mps"]) for limit in limits], 1),
        over_seeds([min(limit["turn_left_radps"], limit["turn_right_radps"]) for limit in limits], 1),
    ]


def _terrain_cells(parts: Sequence[dict[str, Any]]) -> list[str]:
    cells = []
    for name in parts[0]["limits"]:
        in_degrees = next(row["unit"] for row in parts[0]["levels"] if row["type"] == name) == "rad"
        sizes = [math.degrees(part["limits"][name]) if in_degrees else 100.0 * part["limits"][name] for part in parts]
        cells.append(over_seeds(sizes, 1, "°" if in_degrees else " cm") if any(sizes) else "-")
    return cells


def _transfer_cells(rows: Sequence[dict[str, Any]]) -> list[str]:
    def percent(values: Sequence[float | None]) -> str:
        return over_seeds([None if value is None else 100.0 * value for value in values], 1, " %")

    worlds, falls = (sum(row[name] for row in rows) for name in ("worlds", "falls"))
    low, high = share_interval(worlds - falls, worlds)
    return [
        number(rows[0]["width"], 2),
        f"{worlds - falls} of {worlds}",
        percent([row["success"] for row in rows]),
        f"{100.0 * low:.1f} to {100.0 * high:.1f} %",
        percent([row["speed_error"] for row in rows]),
        percent([row["speed_error_quantiles"]["0.95"] for row in rows]),
        over_seeds([row["cot"] for row in rows], 3),
    ]


def _gait_cells(parts: Sequence[dict[str, Any]]) -> list[str]:
    return [
        number(parts[0]["command_mps"], 2),
        *(over_seeds([part[k] for part in parts], 3) for k in parts[0] if k != "command_mps"),
    ]


def _learning_cells(curves: Sequence[dict[str, Any]]) -> list[str]:
    samples = [(curve["samples"][-1], curve["samples_to_95_length"], curve["samples_to_95_return"]) for curve in curves]
    return [
        over_seeds([None if value is None else value / 1e6 for value in column], 2, " M")
        for column in zip(*samples, strict=True)
    ]


def _machine_cells(group: Group) -> list[str]:
    def told(values: Sequence[Any]) -> str:
        return ", ".join(dict.fromkeys(str(value) for value in values if value)) or "-"

    trained = [results.get("training") or {} for results in group]
    return [
        *(told([training.get(key) for training in trained]) for key in ("processor", "arithmetic", "backend")),
        *(told([results.get(key) for results in group]) for key in ("machine", "engine")),
    ]


def _is_finite(value: float | None) -> bool:
    return value is not None and math.isfinite(value)


def number(value: float | None, digits: int) -> str:
    """Return a number with its digits, and a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
