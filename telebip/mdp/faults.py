"""What can go wrong with a world, and the record of the first time that it did.

A faulty world is counted, ends its episode and starts anew; the others never notice. Of each kind the first world is kept as
it was before the step that broke it, so that the step can be repeated: `play.py --replay`.
"""

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from telebip.math import over
from telebip.sim.base import ENGINE_FAULTS

KINDS = ("non_finite_action", "non_finite_state", *ENGINE_FAULTS, "non_finite_reward")
"""Rows of a step's faults (kinds, num_envs): the policy's, the physics', those that the engine reports itself, the rewards'."""


class FaultRecorder:
    """The first faulty world of each kind, kept on the device until asked for."""

    def __init__(self, num_envs: int, device: torch.device) -> None:
        """Start with nothing seen."""
        self._seen = torch.zeros(len(KINDS), dtype=torch.bool, device=device)
        self._world = torch.arange(num_envs, device=device)
        self._may_ask = device.type == "cpu"  # where it costs nothing
        self._records: dict[str, Tensor] = {}
        self._taken: set[str] = set()

    def note(self, faults: Tensor, world: Mapping[str, Tensor], step: Tensor) -> None:
        """Keep the first faulty world of each kind that has none yet; masks and gathers of fixed shape.

        Args:
            faults: bool, (kinds, num_envs).
            world: what to keep, (num_envs, ...) each: all that the step's outcome depended on.
            step: number of this step, ().
        """
        if self._may_ask and not faults.numpy().any():
            return
        first, new = faults.byte().argmax(1), faults.any(1) & ~self._seen
        for name, value in {"step": step.expand_as(self._world), "world": self._world, **world}.items():
            rows = value.index_select(0, first)
            if name not in self._records:
                with torch.inference_mode(False):  # it outlives the caller's mode
                    self._records[name] = torch.zeros_like(rows)
            kept = self._records[name]
            kept.copy_(torch.where(over(new, rows), rows, kept))
        self._seen |= new

    def take(self) -> dict[str, dict[str, Any]]:
        """Return the records not yet taken, by kind: this waits for the device."""
        seen = zip(KINDS, self._seen.tolist(), strict=True)
        new = [(row, kind) for row, (kind, is_seen) in enumerate(seen) if is_seen and kind not in self._taken]
        self._taken.update(kind for _, kind in new)
        return {kind: self._row(row) for row, kind in new}

    def first(self, kind: str) -> dict[str, Any] | None:
        """Return the first record of a kind, taken or not; None if there is none. Waits for the device."""
        row = KINDS.index(kind)
        return self._row(row) if self._seen[row] else None

    def _row(self, row: int) -> dict[str, Any]:
        return {name: value[row].cpu().clone() for name, value in self._records.items()}
