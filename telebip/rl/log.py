"""What a training tells about itself: TensorBoard's files, `learning.csv`, and the statistics of its episodes."""

import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter

from telebip.errors import UserError
from telebip.rl.curve import CurveWriter


class RunLog:
    """A run folder's numbers: TensorBoard's files and `learning.csv`. They can do without a row; the training goes on."""

    def __init__(self, run_dir: Path, samples: int, note: Callable[[str], None]) -> None:
        """Open them at `samples` environment steps; what lies beyond is dropped. `note` is told what cannot be written."""
        self._writer = SummaryWriter(str(run_dir), purge_step=samples + 1)
        self._curve = CurveWriter(run_dir, samples)
        self._note, self._noted = note, False

    def add(self, iteration: int, samples: int, scalars: dict[str, float]) -> None:
        """Append one iteration's scalars."""
        with self._tolerant():
            self._curve.add({"iteration": iteration, "samples": samples, **scalars})
        with self._tolerant():
            for key, value in scalars.items():
                self._writer.add_scalar(key, value, samples)

    def close(self) -> None:
        """Write what TensorBoard's writer still holds."""
        with self._tolerant():
            self._writer.close()

    @contextlib.contextmanager
    def _tolerant(self) -> Iterator[None]:
        try:
            yield
        except (OSError, UserError) as error:
            if not self._noted:
                self._note(f"cannot write the curves: {getattr(error, 'strerror', None) or error}; they will lack rows")
            self._noted = True


class EpisodeStatistics:
    """Mean return and length of the episodes that ended lately, kept on the device until asked."""

    def __init__(self, num_envs: int, device: torch.device, min_episodes: int = 100) -> None:
        """Average over as many of the latest iterations as it takes to see `min_episodes` end."""
        self._return, self._length = torch.zeros(num_envs, device=device), torch.zeros(num_envs, device=device)
        self._sums = torch.zeros(3, device=device)  # of finished episodes: returns, lengths, number
        self._history: deque[tuple[float, float, float]] = deque()
        self._min_episodes = min_episodes

    def add(self, rewards: Tensor, dones: Tensor) -> None:
        """Account for one environment step: rewards (num_envs,) and dones (num_envs,) bool."""
        self._return += rewards
        self._length += 1.0
        done = dones.float()
        self._sums += torch.stack([self._return @ done, self._length @ done, done.sum()])
        self._return.masked_fill_(dones, 0.0)
        self._length.masked_fill_(dones, 0.0)

    def state_dict(self) -> dict[str, Any]:
        """Return a copy of everything."""
        tensors = {"return": self._return, "length": self._length, "sums": self._sums}
        return {**{name: value.clone() for name, value in tensors.items()}, "history": list(self._history)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from another's `state_dict`."""
        self._return.copy_(state["return"])
        self._length.copy_(state["length"])
        self._sums.copy_(state["sums"])
        self._history = deque(tuple(entry) for entry in state["history"])

    def recent(self) -> tuple[float, float]:
        """Return (mean return, mean length in policy steps), NaN before any episode has ended; call once per iteration."""
        returns, lengths, number = self._sums.tolist()
        self._history.append((returns, lengths, number))
        self._sums.zero_()
        while sum(n for *_, n in self._history) - self._history[0][2] >= self._min_episodes:
            self._history.popleft()
        total = [sum(column) for column in zip(*self._history, strict=True)]
        return (total[0] / total[2], total[1] / total[2]) if total[2] else (float("nan"), float("nan"))
