# pyright: reportAttributeAccessIssue=false
"""What is kept of a robot beside what was trained or measured on it, and in what another robot differs.

A record is plain data, as checkpoints and ONNX files hold it:

    joint_names  the joints that actions move, in their order
    decimation   physics steps of a policy step
    values       quantity -> part -> numbers, see `QUANTITIES`
    fields       field of the compiled model -> digest of all its numbers
    digest       of the compiled model, and `mujoco`, the version that compiled it
"""

import hashlib
from collections.abc import Mapping
from operator import attrgetter
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco.batch import MODEL_FIELDS
from numpy.typing import NDArray

from telebip.robot import Robot

Record = Mapping[str, Any]


class Quantity(NamedTuple):
    """One thing that is told of each part of a kind."""

    name: str  # with its unit
    kind: str  # of its parts: body, joint, dof, actuator, geom or site
    field: str  # of MuJoCo's model
    columns: slice = slice(None)
    scale: float = 1.0


QUANTITIES = (
    Quantity("kind of joint (2 slides, 3 turns)", "joint", "jnt_type"),
    Quantity("axis", "joint", "jnt_axis"),
    Quantity("range [rad | m]", "joint", "jnt_range"),
    Quantity("spring [N m/rad | N/m]", "joint", "jnt_stiffness"),
    Quantity("passive damping [N m s/rad | N s/m]", "dof", "dof_damping"),
    Quantity("dry friction [N m | N]", "dof", "dof_frictionloss"),
    Quantity("armature [kg m^2 | kg]", "dof", "dof_armature"),
    Quantity("stiffness kp [N m/rad | N/m]", "actuator", "actuator_gainprm", slice(0, 1)),
    Quantity("damping kv [N m s/rad | N s/m]", "actuator", "actuator_biasprm", slice(2, 3), -1.0),
    Quantity("force limits [N m | N]", "actuator", "actuator_forcerange"),
    Quantity("control limits [rad | m]", "actuator", "actuator_ctrlrange"),
    Quantity("gear", "actuator", "actuator_gear", slice(0, 1)),
    Quantity("time constant [s]", "actuator", "actuator_dynprm", slice(0, 1)),
    Quantity("delay [s]", "actuator", "actuator_delay"),
    Quantity("mass [kg]", "body", "body_mass"),
    Quantity("inertia [kg m^2]", "body", "body_inertia"),
    Quantity("place in its parent [m]", "body", "body_pos"),
    Quantity("orientation in its parent", "body", "body_quat"),
    Quantity("centre of mass [m]", "body", "body_ipos"),
    Quantity("size [m]", "geom", "geom_size"),
    Quantity("place in its body [m]", "geom", "geom_pos"),
    Quantity("friction", "geom", "geom_friction"),
    Quantity("size of site [m]", "site", "site_size"),
    Quantity("place of site [m]", "site", "site_pos"),
)
"""What tells robots apart, in words; all else by its field in MuJoCo's model."""

PARTS = {"joint": "axis", "body": "mass [kg]", "geom": "size [m]", "site": "size of site [m]"}
"""Kinds of parts, and a quantity that each of them has."""

OPTIONS = {
    "physics step [s]": "opt.timestep",
    "gravity [m/s^2]": "opt.gravity",
    "integrator": "opt.integrator",
    "solver": "opt.solver",
    "cone": "opt.cone",
    "iterations": "opt.iterations",
}
"""What is told of the whole model."""

SEEN_ONLY = ("cam_", "light_", "mat_", "tex_", "name", "key_", "skin", "text", "bvh", "numeric", "tuple", "sensor_")
SEEN_ONLY_ENDS = ("rgba", "_group", "_user", "matid", "bvhadr", "bvhnum")
"""Fields that move nothing: how it looks, what it is called, what is measured."""

SHOWN = 3  # parts of a difference that are named


def describe_robot(robot: Robot, decimation: int) -> dict[str, Any]:
    """Return the record of a robot whose policy step has `decimation` physics steps; the terrain is no part of it."""
    model = robot.on(None).engine_model()
    values = {quantity.name: _values(model, quantity, robot.joint_names) for quantity in QUANTITIES}
    whole = {name: {"": _numbers(attrgetter(field)(model))} for name, field in OPTIONS.items()}
    home = {"home position [rad | m]": dict(zip(robot.joint_names, map(_numbers, robot.nominal), strict=True))}
    home |= {"home height [m] and orientation": {"trunk": _numbers(robot.home_qpos[2:7])}}
    fields = {field: digest for field in sorted(_moving()) if (digest := _digest(attrgetter(field)(model)))}
    told = "".join(f"{field}:{fields[field]}\n" for field in fields) + repr((robot.joint_names, home))
    return {
        "joint_names": list(robot.joint_names),
        "decimation": decimation,
        "values": {**whole, **home, **values},
        "fields": fields,
        "digest": hashlib.sha256(told.encode()).hexdigest()[:16],
        "mujoco": mujoco.__version__,
    }


def is_record(record: Record) -> bool:
    """Whether this is one; checkpoints of before have none."""
    return record.keys() >= {"joint_names", "decimation", "values", "fields", "digest", "mujoco"}


def differences(theirs: Record, own: Record) -> list[str]:
    """Return in what the robot of `own` differs from that of `theirs`, a line each.

    Where `theirs` holds no more than joints and decimation, these alone are compared.
    """
    lines = []
    if theirs["joint_names"] != own["joint_names"]:
        lines.append(f"joints: {', '.join(theirs['joint_names'])} -> {', '.join(own['joint_names'])}")
    if theirs["decimation"] != own["decimation"]:
        lines.append(f"decimation: {theirs['decimation']} -> {own['decimation']} physics steps")
    if not is_record(theirs):
        return lines
    before, now = theirs["values"], own["values"]
    for kind, name in PARTS.items():
        parts, others = before.get(name, {}), now[name]
        gone = [*(f"{part} is gone" for part in parts if part not in others)]
        gone += [f"{part} is new" for part in others if part not in parts]
        lines += [f"{kind}: {_listed(gone)}"] if gone else []
    has_same_parts = not lines
    changes = {name: _changes(before[name], now[name]) for name in before if name in now}
    lines += [f"{name}: {_listed(changed)}" for name, changed in changes.items() if changed]
    told = {quantity.field for quantity in QUANTITIES if changes.get(quantity.name)}
    told |= {field for name, field in OPTIONS.items() if changes.get(name)}
    told |= {"actuator_biasprm"} if "actuator_gainprm" in told else set()  # it has -kp
    if has_same_parts and theirs["mujoco"] == own["mujoco"]:  # another version compiles the same file to other numbers
        fields = {**theirs["fields"], **own["fields"]}
        others = [name for name in fields if name not in told and theirs["fields"].get(name) != own["fields"].get(name)]
        lines += [f"fields of the compiled model: {_listed(others)}"] if others else []
    return lines


def obstacles(theirs: Record, own: Record) -> list[str]:
    """Return why a policy that was trained on the robot of `theirs` cannot mean that of `own`, a clause each.

    It has other joints: of other names, order or kind, or about other axes; or its policy step is another one.
    """
    names = theirs["joint_names"]
    if names != own["joint_names"]:
        return [f"it moves the joints {', '.join(names)}, not {', '.join(own['joint_names'])}"]
    if not is_record(theirs):
        steps = theirs["decimation"], own["decimation"]
        return [] if steps[0] == steps[1] else [f"its policy step has {steps[0]} physics steps, not {steps[1]}"]
    found = []
    kinds, axes = ((theirs["values"][quantity.name], own["values"][quantity.name]) for quantity in QUANTITIES[:2])
    for name in names:
        kind, other_kind, axis, other_axis = (values[name] for values in (*kinds, *axes))
        if kind != other_kind:
            found.append(f"its joint '{name}' {_moves(kind)}, and {_moves(other_kind)} here")
        elif np.dot(axis, other_axis) < 0.5:
            found.append(f"its joint '{name}' has the axis {_text(axis)}, not {_text(other_axis)}")
    step, other_step = (record["decimation"] * record["values"]["physics step [s]"][""][0] for record in (theirs, own))
    if not np.isclose(step, other_step, rtol=1e-6):
        found.append(f"its policy step is {step:g} s, not {other_step:g} s")
    return found


def _moves(kind: list[float]) -> str:
    return "slides" if kind == [float(mujoco.mjtJoint.mjJNT_SLIDE)] else "turns"


def _values(model: mujoco.MjModel, quantity: Quantity, joint_names: tuple[str, ...]) -> dict[str, list[float]]:
    """Return a quantity of each of the model's parts but the world and the root; of actuators by the names of their joints."""
    kind, rows = quantity.kind, quantity.scale * np.asarray(getattr(model, quantity.field), dtype=float)
    if kind == "actuator":
        names = dict(enumerate(joint_names))
    elif kind in ("joint", "dof"):
        joints = range(1, model.njnt)
        names = {(model.jnt_dofadr[i] if kind == "dof" else i): model.joint(i).name or f"joint {i}" for i in joints}
    else:
        count = {"body": model.nbody, "geom": model.ngeom, "site": model.nsite}[kind]
        names = {i: getattr(model, kind)(i).name or f"{kind} {i}" for i in range(int(kind == "body"), count)}
    return {name: _numbers(np.atleast_1d(rows[i])[quantity.columns]) for i, name in names.items()}


def _numbers(values: Any) -> list[float]:
    return np.atleast_1d(np.asarray(values, dtype=float)).ravel().tolist()


def _moving() -> list[str]:
    """Return the fields of MuJoCo's model that decide how it moves, less those that follow from others."""
    return [
        field
        for field in MODEL_FIELDS
        if not field.startswith(SEEN_ONLY)
        and not field.endswith(SEEN_ONLY_ENDS)
        and (field not in mujoco.MjModel._setconst_outputs or field == "geom_size")
    ]


def _digest(value: Any) -> str:
    """Return a short digest of a field, the same where its numbers differ in their last bits; empty for an empty field."""
    array = np.asarray(value)
    if array.size == 0:
        return ""
    if array.dtype.kind == "f":
        small = np.where(np.abs(array) < 1e-9, 0.0, array)
        return hashlib.sha256(" ".join(f"{x:.6g}" for x in small.ravel()).encode()).hexdigest()[:12]
    return hashlib.sha256(repr(array.tolist()).encode()).hexdigest()[:12]


def _changes(before: Mapping[str, list[float]], now: Mapping[str, list[float]]) -> list[str]:
    """Return which parts that are in both have changed, and how."""
    return [
        f"{part} {_text(old)} -> {_text(now[part])}".strip()
        for part, old in before.items()
        if part in now and _differ(old, now[part])
    ]


def _differ(old: list[float], new: list[float]) -> bool:
    return len(old) != len(new) or not np.allclose(old, new, rtol=1e-6, atol=1e-9, equal_nan=True)


def _listed(items: list[str]) -> str:
    """Return the first items, and how many more there are."""
    more = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(items[:SHOWN]) + more


def _text(values: list[float] | NDArray[np.float64]) -> str:
    return " ".join(f"{value:.7g}" for value in values)
