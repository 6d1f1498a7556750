"""Checkpoints of a training on disk: written as it goes, and not lost where the disk is full."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from telebip.errors import UserError
from telebip.rl.checkpoint import Checkpoint, prune_checkpoints, save_checkpoint
from telebip.rl.distributed import Ranks

Snapshot = Callable[[], Checkpoint]
"""Makes a checkpoint of the training as it is now; every process has to call it."""


class Saver:
    """Writes `model_<iteration>.pt`, to go on from, and `policy.pt`, the actor alone; the first process does."""

    def __init__(self, ranks: Ranks, device: torch.device, keep: int, note: Callable[[str], None]) -> None:
        """Keep the `keep` newest checkpoints of a run; `note` is told what cannot be written."""
        self._ranks, self._device, self._keep, self._note = ranks, device, keep, note
        self._saved = -1  # the iteration of the last checkpoint

    def save(self, run_dir: Path, snapshot: Snapshot) -> bool:
        """Write a checkpoint to the run's folder.

        Returns:
            Whether that worked, the same in every process. Where the disk is full, say, `note` tells, and what was there stays.
        """
        checkpoint, failed = snapshot(), False
        if self._ranks.is_main:
            try:
                _write(run_dir, checkpoint)
                prune_checkpoints(run_dir, self._keep)
            except OSError as error:
                failed = True
                self._note(f"cannot save to '{run_dir}': {error.strerror or error}; training goes on and will try again")
        if self._ranks.any(failed, self._device):
            return False
        self._saved = checkpoint.iteration
        return True

    def save_finally(self, run_dir: Path, snapshot: Snapshot, iteration: int) -> None:
        """Save what must not be lost: to the run's folder or, where that fails, to the system's folder for temporary files.

        Raises:
            UserError: it is not in the run's folder.
        """
        if self._saved == iteration or self.save(run_dir, snapshot):
            return
        spare, checkpoint = Path(tempfile.gettempdir()), snapshot()
        try:
            if self._ranks.is_main:
                spare = Path(tempfile.mkdtemp(prefix=f"telebip_{run_dir.name}_"))
                _write(spare, checkpoint)
        except OSError as error:
            raise UserError(f"cannot save to '{run_dir}' nor to '{spare}': {error.strerror or error}") from error
        raise UserError(f"could not save to '{run_dir}'; the checkpoint is in '{spare}': move it there to go on")


def _write(folder: Path, checkpoint: Checkpoint) -> None:
    save_checkpoint(replace(checkpoint, path=folder / f"model_{checkpoint.iteration}.pt"))
    save_checkpoint(replace(policy_alone(checkpoint), path=folder / "policy.pt"))


def policy_alone(checkpoint: Checkpoint) -> Checkpoint:
    """Return what is needed to walk, without what is needed to go on."""
    return replace(checkpoint, learner={"actor_state_dict": checkpoint.policy_weights}, training=[])
