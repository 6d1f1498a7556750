"""All random numbers of a step, drawn at once."""

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

Ranges = Mapping[str, Sequence[tuple[float, float]]]
"""By name, the bounds of each number that a world draws."""


class RandomNumbers:
    """Numbers, uniform in their ranges, for all worlds: `part(name)` is (num_envs, size), and `draw` writes new ones to it.

    Every step draws all of them, for every world, whether it needs them or not: one call instead of dozens, and a fault in one
    world changes nothing for the others. Each is one of 65,536 values, evenly spaced from the low bound on: four of them come
    from 64 random bits, in a third of the time of four floats.
    """

    def __init__(self, ranges: Ranges, values: Tensor) -> None:
        """Let `values` (num_envs, numbers) hold them."""
        bounds = [bound for bounds in ranges.values() for bound in bounds]
        low, high = torch.tensor(bounds, device=values.device).reshape(-1, 2).unbind(1)
        self._middle, self._spacing = 0.5 * (low + high), (high - low) / 2**16
        self._values = values
        self._bits = torch.zeros(-(-values.numel() // 4), dtype=torch.int64, device=values.device)
        self._numbers = self._bits.view(torch.int16)[: values.numel()].view(values.T.shape).T
        parts = values.split([len(bounds) for bounds in ranges.values()], dim=1)
        self._parts = dict(zip(ranges, parts, strict=True))

    @staticmethod
    def count(ranges: Ranges) -> int:
        """Return how many numbers a world draws."""
        return sum(map(len, ranges.values()))

    def draw(self, generator: torch.Generator) -> None:
        """Draw all anew."""
        self._bits.random_(-(2**63), None, generator=generator)
        self._values.copy_(self._numbers).mul_(self._spacing).add_(self._middle)  # the numbers are -32768 to 32767

    def part(self, name: str) -> Tensor:
        """Return the present numbers of a range, (num_envs, size)."""
        return self._parts[name]
