# pyright: reportAttributeAccessIssue=false
"""What groups of observations show, and when: histories and delays of what is seen and of what is done."""

import json

import pytest
import torch
from torch import Tensor
from worlds import CALM, EVENTFUL, LAST_ACTION, MORE_EVENTFUL, NEVER_FALL, MakeEnv, put, random_actions, same

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.math import rotate_inverse
from telebip.robot import Robot
from telebip.sim import Backend, SimState


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
