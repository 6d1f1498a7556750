"""What `play.py` and `evaluate.py` show on a terminal: every line is whole, however narrow it is."""

import io
import json

import pytest
from rich.console import Console

from telebip import ROOT
from telebip.cli import play
from telebip.cli.evaluate import progress_bar
from telebip.eval.report import summary

RESULTS = json.loads((ROOT / "docs" / "results" / "telebip_efficient" / "seed1" / "results.json").read_text(encoding="utf-8"))
WIDTHS = (60, 80, 120, 200)


@pytest.mark.parametrize("width", WIDTHS)
def test_the_progress_of_a_measurement_is_whole(width: int) -> None:
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=width, highlight=False, color_system=None)
    with progress_bar(console) as show:
        show("walking in 2800 of 4600 worlds", 3, 10)
    assert "walking in 2800 of 4600 worlds eta " in screen.getvalue()
    assert "…" not in screen.getvalue()


def test_a_pipe_gets_a_line_as_a_measurement_begins() -> None:
    console = Console(file=io.StringIO(), force_terminal=False)
    with progress_bar(console, announce=True) as show:
        show("walking", 1, 2)
        show("walking", 2, 2)
    assert console.file.getvalue() == "walking ...\n"  # type: ignore[attr-defined]


@pytest.mark.parametrize("width", WIDTHS)
def test_the_summary_of_a_measurement_fits_the_terminal(width: int) -> None:
    lines = summary(RESULTS, width).splitlines()
    assert max(map(len, lines)) <= width
    (speeds, *_) = [line.split()[3:] for line in lines if line.startswith("  mean speed [m/s]")]
    assert speeds[:3] == [f"{RESULTS['tracking'][0]['mean_speed_mps']:.3f}", "±", f"{RESULTS['tracking'][0]['ci95_mps']:.3f}"]
    (regularity,) = [line.split()[1:] for line in lines if line.startswith("  regularity")]
    assert regularity == [f"{RESULTS['gait']['regularity']:.3f}"]


def test_what_play_measures_fits_60_columns(capsys: pytest.CaptureFixture[str]) -> None:
    policy = str(ROOT / "assets" / "policies" / "telebip_efficient")
    play.main(["--checkpoint", policy, "--duration", "1", "--device", "cpu", "--num-envs", "2"])
    _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[1].strip() for line in lines[:4]] == ["task", "command", "mean speed", "spread"]
    assert max(map(len, lines)) <= 60
