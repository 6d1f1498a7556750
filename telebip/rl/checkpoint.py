"""Checkpoints: self-contained, written atomically, and data only (`weights_only=True`): loading one never runs code.

A policy exported to ONNX is read as a checkpoint too: one that can be walked, but not resumed.
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from telebip import ROOT
from telebip.config import TaskConfig, parse_config, to_yaml
from telebip.errors import UserError
from telebip.mdp.observations import LAYOUT
from telebip.rl.onnx import OnnxPolicy
from telebip.robot import JOINTS

FORMAT = "telebip-checkpoint-1"
POLICIES = ROOT / "assets" / "policies"


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds; `learner` has the optimiser and the critic too, unless it was saved for inference."""

    path: Path
    task: str
    config: TaskConfig
    iteration: int  # finished iterations
    samples: int  # environment steps seen in training
    learner: dict[str, Any]  # state dictionaries as `rsl_rl.algorithms.PPO.save` returns them; none in an ONNX file

    @property
    def is_onnx(self) -> bool:
        """Whether the file holds a policy exported to ONNX."""
        return self.path.suffix == ".onnx"


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
    """Load a checkpoint file (.pt or .onnx), or the newest one of a run folder.

    Args:
        path: from the working directory, from telebip's own folder, or the name of a policy that comes with telebip.

    Raises:
        UserError: there is none, it is damaged or unsafe, or its observations or actions are laid out differently.
    """
    file = _find(Path(path))
    if file.suffix == ".onnx":
        return _load_onnx(file)
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
    _check_layout(file, content["observation"], content["action"])
    learner = {key: value for key, value in content.items() if key.endswith("_state_dict")}
    config = parse_config(content["config"], f"{file}:config")
    return Checkpoint(file, content["task"], config, content["iteration"], content["samples"], learner)


def _load_onnx(file: Path) -> Checkpoint:
    metadata = OnnxPolicy(file).metadata
    _check_layout(file, {part["name"]: part["size"] for part in metadata["observation"]}, metadata["joint_names"])
    config = parse_config(metadata["config"], f"{file}:config")
    return Checkpoint(file, metadata["task"], config, metadata["iteration"], metadata["samples"], learner={})


def _check_layout(file: Path, observation: dict[str, int], action: list[str]) -> None:
    for part, found, expected in (("observation", observation, LAYOUT), ("action", action, list(JOINTS))):
        if found != expected:
            raise UserError(f"checkpoint '{file}': its {part} layout {found} differs from this version's {expected}")


def _find(given: Path) -> Path:
    path = next((p for p in (given, ROOT / given, POLICIES / given) if p.exists()), given)
    if path.is_file():
        return path
    if not path.exists():
        shipped = ", ".join(sorted(folder.name for folder in POLICIES.glob("*")))
        raise UserError(f"checkpoint '{path}' does not exist; policies that come with telebip: {shipped}")
    numbered = {int(m[1]): file for file in path.glob("model_*.pt") if (m := re.fullmatch(r"model_(\d+)\.pt", file.name))}
    if numbered:
        return numbered[max(numbered)]
    if (path / "policy.pt").is_file():
        return path / "policy.pt"
    raise UserError(f"folder '{path}' holds no checkpoint (model_<iteration>.pt or policy.pt)")
