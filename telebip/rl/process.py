"""Settings of the whole process that make training on a CPU fast. A thread count may change how sums round, nothing else."""

import ctypes
import functools
import sys

import torch

# Parameters of glibc's mallopt, from <malloc.h>.
M_TRIM_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -4, -8


@functools.cache  # halving the threads is for once
def prepare_cpu() -> None:
    """Keep freed memory, and share the processors between actor and critic; call it before the first worker thread starts.

    glibc hands blocks of more than 32 MB back to the kernel when they are freed, and smaller ones when enough of them lie at
    the heap's end. The update allocates and frees its activations 16 times per iteration, and took as long to have the kernel
    zero their pages, again and again, as for its matrix products.

    `FastPPO` runs actor and critic in two threads, each of which torch would give as many helpers as there are processors.
    """
    torch.set_num_threads(max(1, torch.get_num_threads() // 2))
    if sys.platform == "linux" and hasattr(libc := ctypes.CDLL(None), "mallopt"):
        for parameter, value in ((M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1), (M_ARENA_MAX, 1)):
            libc.mallopt(parameter, value)
