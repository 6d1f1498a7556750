# pyright: reportAttributeAccessIssue=false
"""The environment: the order of one step, and what it promises to a learner."""

import math

import mujoco
import numpy as np
import pytest
import torch
from rsl_rl.env import VecEnv
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
    same,
)

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.math import wrap_angle
from telebip.robot import Robot
from telebip.sim import Backend

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
