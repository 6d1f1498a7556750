# pyright: reportAttributeAccessIssue=false
"""What the MDP takes for granted of a robot: a joint target in, a bounded force out, on a body that is free to fall.

What is written in another way but means the same is rewritten (`in_joint_units`); what cannot be meant is refused by the name
of its part, with the remedy (`check_model`). What only a simulation tells is in `telebip.eval.standing`.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from telebip.errors import UserError

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
DYNAMICS = tuple(int(kind) for kind in (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT))
"""Of an actuator whose control is where the joint is to go: at once, or through a first-order filter."""
PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
NEEDED = ("CONSTRAINT", "CONTACT", "LIMIT", "GRAVITY", "ACTUATION", "SENSOR")
"""What of `<option><flag .../>` must not be disabled."""
NUMBERS = (
    *("body_pos", "body_quat", "body_ipos", "body_iquat", "body_mass", "body_inertia", "geom_pos", "geom_quat", "geom_size"),
    *("geom_friction", "geom_solref", "geom_solimp", "jnt_pos", "jnt_axis", "jnt_stiffness", "qpos_spring", "dof_armature"),
    *("dof_damping", "dof_frictionloss", "actuator_gainprm", "actuator_biasprm", "actuator_gear", "actuator_ctrlrange"),
    *("actuator_forcerange", "jnt_range", "site_pos", "site_size", "key_qpos"),
)
"""Fields of the model that must be finite; MuJoCo itself takes a NaN with a warning."""


@dataclass(frozen=True)
class Parts:
    """Ids of the parts that the MDP refers to."""

    trunk: int  # body
    floor: int  # geom
    feet: list[int]  # sensors, right and left
    home: int  # keyframe


def in_joint_units(model: mujoco.MjModel) -> None:
    r"""Rewrite actuators with a gear, or on a joint with a limit of its own, as ones that do the same with a gear of 1.

        f_joint = g clip(kp (u - g q) - kv g qd)  =  clip_g(g^2 kp (u / g - q) - g^2 kv qd)

    for a gear g: stiffness and damping times g^2, force range times g, control range over g, so that a control is the joint's
    target [rad | m] and a force the joint's [N m | N]. A joint's `actuatorfrcrange` narrows its actuator's force range.
    """
    for i in range(model.nactuator):
        joint, gear = model.actuator_trnid[i, 0], model.actuator_gear[i, 0]
        if not _drives_joint(model, i) or gear == 0.0:
            continue
        model.actuator_gear[i, 0] = 1.0
        model.actuator_gainprm[i, 0] *= gear**2
        model.actuator_biasprm[i, 1:3] *= gear**2
        model.actuator_biasprm[i, 0] *= gear
        model.actuator_armature[i] *= gear**2
        model.actuator_damping[i] *= gear**2
        model.actuator_dampingpoly[i] *= gear ** np.arange(3, 3 + model.actuator_dampingpoly.shape[1])
        model.actuator_forcerange[i] = np.sort(gear * model.actuator_forcerange[i])
        model.actuator_ctrlrange[i] = np.sort(model.actuator_ctrlrange[i] / gear)
        if model.jnt_actfrclimited[joint]:
            own, most = model.actuator_forcerange[i], model.jnt_actfrcrange[joint]
            model.actuator_forcerange[i] = np.clip(own, *most) if model.actuator_forcelimited[i] else most
            model.actuator_forcelimited[i] = True


def check_model(model: mujoco.MjModel, path: str | Path, parts: Parts) -> None:
    """Check a model, after `in_joint_units`.

    Raises:
        UserError: something is not as the MDP takes it for granted; the message names it and says what to change.
    """
    data = mujoco.MjData(model)
    for problem in (_numbers(model), _options(model), _joints(model, parts), _actuators(model, parts)):
        _refuse(path, problem)
    data.qpos[:] = model.key_qpos[parts.home]
    mujoco.mj_kinematics(model, data)
    for problem in (_floor(model, data, parts), _feet(model, data, parts)):
        _refuse(path, problem)


def _refuse(path: str | Path, problems: Iterator[str]) -> None:
    for problem in problems:
        raise UserError(f"{path}: {problem}")


def _numbers(model: mujoco.MjModel) -> Iterator[str]:
    """Yield which fields are not finite."""
    for name in NUMBERS:
        rows = np.argwhere(~np.isfinite(getattr(model, name)))
        if len(rows):
            yield f"{name} of {_named(model, name, int(rows[0][0]))} is not finite"


def _named(model: mujoco.MjModel, field: str, row: int) -> str:
    """Return what to call the part that a row of a field belongs to: "joint 'right_knee'"."""
    kind = {"jnt": "joint", "dof": "joint", "qpos": "joint"}.get(field.partition("_")[0], field.partition("_")[0])
    if field.startswith("dof_"):
        row = int(model.dof_jntid[row])
    elif field.startswith("qpos_"):
        row = max(0, row - 6)
    return f"{kind} '{getattr(model, kind)(row).name or row}'"


def _options(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what of `<option>` leaves nothing to walk on."""
    x, y, z = gravity = model.opt.gravity
    if not (np.isfinite(gravity).all() and x == y == 0.0 and z < 0.0):
        yield f"option gravity is '{x:g} {y:g} {z:g}'; it must point down, as \"0 0 -9.81\""
    if not 1e-4 <= model.opt.timestep <= 0.1:
        yield f"option timestep is {model.opt.timestep:g} s; it must be between 0.0001 and 0.1, as 0.005"
    for name in NEEDED:
        if model.opt.disableflags & getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"):
            yield f'option flag {name.lower()} is disabled; leave out {name.lower()}="disable"'


def _joints(model: mujoco.MjModel, parts: Parts) -> Iterator[str]:
    """Yield which joints are of another kind, what hinders the root, and what the home pose leaves."""
    trunk, home = model.body(parts.trunk).name, model.key_qpos[parts.home]
    for name, values in {
        "damping": model.dof_damping[:6],
        "armature": model.dof_armature[:6],
        "frictionloss": model.dof_frictionloss[:6],
        "stiffness": model.jnt_stiffness[:1],
    }.items():
        if values.any():
            yield f"the free joint of body '{trunk}' has {name} {values.max():g}; write <freejoint/>, which takes no defaults"
    if not 0.99 < np.linalg.norm(home[3:7]) < 1.01:
        yield f"the quaternion of body '{trunk}' in keyframe 'home' is no unit quaternion: {home[3:7]}; upright is 1 0 0 0"
    for joint in range(1, model.njnt):
        name, (low, high) = model.joint(joint).name, model.jnt_range[joint]
        if model.jnt_type[joint] not in (HINGE, SLIDE):
            yield f"joint '{name}' must be a hinge or a slide"
        at, slack = home[model.jnt_qposadr[joint]], 1e-6 + 1e-3 * (high - low)
        if model.jnt_limited[joint] and not low - slack <= at <= high + slack:
            yield (
                f"joint '{name}' stands at {at:g} in keyframe 'home', outside of its range \"{low:g} {high:g}\"; "
                "change the one or the other"
            )


def _actuators(model: mujoco.MjModel, parts: Parts) -> Iterator[str]:
    """Yield which actuators are no bounded forces towards a joint target of their own."""
    if model.nu == 0:
        yield "expected position actuators, one for each joint that a policy moves"
    driven: set[str] = set()
    for i in range(model.nactuator):
        name = model.actuator(i).name or str(i)
        if not _drives_joint(model, i):
            yield f"actuator '{name}' must drive one joint, a hinge or a slide"
            return
        joint = model.joint(model.actuator_trnid[i, 0])
        if not joint.name:
            yield f"the joint of actuator '{name}' needs a name"
        if joint.name in driven:
            yield f"joint '{joint.name}' has a second actuator, '{name}'"
        if not model.jnt_limited[joint.id]:
            yield f"joint '{joint.name}' needs a range"
        yield from _not_position(model, i, name)
        yield from _not_bounded(model, i, name, model.key_qpos[parts.home, joint.qposadr[0]])
        driven.add(joint.name)


def _drives_joint(model: mujoco.MjModel, i: int) -> bool:
    """Whether an actuator is on a hinge or a slide; the joint's frame, or its parent's, make no difference there."""
    return int(model.actuator_trntype[i]) in ON_JOINT and model.jnt_type[model.actuator_trnid[i, 0]] in (HINGE, SLIDE)


def _not_position(model: mujoco.MjModel, i: int, name: str) -> Iterator[str]:
    """Yield why an actuator's force is not kp (control - position) - kv velocity."""
    (kp, *_), (offset, stiffness, *_) = model.actuator_gainprm[i], model.actuator_biasprm[i]
    kinds = (model.actuator_gaintype[i], model.actuator_biastype[i])
    if kinds != (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE) or not 0.0 < kp == -stiffness:
        yield f"actuator '{name}' must be a position actuator: its control is a joint target"
    if offset != 0.0:
        yield f"actuator '{name}' adds the force {offset:g} to that of its target; the first number of biasprm must be 0"
    if model.actuator_dyntype[i] not in DYNAMICS:
        yield f"actuator '{name}' must act at once or through a filter (timeconst), not through other activation dynamics"
    if model.actuator_gear[i, 0] == 0.0:
        yield f"actuator '{name}' has a gear of 0 and moves nothing"
    if model.opt.disableactuator >> int(model.actuator_group[i]) & 1:
        yield f"actuator '{name}' is disabled with its group; leave {model.actuator_group[i]} out of actuatorgroupdisable"


def _not_bounded(model: mujoco.MjModel, i: int, name: str, home: float) -> Iterator[str]:
    """Yield why an actuator cannot push both ways within bounds, or why its target cannot be the home pose."""
    if not model.actuator_forcelimited[i]:
        yield f"actuator '{name}' needs a forcerange"
    low, high = model.actuator_forcerange[i]
    if not low < 0.0 < high:
        yield f"actuator '{name}' has forcerange \"{low:g} {high:g}\" at its joint; a joint must be pushed both ways"
    low, high = model.actuator_ctrlrange[i]
    is_clipped = model.actuator_ctrllimited[i] and not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL
    if is_clipped and not low <= home <= high:
        yield (
            f"actuator '{name}' clips targets to ctrlrange \"{low:g} {high:g}\" of its joint, which stands at {home:g} in "
            "keyframe 'home'; widen the range, or leave it out"
        )


def _floor(model: mujoco.MjModel, data: mujoco.MjData, parts: Parts) -> Iterator[str]:
    """Yield why the floor is no level ground at the height 0, from which the hips' is measured."""
    floor = parts.floor
    if model.body_weldid[model.geom_bodyid[floor]] != 0 or model.body_mocapid[model.geom_bodyid[floor]] >= 0:
        yield f"geom '{model.geom(floor).name}' must belong to the world, not to a body that moves"
    if model.geom_type[floor] == PLANE:
        if data.geom_xmat[floor, 8] < 1.0 - 1e-6:
            yield f"geom '{model.geom(floor).name}' is tilted; a plane must be level, and face up"
        if abs(data.geom_xpos[floor, 2]) > 1e-6:
            yield f"geom '{model.geom(floor).name}' lies at z = {data.geom_xpos[floor, 2]:g}; heights are measured from z = 0"


def _feet(model: mujoco.MjModel, data: mujoco.MjData, parts: Parts) -> Iterator[str]:
    """Yield why the feet's sensors cannot feel the ground, or which foot is on the wrong side."""
    for sensor in parts.feet:
        name = model.sensor(sensor).name
        if model.sensor_type[sensor] != mujoco.mjtSensor.mjSENS_TOUCH:
            yield f"sensor '{name}' must be a touch sensor"
            return
        site = model.sensor_objid[sensor]
        body = model.site_bodyid[site]
        if model.body_rootid[body] != model.body_rootid[parts.trunk] or body == parts.trunk:
            yield f"sensor '{name}' is on site '{model.site(site).name}' of body '{model.body(body).name}', which is no foot"
        if not any(can_collide(model, geom, parts.floor) for geom in np.flatnonzero(model.geom_bodyid == body)):
            yield (
                f"sensor '{name}' feels nothing: no geom of body '{model.body(body).name}' collides with geom "
                f"'{model.geom(parts.floor).name}' (contype and conaffinity)"
            )
        weight, cutoff = model.body_subtreemass[parts.trunk] * -model.opt.gravity[2], model.sensor_cutoff[sensor]
        if 0.0 < cutoff < weight:
            yield f"sensor '{name}' has a cutoff of {cutoff:g} N, less than the robot's weight of {weight:.0f} N; leave it out"
    sites = model.sensor_objid[parts.feet]
    if model.site_bodyid[sites[0]] == model.site_bodyid[sites[1]]:
        yield f"both feet's sensors are on body '{model.body(model.site_bodyid[sites[0]]).name}'"
    right, left = (to_the_left(data, parts.trunk, data.site_xpos[site]) for site in sites)
    if right > left + 1e-3:
        yield (
            f"sensor '{model.sensor(parts.feet[0]).name}' is on the left foot and the other on the right "
            "(x is forward, y to the left); swap their sites"
        )


def can_collide(model: mujoco.MjModel, a: int | np.intp, b: int | np.intp) -> bool:
    """Whether two geoms can touch, by their bits or as a pair."""
    bits = model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]
    pairs = zip(model.pair_geom1, model.pair_geom2, strict=True)
    return bool(bits) or any({a, b} == {int(one), int(other)} for one, other in pairs)


def to_the_left(data: mujoco.MjData, trunk: int, point: NDArray[np.float64]) -> float:
    """Return how far a point lies to the left of the trunk, along its y axis [m]."""
    return float((point - data.xpos[trunk]) @ data.xmat[trunk].reshape(3, 3)[:, 1])
