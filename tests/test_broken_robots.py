"""Robots broken at random get one line, or train: never a traceback, a hang or a crash of the process."""

import subprocess
import sys
from pathlib import Path

import pytest

BATCH, SECONDS = 25, 30.0  # mutants of one process; a mutant that takes longer counts as one that hangs
SCRIPT = Path(__file__).with_name("broken_robots.py")


def broken(kind: str, folder: Path, first: int, last: int) -> list[str]:
    """Try mutants in a process of their own, and return what went wrong; after a crash or a hang, go on behind it."""
    wrong = []
    while first < last:
        folder.mkdir(exist_ok=True, parents=True)
        command = [sys.executable, str(SCRIPT), kind, str(folder), str(first), str(last)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=60.0 + SECONDS * (last - first))
            output, end = done.stdout, f"exit status {done.returncode}: {done.stderr[-500:]}"
        except subprocess.TimeoutExpired as late:
            output, end = (late.stdout or b"").decode() if isinstance(late.stdout, bytes) else late.stdout or "", "it hangs"
        lines = output.splitlines()
        wrong += [line for line in lines if " BROKEN: " in line]
        tried = [int(line.split()[0]) for line in lines if line.endswith(" tried")]
        finished = {int(line.split()[0]) for line in lines if not line.endswith(" tried")}
        if tried and tried[-1] not in finished:
            wrong.append(f"{tried[-1]}: {end}")
        elif not tried:
            wrong.append(f"{first}: {end}")
        first = max([first, *tried]) + 1
    return wrong


@pytest.mark.parametrize(("kind", "batch"), [*(("mjcf", i) for i in range(3)), ("urdf", 0)])
def test_a_hundred_broken_robots(kind: str, batch: int, tmp_path: Path) -> None:
    assert broken(kind, tmp_path, batch * BATCH, (batch + 1) * BATCH) == []


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "number"), [("mjcf", 1500), ("urdf", 500)])
def test_two_thousand_broken_robots(kind: str, number: int, tmp_path: Path) -> None:
    wrong = [line for first in range(0, number, BATCH) for line in broken(kind, tmp_path, first, first + BATCH)]
    assert wrong == []
