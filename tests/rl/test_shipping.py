"""What is shipped of a run, and that nothing of the machine comes along."""

import json
from pathlib import Path

import pytest

from telebip import ROOT
from telebip.errors import UserError
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.shipping import ship

COMMAND = ["scripts/train.py", "--task", "telebip_rough", "--seed", "1"]


@pytest.fixture
def run_dir(tmp_path: Path) -> Path:
    """A run as it is on the machine that trained it."""
    source, folder = ROOT / "assets" / "policies" / "telebip_rough", tmp_path / "run"
    folder.mkdir()
    for file in source.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    about = json.loads((folder / "run.json").read_text())
    about["starts"] = [{**about["starts"][0], "command": ["/home/me/train.py", "--resume", "/tmp/x"]}] * 2
    (folder / "run.json").write_text(json.dumps(about))
    (folder / "model_600.pt").write_bytes(b"")
    return folder


def test_four_files_and_the_command_that_makes_them(run_dir: Path, tmp_path: Path) -> None:
    ship(run_dir, tmp_path / "shipped", COMMAND)
    assert {file.name for file in (tmp_path / "shipped").iterdir()} == {"policy.pt", "config.yaml", "learning.csv", "run.json"}
    starts = json.loads((tmp_path / "shipped" / "run.json").read_text())["starts"]
    assert [start["command"] for start in starts] == [COMMAND, COMMAND]
    assert starts[0]["versions"]["mujoco"]
    assert load_checkpoint(tmp_path / "shipped").task == "telebip_rough"


def test_a_path_of_the_machine_is_refused(run_dir: Path, tmp_path: Path) -> None:
    config = (run_dir / "config.yaml").read_text()
    (run_dir / "config.yaml").write_text(config.replace("robot: assets/telebip.xml", "robot: /home/me/telebip.xml"))
    with pytest.raises(UserError, match=r"config.yaml holds the path '/home/me/telebip.xml' of this machine"):
        ship(run_dir, tmp_path / "shipped", COMMAND)
    assert not (tmp_path / "shipped").exists()


def test_what_is_missing_is_named(run_dir: Path, tmp_path: Path) -> None:
    (run_dir / "learning.csv").unlink()
    with pytest.raises(UserError, match=r"cannot ship .*learning.csv"):
        ship(run_dir, tmp_path / "shipped", COMMAND)
