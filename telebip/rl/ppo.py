"""rsl-rl's PPO with the same update in less time, and the same in several processes.

What is here beside rsl-rl's, for feed-forward networks without its extensions (RND, symmetry), and what each piece is for:

- `ShuffledStorage`: rsl-rl gathers the rows of every mini-batch anew in every epoch, though its mini-batches are those of
  the one before. Here the rollout is shuffled once, and a mini-batch is a slice of it: the same numbers, bit for bit.
- A fused Adam: one pass over the parameters instead of a dozen. It rounds differently in the last bit.
- Advantages that are normalised over the samples of all processes (`telebip.rl.distributed`); rsl-rl's are over those of one.

`tests/rl/test_ppo.py` holds an update against rsl-rl's own; docs/performance.md says what the first two are worth.
"""

from collections.abc import Iterator

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor


class ShuffledStorage(RolloutStorage):
    """A rollout whose mini-batches are slices, the same in every epoch."""

    def mini_batch_generator(self, num_mini_batches: int, num_epochs: int = 8) -> Iterator[RolloutStorage.Batch]:  # type: ignore[override]
        """Yield the mini-batches of each epoch; as in rsl-rl, the remainder of the division is left out."""
        size = self.num_envs * self.num_transitions_per_env // num_mini_batches
        order = torch.randperm(size * num_mini_batches, device=self.device)

        def shuffled(values):
            return values.flatten(0, 1)[order]

        names = ("observations", "actions", "values", "advantages", "returns")
        columns = {
            **{name: shuffled(getattr(self, name)) for name in names},
            "old_actions_log_prob": shuffled(self.actions_log_prob),
        }
        params = [shuffled(values) for values in self.distribution_params or ()]
        rows = [slice(start, start + size) for start in range(0, len(order), size)]
        for part in num_epochs * rows:
            batch = {name: column[part] for name, column in columns.items()}
            yield RolloutStorage.Batch(**batch, old_distribution_params=tuple(column[part] for column in params))


class FastPPO(PPO):
    """PPO for feed-forward actors and critics; with `multi_gpu_cfg` several processes make one update of all their samples."""

    def __init__(self, *args, **kwargs) -> None:
        """Take the arguments of `rsl_rl.algorithms.PPO`."""
        super().__init__(*args, **kwargs)
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        self.optimizer = torch.optim.Adam(parameters, lr=self.learning_rate, fused=True)

    def compute_returns(self, obs: TensorDict) -> None:
        """Compute returns and normalised advantages of the stored rollout, which ended at `obs`."""
        super().compute_returns(obs)
        if self.is_multi_gpu:
            self._normalize_advantages()

    def _normalize_advantages(self) -> None:
        """Normalise by the mean and deviation over all processes' samples, as rsl-rl does over those of one."""
        advantages = self.storage.returns - self.storage.values
        number = advantages.numel() * self.gpu_world_size
        deviation = advantages - _sum_over_processes(advantages.sum()) / number
        variance = _sum_over_processes(deviation.square().sum()) / (number - 1)
        self.storage.advantages = deviation / (variance.sqrt() + 1e-8)


def _sum_over_processes(value: Tensor) -> Tensor:
    """Return the sum of a tensor over all processes, every one of which has to ask."""
    total = value.clone()
    torch.distributed.all_reduce(total)
    return total
