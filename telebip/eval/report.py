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
from telebip.eval.suites import SCHEMA

Results = dict[str, Any]
Table = tuple[str, list[str], list[list[str]]]  # title, header and rows


def write_report(
    all_results: Sequence[Results], out: Path, title: str, text: str = "", references: Sequence[Results] = ()
) -> None:
    """Write `report.md`, its pictures, and `report.html`, complete in one file, about walkers to the folder `out`.

    Args:
        all_results: as `telebip.eval.suites.evaluate` returns them.
        out: an existing folder.
        title: of the report.
        text: paragraphs under the title, separated by blank lines.
        references: results to compare with, such as the article's; they stand in the same tables and plots.
    """
    tables = [table for table in _tables([*all_results, *references]) if table[2]]
    markdown = [f"# {title}", *([text] if text else [])]
    page = [f"<h1>{html.escape(title)}</h1>", *(f"<p>{html.escape(p)}</p>" for p in text.split("\n\n") if p)]
    page += [_contents([heading for heading, _, _ in tables])]
    page += [_section(heading, _html(header, rows)) for heading, header, rows in tables]
    page += ["<h2 id='plots'>Comparison in plots</h2>"]
    for name, figure in _comparisons(all_results, references):
        picture = plots.svg(figure)
        write(out / f"{name}.svg", picture)
        markdown.append(f"![{name.replace('_', ' ')}]({name}.svg)")
        page.append(f"<figure>{picture}</figure>")
    markdown += [f"## {heading}\n\n{_markdown(header, rows)}" for heading, header, rows in tables]
    page += ["<h2 id='walkers'>Each walker alone</h2>"]
    for results in all_results:
        figures = "".join(f"<figure>{plots.svg(figure)}</figure>" for figure in _figures_of_each([results]))
        page += [f"<details><summary>{html.escape(str(results['label']))}</summary>{figures}</details>"] if figures else []
    write(out / "report.md", "\n\n".join(markdown) + "\n")
    write(out / "report.html", _PAGE.format(title=html.escape(title), body="\n".join(page)))


def summary(results: Results, width: int) -> str:
    """Return the tables of one walker for a terminal of `width` columns: a line for each number, a column for each row."""
    tables = [table for table in _tables([results]) if table[2]]
    return "\n\n".join([str(results["label"]), *(_upright(*table, width) for table in tables)])


def _upright(heading: str, header: list[str], rows: list[list[str]], width: int) -> str:
    """Return a table turned on its side, without the walker's name; as many columns beside each other as there is room for."""
    names = [f"  {name}" for name in header[1:]]
    left, column = max(map(len, names)), 1 + max(len(cell) for row in rows for cell in row[1:])
    at_once = max(1, (width - left) // column)
    parts = [rows[i : i + at_once] for i in range(0, len(rows), at_once)]
    lines = [
        "\n".join(name.ljust(left) + "".join(row[i].rjust(column) for row in part) for i, name in enumerate(names, start=1))
        for part in parts
    ]
    return "\n".join([heading, "\n\n".join(lines)])


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
        _tables([results])
        list(_comparisons([results], []))
        list(_figures_of_each([results]))
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


def _comparisons(all_results: Sequence[Results], references: Sequence[Results]) -> Iterator[tuple[str, Figure]]:
    """Draw all walkers together; yield each picture with the name of its file."""
    together = [*all_results, *references]
    if any("tracking" in results for results in all_results):
        yield "cost_of_transport", plots.cost_of_transport(together)
    for horizon in ("10s", "20s"):
        if any(horizon in (results.get("push") or {}) for results in all_results):
            yield f"push_{horizon}", plots.push(together, horizon)
    if any(results.get("learning") for results in all_results):
        yield "learning", plots.learning(all_results)
    for suite, draw in (("omni", plots.omni), ("terrain", plots.terrain), ("transfer", plots.transfer)):
        measured = [results for results in all_results if results.get(suite)]
        if suite == "transfer":
            measured = [results for results in measured if results[suite]["factors"]]
        for i, results in enumerate(measured, 1):
            yield f"{suite}_{i}" if len(measured) > 1 else suite, draw(results)


def _figures_of_each(all_results: Sequence[Results]) -> Iterator[Figure]:
    """Draw each walker alone."""
    for results in all_results:
        if "series" in results:
            yield plots.speed(results)
            yield plots.feet(results)
        if "tracking" in results:
            yield plots.joints(results)


def _tables(all_results: Sequence[Results]) -> list[Table]:
    def of(suite: str) -> list[tuple[str, Any]]:
        return [(results["label"], results[suite]) for results in all_results if results.get(suite)]

    tracking = ["walker", "command [m/s]", "mean speed [m/s]", "error", "RMS error [m/s]", "falls", "yaw drift [deg]"]
    tracking += ["COT mechanical", "COT article", "COT positive"]
    push = ["walker", "forward [N]", "backward [N]", "lateral [N]", "as impulse [N s]", "of body weight"]
    gait = ["walker", "command [m/s]", "period [s]", "regularity", "symmetry", "duty factor", "double support", "flight"]
    gait += ["peak force [body weights]", "stride [m]", "knee stroke [m]"]
    learning = ["walker", "samples", "to 95 % of the final episode length", "to 95 % of the final return"]
    omni = ["walker", "largest error [m/s]", "[rad/s]", "falls", "falls after changes", "COT straight ahead"]
    omni += ["forward [m/s]", "backward [m/s]", "sideways [m/s]", "turning [rad/s]"]
    transfer = [
        "width of the ranges",
        "without a fall",
        "95 % interval",
        "speed error, median",
        "95 % of worlds",
        "COT, median",
    ]
    rough = of("terrain")
    kinds = [name.replace("_", " ") for name in rough[0][1]["limits"]] if rough else []
    horizons = sorted({h for _, limits in of("push") for h in limits if h.endswith("s") and h[0].isdigit()}, key=_seconds)
    return [
        ("Tracking and cost of transport", tracking, [[k, *_tracking_cells(r)] for k, rows in of("tracking") for r in rows]),
        *(
            (
                f"Largest push survived, {horizon.removesuffix('s')} s of walking",
                push,
                [[label, *_push_cells(limits[horizon])] for label, limits in of("push") if horizon in limits],
            )
            for horizon in horizons
        ),
        ("All directions", omni, [[label, *_omni_cells(part)] for label, part in of("omni")]),
        (
            "Hardest terrain passed",
            ["walker", *kinds],
            [[label, *_terrain_cells(part)] for label, part in rough],
        ),
        (
            "Transfer: worlds of drawn robots",
            ["walker", *transfer],
            [[label, *_transfer_cells(row)] for label, part in of("transfer") for row in part["worlds"]],
        ),
        ("Gait", gait, [[label, *(number(value, 3) for value in row.values())] for label, row in of("gait")]),
        ("Learning", learning, [[label, *_learning_cells(curve)] for label, curve in of("learning")]),
    ]


def _seconds(horizon: str) -> float:
    return float(horizon.removesuffix("s"))


def _tracking_cells(row: dict[str, Any]) -> list[str]:
    interval = f" ± {row['ci95_mps']:.3f}" if math.isfinite(row.get("ci95_mps") or math.nan) else ""
    return [
        number(row["command_mps"], 2),
        number(row["mean_speed_mps"], 3) + interval,
        f"{100.0 * (row['mean_speed_mps'] / row['command_mps'] - 1.0):+.1f} %" if row["command_mps"] else "-",
        number(row.get("rms_error_mps"), 3),
        f"{row['falls']} of {row['worlds']}" if "falls" in row else "-",
        number(row.get("yaw_drift_deg"), 1),
        *(number(row.get(f"cot_{formula}"), 3) for formula in ("mechanical", "article", "positive")),
    ]


def _push_cells(limits: dict[str, float]) -> list[str]:
    names = ("forward", "backward", "lateral")
    return [
        *(number(limits[f"{name}_n"], 0) for name in names),
        " / ".join(number(limits.get(f"{name}_ns"), 1) for name in names),
        " / ".join(number(limits.get(f"{name}_bw"), 2) for name in names),
    ]


def _omni_cells(part: dict[str, Any]) -> list[str]:
    worst, limits = part["worst"], part["limits"]
    return [
        number(worst["lin_vel_error_mps"], 3),
        number(worst["yaw_rate_error_radps"], 3),
        f"{worst['falls']} of {sum(row['worlds'] for row in part['grid'])}",
        f"{worst['change_falls']} of {sum(row['worlds'] for row in part['changes'])}",
        " / ".join(number(row["cot_mechanical"], 3) for row in part["straight"]),
        number(limits["forward_mps"], 1),
        number(limits["backward_mps"], 1),
        number(min(limits["left_mps"], limits["right_mps"]), 1),
        number(min(limits["turn_left_radps"], limits["turn_right_radps"]), 1),
    ]


def _terrain_cells(part: dict[str, Any]) -> list[str]:
    units = {row["type"]: row["unit"] for row in part["levels"]}
    return [plots.obstacle({"size": size, "unit": units[name]}) if size else "-" for name, size in part["limits"].items()]


def _transfer_cells(row: dict[str, Any]) -> list[str]:
    def percent(value: float | None) -> str:
        return number(100.0 * value, 1) + " %" if value is not None and math.isfinite(value) else "-"

    return [
        number(row["width"], 2),
        f"{row['worlds'] - row['falls']} of {row['worlds']}",
        f"{percent(row['success_low'])} to {percent(row['success_high'])}",
        percent(row["speed_error"]),
        percent(row["speed_error_quantiles"]["0.95"]),
        number(row["cot"], 3),
    ]


def _learning_cells(curve: dict[str, Any]) -> list[str]:
    samples = (curve["samples"][-1], curve["samples_to_95_length"], curve["samples_to_95_return"])
    return ["-" if value is None else f"{value / 1e6:.1f} M" for value in samples]


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
