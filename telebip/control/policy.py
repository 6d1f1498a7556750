"""The interface of everything that walks: trained networks, model-based controllers, stand-ins."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from tensordict import TensorDict
from torch import Tensor


class Policy(Protocol):
    """Acts for all worlds at once, from the groups of observations that it reads and nothing else.

    A policy may remember: `reset` makes it forget in the worlds that start anew. rsl-rl's `MLPModel` satisfies it as it is.
    """

    def __call__(self, obs: TensorDict) -> Tensor:
        """Return actions (num_envs, num_joints), see `telebip.mdp.actions`.

        Args:
            obs: one entry (num_envs, size) for each group of the task's `observations`, as `TelebipEnv.step` returns it.
        """
        ...

    def reset(self, mask: Tensor, /) -> None:
        """Forget the past of the worlds where `mask` (num_envs,) bool holds; called before they are observed anew."""
        ...


@dataclass(frozen=True)
class Stateless:
    """A policy that is a function of the observation alone."""

    act: Callable[[TensorDict], Tensor]

    def __call__(self, obs: TensorDict) -> Tensor:
        """See `Policy`."""
        return self.act(obs)

    def reset(self, mask: Tensor, /) -> None:
        """Nothing to forget."""
