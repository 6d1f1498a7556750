"""`learning.csv`: one row of numbers per iteration, beside TensorBoard's files, for people, spreadsheets and reports."""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from telebip.errors import UserError
from telebip.files import write_atomically

FILE = "learning.csv"


class CurveWriter:
    """Appends rows to a run's `learning.csv`; a resumed run drops what lies beyond its checkpoint first."""

    def __init__(self, run_dir: Path, samples: int) -> None:
        """Open the file of `run_dir`, keeping its rows up to `samples` environment steps."""
        self._path = run_dir / FILE
        rows = rows_so_far(run_dir)
        self._columns: list[str] = []
        self._write([row for row in rows if row["samples"] <= samples])

    def add(self, row: Mapping[str, float]) -> None:
        """Append one iteration's numbers; where an older version wrote other columns, they are NaN, as are its in this row."""
        if not row.keys() <= set(self._columns):
            rows = read_curve(self._path.parent)
            self._columns += [name for name in row if name not in self._columns]
            self._write(rows)
        with self._path.open("a", newline="", encoding="utf-8") as file:
            csv.writer(file).writerow(_text(row.get(name, math.nan)) for name in self._columns)

    def _write(self, rows: Sequence[Mapping[str, float]]) -> None:
        """Write the file anew."""
        self._columns = list(dict.fromkeys([*(rows[0] if rows else ()), *self._columns]))
        text = io.StringIO(newline="")
        writer = csv.writer(text)
        if self._columns:
            writer.writerow(self._columns)
        writer.writerows([_text(row.get(name, math.nan)) for name in self._columns] for row in rows)
        write_atomically(self._path, text.getvalue().encode())


def _text(value: float) -> str:
    """Return a number with six digits, or a whole one, such as `samples`, with all of them."""
    return f"{value:.0f}" if float(value).is_integer() else f"{value:.6g}"


def rows_so_far(run_dir: Path) -> list[dict[str, float]]:
    """Return the rows of a run's `learning.csv`, as `read_curve` does; none where there is no such file."""
    return read_curve(run_dir) if (run_dir / FILE).exists() else []


def read_curve(run_dir: Path) -> list[dict[str, float]]:
    """Return the rows of a run's `learning.csv`; a last one that was not finished is left out.

    Raises:
        FileNotFoundError: there is no such file.
        UserError: it cannot be read, or its lines are not all numbers under the first one's names, among them "samples".
    """
    path = run_dir / FILE
    try:
        with path.open(newline="", encoding="utf-8") as file:
            finished = [line for line in file if line.endswith("\n")]
    except FileNotFoundError:
        raise
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path} is damaged: {error}") from error
    table, rows = csv.reader(finished), []
    try:
        names = next(table, ["samples"])
        if "samples" not in names:
            raise UserError(f"{path} is damaged: its first line names no column 'samples'")
        for line in table:
            if len(line) != len(names):
                raise ValueError(f"{len(line)} numbers under {len(names)} names")
            rows.append(dict(zip(names, map(float, line), strict=True)))
    except (ValueError, csv.Error) as error:
        raise UserError(f"{path} is damaged at line {table.line_num}: {error}") from error
    return rows
