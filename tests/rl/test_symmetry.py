"""A policy that has learned half of the gait treats right and left alike."""

import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor
from worlds import MakeEnv, random_actions

from telebip.mdp.mirror import ACTION, OBSERVATION, PHASE_RIGHT
from telebip.rl.symmetry import SymmetricEnv, SymmetricPolicy


def as_obs(rows: Tensor) -> TensorDict:
    return TensorDict({"policy": rows}, batch_size=[len(rows)])


@pytest.fixture
def half() -> MLPModel:
    torch.manual_seed(0)
    return MLPModel(as_obs(torch.zeros(1, 33)), {"actor": ["policy"]}, "actor", 6, hidden_dims=[32])


def test_the_mirrored_robot_does_the_mirrored_thing(half: MLPModel) -> None:
    policy, rows = SymmetricPolicy(half), torch.randn(64, 33)
    rows[:, PHASE_RIGHT + 1] = -rows[:, PHASE_RIGHT]
    mirrored = rows[:, OBSERVATION[0]] * OBSERVATION[1]
    with torch.inference_mode():
        action = policy(as_obs(rows))
        torch.testing.assert_close(policy(as_obs(mirrored)), action[:, ACTION[0]] * ACTION[1], atol=1e-6, rtol=0.0)
        right = rows[:, PHASE_RIGHT] >= 0.0
        assert 10 < right.sum() < 54
        assert torch.equal(action[right], half(as_obs(rows))[right])
        assert not torch.equal(action[~right], half(as_obs(rows))[~right])


def test_the_learner_sees_half_of_the_gait_and_acts_on_all_of_it(make_env: MakeEnv, half: MLPModel) -> None:
    plain, seen = make_env(calm=True, num_envs=8), SymmetricEnv(make_env(calm=True, num_envs=8))
    policy = SymmetricPolicy(half)
    obs, learner_obs = plain.get_observations(), seen.get_observations()
    with torch.inference_mode():
        for _ in range(40):
            assert (learner_obs["policy"][:, PHASE_RIGHT] >= 0.0).all()
            learner_obs, rewards, dones, _ = seen.step(half(learner_obs))
            obs, expected_rewards, expected_dones, _ = plain.step(policy(obs))
            assert torch.equal(rewards, expected_rewards)
            assert torch.equal(dones, expected_dones)
    assert torch.equal(seen.env.sim.state.qpos, plain.sim.state.qpos)


def test_episode_lengths_are_those_of_the_worlds(make_env: MakeEnv) -> None:
    env = make_env()
    seen = SymmetricEnv(env)
    seen.episode_length_buf = torch.tensor([3, 1, 4, 1])
    seen.step(random_actions(1, 4)[0])
    assert env.episode_length_buf.tolist() == seen.episode_length_buf.tolist() == [4, 2, 5, 2]
