"""Tensor work recorded as a CUDA graph: one launch instead of hundreds."""

import contextlib
import gc
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import torch

Result = TypeVar("Result")


class CudaGraph(Generic[Result]):
    """A function of tensors that stay where they are: its first call runs it, the second records it, and all later replay that.

    What it does must depend on nothing but the values in those tensors: no branch on what changes, nothing read back to the
    host, the same shapes always. `tests/test_graph.py` holds both functions that `env.step` records to this, on a CPU.
    """

    def __init__(self, function: Callable[[], Result], device: torch.device, generator: torch.Generator) -> None:
        """Keep `function`, which works on `device` and draws from `generator` alone."""
        self._function, self._device, self._generator = function, device, generator
        self._is_warm = False
        self._graph: torch.cuda.CUDAGraph | None = None

    def __call__(self) -> Result:
        """Do what the function does, and return its result: from the second call on in the same tensors each time.

        Raises:
            RuntimeError: it cannot be recorded.
        """
        if not self._is_warm:  # libraries make their workspaces, which a recording cannot
            self._is_warm = True
            return self._function()
        if self._graph is None:
            self._graph, self._result = self._record()
        self._graph.replay()
        return self._result

    def _record(self) -> tuple[torch.cuda.CUDAGraph, Result]:
        stream = torch.cuda.current_stream(self._device)
        with torch.cuda.device(self._device), torch.inference_mode(False), torch.no_grad(), no_garbage_collection():
            graph = torch.cuda.CUDAGraph()
            graph.register_generator_state(self._generator)
            try:
                with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                    result = self._function()
            except torch.OutOfMemoryError:
                raise
            except RuntimeError as error:
                torch.cuda.set_stream(stream)  # where torch has not got to put it back
                raise RuntimeError(
                    "the step cannot be recorded as a CUDA graph. A term of your own must not read values back to the host "
                    "(.item(), `if` on a tensor), nor bring new ones from there (torch.tensor, a list as an index). Start "
                    "anew; sim.cuda_graph=false does without the graph"
                ) from error
        return graph, result


@contextlib.contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect garbage now and not in between: finalizers free memory and graphs, which a recording forbids."""
    gc.collect()
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()
