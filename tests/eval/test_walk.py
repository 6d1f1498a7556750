"""Measures of a walk: synthetic rollouts with known answers, and the shapes of a real one."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from telebip.control.policy import Stateless
from telebip.env import TelebipEnv
from telebip.eval.walk import cost_of_transport, heading_velocity, summarise
from telebip.rollout import Rollout, roll_out

STEP_DT, WEIGHT = 0.02, 130.0  # s, N
JOINTS = ("right_hip_roll", "right_hip_pitch", "right_knee", "left_hip_roll", "left_hip_pitch", "left_knee")


def facing(angle: float | NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the quaternion of a robot that faces `angle` [rad] to the left of x, (..., 4)."""
    half, zero = 0.5 * np.asarray(angle), np.zeros_like(np.asarray(angle, dtype=float))
    return np.stack([np.cos(half), zero, zero, np.sin(half)], axis=-1)


def walk(steps: int = 200, worlds: int = 2, joint_names: tuple[str, ...] = JOINTS, **replaced: Any) -> Rollout:
    """Return a rollout that stands still facing x, with the given arrays in place of zeros (they broadcast)."""
    n = len(joint_names)
    sizes = {"qpos": 7 + n, "qvel": 6 + n, "joint_pos": n, "joint_target": n, "joint_force": n, "joint_power": n}
    sizes |= {
        "joint_net_power": n,
        "foot_force": 2,
        "push_w": 3,
        "phase": 2,
        "command": 3,
        "reference_heading": 0,
        "reward": 0,
        "reward_terms": 2,
        "fallen": 0,
    }
    arrays = {}
    for name, size in sizes.items():
        array = np.zeros((steps, worlds, size) if size else (steps, worlds), dtype=bool if name == "fallen" else np.float32)
        if name == "qpos":
            array[..., 3] = 1.0
        if name in replaced:
            array[...] = replaced[name]
        arrays[name] = array
    return Rollout(step_dt=STEP_DT, weight=WEIGHT, joint_names=joint_names, reward_names=("cmd", "foot"), **arrays)


def velocity(forward: float, left: float = 0.0) -> NDArray[np.floating]:
    """Return a row of qvel with this velocity along the world's axes [m/s]."""
    return np.array([forward, left, *[0.0] * 10])


def test_cost_of_transport_is_power_per_weight_and_speed() -> None:
    power, moving = np.full((50, 3), 91.0), np.tile([0.7, 0.0], (50, 3, 1))
    assert cost_of_transport(power, moving, 130.0) == pytest.approx(1.0)  # 91 W / (130 N 0.7 m/s)
    assert cost_of_transport(power, 0.0 * moving, 130.0) == math.inf


def test_cost_of_transport_sums_the_joints_and_ignores_the_swaying() -> None:
    steps = np.arange(200)[:, None]
    qvel = np.zeros((200, 2, 12))
    qvel[..., 0], qvel[..., 1] = 0.5, 0.4 * (-1.0) ** steps
    summary = summarise(walk(qvel=qvel, joint_power=[10.0, 20.0, 5.0, 10.0, 15.0, 5.0]), skip=1.0)
    assert summary.cost_of_transport == pytest.approx(65.0 / (130.0 * 0.5))
    assert summary.cost_of_transport_article == pytest.approx(1.0 + 1.0 / 130.0)
    assert summary.joint_cost_of_transport == pytest.approx([power / 65.0 for power in (10, 20, 5, 10, 15, 5)])


def test_any_number_of_joints_shares_the_cost_of_transport() -> None:
    names = (*JOINTS, "right_ankle", "left_ankle")
    qvel = np.pad(velocity(0.5), (0, 2))
    summary = summarise(walk(joint_names=names, qvel=qvel, joint_power=[10.0] * 8), skip=0.0)
    assert summary.joint_cost_of_transport == pytest.approx([10.0 / 65.0] * 8)
    assert summary.cost_of_transport == pytest.approx(80.0 / 65.0)


def test_positive_work_leaves_out_what_an_actuator_brakes() -> None:
    # 30 W up and 10 W down: |P| = 40 W and P = 20 W, each on average.
    power, net = np.array([40.0, 0, 0, 0, 0, 0]), np.array([20.0, 0, 0, 0, 0, 0])
    summary = summarise(walk(qvel=velocity(0.5), joint_power=power, joint_net_power=net), skip=0.0)
    assert summary.cost_of_transport == pytest.approx(40.0 / 65.0)
    assert summary.cost_of_transport_positive == pytest.approx(30.0 / 65.0)


def test_heading_velocity_of_a_robot_that_faces_left() -> None:
    qpos = np.concatenate([np.zeros(3), facing(math.pi / 2), np.zeros(6)])
    np.testing.assert_allclose(heading_velocity(qpos, velocity(0.0, 0.7)), [0.7, 0.0], atol=1e-12)  # along world y: forward
    np.testing.assert_allclose(heading_velocity(qpos, velocity(0.7, 0.0)), [0.0, -0.7], atol=1e-12)  # along world x: right


def test_speed_error_and_spread() -> None:
    qvel = np.zeros((200, 2, 12))
    qvel[:, 0, 0], qvel[:, 1, 0] = 0.6, 0.8
    qvel[:50] = 9.0  # the first second, which is skipped
    qvel[50:, :, 5] = 0.03
    summary = summarise(walk(qvel=qvel, command=[0.7, 0.0, 0.0]), skip=1.0)
    assert (summary.worlds, summary.duration, summary.skipped) == (2, pytest.approx(4.0), pytest.approx(1.0))
    assert summary.command == pytest.approx((0.7, 0.0, 0.0), abs=1e-5)
    assert summary.speed == pytest.approx((0.7, 0.0), abs=1e-5)
    assert summary.speed_spread == pytest.approx(0.1, abs=1e-5)
    assert summary.speed_ci95 == pytest.approx(1.96 * math.sqrt(2) * 0.1 / math.sqrt(2), abs=1e-5)  # sample deviation, 2 worlds
    assert summary.lin_vel_rms_error == pytest.approx(0.1, abs=1e-5)
    assert summary.lin_vel_error == pytest.approx(0.1, abs=1e-5)
    assert summary.yaw_rate == pytest.approx(0.03, abs=1e-5)


def test_means_over_many_rows_keep_their_digits() -> None:
    rollout = walk(steps=1000, worlds=64, qvel=velocity(0.7), command=[0.7, 0.0, 0.0], joint_power=[91.0, 0, 0, 0, 0, 0])
    summary = summarise(rollout, skip=0.0)
    assert summary.speed[0] == pytest.approx(0.7, abs=1e-5)
    assert summary.cost_of_transport == pytest.approx(1.0, abs=1e-5)
    assert summary.command[0] == pytest.approx(0.7, abs=1e-5)


@pytest.mark.parametrize(("heading", "reference", "drift"), [(0.1, 0.0, 0.1), (3.1, -3.1, 2 * math.pi - 6.2), (-0.2, 0.1, 0.3)])
def test_yaw_drift_wraps(heading: float, reference: float, drift: float) -> None:
    qpos = np.concatenate([np.zeros(3), facing(heading), np.zeros(6)])
    summary = summarise(walk(qpos=qpos, reference_heading=reference), skip=0.0)
    assert summary.yaw_drift_deg == pytest.approx(math.degrees(drift), abs=1e-3)


def test_falls_count_from_the_start() -> None:
    fallen = np.zeros((200, 2), dtype=bool)
    fallen[3, 0] = fallen[100, 0] = fallen[100, 1] = True
    summary = summarise(walk(fallen=fallen), skip=1.0)
    assert (summary.falls, summary.worlds_fallen) == (3, 2)


def test_a_rollout_of_real_worlds(make_env: Callable[..., TelebipEnv]) -> None:
    env = make_env("episode.length=0.2")
    finished: list[int] = []
    rollout = roll_out(env, Stateless(lambda obs: torch.zeros(4, 6)), 15, progress=finished.append)
    assert finished == list(range(1, 16))
    np.testing.assert_allclose(rollout.time, np.linspace(0.02, 0.30, 15))
    assert (rollout.step_dt, rollout.weight) == (pytest.approx(0.02), pytest.approx(13.6 * 9.81))
    assert (rollout.joint_names, rollout.reward_names) == (JOINTS, env.reward_names)
    shapes = {"qpos": (13,), "qvel": (12,), "joint_pos": (6,), "joint_target": (6,), "joint_force": (6,), "joint_power": (6,)}
    shapes |= {
        "joint_net_power": (6,),
        "foot_force": (2,),
        "push_w": (3,),
        "phase": (2,),
        "command": (3,),
        "reference_heading": (),
        "reward": (),
        "reward_terms": (len(env.reward_names),),
        "fallen": (),
    }
    for name, shape in shapes.items():
        assert getattr(rollout, name).shape == (15, 4, *shape), name
    np.testing.assert_allclose(rollout.reward_terms.sum(-1), rollout.reward, atol=1e-6)
    assert not rollout.fallen.any()  # time-outs are no falls
    np.testing.assert_array_equal(rollout.qpos[-1], env.sim.state.qpos.numpy())
    np.testing.assert_array_equal(rollout.joint_pos, rollout.qpos[..., 7:])
    assert np.ptp(rollout.qpos[:, :, 9], axis=0).min() > 0.0  # rows are copies, not one live buffer
    np.testing.assert_allclose(rollout.phase[3, :, 0], math.sin(2 * math.pi * 0.08 / 0.5), rtol=1e-5)
    np.testing.assert_array_equal(
        rollout.joint_target, np.broadcast_to(np.array([0, 0, 0.04] * 2, dtype=np.float32), (15, 4, 6))
    )
