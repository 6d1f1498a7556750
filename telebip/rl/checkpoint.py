"""Checkpoints: self-contained, written atomically, and data only (`weights_only=True`): loading one never runs code."""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from telebip.config import TaskConfig, parse_config, to_yaml
from telebip.errors import UserError
from telebip.mdp.observations import LAYOUT
from telebip.robot import JOINTS

FORMAT = "telebip-checkpoint-1"


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds; `learner` has the optimiser and the critic too, unless it was saved for inference."""

    path: Path
    task: str
    config: TaskConfig
    iteration: int  # finished iterations
    samples: int  # environment steps seen in training
    learner: dict[str, Any]  # state dictionaries as `rsl_rl.algorithms.PPO.save` returns them


def save_checkpoint(path: Path, task: str, config: TaskConfig, iteration: int, samples: int, learner: dict[str, Any]) -> None:
    """Write a checkpoint to `path`: complete, or not at all."""
    content = {
        "format": FORMAT,
        "task": task,
        "config": to_yaml(config),
        "observation": LAYOUT,
        "action": list(JOINTS),
        "iteration": iteration,
        "samples": samples,
        **learner,
    }
    partial = path.with_suffix(".partial")
    torch.save(content, partial)
    os.replace(partial, path)


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Load a checkpoint file, or the newest one of a run folder.

    Raises:
        UserError: there is none, it is damaged or unsafe, or its observations or actions are laid out differently.
    """
    file = _find(Path(path))
    try:
        content = torch.load(file, map_location="cpu", weights_only=True)
    except OSError as error:
        raise UserError(f"checkpoint '{file}' cannot be read: {error.strerror or error}") from error
    except Exception as error:  # bytes that are no checkpoint fail in as many ways as there are bytes
        raise UserError(f"checkpoint '{file}' is not a telebip checkpoint: it is damaged, or holds more than data") from error
    if not isinstance(content, dict) or "format" not in content:
        raise UserError(f"checkpoint '{file}' is not a telebip checkpoint")
    if content["format"] != FORMAT:
        raise UserError(f"checkpoint '{file}' has format '{content['format']}', this version reads '{FORMAT}'")
    missing = {"task", "config", "observation", "action", "iteration", "samples", "actor_state_dict"} - content.keys()
    if missing:
        raise UserError(f"checkpoint '{file}' is not complete: it lacks {', '.join(sorted(missing))}")
    for part, expected in (("observation", LAYOUT), ("action", list(JOINTS))):
        if content[part] != expected:
            raise UserError(f"checkpoint '{file}': its {part} layout {content[part]} differs from this version's {expected}")
    learner = {key: value for key, value in content.items() if key.endswith("_state_dict")}
    config = parse_config(content["config"], f"{file}:config")
    return Checkpoint(file, content["task"], config, content["iteration"], content["samples"], learner)


def _find(path: Path) -> Path:
    if path.is_file():
        return path
    if not path.exists():
        raise UserError(f"checkpoint '{path}' does not exist")
    numbered = {int(m[1]): file for file in path.glob("model_*.pt") if (m := re.fullmatch(r"model_(\d+)\.pt", file.name))}
    if numbered:
        return numbered[max(numbered)]
    if (path / "policy.pt").is_file():
        return path / "policy.pt"
    raise UserError(f"folder '{path}' holds no checkpoint (model_<iteration>.pt or policy.pt)")
