"""`FastPPO` against rsl-rl's own PPO, from the same weights, rollout and shuffle."""

import copy
from pathlib import Path
from typing import Any

import pytest
import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict

from telebip.config import load_task
from telebip.env import TelebipEnv
from telebip.rl.learner import FIELDS
from telebip.rl.networks import CpuElu, Gaussian
from telebip.rl.ppo import FastPPO
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
    settings: dict[str, Any] = {name: getattr(learner, name) for name in FIELDS}
    stock = PPO(copy.deepcopy(learner.actor), copy.deepcopy(learner.critic), copy.deepcopy(learner.storage), **settings)
    state = copy.deepcopy(learner.optimizer.state_dict())
    for group in state["param_groups"]:
        group["fused"] = None
    stock.optimizer.load_state_dict(state)
    stock.train_mode()
    return stock


PRECISIONS = pytest.mark.parametrize("precision", ["never", "always"])


@PRECISIONS
@pytest.mark.usefixtures("torch_threads")
@pytest.mark.parametrize("overrides", [(), ("ppo.schedule=fixed",), ("ppo.num_mini_batches=3", "ppo.obs_normalization=false")])
def test_an_update_equals_rsl_rls(robot: Robot, overrides: tuple[str, ...], precision: str) -> None:
    learner = rollout(robot, f"ppo.mixed_precision={precision}", "ppo.learning_rate=0.001", *overrides)[0].learner
    assert type(learner) is FastPPO
    stock = stock_copy(learner)
    before = copy.deepcopy(learner.save())
    losses, threads = [], torch.get_num_threads()
    for ppo in (stock, learner):
        torch.manual_seed(7)  # of the shuffle
        losses.append(ppo.update())
    loose = 1.0 if precision == "never" else 100.0  # a last bit of a weight can be one of bfloat16
    assert losses[1] == pytest.approx(losses[0], rel=1e-4 * loose, abs=1e-6 * loose)
    assert learner.learning_rate == pytest.approx(stock.learning_rate)
    if not overrides:
        assert learner.learning_rate != 0.001
    for part in ("actor_state_dict", "critic_state_dict"):
        for name, expected in stock.save()[part].items():
            torch.testing.assert_close(learner.save()[part][name], expected, rtol=1e-4 * loose, atol=1e-5 * loose)
            assert name.endswith("._std") or not torch.equal(before[part][name], expected), name
    moments, expected = learner.optimizer.state_dict(), stock.optimizer.state_dict()
    assert torch.get_num_threads() == threads
    assert all(group.pop("fused") for group in moments["param_groups"])
    assert not any(group.pop("fused") for group in expected["param_groups"])
    rates = [[float(group.pop("lr")) for group in state["param_groups"]] for state in (moments, expected)]
    assert rates[0] == pytest.approx(rates[1])
    assert moments["param_groups"] == expected["param_groups"]


@PRECISIONS
def test_a_rollout_holds_what_its_own_policy_said(robot: Robot, precision: str) -> None:
    """In the update's arithmetic: the likelihood ratio compares the policy with itself, not one rounding with another."""
    learner = rollout(robot, f"ppo.mixed_precision={precision}")[0].learner
    storage, obs = learner.storage, learner.storage.observations.flatten(0, 1)
    assert storage.distribution_params is not None
    mean, std = (x.flatten(0, 1) for x in storage.distribution_params)
    with torch.no_grad():
        learner.actor(obs, stochastic_output=True)
        torch.testing.assert_close(mean, learner.actor.output_mean, rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(storage.values.flatten(0, 1), learner.critic(obs), rtol=1e-5, atol=1e-5)
        own = learner.actor.get_output_log_prob(storage.actions.flatten(0, 1))
    torch.testing.assert_close(own, storage.actions_log_prob.flatten(), rtol=1e-5, atol=1e-4)
    assert 0.3 < ((storage.actions.flatten(0, 1) - mean) / std).std() < 3.0


@PRECISIONS
def test_the_product_says_what_it_computes_in(robot: Robot, precision: str) -> None:
    trainer, obs = rollout(robot, f"ppo.mixed_precision={precision}")
    assert trainer.arithmetic == ("float32" if precision == "never" else "bfloat16")
    learner, obs = trainer.learner, TensorDict({"policy": obs}, batch_size=[len(obs)])
    with torch.no_grad():
        exact = learner.actor.mlp(learner.actor.get_latent(obs))
        assert torch.equal(learner.actor(obs), exact) == (precision == "never")
        torch.testing.assert_close(learner.actor(obs), exact, rtol=0.02, atol=0.02)
        assert learner.actor(obs).dtype == learner.critic(obs).dtype == torch.float32
    assert all(p.dtype == torch.float32 for p in learner.actor.parameters())


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_an_elu_is_torchs_own(dtype: torch.dtype) -> None:
    x = torch.cat([torch.linspace(-30.0, 30.0, 1001), torch.logspace(-6, -1, 100).neg()]).to(dtype)
    gradient = torch.linspace(-2.0, 2.0, len(x)).to(dtype)
    (own, theirs), values = (x.clone().requires_grad_() for _ in range(2)), []
    for layer, given in ((CpuElu(), own), (torch.nn.ELU(), theirs)):
        values.append(layer(given))
        values[-1].backward(gradient)
    assert values[0].dtype == dtype
    torch.testing.assert_close(values[0], values[1], rtol=0.0, atol=2e-7)
    torch.testing.assert_close(own.grad, theirs.grad, rtol=1e-6, atol=1e-6 if dtype == torch.float32 else 0.01)


def test_an_update_waits_for_nothing_before_its_end(robot: Robot) -> None:
    """On CUDA every number that is read back is a wait; the mean losses are, together, at the end."""
    learner = rollout(robot)[0].learner
    stock = stock_copy(learner)
    with HostReads() as control:
        stock.update()
    assert "_local_scalar_dense" in control.seen
    with HostReads() as reads:
        learner.update()
    assert reads.seen == []


def test_a_rollout_reads_nothing_back_to_the_host(robot: Robot) -> None:
    with HostReads() as control:
        torch.distributions.Normal(torch.zeros(3), torch.ones(3)).sample()  # looks whether every deviation is positive
    assert control.seen == ["normal"]

    config = load_task("telebip_flat", [*SMALL, "ppo.num_steps_per_env=3"])
    trainer = Trainer(TelebipEnv(config, robot, "cpu", "native"), "", Path())
    with torch.inference_mode(), HostReads() as reads:
        trainer.collect(trainer.view.get_observations())
    assert reads.seen == []


@PRECISIONS
def test_rsl_rls_own_ppo_takes_the_same_actions(robot: Robot, precision: str) -> None:
    learner, obs = (trainer := rollout(robot, f"ppo.mixed_precision={precision}")[0]).learner, trainer.env.get_observations()
    stock = stock_copy(learner)
    actions = []
    for ppo in (learner, stock):
        torch.manual_seed(5)
        with torch.inference_mode():
            actions.append(ppo.act(obs))
    assert torch.equal(*actions)


def test_a_sample_is_that_of_torchs_own_normal() -> None:
    gaussian, mean = Gaussian(6, init_std=0.3), torch.randn(50, 6)
    gaussian.update(mean)
    torch.manual_seed(5)
    sample = gaussian.sample()
    torch.manual_seed(5)
    assert torch.equal(sample, torch.normal(mean, 0.3 * torch.ones(6).expand(50, 6)))
