# pyright: reportAttributeAccessIssue=false
"""Errors of the sensors, on both engines: what the policy sees, what the motors do, and what the truth still is."""

import copy
import itertools
import math

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor
from worlds import MakeEnv, random_actions

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.math import matrix, yaw
from telebip.robot import Robot
from telebip.sim import Backend

TRUTH = (
    "observations.truth={joint_pos: {}, base_lin_vel: {}, base_ang_vel: {}, base_quat: {}, projected_gravity: {}, command: {}, "
    "noise: false}"
)
SEEN = TRUTH.replace("truth=", "seen=").replace("noise: false", "noise: true")
ERRORS = (
    "events.encoder_bias={hinge: 0.05, slide: 0.01}",
    "events.imu_orientation={angle: 0.1}",
    "events.gyro_bias={rate: 0.05}",
    "events.attitude_error={tilt: 0.05, time: 0.5}",
)
PLACES = {"joint_pos": 6, "base_lin_vel": 3, "base_ang_vel": 3, "base_quat": 4, "projected_gravity": 3, "command": 3}


def walked(env: TelebipEnv, steps: int = 12) -> dict[str, dict[str, Tensor]]:
    """Move, and return what the groups see then, by term."""
    obs = env.get_observations()
    for action in random_actions(steps, env.num_envs, 0.3):
        obs, _, dones, _ = env.step(action)
        assert not dones.any()
    parts = {name: obs[name].split(list(PLACES.values()), dim=1) for name in ("truth", "seen")}
    return {name: dict(zip(PLACES, values, strict=True)) for name, values in parts.items()}


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_biased_encoder_misleads_policy_and_motors_alike(make_env: MakeEnv, robot: Robot, backend: Backend) -> None:
    env = make_env(TRUTH, SEEN, ERRORS[0], calm=True, backend=backend)
    bias = env.state.memory["encoder_bias"]["bias"]
    limits = torch.tensor([0.05, 0.05, 0.01] * 2)
    assert (bias.abs() <= limits).all() and (bias.abs().amax(0) > 0.2 * limits).all()
    # The same as a motor whose own reading has the offset: tau = kp (q_target - (q + b)) - kv qd.
    model = copy.copy(robot.engine_model())
    model.actuator_biasprm[:, 0] = -model.actuator_gainprm[:, 0] * bias[2].double().numpy()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = (x[2].double().numpy() for x in (env.sim.state.qpos, env.sim.state.qvel))
    for action in random_actions(6, 4, 0.3):
        obs = env.step(action)[0]
        data.ctrl[:] = env.state.joint_target[2].double().numpy()
        for _ in range(4):
            mujoco.mj_step(model, data)
    np.testing.assert_allclose(env.sim.state.qpos[2].numpy(), data.qpos, atol=1e-5 if backend == "native" else 1e-3)
    torch.testing.assert_close(obs["seen"][:, :6] - obs["truth"][:, :6], bias, atol=1e-6, rtol=0.0)


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_an_imu_that_is_mounted_askew_tells_what_mujoco_s_would(make_env: MakeEnv, robot: Robot, backend: Backend) -> None:
    env = make_env(TRUTH, SEEN, ERRORS[1], calm=True, backend=backend)
    obs, angles = walked(env), env.state.memory["imu_orientation"]["angles"]
    assert (angles.abs() <= 0.1).all() and (angles.abs().amax(0) > 0.02).all()
    model = copy.copy(robot.model)
    data, site = mujoco.MjData(model), model.site("imu").id
    for world in range(4):
        quat = np.array([1.0, *(0.5 * angles[world].double().numpy())])
        model.site_quat[site] = quat / np.linalg.norm(quat)
        mujoco.mj_setConst(model, data)
        data.qpos[:], data.qvel[:] = (x[world].double().numpy() for x in (env.sim.state.qpos, env.sim.state.qvel))
        mujoco.mj_forward(model, data)
        seen = {name: values[world].double().numpy() for name, values in obs["seen"].items()}
        np.testing.assert_allclose(seen["base_ang_vel"], data.sensor("gyro").data, atol=1e-5)
        down = data.site("imu").xmat.reshape(3, 3).T @ [0.0, 0.0, -1.0]
        np.testing.assert_allclose(seen["projected_gravity"], down, atol=1e-5)
        velocity = data.site("imu").xmat.reshape(3, 3).T @ data.qvel[:3]
        np.testing.assert_allclose(seen["base_lin_vel"], velocity, atol=1e-5)
        # The heading counts from that with which the sensor began: that of the mounting is not seen.
        expected = data.site("imu").xmat.reshape(3, 3)
        relative = matrix(obs["seen"]["base_quat"][world]).double().numpy()
        np.testing.assert_allclose(relative[2], expected[2], atol=1e-5)


def test_the_gyro_s_bias_is_seen_and_lets_the_heading_drift(make_env: MakeEnv) -> None:
    env = make_env(TRUTH, SEEN, ERRORS[2], "commands.heading_gain=1.0", "commands.heading_limit=9.0", calm=True)
    env.set_command(0.0, 0.0, 0.0)
    obs, bias = walked(env), env.state.memory["gyro_bias"]["bias"]
    assert (bias.abs() <= 0.05).all() and (bias.abs().amax(0) > 0.01).all()
    seen, truth = obs["seen"], obs["truth"]
    torch.testing.assert_close(seen["base_ang_vel"] - truth["base_ang_vel"], bias, atol=1e-6, rtol=0.0)
    drift = 12 * 0.02 * bias[:, 2]
    torch.testing.assert_close(yaw(seen["base_quat"]) - yaw(truth["base_quat"]), drift, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(seen["projected_gravity"], truth["projected_gravity"], atol=1e-6, rtol=0.0)
    # The heading hold steers by what the robot takes for its heading.
    correction = env.state.reference_heading - (yaw(env.sim.state.base_quat) + drift)
    torch.testing.assert_close(env.state.command[:, 2], correction, atol=1e-5, rtol=0.0)


def test_the_attitude_filter_s_error_wanders_with_its_size_and_correlation_time(make_env: MakeEnv) -> None:
    env = make_env(TRUTH, SEEN, ERRORS[3], "terminations.fallen.min_hip_height=0", num_envs=2048, calm=True)
    angles, errors = env.state.memory["attitude_error"]["angles"], []
    assert not angles.any()
    step = env.view()
    for _ in range(150):
        env._events.happen("step", step)
        env._random.draw(env.generator)
        errors.append(angles.clone())
    error = torch.stack(errors)[75:]  # 3 correlation times later
    assert not error[:, :, 2].any()
    assert error[:, :, :2].std().item() == pytest.approx(0.05, rel=0.03)
    later = (error[25:50, :, :2] * error[:25, :, :2]).mean() / error[:50, :, :2].square().mean()
    assert later.item() == pytest.approx(math.exp(-1.0), abs=0.04)  # after 25 steps of 0.02 s
    # To first order, R(e)^T (0, 0, -1) = (0, 0, -1) + e x (0, 0, 1).
    seen, truth = env.view().measured.projected_gravity, env.view().projected_gravity
    expected = torch.stack([angles[:, 1], -angles[:, 0]], dim=1)
    torch.testing.assert_close((seen - truth)[:, :2], expected, atol=1e-2 * 0.2, rtol=0.02)


def test_all_errors_together_leave_the_truth_alone(make_env: MakeEnv) -> None:
    plain, env = make_env(TRUTH, SEEN, calm=True), make_env(TRUTH, SEEN, *ERRORS[1:], calm=True)
    plain.sim.reset(torch.ones(4, dtype=torch.bool), env.sim.state.qpos.clone(), env.sim.state.qvel.clone())
    for action in random_actions(5, 4, 0.3):
        seen, true = env.step(action)[0], plain.step(action)[0]
        torch.testing.assert_close(env.sim.state.qpos, plain.sim.state.qpos)
        torch.testing.assert_close(seen["truth"][:, :12], true["truth"][:, :12])
    assert not torch.isclose(seen["seen"][:, 6:12], true["seen"][:, 6:12]).any(1).all()


def test_errors_are_drawn_anew_where_an_episode_begins(make_env: MakeEnv) -> None:
    env = make_env(*ERRORS, calm=True)
    names = ("encoder_bias", "imu_orientation", "gyro_bias")
    before = {name: {key: value.clone() for key, value in env.state.memory[name].items()} for name in names}
    env.reset(torch.tensor([True, False, True, False]))
    for name, part in before.items():
        for key, value in part.items():
            same = (env.state.memory[name][key] == value).all(1)
            assert same.tolist() == [False, True, False, True]


def test_a_kind_of_error_is_there_once(robot: Robot) -> None:
    more = "events.again={term: gyro_bias, rate: 0.1}"
    with pytest.raises(UserError, match=r"events\.again: there is a 'gyro_bias' already, and it can be there once"):
        TelebipEnv(load_task("telebip_flat", ["num_envs=1", ERRORS[2], more]), robot, "cpu", "native")


def test_a_lost_frame_keeps_what_the_sensors_told_before_and_nothing_else(make_env: MakeEnv) -> None:
    lossy = "observations.lossy={joint_pos: {}, phase: {}, joint_vel: {}, last_action: {}, loss: 0.3}"
    exact = lossy.replace("lossy", "exact").replace("loss: 0.3", "loss: 0.0")
    env = make_env(lossy, exact, "episode.length=0.4", calm=True, num_envs=64)
    sensed = torch.tensor([True] * 6 + [False] * 2 + [True] * 6 + [False] * 6)
    before, lost = env.get_observations()["lossy"], []
    assert torch.equal(before, env.get_observations()["exact"])
    for action in random_actions(60, 64, 0.3):
        obs, _, dones, _ = env.step(action)
        exact_now, now = obs["exact"], obs["lossy"]
        is_lost = (now[:, :6] != exact_now[:, :6]).any(1)
        assert torch.equal(now, torch.where(is_lost[:, None] & sensed, before, exact_now))
        assert not is_lost[dones].any()  # an episode begins with what is there
        assert torch.equal(env.get_observations()["lossy"], now)
        lost.append(is_lost[~dones])
        before = now.clone()
    assert torch.cat(lost).float().mean().item() == pytest.approx(0.3, abs=0.03)


def test_a_history_of_lost_frames_repeats_the_one_before(make_env: MakeEnv) -> None:
    env = make_env("observations.old={joint_pos: {}, loss: 0.5, history: 3}", calm=True, num_envs=16)
    seen = [env.get_observations()["old"]]
    for action in random_actions(20, 16, 0.3):
        seen.append(env.step(action)[0]["old"])
    for before, now in itertools.pairwise(seen):
        assert torch.equal(now[:, 6:], before[:, :12])
    repeated = torch.stack([(x[:, :6] == x[:, 6:12]).all(1) for x in seen[3:]])
    assert repeated.float().mean().item() == pytest.approx(0.5, abs=0.1)
