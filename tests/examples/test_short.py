"""The short examples do what they say."""

import json
import math
import runpy
from pathlib import Path

import pytest

from telebip import ROOT

SMALL = ["num_envs=32", "ppo.max_iterations=2", "ppo.hidden_dims=[16,16]", "ppo.num_mini_batches=1"]


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


def test_the_notebook_trains_and_walks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    notebook = json.loads((ROOT / "examples" / "walk.ipynb").read_text(encoding="utf-8"))
    names = {"__name__": "notebook"}
    monkeypatch.chdir(tmp_path)
    for cell in (cell for cell in notebook["cells"] if cell["cell_type"] == "code"):
        code = "".join(cell["source"]).replace('load_task("telebip_quick")', f'load_task("telebip_quick", {SMALL})')
        exec(code.replace("plt.show()", ""), names)
    assert (next((tmp_path / "runs" / "telebip_quick").iterdir()) / "walk.png").stat().st_size > 10_000
    assert "m/s, cost of transport" in capsys.readouterr().out
