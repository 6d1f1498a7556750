"""From YAML files and overrides to a validated configuration, and back to text."""

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from telebip import ROOT
from telebip.config.schema import TaskConfig
from telebip.errors import UserError, nearest
from telebip.files import is_file

CONFIGS = ROOT / "configs"

Leaf = tuple[str, Any, str]
"""A field of a file or override: dotted key, value, and the place to name in errors, as "file:line"."""

Schema = TypeVar("Schema")


def load_task(task: str | TaskConfig, overrides: Sequence[str] = ()) -> TaskConfig:
    """Read a task by name or by path to a YAML file (or take a loaded one), apply `key.path=value` overrides, and validate it.

    Raises:
        UserError: unknown task, unreadable file, unknown or missing field, wrong type or a value out of bounds.
    """
    return load(TaskConfig, task, overrides)


def load(schema: type[Schema], source: str | Schema, overrides: Sequence[str] = ()) -> Schema:
    """Do what `load_task` does for any dataclass of `quantity` and `section` fields; names are those of files in `configs/`."""
    origins: dict[str, str] = {}
    if isinstance(source, str):
        config, name = OmegaConf.structured(schema), source
        for leaves in _layers(source):
            _apply(config, leaves, origins)
    else:
        config, name = OmegaConf.structured(source), "configuration"
    for override in overrides:
        key, equals, value = override.partition("=")
        where = f"override '{override}'"
        if not equals or not re.fullmatch(r"\w+(\.\w+)*", key):
            raise UserError(f"{where} is not of the form key.path=value")
        _, parsed = _load_yaml(value, where)
        _apply(config, [_with_robot_found((key, parsed, where), Path())], origins)
    return _validate(config, origins, name)


def parse_config(text: str, source: str) -> TaskConfig:
    """Rebuild a configuration from `to_yaml`'s text, as checkpoints and run folders hold it; `source` names it in errors.

    Fields that are younger than the text have the values of `telebip_flat`, which enters each with one that changes nothing.
    """
    config, origins = OmegaConf.structured(TaskConfig), {}
    for leaves in (*_layers("telebip_flat"), _parse_yaml(text, source)):
        _apply(config, leaves, origins)
    return _validate(config, origins, source)


def to_yaml(config: TaskConfig) -> str:
    """Return the whole configuration as YAML text, complete without a base."""
    return OmegaConf.to_yaml(OmegaConf.structured(config))


def task_names() -> list[str]:
    """Return the names that `--task` accepts."""
    return sorted(path.stem for path in CONFIGS.glob("*.yaml"))


def _layers(task: str, named_at: str = "", below: tuple[Path, ...] = ()) -> list[list[Leaf]]:
    """Return the leaves of a task's file and, before them, of the bases it builds on."""
    path = _task_path(task, named_at, *(file.parent for file in below[-1:]))
    if path in below:
        raise UserError(f"{named_at}base '{task}' leads back to itself")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{named_at}{_shown(path)}: {error}") from error
    folders = [path.parent, Path()] if path.parent != CONFIGS else [path.parent]
    leaves = [_with_robot_found(leaf, *folders) for leaf in _parse_yaml(text, _shown(path))]
    for key, value, where in leaves:
        if key == "base":
            if not isinstance(value, str):
                raise UserError(f"{where}: base must be the name of a task")
            own = [leaf for leaf in leaves if leaf[0] != "base"]
            return [*_layers(value, f"{where}: ", (*below, path)), own]
    return [leaves]


def _with_robot_found(leaf: Leaf, *folders: Path) -> Leaf:
    """Make the path of a robot of one's own absolute, so that it is found again from any working directory."""
    key, value, where = leaf
    if key == "sim.robot" and isinstance(value, str):
        for file in (folder / value for folder in folders):
            if is_file(file) and file.resolve() != (ROOT / value).resolve():
                return key, str(file.resolve()), where
    return leaf


def _task_path(task: str, named_at: str, *folders: Path) -> Path:
    """Return a task's file: a name's in `configs/`, a path's from the first of `folders` or the working directory."""
    names_file = task.endswith((".yaml", ".yml"))
    paths = [folder / task for folder in (*folders, Path())] if names_file else [CONFIGS / f"{task}.yaml"]
    if path := next(filter(is_file, paths), None):
        return path
    if names_file:
        raise UserError(f"{named_at}task file '{task}' does not exist")
    raise UserError(f"{named_at}unknown task '{task}'; {nearest(task, task_names())}")


def _parse_yaml(text: str, source: str) -> list[Leaf]:
    """Return the leaves of a YAML mapping."""
    tree, values = _load_yaml(text, source)
    if values is None:
        return []
    if not isinstance(tree, yaml.MappingNode):
        raise UserError(f"{source}: a task is a mapping of fields to values")
    try:
        return list(_leaves(tree, values, source))
    except RecursionError as error:  # an alias inside of what it stands for
        raise UserError(f"{source}: a section contains itself") from error


def _load_yaml(text: str, source: str) -> tuple[Any, Any]:
    """Return YAML text as nodes, which know their lines, and as values."""
    try:
        return yaml.compose(text, Loader=yaml.SafeLoader), yaml.safe_load(text)
    except Exception as error:  # PyYAML lets more than YAMLError escape, as from `!!int x`
        raise UserError(f"{source}: not valid YAML: {error}") from error


def _leaves(node: Any, values: Any, source: str, prefix: str = "") -> Iterator[Leaf]:
    names = set()
    for key_node, value_node in node.value:
        key, where = str(key_node.value), f"{source}:{key_node.start_mark.line + 1}"
        if key in names:
            raise UserError(f"{where}: field '{prefix}{key}' stands there twice")
        names.add(key)
        value = values.get(key) if isinstance(values, dict) else None
        if isinstance(value, dict) and value and isinstance(value_node, yaml.MappingNode):
            yield from _leaves(value_node, value, source, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value, where


def _apply(config: DictConfig, leaves: list[Leaf], origins: dict[str, str]) -> None:
    """Set the leaves one by one, so that an error knows its place; remember where each came from."""
    for key, value, where in leaves:
        schema = _schema_of(OmegaConf.get_type(config), key, where)
        if dataclasses.is_dataclass(schema):
            names = ", ".join(f.name for f in dataclasses.fields(schema))
            raise UserError(f"{where}: {key} is a section; set one of its fields: {names}")
        try:
            if "${" in str(value):
                raise ValueError("OmegaConf would look the value up elsewhere")
            OmegaConf.update(config, key, value, merge=False)
        except (OmegaConfBaseException, OverflowError, ValueError, TypeError) as error:
            raise UserError(f"{where}: {key}: {_describe(value)} is not {_type_name(schema)}") from error
        origins[key] = where


def _schema_of(schema: Any, key: str, where: str) -> Any:
    """Return the type of a dotted key, or raise the error that names the nearest valid one."""
    walked = ""
    for name in key.split("."):
        if schema == dict[str, float]:  # names of the user's own
            schema, walked = float, f"{walked}{name}."
            continue
        fields = {f.name: f for f in dataclasses.fields(schema)} if dataclasses.is_dataclass(schema) else {}
        if name not in fields:
            raise UserError(
                f"{where}: unknown field '{key}'; "
                + (nearest(walked + name, [walked + f for f in fields]) if fields else f"'{walked[:-1]}' is a value")
            )
        schema, walked = fields[name].type, f"{walked}{name}."
    return schema


def _type_name(schema: Any) -> str:
    names = {float: "a number", int: "a whole number", bool: "true or false", str: "a text"}
    if schema in names:
        return names[schema]
    if schema == dict[str, float]:
        return "a mapping of names to numbers"
    text = str(schema)
    if "Literal" in text:
        return "one of " + ", ".join(schema.__args__)
    return "a pair [low, high] of numbers" if "tuple" in text else "a list of whole numbers"


def _describe(value: Any) -> str:
    text = repr(value) if isinstance(value, str) else str(value)
    return text if len(text) <= 40 else text[:37] + "..."


def _validate(config: DictConfig, origins: dict[str, str], source: str) -> Any:
    missing = OmegaConf.missing_keys(config)
    if missing:
        raise UserError(f"{source}: field '{min(missing)}' has no value")
    values = OmegaConf.to_object(config)
    for key, value, meta in _values(values):
        where = origins.get(key, source)
        for entry in value if isinstance(value, tuple | list) else [value]:
            if isinstance(entry, float) and not math.isfinite(entry):
                raise UserError(f"{where}: {key} must be finite, got {entry}")
            for bound, limit in meta.get("bounds", {}).items():
                sign, holds = _BOUNDS[bound]
                if not holds(entry, limit):
                    raise UserError(
                        f"{where}: {key} must be {sign} {limit}{' ' + meta['unit'] if meta['unit'] else ''}, got {entry}"
                    )
        if isinstance(value, tuple) and value[0] > value[1]:
            raise UserError(f"{where}: {key} must be [low, high], got [{value[0]}, {value[1]}]")
        if value == []:
            raise UserError(f"{where}: {key} must not be empty")
    return values


_BOUNDS = {
    "gt": (">", lambda value, limit: value > limit),
    "ge": (">=", lambda value, limit: value >= limit),
    "lt": ("<", lambda value, limit: value < limit),
    "le": ("<=", lambda value, limit: value <= limit),
}


def _values(node: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """Yield (dotted key, value, metadata) of every leaf of a dataclass."""
    for f in dataclasses.fields(node):
        value = getattr(node, f.name)
        if dataclasses.is_dataclass(value):
            yield from _values(value, f"{prefix}{f.name}.")
        else:
            entries = value if isinstance(value, dict) else {"": value}
            yield from ((f"{prefix}{f.name}.{name}".rstrip("."), entry, f.metadata) for name, entry in entries.items())


def _shown(path: Path) -> str:
    return str(path.relative_to(ROOT)) if path.is_relative_to(ROOT) else str(path)
