"""A run as it is shipped: the policy and how it came about, without anything of the machine that trained it."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path

from telebip.archive import load_archive
from telebip.errors import UserError
from telebip.rl.checkpoint import FORMAT
from telebip.rl.run import read_starts

FILES = ("policy.pt", "config.yaml", "learning.csv")


def ship(run_dir: Path, folder: Path, command: Sequence[str]) -> None:
    """Copy a finished run's policy, configuration, learning curve and `run.json` to `folder`.

    Args:
        run_dir: the run's folder.
        folder: where they go; what it holds under these names is replaced.
        command: what trains the same policy again; it takes the place of the commands, with their paths, that were typed.

    Raises:
        UserError: a file is missing or damaged, holds an absolute path, or cannot be written.
    """
    starts = [{**start, "command": list(command)} for start in read_starts(run_dir)]
    about = json.dumps({"starts": starts}, indent=2) + "\n"
    try:
        config = (run_dir / "config.yaml").read_text(encoding="utf-8")
        inside = str(load_archive(run_dir / "policy.pt", "checkpoint", FORMAT)["config"])
        for name, text in (("run.json", about), ("config.yaml", config), ("policy.pt", inside)):
            if path := _absolute_path(text):
                raise UserError(f"{run_dir / name} holds the path '{path}' of this machine; train with paths inside of telebip")
        folder.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            shutil.copyfile(run_dir / name, folder / name)
        (folder / "run.json").write_text(about, encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot ship '{run_dir}' to '{folder}': {error}") from error


def _absolute_path(text: str) -> str | None:
    """Return a word of a text that is an absolute path, if there is one."""
    words = (word.strip("\"',[]") for word in text.split())
    return next((word for word in words if len(word) > 1 and Path(word).is_absolute()), None)
