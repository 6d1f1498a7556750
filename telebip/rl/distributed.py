"""Data-parallel training: processes that torchrun starts, each with its own worlds and seed, learn one policy together.

    torchrun --nproc-per-node 8 scripts/train.py --task telebip_flat --device cuda

Every process collects its own rollout; gradients, observation statistics, advantages' mean and deviation, and the KL divergence
are averaged over all of them, so that n processes with one world each learn what one process with n worlds would. The first
process alone prints, logs and saves. GPUs talk through NCCL, CPUs through gloo.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from telebip.errors import UserError

if TYPE_CHECKING:
    import torch  # importing it takes a second, in which a command should already know whether to print


@dataclass(frozen=True)
class Ranks:
    """Which of how many processes this one is; one of one where torchrun did not start it."""

    rank: int = 0
    local_rank: int = 0  # on this machine
    size: int = 1

    @staticmethod
    def from_environment() -> "Ranks":
        """Read what torchrun tells its processes."""
        return Ranks(
            *(int(os.environ.get(name, default)) for name, default in (("RANK", 0), ("LOCAL_RANK", 0), ("WORLD_SIZE", 1)))
        )

    @property
    def is_main(self) -> bool:
        """Whether this process prints, logs and saves."""
        return self.rank == 0

    @property
    def multi_gpu_cfg(self) -> dict[str, int] | None:
        """Return what `rsl_rl.algorithms.PPO` wants to know, on CPUs too."""
        if self.size == 1:
            return None
        return {"global_rank": self.rank, "local_rank": self.local_rank, "world_size": self.size}

    def device_name(self, asked: str) -> str:
        """Return the device of this process: with several of them, a GPU of its own wherever CUDA was meant.

        Raises:
            UserError: all processes were sent to one GPU.
        """
        import torch

        if self.size == 1 or asked == "cpu" or (asked == "auto" and not torch.cuda.is_available()):
            return asked
        if asked not in ("auto", "cuda"):
            raise UserError(f"torchrun gives each process a GPU of its own; say --device cuda, not '{asked}'")
        return f"cuda:{self.local_rank}"

    def any(self, flag: bool, device: "torch.device") -> bool:
        """Whether `flag` holds in any process; all of them have to ask."""
        if self.size == 1:
            return flag
        import torch.distributed

        flags = torch.tensor(float(flag), device=device)
        torch.distributed.all_reduce(flags, op=torch.distributed.ReduceOp.MAX)
        return bool(flags > 0.0)

    def gather(self, state: dict[str, Any]) -> list[dict[str, Any]]:
        """Return every process's `state` to the first one, and an empty list to the others; all of them have to call."""
        if self.size == 1:
            return [state]
        import torch.distributed

        states: list[Any] | None = [None] * self.size if self.is_main else None
        torch.distributed.gather_object(_on_cpu(state), states)
        return states or []


def _on_cpu(value: Any) -> Any:
    """Return a state with its tensors on the CPU: the receiver would put them on a GPU numbered as the sender's."""
    import torch

    if isinstance(value, dict):
        return {key: _on_cpu(part) for key, part in value.items()}
    return value.cpu() if isinstance(value, torch.Tensor) else value


@contextmanager
def joined(ranks: Ranks, device: "torch.device") -> Iterator[None]:
    """Connect the processes for the duration of the context."""
    if ranks.size == 1:
        yield
        return
    import torch._dynamo  # which Adam imports; where there is a group, it would keep it, and gloo's threads, until the end
    import torch.distributed

    if device.type == "cuda":
        torch.cuda.set_device(device)
    torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo", rank=ranks.rank, world_size=ranks.size)
    try:
        yield
    finally:
        torch.distributed.destroy_process_group()
