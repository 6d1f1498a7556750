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
from telebip.eval.study import median_seed
from telebip.eval.suites import SCHEMA
from telebip.eval.tables import WHO, Group, Results, Table, overview, tables

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
    filled = [table for table in tables(every) if table[2]]
    markdown = [f"# {title}", *([text] if text else [])]
    page = [f"<h1>{html.escape(title)}</h1>", *(f"<p>{_code(html.escape(p))}</p>" for p in text.split("\n\n") if p)]
    page += [_contents([heading for heading, _, _ in filled])]
    page += [_section(heading, _html(header, rows)) for heading, header, rows in filled]
    page += ["<h2 id='plots'>Comparison in plots</h2>"]
    for name, figure in _comparisons(groups, references):
        picture = plots.svg(figure)
        write(out / f"{name}.svg", picture)
        markdown.append(f"![{name.replace('_', ' ')}]({name}.svg)")
        page.append(f"<figure>{picture}</figure>")
    markdown += [f"## {heading}\n\n{_markdown(header, rows)}" for heading, header, rows in filled]
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
    filled = [table for table in tables([[results]]) if table[2] and table[1][: len(WHO)] == [*WHO]]
    return "\n\n".join([str(results["label"]), *(_upright(*table, width) for table in filled)])


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


def write_tables(page: Path, tables: Sequence[Table]) -> None:
    """Replace what stands between the markers of a Markdown page by tables; one without a title has no heading.

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
    filled = [table for table in tables if table[2]]
    parts = [(f"## {heading}\n\n" if heading else "") + _markdown(header, rows) for heading, header, rows in filled]
    write(page, "\n\n".join([before + begin, *parts, end + after]))


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
        tables([[results]])
        overview([[results]])
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


def _markdown(header: list[str], rows: list[list[str]]) -> str:
    return "\n".join("| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *rows])


def _html(header: list[str], rows: list[list[str]]) -> str:
    def line(cells: list[str], tag: str) -> str:
        return "<tr>" + "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells) + "</tr>"

    return f"<table><thead>{line(header, 'th')}</thead><tbody>{''.join(line(row, 'td') for row in rows)}</tbody></table>"


def _code(text: str) -> str:
    """Return text with what stands between backticks as code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", text)


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
