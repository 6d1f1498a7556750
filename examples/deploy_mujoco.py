# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false
"""Walk an exported policy in plain MuJoCo with numpy, onnxruntime and mujoco alone: no telebip, no torch.

    python scripts/export.py --checkpoint assets/policies/telebip_flat --out policy.onnx
    python examples/deploy_mujoco.py policy.onnx assets/telebip.xml --command 0.7 0 0

`Policy` is what runs on a robot's computer: it takes sensor readings and returns joint targets, and all it knows comes from
the ONNX file: what is observed, how many of the latest frames, what a robot must measure. `SimulatedRobot` is what a robot's
drivers would replace: encoders, an inertial measurement unit, an estimate of the velocity where the policy sees one, and
position controllers with the gains and limits of the file. A model whose joints and sensors have names of their own:

    ... --rename right_knee=RK left_knee=LK --sensor ang_vel=imu_gyro quat=imu_quat --delay 20
"""

import argparse
import json
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import onnxruntime


@dataclass(frozen=True)
class Readings:
    """What the sensors say now. Joints in the order of the file's `joint_names`; x forward, y left, z up."""

    joint_pos: np.ndarray  # rad or m
    joint_vel: np.ndarray  # rad/s or m/s
    ang_vel: np.ndarray  # of the trunk, in its frame [rad/s]
    quat: np.ndarray  # orientation of the trunk, w x y z; its heading may start anywhere, and drift
    lin_vel: np.ndarray | None = None  # of the trunk's frame (midway between the hips), in that frame [m/s]


TERMS = (
    *("joint_pos", "joint_vel", "last_action", "base_lin_vel", "base_ang_vel", "base_quat", "projected_gravity"),
    *("command", "phase"),
)
"""What a policy may see, by telebip's names."""


class Policy:
    """An exported policy with what its observation needs to remember: time, last action, reference heading, latest frames."""

    def __init__(self, file: Path) -> None:
        """Load the network and its description; exit if the policy sees something that is not in `TERMS`."""
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # the network is small; to share it out takes longer than to run it
        try:
            self._session = onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's have no common base
            raise SystemExit(f"{file}: {error}") from error
        texts = self._session.get_modelmeta().custom_metadata_map
        if "measures" not in texts:
            raise SystemExit(f"{file}: no policy exported by this version; export it again")
        self.about = {key: json.loads(text) for key, text in texts.items()}
        self._nominal, self._scale = np.array(self.about["nominal_pose"]), np.array(self.about["action_scale"])
        self._terms = [part["name"] for part in self.about["observation"]]
        for name in self._terms:
            if name not in TERMS:
                raise SystemExit(f"{file}: the policy sees '{name}', which this example does not know; add it to Policy._seen")

    def require(self, measured: set[str]) -> None:
        """Exit if a robot that measures this, by the names of `Readings`, lacks something that the policy needs."""
        for part in self.about["measures"]:
            if part["name"] not in measured:
                what = f"'{part['name']}' [{part['unit']}, {part['frame']}]"
                raise SystemExit(f"the robot does not measure {what}, which the policy needs for: {', '.join(part['for'])}")

    def start(self, readings: Readings) -> None:
        """Begin to walk: forget the past and take the present heading as reference."""
        self._steps = 0
        self._last_action = np.zeros(len(self._nominal))
        self._reference_heading = yaw(readings.quat)
        self._lag = np.zeros(2)  # how far the robot is behind the commanded velocity, forward and to the left [m]
        self._frames: list[np.ndarray] = []  # the newest first

    def joint_targets(self, readings: Readings, command: np.ndarray) -> np.ndarray:
        """Return joint targets [rad | m] for the next `step_dt`; call once per `step_dt`.

        Args:
            readings: the sensors, now.
            command: (vx forward, vy left, yaw rate) [m/s, m/s, rad/s].
        """
        if self._steps > 0:
            self._reference_heading += self.about["step_dt"] * command[2]
            self._advance_lag(readings, command)
        seen, history = self._seen(readings, command), self.about["history"]
        frame = np.concatenate([seen[name] for name in self._terms])
        self._frames = [frame, *(self._frames or [frame] * history)][:history]
        obs = np.concatenate(self._frames).astype(np.float32)
        self._last_action = self._session.run(["actions"], {"obs": obs[None]})[0][0]
        self._steps += 1
        return self._nominal + self._scale * self._last_action

    def _advance_lag(self, readings: Readings, command: np.ndarray) -> None:
        """Let a step pass on the lag; it counts as far as it changes the command."""
        gain, limit = self.about["velocity_gain"], self.about["velocity_limit"]
        if gain and readings.lin_vel is not None:
            lag = self._lag + self.about["step_dt"] * (command[:2] - readings.lin_vel[:2])
            self._lag = np.clip(lag, -limit / gain, limit / gain)

    def _seen(self, readings: Readings, command: np.ndarray) -> dict[str, np.ndarray]:
        """Return the values of all `TERMS`."""
        about = self.about
        error = (self._reference_heading - yaw(readings.quat) + np.pi) % (2.0 * np.pi) - np.pi
        correction = np.clip(about["heading_gain"] * error, -about["heading_limit"], about["heading_limit"])
        phase = np.sin(2.0 * np.pi * self._steps * about["step_dt"] / about["gait_period"])
        return {
            "joint_pos": readings.joint_pos - self._nominal,
            "joint_vel": readings.joint_vel,
            "last_action": self._last_action,
            "base_lin_vel": np.zeros(3) if readings.lin_vel is None else readings.lin_vel,  # not there: not seen
            "base_ang_vel": readings.ang_vel,
            "base_quat": relative_to_heading(readings.quat, self._reference_heading),
            "projected_gravity": to_body(np.array([0.0, 0.0, -1.0]), readings.quat),
            "command": np.array([*(command[:2] + about["velocity_gain"] * self._lag), command[2] + correction]),
            "phase": np.array([phase, -phase]),
        }


class SimulatedRobot:
    """The robot's sensors and motors, in MuJoCo."""

    measures = frozenset(("joint_pos", "joint_vel", "ang_vel", "quat", "lin_vel"))

    def __init__(
        self,
        file: Path,
        about: dict,
        names: Mapping[str, str] | None = None,
        sensors: Mapping[str, str] | None = None,
        delay: float = 0.0,
    ) -> None:
        """Stand in the pose `home`, with the gains that the policy was trained with; exit if the robot is another one.

        Args:
            file: MJCF of the robot.
            about: the policy's description.
            names: what this robot calls a joint of the policy, where it has another name.
            sensors: which sensor of the MJCF measures "ang_vel", "quat" or "lin_vel"; the truth is told where none is named.
            delay: by which targets reach the motors late [s].
        """
        own = dict(names or {})
        self.model = mujoco.MjModel.from_xml_path(str(file))
        self.data = mujoco.MjData(self.model)
        self.model.opt.timestep = about["physics_dt"]
        if self.model.njnt == 0 or self.model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
            raise SystemExit(f"{file}: the first joint must be a free joint, that of the trunk")
        joints = [self._joint(own.get(str(name), str(name)), file) for name in about["joint_names"]]
        self._sensors = {what: self._sensor(what, name, file) for what, name in (sensors or {}).items()}
        self._qpos, self._qvel = [joint.qposadr[0] for joint in joints], [joint.dofadr[0] for joint in joints]
        self._motors = [self._motor(joint, file) for joint in joints]
        self._substeps = round(about["step_dt"] / about["physics_dt"])
        for motor, kp, kd, limits in zip(self._motors, about["stiffness"], about["damping"], about["force_range"], strict=True):
            gear = self.model.actuator_gear[motor, 0]  # gains and limits of the policy are those at the joint
            self.model.actuator_ctrlrange[motor] = np.sort(self.model.actuator_ctrlrange[motor] / gear)
            self.model.actuator_gear[motor, 0] = 1.0
            self.model.actuator_gainprm[motor, 0] = kp
            self.model.actuator_biasprm[motor, :3] = 0.0, -kp, -kd
            self.model.actuator_forcelimited[motor], self.model.actuator_forcerange[motor] = True, limits
        homes = [i for i in range(self.model.nkey) if self.model.key(i).name == "home"]
        if not homes:
            raise SystemExit(f"{file}: no keyframe named 'home' to start from")
        mujoco.mj_resetDataKeyframe(self.model, self.data, homes[0])
        self._late = deque([np.array(about["nominal_pose"])] * round(delay / about["physics_dt"]))  # on their way to the motors

    def _joint(self, name: str, file: Path):
        if mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name) < 0:
            raise SystemExit(f"{file}: no joint named '{name}', which the policy moves")
        return self.model.joint(name)

    def _motor(self, joint, file: Path) -> int:
        on_joint = self.model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
        motors = np.flatnonzero(on_joint & (self.model.actuator_trnid[:, 0] == joint.id))
        if not len(motors):
            raise SystemExit(f"{file}: no actuator moves joint '{joint.name}'")
        return int(motors[0])

    def _sensor(self, what: str, name: str, file: Path) -> slice:
        size = {"ang_vel": 3, "quat": 4, "lin_vel": 3}.get(what)
        if size is None:
            raise SystemExit(f"no sensor is needed for '{what}'; those of 'ang_vel', 'quat' and 'lin_vel' may be named")
        if mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_SENSOR, name) < 0:
            raise SystemExit(f"{file}: no sensor named '{name}', which is to measure '{what}'")
        if self.model.sensor(name).dim[0] != size:
            raise SystemExit(f"{file}: sensor '{name}' has {self.model.sensor(name).dim[0]} numbers, and '{what}' has {size}")
        return slice(self.model.sensor(name).adr[0], self.model.sensor(name).adr[0] + size)

    def read(self) -> Readings:
        """Read the sensors that have been named, and of the rest the true state; the trunk's free joint comes first."""
        qpos, qvel = self.data.qpos, self.data.qvel
        trunk = {"lin_vel": to_body(qvel[:3], qpos[3:7]), "ang_vel": qvel[3:6].copy(), "quat": qpos[3:7].copy()}
        if self._sensors:
            mujoco.mj_forward(self.model, self.data)  # what they measure is else that of the step before
            trunk |= {what: self.data.sensordata[place].copy() for what, place in self._sensors.items()}
        return Readings(joint_pos=qpos[self._qpos], joint_vel=qvel[self._qvel], **trunk)

    def move(self, joint_targets: np.ndarray) -> None:
        """Hold the targets for one policy step, from when they arrive."""
        for _ in range(self._substeps):
            self._late.append(joint_targets)
            self.data.ctrl[self._motors] = self._late.popleft()
            mujoco.mj_step(self.model, self.data)


def walk(
    policy: Policy, robot: SimulatedRobot, command: np.ndarray, duration: float, show: Callable[[float], None] = lambda t: None
) -> np.ndarray:
    """Walk for `duration` [s], and return the trajectory qpos, (steps, nq), one row after each policy step."""
    steps = round(duration / policy.about["step_dt"])
    trajectory = np.zeros((steps, robot.model.nq))
    policy.require(set(robot.measures))
    policy.start(robot.read())
    for step in range(steps):
        robot.move(policy.joint_targets(robot.read(), command))
        trajectory[step] = robot.data.qpos
        show((step + 1) * policy.about["step_dt"])
    return trajectory


def yaw(quat: np.ndarray) -> float:
    """Return the heading [rad] of the x axis of the orientation w x y z."""
    w, x, y, z = quat
    return float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))


def to_body(vector: np.ndarray, quat: np.ndarray) -> np.ndarray:
    """Express a vector of the world's frame in that of the orientation w x y z."""
    inverse, turned = quat * [1.0, -1.0, -1.0, -1.0], np.zeros(3)
    mujoco.mju_rotVecQuat(turned, vector, inverse)
    return turned


def relative_to_heading(quat: np.ndarray, heading: float) -> np.ndarray:
    """Return the orientation as seen from the reference heading [rad], with w >= 0: q_z(-heading) q."""
    c, s = np.cos(0.5 * heading), np.sin(0.5 * heading)
    w, x, y, z = quat
    relative = np.array([c * w + s * z, c * x + s * y, c * y - s * x, c * z - s * w])
    return -relative if relative[0] < 0.0 else relative


def pair(text: str) -> tuple[str, str]:
    """Read `a=b`."""
    key, equals, value = text.partition("=")
    if not (key and equals and value):
        raise argparse.ArgumentTypeError(f"'{text}' is not of the form NAME=NAME")
    return key, value


def main() -> None:
    """Walk and print how fast."""
    parser = argparse.ArgumentParser(description="Walk an exported policy in plain MuJoCo.")
    parser.add_argument("policy", type=Path, help="ONNX file from scripts/export.py")
    parser.add_argument("model", type=Path, help="MJCF of the robot, assets/telebip.xml")
    parser.add_argument("--command", nargs=3, type=float, default=(0.7, 0.0, 0.0), metavar=("VX", "VY", "WZ"))
    parser.add_argument("--duration", type=float, default=20.0, help="s (default: 20)")
    parser.add_argument(
        "--delay", type=float, default=0.0, metavar="MS", help="targets reach the motors late by this (default: 0)"
    )
    parser.add_argument(
        "--rename", nargs="+", type=pair, default=[], metavar="JOINT=NAME", help="joints with names of their own"
    )
    parser.add_argument(
        "--sensor", nargs="+", type=pair, default=[], metavar="WHAT=NAME", help="sensors of ang_vel, quat, lin_vel"
    )
    options = parser.parse_args()

    try:
        policy = Policy(options.policy)
        names, sensors = dict(options.rename), dict(options.sensor)
        robot = SimulatedRobot(options.model, policy.about, names, sensors, 1e-3 * options.delay)
    except ValueError as error:
        raise SystemExit(f"{options.model}: {error}") from error

    def show(t: float) -> None:
        if t % 2.0 < 0.5 * policy.about["step_dt"]:
            x, y, z = robot.data.qpos[:3]
            print(f"{t:5.1f} s   x {x:6.2f} m   y {y:6.2f} m   hips {z:.2f} m above ground")

    trajectory = walk(policy, robot, np.array(options.command), options.duration, show)
    distance = np.linalg.norm(trajectory[-1, :2] - trajectory[0, :2])
    print(f"{distance:.1f} m in {options.duration:g} s: {distance / options.duration:.2f} m/s")


if __name__ == "__main__":
    main()
