"""`gpu_check.py` on a CPU, at toy size: that every step runs, and that what was found outlives what was cut off."""

import json
import sys
from pathlib import Path
from typing import Any

import pytest
from processes import fresh
from test_commands_line import refusal

from telebip.tools import gpu_check
from telebip.tools.gpu_check import STEPS, run_steps, summary

GPU_CHECK = "scripts/gpu_check.py"


def results(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "results.jsonl").read_text().splitlines()]


def test_steps_leave_their_results(tmp_path: Path) -> None:
    done = fresh(GPU_CHECK, "--device", "cpu", "--minutes", "10", "--out", str(tmp_path), "--steps", "tasks", "quick")
    assert done.returncode == 0, done.stdout + done.stderr
    rows = results(tmp_path)
    ends = [row for row in rows if "ended" in row]
    assert [(row["step"], row["ended"]) for row in ends] == [("tasks", "done"), ("quick", "done")]
    assert all(0.0 < row["seconds"] < row["limit_s"] < 600.0 for row in ends)
    (trained,) = [row for row in rows if row.get("task") == "telebip_quick"]
    assert trained["end"]["samples"] == 4 * 5
    assert "telebip_quick" in done.stdout


@pytest.mark.slow
def test_every_step_runs_on_a_cpu(tmp_path: Path) -> None:
    command = [sys.executable, GPU_CHECK, "--device", "cpu", "--out", str(tmp_path), "--run"]
    assert run_steps([*STEPS], 3600.0, tmp_path, command), "\n".join(summary(tmp_path))
    rows = results(tmp_path)
    found = {step: {key for row in rows if row["step"] == step for key in row} for step in STEPS}
    assert {"versions", "make_s", "finite", "kernel_modules"} <= found["versions"]
    assert {"exit_status", "skipped"} <= found["tests"]
    assert {"walks", "tracking"} <= found["flat"]
    assert {"env_over_engine", "cuda_graph"} <= found["speed"]
    assert {"calls", "longest_us"} <= found["profile"]
    assert {"cost"} <= found["determinism"]
    verdicts = [row[key] for row in rows for key in ("same_seed_same_bits", "resumed_same_bits") if key in row]
    assert verdicts == [True, True]
    assert [row["arithmetic"] for row in rows if row["step"] == "precision" and "ended" not in row] == [
        "float32",
        "tf32",
        "bfloat16",
    ]
    assert {"ratio"} <= found["compiled"]


SLOW_STEP = """
import subprocess, sys, time
print("begun", flush=True)
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(3); open({late!r}, 'w')"])
if sys.argv[1] == "speed":
    raise SystemExit(3)
if sys.argv[1] == "quick":
    time.sleep(60)
"""


def test_a_step_that_takes_too_long_or_fails_is_ended_with_all_that_it_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = {name: (STEPS[name][0], share) for name, share in (("quick", 1.0), ("speed", 1.0), ("profile", 1.0))}
    monkeypatch.setattr(gpu_check, "STEPS", steps)
    (tmp_path / "step.py").write_text(SLOW_STEP.format(late=str(tmp_path / "late")))
    assert not run_steps([*steps], 6.0, tmp_path, [sys.executable, str(tmp_path / "step.py")])
    ends = {row["step"]: row for row in results(tmp_path)}
    assert ends["quick"]["ended"] == "cut off after 2 s"
    assert ends["speed"]["ended"] == "failed with status 3, see log.txt"
    assert ends["profile"]["ended"] == "done"
    assert ends["profile"]["limit_s"] > ends["quick"]["limit_s"]  # it gets what the others have left
    assert (tmp_path / "log.txt").read_text().count("begun") == 3
    assert not (tmp_path / "late").exists()
    assert any(line.split()[:4] == ["quick", "cut", "off", "after"] for line in summary(tmp_path))


def test_what_cannot_be_is_refused(tmp_path: Path) -> None:
    assert "no step 'speeed'; did you mean 'speed'?" in refusal(GPU_CHECK, "--steps", "speeed", "--out", str(tmp_path))
    assert "--minutes must be > 0, got 0" in refusal(GPU_CHECK, "--minutes", "0", "--out", str(tmp_path))
    (tmp_path / "file").touch()
    assert f"cannot write to '{tmp_path}/file" in refusal(GPU_CHECK, "--out", str(tmp_path / "file"))
