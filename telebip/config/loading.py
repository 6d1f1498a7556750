"""From YAML files and overrides to a validated configuration, and back to text."""

import dataclasses
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml

from telebip import ROOT
from telebip.config.schema import TaskConfig
from telebip.config.tree import Dumper, Entry, Tree, entry_of, merge, plain, read
from telebip.config.validation import KINDS, Validator
from telebip.errors import UserError, nearest
from telebip.files import is_file

CONFIGS = ROOT / "configs"
FOLDERS = (CONFIGS, CONFIGS / "study")  # of the tasks that have names; those in the second one are of the study alone

Schema = TypeVar("Schema")


def load_task(task: str | TaskConfig, overrides: Sequence[str] = ()) -> TaskConfig:
    """Read a task by name or by path to a YAML file (or take a loaded one), apply `key.path=value` overrides, and validate it.

    Raises:
        UserError: unknown task, unreadable file, unknown or missing field, wrong type or a value out of bounds.
    """
    return load(TaskConfig, task, overrides)


def check(config: TaskConfig) -> TaskConfig:
    """Return a task that was made or changed in code, validated, and with the default values of the terms' parameters.

    Raises:
        UserError: it names the field, as `load_task` does.
    """
    return load(TaskConfig, config)


def load(schema: type[Schema], source: str | Schema, overrides: Sequence[str] = ()) -> Schema:
    """Do what `load_task` does for any dataclass of annotated fields; names are those of files in `configs/`."""
    if isinstance(source, str):
        tree, name = _read_task(source), source
    else:
        tree, name = entry_of(plain(source), "configuration").value, "configuration"
    for override in overrides:
        key, layer = _read_override(override)
        tree = merge(tree, layer, _is_group if key.count(".") < 2 else lambda _: False)  # a deeper key changes a group
    return Validator().section(schema, Entry(tree, name))


def parse_config(text: str, source: str, missing: list[str] | None = None) -> TaskConfig:
    """Rebuild a configuration from `to_yaml`'s text, as checkpoints and run folders hold it; `source` names it in errors.

    Fields that are younger than the text have the values of `telebip_flat`, which enters each with one that changes nothing;
    terms and names are the text's own. Terms whose function is not known here are errors, or `missing` takes their dotted
    names and they are left out; those of `observations.policy` are always errors.
    """
    sections = {f.name for f in dataclasses.fields(TaskConfig) if dataclasses.is_dataclass(f.type)}
    base = {name: entry for name, entry in _read_task("telebip_flat").items() if name not in {"observations", *KINDS}}
    tree = merge(base, _section(read(text, source), source), lambda key: key not in sections)
    return Validator(missing).section(TaskConfig, Entry(tree, source))


def to_yaml(config: Any) -> str:
    """Return the whole configuration as YAML text, complete without a base."""
    return yaml.dump(plain(config), Dumper=Dumper, sort_keys=False)


def task_names() -> list[str]:
    """Return the names of the tasks; `--task` accepts those of `study_names` too."""
    return sorted(path.stem for path in FOLDERS[0].glob("*.yaml"))


def study_names() -> list[str]:
    """Return the names of the tasks that the study alone is about: ablations."""
    return sorted(path.stem for path in FOLDERS[1].glob("*.yaml"))


def _read_task(task: str, named_at: str = "", below: tuple[Path, ...] = ()) -> Tree:
    """Return a task's file, laid over the bases it builds on."""
    path = _task_path(task, named_at, *(file.parent for file in below[-1:]))
    if path in below:
        raise UserError(f"{named_at}base '{task}' leads back to itself")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{named_at}{_shown(path)}: {error}") from error
    tree = _section(read(text, _shown(path)), _shown(path))
    folders = [path.parent, Path()] if path.parent not in FOLDERS else [path.parent]
    tree = _with_robot_found(tree, *folders)
    base = tree.pop("base", None)
    if base is None:
        return tree
    if not isinstance(base.value, str):
        raise UserError(f"{base.where}: base must be the name of a task")
    return merge(_read_task(base.value, f"{base.where}: ", (*below, path)), tree, _is_group)


def _is_group(key: str) -> bool:
    """Whether a dotted key names a group of observations: its order matters, so a task states it as a whole."""
    return key.startswith("observations.") and key.count(".") == 1


def _read_override(override: str) -> tuple[str, Tree]:
    """Return an override's key, and a tree that holds nothing else."""
    key, equals, value = override.partition("=")
    where = f"override '{override}'"
    if not equals or not re.fullmatch(r"\w+(\.\w+)*", key):
        raise UserError(f"{where} is not of the form key.path=value")
    entry = read(value, where, line_by_line=False)
    for name in reversed(key.split(".")):
        entry = Entry({name: entry}, where)
    return key, _with_robot_found(entry.value, Path())


def _with_robot_found(tree: Tree, *folders: Path) -> Tree:
    """Make the path of a robot of one's own absolute, so that it is found again from any working directory."""
    sim = tree.get("sim")
    robot = sim.value.get("robot") if sim and sim.is_section else None
    if sim and robot and isinstance(robot.value, str):
        for file in (folder / robot.value for folder in folders):
            if is_file(file) and file.resolve() != (ROOT / robot.value).resolve():
                found = Entry(str(file.resolve()), robot.where)
                return {**tree, "sim": Entry({**sim.value, "robot": found}, sim.where)}
    return tree


def _task_path(task: str, named_at: str, *folders: Path) -> Path:
    """Return a task's file: a name's in `FOLDERS`, a path's from the first of `folders` or the working directory."""
    names_file = task.endswith((".yaml", ".yml"))
    paths = [folder / task for folder in (*folders, Path())] if names_file else [folder / f"{task}.yaml" for folder in FOLDERS]
    if path := next(filter(is_file, paths), None):
        return path
    if names_file:
        raise UserError(f"{named_at}task file '{task}' does not exist")
    raise UserError(f"{named_at}unknown task '{task}'; {nearest(task, [*task_names(), *study_names()])}")


def _section(entry: Entry, source: str) -> Tree:
    """Return the entries of a file."""
    if entry.value is not None and not entry.is_section:
        raise UserError(f"{source}: a task is a mapping of fields to values")
    return entry.value or {}


def _shown(path: Path) -> str:
    return str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else str(path)
