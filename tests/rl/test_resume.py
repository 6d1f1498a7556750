"""A training that is killed and resumed is, from its last checkpoint on, the training that was never interrupted."""

import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest
import torch
from processes import FORKS
from worlds import write_stateful

from telebip import ROOT
from telebip.cli.common import run
from telebip.errors import UserError
from telebip.rl.checkpoint import load_checkpoint

SMALL = ("num_envs=16", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[32,16]", "episode.length=0.5", "ppo.save_interval=2")
"""Episodes that end by falls and by time-outs, pushes and commands that change, within a few iterations."""
BUSY = ("events.push.interval=[0.1,0.3]", "commands.resampling_time=0.2", "ppo.symmetry=phase")


class Training:
    """`train.py` in a process of its own."""

    def __init__(
        self, tmp_path: Path, *arguments: str, before: Callable[[], None] | None = None, after: tuple[str, ...] = ()
    ) -> None:
        """Start it; `before` is called in it first, and the overrides `after` come last."""
        self.output_file = tmp_path / f"output_{time.monotonic_ns()}"
        self.process: ForkServerProcess = FORKS.Process(
            target=_train, args=(self.output_file, [*arguments, *SMALL, *BUSY, *after], before)
        )
        self.process.start()

    def send(self, number: signal.Signals) -> None:
        assert self.process.pid
        os.kill(self.process.pid, number)

    def wait(self) -> int | None:
        """Return the exit status, or minus the signal that ended it."""
        self.process.join(timeout=1200)
        return self.process.exitcode

    def finish(self) -> str:
        """Return what it has printed."""
        status = self.wait()
        assert status == 0, self.output
        return self.output

    @property
    def output(self) -> str:
        return self.output_file.read_text()

    @property
    def running(self) -> bool:
        return self.process.is_alive()


def _train(output: Path, arguments: list[str], before: Callable[[], None] | None) -> None:
    from telebip.cli.train import main

    descriptor = os.open(output, os.O_WRONLY | os.O_CREAT)
    os.dup2(descriptor, 1)
    os.dup2(descriptor, 2)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # which tests under `nohup` would hand down ignored
    sys.argv = ["scripts/train.py", *arguments]
    torch.set_num_threads(1)
    if before:
        before()
    run(lambda: main(arguments))


def new(log_dir: Path, iterations: int) -> tuple[str, ...]:
    return ("--task", "telebip_flat", "--log-dir", str(log_dir), "--max-iterations", str(iterations))


def resumed(folder: Path, iterations: int) -> tuple[str, ...]:
    return ("--resume", str(folder), "--max-iterations", str(iterations))


def run_dir(log_dir: Path) -> Path:
    (folder,) = (log_dir / "telebip_flat").iterdir()
    return folder


def await_checkpoint(training: Training, log_dir: Path) -> Path:
    while not list(log_dir.glob("telebip_flat/*/model_*.pt")):
        assert training.running, training.output
        time.sleep(0.01)
    return run_dir(log_dir)


@pytest.fixture(scope="module")
def done_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a run of four iterations, to be copied."""
    log_dir = tmp_path_factory.mktemp("done")
    Training(log_dir, *new(log_dir, 4)).finish()
    return run_dir(log_dir)


def same(a: object, b: object) -> bool:
    """Whether two nests of dictionaries, lists, tensors and numbers are equal, bit for bit."""
    if isinstance(a, torch.Tensor):
        return isinstance(b, torch.Tensor) and a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return isinstance(b, list | tuple) and len(a) == len(b) and all(map(same, a, b))
    return a == b


def curve(folder: Path) -> list[list[str]]:
    """Return the rows of `learning.csv` without the times that they took."""
    rows = [line.split(",") for line in (folder / "learning.csv").read_text().splitlines()]
    kept = [i for i, name in enumerate(rows[0]) if not name.startswith("speed/")]
    return [[row[i] for i in kept] for row in rows]


def interrupted(tmp_path: Path, iterations: int, kills: int, wait: float, seed: int = 0) -> tuple[Path, int]:
    """Train, killed at random moments after the first checkpoint; return the folder and the number of kills."""
    moments = random.Random(seed)
    training = Training(tmp_path, *new(tmp_path / "killed", iterations))
    folder, killed = await_checkpoint(training, tmp_path / "killed"), 0
    while killed < kills:
        time.sleep(moments.uniform(0.0, wait))
        training.send(signal.SIGKILL)
        if training.wait() == 0:
            break  # it was faster
        killed += 1
        before = len(curve(folder))
        training = Training(tmp_path, *resumed(folder, iterations))
        while len(curve(folder)) <= before and training.running:  # until it has got further than ever
            time.sleep(0.01)
    training.finish()
    return folder, killed


def assert_killing_changes_nothing(tmp_path: Path, iterations: int, kills: int, wait: float) -> None:
    Training(tmp_path, *new(tmp_path / "whole", iterations)).finish()
    folder, killed = interrupted(tmp_path, iterations, kills, wait)
    assert killed == kills
    reference = run_dir(tmp_path / "whole")
    ours, theirs = (load_checkpoint(run / f"model_{iterations}.pt") for run in (folder, reference))
    assert same(ours.learner, theirs.learner)
    assert same(ours.training, theirs.training)
    assert (ours.iteration, ours.samples, ours.config) == (theirs.iteration, theirs.samples, theirs.config)
    assert curve(folder) == curve(reference)


def test_a_killed_training_goes_on_bit_for_bit(tmp_path: Path) -> None:
    assert_killing_changes_nothing(tmp_path, iterations=40, kills=3, wait=0.1)


def test_a_robot_with_filters_delays_and_mocap_bodies_goes_on_bit_for_bit(tmp_path: Path) -> None:
    robot = f"sim.robot={write_stateful(ROOT / 'assets' / 'telebip.xml', tmp_path)}"
    own = (robot, "ppo.symmetry=none")  # its right knee alone has a spring
    folders = []
    for name, ends in (("whole", [6]), ("interrupted", [2, 6])):
        Training(tmp_path, *new(tmp_path / name, ends[0]), after=own).finish()
        folders.append(run_dir(tmp_path / name))
        for end in ends[1:]:
            Training(tmp_path, *resumed(folders[-1], end), after=own).finish()
    whole, interrupted = (load_checkpoint(folder / "model_6.pt") for folder in folders)
    assert {"act", "history", "plastic", "mocap_pos"} <= whole.training[0]["env"]["sim"].keys()
    assert same(whole.learner, interrupted.learner)
    assert same(whole.training, interrupted.training)
    assert curve(folders[0]) == curve(folders[1])


@pytest.mark.slow
def test_twenty_kills_change_nothing(tmp_path: Path) -> None:
    assert_killing_changes_nothing(tmp_path, iterations=200, kills=20, wait=0.3)


class DieWriting:
    """End the process at its n-th `fsync`: with half of the file's bytes, or with all of them but not under their name."""

    def __init__(self, half: bool, number: int) -> None:
        self.half, self.left, self.fsync = half, number, os.fsync

    def __call__(self) -> None:
        os.fsync = self.die

    def die(self, descriptor: int) -> None:
        self.left -= 1
        if self.left == 0:
            if self.half:
                os.ftruncate(descriptor, os.fstat(descriptor).st_size // 2)
            os.kill(os.getpid(), signal.SIGKILL)
        self.fsync(descriptor)


@pytest.mark.parametrize(("half", "number"), [(True, 11), (False, 11), (True, 13), (False, 14)])
def test_a_kill_while_a_checkpoint_is_written_leaves_the_one_before(tmp_path: Path, half: bool, number: int) -> None:
    """Each file is synced, and then its folder: three files at the start, then two for each checkpoint."""
    training = Training(tmp_path, *new(tmp_path, 8), before=DieWriting(half, number))
    assert training.wait() == -signal.SIGKILL
    checkpoint = load_checkpoint(run_dir(tmp_path))
    assert (checkpoint.iteration, checkpoint.damaged) == (4 if number == 14 else 2, ()) or number == 13
    Training(tmp_path, *resumed(run_dir(tmp_path), 8)).finish()
    assert load_checkpoint(run_dir(tmp_path)).iteration == 8


def test_two_interrupts_leave_at_once_and_without_damage(tmp_path: Path) -> None:
    training = Training(tmp_path, *new(tmp_path, 100_000))
    folder = await_checkpoint(training, tmp_path)
    for _ in range(2):
        training.send(signal.SIGINT)
        time.sleep(0.001)
    assert training.wait() in (0, 130)  # 0 where the iteration ended first
    assert load_checkpoint(folder).damaged == ()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_one_interrupt_finishes_the_iteration_and_saves_it(tmp_path: Path, number: signal.Signals) -> None:
    training = Training(tmp_path, *new(tmp_path, 100_000))
    folder = await_checkpoint(training, tmp_path)
    training.send(number)
    output = training.finish()
    assert f"stopped after iteration {load_checkpoint(folder).iteration} of 100000" in output
    assert len(curve(folder)) == 1 + load_checkpoint(folder).iteration


def ignore_hangups() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)


def test_a_training_under_nohup_outlives_its_terminal(tmp_path: Path) -> None:
    training = Training(tmp_path, *new(tmp_path, 30), before=ignore_hangups)
    folder = await_checkpoint(training, tmp_path)
    training.send(signal.SIGHUP)
    training.finish()
    assert load_checkpoint(folder).iteration == 30


def lose_the_reader() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    os.dup2(writer, 1)


def fill_the_disk() -> None:
    os.dup2(os.open("/dev/full", os.O_WRONLY), 1)


@pytest.mark.parametrize("before", [lose_the_reader, fill_the_disk])
def test_a_training_outlives_the_reader_of_its_output(tmp_path: Path, before: Callable[[], None]) -> None:
    """As in `train.py | head`, and in `train.py | tee log` after a Ctrl-C, which ends `tee` first."""
    training = Training(tmp_path, *new(tmp_path, 100_000), before=before)
    folder = await_checkpoint(training, tmp_path)
    training.send(signal.SIGINT)
    assert training.finish() == ""
    assert len(curve(folder)) == 1 + load_checkpoint(folder).iteration


def test_going_on_from_an_earlier_checkpoint_sets_the_later_ones_aside(tmp_path: Path) -> None:
    Training(tmp_path, *new(tmp_path, 8)).finish()
    folder = run_dir(tmp_path)
    output = Training(tmp_path, *resumed(folder / "model_4.pt", 5), "ppo.keep_checkpoints=1").finish()
    for name in ("model_6.pt", "model_8.pt"):
        assert f"note: {name} is from after the checkpoint to go on from, and is in {folder / 'set_aside'} now" in output
        assert load_checkpoint(folder / "set_aside" / name).iteration == int(name[6])
    assert [file.name for file in folder.glob("model_*.pt")] == ["model_5.pt"]
    assert load_checkpoint(folder).iteration == 5
    assert [row[0] for row in curve(folder)[1:]] == ["1", "2", "3", "4", "5"]


def test_what_was_set_aside_stays_when_more_is(tmp_path: Path) -> None:
    Training(tmp_path, *new(tmp_path, 6)).finish()
    folder = run_dir(tmp_path)
    first = (folder / "model_6.pt").read_bytes()
    for target in (6, 5):
        Training(tmp_path, *resumed(folder / "model_4.pt", target)).finish()
    assert (folder / "set_aside" / "model_6.pt").read_bytes() == first
    assert load_checkpoint(folder / "set_aside_2" / "model_6.pt").iteration == 6


def test_a_link_to_a_checkpoint_goes_on_in_the_runs_own_folder(tmp_path: Path) -> None:
    Training(tmp_path, *new(tmp_path, 2)).finish()
    folder, link = run_dir(tmp_path), tmp_path / "mine" / "start.pt"
    link.parent.mkdir()
    link.symlink_to(folder / "model_2.pt")
    Training(tmp_path, *resumed(link, 3)).finish()
    assert load_checkpoint(folder).iteration == 3
    assert [*link.parent.iterdir()] == [link]


def train_meanwhile() -> None:
    """Let another process save a checkpoint before this one has the run for itself."""
    import telebip.rl.run

    exclusive = telebip.rl.run.exclusive

    def late(folder: Path):
        shutil.copy(folder / "model_2.pt", folder / "model_4.pt")
        return exclusive(folder)

    telebip.rl.run.exclusive = late


def test_a_run_that_has_gone_on_since_its_checkpoint_was_loaded_is_left_alone(tmp_path: Path) -> None:
    Training(tmp_path, *new(tmp_path, 2)).finish()
    folder = run_dir(tmp_path)
    late = Training(tmp_path, *resumed(folder, 6), before=train_meanwhile)
    assert late.wait() == 2
    assert f"another process has trained in '{folder}' meanwhile, up to iteration 4; start again" in late.output
    assert {file.name for file in folder.glob("model_*.pt")} == {"model_2.pt", "model_4.pt"}


def test_two_processes_do_not_train_in_one_folder(tmp_path: Path) -> None:
    training = Training(tmp_path, *new(tmp_path, 100_000))
    folder = await_checkpoint(training, tmp_path)
    second = Training(tmp_path, *resumed(folder, 100_000))
    assert second.wait() == 2
    assert f"another process is training in '{folder}'" in second.output
    training.send(signal.SIGKILL)
    training.wait()
    Training(tmp_path, *resumed(folder, 1)).finish()  # the lock went with its holder


def test_a_damaged_newest_checkpoint_is_named_and_the_one_before_used(tmp_path: Path) -> None:
    Training(tmp_path, *new(tmp_path, 4)).finish()
    newest = run_dir(tmp_path) / "model_4.pt"
    content = bytearray(newest.read_bytes())
    content[content.index(b"optimizer_state_dict")] ^= 1
    newest.write_bytes(bytes(content))
    with pytest.raises(UserError, match="is damaged"):
        load_checkpoint(newest)
    output = Training(tmp_path, *resumed(run_dir(tmp_path), 6)).finish()
    assert f"note: checkpoint '{newest}' is damaged: a checksum is wrong; using model_2.pt instead" in output
    assert "resuming after iteration 2 of 6" in output
    assert load_checkpoint(run_dir(tmp_path)).iteration == 6


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("learning.csv", "samples,loss\n1,many\n", "learning.csv is damaged at line 2: could not convert"),
        ("learning.csv", "samples\n" + 200_000 * "1" + "\n", "learning.csv is damaged at line 2: field larger than"),
        ("learning.csv", None, "learning.csv: Is a directory"),
        ("run.json", '{"starts": [', "run.json is damaged: Expecting value"),
        ("run.json", '{"starts": 3}', "run.json is damaged: it holds no list 'starts'"),
        ("run.json", "[]", "run.json is damaged: it holds no list 'starts'"),
    ],
    ids=["word", "long", "folder", "torn", "number", "list"],
)
def test_a_damaged_file_of_a_run_is_named_before_anything_changes(
    done_run: Path, tmp_path: Path, name: str, content: str | None, said: str
) -> None:
    folder = tmp_path / "run"
    shutil.copytree(done_run, folder)
    (folder / name).unlink()
    if content is None:
        (folder / name).mkdir()
    else:
        (folder / name).write_text(content)
    before = {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    refused = Training(tmp_path, *resumed(folder / "model_2.pt", 5))
    assert refused.wait() == 2
    (error,) = (line for line in refused.output.splitlines() if line.startswith("error: "))
    assert str(folder) in error and said in error
    assert "Traceback" not in refused.output
    assert {file: file.read_bytes() for file in folder.rglob("*") if file.is_file()} == before


class FullDisk:
    """Let every write to checkpoints fail, from a given one on, as on a full disk: they go to /dev/full."""

    def __init__(self, folder: str) -> None:
        self.folder = folder

    def __call__(self) -> None:
        from telebip import archive

        write = archive.write_atomically

        def fill(path: Path, content: bytes) -> None:
            if str(path).startswith(self.folder):
                Path("/dev/full").write_bytes(content)
            write(path, content)

        archive.write_atomically = fill


def test_a_full_disk_is_told_and_nothing_is_lost(tmp_path: Path) -> None:
    training = Training(tmp_path, *new(tmp_path, 5), before=FullDisk(str(tmp_path)))
    assert training.wait() == 2
    folder, output = run_dir(tmp_path), training.output
    assert f"note: cannot save to '{folder}': No space left on device; training goes on and will try again" in output
    assert "5/5" in output
    saved = Path(output.rsplit("the checkpoint is in '", 1)[1].split("'")[0])
    assert not list(folder.glob("model_*.pt"))
    assert load_checkpoint(saved).iteration == 5
    assert len(load_checkpoint(saved).training) == 1
    for file in saved.iterdir():
        file.rename(folder / file.name)
    saved.rmdir()
    Training(tmp_path, *resumed(folder, 6)).finish()
    assert load_checkpoint(folder).iteration == 6


def test_too_little_room_is_said_before_the_start(tmp_path: Path) -> None:
    training = Training(tmp_path, *new(tmp_path, 5), "ppo.keep_checkpoints=1000000000")
    assert training.wait() == 2
    assert "make room, or choose another --log-dir" in training.output


def test_old_checkpoints_are_pruned(tmp_path: Path) -> None:
    Training(tmp_path, *new(tmp_path, 9), "ppo.keep_checkpoints=2").finish()
    assert {file.name for file in run_dir(tmp_path).glob("*.pt")} == {"model_8.pt", "model_9.pt", "policy.pt"}
