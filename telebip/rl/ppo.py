"""rsl-rl's PPO with the same update in less time, and the same in several processes.

For feed-forward networks, without rsl-rl's extensions (RND, symmetry). Losses, clipping, adaptive learning rate, storage and
checkpoints are its own, and `tests/rl/test_ppo.py` holds an update against its. What differs, and what for:

- The rollout is shuffled and normalised once, not once an epoch, so that a mini-batch is a slice of it; and the gradient of the
  actor is computed apart from the critic's, whose activations then do not push each other out of the cache.
- On a CPU the two gradients, of networks that share nothing but their input, are computed side by side, each on half of the
  threads: two threads at one matrix product wait for each other after every layer.
- Adam is fused: one pass over the parameters instead of a dozen.
- Advantages are normalised over the samples of all processes (`telebip.rl.distributed`); rsl-rl's are over those of one.

docs/tried.md has what the first three are worth.
"""

# pyright: reportOptionalMemberAccess=false, reportOptionalIterable=false
# rsl-rl declares an actor's distribution and the storage's parameters of it optional.
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor, nn

from telebip.rl.networks import output

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
    """PPO for feed-forward networks; with `multi_gpu_cfg` several processes make one update from the samples of them all."""

    def __init__(self, *args, **kwargs) -> None:
        """Take the arguments of `rsl_rl.algorithms.PPO`."""
        super().__init__(*args, **kwargs)
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=self.learning_rate, fused=True)
        self._worker = ThreadPoolExecutor(1, "critic")

    @property
    def learning_rate(self) -> float:
        """Adam's rate, which lives on the device: the adaptive schedule changes it there, and waits for nothing."""
        return self._rate.item()

    @learning_rate.setter
    def learning_rate(self, rate: float | Tensor) -> None:
        self._rate = torch.tensor(float(rate), device=self.device)

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and normalised advantages of the stored rollout, which ended at `obs`."""
        super().compute_returns(obs)
        if self.is_multi_gpu:
            self._normalize_advantages()

    def update(self) -> dict[str, float]:
        """Run the configured epochs over the stored rollout and return the mean losses."""
        sums = torch.zeros(3, device=self.device)
        for group in self.optimizer.param_groups:
            group["lr"] = self._rate
        with self._threads() as together:
            for batch in self._mini_batches() * self.num_learning_epochs:
                self.optimizer.zero_grad()
                actor, critic = together(partial(self._actor_gradient, batch), partial(self._critic_gradient, batch))
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

    @contextmanager
    def _threads(self) -> Iterator[Callable[[Callable[[], A], Callable[[], B]], tuple[A, B]]]:
        """Yield a function that calls two others: at the same time, where a CPU has threads for both."""
        threads = torch.get_num_threads()
        if torch.device(self.device).type != "cpu" or threads == 1:  # a CUDA stream runs kernels one after the other anyway
            yield lambda first, second: (first(), second())
            return

        def side_by_side(first: Callable[[], A], second: Callable[[], B]) -> tuple[A, B]:
            other = self._worker.submit(second)
            return first(), other.result()

        torch.set_num_threads(threads // 2)  # of this thread; the worker's takes it over when it starts
        try:
            yield side_by_side
        finally:
            torch.set_num_threads(threads)

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
        distribution.update(output(self.actor, b.actor_obs))
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
        """Accumulate the gradient of the value loss, clipped if so configured."""
        values = output(self.critic, b.critic_obs)
        squares = (values - b.returns).pow(2)
        if self.use_clipped_value_loss:
            clipped = b.values + (values - b.values).clamp(-self.clip_param, self.clip_param)
            squares = torch.max(squares, (clipped - b.returns).pow(2))
        loss = squares.mean()
        (self.value_loss_coef * loss).backward()
        return loss.detach()

    def _adapt_learning_rate(self, kl: Tensor) -> None:
        """Lower the learning rate by 1.5 where the KL divergence is over twice the desired one, raise it where under half."""
        if self.schedule != "adaptive":
            return
        divergence, rate = self._sum_over_processes(kl) / self.gpu_world_size, self._rate
        is_far, is_near = divergence > 2.0 * self.desired_kl, (divergence > 0.0) & (divergence < 0.5 * self.desired_kl)
        slower, faster = (rate / 1.5).clamp(min=1e-5), (1.5 * rate).clamp(max=1e-2)
        rate.copy_(torch.where(is_far, slower, torch.where(is_near, faster, rate)))

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
