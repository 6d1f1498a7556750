"""`learning.csv`: one row of numbers per iteration, beside TensorBoard's files, for people, spreadsheets and reports."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path

from telebip.files import write_atomically

FILE = "learning.csv"


class CurveWriter:
    """Appends rows to a run's `learning.csv`; a resumed run drops what lies beyond its checkpoint first."""

    def __init__(self, run_dir: Path, samples: int) -> None:
        """Open the file of `run_dir`, keeping its rows up to `samples` environment steps."""
        self._path = run_dir / FILE
        rows = read_curve(run_dir) if self._path.exists() else []
        kept, text = [row for row in rows if row["samples"] <= samples], io.StringIO(newline="")
        if kept:
            writer = csv.DictWriter(text, list(kept[0]))
            writer.writeheader()
            writer.writerows({name: f"{value:.6g}" for name, value in row.items()} for row in kept)
        write_atomically(self._path, text.getvalue().encode())

    def add(self, row: Mapping[str, float]) -> None:
        """Append one iteration's numbers; the first row names the columns."""
        with self._path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(row))
            if file.tell() == 0:
                writer.writeheader()
            writer.writerow({name: f"{value:.6g}" for name, value in row.items()})


def read_curve(run_dir: Path) -> list[dict[str, float]]:
    """Return the rows of a run's `learning.csv`; a last one that was not finished is left out.

    Raises:
        OSError: there is no such file.
        ValueError: it holds something other than numbers.
    """
    with (run_dir / FILE).open(newline="", encoding="utf-8") as file:
        finished = [line for line in file if line.endswith("\n")]
    return [{name: float(value) for name, value in row.items()} for row in csv.DictReader(finished)]
