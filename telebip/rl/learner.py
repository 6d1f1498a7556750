"""From a task's configuration to rsl-rl's learner."""

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.env import VecEnv
from rsl_rl.storage import RolloutStorage

from telebip.config.schema import PpoConfig
from telebip.errors import UserError, nearest
from telebip.mdp.curriculum import progress
from telebip.rl.distributed import Ranks
from telebip.rl.networks import make_networks
from telebip.rl.ppo import FastPPO

ALGORITHMS: dict[str, type[PPO]] = {"fast_ppo": FastPPO, "ppo": PPO}
"""What `ppo.algorithm` may name; add a subclass of your own here (docs/extending.md)."""

FIELDS = (
    *("num_learning_epochs", "num_mini_batches", "learning_rate", "schedule", "desired_kl", "gamma", "lam", "clip_param"),
    *("value_loss_coef", "entropy_coef", "max_grad_norm"),
)
"""Fields of `PpoConfig` that rsl-rl's PPO calls the same."""


def make_learner(
    env: VecEnv,
    ppo: PpoConfig,
    obs_groups: dict[str, list[str]],
    ranks: Ranks,
    algorithm: str | None = None,
) -> PPO:
    """Return a learner with new networks, which draw their weights from torch's generator, the same in every process.

    Args:
        env: the worlds as the learner sees them.
        ppo: the learning.
        obs_groups: which groups of observations actor and critic see.
        ranks: the processes that learn together.
        algorithm: of `ALGORITHMS`; `ppo.algorithm` if not given.

    Raises:
        UserError: an iteration has too few samples, or there is no such algorithm.
    """
    _check_batch(env.num_envs, ppo)
    name = algorithm or ppo.algorithm
    if name not in ALGORITHMS:
        raise UserError(f"ppo.algorithm: unknown algorithm '{name}'; {nearest(name, ALGORITHMS)}")
    obs, device = env.get_observations(), str(env.device)
    actor, critic = make_networks(obs, obs_groups, env.num_actions, ppo, torch.device(device))
    learner = ALGORITHMS[name](
        actor,
        critic,
        RolloutStorage("rl", env.num_envs, ppo.num_steps_per_env, obs, [env.num_actions], device),
        device=device,
        multi_gpu_cfg=ranks.multi_gpu_cfg,
        use_clipped_value_loss=ppo.clip_value_loss,
        **{name: getattr(ppo, name) for name in FIELDS},
    )
    if ranks.size > 1:
        learner.broadcast_parameters()
    return learner


def _check_batch(num_envs: int, ppo: PpoConfig) -> None:
    samples = num_envs * ppo.num_steps_per_env
    if samples < 2:
        raise UserError("an iteration of one sample has nothing to compare; raise num_envs or ppo.num_steps_per_env")
    if ppo.num_mini_batches > samples:
        raise UserError(
            f"ppo.num_mini_batches is {ppo.num_mini_batches}, but an iteration has only {num_envs} worlds x "
            f"{ppo.num_steps_per_env} steps"
        )


def set_min_std(learner: PPO, ppo: PpoConfig, samples: int) -> None:
    """Give the action's standard deviation the floor that it has after `samples`."""
    learner.get_policy().distribution.std_range[0] = min_std(ppo, samples)  # type: ignore[union-attr]


def min_std(ppo: PpoConfig, samples: int) -> float:
    """Return the floor of the action's standard deviation after `samples`: from `min_std` to `final_min_std`, geometrically."""
    grown = float(progress(torch.tensor(samples, dtype=torch.float64), ppo.min_std_ramp))
    return ppo.min_std * (ppo.final_min_std / ppo.min_std) ** grown
