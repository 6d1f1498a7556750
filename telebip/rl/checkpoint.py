"""Checkpoints: self-contained archives (`telebip.archive`) of data: loading one never runs code.

A policy exported to ONNX is read as a checkpoint too: one that can be walked, but not resumed.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from telebip import ROOT
from telebip.archive import DamagedArchiveError, load_archive, save_archive
from telebip.config import TaskConfig, parse_config, to_yaml
from telebip.errors import UserError
from telebip.files import is_file, is_folder
from telebip.rl.layout import Image, Layout
from telebip.rl.onnx import OnnxPolicy
from telebip.robot_record import is_record

FORMAT = "telebip-checkpoint-2"
POLICIES = ROOT / "assets" / "policies"
CONTENT = {
    **{"task": str, "config": str, "iteration": int, "samples": int, "observations": dict, "joint_names": list},
    **{"joint_mirror": (tuple, str), "actor_state_dict": dict, "training": list, "robot": dict},
}
"""What a checkpoint file holds; the last two, not all of them do."""


@dataclass(frozen=True)
class Checkpoint:
    """What a checkpoint file holds; `learner` has the optimiser and the critic too, unless it was saved for inference."""

    path: Path
    task: str
    config: TaskConfig
    iteration: int  # finished iterations
    samples: int  # environment steps seen in training
    observations: Layout  # what the networks see
    joint_names: list[str]  # what the actions move
    joint_mirror: Image | str  # how those joints are mirrored, or why they cannot be
    learner: dict[str, Any]  # state dictionaries as `rsl_rl.algorithms.PPO.save` returns them; none in an ONNX file
    training: list[dict[str, Any]]  # of each process: its worlds, generators and statistics; none where a policy is alone
    robot: dict[str, Any]  # record of the robot trained on, see `telebip.robot_record`; checkpoints of before have none
    missing: tuple[str, ...] = ()  # terms of the task that this process does not know, as "rewards.level"
    damaged: tuple[str, ...] = ()  # newer checkpoints of the same folder that could not be read: why, a line each
    beside: tuple[int, ...] = ()  # iterations of all checkpoints that its folder had when it was loaded

    @property
    def policy_weights(self) -> dict[str, Any]:
        """The actor's weights to walk with: their average over the latest iterations, where the training has one."""
        return self.learner.get("average_state_dict", self.learner["actor_state_dict"])

    @property
    def robot_record(self) -> dict[str, Any]:
        """The record of the robot trained on, or no more of it than joints and decimation; see `telebip.robot_record`."""
        known = self.robot if is_record(self.robot) else {"decimation": self.config.sim.decimation}
        return {**known, "joint_names": self.joint_names}

    @property
    def is_onnx(self) -> bool:
        """Whether the file holds a policy exported to ONNX."""
        return self.path.suffix == ".onnx"


def save_checkpoint(checkpoint: Checkpoint) -> None:
    """Write a checkpoint to its `path`: complete, or not at all.

    Raises:
        OSError: it cannot be written.
    """
    own = {name: getattr(checkpoint, name) for name in CONTENT if name not in ("config", "actor_state_dict")}
    save_archive(checkpoint.path, {"format": FORMAT, "config": to_yaml(checkpoint.config), **own, **checkpoint.learner})


def prune_checkpoints(run_dir: Path, keep: int) -> None:
    """Delete all but the `keep` newest of a run folder's `model_<iteration>.pt`."""
    for file in [*_numbered(run_dir).values()][keep:]:
        file.unlink(missing_ok=True)


def require_unchanged(run_dir: Path, checkpoint: Checkpoint | None) -> None:
    """Refuse to go on in a folder that another process has trained in since `checkpoint` was loaded from it, or not found.

    Raises:
        UserError: it has.
    """
    new = _numbered(run_dir).keys() - set(checkpoint.beside if checkpoint else ())
    if new:
        raise UserError(f"another process has trained in '{run_dir}' meanwhile, up to iteration {max(new)}; start again")


def set_aside_newer(run_dir: Path, iteration: int) -> list[Path]:
    """Move a run folder's checkpoints from after `iteration` to its folder `set_aside`, and return where they are now.

    Where that has some of their names already, they go to `set_aside_2`, and so on: nothing is overwritten. A run that goes on
    from an earlier checkpoint is another one from there on; "the newest" must mean its own.

    Raises:
        UserError: they cannot be moved.
    """
    newer = [file for number, file in _numbered(run_dir).items() if number > iteration]
    folders = (run_dir / name for name in ("set_aside", *(f"set_aside_{i}" for i in range(2, 1000))))
    folder = next(folder for folder in folders if not any((folder / file.name).exists() for file in newer))
    try:
        if newer:
            folder.mkdir(exist_ok=True)
        return [file.replace(folder / file.name) for file in newer]
    except OSError as error:
        raise UserError(f"cannot write to run folder '{run_dir}': {error.strerror or error}") from error


def load_checkpoint(path: str | Path) -> Checkpoint:
    """Load a checkpoint file (.pt or .onnx), or the newest one of a run folder that is not damaged.

    Args:
        path: from the working directory, from telebip's own folder, or the name of a policy that comes with telebip.

    Raises:
        UserError: there is none, it is damaged or unsafe, of another format, or its policy sees a term that is unknown here.
    """
    damaged: list[str] = []
    beside = tuple(_numbered(_find(Path(path))[0].resolve().parent))
    candidates = _find(Path(path))  # after that, so that a checkpoint written meanwhile is noticed
    for file in candidates:
        try:
            checkpoint = _load_onnx(file) if file.suffix == ".onnx" else _load_file(file)
            return replace(checkpoint, damaged=tuple(damaged), beside=beside)
        except DamagedArchiveError as error:
            if len(candidates) == 1:
                raise
            damaged.append(str(error))
    raise UserError(f"folder '{path}' holds {len(candidates)} checkpoints, all damaged: {damaged[0]}")


def _load_file(file: Path) -> Checkpoint:
    content = load_archive(file, "checkpoint", FORMAT)
    absent = CONTENT.keys() - content.keys() - {"training", "robot"}
    if absent:
        raise UserError(f"checkpoint '{file}' is not complete: it lacks {', '.join(sorted(absent))}")
    content = {"training": [], "robot": {}, **content}
    for name, kind in CONTENT.items():
        if not isinstance(content[name], kind):
            expected = kind.__name__ if isinstance(kind, type) else " or ".join(one.__name__ for one in kind)
            raise UserError(f"checkpoint '{file}' is not a telebip checkpoint: its {name} is no {expected}")
    if "policy" not in content["observations"]:
        raise UserError(f"checkpoint '{file}' is not complete: its observations lack the group 'policy'")
    missing: list[str] = []
    config = parse_config(content["config"], f"{file}:config", missing)
    own = {name: content[name] for name in CONTENT if name not in ("config", "actor_state_dict")}
    learner = {key: value for key, value in content.items() if key.endswith("_state_dict")}
    return Checkpoint(file, config=config, learner=learner, missing=tuple(missing), **own)


def _load_onnx(file: Path) -> Checkpoint:
    about, missing = OnnxPolicy(file).metadata, []
    return Checkpoint(
        path=file,
        task=about["task"],
        config=parse_config(about["config"], f"{file}:config", missing),
        iteration=about["iteration"],
        samples=about["samples"],
        observations={"policy": about["observation"]},
        joint_names=about["joint_names"],
        joint_mirror="its mirror is inside of the ONNX file",
        learner={},
        training=[],
        robot=about.get("robot", {}),
        missing=tuple(missing),
    )


def _find(given: Path) -> list[Path]:
    """Return the files that a path stands for, the best one first."""
    paths = [path for path in (given, ROOT / given, POLICIES / given) if is_file(path) or is_folder(path)]
    for path in paths:
        policy = path / "policy.pt"
        if files := [path] if is_file(path) else [*_numbered(path).values()] or [policy] * is_file(policy):
            return files
    if paths:
        raise UserError(f"folder '{paths[0]}' holds no checkpoint (model_<iteration>.pt or policy.pt)")
    shipped = ", ".join(sorted(folder.name for folder in POLICIES.glob("*")))
    raise UserError(f"checkpoint '{given}' does not exist; policies that come with telebip: {shipped}")


def checkpoints_in(run_dir: Path) -> list[Path]:
    """Return a folder's checkpoints: `model_<iteration>.pt`, the newest first, and `policy.pt`, as far as they are there."""
    return [*_numbered(run_dir).values(), *run_dir.glob("policy.pt")]


def _numbered(run_dir: Path) -> dict[int, Path]:
    """Return a run folder's `model_<iteration>.pt` by their iterations, the newest first."""
    files = {int(m[1]): file for file in run_dir.glob("model_*.pt") if (m := re.fullmatch(r"model_(\d+)\.pt", file.name))}
    return dict(sorted(files.items(), reverse=True))
