"""Typed task configuration: YAML file (and its base) -> command-line overrides -> one validated `TaskConfig`.

The dataclasses below name every field, its type, its unit and its bounds; they hold no numbers, which stand in `configs/`.
Whatever a user gets wrong is a `UserError` that names the field, the file and line (or the override) and what would be valid.
"""

import dataclasses
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml
from omegaconf import MISSING, DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from telebip import ROOT
from telebip.errors import UserError, nearest

CONFIGS = ROOT / "configs"

Leaf = tuple[str, Any, str]
"""A field of a file or override: dotted key, value, and the place to name in errors, as "file:line"."""

Schema = TypeVar("Schema")


def quantity(unit: str = "", **bounds: float) -> Any:
    """Declare a required number with its unit and bounds (`gt`, `ge`, `lt`, `le`), which hold for every entry of a tuple."""
    return field(default=MISSING, metadata={"unit": unit, "bounds": bounds})


def section(schema: type) -> Any:
    """Declare a nested section."""
    return field(default_factory=schema)


@dataclass
class SimConfig:
    robot: str = MISSING
    decimation: int = quantity(ge=1, le=1000)
    max_contacts: int = quantity(ge=1, le=10_000)
    max_constraints: int = quantity(ge=1, le=100_000)
    cuda_graph: bool = MISSING


@dataclass
class EpisodeConfig:
    length: float = quantity("s", gt=0)
    min_hip_height: float = quantity("m", ge=0)
    reset_joint_pos: float = quantity(ge=0)
    reset_joint_vel: float = quantity(ge=0)
    reset_lin_vel: float = quantity("m/s", ge=0)
    reset_ang_vel: float = quantity("rad/s", ge=0)
    reset_heading: float = quantity("rad", ge=0)


@dataclass
class ActionConfig:
    hip_roll: float = quantity("rad", gt=0)
    hip_pitch: float = quantity("rad", gt=0)
    knee: float = quantity("m | rad", gt=0)


@dataclass
class CommandConfig:
    lin_vel_x: tuple[float, float] = quantity("m/s")
    lin_vel_y: tuple[float, float] = quantity("m/s")
    ang_vel_z: tuple[float, float] = quantity("rad/s")
    resampling_time: float = quantity("s", gt=0)
    heading_gain: float = quantity("1/s", ge=0)
    heading_limit: float = quantity("rad/s", ge=0)


@dataclass
class GaitConfig:
    period: float = quantity("s", gt=0)


@dataclass
class CmdRewardConfig:
    k_xy: float = quantity()
    sigma_xy: float = quantity("m/s", gt=0)
    k_w: float = quantity()
    sigma_w: float = quantity("rad/s", gt=0)


@dataclass
class DiffRewardConfig:
    k_diff: float = quantity(le=0)


@dataclass
class TqRewardConfig:
    k_tq: float = quantity(le=0)


@dataclass
class FootRewardConfig:
    k_foot: float = quantity()
    gamma: float = quantity(gt=0, le=1)
    first: Literal["newest", "oldest"] = MISSING
    cap: float = quantity("body weights", gt=0)


@dataclass
class EnergyRewardConfig:
    k_energy: float = quantity("s/m", le=0)
    ramp: tuple[float, float] = quantity("samples", ge=0)


@dataclass
class TerminationRewardConfig:
    k_termination: float = quantity(le=0)


@dataclass
class RewardConfig:
    cmd: CmdRewardConfig = section(CmdRewardConfig)
    diff: DiffRewardConfig = section(DiffRewardConfig)
    tq: TqRewardConfig = section(TqRewardConfig)
    foot: FootRewardConfig = section(FootRewardConfig)
    energy: EnergyRewardConfig = section(EnergyRewardConfig)
    termination: TerminationRewardConfig = section(TerminationRewardConfig)
    extra: dict[str, float] = field(default_factory=dict)


@dataclass
class PushConfig:
    enabled: bool = MISSING
    force: float = quantity("N", ge=0)
    duration: float = quantity("s", gt=0)
    interval: tuple[float, float] = quantity("s", gt=0)
    ramp: tuple[float, float] = quantity("samples", ge=0)


@dataclass
class FrictionConfig:
    enabled: bool = MISSING
    range: tuple[float, float] = quantity(gt=0)


@dataclass
class NoiseConfig:
    enabled: bool = MISSING
    joint_pos: float = quantity(ge=0)
    joint_vel: float = quantity(ge=0)
    base_lin_vel: float = quantity("m/s", ge=0)
    base_ang_vel: float = quantity("rad/s", ge=0)
    base_quat: float = quantity(ge=0)


@dataclass
class DisturbanceConfig:
    push: PushConfig = section(PushConfig)
    friction: FrictionConfig = section(FrictionConfig)
    noise: NoiseConfig = section(NoiseConfig)


@dataclass
class PpoConfig:
    max_iterations: int = quantity(ge=1)
    num_steps_per_env: int = quantity(ge=1)
    num_learning_epochs: int = quantity(ge=1)
    num_mini_batches: int = quantity(ge=1)
    learning_rate: float = quantity(gt=0, le=1)
    schedule: Literal["fixed", "adaptive"] = MISSING
    desired_kl: float = quantity(gt=0)
    gamma: float = quantity(ge=0, le=1)
    lam: float = quantity(ge=0, le=1)
    clip_param: float = quantity(gt=0)
    value_loss_coef: float = quantity(ge=0)
    entropy_coef: float = quantity(ge=0)
    max_grad_norm: float = quantity(gt=0)
    hidden_dims: list[int] = quantity(ge=1)
    activation: Literal["elu", "relu", "selu", "tanh"] = MISSING
    symmetry: Literal["none", "phase"] = MISSING
    obs_normalization: bool = MISSING
    init_std: float = quantity(gt=0)
    min_std: float = quantity(gt=0)
    final_min_std: float = quantity(gt=0)
    min_std_ramp: tuple[float, float] = quantity("samples", ge=0)
    mixed_precision: Literal["auto", "always", "never"] = MISSING
    save_interval: int = quantity(ge=1)
    keep_checkpoints: int = quantity(ge=1)
    max_fault_rate: float = quantity(ge=0, le=1)


@dataclass
class TaskConfig:
    """One task: the MDP and its training. Read `configs/telebip_flat.yaml` for values and explanations."""

    seed: int = quantity(ge=0, le=2**32 - 1)
    num_envs: int = quantity(ge=1, le=2**24)
    sim: SimConfig = section(SimConfig)
    episode: EpisodeConfig = section(EpisodeConfig)
    action: ActionConfig = section(ActionConfig)
    command: CommandConfig = section(CommandConfig)
    gait: GaitConfig = section(GaitConfig)
    reward: RewardConfig = section(RewardConfig)
    disturbance: DisturbanceConfig = section(DisturbanceConfig)
    ppo: PpoConfig = section(PpoConfig)


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
        _apply(config, [(key, parsed, where)], origins)
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
    path = _task_path(task, named_at)
    if path in below:
        raise UserError(f"{named_at}base '{task}' leads back to itself")
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"{named_at}{_shown(path)}: {error}") from error
    leaves = [_from_its_folder(leaf, path) for leaf in _parse_yaml(text, _shown(path))]
    for key, value, where in leaves:
        if key == "base":
            if not isinstance(value, str):
                raise UserError(f"{where}: base must be the name of a task")
            own = [leaf for leaf in leaves if leaf[0] != "base"]
            return [*_layers(value, f"{where}: ", (*below, path)), own]
    return [leaves]


def _from_its_folder(leaf: Leaf, file: Path) -> Leaf:
    """Let a task file name the robot that lies beside it, whatever the working directory."""
    key, value, where = leaf
    if key == "sim.robot" and isinstance(value, str) and (file.parent / value).is_file():
        return key, str((file.parent / value).resolve()), where
    return leaf


def _task_path(task: str, named_at: str) -> Path:
    is_file = task.endswith((".yaml", ".yml"))
    path = Path(task) if is_file else CONFIGS / f"{task}.yaml"
    try:
        if path.is_file():
            return path
    except (OSError, ValueError):
        pass  # no such file: the name is too long, or holds what no name can hold
    if is_file:
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
