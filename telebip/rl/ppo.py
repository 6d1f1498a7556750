"""rsl-rl's PPO with an update that does the same arithmetic in less time.

`PPO.update` normalises, gathers and copies every mini-batch once per epoch, and runs the actor and the critic one after the
other. `FastPPO.update` shuffles and normalises the rollout once (mini-batches are the same in every epoch, and the normaliser
does not change before the end), so that a mini-batch is a slice; and it lets the two networks, which share nothing but the
observation and the learning rate, compute their gradients side by side. Losses, gradient clipping, the adaptive learning rate
and checkpoints are rsl-rl's; `tests/rl/test_ppo.py` holds one update against its own.
"""

# pyright: reportOptionalMemberAccess=false, reportOptionalIterable=false
# rsl-rl declares an actor's distribution and the storage's parameters of it optional.
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor, nn

A = TypeVar("A")
B = TypeVar("B")


@dataclass(frozen=True)
class MiniBatch:
    """Samples of a rollout, (batch, size); observations as the actor and the critic have normalised them."""

    actor_obs: Tensor
    critic_obs: Tensor
    actions: Tensor
    log_prob: Tensor  # of `actions` under the policy that chose them, whose parameters are
    mean: Tensor
    std: Tensor
    advantages: Tensor
    values: Tensor  # of the critic before the update
    returns: Tensor


class FastPPO(PPO):
    """PPO for feed-forward actors and critics, without rsl-rl's extensions (RND, symmetry).

    With `multi_gpu_cfg` several processes make one update from the samples of them all: see `telebip.rl.distributed`.

    With `use_mixed_precision` the networks run in bfloat16 in the rollout too, not in the update alone: the likelihood ratio
    then compares the policy with itself, and not one rounding of it with another.
    """

    def __init__(self, *args, **kwargs) -> None:
        """Take the arguments of `rsl_rl.algorithms.PPO`."""
        super().__init__(*args, **kwargs)
        # On CUDA the kernels of one stream run one after the other anyway.
        self._worker = ThreadPoolExecutor(1, "critic") if torch.device(self.device).type == "cpu" else None

    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions, and note down what `process_env_step` stores with them."""
        transition, distribution = self.transition, self.actor.distribution
        transition.observations = obs
        mean, transition.values = self._side_by_side(
            lambda: self._forward(self.actor, self.actor.get_latent(obs)),
            lambda: self._forward(self.critic, self.critic.get_latent(obs)),
        )
        distribution.update(mean)
        mean, std = distribution.params
        transition.actions = torch.randn_like(mean).mul_(std).add_(mean)  # torch.normal would wait for CUDA to look at std
        transition.actions_log_prob = distribution.log_prob(transition.actions)
        transition.distribution_params = distribution.params
        return transition.actions

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and normalised advantages of the stored rollout, which ended at `obs`."""
        with self._autocast():
            super().compute_returns(obs)
        if self.is_multi_gpu:
            self._normalize_advantages()

    def update(self) -> dict[str, float]:
        """Run the configured epochs over the stored rollout and return the mean losses."""
        sums = torch.zeros(3, device=self.device)
        for batch in self._mini_batches() * self.num_learning_epochs:
            self.optimizer.zero_grad()
            actor, critic = self._side_by_side(partial(self._actor_gradient, batch), partial(self._critic_gradient, batch))
            if self.is_multi_gpu:
                self.reduce_parameters()  # of which it averages the gradients
            for network in (self.actor, self.critic):
                nn.utils.clip_grad_norm_(network.parameters(), self.max_grad_norm)
            self.optimizer.step()
            sums += torch.stack([critic, *actor])
        obs = self.storage.observations.flatten(0, 1)
        self.actor.update_normalization(obs)
        self.critic.update_normalization(obs)
        self.storage.clear()
        means = sums / (self.num_learning_epochs * self.num_mini_batches)
        return dict(zip(("value", "surrogate", "entropy"), means.tolist(), strict=True))

    def _side_by_side(self, actor: Callable[[], A], critic: Callable[[], B]) -> tuple[A, B]:
        """Return what the two functions return; on a CPU they run at the same time."""
        if self._worker is None:
            return actor(), critic()
        inference = torch.is_inference_mode_enabled()  # a property of the thread

        def run() -> B:
            with torch.inference_mode(inference):
                return critic()

        other = self._worker.submit(run)
        return actor(), other.result()

    def _autocast(self) -> torch.autocast:
        return torch.autocast(torch.device(self.device).type, torch.bfloat16, enabled=self.use_mixed_precision)

    def _forward(self, net: MLPModel, latent: Tensor) -> Tensor:
        """Return the network's output, before its distribution, in float32."""
        with self._autocast():
            return net.mlp(latent).float()

    def _mini_batches(self) -> list[MiniBatch]:
        """Shuffle the rollout and cut it into mini-batches; as in rsl-rl, the remainder of the division is left out."""
        st = self.storage
        size = st.num_envs * st.num_transitions_per_env // self.num_mini_batches
        order = torch.randperm(size * self.num_mini_batches, device=self.device)
        obs = st.observations.flatten(0, 1)[order]
        stored = (st.actions, st.actions_log_prob, *st.distribution_params, st.advantages, st.values, st.returns)
        columns = [self.actor.get_latent(obs), self.critic.get_latent(obs), *(x.flatten(0, 1)[order] for x in stored)]
        return [MiniBatch(*rows) for rows in zip(*(column.split(size) for column in columns), strict=True)]

    def _actor_gradient(self, b: MiniBatch) -> tuple[Tensor, Tensor]:
        """Accumulate the gradient of surrogate loss and entropy bonus, and adapt the learning rate."""
        distribution = self.actor.distribution
        distribution.update(self._forward(self.actor, b.actor_obs))
        with torch.no_grad():
            self._adapt_learning_rate(distribution.kl_divergence((b.mean, b.std), distribution.params).mean())
        ratio = torch.exp(distribution.log_prob(b.actions) - b.log_prob.squeeze(1))
        advantages = b.advantages.squeeze(1)
        clipped = ratio.clamp(1.0 - self.clip_param, 1.0 + self.clip_param)
        surrogate = torch.max(-advantages * ratio, -advantages * clipped).mean()
        entropy = distribution.entropy.mean()
        (surrogate - self.entropy_coef * entropy).backward()
        return surrogate.detach(), entropy.detach()

    def _critic_gradient(self, b: MiniBatch) -> Tensor:
        """Accumulate the gradient of the clipped value loss."""
        values = self._forward(self.critic, b.critic_obs)
        clipped = b.values + (values - b.values).clamp(-self.clip_param, self.clip_param)
        loss = torch.max((values - b.returns).pow(2), (clipped - b.returns).pow(2)).mean()
        (self.value_loss_coef * loss).backward()
        return loss.detach()

    def _adapt_learning_rate(self, kl: Tensor) -> None:
        """Lower the learning rate by 1.5 where the KL divergence is over twice the desired one, raise it where under half."""
        if self.schedule != "adaptive":
            return
        divergence = self._sum_over_processes(kl).item() / self.gpu_world_size
        if divergence > 2.0 * self.desired_kl:
            self.learning_rate = max(1e-5, self.learning_rate / 1.5)
        elif 0.0 < divergence < self.desired_kl / 2.0:
            self.learning_rate = min(1e-2, self.learning_rate * 1.5)
        for group in self.optimizer.param_groups:
            group["lr"] = self.learning_rate

    def _normalize_advantages(self) -> None:
        """Normalise by the mean and deviation over all processes' samples, as rsl-rl does over those of one."""
        advantages = self.storage.returns - self.storage.values
        number = advantages.numel() * self.gpu_world_size
        deviation = advantages - self._sum_over_processes(advantages.sum()) / number
        variance = self._sum_over_processes(deviation.square().sum()) / (number - 1)
        self.storage.advantages = deviation / (variance.sqrt() + 1e-8)

    def _sum_over_processes(self, value: Tensor) -> Tensor:
        """Return the sum of a tensor over all processes, every one of which has to ask."""
        if not self.is_multi_gpu:
            return value
        total = value.clone()
        torch.distributed.all_reduce(total)
        return total
