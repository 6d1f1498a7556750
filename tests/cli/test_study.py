"""`evaluate.py` and `reproduce.py` as a user runs them."""

import io
import json
import re
import sys
from functools import partial
from pathlib import Path

import pytest
from processes import fresh
from test_commands_line import ran, refusal

from telebip import ROOT
from telebip.cli import evaluate, reproduce
from telebip.cli.console import Console
from telebip.eval.report import BEGIN, END
from telebip.rl.checkpoint import load_checkpoint

EVALUATE, REPRODUCE = "scripts/evaluate.py", "scripts/reproduce.py"
SMALL = ("--num-envs", "2", "--duration", "2", "--device", "cpu")


def test_evaluate_writes_results_and_reports(tmp_path: Path) -> None:
    policy = ("--checkpoint", "assets/policies/telebip_flat", "--suite", "tracking,gait", "--commands", "0.7")
    printed = ran(EVALUATE, *policy, *SMALL, "--out", str(tmp_path), "--label", "mine", run=fresh)
    pictures = {"cost_of_transport.svg", "energy.svg"}
    assert {file.name for file in tmp_path.iterdir()} == {"results.json", "report.md", "report.html", *pictures}
    results = json.loads((tmp_path / "results.json").read_text())
    assert (results["label"], [row["command_mps"] for row in results["tracking"]]) == ("mine", [0.7])
    assert "push" not in results
    assert "mean speed [m/s]" in printed


def test_evaluate_draws_robots_from_the_ranges_of_a_task(tmp_path: Path) -> None:
    transfer = ("--suite", "transfer", "--transfer-task", "telebip_flat", "--transfer-worlds", "2", "--transfer-points", "0")
    ran(EVALUATE, "--checkpoint", "assets/policies/telebip_efficient", *transfer, "--device", "cpu", "--out", str(tmp_path))
    results = json.loads((tmp_path / "results.json").read_text())
    assert "--transfer-task=telebip_flat" in results["source"]
    assert results["transfer"]["protocol"]["task"] == "telebip_flat"


def test_evaluate_measures_a_model_based_walker_at_the_physics_rate(tmp_path: Path) -> None:
    suite, overrides = ("--suite", "tracking", "--commands", "0.5"), ("sim.decimation=1", "control.swing_height=0.05")
    ran(EVALUATE, "--controller", "alip", *suite, *SMALL, "--out", str(tmp_path), *overrides)
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["source"] == (
        "evaluate.py --controller alip sim.decimation=1 control.swing_height=0.05 "
        "--suite=tracking --num-envs=2 --duration=2.0 --commands=0.5"
    )
    assert results["tracking"][0]["falls"] == 0


@pytest.mark.parametrize(
    ("label", "folder"),
    [("flat", "flat"), ("RL, slow", "RL, slow"), ("../../out", "out"), ("/etc", "etc"), ("..", "unnamed"), ("/", "unnamed")],
)
def test_a_report_without_a_folder_stays_in_reports(label: str, folder: str) -> None:
    assert evaluate.default_folder(label) == Path("reports", folder)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([EVALUATE], "--checkpoint"),
        ([EVALUATE, "--checkpoint", "nowhere"], "checkpoint 'nowhere' does not exist"),
        ([EVALUATE, "--checkpoint", "assets/policies/telebip_flat", "--suite", "pusj"], "did you mean 'push'?"),
        ([EVALUATE, "--controller", "dcm", "--commands", "0.5;0.7"], "invalid speeds value: '0.5;0.7'"),
        ([EVALUATE, "--controller", "dcm", "--commands", "0.5,inf"], "invalid speeds value: '0.5,inf'"),
        ([EVALUATE, "--checkpoint", "assets/policies/telebip_flat", "--num-envs", "0"], "--num-envs must be between 1"),
        ([EVALUATE, "--checkpoint", "assets/policies/telebip_flat", "--out", "/proc/x"], "cannot write to folder '/proc/x'"),
        ([EVALUATE, "--controller", "dcm", "num_envs=99"], "'num_envs=99' cannot be overridden here; use --num-envs"),
        ([EVALUATE, "--controller", "dcm", "episode.length=1"], "use --duration"),
        ([EVALUATE, "--controller", "dcm", "events.push.force=20"], "the push suite has its own pushes"),
        ([EVALUATE, "--controller", "dcm", "events.start_pose.heading=3"], "robots that face x"),
        ([EVALUATE, "--controller", "dcm", "--transfer-task", "telebip_reel"], "did you mean 'telebip_real'?"),
        ([REPRODUCE, "--only", "telebip_flta"], "did you mean 'telebip_flat'?"),
        ([REPRODUCE, "--seeds", "0"], "--seeds must be 1 or more, got 0"),
        ([REPRODUCE, "--jobs", "0"], "--jobs must be 1 or more, got 0"),
        ([REPRODUCE, "--shipped", "--seeds", "2"], "the one policy that there is of each; leave out --seeds"),
        ([REPRODUCE, "--shipped", "--ship"], "leave out --ship"),
    ],
    ids=lambda value: " ".join(value[1:]) if isinstance(value, list) else "",
)
def test_a_mistake_is_one_line(arguments: list[str], named: str) -> None:
    assert named in refusal(*arguments)


def test_the_options_that_differ_from_the_defaults_measure_it_again() -> None:
    assert evaluate._parse(["--controller", "dcm"]).given == []
    options = evaluate._parse(["--controller", "dcm", "--commands=-0.3,0.5", "--max-force", "150", "--device", "cpu"])
    assert options.given == ["--commands=-0.3,0.5", "--max-force=150.0"]
    again = evaluate._parse(["--controller", "dcm", *options.given])
    assert (again.commands, again.max_force) == ((-0.3, 0.5), 150.0)
    assert evaluate._parse(["--controller", "dcm", "--transfer-task", "mine.yaml"]).given == ["--transfer-task=mine.yaml"]


def test_a_command_with_spaces_and_brackets_can_be_pasted() -> None:
    candidate = evaluate.controller_candidate("dcm", None, ["commands.lin_vel_x=[0.2, 0.4]"])
    assert candidate.source == "evaluate.py --controller dcm 'commands.lin_vel_x=[0.2, 0.4]'"


def test_signs_that_the_terminal_lacks_stop_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    stdout = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", stdout)
    Console().print("0.676 ± 0.012 m/s in [v2] of runs[/v2]")
    stdout.flush()
    assert stdout.buffer.getvalue() == b"0.676 ? 0.012 m/s in [v2] of runs[/v2]\n"


def test_the_study_at_toy_size_goes_on_where_it_stopped(tmp_path: Path) -> None:
    page, out, runs = tmp_path / "out.md", tmp_path / "out", tmp_path / "runs"
    page.write_text(f"Before.\n{BEGIN}\nold\n{END}\nAfter.\n")
    where = ("--quick", "--device", "cpu", "--out", str(out), "--runs", str(runs))
    only = ("--only", "period_06", "dcm", "--seeds", "2", "--ship")
    ran(REPRODUCE, *where, *only, run=partial(fresh, timeout=600.0))  # which imports torch three times over
    assert {path.name for path in runs.glob("seed*/*")} == {"period_06", "period_06.log"}
    report = (out / "report.md").read_text()
    for label in ("| RL, period 0.6 s | 2 seeds |", "| DCM | - |", "| article: RL | - |"):
        assert label in report
    first, second = (json.loads((out / "period_06" / seed / "results.json").read_text()) for seed in ("seed1", "seed2"))
    assert first["fingerprint"] != second["fingerprint"]
    assert first["training"]["task"] == second["training"]["task"]
    assert [results["training"]["seed"] for results in (first, second)] == [1, 2]
    text = page.read_text()
    assert text.startswith("Before.\n") and text.endswith("After.\n") and "old" not in text
    assert "| RL, period 0.6 s | 2 seeds |" in text
    shipped = runs / "shipped" / "period_06"
    command = json.loads((shipped / "run.json").read_text())["starts"][0]["command"]
    assert command[:3] == ["scripts/train.py", "--task", "period_06"]
    assert load_checkpoint(shipped).config.seed == int(command[-1])
    written = (out / "dcm" / "results.json").stat().st_mtime_ns
    again = ran(REPRODUCE, *where, *only)
    assert again.count("training, log in") == 0
    assert again.count("measured already") == 3
    assert (out / "dcm" / "results.json").stat().st_mtime_ns == written


@pytest.mark.slow
def test_results_that_lack_something_are_measured_again_or_named(tmp_path: Path) -> None:
    where = ("--quick", "--device", "cpu", "--out", str(tmp_path), "--runs", str(tmp_path / "runs"), "--only", "dcm")
    older = {"schema": "telebip-results-2", "label": "older", "push": None, "tracking": [{"command_mps": 0.5}]}
    files = {name: tmp_path / name / "results.json" for name in ("dcm", "period_06/seed1")}
    for file in files.values():
        file.parent.mkdir(parents=True)
        file.write_text(json.dumps(older))
    assert f"results '{files['period_06/seed1']}' lack some" in refusal(REPRODUCE, *where)
    assert json.loads(files["dcm"].read_text())["label"] == "DCM"
    files["period_06/seed1"].unlink()
    assert "dcm: measured already" in ran(REPRODUCE, *where)
    files["dcm"].write_text("{")
    assert "dcm: measured\n" in ran(REPRODUCE, *where)


def text_apart_from_intervals(page: Path) -> str:
    return re.sub(r" \[-?[\d.]+, -?[\d.]+\]", "", page.read_text())


def test_readme_and_results_show_what_was_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    walkers, pages = reproduce._walkers(ROOT / "docs" / "results", is_shipped=False), ("README.md", "docs/results.md")
    (tmp_path / "docs").mkdir()
    for page in pages:
        before, _, rest = (ROOT / page).read_text().partition(BEGIN)
        (tmp_path / page).write_text(f"{before}{BEGIN}\nold\n{END}{rest.partition(END)[2]}")
    monkeypatch.setattr(reproduce, "ROOT", tmp_path)
    monkeypatch.chdir(tmp_path)
    quick, elsewhere, real = (["--quick", "--out", "docs/results"], ["--out", "elsewhere"], [])
    written = [reproduce._write_pages(walkers, reproduce._parse(options)) for options in (quick, elsewhere, real)]
    assert written == [[Path("docs/results.md")], [], [Path("docs/results.md"), tmp_path / "README.md"]]
    for page in pages:
        assert text_apart_from_intervals(tmp_path / page) == text_apart_from_intervals(ROOT / page)
    (tmp_path / "README.md").unlink()  # as in an installed package
    assert reproduce._write_pages(walkers, reproduce._parse([])) == [Path("docs/results.md")]


def test_the_toy_study_keeps_apart_from_the_real_one() -> None:
    toy, real = reproduce._parse(["--quick"]), reproduce._parse([])
    assert (real.out, real.runs) == ("docs/results", "runs/study")
    assert (toy.out, toy.runs) == ("runs/study_quick/results", "runs/study_quick")
