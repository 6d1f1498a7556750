# pyright: reportAttributeAccessIssue=false
"""The robot as its MJCF describes it: its actuated joints, nominal pose, limits, feet and mirror image."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from telebip import ROOT
from telebip.errors import UserError, nearest
from telebip.files import is_file
from telebip.terrain import Terrain

FEET = ("right_foot", "left_foot")
"""The order of all that is told of two feet: right first, as the phase signals (p_r, p_l)."""
FOOT_SENSORS = tuple(f"{foot}_force" for foot in FEET)
TRUNK, FLOOR, KEYFRAME = "trunk", "floor", "home"
NET_FORCE = 3
"""MuJoCo's number of a contact sensor's `reduce="netforce"`."""

HINGE, SLIDE = int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE)
DYNAMICS = [int(kind) for kind in (mujoco.mjtDyn.mjDYN_NONE, mujoco.mjtDyn.mjDYN_FILTER, mujoco.mjtDyn.mjDYN_FILTEREXACT)]
"""Of an actuator whose control is where the joint is to go: at once, or through a first-order filter."""
MIRROR = np.array([1.0, -1.0, 1.0])
"""Reflection of a polar vector at the plane y = 0; an axial one is reflected by its negative."""


@dataclass(frozen=True)
class JointMirror:
    """How the actuated joints move in the mirror image: mirrored_joint[i] = sign[i] * joint[order[i]]."""

    order: list[int]
    sign: list[float]  # 1 or -1


@dataclass(frozen=True)
class Robot:
    """A compiled model and what the MDP reads from it. Joints in the order of `joint_names`, feet in that of `FEET`."""

    path: Path
    model: mujoco.MjModel  # everything that the file describes
    joint_names: tuple[str, ...]  # the actuated joints, in the order of the actuators
    home_qpos: NDArray[np.float64]  # (nq,) standing on the ground, heading along x
    nominal: NDArray[np.float64]  # (num_joints,) joint positions of the home pose [rad | m]
    joint_range: NDArray[np.float64]  # (num_joints, 2) [rad | m]
    force_limit: NDArray[np.float64]  # (num_joints,) largest actuator forces [N m | N]
    is_slide: NDArray[np.bool_]  # (num_joints,) whether a joint is prismatic: m and N instead of rad and N m
    weight: float  # m g [N]
    trunk_id: int  # of `model`, as `floor_id`; an engine's model may number its parts otherwise
    floor_id: int
    joint_columns: slice | list[int]  # of the joints in `qpos`; in `qvel` they stand one column further left
    foot_lift: NDArray[np.float64]  # (2, num_joints) d(foot height) / d(joint position) in the home pose [m/rad | m/m]
    mirror: JointMirror | str  # at the plane y = 0; or which part is not its own mirror image
    terrain: Terrain | None = None  # on which it stands; None: the floor of the file

    @property
    def physics_dt(self) -> float:
        """Physics step [s]."""
        return float(self.model.opt.timestep)

    def on(self, terrain: Terrain | None) -> "Robot":
        """Return the same robot on a height field with its floor's friction and look, or on the floor of its file."""
        if terrain is self.terrain:
            return self
        spec = mujoco.MjSpec.from_file(str(self.path))
        if terrain:
            _lay(spec, terrain)
        return replace(self, model=spec.compile(), terrain=terrain)

    def engine_model(self, sensors: Sequence[str] = ()) -> mujoco.MjModel:
        """Compile the file, on its `terrain`, as an engine steps it: with `ground_force_sensor` of each foot.

        It lacks what moves nothing and nobody reads, but costs the engine a seventh of every step: sensors (an accelerometer
        alone takes a pass over the bodies), cameras, lights, geoms that collide with nothing (inertias are computed before),
        and the search for constraint islands, as one robot is one island. It moves the same, bit for bit. Bodies, geoms and
        sensors may have other ids than in `model`: look them up by name.

        Args:
            sensors: names of the sensors to keep.

        Raises:
            UserError: there is no such sensor, or without the rest the file is no valid MJCF.
        """
        spec = mujoco.MjSpec.from_file(str(self.path))
        kept = [sensor for sensor in spec.sensors if sensor.name in sensors]
        for name in sensors:
            if name not in [sensor.name for sensor in kept]:
                known = (sensor.name for sensor in spec.sensors if sensor.name)
                raise UserError(f"{self.path}: no sensor named '{name}'; {nearest(name, known)}")
        on_camera = any(mujoco.mjtObj.mjOBJ_CAMERA in (sensor.objtype, sensor.reftype) for sensor in kept)
        dropped = [sensor for sensor in spec.sensors if sensor not in kept]
        for foot, touch in zip(FEET, FOOT_SENSORS, strict=True):
            _sense_ground_force(spec, foot, spec.sensor(touch).objname)
        for part in (*dropped, *spec.lights, *([] if on_camera else spec.cameras)):
            spec.delete(part)
        # A rangefinder's rays end at geoms that collide with nothing, too.
        spec.compiler.discardvisual = all(sensor.type != mujoco.mjtSensor.mjSENS_RANGEFINDER for sensor in kept)
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
        if self.terrain:
            _lay(spec, self.terrain)
        try:
            return spec.compile()
        except ValueError as error:
            raise UserError(f"{self.path}: {error}") from error


def _lay(spec: mujoco.MjSpec, terrain: Terrain) -> None:
    """Make a height field of the floor; MuJoCo scales its data to 0..1."""
    lowest, (rows, columns) = float(terrain.heights.min()), terrain.heights.shape
    size = [*terrain.half_extent, max(float(np.ptp(terrain.heights)), 1e-6), 1.0]  # the last is its thickness below
    spec.add_hfield(name=FLOOR, nrow=rows, ncol=columns, size=size, userdata=terrain.heights.astype(np.float32).ravel())
    floor = spec.geom(FLOOR)
    floor.type, floor.hfieldname, floor.pos = mujoco.mjtGeom.mjGEOM_HFIELD, FLOOR, [0.0, 0.0, lowest]


def _sense_ground_force(spec: mujoco.MjSpec, foot: str, site: str) -> None:
    """Add a contact sensor: the net force that a foot puts on the ground within its `site`, world frame [N], (3,).

    Its vertical component means the same on every ground. A touch sensor adds the magnitudes of normal forces; on a height
    field a foot touches several triangles at once, whose normals are tilted, and the sum is larger than what they carry.
    """
    spec.add_sensor(
        name=ground_force_sensor(foot),
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        objname=site,
        reftype=mujoco.mjtObj.mjOBJ_BODY,
        refname="world",
        intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FORCE.value, NET_FORCE, 1],
    )


def ground_force_sensor(foot: str) -> str:
    """Return the name of the sensor that `Robot.engine_model` has for a foot."""
    return f"{foot}_ground_force"


def load_robot(path: str | Path) -> Robot:
    """Load a biped; relative paths start at telebip's own folder, then at the working directory.

    The MJCF must name the body `trunk` with a free joint, which comes first, a touch sensor `<foot>_force` for each of `FEET`,
    the geom `floor`, and the keyframe `home`. All other joints are hinges and slides. Every actuator is a position actuator
    with a force range, on a named joint with a range, at once or through a filter; a joint may have none. See
    docs/your_robot.md.

    Raises:
        UserError: the file is missing or is no valid MJCF, or something is missing or of another kind; the message says what.
    """
    file = next((p for p in (ROOT / path, Path(path)) if is_file(p)), None)
    if file is None:
        raise UserError(f"robot file '{path}' does not exist")
    try:
        model = mujoco.MjModel.from_xml_path(str(file))
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
    trunk = part(model, "body", TRUNK, path).id
    floor = part(model, "geom", FLOOR, path).id
    sensors = [part(model, "sensor", name, path).id for name in FOOT_SENSORS]
    home = part(model, "key", KEYFRAME, path).qpos.copy()
    _check_bodies(model, trunk, sensors, path)
    _check_actuators(model, path)
    joints = model.actuator_trnid[:, 0]
    columns = model.jnt_qposadr[joints]
    return Robot(
        path=file.absolute(),
        model=model,
        joint_names=tuple(model.joint(joint).name for joint in joints),
        home_qpos=home,
        nominal=home[columns],
        joint_range=model.jnt_range[joints],
        force_limit=np.abs(model.actuator_forcerange).max(1),
        is_slide=model.jnt_type[joints] == SLIDE,
        weight=float(model.body_subtreemass[trunk] * np.linalg.norm(model.opt.gravity)),
        trunk_id=trunk,
        floor_id=floor,
        joint_columns=_columns(columns.tolist()),
        foot_lift=_foot_lift(model, home, model.sensor_objid[sensors], columns - 1),
        mirror=_mirror(model, trunk, home, model.sensor_objid[sensors]),
    )


def _check_bodies(model: mujoco.MjModel, trunk: int, sensors: list[int], path: str | Path) -> None:
    """Raise a `UserError` unless trunk, feet and joints are of the kinds that the MDP takes for granted."""
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE or model.jnt_bodyid[0] != trunk:
        raise UserError(f"{path}: the first joint must be a free joint, that of body '{TRUNK}'")
    for joint in range(1, model.njnt):
        if model.jnt_type[joint] not in (HINGE, SLIDE):
            raise UserError(f"{path}: joint '{model.joint(joint).name}' must be a hinge or a slide")
    for sensor in sensors:
        if model.sensor_type[sensor] != mujoco.mjtSensor.mjSENS_TOUCH:
            raise UserError(f"{path}: sensor '{model.sensor(sensor).name}' must be a touch sensor")


def _check_actuators(model: mujoco.MjModel, path: str | Path) -> None:
    """Raise a `UserError` unless every actuator's control is the target of one joint of its own."""
    if model.nu == 0:
        raise UserError(f"{path}: expected position actuators, one for each joint that a policy moves")
    driven: set[str] = set()
    for i in range(model.nactuator):
        name = model.actuator(i).name or str(i)
        on_joint = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
        if not on_joint or model.jnt_type[model.actuator_trnid[i, 0]] not in (HINGE, SLIDE):
            raise UserError(f"{path}: actuator '{name}' must drive one joint, a hinge or a slide")
        joint = model.joint(model.actuator_trnid[i, 0])
        for holds, else_wrong in (
            (joint.name, f"the joint of actuator '{name}' needs a name"),
            (joint.name not in driven, f"joint '{joint.name}' has a second actuator, '{name}'"),
            (model.jnt_limited[joint.id], f"joint '{joint.name}' needs a range"),
            (_is_position(model, i), f"actuator '{name}' must be a position actuator: its control is a joint target"),
            (
                model.actuator_dyntype[i] in DYNAMICS,
                f"actuator '{name}' must act at once or through a filter (timeconst), not through other activation dynamics",
            ),
            (model.actuator_gear[i, 0] == 1.0, f"actuator '{name}' must have a gear of 1"),
            (model.actuator_forcelimited[i], f"actuator '{name}' needs a forcerange"),
        ):
            if not holds:
                raise UserError(f"{path}: {else_wrong}")
        driven.add(joint.name)


def _is_position(model: mujoco.MjModel, i: int) -> bool:
    """Whether an actuator's force is kp (control - position) and what depends on its velocity."""
    kinds = (model.actuator_gaintype[i], model.actuator_biastype[i])
    is_linear = kinds == (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE)
    return is_linear and 0 < model.actuator_gainprm[i, 0] == -model.actuator_biasprm[i, 1]


def part(model: mujoco.MjModel, kind: str, name: str, path: str | Path, condition: str = "") -> Any:
    """Return MuJoCo's view of the `kind` (body, joint, geom, sensor, key, ...) of this name.

    Raises:
        UserError: there is none that meets the `condition` for being in the model, as " moves or collides".
    """
    try:
        return getattr(model, kind)(name)
    except KeyError as error:  # MuJoCo lists the valid names
        valid = str(error.args[0]).partition("Valid names: ")[2]
        raise UserError(f"{path}: no {kind} named '{name}'{condition}; valid: {valid.strip('[]') or 'none'}") from error


def _columns(columns: list[int]) -> slice | list[int]:
    """Return a slice where columns lie side by side: what it selects is no copy."""
    first, end = columns[0], columns[0] + len(columns)
    return slice(first, end) if columns == list(range(first, end)) else columns


def _foot_lift(
    model: mujoco.MjModel, home: NDArray[np.float64], sites: NDArray[np.int32], dofs: NDArray[np.int32]
) -> NDArray[np.float64]:
    """Return the derivatives of the sites' heights with respect to the degrees of freedom `dofs`, (2, num_joints)."""
    data, jacobian, rows = mujoco.MjData(model), np.zeros((3, model.nv)), []
    data.qpos[:] = home
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    for site in sites:
        mujoco.mj_jacSite(model, data, jacobian, None, site)
        rows.append(jacobian[2, dofs])
    return np.array(rows)


def _mirror(model: mujoco.MjModel, trunk: int, home: NDArray[np.float64], sites: NDArray[np.int32]) -> JointMirror | str:
    """Find how the joints mirror at the plane y = 0 through the trunk, or return which part is not its own mirror image.

    A joint's image is the one whose name has the other side, or itself. In the home pose, heading along x, whatever belongs to
    one must be the image of what belongs to the other, within a hundredth and a thousandth of its unit.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = home
    data.qpos[:2] = 0.0
    w, x, y, z = home[3:7]
    half = 0.5 * np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    mujoco.mju_mulQuat(data.qpos[3:7], np.array([np.cos(half), 0.0, 0.0, -np.sin(half)]), home[3:7])
    mujoco.mj_kinematics(model, data)

    if not _same(data.qpos[3:7], data.qpos[3:7] * [1.0, -1.0, 1.0, -1.0]):
        return f"body '{TRUNK}' leans to one side"
    if not _same(data.site_xpos[sites[0]], data.site_xpos[sites[1]] * MIRROR):
        return "places of the feet's touch sensors"
    names = [model.joint(joint).name for joint in range(model.njnt)]
    moments = moments_of_mass(model, data, data.xpos[trunk])
    for body in reversed(range(1, model.nbody)):  # of each body with all that hangs on it
        moments[model.body_parentid[body]] += moments[body]
    actuator = {int(joint): i for i, joint in enumerate(model.actuator_trnid[:, 0])}
    order, sign = [0] * len(actuator), [0.0] * len(actuator)
    for i in range(1, model.njnt):
        other = _other_side(names[i])
        if other and other not in names:
            return f"no joint '{other}'"
        j = names.index(other) if other else i
        pair = f"joints '{names[i]}' and '{other}'" if i != j else f"joint '{other}'"
        if (i in actuator) != (j in actuator):
            return f"only one actuator on {pair}"
        signed = _axis_sign(model, data, i, j)
        if unlike := _unlike(model, data, moments, i, j, signed):
            return f"{unlike} of {pair}"
        if i in actuator:
            a, b = actuator[i], actuator[j]
            if not _same(model.actuator_forcerange[a], np.sort(signed * model.actuator_forcerange[b])):
                return f"force limits of {pair}"
            parameters = model.actuator_gainprm, model.actuator_biasprm, model.actuator_dynprm
            if not all(_same(own[a], own[b]) for own in parameters):
                return f"gains of {pair}"
            order[a], sign[a] = b, signed
    if not _mirrors(moments[trunk], moments[trunk]):
        return f"masses of body '{TRUNK}'"
    return JointMirror(order, sign)


def _axis_sign(model: mujoco.MjModel, data: mujoco.MjData, i: int, j: int) -> float:
    """Return s, 1 or -1, for which the axis of joint `i` is s times the image of that of joint `j`, or 0 if there is none.

    The image of a slide's axis a is M a, with M = diag(1, -1, 1); a hinge's axis is an axial vector, and its image -M a.
    """
    is_hinge = model.jnt_type[i] == HINGE
    image = data.xaxis[j] * (-MIRROR if is_hinge else MIRROR)
    sign = 1.0 if image @ data.xaxis[i] > 0.0 else -1.0
    return sign if model.jnt_type[i] == model.jnt_type[j] and _same(data.xaxis[i], sign * image) else 0.0


def _unlike(model: mujoco.MjModel, data: mujoco.MjData, moments: NDArray[np.float64], i: int, j: int, sign: float) -> str:
    """Return what of joint `i` is not the image of what joint `j` has, or nothing."""
    if not sign:
        return "axes"
    if model.jnt_type[i] == HINGE and not _same(data.xanchor[i], data.xanchor[j] * MIRROR):
        return "anchors"
    if not _mirrors(moments[model.jnt_bodyid[i]], moments[model.jnt_bodyid[j]]):
        return "masses"
    columns, dofs = model.jnt_qposadr[[i, j], None], model.jnt_dofadr[[i, j], None]
    signed = {
        "home positions": data.qpos[columns],
        "rest positions": model.qpos_spring[columns],
        "ranges": model.jnt_range[[i, j]],
    }
    unsigned = {
        "stiffness": model.jnt_stiffness[[i, j]],
        "damping": model.dof_damping[dofs],
        "friction": model.dof_frictionloss[dofs],
        "armature": model.dof_armature[dofs],
    }
    for what, (own, others) in (signed | unsigned).items():
        if not _same(own, np.sort(sign * others) if what in signed else others):
            return what
    return ""


def moments_of_mass(model: mujoco.MjModel, data: mujoco.MjData, origin: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the moments of mass of each body in its present pose, in the world's axes, (nbody, 4, 4).

        sum m [r r^T  r; r^T  1]                                                            [kg m^2, kg m, kg]

    over all particles, r from `origin` to each. Those of several bodies together are their sum.
    """
    axes, place = data.ximat.reshape(-1, 3, 3), np.insert(data.xipos - origin, 3, 1.0, axis=1)
    moments = model.body_mass[:, None, None] * place[:, :, None] * place[:, None]
    spread = 0.5 * model.body_inertia.sum(1, keepdims=True) - model.body_inertia  # sum m x^2, y^2, z^2 about the principal axes
    moments[:, :3, :3] += axes * spread[:, None] @ axes.transpose(0, 2, 1)
    return moments


def _mirrors(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Whether moments of mass are mirror images of each other."""
    image = np.append(MIRROR, 1.0)
    return _same(a, b * np.outer(image, image))


def _same(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    return np.allclose(a, b, rtol=1e-2, atol=1e-3)


def _other_side(name: str) -> str:
    """Return the name of what takes the place of `name` in the mirror image: `right_knee` is `left_knee`, `waist` itself."""
    sides = {"right": "left", "left": "right"}
    return re.sub("^(right|left)(?=_)|(?<=_)(right|left)$", lambda side: sides[side[0]], name, count=1)
