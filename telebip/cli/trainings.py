"""Trainings side by side: processes of the train command, each with its log, that can be stopped and gone on with."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from telebip.config import TaskConfig, parse_config
from telebip.errors import UserError

POLL = 0.5  # s between two looks at the processes


@dataclass
class Run:
    """One training of the study: `train.py --task NAME --seed S`, in a folder of its own."""

    task: str
    seed: int
    config: TaskConfig  # what the command trains
    runs: Path  # where all trainings go
    overrides: tuple[str, ...] = ()
    allow_robot_change: bool = False
    process: subprocess.Popen[bytes] | None = None
    is_told: bool = False  # to stop
    _found: Path | None = None

    @property
    def name(self) -> str:
        """What people call it."""
        return f"{self.task}, seed {self.seed}"

    @property
    def log_dir(self) -> Path:
        """The `--log-dir` of its command."""
        return self.runs / f"seed{self.seed}"

    @property
    def log(self) -> Path:
        """What its processes have printed."""
        return self.log_dir / f"{self.task}.log"

    @property
    def run_dir(self) -> Path | None:
        """Its run's folder: the newest one with the same configuration; None before it has begun."""
        if self._found is None:
            files = sorted((self.log_dir / self.task).glob("*/config.yaml"), reverse=True)
            self._found = next((file.parent for file in files if _holds(file, self.config)), None)
        return self._found

    @property
    def is_finished(self) -> bool:
        """Whether all of its iterations are done."""
        run_dir = self.run_dir
        return bool(run_dir and (run_dir / f"model_{self.config.ppo.max_iterations}.pt").is_file())

    @property
    def samples_per_iteration(self) -> int:
        """Environment steps of one iteration."""
        return self.config.num_envs * self.config.ppo.num_steps_per_env

    @property
    def total(self) -> int:
        """Environment steps of the whole training."""
        return self.samples_per_iteration * self.config.ppo.max_iterations

    def samples(self) -> int:
        """Return the environment steps so far."""
        run_dir = self.run_dir
        if run_dir is None:
            return 0
        with contextlib.suppress(OSError):
            return self.samples_per_iteration * max(0, (run_dir / "learning.csv").read_bytes().count(b"\n") - 1)
        return 0

    def command(self, device: str) -> list[str]:
        """Return the command that begins the training, or goes on with it."""
        run_dir = self.run_dir
        if run_dir and any(run_dir.glob("model_*.pt")):
            arguments = ["--resume", str(run_dir), *(["--allow-robot-change"] * self.allow_robot_change)]
        else:
            arguments = ["--task", self.task, "--seed", str(self.seed), "--log-dir", str(self.log_dir), *self.overrides]
        return [sys.executable, "-m", "telebip.cli.main", "train", *arguments, "--device", device]

    def last_line(self) -> str:
        """Return the last line of the log."""
        with contextlib.suppress(OSError):
            lines = self.log.read_text(encoding="utf-8", errors="replace").split("\n")
            return next((line.strip() for line in reversed(lines) if line.strip()), "")
        return ""


def _holds(file: Path, config: TaskConfig) -> bool:
    with contextlib.suppress(OSError, UserError):
        return parse_config(file.read_text(encoding="utf-8"), str(file)) == config
    return False


def default_jobs(device_type: str) -> int:
    """Return how many trainings run side by side: two on a CPU with two processors or more, one on a GPU."""
    return min(2, len(_processors())) if device_type == "cpu" else 1


def train_all(
    runs: Sequence[Run],
    jobs: int,
    device: str,
    asked: Callable[[], bool],
    say: Callable[[str], None],
    show: Callable[[Sequence[Run]], None],
) -> list[Run]:
    """Train what is not finished, `jobs` at the same time.

    On a CPU each has processors of its own, and as many threads. When asked to stop, every process is told so, as by Ctrl-C,
    and leaves a checkpoint after its iteration.

    Args:
        runs: what to train, in this order.
        jobs: number of processes.
        device: as the train command takes it.
        asked: whether to stop.
        say: called with a line about what has happened.
        show: called every half second with the runs that are being trained.

    Returns:
        The runs that have failed.
    """
    waiting, failed = [run for run in runs if not run.is_finished], []
    at_work: dict[int, Run] = {}  # by their place
    with _ended_in_any_case(at_work):
        while (waiting and not asked()) or at_work:
            for place in range(jobs):
                if place not in at_work and waiting and not asked():
                    at_work[place] = waiting.pop(0)
                    _start(at_work[place], place, jobs, device)
                    say(f"{at_work[place].name}: training, log in {at_work[place].log}")
            if asked():
                _tell_to_stop(at_work.values())
            time.sleep(POLL)
            show(list(at_work.values()))
            for place, run in list(at_work.items()):
                if run.process and (status := run.process.poll()) is not None:
                    del at_work[place]
                    if run.is_finished:
                        say(f"{run.name}: trained, {run.total / 1e6:.1f} M samples in {run.run_dir}")
                    elif not asked():
                        say(f"{run.name}: training failed (exit status {status}), see {run.log}: {run.last_line()}")
                        failed.append(run)
    return failed


def _start(run: Run, place: int, jobs: int, device: str) -> None:
    """Start a run's process in a session of its own: a Ctrl-C in the terminal reaches it through us, once."""
    run.log.parent.mkdir(parents=True, exist_ok=True)
    environment, processors = dict(os.environ), _processors()
    own = processors[place::jobs] or processors
    if device == "cpu":
        environment["OMP_NUM_THREADS"] = str(len(own))
    with run.log.open("ab") as log:
        run.process = subprocess.Popen(
            run.command(device),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
        )
    if device == "cpu" and hasattr(os, "sched_setaffinity"):
        with contextlib.suppress(OSError):  # it has ended already
            os.sched_setaffinity(run.process.pid, own)


def _tell_to_stop(runs: Iterable[Run]) -> None:
    """Send every process the signal of a Ctrl-C, once."""
    for run in runs:
        if run.process and not run.is_told:
            run.is_told = True
            with contextlib.suppress(OSError):
                run.process.send_signal(signal.SIGINT)


@contextmanager
def _ended_in_any_case(at_work: dict[int, Run]) -> Iterator[None]:
    """Leave no process behind, whatever ends the context."""
    try:
        yield
    finally:
        for run in at_work.values():
            if run.process and run.process.poll() is None:
                run.process.kill()
                run.process.wait()


def _processors() -> list[int]:
    """Return the processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))
