"""Run folders: where a training writes, and what it notes down about itself."""

import json
import platform
import subprocess
import sys
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from telebip import ROOT, __version__
from telebip.config import TaskConfig, to_yaml
from telebip.errors import UserError

PACKAGES = ("mujoco", "mujoco-warp", "warp-lang", "torch", "rsl-rl-lib", "numpy")


def create_run_dir(log_dir: Path, task: str) -> Path:
    """Create `log_dir/<task>/<date>_<time>`, a folder that no other run has.

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
    """Write `config.yaml`, complete, and append this start's versions, git revision and command line to `run.json`."""
    (run_dir / "config.yaml").write_text(to_yaml(config), encoding="utf-8")
    start = {
        "time": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": sys.argv,
        "device": device,
        "backend": backend,
        "processes": processes,
        **describe_code(),
    }
    file = run_dir / "run.json"
    starts = json.loads(file.read_text(encoding="utf-8"))["starts"] if file.exists() else []
    file.write_text(json.dumps({"starts": [*starts, start]}, indent=2) + "\n", encoding="utf-8")


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
