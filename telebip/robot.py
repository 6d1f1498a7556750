# pyright: reportAttributeAccessIssue=false
"""The robot as its MJCF describes it: names, order, nominal pose and limits."""

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from telebip import ROOT
from telebip.errors import UserError
from telebip.files import is_file

JOINTS = ("right_hip_roll", "right_hip_pitch", "right_knee", "left_hip_roll", "left_hip_pitch", "left_knee")
"""Joints and their actuators, in the order of actions and observations: right leg first, as the phase signals (p_r, p_l)."""

FEET = ("right_foot", "left_foot")
FOOT_SENSORS = tuple(f"{foot}_force" for foot in FEET)
TRUNK, FLOOR, KEYFRAME = "trunk", "floor", "home"


@dataclass(frozen=True)
class Robot:
    """A compiled model and what the MDP reads from it. Arrays follow the order of `JOINTS` and `FEET`; knees in m and N."""

    path: Path
    model: mujoco.MjModel  # everything that the file describes
    engine_model: mujoco.MjModel  # what the engines step: the same motion, bit for bit, see `_engine_model`
    home_qpos: NDArray[np.float64]  # (13,) standing on the ground, heading along x
    nominal: NDArray[np.float64]  # (6,) joint positions of the home pose [rad | m]
    joint_range: NDArray[np.float64]  # (6, 2) [rad | m]
    force_limit: NDArray[np.float64]  # (6,) actuator force limits [N m | N]
    weight: float  # m g [N]
    trunk_id: int
    floor_id: int
    foot_sensor_adr: tuple[int, int]  # columns of `sensordata` that hold the feet's normal forces
    engine_floor_id: int  # of `engine_model`, where geoms and sensors have other numbers
    engine_foot_sensor_adr: tuple[int, int]

    @property
    def physics_dt(self) -> float:
        """Physics step [s]."""
        return float(self.model.opt.timestep)


def load_robot(path: str | Path) -> Robot:
    """Load a six-actuator biped; relative paths start at telebip's own folder, then at the working directory.

    The MJCF must name the body `trunk` with a free joint, the joints of `JOINTS` with a range and one position actuator of the
    same name each, a touch sensor `<foot>_force` for each of `FEET`, the geom `floor`, and the keyframe `home`; see
    docs/your_robot.md.

    Raises:
        UserError: the file is missing or is no valid MJCF, or something is missing or of another kind; the message says what.
    """
    file = next((p for p in (ROOT / path, Path(path)) if is_file(p)), None)
    if file is None:
        raise UserError(f"robot file '{path}' does not exist")
    try:
        model, engine_model = mujoco.MjModel.from_xml_path(str(file)), _engine_model(file)
    except ValueError as error:
        raise UserError(f"{path}: {' '.join(str(error).split())}") from error
    joints = [_id(model, "joint", name, path) for name in JOINTS]
    actuators = [_id(model, "actuator", name, path) for name in JOINTS]
    trunk = _id(model, "body", TRUNK, path)
    floor = _id(model, "geom", FLOOR, path)
    sensors = [_id(model, "sensor", name, path) for name in FOOT_SENSORS]
    home = model.key(_id(model, "key", KEYFRAME, path))
    _check(model, trunk, joints, actuators, sensors, path)
    return Robot(
        path=file,
        model=model,
        engine_model=engine_model,
        home_qpos=home.qpos.copy(),
        nominal=home.qpos[7:].copy(),
        joint_range=model.jnt_range[joints].copy(),
        force_limit=model.actuator_forcerange[:, 1].copy(),
        weight=float(model.body_subtreemass[trunk] * np.linalg.norm(model.opt.gravity)),
        trunk_id=trunk,
        floor_id=floor,
        foot_sensor_adr=_sensor_adr(model),
        engine_floor_id=_id(engine_model, "geom", FLOOR, path),
        engine_foot_sensor_adr=_sensor_adr(engine_model),
    )


def _engine_model(file: Path) -> mujoco.MjModel:
    """Compile the file without what moves nothing and nobody reads, but costs the engine a seventh of every step.

    These are sensors but the feet's (an accelerometer alone takes a pass over the bodies), cameras, lights, geoms that collide
    with nothing (inertias are computed before they go), and the search for constraint islands: one robot is one island.
    """
    spec = mujoco.MjSpec.from_file(str(file))
    sensors = [sensor for sensor in spec.sensors if sensor.name not in FOOT_SENSORS]
    for part in (*sensors, *spec.cameras, *spec.lights):
        spec.delete(part)
    spec.compiler.discardvisual = True
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return spec.compile()


def _sensor_adr(model: mujoco.MjModel) -> tuple[int, int]:
    right, left = (int(model.sensor(name).adr[0]) for name in FOOT_SENSORS)
    return right, left


def _check(
    model: mujoco.MjModel, trunk: int, joints: list[int], actuators: list[int], sensors: list[int], path: str | Path
) -> None:
    """Raise a `UserError` unless the named parts are of the kinds and in the order that the MDP takes for granted."""
    order = ", ".join(JOINTS)
    if (model.nq, model.nv) != (13, 12) or list(model.jnt_qposadr[joints]) != list(range(7, 13)):
        raise UserError(f"{path}: expected a free joint followed by {order}, in this order, and no other joints")
    if model.jnt_bodyid[0] != trunk:
        raise UserError(f"{path}: the free joint must be that of body '{TRUNK}'")
    if model.nu != 6 or actuators != list(range(6)) or list(model.actuator_trnid[:, 0]) != joints:
        raise UserError(f"{path}: expected one actuator each for {order}, in this order, and no others")
    position = (model.actuator_gainprm[:, 0] > 0) & (model.actuator_biasprm[:, 1] == -model.actuator_gainprm[:, 0])
    for i, name in enumerate(JOINTS):
        if not model.jnt_limited[joints[i]]:
            raise UserError(f"{path}: joint '{name}' needs a range")
        if not position[i]:
            raise UserError(f"{path}: actuator '{name}' must be a position actuator: its control is a joint target")
        if not model.actuator_forcelimited[i]:
            raise UserError(f"{path}: actuator '{name}' needs a forcerange")
    for sensor, foot in zip(sensors, FEET, strict=True):
        if model.sensor_type[sensor] != mujoco.mjtSensor.mjSENS_TOUCH:
            raise UserError(f"{path}: sensor '{foot}_force' must be a touch sensor")


def _id(model: mujoco.MjModel, kind: str, name: str, path: str | Path) -> int:
    """Return the id of the `kind` (joint, body, geom, actuator, sensor, key) of this name."""
    try:
        return getattr(model, kind)(name).id
    except KeyError as error:  # MuJoCo lists the valid names
        valid = str(error.args[0]).partition("Valid names: ")[2]
        raise UserError(f"{path}: no {kind} named '{name}'; valid: {valid.strip('[]') or 'none'}") from error
