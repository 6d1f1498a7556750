"""Train with another library: skrl's PPO on the Gymnasium worlds of telebip.

    pip install 'telebip[gym]' skrl
    python examples/train_skrl.py --iterations 100

Any library that knows Gymnasium's vector environments can do the same. telebip's own trainer, scripts/train.py, is faster: its
tensors never leave torch.
"""

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import RecordEpisodeStatistics
from skrl.agents.torch.ppo import PPO, PPO_CFG
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
from skrl.resources.preprocessors.torch import RunningStandardScaler
from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg
from skrl.utils import set_seed

import telebip.gym  # noqa: F401 (registers telebip/Flat-v0 and the other tasks)

STEPS = 24  # policy steps per iteration


def mlp(inputs: int, outputs: int) -> torch.nn.Sequential:
    """Return a network with two hidden layers."""
    layers = [torch.nn.Linear(inputs, 256), torch.nn.ELU(), torch.nn.Linear(256, 128), torch.nn.ELU()]
    return torch.nn.Sequential(*layers, torch.nn.Linear(128, outputs))


class Actor(GaussianMixin, Model):
    """Gaussian policy: its mean is a network, its deviation a parameter."""

    def __init__(self, **spaces) -> None:
        """Build the network for the spaces and the device."""
        Model.__init__(self, **spaces)
        GaussianMixin.__init__(self)
        self.network = mlp(self.num_observations, self.num_actions)
        self.log_std = torch.nn.Parameter(torch.full((self.num_actions,), np.log(0.5).item()))

    def compute(self, inputs: dict, role: str = "") -> tuple[torch.Tensor, dict]:
        """Return mean actions and the logarithm of their deviation."""
        return self.network(inputs["observations"]), {"log_std": self.log_std}


class Critic(DeterministicMixin, Model):
    """Value function."""

    def __init__(self, **spaces) -> None:
        """Build the network for the spaces and the device."""
        Model.__init__(self, **spaces)
        DeterministicMixin.__init__(self)
        self.network = mlp(self.num_observations, 1)

    def compute(self, inputs: dict, role: str = "") -> tuple[torch.Tensor, dict]:
        """Return values."""
        return self.network(inputs["observations"]), {}


def train(num_envs: int, iterations: int, seed: int = 0) -> RecordEpisodeStatistics:
    """Train a policy from scratch and return the worlds, with the statistics of the last episodes."""
    set_seed(seed)
    statistics = RecordEpisodeStatistics(
        gymnasium.make_vec("telebip/Flat-v0", num_envs=num_envs, autoreset_mode="SameStep"), buffer_length=200
    )
    env = wrap_env(statistics, wrapper="gymnasium")
    spaces: dict[str, Any] = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "device": env.device,
    }
    cfg = PPO_CFG(
        rollouts=STEPS,
        learning_epochs=4,
        mini_batches=4,
        learning_rate=5e-4,
        entropy_loss_scale=0.003,
        value_loss_scale=1.0,
        grad_norm_clip=1.0,
        time_limit_bootstrap=True,
        observation_preprocessor=RunningStandardScaler,
        observation_preprocessor_kwargs={"size": env.observation_space, "device": env.device},
        value_preprocessor=RunningStandardScaler,
        value_preprocessor_kwargs={"size": 1, "device": env.device},
    )
    cfg.experiment.write_interval = cfg.experiment.checkpoint_interval = 0  # no files
    agent = PPO(
        models={"policy": Actor(**spaces), "value": Critic(**spaces)},
        memory=RandomMemory(memory_size=STEPS, num_envs=num_envs, device=env.device),
        cfg=cfg,
        **spaces,
    )
    trainer = SequentialTrainerCfg(
        timesteps=STEPS * iterations, headless=True, disable_progressbar=None, close_environment_at_exit=False
    )
    SequentialTrainer(env=env, agents=agent, cfg=trainer).train()
    return statistics


def main() -> None:
    """Train and print how the last episodes went."""
    parser = argparse.ArgumentParser(description="Train with skrl's PPO on telebip's Gymnasium worlds.")
    parser.add_argument("--num-envs", type=int, default=512)
    parser.add_argument("--iterations", type=int, default=100)
    options = parser.parse_args()
    statistics = train(options.num_envs, options.iterations)
    lengths, mean_return = statistics.length_queue, np.mean(statistics.return_queue)
    print(f"last {len(lengths)} of {statistics.episode_count} episodes: {np.mean(lengths):.0f} steps, return {mean_return:.2f}")


if __name__ == "__main__":
    main()
