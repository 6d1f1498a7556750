"""Run folders: where a training writes, and what it notes down about itself."""

import contextlib
import json
import platform
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from filelock import FileLock, Timeout

from telebip import ROOT, __version__
from telebip.config import TaskConfig, to_yaml
from telebip.errors import UserError
from telebip.files import write_atomically
from telebip.rl.networks import arithmetic

PACKAGES = ("mujoco", "mujoco-warp", "warp-lang", "torch", "rsl-rl-lib", "numpy")


def create_run_dir(log_dir: Path, task: str) -> Path:
    """Create `log_dir/<task>/<date>_<time>`, a folder that no other run has, with a free name of the same second if need be.

    Raises:
        UserError: the folder cannot be made.
    """
    name = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for suffix in ("", *(f"_{i}" for i in range(2, 100))):
        run_dir = log_dir / task / (name + suffix)
        try:
            run_dir.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"cannot write to log folder '{log_dir}': {error.strerror or error}") from error
        return run_dir
    raise UserError(f"log folder '{log_dir / task}' has a hundred runs of this second")


def describe_run(run_dir: Path, config: TaskConfig, device: str, backend: str, processes: int = 1) -> None:
    """Write `config.yaml`, complete, and append to `run.json` this start: command, machine, versions, git revision.

    Raises:
        UserError: `run.json` is damaged, or the folder cannot be written to.
    """
    start = {
        "time": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": sys.argv,
        "device": device,
        "processor": machine_name(torch.device(device)),
        "arithmetic": arithmetic(config.ppo.mixed_precision, torch.device(device)),
        "backend": backend,
        "processes": processes,
        **describe_code(),
    }
    starts = read_starts(run_dir)
    try:
        write_atomically(run_dir / "run.json", (json.dumps({"starts": [*starts, start]}, indent=2) + "\n").encode())
        write_atomically(run_dir / "config.yaml", to_yaml(config).encode())
    except OSError as error:
        raise UserError(f"cannot write to run folder '{run_dir}': {error.strerror or error}") from error


def read_starts(run_dir: Path) -> list[dict[str, Any]]:
    """Return what `describe_run` has noted down in a run's `run.json`; nothing where there is no such file.

    Raises:
        UserError: it cannot be read, or holds something else.
    """
    file = run_dir / "run.json"
    if not file.exists():
        return []
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"cannot read {file}: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{file} is damaged: {error}; move it away to go on without it") from error
    starts = content.get("starts") if isinstance(content, dict) else None
    if not isinstance(starts, list):
        raise UserError(f"{file} is damaged: it holds no list 'starts'; move it away to go on without it")
    return starts


@contextmanager
def exclusive(run_dir: Path) -> Iterator[None]:
    """Keep other processes from training in `run_dir` for the duration of the context, however this process ends.

    Raises:
        UserError: another process is at it, or the folder cannot be written to.
    """
    lock = FileLock(run_dir / ".lock")
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        raise UserError(f"another process is training in '{run_dir}'; stop it first") from error
    except OSError as error:
        raise UserError(f"cannot write to run folder '{run_dir}': {error.strerror or error}") from error
    try:
        yield
    finally:
        lock.release()


def require_space(run_dir: Path, checkpoint_bytes: int, checkpoints: int) -> None:
    """Say so before the training starts if the disk has no room for its checkpoints.

    Raises:
        UserError: it has not.
    """
    free, needed = shutil.disk_usage(run_dir).free, checkpoint_bytes * (checkpoints + 1)
    if free < needed:
        raise UserError(
            f"the disk of '{run_dir}' has {free / 2**20:.0f} MiB left, and {checkpoints} checkpoints need "
            f"{needed / 2**20:.0f} MiB; make room, or choose another --log-dir or a smaller ppo.keep_checkpoints"
        )


def describe_code() -> dict[str, Any]:
    """Return the git revision and the versions of everything that numbers depend on."""
    return {
        "git_revision": git_revision(),
        "git_dirty": bool(_git("status", "--porcelain", "--untracked-files=no")),
        "python": platform.python_version(),
        "versions": {"telebip": __version__, **{name: version(name) for name in PACKAGES}},
    }


def git_revision() -> str | None:
    """Return the revision of telebip's repository, or None for an installed package."""
    return _git("rev-parse", "HEAD")


def _git(*arguments: str) -> str | None:
    """Return git's answer about telebip's own repository, or None where there is no git or no repository."""
    if not (ROOT / ".git").exists():
        return None  # git would answer about a repository of the user's that happens to surround the installed package
    try:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def machine_name(device: torch.device) -> str:
    """Return what the device calls itself."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    with contextlib.suppress(OSError):  # Linux; elsewhere platform knows
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        if names:
            return names[0]
    return platform.processor() or platform.machine()
