"""A policy that has learned half of the gait treats right and left alike."""

from dataclasses import replace

import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor
from worlds import MakeEnv, random_actions

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.errors import UserError
from telebip.rl.symmetry import Canonical, SymmetricEnv, SymmetricPolicy, joint_mirror
from telebip.robot import Robot

PHASE_RIGHT, HISTORY = 31, ("observations.policy.history=3",)
"""Column of p_r in the newest frame."""
CRITIC = "observations.critic={foot_force: {}, friction: {}, base_lin_vel: {}, phase: {}, history: 2}"


def as_obs(rows: Tensor) -> TensorDict:
    return TensorDict({"policy": rows}, batch_size=[len(rows)])


def canonical_of(env: TelebipEnv) -> Canonical:
    return Canonical(env.cfg, env.layout(), joint_mirror(env.robot))


def network(size: int) -> MLPModel:
    torch.manual_seed(0)
    return MLPModel(as_obs(torch.zeros(1, size)), {"actor": ["policy"]}, "actor", 6, hidden_dims=[32])


@pytest.mark.parametrize("overrides", [(), HISTORY])
def test_the_mirrored_robot_does_the_mirrored_thing(make_env: MakeEnv, overrides: tuple[str, ...]) -> None:
    env = make_env(*overrides)
    size, canonical = env.groups["policy"].size, canonical_of(env)
    half, rows = network(size), torch.randn(64, size)
    rows[:, PHASE_RIGHT + 1] = -rows[:, PHASE_RIGHT]
    policy, mirrored = SymmetricPolicy(half, canonical), canonical.groups["policy"](rows)
    with torch.inference_mode():
        action = policy(as_obs(rows))
        torch.testing.assert_close(policy(as_obs(mirrored)), canonical.joints(action), atol=1e-6, rtol=0.0)
        right = rows[:, PHASE_RIGHT] >= 0.0
        assert 10 < right.sum() < 54
        assert torch.equal(action[right], half(as_obs(rows))[right])
        assert not torch.equal(action[~right], half(as_obs(rows))[~right])


def test_every_group_is_mirrored_by_what_its_terms_declare(make_env: MakeEnv) -> None:
    env = make_env(CRITIC, num_envs=1)
    mirror = canonical_of(env).groups["critic"]
    frame = torch.arange(1.0, 9.0)  # forces, friction, velocity, phase
    image = torch.tensor([2.0, 1.0, 3.0, 4.0, -5.0, 6.0, 8.0, 7.0])
    assert torch.equal(mirror(torch.cat([frame, 10.0 * frame])[None])[0], torch.cat([image, 10.0 * image]))


@pytest.mark.parametrize("overrides", [(), HISTORY])
def test_the_learner_sees_half_of_the_gait_and_acts_on_all_of_it(make_env: MakeEnv, overrides: tuple[str, ...]) -> None:
    plain, seen = make_env(*overrides, calm=True, num_envs=8), SymmetricEnv(make_env(*overrides, calm=True, num_envs=8))
    half = network(plain.groups["policy"].size)
    policy = SymmetricPolicy(half, canonical_of(plain))
    obs, learner_obs = plain.get_observations(), seen.get_observations()
    with torch.inference_mode():
        for _ in range(40):
            assert (learner_obs["policy"][:, PHASE_RIGHT] >= 0.0).all()
            learner_obs, rewards, dones, _ = seen.step(half(learner_obs))
            obs, expected_rewards, expected_dones, _ = plain.step(policy(obs))
            assert torch.equal(rewards, expected_rewards)
            assert torch.equal(dones, expected_dones)
    assert torch.equal(seen.env.sim.state.qpos, plain.sim.state.qpos)


def test_actor_and_critic_see_the_same_half(make_env: MakeEnv) -> None:
    env = make_env(CRITIC, num_envs=8)
    seen = SymmetricEnv(env)
    for action in random_actions(20, 8, 0.3):
        obs = seen.step(action)[0]
        assert set(obs.keys()) == {"policy", "critic"}
        torch.testing.assert_close(obs["policy"][:, -2:], obs["critic"][:, 6:8])
        assert (obs["critic"][:, 6] >= 0.0).all()


def test_episode_lengths_are_those_of_the_worlds(make_env: MakeEnv) -> None:
    env = make_env()
    seen = SymmetricEnv(env)
    seen.episode_length_buf = torch.tensor([3, 1, 4, 1])
    seen.step(random_actions(1, 4)[0])
    assert env.episode_length_buf.tolist() == seen.episode_length_buf.tolist() == [4, 2, 5, 2]


def test_what_has_no_mirror_image_is_refused_by_name(make_env: MakeEnv) -> None:
    without_phase = make_env("observations.policy.phase=null")
    with pytest.raises(UserError, match=r"^ppo\.symmetry=phase: observations\.policy has no term 'phase'"):
        SymmetricEnv(without_phase)
    with pytest.raises(UserError, match=r"^ppo\.symmetry=phase: robot '.*' is not its own mirror image: it has one leg$"):
        Canonical(without_phase.cfg, without_phase.layout(), "it has one leg")
    env = make_env(CRITIC)
    layout = env.layout()
    layout["critic"][1] = {**layout["critic"][1], "mirror": "it declares none"}
    with pytest.raises(
        UserError, match=r"^ppo\.symmetry=phase: observations\.critic\.friction cannot be mirrored: it declares none$"
    ):
        Canonical(env.cfg, layout, joint_mirror(env.robot))


def test_a_group_that_nobody_learns_from_needs_no_mirror_image(make_env: MakeEnv) -> None:
    env = make_env(estimate=True)
    env.groups["estimate"].parts[:] = [replace(part, image="it has none") for part in env.groups["estimate"].parts]
    assert set(SymmetricEnv(env).get_observations().keys()) == {"policy"}


def test_policy_and_critic_of_a_real_robot_have_a_mirror_image(robot: Robot) -> None:
    """Of the critic's frame, the trunk's centre of mass is a vector, and mass, friction and delay are the same."""
    env = TelebipEnv(load_task("telebip_real", ["num_envs=16"]), robot, "cpu", "native")
    canonical, obs = canonical_of(env), env.get_observations()
    for name, group in canonical.groups.items():
        assert torch.equal(group(group(obs[name])), obs[name])
        assert not torch.equal(group(obs[name]), obs[name])
    friction, delay, mass, com = canonical.groups["critic"](obs["critic"])[:, -6:].split([1, 1, 1, 3], dim=1)
    assert torch.equal(torch.cat([friction, delay, mass], dim=1), obs["critic"][:, -6:-3])
    torch.testing.assert_close(com, obs["critic"][:, -3:] * torch.tensor([1.0, -1.0, 1.0]))
    assert com.abs().amax(0).min() > 0.01
    assert len(mass.unique()) == 16
