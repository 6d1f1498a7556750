# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
"""Walk an exported policy in real time: its 50 Hz loop in one process, a robot with a 1 kHz motor loop in another.

    python scripts/export.py --checkpoint assets/policies/telebip_efficient --out policy.onnx
    python examples/deploy_realtime.py policy.onnx assets/telebip.xml --command 0.7 0 0

The two share a few numbers, as a robot's computer and its motor controllers do: readings one way, joint targets the other.
The robot is simulated in steps of 1 ms, in real time. Its inertial measurement unit has a gyro and an accelerometer, of which
`AttitudeFilter` makes the orientation; encoders have no errors, and the velocity, for policies that see it, is the true one.
What is printed at the end: how punctual both loops were, and how long the policy takes from readings to targets. Priorities
help on a busy machine: `chrt -f 50 python ...` on Linux.
"""

import argparse
import ctypes
import itertools
import multiprocessing as mp
import time
from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
from deploy_mujoco import Policy, Readings, SimulatedRobot, to_body

MOTOR_DT = 0.001  # s
SPAWN = mp.get_context("spawn")  # processes that share nothing but what they are given


class AttitudeFilter:
    r"""Orientation from gyro and accelerometer: the gyro is integrated, and turned towards what the accelerometer takes for up.

        w' = w + k (a / |a|) x (R^T z),    q <- q exp(w' dt)

    (Mahony et al. 2008, Nonlinear complementary filters on the special orthogonal group, without the bias.) The correction is
    left out while |a| is far from g: a foot that lands shakes the trunk. The heading is the gyro's integral alone.
    """

    def __init__(self, quat: np.ndarray, gain: float = 0.5, trusted: float = 0.3) -> None:
        """Start from an orientation w x y z; k is `gain` [1/s], and `trusted` the share by which |a| may differ from g."""
        self.quat, self._gain, self._trusted = quat.copy(), gain, trusted

    def advance(self, ang_vel: np.ndarray, acceleration: np.ndarray, dt: float) -> np.ndarray:
        """Take a sample of the gyro [rad/s] and of the accelerometer [m/s^2], and return the orientation."""
        size = float(np.linalg.norm(acceleration))
        if abs(size / 9.81 - 1.0) < self._trusted:
            up = to_body(np.array([0.0, 0.0, 1.0]), self.quat)
            ang_vel = ang_vel + self._gain * np.cross(acceleration / size, up)
        mujoco.mju_quatIntegrate(self.quat, ang_vel, dt)
        return self.quat


class Shared:
    """What the two processes tell each other: one array each way, written and read as a whole."""

    def __init__(self, num_joints: int) -> None:
        """Make room for readings, targets and clocks."""
        self._lock = SPAWN.Lock()
        self._n = num_joints
        self._numbers = SPAWN.RawArray(ctypes.c_double, 2 * num_joints + 10 + num_joints)
        self.ready, self.stop = SPAWN.Event(), SPAWN.Event()

    def _array(self) -> np.ndarray:
        return np.ctypeslib.as_array(self._numbers)

    def tell_readings(self, readings: Readings) -> None:
        """Write what the sensors say."""
        lin_vel = np.zeros(3) if readings.lin_vel is None else readings.lin_vel
        numbers = np.concatenate([readings.joint_pos, readings.joint_vel, readings.ang_vel, readings.quat, lin_vel])
        with self._lock:
            self._array()[: len(numbers)] = numbers

    def readings(self) -> Readings:
        """Return what the sensors said last."""
        n = self._n
        with self._lock:
            numbers = self._array()[: 2 * n + 10].copy()
        joint_pos, joint_vel, ang_vel, quat, lin_vel = np.split(numbers, [n, 2 * n, 2 * n + 3, 2 * n + 7])
        return Readings(joint_pos, joint_vel, ang_vel, quat, lin_vel)

    def tell_targets(self, targets: np.ndarray) -> None:
        """Write joint targets."""
        with self._lock:
            self._array()[2 * self._n + 10 :] = targets

    def targets(self) -> np.ndarray:
        """Return the joint targets that were written last."""
        with self._lock:
            return self._array()[2 * self._n + 10 :].copy()


def ticks(period: float, late: list[float]) -> Iterator[int]:
    """Yield at multiples of `period` [s] from now on, and append by how much each came late [s]; none is left out."""
    start = time.perf_counter()
    for tick in itertools.count():
        wait = start + tick * period - time.perf_counter()
        if wait > 0.0:
            time.sleep(wait)
        late.append(time.perf_counter() - start - tick * period)
        yield tick


def run_robot(file: Path, about: dict, shared: Shared, results: mp.Queue) -> None:
    """Simulate the robot at 1 kHz in real time until `shared.stop` is set; then tell how late it was, and where it has come."""
    robot = SimulatedRobot(file, {**about, "physics_dt": MOTOR_DT, "step_dt": MOTOR_DT})
    start = robot.data.qpos[:3].copy()
    imu = {name: robot.model.sensor(name).adr[0] for name in ("gyro", "accelerometer")}
    attitude = AttitudeFilter(robot.data.qpos[3:7])
    shared.tell_readings(robot.read())
    shared.tell_targets(np.array(about["nominal_pose"]))
    shared.ready.set()
    late: list[float] = []
    for _ in ticks(MOTOR_DT, late):
        if shared.stop.is_set():
            break
        robot.move(shared.targets())
        gyro, acceleration = (robot.data.sensordata[at : at + 3] for at in imu.values())
        quat = attitude.advance(gyro, acceleration, MOTOR_DT)
        truth = robot.read()
        shared.tell_readings(Readings(truth.joint_pos, truth.joint_vel, gyro.copy(), quat.copy(), truth.lin_vel))
    up = to_body(np.array([0.0, 0.0, 1.0]), robot.data.qpos[3:7])
    tilt = float(np.arccos(np.clip(up @ to_body(np.array([0.0, 0.0, 1.0]), attitude.quat), -1.0, 1.0)))
    results.put({"late": late, "moved": robot.data.qpos[:3] - start, "time": robot.data.time, "tilt_error": tilt})


def run_policy(policy: Policy, shared: Shared, command: np.ndarray, duration: float) -> tuple[list[float], list[float]]:
    """Walk for `duration` [s]; return by how much each step came late, and how long it took from readings to targets [s]."""
    late: list[float] = []
    taken: list[float] = []
    policy.start(shared.readings())
    for tick in ticks(policy.about["step_dt"], late):
        if tick * policy.about["step_dt"] >= duration:
            return late, taken
        before = time.perf_counter()
        shared.tell_targets(policy.joint_targets(shared.readings(), command))
        taken.append(time.perf_counter() - before)
    raise AssertionError


def told(name: str, seconds: list[float]) -> str:
    """Return median, 99th percentile and largest of a list in milliseconds."""
    median, high = np.quantile(seconds, [0.5, 0.99]) * 1e3
    return f"{name:<42}{median:9.3f}{high:9.3f}{max(seconds) * 1e3:9.3f}"


def main() -> None:
    """Walk, and print how punctual it was."""
    parser = argparse.ArgumentParser(description="Walk an exported policy in real time, in a process of its own.")
    parser.add_argument("policy", type=Path, help="ONNX file from scripts/export.py")
    parser.add_argument("model", type=Path, help="MJCF of the robot, assets/telebip.xml")
    parser.add_argument("--command", nargs=3, type=float, default=(0.7, 0.0, 0.0), metavar=("VX", "VY", "WZ"))
    parser.add_argument("--duration", type=float, default=10.0, help="s (default: 10)")
    options = parser.parse_args()

    policy = Policy(options.policy)
    policy.require(set(SimulatedRobot.measures))
    shared, results = Shared(len(policy.about["joint_names"])), SPAWN.Queue()
    robot = SPAWN.Process(target=run_robot, args=(options.model, policy.about, shared, results), daemon=True)
    robot.start()
    while not shared.ready.wait(0.1):
        if not robot.is_alive():
            raise SystemExit(1)  # it has said why
    late, taken = run_policy(policy, shared, np.array(options.command), options.duration)
    shared.stop.set()
    found = results.get(timeout=10.0)
    robot.join(timeout=10.0)

    print(f"{'[ms]':<42}{'median':>9}{'99 %':>9}{'most':>9}")
    print(told("from readings to targets", taken))
    print(told(f"policy's loop of {1e3 * policy.about['step_dt']:g} ms: late by", late))
    print(told(f"motors' loop of {1e3 * MOTOR_DT:g} ms: late by", found["late"]))
    print(f"the attitude filter is off by {np.degrees(found['tilt_error']):.2f} degrees at the end")
    moved, lasted = found["moved"], found["time"]
    print(
        f"{np.linalg.norm(moved[:2]):.1f} m in {lasted:.1f} s of the robot's time; hips {moved[2]:+.2f} m from where they were"
    )


if __name__ == "__main__":
    main()
