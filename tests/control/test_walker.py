"""The two walkers on the robot: they walk, remember nothing that they should forget, and cannot tell left from right."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from worlds import HostReads, MakeEnv, random_actions

from telebip.config import load_task
from telebip.control.config import load_controller, split_overrides
from telebip.control.factory import PLACEMENTS, make_controller, with_estimate
from telebip.control.walker import Walker
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.eval.walk import summarise
from telebip.rollout import Rollout, roll_out
from telebip.rollout import walk as walk_on

NAMES = pytest.mark.parametrize("name", PLACEMENTS)
SPEEDS, WORLDS = (0.5, 0.7, 1.0, 0.0, -0.3), 4  # m/s, and worlds at each speed


def walk(env: TelebipEnv, name: str, command: tuple[float, float, float], seconds: float) -> Rollout:
    env.set_command(*command)
    return roll_out(env, make_controller(name, env), round(seconds / env.step_dt))


@pytest.fixture(scope="module")
def straight(make_env: MakeEnv) -> dict[str, Rollout]:
    """Five seconds of each walker at all speeds at once."""
    rollouts, commands = {}, torch.tensor([[speed, 0.0, 0.0] for speed in SPEEDS])
    for name in PLACEMENTS:
        env = make_env(calm=True, num_envs=len(SPEEDS) * WORLDS, estimate=True)
        env.set_commands(commands.repeat_interleave(WORLDS, dim=0))
        rollouts[name] = roll_out(env, make_controller(name, env), round(5.0 / env.step_dt))
    return rollouts


@NAMES
@pytest.mark.parametrize("speed", SPEEDS)
def test_it_walks(straight: dict[str, Rollout], name: str, speed: float) -> None:
    first = SPEEDS.index(speed) * WORLDS
    summary = summarise(straight[name].select(slice(first, first + WORLDS)), skip=2.0)
    assert summary.falls == 0
    assert summary.speed == pytest.approx((speed, 0.0), abs=0.06)
    assert summary.yaw_drift_deg < 15.0
    assert summary.gait_period == pytest.approx(2.0 * load_controller(name).step_time, abs=0.02)


@pytest.mark.slow
@NAMES
def test_it_walks_at_the_rate_of_the_physics(make_env: MakeEnv, name: str) -> None:
    env = make_env("sim.decimation=1", calm=True, estimate=True)
    assert env.step_dt == pytest.approx(0.005)
    summary = summarise(walk(env, name, (0.7, 0.0, 0.0), 5.0), skip=2.0)
    assert summary.falls == 0
    assert summary.speed == pytest.approx((0.7, 0.0), abs=0.06)


def heading(rollout: Rollout) -> np.ndarray:
    """Return the heading since the start [rad], (steps, num_envs)."""
    w, x, y, z = np.moveaxis(rollout.qpos[..., 3:7], -1, 0)
    angle = np.unwrap(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)), axis=0)
    return angle - angle[0]


@pytest.mark.slow
@NAMES
def test_it_walks_sideways_and_turns(make_env: MakeEnv, name: str) -> None:
    sideways = summarise(walk(make_env(calm=True, estimate=True), name, (0.3, 0.1, 0.0), 6.0), skip=3.0)
    assert sideways.falls == 0
    assert sideways.speed == pytest.approx((0.3, 0.1), abs=0.05)
    right, left = (walk(make_env(calm=True, estimate=True), name, (0.5, 0.0, rate), 6.0) for rate in (-0.1, 0.1))
    assert not right.fallen.any()
    assert not left.fallen.any()
    # Without a hip yaw joint it follows slowly, on feet that grip: it does turn the right way.
    assert heading(left)[-1].mean() - heading(right)[-1].mean() > 0.02


@NAMES
def test_it_withstands_the_tasks_pushes_friction_and_noise(make_env: MakeEnv, name: str) -> None:
    env = make_env("episode.length=20", num_envs=8, estimate=True)
    assert walk(env, name, (0.7, 0.0, 0.0), 6.0).fallen.sum() <= 1


@NAMES
def test_a_forward_push_neither_fells_it_nor_makes_it_jump(make_env: MakeEnv, name: str) -> None:
    """120 N for 0.1 s, in each world from another moment of the stride on."""
    env = make_env("events.start_pose.heading=0", calm=True, num_envs=24, estimate=True)
    env.set_command(0.7, 0.0, 0.0)
    walking, start = walk_on(env, make_controller(name, env)), 100 + torch.arange(24)
    rise, fallen = torch.zeros(24), torch.zeros(24, dtype=torch.bool)
    for step in range(200):
        since = step - start
        pushing = (since >= 0) & (since < 5)
        env.push(pushing[:, None] * torch.tensor([120.0, 0.0, 0.0]))
        fallen |= next(walking).dones
        rise = torch.maximum(rise, torch.where(since < 0, 0.0, env.sim.state.base_lin_vel_w[:, 2]))
    assert not fallen.any()
    assert rise.max() < 0.35  # m/s


def mirror(obs: Tensor) -> Tensor:
    """Reflect observations in the plane y = 0: legs change sides; y, roll and yaw change sign."""
    leg = torch.tensor([-1.0, 1.0, 1.0]).repeat(2)
    joints = [part.unflatten(1, (2, 3)).flip(1).flatten(1) * leg for part in obs[:, :18].split(6, dim=1)]
    signs = torch.tensor([1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0])
    return torch.cat([*joints, obs[:, 18:31] * signs, obs[:, 31:].flip(1)], dim=1)


def estimate(obs: Tensor) -> TensorDict:
    return TensorDict({"estimate": obs}, batch_size=[len(obs)])


def seen(env: TelebipEnv, name: str, steps: int) -> list[Tensor]:
    """Return what a walker observes while it walks and is disturbed a little."""
    env.set_command(0.6, 0.1, 0.05)
    policy, observations = make_controller(name, env), []
    for noise in random_actions(steps, env.num_envs, 0.1):
        observations.append(env.get_observations()["estimate"])
        env.step(policy(estimate(observations[-1])) + noise)
    return observations


@NAMES
def test_a_mirrored_robot_acts_mirrored(make_env: MakeEnv, name: str) -> None:
    env = make_env(calm=True, estimate=True)
    observations = seen(env, name, 40)
    policy, image = make_controller(name, env), make_controller(name, env)
    leg = torch.tensor([-1.0, 1.0, 1.0]).repeat(2)
    for obs in observations:
        actions, mirrored = policy(estimate(obs)), image(estimate(mirror(obs)))
        expected = actions.unflatten(1, (2, 3)).flip(1).flatten(1) * leg
        torch.testing.assert_close(mirrored, expected, atol=1e-4, rtol=1e-4)
    assert actions.abs().max() > 0.1


@NAMES
def test_a_reset_world_is_as_new_and_the_others_go_on_bit_for_bit(make_env: MakeEnv, name: str) -> None:
    env = make_env(calm=True, estimate=True)
    observations = seen(env, name, 40)
    untouched, reset, new = (make_controller(name, env) for _ in range(3))
    mask = torch.tensor([False, True, False, True])
    for step, obs in enumerate(observations):
        if step == 25:
            reset.reset(mask)
        a, b = untouched(estimate(obs)), reset(estimate(obs))
        assert torch.equal(a[~mask], b[~mask])
        if step >= 25:
            assert torch.equal(b[mask], new(estimate(obs))[mask])
            assert step > 25 or not torch.equal(a[mask], b[mask])


@NAMES
def test_worlds_do_not_know_of_each_other(make_env: MakeEnv, name: str) -> None:
    env = make_env(calm=True, estimate=True)
    observations = seen(env, name, 20)
    order = torch.tensor([2, 0, 3, 1])
    policy, shuffled = make_controller(name, env), make_controller(name, env)
    for obs in observations:
        assert torch.equal(policy(estimate(obs))[order], shuffled(estimate(obs[order])))


@NAMES
def test_a_call_reads_nothing_back_to_the_host(make_env: MakeEnv, name: str) -> None:
    env = make_env(calm=True, estimate=True)
    policy, obs = make_controller(name, env), env.get_observations()
    with HostReads() as reads:
        for step in range(30):
            policy(obs)
            if step % 10 == 5:
                policy.reset(torch.tensor([True, False, False, True]))
    assert reads.seen == []


@NAMES
def test_any_state_gets_a_finite_answer(make_env: MakeEnv, name: str) -> None:
    env = make_env(num_envs=64, estimate=True)
    policy = make_controller(name, env)
    generator = torch.Generator().manual_seed(0)
    low, high = torch.as_tensor(env.robot.joint_range).float().T
    for _ in range(30):  # lying on its back, upside down, at any speed
        obs = 3.0 * torch.randn(64, 33, generator=generator)
        obs[:, 24:28] /= obs[:, 24:28].norm(dim=1, keepdim=True)
        actions = policy(estimate(obs))
        assert actions.isfinite().all()
        target = env.world.nominal + env.world.action_scale * actions
        assert ((target >= low - 1e-5) & (target <= high + 1e-5)).all()


def test_the_estimate_has_the_policys_noise_term_by_term() -> None:
    task = load_task("telebip_flat", ["observations.policy.joint_pos.noise=0.25", "observations.policy.base_lin_vel=null"])
    group = with_estimate(task).observations["estimate"]
    assert {name: params["noise"] for name, params in group.terms.items()} == {
        **{"joint_pos": 0.25, "joint_vel": 0.1, "last_action": 0.0, "base_lin_vel": 0.0, "base_ang_vel": 0.1},
        **{"base_quat": 0.01, "command": 0.0, "phase": 0.0},
    }
    assert group.noise
    assert not with_estimate(load_task(task, ["observations.policy.noise=false"])).observations["estimate"].noise


def test_the_estimate_is_what_telebip_flats_policy_sees(make_env: MakeEnv) -> None:
    env = make_env(calm=True, estimate=True)
    obs, *_ = env.step(random_actions(1, 4)[0])
    assert torch.equal(obs["estimate"], obs["policy"])
    assert obs["estimate"].shape == (4, 33)


def error_of(env: TelebipEnv, name: str, *overrides: str) -> str:
    with pytest.raises(UserError) as caught:
        make_controller(name, env, overrides)
    return str(caught.value)


def test_mistakes_are_one_line_that_names_them(make_env: MakeEnv) -> None:
    env = make_env(estimate=True)
    assert error_of(env, "alp") == "unknown controller 'alp'; did you mean 'alip'?"
    message = error_of(env, "dcm", "control.swing_hight=0.1")
    assert "unknown field 'control.swing_hight'; did you mean 'control.swing_height'?" in message
    assert "control.step_time must be > 0 s, got 0.0" in error_of(env, "dcm", "control.step_time=0")
    assert "control.feet_distance must be [low, high]" in error_of(env, "dcm", "control.feet_distance=[1, 0.1]")


def test_overrides_reach_the_controller(make_env: MakeEnv) -> None:
    policy: Walker = make_controller("alip", make_env(estimate=True), ["control.swing_height=0.1"])
    assert (policy.cfg.swing_height, load_controller("alip").swing_height) != (0.1, 0.1)
    assert split_overrides(["seed=2", "control.step_time=0.3", "gait.period=0.6"]) == (
        ["seed=2", "gait.period=0.6"],
        ["control.step_time=0.3"],
    )
