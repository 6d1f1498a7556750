"""The policy that a training leaves: its latest weights, or their average over the latest part of the training."""

from collections.abc import Mapping

import torch
from torch import Tensor


class Average:
    r"""An average of a network's weights over the latest iterations.

        a_t = a_{t-1} + (w_t - a_{t-1}) / max(1, s t)

    With w_t the weights after iteration t, this weighs the latest share s of the iterations most (Polyak and Juditsky, 1992).
    PPO at a large learning rate walks around what it learns, by several percent of the speed from one iteration to the next;
    the average stands in the middle, and needs no rate that falls at a time that has to be known beforehand.
    """

    def __init__(self, share: float, weights: Mapping[str, Tensor]) -> None:
        """Start with the weights of a new network; `share` 0 keeps the latest weights alone."""
        self._share = share
        self.weights = {name: value.detach().clone() for name, value in weights.items()}

    @torch.no_grad()
    def add(self, weights: Mapping[str, Tensor], iteration: int) -> None:
        """Take in the weights after `iteration`; what is no floating-point number is that of the latest."""
        step = 1.0 / max(1.0, self._share * iteration)
        for name, value in self.weights.items():
            if value.is_floating_point():
                value.lerp_(weights[name], step)
            else:
                value.copy_(weights[name])

    def load(self, weights: Mapping[str, Tensor]) -> None:
        """Go on from an average as a checkpoint holds it."""
        for name, value in self.weights.items():
            value.copy_(weights[name])
