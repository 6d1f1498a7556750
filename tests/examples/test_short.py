"""The short examples do what they say."""

import math
import runpy

import pytest

from telebip import ROOT


def printed(example: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """Run an example and return the lines that it prints."""
    runpy.run_path(str(ROOT / "examples" / example), run_name="__main__")
    return capsys.readouterr().out.splitlines()


def test_a_policy_walks(capsys: pytest.CaptureFixture[str]) -> None:
    (line,) = printed("walk_a_policy.py", capsys)
    speed, falls = float(line.split()[0]), int(line.split()[2])
    assert speed == pytest.approx(0.7, abs=0.1)  # m/s, the command
    assert falls <= 6  # of 64 worlds that are pushed


def test_a_changed_task_trains(capsys: pytest.CaptureFixture[str]) -> None:
    lines = printed("change_a_task.py", capsys)
    assert [line.split(":")[0] for line in lines] == ["iteration 1", "iteration 2", "iteration 3"]
    assert math.isfinite(float(lines[-1].split()[-1]))
