# pyright: reportAttributeAccessIssue=false
"""The environment: the order of one step, and what it promises to a learner."""

import json
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor
from worlds import (
    CALM,
    EVENTFUL,
    LAST_ACTION,
    MORE_EVENTFUL,
    NEVER_FALL,
    PHASE,
    HostReads,
    MakeEnv,
    observe,
    put,
    put_low,
    random_actions,
)

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.math import rotate_inverse, wrap_angle
from telebip.robot import Robot
from telebip.sim import Backend, SimState

HALF = math.sqrt(0.5)


@pytest.mark.parametrize("num_envs", [1, 4])
def test_it_is_an_rsl_rl_vec_env(make_env: MakeEnv, num_envs: int) -> None:
    env = make_env(num_envs=num_envs)
    assert isinstance(env, VecEnv)
    assert (env.num_envs, env.num_actions, env.max_episode_length) == (num_envs, 6, 500)  # 10 s at 50 Hz
    assert env.step_dt == pytest.approx(0.02)
    for obs, rewards, dones, extras in (env.step(torch.zeros(num_envs, 6)) for _ in range(2)):
        assert obs.batch_size == (num_envs,)
        assert (obs["policy"].shape, obs["policy"].dtype) == ((num_envs, 33), torch.float32)
        assert (rewards.shape, rewards.dtype) == ((num_envs,), torch.float32)
        assert (dones.shape, dones.dtype) == ((num_envs,), torch.bool)
        assert (extras["time_outs"].shape, extras["time_outs"].dtype) == ((num_envs,), torch.bool)
        assert {value.shape for value in extras["log"].values()} == {()}
    assert env.episode_length_buf.tolist() == [2] * num_envs


def test_ages_that_are_assigned_go_to_the_same_memory(make_env: MakeEnv) -> None:
    """As rsl-rl's runner assigns them, to spread the time-outs; a CUDA graph would not see another tensor."""
    env = make_env(num_envs=3)
    before = env.episode_length_buf
    env.episode_length_buf = torch.tensor([1, 2, 3])
    assert before.tolist() == [1, 2, 3]
    env.step(torch.zeros(3, 6))
    assert before.tolist() == [2, 3, 4]


@pytest.mark.parametrize("shape", [(4, 5), (3, 6), (6,), (4, 6, 1)])
def test_actions_of_another_shape_are_refused(make_env: MakeEnv, shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"\(4, 6\)"):
        make_env().step(torch.zeros(shape))


def test_observation_order(make_env: MakeEnv, robot: Robot) -> None:
    env = make_env("commands.heading_gain=0.5", "commands.heading_limit=0.2", calm=True)
    env.set_command(0.6, 0.1, 0.3)
    actions = random_actions(5, 4, 0.3)
    for action in actions:
        obs = env.step(action)[0]["policy"].double().numpy()
    qpos, qvel = env.sim.state.qpos.double().numpy(), env.sim.state.qvel.double().numpy()
    for world in range(4):
        quat, inverse, lin_vel_b = qpos[world, 3:7], np.empty(4), np.empty(3)
        mujoco.mju_negQuat(inverse, quat)
        mujoco.mju_rotVecQuat(lin_vel_b, qvel[world, :3], inverse)
        reference, relative = float(env.state.reference_heading[world]), np.empty(4)
        mujoco.mju_mulQuat(relative, np.array([math.cos(reference / 2), 0, 0, -math.sin(reference / 2)]), quat)
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, quat)
        correction = np.clip(0.5 * _wrapped(reference - math.atan2(rotation[3], rotation[0])), -0.2, 0.2)
        phase = math.sin(2 * math.pi * 0.1 / 0.5)  # five steps of 0.02 s, a period of 0.5 s
        expected = np.concatenate(
            [
                qpos[world, 7:] - robot.nominal,
                qvel[world, 6:],
                actions[-1, world].numpy(),
                lin_vel_b,
                qvel[world, 3:6],
                relative * np.sign(relative[0]),
                [0.6, 0.1, 0.3 + correction],
                [phase, -phase],
            ]
        )
        np.testing.assert_allclose(obs[world], expected, atol=2e-6)


def _wrapped(angle: float) -> float:
    return math.remainder(angle, 2 * math.pi)


def test_the_reference_heading_starts_at_the_robots_and_turns_with_the_command(make_env: MakeEnv) -> None:
    env = make_env(calm=True)
    env.set_command(0.5, 0.0, 0.4)
    w, _, _, z = env.sim.state.base_quat.unbind(1)
    start = 2.0 * torch.atan2(z, w)
    assert (wrap_angle(start)[:, None] - wrap_angle(start)).abs().max() > 0.5  # they face different ways
    torch.testing.assert_close(env.state.reference_heading, wrap_angle(start), atol=1e-5, rtol=0.0)
    for _ in range(10):
        env.step(torch.zeros(4, 6))
    torch.testing.assert_close(wrap_angle(env.state.reference_heading - start), torch.full((4,), 0.08), atol=1e-5, rtol=0.0)


def test_the_end_of_the_episode_is_a_time_out_and_not_a_termination(make_env: MakeEnv) -> None:
    env = make_env("episode.length=0.1", "events.start_pose.joint_pos=0")
    for step in range(1, 11):
        _, _, dones, extras = env.step(torch.zeros(4, 6))
        assert dones.tolist() == extras["time_outs"].tolist() == [step % 5 == 0] * 4
        assert extras["log"]["reward/termination"] == 0.0
        assert extras["log"]["walk/falls_per_minute"] == 0.0


def test_a_fall_is_a_termination_and_not_a_time_out_even_at_the_end(make_env: MakeEnv) -> None:
    env = make_env("episode.length=0.1", calm=True)
    for step in range(1, 6):
        if step in (2, 5):
            put_low(env, [1])
        _, _, dones, extras = env.step(torch.zeros(4, 6))
        fell = [step in (2, 5) and world == 1 for world in range(4)]
        late = [step == 5 and world != 1 for world in range(4)]
        assert (dones & ~extras["time_outs"]).tolist() == fell
        assert extras["time_outs"].tolist() == late
        assert extras["log"]["reward/termination"].item() == -0.25 * any(fell)
        if step == 2:
            env.episode_length_buf[1] = 2  # so that its episode, too, would end at step 5


def test_the_reward_is_the_sum_of_its_terms(make_env: MakeEnv) -> None:
    env = make_env("rewards.energy.k_energy=-0.3", num_envs=8)
    seen: set[str] = set()
    for step, action in enumerate(random_actions(20, 8)):
        if step == 10:
            put_low(env, [0])
        _, rewards, _, extras = env.step(action)
        terms = {key: value for key, value in extras["log"].items() if key.startswith("reward/")}
        assert set(terms) == {f"reward/{name}" for name in ("cmd", "diff", "tq", "foot", "energy", "termination")}
        torch.testing.assert_close(rewards.mean(), torch.stack(list(terms.values())).sum(), atol=1e-6, rtol=0.0)
        seen |= {key for key, value in terms.items() if value != 0.0}
    assert seen == set(terms)


def test_the_energy_term_grows_with_the_training_and_is_complete_without_one(make_env: MakeEnv) -> None:
    settings = ("rewards.energy.k_energy=-0.3", "rewards.energy.ramp=[1000,3000]")
    energy = []
    for samples in (0, 2000, 3000, None):
        env = make_env(*settings, calm=True)
        if samples is not None:
            env.set_samples(samples)
        log = env.step(torch.ones(4, 6))[3]["log"]
        energy.append(log["reward/energy"].item())
    assert energy[0] == 0.0 > energy[1]
    assert energy[1:] == pytest.approx([energy[3] / 2, energy[3], energy[3]])


def test_the_observation_after_a_reset_belongs_to_the_new_episode(make_env: MakeEnv) -> None:
    env = make_env(calm=True)
    for action in random_actions(3, 4, 0.3):
        env.step(action)
    put_low(env, [0, 2])
    action = torch.ones(4, 6)
    obs = env.step(action)[0]["policy"]
    assert env.episode_length_buf.tolist() == [0, 4, 0, 4]
    for world in (0, 2):
        assert obs[world, LAST_ACTION].tolist() == [0.0] * 6
        assert obs[world, PHASE].tolist() == [0.0, 0.0]
        assert obs[world, :6].abs().max() <= 0.02 + 1e-6  # events.start_pose.joint_pos
        assert env.sim.state.qpos[world, 2] > 0.6
        assert not env.state.memory["rewards.foot"]["window"][world].any()
        torch.testing.assert_close(obs[world, 24:28], torch.tensor([1.0, 0.0, 0.0, 0.0]), atol=1e-6, rtol=0.0)
    for world in (1, 3):
        assert obs[world, LAST_ACTION].tolist() == [1.0] * 6
        assert obs[world, PHASE.start] == pytest.approx(math.sin(2 * math.pi * 0.08 / 0.5))


def test_commands_are_drawn_anew_after_the_resampling_time_and_only_then(make_env: MakeEnv) -> None:
    ranges = ("commands.lin_vel_x=[0.4,1.0]", "commands.lin_vel_y=[-0.2,0.2]", "commands.ang_vel_z=[-0.5,0.5]")
    env = make_env("commands.resampling_time=0.2", NEVER_FALL, *ranges, calm=True)
    low, high = torch.tensor([0.4, -0.2, -0.5]), torch.tensor([1.0, 0.2, 0.5])
    last = env.state.target_command.clone()
    for step in range(1, 41):
        env.step(torch.zeros(4, 6))
        changed = (env.state.target_command != last).all(dim=1)
        assert changed.tolist() == [step % 10 == 0] * 4
        assert ((low <= env.state.target_command) & (env.state.target_command <= high)).all()
        last = env.state.target_command.clone()


def test_a_new_episode_gets_a_new_command(make_env: MakeEnv) -> None:
    env = make_env(calm=True)
    last = env.state.target_command.clone()
    put_low(env, [2])
    env.step(torch.zeros(4, 6))
    assert (env.state.target_command != last).any(dim=1).tolist() == [False, False, True, False]


def test_a_set_command_stays_through_resets_and_resampling(make_env: MakeEnv) -> None:
    env = make_env("episode.length=0.1", "commands.resampling_time=0.06", "commands.heading_gain=0", calm=True)
    env.set_command(0.3, -0.1, 0.2)
    command = torch.tensor([[0.3, -0.1, 0.2]]).expand(4, -1)
    assert torch.equal(observe(env)[:, 28:31], command)
    dones = torch.zeros(4, dtype=torch.bool)
    for _ in range(12):
        obs, _, done, _ = env.step(torch.zeros(4, 6))
        dones |= done
        assert torch.equal(obs["policy"][:, 28:31], command)
    env.reset()
    assert dones.all()
    assert torch.equal(observe(env)[:, 28:31], command)


def test_pushes_last_their_duration_and_come_at_their_interval(make_env: MakeEnv) -> None:
    push = ("force=40", "duration=0.1", "interval=[0.4,0.4]")
    env = make_env(*(f"events.push.{setting}" for setting in push), NEVER_FALL)
    wrenches = []
    for _ in range(120):
        env.step(torch.zeros(4, 6))
        wrenches.append(env.state.wrench_w.clone())
    wrench = torch.stack(wrenches)
    assert not wrench[:, :, 2:].any()  # horizontal, at the centre of mass
    assert 1.0 < torch.linalg.vector_norm(wrench[..., :2], dim=-1).max() <= 40.0
    for world in range(4):
        active = wrench[:, world].any(dim=1).int()
        edges = torch.diff(active, prepend=torch.zeros(1, dtype=torch.int32))
        starts, ends = torch.nonzero(edges == 1)[:, 0], torch.nonzero(edges == -1)[:, 0]
        assert len(starts) >= 5
        assert set((ends - starts[: len(ends)]).tolist()) == {5}  # 0.1 s
        assert set(torch.diff(starts).tolist()) <= {20, 21}  # 0.4 s
        assert 20 <= starts[0] <= 21
        for start in starts[:-1]:
            assert torch.equal(wrench[start, world], wrench[start + 4, world])


def test_a_push_moves_the_robot_along_it(make_env: MakeEnv) -> None:
    push = [f"events.push.{setting}" for setting in ("force=50", "duration=0.1", "interval=[0.06,0.06]")]
    pushed, calm = make_env(*push, *CALM[1:]), make_env(calm=True)
    qpos = pushed.sim.state.qpos.clone()
    qpos[:, 2] = 3.0  # in the air, where nothing else pushes
    for env in (pushed, calm):
        put(env, list(range(4)), qpos, torch.zeros(4, 12))
    steps = 0
    while not pushed.state.wrench_w.any():
        assert torch.equal(pushed.sim.state.qvel, calm.sim.state.qvel)
        for env in (pushed, calm):
            env.step(torch.zeros(4, 6))
        steps += 1
        assert steps < 10
    difference = (pushed.sim.state.qvel - calm.sim.state.qvel)[:, :2]
    direction = torch.nn.functional.cosine_similarity(difference, pushed.state.wrench_w[:, :2])
    assert direction.min() > 0.9


def test_switched_off_disturbances_are_exactly_absent(make_env: MakeEnv, robot: Robot) -> None:
    env = make_env("episode.length=0.2", calm=True)
    for action in random_actions(30, 4):
        env.step(action)
        assert not env.state.wrench_w.any()
        assert torch.equal(observe(env), observe(env))
    assert env.sim.model_fields == {}
    model = env.sim.model
    assert model.geom("floor").friction.tolist() == robot.model.geom_friction[robot.floor_id].tolist()


def noise_of_a_step(env: TelebipEnv) -> Tensor:
    """Step, and return what the noise adds to the observation."""
    env.step(torch.ones(env.num_envs, 6))
    noisy, noise = observe(env), env.state.random.clone()
    assert torch.equal(observe(env), noisy)  # reading is not drawing
    env.state.random.zero_()
    clean = observe(env)
    env.state.random.copy_(noise)
    return noisy - clean


def test_noise_is_bounded_fresh_and_leaves_what_the_policy_knows(make_env: MakeEnv) -> None:
    env = make_env("events.push=null", num_envs=16)
    draws = torch.stack([noise_of_a_step(env) for _ in range(50)])
    amplitude = torch.cat(
        [torch.full((n,), a) for n, a in ((6, 0.005), (6, 0.1), (6, 0.0), (3, 0.05), (3, 0.1), (4, 0.01), (5, 0.0))]
    )
    spread = draws.amax(dim=(0)) - draws.amin(dim=0)
    assert (spread <= 2.0 * amplitude + 1e-5).all()
    assert (spread >= 1.5 * amplitude).all()  # of 50 uniform draws, the range is below three quarters once in 10^5
    assert torch.equal(spread[:, amplitude == 0.0], torch.zeros(16, 11))


def test_noise_does_not_reach_the_rewards(make_env: MakeEnv) -> None:
    noisy, calm = make_env(*CALM[:2]), make_env(calm=True)
    put(noisy, list(range(4)), calm.sim.state.qpos, calm.sim.state.qvel)
    noisy.state.reference_heading.copy_(calm.state.reference_heading)
    for env in (noisy, calm):
        env.set_command(0.5, 0.0, 0.0)
    for action in random_actions(5, 4, 0.3):
        assert torch.equal(noisy.step(action)[1], calm.step(action)[1])


def test_friction_is_drawn_per_world_and_episode(make_env: MakeEnv) -> None:
    env = make_env("events.friction.range=[0.3,0.9]", num_envs=8)
    friction = env.sim.model_fields["geom_friction"][:, env.sim.model.geom("floor").id, 0]
    first = friction.clone()
    assert len(first.unique()) == 8
    assert ((first >= 0.3) & (first <= 0.9)).all()
    put_low(env, [4])
    env.step(torch.zeros(8, 6))
    assert (friction != first).tolist() == [world == 4 for world in range(8)]


def test_a_fault_is_counted_reset_and_stays_in_its_world(make_env: MakeEnv) -> None:
    healthy, faulty = (make_env("events.push.interval=[0.1,0.3]", num_envs=8) for _ in range(2))
    others = [0, 1, 2, 4, 5, 6, 7]
    for step, action in enumerate(random_actions(20, 8, 0.5)):
        if step == 6:
            qpos = faulty.sim.state.qpos.clone()
            qpos[3, 8] = float("nan")
            put(faulty, [3], qpos, faulty.sim.state.qvel.clone())
        obs, rewards, dones, extras = faulty.step(action)
        expected_obs, expected_rewards, expected_dones, expected_extras = healthy.step(action)
        assert extras["log"]["fault/non_finite_state"].item() == (1 if step == 6 else 0)
        assert expected_extras["log"]["fault/non_finite_state"].item() == 0
        if step == 6:
            assert dones[3]
            assert not extras["time_outs"][3]
            assert faulty.episode_length_buf[3] == 0
        for values in (obs["policy"], rewards, faulty.reward_terms, *extras["log"].values()):
            assert values.isfinite().all()
        assert torch.equal(obs["policy"][others], expected_obs["policy"][others])
        assert torch.equal(rewards[others], expected_rewards[others])
        assert torch.equal(dones[others], expected_dones[others])
        assert torch.equal(faulty.sim.state.qvel[others], healthy.sim.state.qvel[others])


def test_both_backends_show_the_same(make_env: MakeEnv) -> None:
    native, warp = make_env(backend="native"), make_env(backend="warp")
    for action in random_actions(10, 4, 0.3):
        obs_n, rewards_n, dones_n, _ = native.step(action)
        obs_w, rewards_w, dones_w, _ = warp.step(action)
        torch.testing.assert_close(obs_w["policy"], obs_n["policy"], atol=2e-4, rtol=0.0)  # joint velocities lead
        torch.testing.assert_close(rewards_w, rewards_n, atol=1e-4, rtol=0.0)
        assert torch.equal(dones_w, dones_n)


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_the_same_seed_gives_the_same_numbers_and_another_does_not(make_env: MakeEnv, backend: Backend) -> None:
    a, b, other = (make_env(f"seed={seed}", num_envs=8, backend=backend) for seed in (1, 1, 2))
    assert not torch.equal(observe(a), observe(other))
    observe(b)
    ended = 0
    for action in random_actions(80, 8, 1.5):
        obs_a, rewards_a, dones_a, _ = a.step(action)
        obs_b, rewards_b, dones_b, _ = b.step(action)
        assert torch.equal(obs_a["policy"], obs_b["policy"])
        assert torch.equal(rewards_a, rewards_b)
        assert torch.equal(dones_a, dones_b)
        ended += int(dones_a.sum())
    assert ended > 0  # resets are part of it


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
def test_cuda_repeats_itself_within_float32s_reach(robot: Robot) -> None:
    """Sums in another order round differently, and contacts let that grow; within a second it stays below 1e-3."""
    config = load_task("telebip_flat", ["num_envs=64"])
    a, b = (TelebipEnv(config, robot, "cuda", "warp") for _ in range(2))
    for action in random_actions(50, 64, 0.3).cuda():
        seen, again = a.step(action), b.step(action)
        torch.testing.assert_close(seen[0]["policy"], again[0]["policy"], atol=1e-3, rtol=0.0)
        assert torch.equal(seen[2], again[2])


@pytest.mark.parametrize("backend", ["native", "warp"])
@pytest.mark.parametrize("task", [EVENTFUL, MORE_EVENTFUL], ids=["eventful", "more eventful"])
def test_a_step_reads_nothing_back_to_the_host(make_env: MakeEnv, backend: Backend, task: tuple[str, ...]) -> None:
    with HostReads() as control:
        torch.ones(3).sum().item()
        torch.nonzero(torch.ones(3))
        torch.ones(3)[torch.tensor([True, False, True])]
    assert control.seen == ["_local_scalar_dense", "nonzero", "index"]

    ends = ("episode.length=0.06", "commands.resampling_time=0.04", "events.push.interval=[0.02,0.02]")
    env = make_env(*task, *ends, backend=backend)
    with HostReads() as reads:
        for action in random_actions(8, 4):
            env.step(action)
    assert reads.seen == []


def test_time_is_up_at_the_last_step(make_env: MakeEnv) -> None:
    env = make_env(calm=True)
    env.episode_length_buf = torch.tensor([0, 498, 499, 600])
    _, _, dones, extras = env.step(torch.zeros(4, 6))
    assert dones.tolist() == extras["time_outs"].tolist() == [False, False, True, True]


def test_a_task_may_do_without_rewards_terminations_and_events(make_env: MakeEnv) -> None:
    rewards = ("cmd", "diff", "tq", "foot", "energy", "termination")
    none = [*(f"rewards.{name}=null" for name in rewards), "terminations.fallen=null"]
    env = make_env(*none, "events.start_pose=null", "events.start_velocity=null", calm=True)
    torch.testing.assert_close(env.sim.state.qpos, torch.as_tensor(env.robot.home_qpos).float().expand(4, -1))
    put_low(env, [1])
    for _ in range(3):
        _, reward, dones, extras = env.step(torch.zeros(4, 6))
        assert not reward.any()
        assert not dones.any()
        assert extras["log"]["walk/falls_per_minute"] == 0.0


def test_each_termination_ends_an_episode_and_is_counted(make_env: MakeEnv) -> None:
    env = make_env("terminations.tilted={max_tilt: 1.0}", calm=True)
    put_low(env, [0])
    qpos = env.sim.state.qpos.clone()
    qpos[:, 2:7] = torch.tensor([2.0, HALF, HALF, 0.0, 0.0])  # on its side, in the air
    put(env, [1, 3], qpos, torch.zeros(4, 12))
    _, _, dones, extras = env.step(torch.zeros(4, 6))
    assert dones.tolist() == [True, True, False, True]
    per_minute = {name: extras["log"][f"termination/{name}_per_minute"].item() for name in ("fallen", "tilted")}
    assert per_minute == pytest.approx({"fallen": 3000 / 4, "tilted": 2 * 3000 / 4})  # of 3000 steps, in 4 worlds
    assert extras["log"]["walk/falls_per_minute"].item() == pytest.approx(3 * 3000 / 4)


def same(a: object, b: object) -> None:
    """Assert that two results of a step, or parts of them, are the same to the last bit."""
    if isinstance(a, Tensor) and isinstance(b, Tensor):
        torch.testing.assert_close(a, b, rtol=0.0, atol=0.0, equal_nan=True)
    elif isinstance(a, (dict, TensorDict)) and isinstance(b, (dict, TensorDict)):
        assert set(a.keys()) == set(b.keys())
        for name in a.keys():  # noqa: SIM118 (a TensorDict iterates over its rows)
            same(a[name], b[name])
    else:
        assert isinstance(a, (tuple, list)) and isinstance(b, (tuple, list)), (a, b)
        for part, other in zip(a, b, strict=True):
            same(part, other)


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_state_is_gone_on_from_bit_for_bit(make_env: MakeEnv, tmp_path: Path, backend: Backend) -> None:
    first, second = (make_env(*MORE_EVENTFUL, f"seed={seed}", backend=backend) for seed in (1, 2))
    actions = random_actions(40, 4, 0.7)
    for action in actions[:9]:
        first.step(action)
        second.step(-action)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    kept = first.state_dict()
    first.step(actions[0])
    assert not torch.equal(first.state_dict()["sim"]["qpos"], kept["sim"]["qpos"])
    saved = torch.load(tmp_path / "state.pt", weights_only=True)
    same(saved, kept)  # a copy, which the step has not touched
    ended = 0
    for env in (first, second):
        env.load_state_dict(saved)
        same(env.state_dict(), saved)
    for action in actions[9:]:
        same(first.get_observations(), second.get_observations())
        result = first.step(action)
        same(result, second.step(action))
        ended += int(result[2].sum())
    same(first.state_dict(), second.state_dict())
    assert ended > 4


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_what_was_last_seen_is_seen_again_after_loading(make_env: MakeEnv, backend: Backend) -> None:
    """A learner that is resumed observes before it steps; forces and sensors are those of the step before."""
    sensor = "observations.critic.accelerometer={term: sensor, sensor: accelerometer}"
    first, second = (make_env(*MORE_EVENTFUL, sensor, f"seed={seed}", backend=backend) for seed in (1, 2))
    for action in random_actions(9, 4, 0.7):
        obs = first.step(action)[0]
    assert obs["critic"].abs().amax() > 5.0  # the accelerometer shows gravity
    second.load_state_dict(first.state_dict())
    same(second.get_observations(), obs)
    same(first.get_observations(), obs)
    same(first.step(torch.ones(4, 6)), second.step(torch.ones(4, 6)))


@pytest.mark.parametrize(
    "other", [("num_envs=5",), ("events.push=null",), ("observations.policy.history=2",), ("events.mass=null",)]
)
def test_the_state_of_other_worlds_is_refused(make_env: MakeEnv, other: tuple[str, ...]) -> None:
    env, others = make_env(*MORE_EVENTFUL), make_env(*MORE_EVENTFUL, *other)
    before = env.state_dict()
    with pytest.raises(ValueError, match="differs"):
        env.load_state_dict(others.state_dict())
    same(env.state_dict(), before)


def test_a_clone_of_the_state_shares_nothing_and_can_be_taken_over(make_env: MakeEnv) -> None:
    env = make_env(*MORE_EVENTFUL)
    for action in random_actions(5, 4, 0.5):
        env.step(action)
    names = [name for name, _ in env.state.items()]
    assert {"episode_length", "target_command", "rewards.foot.window", "observations.policy.frames"} <= set(names)
    clone, places = env.state.clone(), [value.data_ptr() for _, value in env.state.items()]
    assert [name for name, _ in clone.items()] == names
    before = {name: value.clone() for name, value in clone.items()}
    for action in random_actions(5, 4, 0.5, seed=1):
        env.step(action)
    same(dict(clone.items()), before)
    assert not torch.equal(clone.joint_target, env.state.joint_target)
    env.state.copy_(clone)
    same(dict(env.state.items()), before)
    assert [value.data_ptr() for _, value in env.state.items()] == places  # in place


def test_a_reset_of_the_state_spares_other_worlds_and_what_lasts(make_env: MakeEnv) -> None:
    env = make_env(*MORE_EVENTFUL)
    for _, value in env.state.items():
        value.fill_(1)
    mask = torch.tensor([True, False, True, False])
    env.state.reset(mask)
    lasting = {"held_wrench_w", "target_command", "command", "command_is_fixed", "reference_heading", "joint_target"}
    lasting |= {"wrench_w", "random", "num_steps", "samples"}
    names = dict(env.state.items())
    assert lasting <= names.keys()
    for name, value in names.items():
        assert (value[~mask] == 1).all() if value.dim() else value == 1
        assert (value == 1).all() if name in lasting else not value[mask].any()


def seen_by(env: TelebipEnv, actions: Tensor) -> tuple[dict[str, Tensor], Tensor]:
    """What each group sees at the start and after each step, (steps + 1, num_envs, size), and which episodes then begin."""
    seen = [env.get_observations()]
    new = [torch.ones(env.num_envs, dtype=torch.bool)]
    for action in actions:
        obs, _, dones, _ = env.step(action)
        seen.append(obs)
        new.append(dones)
    return {name: torch.stack([obs[name] for obs in seen]) for name in env.groups}, torch.stack(new)


NOW = "observations.now={joint_pos: {}, joint_vel: {}, last_action: {}, base_lin_vel: {}, phase: {}}"


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_history_and_a_delay_show_exactly_what_was_there_before(make_env: MakeEnv, backend: Backend) -> None:
    late = NOW.replace("observations.now", "observations.late").replace("}}", "}, history: 3, delay: [0, 2]}")
    env = make_env(NOW, late, "episode.length=0.24", calm=True, num_envs=16, backend=backend)
    assert env.groups["late"].size == 3 * env.groups["now"].size == 3 * 23
    seen, new = seen_by(env, random_actions(40, 16, 0.3))
    first = torch.zeros(16, dtype=torch.long)  # step in which the world's episode began
    delays: set[int] = set()
    for t in range(41):
        first[new[t]] = t
        for world in range(16):
            shown = seen["late"][t, world].view(3, -1)
            possible = [
                d
                for d in range(3)
                if all(torch.equal(shown[k], seen["now"][max(t - d - k, int(first[world])), world]) for k in range(3))
            ]
            assert possible
            if t - first[world] >= 4:  # old enough to tell the delays apart
                (delay,) = possible
                delays.add(delay)
    assert delays == {0, 1, 2}
    assert new.sum() > 3 * 16


def test_the_delay_of_an_episode_stays_the_same(make_env: MakeEnv) -> None:
    late = NOW.replace("observations.now", "observations.late").replace("}}", "}, delay: [0, 2]}")
    env = make_env(NOW, late, "episode.length=0.4", calm=True, num_envs=16)
    seen, new = seen_by(env, random_actions(19, 16, 0.1))
    assert not new[1:].any()
    same_as = torch.stack([(seen["late"][2:] == seen["now"][2 - d : 20 - d]).all(-1).all(0) for d in range(3)])
    assert same_as.sum(0).tolist() == [1] * 16
    assert same_as.any(1).all()


def test_the_history_keeps_the_noise_with_which_a_frame_was_seen(make_env: MakeEnv) -> None:
    env = make_env("observations.policy.history=2", num_envs=4)
    seen, new = seen_by(env, random_actions(10, 4, 0.1))
    assert not new[1:].any()
    assert torch.equal(seen["policy"][1:, :, 33:], seen["policy"][:-1, :, :33])
    assert torch.equal(seen["policy"][0, :, 33:], seen["policy"][0, :, :33])


def test_observing_between_steps_changes_nothing(make_env: MakeEnv) -> None:
    asked, env = (make_env(*MORE_EVENTFUL) for _ in range(2))
    for action in random_actions(25, 4, 0.5):
        for _ in range(2):
            asked.get_observations()
        same(asked.step(action), env.step(action))


def test_what_ending_episodes_saw_last_comes_from_before_the_reset(robot: Robot) -> None:
    config = load_task("telebip_flat", ["num_envs=4", "observations.policy.history=2", *CALM, "episode.length=0.1"])
    env = TelebipEnv(config, robot, "cpu", "native", keep_final_obs=True)
    plain = TelebipEnv(config, robot, "cpu", "native")
    last = env.get_observations()
    for step, action in enumerate(random_actions(12, 4, 0.2), start=1):
        obs, _, dones, extras = env.step(action)
        same(plain.step(action)[0], obs)
        final = extras["final_obs"]["policy"]
        assert dones.tolist() == [step % 5 == 0] * 4
        torch.testing.assert_close(final[:, LAST_ACTION], action)
        assert torch.equal(final[:, 33:], last["policy"][:, :33])
        if step % 5:
            assert torch.equal(final, obs["policy"])
        else:
            assert torch.equal(obs["policy"][:, :33], obs["policy"][:, 33:])
            assert not obs["policy"][:, LAST_ACTION].any()
        last = obs


def targets_given(env: TelebipEnv, actions: Tensor, monkeypatch: pytest.MonkeyPatch) -> tuple[Tensor, Tensor]:
    """What the engine is given, (steps, num_envs, ...), and which episodes end, (steps, num_envs)."""
    given, step, ended = [], env.sim.step, []

    def noting(targets: Tensor, wrench_w: Tensor) -> SimState:
        given.append(targets.clone())
        return step(targets, wrench_w)

    monkeypatch.setattr(env.sim, "step", noting)
    for action in actions:
        ended.append(env.step(action)[2])
    return torch.stack(given), torch.stack(ended)


def wanted(env: TelebipEnv, actions: Tensor) -> Tensor:
    """Joint targets of actions (steps, num_envs, 6)."""
    return env.world.nominal + env.world.action_scale * actions


def test_a_fixed_action_delay_gives_the_engine_the_targets_of_earlier_steps(
    make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, actions = make_env("actions.delay=[2,2]", "episode.length=0.12"), random_actions(20, 4, 0.3)
    given, ended = targets_given(env, actions, monkeypatch)
    assert ended.nonzero()[:, 0].tolist() == [step for step in (5, 11, 17) for _ in range(4)]
    assert torch.equal(env.state.joint_target, wanted(env, actions)[-1])  # what is wanted now
    for start in (0, 6, 12, 18):  # each episode's first targets are the home pose
        end = min(start + 6, 20)
        home = env.world.nominal.expand(2, 4, -1)
        expected = torch.cat([home, wanted(env, actions)[start : end - 2]])[: end - start]
        torch.testing.assert_close(given[start:end], expected, atol=1e-6, rtol=0.0)


def test_a_delay_of_three_physics_steps_leaves_one_of_four_to_the_new_target(
    make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch
) -> None:
    env, actions = make_env("actions.physics_delay=[3,3]", "episode.length=0.12"), random_actions(11, 4, 0.3)
    given, _ = targets_given(env, actions, monkeypatch)
    assert given.shape == (11, 4, 4, 6)  # steps, worlds, physics steps, joints
    targets = wanted(env, actions)
    for step in range(11):
        before = targets[step - 1] if step % 6 else env.world.nominal.expand(4, -1)
        expected = torch.stack([before, before, before, targets[step]], dim=1)
        torch.testing.assert_close(given[step], expected, atol=1e-6, rtol=0.0)


def test_delays_in_a_range_are_drawn_per_world_and_episode(make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    env = make_env("actions.delay=[0,1]", "actions.physics_delay=[0,3]", "episode.length=0.2", NEVER_FALL, num_envs=64)
    actions = random_actions(20, 64, 0.3)
    given, _ = targets_given(env, actions, monkeypatch)
    targets, found = wanted(env, actions), []
    for start in (0, 10):
        known = torch.cat([env.world.nominal.expand(2, 64, -1), targets[start : start + 10]])  # from step -2 on
        held = known.repeat_interleave(4, dim=0)  # at each physics step
        seen = given[start : start + 10].transpose(1, 2).flatten(0, 1)  # (40, 64, 6)
        matches = [torch.isclose(seen, held[8 - d : 48 - d], atol=1e-6).all(2).all(0) for d in range(8)]
        assert torch.stack(matches).sum(0).tolist() == [1] * 64  # one delay from 0 to 7 for all of the episode
        found.append(torch.stack(matches).int().argmax(0))
    assert set(found[0].tolist()) == set(found[1].tolist()) == set(range(8))
    assert not torch.equal(*found)


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_a_robot_with_late_actions_moves_as_one_that_gets_them_later(make_env: MakeEnv, backend: Backend) -> None:
    late, env = make_env("actions.delay=[2,2]", calm=True, backend=backend), make_env(calm=True, backend=backend)
    put(late, [0, 1, 2, 3], env.sim.state.qpos.clone(), env.sim.state.qvel.clone())
    actions = random_actions(12, 4, 0.3)
    shifted = torch.cat([torch.zeros(2, 4, 6), actions])
    for action, earlier in zip(actions, shifted, strict=False):
        late.step(action)
        env.step(earlier)
        torch.testing.assert_close(late.sim.state.qpos, env.sim.state.qpos, atol=1e-6, rtol=0.0)


def test_ages_that_are_assigned_do_not_begin_an_episode(make_env: MakeEnv, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pushes still wait for their interval, and delays are drawn."""
    env = make_env("actions.delay=[2,2]", "events.push.interval=[1,1]")
    env.episode_length_buf = torch.tensor([0, 7, 11, 100])
    actions = random_actions(6, 4, 0.1)
    given, ended = targets_given(env, actions, monkeypatch)
    assert not ended.any()
    torch.testing.assert_close(given[2:], wanted(env, actions)[:-2], atol=1e-6, rtol=0.0)
    assert not env.state.wrench_w.any()


def test_a_held_push_acts_until_it_is_ended(make_env: MakeEnv) -> None:
    env = make_env("episode.length=0.1", calm=True)
    forces = torch.tensor([[10.0, 0.0, 0.0], [0.0, -20.0, 5.0], [0.0, 0.0, 0.0], [3.0, 4.0, 0.0]])
    env.push(forces)
    for _ in range(7):  # through a reset
        env.step(torch.zeros(4, 6))
        assert torch.equal(env.state.wrench_w, torch.cat([forces, torch.zeros(4, 3)], dim=1))
    env.reset()
    env.push(torch.tensor([1.0, 2.0, 3.0]))
    env.step(torch.zeros(4, 6))
    assert torch.equal(env.state.wrench_w, torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]).expand(4, -1))
    env.push(torch.zeros(3))
    env.step(torch.zeros(4, 6))
    assert not env.state.wrench_w.any()


def test_a_held_push_adds_to_random_ones(make_env: MakeEnv) -> None:
    pushed, env = (make_env(*EVENTFUL, NEVER_FALL) for _ in range(2))
    pushed.push(torch.tensor([1.0, 2.0, 3.0]))
    both = torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
    seen = False
    for _ in range(12):
        pushed.step(torch.zeros(4, 6))
        env.step(torch.zeros(4, 6))
        torch.testing.assert_close(pushed.state.wrench_w, env.state.wrench_w + both)
        seen = seen or bool(env.state.wrench_w.any())
    assert seen


def momentum(env: TelebipEnv) -> np.ndarray:
    """Linear momentum of each robot [kg m/s], (num_envs, 3), from C MuJoCo."""
    model, data = env.robot.model, mujoco.MjData(env.robot.model)
    rows = []
    for qpos, qvel in zip(env.sim.memory["qpos"].numpy(), env.sim.memory["qvel"].numpy(), strict=True):
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        rows.append(model.body_subtreemass[env.robot.trunk_id] * data.subtree_linvel[env.robot.trunk_id].copy())
    return np.array(rows)


def test_a_held_push_changes_the_momentum_by_force_times_time(make_env: MakeEnv) -> None:
    env = make_env(calm=True)
    qpos = env.sim.state.qpos.clone()
    qpos[:, 2] = 3.0  # in the air, where nothing else pushes
    put(env, [0, 1, 2, 3], qpos, torch.zeros(4, 12))
    before, force = momentum(env), torch.tensor([30.0, -10.0, 5.0])
    env.push(force)
    for _ in range(5):
        env.step(torch.zeros(4, 6))
    gravity = np.array([0.0, 0.0, -env.robot.weight])
    np.testing.assert_allclose(momentum(env) - before, np.tile((force.numpy() + gravity) * 0.1, (4, 1)), atol=0.02)


def test_a_kick_changes_the_momentum_at_once(make_env: MakeEnv) -> None:
    env = make_env("events.kick={lin_vel: 1.0, ang_vel: 0.0, interval: [0.04, 0.04]}", calm=True)
    qpos = env.sim.state.qpos.clone()
    qpos[:, 2] = 3.0
    put(env, [0, 1, 2, 3], qpos, torch.zeros(4, 12))
    changes = []
    for _ in range(4):
        before = momentum(env)
        env.step(torch.zeros(4, 6))
        changes.append(momentum(env)[:, :2] - before[:, :2])
    calm, kicked = [np.abs(change).max() for change in changes[:2]], np.abs(changes[2])
    assert max(calm) < 0.05
    assert (kicked.max(axis=1) > 0.5).all()  # of 13.6 kg
    assert kicked.max() < 13.7


@pytest.mark.parametrize("backend", ["native", "warp"])
def test_masses_are_drawn_per_world_and_episode_and_act(make_env: MakeEnv, backend: Backend) -> None:
    env = make_env("events.mass={scale: [0.5, 2.0]}", "episode.length=0.2", calm=True, num_envs=4, backend=backend)
    mass = env.sim.model_fields["body_mass"].sum(1)
    assert len(mass.unique()) == 4
    previous = mass.clone()
    for step in range(1, 26):
        _, _, dones, _ = env.step(torch.zeros(4, 6))
        changed = env.sim.model_fields["body_mass"].sum(1) != previous
        assert changed.tolist() == dones.tolist() == [step % 10 == 0] * 4
        previous = env.sim.model_fields["body_mass"].sum(1).clone()
        if step % 10 == 9:
            support = env.sim.state.foot_force.sum(1) / (9.81 * previous)
    assert support.mean().item() == pytest.approx(1.0, abs=0.3)
    fresh = make_env("events.mass={scale: [0.5, 2.0]}", "episode.length=0.2", calm=True, num_envs=4, backend=backend)
    fresh.load_state_dict(env.state_dict())
    same(env.step(torch.ones(4, 6)), fresh.step(torch.ones(4, 6)))


def test_each_group_sees_its_own_terms(make_env: MakeEnv) -> None:
    env = make_env(*MORE_EVENTFUL)
    obs = env.reset()
    assert {name: group.shape for name, group in obs.items()} == {"policy": (4, 3 * 33), "critic": (4, 2 * 12)}
    assert {name: group.size for name, group in env.groups.items()} == {"policy": 99, "critic": 24}
    layout = env.layout()
    assert [part["name"] for part in layout["critic"]] == ["joint_pos", "foot_force", "friction", "push_force"]
    assert sum(part["size"] for part in layout["critic"]) == 12
    json.dumps(layout)  # plain data


def test_the_critic_sees_what_the_policy_does_not(make_env: MakeEnv) -> None:
    critic = "observations.critic={foot_force: {}, friction: {}, push_force: {}}"
    env = make_env(critic, *EVENTFUL)
    floor, pushed, ended = env.sim.model.geom("floor").id, 0, 0
    for action in random_actions(30, 4, 0.3):
        obs, _, dones, _ = env.step(action)
        state, weight = env.sim.state, env.robot.weight
        torch.testing.assert_close(obs["critic"][:, :2], state.foot_force / weight)
        torch.testing.assert_close(obs["critic"][:, 2], env.sim.model_fields["geom_friction"][:, floor, 0].float())
        force_b = rotate_inverse(state.base_quat, env.state.wrench_w[:, :3]) / weight
        force_b[dones] = 0.0  # nothing has pushed those that are new
        torch.testing.assert_close(obs["critic"][:, 3:], force_b)
        pushed += int(force_b.any(1).sum())
        ended += int((dones & env.state.wrench_w.any(1)).sum())
    assert pushed > 10
    assert ended > 0
