"""Results as files: `results.json` for programs, `report.md` for reading, `report.html` with plots, complete in one file."""

import html
import json
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from telebip.errors import UserError
from telebip.eval import plots
from telebip.eval.energy import PHASES
from telebip.eval.push import DIRECTIONS
from telebip.eval.statistics import estimate, share_interval
from telebip.eval.study import median_seed
from telebip.eval.suites import SCHEMA

Results = dict[str, Any]
Group = Sequence[Results]  # of a walker's seeds
Table = tuple[str, list[str], list[list[str]]]  # title, header and rows

WHO = ("walker", "seeds")
BEGIN = "<!-- written by scripts/reproduce.py from here -->"
END = "<!-- to here -->"


def write_report(groups: Sequence[Group], out: Path, title: str, text: str = "", references: Sequence[Results] = ()) -> None:
    """Write `report.md`, its pictures, and `report.html`, complete in one file, about walkers to the folder `out`.

    Args:
        groups: for each walker the results of its seeds, as `telebip.eval.suites.evaluate` returns them.
        out: an existing folder.
        title: of the report.
        text: paragraphs under the title, separated by blank lines.
        references: results to compare with, such as the article's; they stand in the same tables and plots.
    """
    every = [*groups, *([results] for results in references)]
    tables = [table for table in _tables(every) if table[2]]
    markdown = [f"# {title}", *([text] if text else [])]
    page = [f"<h1>{html.escape(title)}</h1>", *(f"<p>{html.escape(p)}</p>" for p in text.split("\n\n") if p)]
    page += [_contents([heading for heading, _, _ in tables])]
    page += [_section(heading, _html(header, rows)) for heading, header, rows in tables]
    page += ["<h2 id='plots'>Comparison in plots</h2>"]
    for name, figure in _comparisons(groups, references):
        picture = plots.svg(figure)
        write(out / f"{name}.svg", picture)
        markdown.append(f"![{name.replace('_', ' ')}]({name}.svg)")
        page.append(f"<figure>{picture}</figure>")
    markdown += [f"## {heading}\n\n{_markdown(header, rows)}" for heading, header, rows in tables]
    page += ["<h2 id='walkers'>Each walker alone</h2>"]
    for group in groups:
        results = group[_shown(group)]
        figures = "".join(f"<figure>{plots.svg(figure)}</figure>" for figure in _figures_of_each(results))
        of_several = f", seed {results['training']['seed']}" if len(group) > 1 else ""
        summary = html.escape(f"{results['label']}{of_several}")
        page += [f"<details><summary>{summary}</summary>{figures}</details>"] if figures else []
    write(out / "report.md", "\n\n".join(markdown) + "\n")
    write(out / "report.html", _PAGE.format(title=html.escape(title), body="\n".join(page)))


def summary(results: Results, width: int) -> str:
    """Return the tables of one walker for a terminal of `width` columns: a line for each number, a column for each row."""
    tables = [table for table in _tables([[results]]) if table[2] and table[1][: len(WHO)] == [*WHO]]
    return "\n\n".join([str(results["label"]), *(_upright(*table, width) for table in tables)])


def _upright(heading: str, header: list[str], rows: list[list[str]], width: int) -> str:
    """Return a table turned on its side, without who walks; as many columns beside each other as there is room for."""
    names = [f"  {name}" for name in header[len(WHO) :]]
    rows = [row[len(WHO) :] for row in rows]
    left, column = max(map(len, names)), 1 + max(len(cell) for row in rows for cell in row)
    at_once = max(1, (width - left) // column)
    parts = [rows[i : i + at_once] for i in range(0, len(rows), at_once)]
    lines = [
        "\n".join(name.ljust(left) + "".join(row[i].rjust(column) for row in part) for i, name in enumerate(names))
        for part in parts
    ]
    return "\n".join([heading, "\n\n".join(lines)])


def write_tables(page: Path, groups: Sequence[Group], references: Sequence[Results] = ()) -> None:
    """Replace what stands between the markers of a Markdown page by the summary of `groups`.

    Raises:
        UserError: the page cannot be read or written, or lacks the markers.
    """
    try:
        text = page.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot read '{page}': {error.strerror or error}") from error
    before, begin, rest = text.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise UserError(f"'{page}' lacks the lines '{BEGIN}' and '{END}', between which the tables are written")
    every = [*groups, *([results] for results in references)]
    tables = [f"## {heading}\n\n{_markdown(header, rows)}" for heading, header, rows in _summary(every) if rows]
    write(page, "\n\n".join([before + begin, *tables, end + after]))


def _shown(group: Group) -> int:
    """Return which of a walker's seeds is drawn alone: the one that would be shipped."""
    if len(group) > 1 and all("tracking" in results for results in group):
        return median_seed(dict(enumerate(group)))
    return 0


def write_results(results: Results, out: Path) -> None:
    """Write `results.json`; numbers that are not finite become null, which JSON can hold."""
    write(out / "results.json", json.dumps(_finite(results), indent=1) + "\n")


def read_results(path: Path) -> Results:
    """Read a `results.json`.

    Raises:
        UserError: it is missing or damaged.
    """
    try:
        results = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"results '{path}' cannot be read: {error}") from error
    if not isinstance(results, dict) or results.get("schema") != SCHEMA:
        raise UserError(f"'{path}' holds no results of this version of telebip")
    return results


def can_be_shown(results: Results) -> bool:
    """Whether results hold all that tables and pictures show of them, which older and damaged ones may not."""
    try:
        _tables([[results]])
        _summary([[results]])
        list(_comparisons([[results]], []))
        list(_figures_of_each(results))
    except (AttributeError, IndexError, KeyError, TypeError, ValueError):
        return False
    return True


def make_folder(out: Path) -> None:
    """Create the folder `out` and make sure, before the long work, that it can be written to.

    Raises:
        UserError: it cannot.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / ".probe").touch()
        (out / ".probe").unlink()
    except OSError as error:
        raise UserError(f"cannot write to folder '{out}': {error.strerror or error}") from error


def write(path: Path, text: str) -> None:
    """Write a text file.

    Raises:
        UserError: it cannot be written.
    """
    try:
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write '{path}': {error.strerror or error}") from error


def _comparisons(groups: Sequence[Group], references: Sequence[Results]) -> Iterator[tuple[str, Figure]]:
    """Draw all walkers together; yield each picture with the name of its file."""
    together = [*groups, *([results] for results in references)]
    if any("tracking" in results for group in groups for results in group):
        yield "cost_of_transport", plots.cost_of_transport(together)
        yield "energy", plots.energy([group[_shown(group)] for group in groups])
    for horizon in ("10s", "20s"):
        if any(horizon in (results.get("push") or {}) for group in groups for results in group):
            yield f"push_{horizon}", plots.push(together, horizon)
    if any(results.get("learning") for group in groups for results in group):
        yield "learning", plots.learning(groups)
    shown = [group[_shown(group)] for group in groups]
    for suite, draw in (("omni", plots.omni), ("terrain", plots.terrain), ("transfer", plots.transfer)):
        measured = [results for results in shown if results.get(suite)]
        if suite == "transfer":
            measured = [results for results in measured if results[suite]["factors"]]
        for i, results in enumerate(measured, 1):
            yield f"{suite}_{i}" if len(measured) > 1 else suite, draw(results)


def _figures_of_each(results: Results) -> Iterator[Figure]:
    """Draw a walker alone."""
    if "series" in results:
        yield plots.speed(results)
        yield plots.feet(results)
    if "tracking" in results:
        yield plots.joints(results)
        yield plots.energy_by_speed(results)


def _tables(groups: Sequence[Group]) -> list[Table]:
    """Return the report's tables; one without rows has nothing to say."""
    directions = ("forward", "backward", "lateral")
    tracking = [*WHO, "command [m/s]", "mean speed [m/s]", "error", "RMS error [m/s]", "falls", "yaw drift [deg]"]
    tracking += ["COT mechanical", "COT article", "COT positive"]
    push = [*WHO, *(f"all: {name} [N]" for name in directions), *(f"95 %: {name} [N]" for name in directions)]
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


def _summary(groups: Sequence[Group]) -> list[Table]:
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
    names = ("forward", "backward", "lateral")
    return " / ".join(over_seeds([part.get(horizon, {}).get(name + suffix) for part in parts], 0) for name in names)


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
    names = ("forward", "backward", "lateral")
    shares = [(parts[0].get("shares") or {}).get(name) if len(parts) == 1 else None for name in DIRECTIONS]
    return [
        *(over_seeds([part[f"{name}_n"] for part in parts], 0) for name in names),
        *(over_seeds([part.get(f"{name}_95_n") for part in parts], 0) for name in names),
        *(f"{s['share']:.3f} [{s['share_low']:.3f}, {s['share_high']:.3f}]" if s else "-" for s in shares),
        " / ".join(over_seeds([part.get(f"{name}_ns") for part in parts], 1) for name in names),
        " / ".join(over_seeds([part.get(f"{name}_bw") for part in parts], 2) for name in names),
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
        "Where the energy goes: shares of the cost at about 0.7 m/s",
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


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *rows])


def _html(header: list[str], rows: list[list[str]]) -> str:
    def line(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table><thead>{line(header, 'th')}</thead><tbody>{''.join(line(row, 'td') for row in rows)}</tbody></table>"


def _section(heading: str, content: str) -> str:
    return f"<h2 id='{_anchor(heading)}'>{html.escape(heading)}</h2>{content}"


def _contents(headings: Sequence[str]) -> str:
    """Return the table of contents."""
    entries = [*((_anchor(heading), heading) for heading in headings), ("plots", "Plots"), ("walkers", "Each walker")]
    links = [f"<a href='#{anchor}'>{html.escape(text)}</a>" for anchor, text in entries]
    return f"<nav>{' · '.join(links)}</nav>"


def _anchor(heading: str) -> str:
    return re.sub(r"\W+", "-", heading.lower())


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{title}</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font: 15px/1.5 system-ui, sans-serif; color: #22262c; max-width: 68rem; margin: 2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.7rem; }} h2 {{ font-size: 1.15rem; margin-top: 2rem; }}
figure {{ margin: 1.2rem 0; }} figure svg {{ max-width: 100%; height: auto; }}
table {{ border-collapse: collapse; font-size: 0.86rem; display: block; overflow-x: auto; }}
th, td {{ padding: 0.25rem 0.7rem; text-align: right; border-bottom: 1px solid #e4e6ea; white-space: nowrap; }}
nav {{ padding: 0.6rem 0; border-block: 1px solid #e4e6ea; }}
nav a {{ color: #2a5da8; text-decoration: none; white-space: nowrap; }}
summary {{ cursor: pointer; padding: 0.4rem 0; font-weight: 600; }}
th:first-child, td:first-child {{ text-align: left; }} th {{ border-bottom: 2px solid #8b9099; white-space: normal; }}
@media (max-width: 40rem) {{ body {{ margin: 0.5rem auto; }} th, td {{ padding: 0.25rem 0.4rem; }} }}
@media print {{
  nav {{ display: none; }} table {{ display: table; overflow: visible; font-size: 0.6rem; }} td {{ white-space: normal; }}
  figure, tr, h2 {{ break-inside: avoid; }} h2 {{ break-after: avoid; }}
}}
</style></head><body>
{body}
</body></html>
"""
