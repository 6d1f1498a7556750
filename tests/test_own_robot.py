"""A robot that telebip does not know goes through everything by one MJCF and one YAML file, as docs/your_robot.md says."""

import json
import re
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from worlds import CALM

from telebip import ROOT
from telebip.cli import evaluate, export, play, train
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.checkpoint import load_checkpoint
from telebip.robot import FLOOR, FOOT_SENSORS, KEYFRAME, load_robot

FOLDER = ROOT / "tests" / "robots"
TASK = FOLDER / "rotary_knee.yaml"
TINY = ("--num-envs", "8", "--device", "cpu", "--max-iterations", "3", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]")


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of three iterations."""
    log_dir = tmp_path_factory.mktemp("runs")
    train.main(["--task", str(TASK), "--log-dir", str(log_dir), *TINY])
    (folder,) = (log_dir / "rotary_knee").iterdir()
    return folder


def test_its_knees_are_hinges_and_it_stands_on_its_feet() -> None:
    robot = load_robot(FOLDER / "rotary_knee.xml")
    np.testing.assert_allclose(robot.nominal, [0.0, -0.35, 0.7] * 2)
    np.testing.assert_allclose(robot.force_limit, [50.0, 50.0, 80.0] * 2)
    config = load_task(str(TASK), ["num_envs=4", "terminations.fallen.min_hip_height=0.6"])
    env = TelebipEnv(config, robot, "cpu", "native")
    for _ in range(10):  # 0.2 s in the nominal pose, from random initial states
        _, _, dones, _ = env.step(torch.zeros(4, 6))
        assert not dones.any()
    weight = env.sim.state.foot_force.sum(1) / robot.weight
    assert weight.mean() == pytest.approx(1.0, abs=0.3)


def test_the_robot_lies_beside_its_task_whatever_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load_task(str(TASK)).sim.robot == str(FOLDER / "rotary_knee.xml")
    assert load_task("telebip_flat").sim.robot == "assets/telebip.xml"  # telebip's own, from telebip's folder


def example_at(file: Path) -> Path:
    """Copy the example's MJCF to `file` in a new folder."""
    file.parent.mkdir()
    file.write_text((FOLDER / "rotary_knee.xml").read_text())
    return file


def test_a_robot_given_from_the_working_directory_is_found_from_any_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = example_at(tmp_path / "robots" / "mine.xml")
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "mine.yaml").write_text("base: telebip_flat\nsim: {robot: robots/mine.xml}\n")
    monkeypatch.chdir(tmp_path)
    assert load_task("telebip_flat", ["sim.robot=robots/mine.xml"]).sim.robot == str(robot)
    assert load_task("tasks/mine.yaml").sim.robot == str(robot)


def test_no_file_of_the_working_directory_stands_for_telebips_own_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = example_at(tmp_path / "assets" / "telebip.xml")
    monkeypatch.chdir(tmp_path)
    assert load_robot(load_task("telebip_flat").sim.robot).path == ROOT / "assets" / "telebip.xml"
    named = load_task("telebip_flat", ["sim.robot=assets/telebip.xml"]).sim.robot  # by the user, who means that one
    assert load_robot(named).path == other


def test_a_base_lies_beside_the_task_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "common.yaml").write_text("base: telebip_flat\nseed: 5\n")
    (tmp_path / "sub" / "mine.yaml").write_text("base: common.yaml\nnum_envs: 3\n")
    monkeypatch.chdir(tmp_path)
    task = load_task("sub/mine.yaml")
    assert (task.seed, task.num_envs) == (5, 3)


def test_it_is_played_and_measured_from_its_checkpoint_alone(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert load_checkpoint(run_dir).config.actions.scale["knee"] == 0.5
    play.main(["--checkpoint", str(run_dir), "--num-envs", "2", "--duration", "1", "--device", "cpu"])
    text = capsys.readouterr().out
    assert "rotary_knee, 2 worlds x 1 s" in text
    assert re.search(r"cost of transport \d+\.\d+ mechanical", text)


def test_it_is_evaluated(run_dir: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = run_dir / "report"
    measure = [
        "--suite",
        "tracking",
        "--commands",
        "0.7",
        "--num-envs",
        "2",
        "--duration",
        "2",
        "--device",
        "cpu",
        "--out",
        str(out),
    ]
    evaluate.main(["--checkpoint", str(run_dir), *measure])
    assert "rotary_knee" in capsys.readouterr().out
    assert json.loads((out / "results.json").read_text())["label"] == "rotary_knee"


def test_its_export_says_newton_metres(run_dir: Path) -> None:
    export.main(["--checkpoint", str(run_dir), "--out", str(run_dir / "policy.onnx")])
    texts = onnxruntime.InferenceSession(str(run_dir / "policy.onnx")).get_modelmeta().custom_metadata_map
    about = {key: json.loads(text) for key, text in texts.items()}
    assert about["joint_unit"] == ["rad"] * 6
    assert about["force_unit"] == ["N m"] * 6
    assert about["action_scale"] == [0.25, 0.5, 0.5] * 2
    assert about["stiffness"] == [200.0, 200.0, 300.0] * 2


def test_both_engines_take_it() -> None:
    states = []
    for backend in ("native", "warp"):
        config = load_task(str(TASK), ["num_envs=2", *CALM])
        env = TelebipEnv(config, load_robot(config.sim.robot), "cpu", backend)
        for _ in range(5):
            env.step(torch.full((2, 6), 0.1))
        states.append(env.sim.state.qpos.clone())
    torch.testing.assert_close(states[0], states[1], atol=1e-3, rtol=0.0)


def test_the_tutorial_names_what_the_loader_demands() -> None:
    text = (ROOT / "docs" / "your_robot.md").read_text(encoding="utf-8")
    for name in (FLOOR, KEYFRAME, *FOOT_SENSORS):
        assert f"`{name}`" in text
    task = (FOLDER / "rotary_knee.yaml").read_text(encoding="utf-8")
    shown = re.search(r"```yaml\n(.*?)```", text, re.DOTALL)
    assert shown is not None
    assert shown[1] == task  # the file that these tests run
