"""The scripts as a user runs them: exit status, the one line on standard error, and what they leave."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from processes import Done, forked, fresh

from telebip import ROOT
from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.replay import save_fault
from telebip.robot import load_robot

TRAIN, PLAY, GALLERY = "scripts/train.py", "scripts/play.py", "scripts/gallery.py"
TINY = ("--num-envs", "8", "--device", "cpu", "ppo.num_steps_per_env=5", "ppo.hidden_dims=[16,16]")


def ran(script: str, *arguments: str, run: Callable[..., Done] = forked) -> str:
    """Run a script that must succeed and return what it printed."""
    done = run(script, *arguments)
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return done.stdout


def refusal(script: str, *arguments: str) -> str:
    """Run a script that must refuse its arguments and return its one line on standard error."""
    done = forked(script, *arguments)
    assert done.returncode == 2, done.stdout + done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("error: ")
    return lines[0]


LONG = 300 * "a"


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ([TRAIN, "--task", "telebip_slwo"], ["telebip_slwo", "did you mean 'telebip_slow'?"]),
        ([TRAIN, "--task", "telebip_flat", "gait.perod=0.6"], ["gait.perod", "did you mean 'gait.period'?"]),
        ([TRAIN, "--task", "telebip_flat", "gait.period=long"], ["gait.period=long", "'long' is not a number"]),
        ([TRAIN, "--task", "telebip_flat", "--num-envs", "0"], ["num_envs must be >= 1", "got 0"]),
        ([TRAIN, "--task", "telebip_flat", "--num-env", "8"], ["--num-env", "did you mean '--num-envs'?"]),
        ([TRAIN], ["--task", "telebip_flat"]),
        ([TRAIN, "--task", "telebip_flat", f"sim.robot={LONG}"], ["robot file", "does not exist"]),
        ([PLAY, "--checkpoint", LONG], ["checkpoint", "does not exist"]),
        ([PLAY, "--agent", "zero", "--duration", "-1"], ["--duration", "-1"]),
        ([PLAY, "--controller", "alp"], ["--controller", "'alp'", "'alip', 'dcm'"]),
        ([PLAY, "--controller", "dcm", "control.step_tim=1"], ["did you mean 'control.step_time'?"]),
        ([PLAY, "--agent", "zero", "--record", "foo.txt"], ["--record", "foo.txt", ".rrd", ".mp4"]),
        ([GALLERY, "--only", "waling.gif"], ["waling.gif", "did you mean 'walking.gif'?"]),
        ([GALLERY, "--only", "stride.png", "--out", "README.md"], ["cannot write to folder 'README.md'"]),
        ([PLAY, "--agent", "zero", "--show", "0"], ["--show", "at least 1"]),
        ([PLAY, "--agent", "zero", "--connect", "localhost"], ["--connect", "--viewer rerun"]),
        ([PLAY, "--agent", "zero", "--viewer", "mujoco", "--record", "f.mp4"], ["--viewer mujoco", "no room for --record"]),
        ([PLAY, "--agent", "zero", "--viewer", "mujoco", "--beside", "dcm"], ["--viewer mujoco", "no room for --beside"]),
        ([PLAY, "--agent", "zero", "--command", "0.5", "nan", "0"], ["--command", "invalid speed value: 'nan'"]),
        ([PLAY, "--replay", "f.pt", "--beside", "dcm"], ["--replay", "leave out --beside"]),
        ([PLAY, "--replay", "f.pt", "--num-envs", "8"], ["--replay", "leave out --num-envs"]),
        ([PLAY, "--replay", "f.pt", "gait.period=1"], ["--replay", "sim.robot=FILE", "'gait.period=1'"]),
        ([TRAIN, "--task", "telebip_flat", "--connect", "localhost"], ["--connect", "--viewer rerun"]),
        ([TRAIN, "--resume", "runs/mine", "--log-dir", "elsewhere"], ["--log-dir", "the run's own folder"]),
        ([PLAY, "--agent", "zero", "--viewer", "mujco"], ["--viewer", "mujco", "mujoco"]),
    ],
    ids=lambda value: " ".join(value[1:]) if value[0] in (TRAIN, PLAY, GALLERY) else "",
)
def test_a_mistake_is_one_line_that_names_it(arguments: list[str], named: list[str]) -> None:
    line = refusal(*arguments)
    for part in named:
        assert part in line


def test_checkpoints_that_are_missing_or_damaged(tmp_path: Path) -> None:
    assert f"{tmp_path}/nowhere.pt" in refusal(PLAY, "--checkpoint", f"{tmp_path}/nowhere.pt")
    damaged = tmp_path / "model_1.pt"
    damaged.write_bytes(b"PK\x03\x04 and nothing that a zip file would hold")
    assert str(damaged) in refusal(TRAIN, "--resume", str(damaged))


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_a_gpu_that_is_not_there() -> None:
    line = refusal(TRAIN, "--task", "telebip_flat", "--device", "cuda")
    assert "cuda:0" in line
    assert "this machine has: cpu" in line


@pytest.mark.parametrize(
    "code",
    [
        "import telebip",
        "import telebip.config; telebip.config.task_names()",
        "import runpy; sys.argv = ['train.py', '--help']; runpy.run_path('scripts/train.py', run_name='__main__')",
    ],
    ids=["telebip", "config", "help"],
)
def test_what_needs_no_engine_loads_none(code: str) -> None:
    script = f"""
import sys
try:
    {code}
except SystemExit as stop:
    assert not stop.code
print(sorted({{"torch", "warp", "mujoco", "rsl_rl"}} & set(sys.modules)), file=sys.stderr)
"""
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "[]\n")


def test_help_shows_options_and_examples() -> None:
    for script in (TRAIN, PLAY):
        text = ran(script, "--help")
        assert "--num-envs" in text
        assert "examples:" in text


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of two iterations with eight worlds, made by train.py."""
    log_dir = tmp_path_factory.mktemp("runs")
    ran(TRAIN, "--task", "telebip_slow", "--max-iterations", "2", "--log-dir", str(log_dir), *TINY)
    (folder,) = (log_dir / "telebip_slow").iterdir()
    return folder


def test_a_trained_policy_can_be_played_and_recorded(run_dir: Path) -> None:
    assert {"model_2.pt", "policy.pt", "config.yaml", "run.json"} <= {path.name for path in run_dir.iterdir()}
    record = run_dir / "walk.rrd"
    others = ("--beside", "zero", "random")
    text = ran(
        PLAY, "--checkpoint", str(run_dir), "--duration", "1", "--record", str(record), "--device", "cpu", *others, run=fresh
    )
    assert "model_2.pt:\n  task              telebip_slow, 1 world x 1 s" in text
    assert "agent 'zero':\n  task              telebip_slow, 1 world x 1 s" in text
    assert "agent 'random':\n  task              telebip_slow, 1 world x 1 s" in text
    assert "0.55 m/s forward" in text  # the middle of telebip_slow's 0.4 to 0.7
    assert record.stat().st_size > 10_000


def test_a_training_looks_whether_it_walks_and_leaves_a_recording(tmp_path: Path) -> None:
    small = (*TINY, "--max-iterations", "11", "ppo.num_steps_per_env=2", "--log-dir", str(tmp_path))
    text = ran(TRAIN, "--task", "telebip_quick", "--until-walking", "--record", *small, run=fresh)
    (run_dir,) = (tmp_path / "telebip_quick").iterdir()
    lines = text.splitlines()
    last = next(line for line in lines if line.lstrip().startswith("11/11"))
    assert "not yet: falls after 0." in last
    assert f"rerun {run_dir / 'walk.rrd'}" in text and f"drew {run_dir / 'learning.png'}" in text
    assert "it walks" not in text
    for name in ("walk.rrd", "learning.png"):
        assert (run_dir / name).stat().st_size > 10_000
    assert (run_dir / "walk.png").exists() != ("note: no picture of it" in text)


@pytest.mark.slow
def test_pictures_are_made_anew(tmp_path: Path) -> None:
    text = ran(GALLERY, "--only", "control_loop.png", "stride.png", "--out", str(tmp_path), run=fresh)
    assert [line.split(":")[0] for line in text.splitlines()] == [f"{tmp_path}/control_loop.png", f"{tmp_path}/stride.png"]
    for name in ("control_loop.png", "stride.png"):
        assert 10_000 < (tmp_path / name).stat().st_size < 300_000


def test_a_model_based_walker_can_be_played() -> None:
    text = ran(
        PLAY, "--controller", "alip", "--command", "0.5", "0", "0", "--duration", "1", "--device", "cpu", "control.reach=0.4"
    )
    assert "controller 'alip':\n  task              telebip_flat, 1 world x 1 s" in text


def test_a_policy_is_not_played_on_other_observations_or_joints(tmp_path: Path) -> None:
    play = (PLAY, "--checkpoint", "telebip_flat", "--duration", "1", "--device", "cpu")
    assert "sees observations.policy as joint_pos (6), " in refusal(*play, "observations.policy.history=2")
    other = tmp_path / "left_leg_first.xml"
    sides = {"right": "left", "left": "right"}
    text = (ROOT / "assets" / "telebip.xml").read_text()
    actuators = re.search("<actuator>.*</actuator>", text, re.DOTALL)
    assert actuators is not None
    other.write_text(text.replace(actuators[0], re.sub("right|left", lambda side: sides[side[0]], actuators[0])))
    assert f"was trained on another robot than '{other}'" in refusal(*play, f"sim.robot={other}")


def test_the_default_command_is_the_middle_of_overridden_ranges() -> None:
    text = ran(PLAY, "--agent", "zero", "--duration", "0.1", "--device", "cpu", "commands.lin_vel_x=[0.2,0.4]")
    assert "0.30 m/s forward" in text


def test_a_run_goes_on_in_its_folder(run_dir: Path) -> None:
    ran(TRAIN, "--resume", str(run_dir), "--max-iterations", "3", "--device", "cpu")
    assert (run_dir / "model_3.pt").is_file()
    assert len(list(run_dir.parent.iterdir())) == 1
    starts = json.loads((run_dir / "run.json").read_text())["starts"]
    assert len(starts) == 2
    assert "--resume" in starts[1]["command"]
    assert "max_iterations: 3" in (run_dir / "config.yaml").read_text()


def test_a_run_goes_on_with_its_task_by_name_or_by_file_and_no_other(run_dir: Path) -> None:
    for task in ("telebip_slow", "configs/telebip_slow.yaml"):
        assert "has finished" in ran(TRAIN, "--resume", str(run_dir), "--max-iterations", "1", "--task", task)
    other = refusal(TRAIN, "--resume", str(run_dir), "--task", "telebip_flat")
    assert "is of task 'telebip_slow', not of 'telebip_flat'" in other


@pytest.mark.parametrize("seed", [("--seed", "7"), ("seed=7",)])
def test_a_run_goes_on_with_its_own_seed(run_dir: Path, seed: tuple[str, ...]) -> None:
    before = (run_dir / "config.yaml").read_text()
    assert "of seed 1; leave out the seed 7" in refusal(TRAIN, "--resume", str(run_dir), "--max-iterations", "9", *seed)
    assert (run_dir / "config.yaml").read_text() == before
    assert "has finished" in ran(TRAIN, "--resume", str(run_dir), "--max-iterations", "1", "--seed", "1")


def test_what_is_refused_leaves_no_folder(tmp_path: Path) -> None:
    arguments = ("--task", "telebip_flat", "--log-dir", str(tmp_path / "runs"), *TINY, "ppo.num_mini_batches=50")
    assert "an iteration has only 8 worlds x 5 steps" in refusal(TRAIN, *arguments)
    assert not (tmp_path / "runs").exists()


def test_an_interrupted_run_ends_well_and_leaves_a_checkpoint(tmp_path: Path) -> None:
    arguments = ["--task", "telebip_flat", "--max-iterations", "100000", "--log-dir", str(tmp_path), *TINY]
    with subprocess.Popen(
        [sys.executable, TRAIN, *arguments, "ppo.save_interval=1"],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as training:
        try:
            until = time.monotonic() + 60.0
            while not list(tmp_path.glob("telebip_flat/*/model_1.pt")):
                assert training.poll() is None
                assert time.monotonic() < until
                time.sleep(0.05)
            training.send_signal(signal.SIGINT)
            output, errors = training.communicate(timeout=60)
        finally:
            training.kill()
    assert (training.returncode, errors) == (0, "")
    stopped = next(line for line in output.splitlines() if line.startswith("stopped after iteration"))
    iteration = int(stopped.split()[3])
    (folder,) = (tmp_path / "telebip_flat").iterdir()
    assert iteration >= 1
    assert (folder / f"model_{iteration}.pt").is_file()
    assert not (folder / f"model_{iteration + 1}.pt").exists()


def test_a_dumped_fault_is_repeated_and_recorded(tmp_path: Path) -> None:
    env = TelebipEnv(load_task("telebip_flat", ["num_envs=4"]), load_robot("assets/telebip.xml"), "cpu", "native")
    env.sim.memory["qpos"][2, 8] = float("nan")
    env.step(torch.zeros(4, 6))
    (fault,) = {save_fault(tmp_path, kind, record, "t", env) for kind, record in env.take_faults().items() if "state" in kind}
    printed = ran(PLAY, "--replay", str(fault), "--record", str(tmp_path / "fault.rrd"))
    assert "non_finite_state, world 2, environment step 1, on native; repeated on native" in printed
    assert printed.splitlines()[-2] == "reproduced"
    assert (tmp_path / "fault.rrd").stat().st_size > 0
    own = tmp_path / "own.xml"
    own.write_text((ROOT / "assets" / "telebip.xml").read_text())
    assert ran(PLAY, "--replay", str(fault), f"sim.robot={own}").splitlines()[-1] == "reproduced"
    other = tmp_path / "other.xml"
    other.write_text(own.read_text().replace("</worldbody>", '<geom name="more" size="0.1" pos="9 9 9"/></worldbody>'))
    assert f"the fault is of another robot than '{other}'" in refusal(PLAY, "--replay", str(fault), f"sim.robot={other}")
    assert "robot file" in refusal(PLAY, "--replay", str(fault), "sim.robot=nowhere.xml")
    assert "this version reads 'telebip-fault-2'" in refusal(PLAY, "--replay", "assets/policies/telebip_flat/policy.pt")
