# pyright: reportAttributeAccessIssue=false, reportMissingImports=false
"""The example with a policy in a process of its own: its filter, its loops, and that a robot walks by it."""

import re
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest

from telebip import ROOT
from telebip.rl.checkpoint import load_checkpoint
from telebip.rl.export import export

sys.path.insert(0, str(ROOT / "examples"))
from deploy_mujoco import Readings
from deploy_realtime import AttitudeFilter, Shared, ticks

EXAMPLE = ROOT / "examples" / "deploy_realtime.py"


def test_the_attitude_filter_finds_up_and_integrates_the_heading() -> None:
    """A body that turns at 0.5 rad/s about the vertical, tilted by 0.2 rad; the filter starts upright."""
    tilted = np.array([np.cos(0.1), np.sin(0.1), 0.0, 0.0])
    inverse = tilted * [1.0, -1.0, -1.0, -1.0]
    up, rate = np.zeros(3), np.zeros(3)
    mujoco.mju_rotVecQuat(up, np.array([0.0, 0.0, 9.81]), inverse)
    mujoco.mju_rotVecQuat(rate, np.array([0.0, 0.0, 0.5]), inverse)
    attitude = AttitudeFilter(np.array([1.0, 0.0, 0.0, 0.0]), gain=2.0)
    for _ in range(4000):
        quat = attitude.advance(rate, up, 0.001)
    seen = np.zeros(3)
    mujoco.mju_rotVecQuat(seen, up, quat)
    np.testing.assert_allclose(seen, [0.0, 0.0, 9.81], atol=9.81 * 0.2 * np.exp(-8.0) * 1.2)  # the error decays as exp(-k t)
    before = quat.copy()
    for _ in range(1000):
        quat = attitude.advance(rate, up, 0.001)
    relative = np.zeros(4)
    mujoco.mju_mulQuat(relative, quat, before * [1.0, -1.0, -1.0, -1.0])
    assert 2.0 * np.arctan2(relative[3], relative[0]) == pytest.approx(0.5, abs=1e-3)


def test_the_filter_does_not_trust_an_accelerometer_that_is_shaken() -> None:
    attitude = AttitudeFilter(np.array([1.0, 0.0, 0.0, 0.0]), gain=5.0)
    for _ in range(1000):
        quat = attitude.advance(np.zeros(3), np.array([20.0, 0.0, 9.81]), 0.001)
    np.testing.assert_allclose(quat, [1.0, 0.0, 0.0, 0.0])


def test_what_is_told_is_read() -> None:
    shared = Shared(4)
    readings = Readings(np.arange(4.0), np.arange(4.0, 8.0), np.arange(3.0), np.arange(4.0), np.arange(3.0) + 9.0)
    shared.tell_readings(readings)
    shared.tell_targets(np.arange(4.0) - 7.0)
    for name in ("joint_pos", "joint_vel", "ang_vel", "quat", "lin_vel"):
        np.testing.assert_array_equal(getattr(shared.readings(), name), getattr(readings, name))
    np.testing.assert_array_equal(shared.targets(), np.arange(4.0) - 7.0)


def test_ticks_keep_their_time_and_tell_how_late_they_were() -> None:
    late: list[float] = []
    for tick in ticks(0.002, late):
        if tick == 50:
            break
    assert len(late) == 51
    assert min(late) >= 0.0


def test_it_walks_in_real_time(tmp_path: Path) -> None:
    export(load_checkpoint("assets/policies/telebip_efficient"), tmp_path / "policy.onnx", samples=100)
    command = [sys.executable, str(EXAMPLE), str(tmp_path / "policy.onnx"), str(ROOT / "assets" / "telebip.xml")]
    done = subprocess.run([*command, "--duration", "2"], capture_output=True, text=True, timeout=120, check=True)
    lines = done.stdout.splitlines()
    assert [line.split("  ")[0] for line in lines[1:4]] == [
        "from readings to targets",
        "policy's loop of 20 ms: late by",
        "motors' loop of 1 ms: late by",
    ]
    median = float(lines[1].split()[-3])
    assert 0.0 < median < 20.0  # far less where the processor is free
    walked = re.fullmatch(r"(\S+) m in (\S+) s of the robot's time; hips (\S+) m from where they were", lines[-1])
    assert walked
    assert float(walked[2]) == pytest.approx(2.0, abs=0.5)


def test_a_robot_that_it_cannot_drive_is_one_line(tmp_path: Path) -> None:
    export(load_checkpoint("assets/policies/telebip_efficient"), tmp_path / "policy.onnx", samples=100)
    robot = ROOT / "tests" / "robots" / "four_joints.xml"
    command = [sys.executable, str(EXAMPLE), str(tmp_path / "policy.onnx"), str(robot)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 1
    assert "no joint named" in done.stderr
    assert "Traceback" not in done.stderr
