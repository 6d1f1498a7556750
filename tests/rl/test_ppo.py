"""`FastPPO` against rsl-rl's own PPO, from the same weights, rollout and shuffle."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.train import Trainer
from telebip.robot import Robot
from tests.worlds import HostReads

SMALL = ("num_envs=8", "ppo.num_steps_per_env=10", "ppo.hidden_dims=[16,16]", "episode.length=0.2")


def rollout(robot: Robot, *overrides: str) -> tuple[Trainer, torch.Tensor]:
    """Return a trainer whose learner has a rollout with falls or time-outs behind it, and the update before it."""
    config = load_task("telebip_flat", [*SMALL, *overrides])
    env = TelebipEnv(config, robot, "cpu", "native")
    trainer = Trainer(env, "telebip_flat", Path())
    learner, obs = trainer.learner, env.get_observations()
    learner.train_mode()
    for iteration in range(2):
        with torch.inference_mode():
            for _ in range(config.ppo.num_steps_per_env):
                obs, rewards, dones, extras = env.step(learner.act(obs))
                learner.process_env_step(obs, rewards, dones, extras)
            learner.compute_returns(obs)
        if iteration == 0:
            learner.update()
    return trainer, obs["policy"]


def stock_copy(learner: PPO) -> PPO:
    """Return rsl-rl's PPO with the learner's weights, optimiser and rollout."""
    names = (
        "num_learning_epochs num_mini_batches clip_param gamma lam value_loss_coef entropy_coef learning_rate "
        "max_grad_norm schedule desired_kl use_mixed_precision"
    )
    settings: dict[str, Any] = {name: getattr(learner, name) for name in names.split()}
    stock = PPO(copy.deepcopy(learner.actor), copy.deepcopy(learner.critic), copy.deepcopy(learner.storage), **settings)
    stock.optimizer.load_state_dict(copy.deepcopy(learner.optimizer.state_dict()))
    stock.train_mode()
    return stock


@pytest.mark.parametrize("overrides", [(), ("ppo.schedule=fixed",), ("ppo.num_mini_batches=3", "ppo.obs_normalization=false")])
def test_an_update_equals_rsl_rls(robot: Robot, overrides: tuple[str, ...]) -> None:
    learner = rollout(robot, "ppo.mixed_precision=never", "ppo.learning_rate=0.001", *overrides)[0].learner
    stock = stock_copy(learner)
    before = copy.deepcopy(learner.save())
    losses = []
    for ppo in (stock, learner):
        torch.manual_seed(7)  # of the shuffle
        losses.append(ppo.update())
    assert losses[1] == pytest.approx(losses[0], rel=1e-4, abs=1e-6)
    assert learner.learning_rate == pytest.approx(stock.learning_rate)
    if not overrides:
        assert learner.learning_rate != 0.001
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, expected in stock.save()[part].items():
            torch.testing.assert_close(learner.save()[part][name], expected, rtol=1e-4, atol=1e-5)
            assert name.endswith("._std") or not torch.equal(before[part][name], expected), name
    moments, expected = learner.optimizer.state_dict(), stock.optimizer.state_dict()
    assert moments["param_groups"] == expected["param_groups"]
    torch.testing.assert_close(moments["state"], expected["state"], rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("precision", ["never", "always"])
def test_a_rollout_holds_what_its_own_policy_said(robot: Robot, precision: str) -> None:
    trainer, _ = rollout(robot, f"ppo.mixed_precision={precision}")
    learner, storage = trainer.learner, trainer.learner.storage
    tolerance = 1e-5 if precision == "never" else 2e-2
    obs = storage.observations.flatten(0, 1)
    assert storage.distribution_params is not None
    mean, std = (x.flatten(0, 1) for x in storage.distribution_params)
    with torch.no_grad():
        torch.testing.assert_close(mean, learner.actor(obs), rtol=tolerance, atol=tolerance)
        torch.testing.assert_close(storage.values.flatten(0, 1), learner.critic(obs), rtol=tolerance, atol=tolerance)
    gaussian = torch.distributions.Normal(mean, std)
    actions = storage.actions.flatten(0, 1)
    torch.testing.assert_close(gaussian.log_prob(actions).sum(1), storage.actions_log_prob.flatten(), rtol=1e-5, atol=1e-4)
    assert 0.3 < ((actions - mean) / std).std() < 3.0


def test_a_rollout_reads_nothing_back_to_the_host(robot: Robot) -> None:
    with HostReads() as control:
        torch.distributions.Normal(torch.zeros(3), torch.ones(3)).sample()  # looks whether every deviation is positive
    assert control.seen == ["normal"]

    config = load_task("telebip_flat", [*SMALL, "ppo.num_steps_per_env=3"])
    trainer = Trainer(TelebipEnv(config, robot, "cpu", "native"), "", Path())
    with torch.inference_mode(), HostReads() as reads:
        trainer.collect(trainer.view.get_observations())
    assert reads.seen == []


def test_actions_are_those_that_rsl_rl_samples(robot: Robot) -> None:
    trainer, policy_obs = rollout(robot)
    learner, obs = trainer.learner, trainer.env.get_observations()
    assert torch.equal(obs["policy"], policy_obs)
    with torch.inference_mode():
        torch.manual_seed(5)
        actions = learner.act(obs)
        torch.manual_seed(5)
        assert torch.equal(actions, learner.actor.distribution.sample())  # type: ignore[union-attr]
