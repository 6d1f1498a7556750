"""What measurements share: a stopwatch that suits the device, and bytes."""

import gc
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn


class Stopwatch:
    """Adds up how long calls take: on CUDA how long the device does, between events that it passes on its way."""

    def __init__(self, device: torch.device) -> None:
        """Wait until `device` is idle."""
        self._device, self._seconds = device, 0.0
        self._events: list[tuple[torch.cuda.Event, torch.cuda.Event]] = []
        self._synchronize()

    def time(self, function: Callable[[], Any]) -> None:
        """Call `function`, and count it."""
        if self._device.type != "cuda":
            start = time.perf_counter()
            function()
            self._seconds += time.perf_counter() - start
            return
        before, after = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        stream = torch.cuda.current_stream(self._device)
        before.record(stream)
        function()
        after.record(stream)
        self._events.append((before, after))

    def seconds(self) -> float:
        """Return the sum [s]."""
        self._synchronize()
        return self._seconds + sum(before.elapsed_time(after) for before, after in self._events) / 1000.0

    def _synchronize(self) -> None:
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)


def allocated_bytes(device: torch.device) -> int:
    """Return the bytes that stay allocated on `device`: what its tensors cover, on CUDA all that is not free."""
    gc.collect()
    if device.type == "cuda":
        torch.cuda.empty_cache()
        free, total = torch.cuda.mem_get_info(device)
        return total - free
    kinds = (Tensor, nn.Parameter)  # torch's stand-ins for tensors, as exports leave them, have no memory
    storages = [x.untyped_storage() for x in gc.get_objects() if type(x) in kinds and x.device == device]
    covered = end = 0
    for low, high in sorted((s.data_ptr(), s.data_ptr() + s.nbytes()) for s in storages):  # views of one array overlap
        covered += max(0, high - max(low, end))
        end = max(end, high)
    return covered
