"""`train.py --check`: a table of what a second of standing tells of a robot."""

import pytest

from telebip import ROOT
from telebip.cli import train
from telebip.errors import UserError

MJCF = (ROOT / "assets" / "telebip.xml").read_text(encoding="utf-8")


def test_a_fit_robot_has_a_table_without_doubts(capsys: pytest.CaptureFixture[str]) -> None:
    train.main(["--task", "telebip_flat", "--check"])
    text = capsys.readouterr().out
    assert "telebip_flat: " in text and "6 joints, 133 N, physics at 200 Hz, policy at 50 Hz" in text
    assert text.rstrip().endswith("fit to be trained")


def test_a_robot_whose_feet_feel_nothing_is_refused_after_the_table(tmp_path, capsys: pytest.CaptureFixture[str]) -> None:
    robot = tmp_path / "robot.xml"
    robot.write_text(MJCF.replace('<site name="right_foot" size="0.04"/>', '<site name="right_foot" size="0.001"/>'))
    with pytest.raises(UserError, match="right_foot_force"):
        train.main(["--task", "telebip_flat", "--check", f"sim.robot={robot}"])
    assert "error" in capsys.readouterr().out
