# pyright: reportAttributeAccessIssue=false
"""The robot as its MJCF describes it: its actuated joints, nominal pose, limits, feet and mirror image."""

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from telebip import ROOT
from telebip.errors import UserError, nearest
from telebip.files import is_file
from telebip.robot_check import HINGE, SLIDE, Parts, check_model, in_joint_units
from telebip.terrain import Terrain

FEET = ("right_foot", "left_foot")
"""The order of all that is told of two feet: right first, as the phase signals (p_r, p_l)."""
FOOT_SENSORS = tuple(f"{foot}_force" for foot in FEET)
FLOOR, KEYFRAME = "floor", "home"
NET_FORCE = 3
"""MuJoCo's number of a contact sensor's `reduce="netforce"`."""

MIRROR = np.array([1.0, -1.0, 1.0])
"""Reflection of a polar vector at the plane y = 0; an axial one is reflected by its negative."""


@dataclass(frozen=True)
class JointMirror:
    """How the actuated joints move in the mirror image: mirrored_joint[i] = sign[i] * joint[order[i]]."""

    order: list[int]
    sign: list[float]  # 1 or -1


@dataclass(frozen=True)
class Robot:
    """A compiled model and what the MDP reads from it. Joints in the order of `joint_names`, feet in that of `FEET`.

    Models are as `telebip.robot_check.in_joint_units` leaves them: controls are joint targets, forces the joints'.
    """

    path: Path
    model: mujoco.MjModel  # everything that the file describes
    joint_names: tuple[str, ...]  # the actuated joints, in the order of the actuators
    home_qpos: NDArray[np.float64]  # (nq,) standing on the ground, heading along x
    nominal: NDArray[np.float64]  # (num_joints,) joint positions of the home pose [rad | m]
    joint_range: NDArray[np.float64]  # (num_joints, 2) [rad | m]
    force_range: NDArray[np.float64]  # (num_joints, 2) least and largest actuator forces, of either sign [N m | N]
    is_slide: NDArray[np.bool_]  # (num_joints,) whether a joint is prismatic: m and N instead of rad and N m
    weight: float  # m g [N]
    trunk_id: int  # of `model`, as `floor_id`; an engine's model may number its parts otherwise
    floor_id: int
    joint_columns: slice | list[int]  # of the joints in `qpos`; in `qvel` they stand one column further left
    foot_lift: NDArray[np.float64]  # (2, num_joints) d(foot height) / d(joint position) in the home pose [m/rad | m/m]
    mirror: JointMirror | str  # at the plane y = 0; or which part is not its own mirror image
    terrain: Terrain | None = None  # on which it stands; None: the floor of the file

    @property
    def trunk_name(self) -> str:
        """Name of the body with the free joint."""
        return self.model.body(self.trunk_id).name

    @property
    def force_limit(self) -> NDArray[np.float64]:
        """Largest magnitudes of the actuators' forces [N m | N], (num_joints,)."""
        return np.abs(self.force_range).max(1)

    @property
    def physics_dt(self) -> float:
        """Physics step [s]."""
        return float(self.model.opt.timestep)

    def on(self, terrain: Terrain | None) -> "Robot":
        """Return the same robot on a height field with its floor's friction and look, or on the floor of its file."""
        if terrain is self.terrain:
            return self
        spec = _read(self.path, self.path)
        if terrain:
            _lay(spec, terrain)
        return replace(self, model=_compiled(spec, self.path), terrain=terrain)

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
        spec = _read(self.path, self.path)
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
        return _compiled(spec, self.path)


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

    The MJCF must have a free joint, which comes first and whose body is the trunk, a touch sensor `<foot>_force` for each of
    `FEET`, the geom `floor`, and the keyframe `home`. All other joints are hinges and slides. Every actuator is a position
    actuator with a force range, on a named joint with a range; a joint may have none. See docs/your_robot.md.

    Raises:
        UserError: the file is missing or is no valid MJCF, or something is missing or of another kind; the message says what.
    """
    file = next((p for p in (ROOT / path, Path(path)) if is_file(p)), None)
    if file is None:
        raise UserError(f"robot file '{path}' does not exist; if it has moved, say where it is: sim.robot=FILE")
    model = _compiled(_read(file, path), path)
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise UserError(f"{path}: the first joint must be a free joint, that of the trunk")
    trunk, floor = int(model.jnt_bodyid[0]), part(model, "geom", FLOOR, path).id
    sensors = [part(model, "sensor", name, path).id for name in FOOT_SENSORS]
    key = part(model, "key", KEYFRAME, path).id
    check_model(model, path, Parts(trunk, floor, sensors, key))
    home = model.key_qpos[key].copy()
    home[3:7] /= np.linalg.norm(home[3:7])
    joints = model.actuator_trnid[:, 0]
    columns = model.jnt_qposadr[joints]
    return Robot(
        path=file.absolute(),
        model=model,
        joint_names=tuple(model.joint(joint).name for joint in joints),
        home_qpos=home,
        nominal=home[columns],
        joint_range=model.jnt_range[joints],
        force_range=model.actuator_forcerange.copy(),
        is_slide=model.jnt_type[joints] == SLIDE,
        weight=float(model.body_subtreemass[trunk] * np.linalg.norm(model.opt.gravity)),
        trunk_id=trunk,
        floor_id=floor,
        joint_columns=_columns(columns.tolist()),
        foot_lift=_foot_lift(model, home, model.sensor_objid[sensors], columns - 1),
        mirror=_mirror(model, trunk, home, model.sensor_objid[sensors]),
    )


@contextlib.contextmanager
def silent_engine() -> Iterator[None]:
    """Keep the engine from writing its warnings to the console and to a file in the working directory."""
    before, quiet = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    quiet.logto_console = quiet.logto_file = False
    quiet.set()
    try:
        yield
    finally:
        before.set()


def _read(file: Path, path: str | Path) -> mujoco.MjSpec:
    """Parse an MJCF; errors name it as `path`."""
    try:
        with silent_engine():
            return mujoco.MjSpec.from_file(str(file))
    except (ValueError, OSError, mujoco.FatalError) as error:
        raise UserError(f"{path}: {error}") from error


def _compiled(spec: mujoco.MjSpec, path: str | Path) -> mujoco.MjModel:
    """Compile an MJCF, with its actuators in the units of their joints."""
    try:
        with silent_engine():
            model = spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise UserError(f"{path}: {error}") from error
    in_joint_units(model)
    return model


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
        return f"body '{model.body(trunk).name}' leans to one side"
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
        return f"masses of body '{model.body(trunk).name}'"
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
