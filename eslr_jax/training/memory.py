"""Host memory of a training run."""

from __future__ import annotations

import ctypes
import sys

_ARENA_MAX, _MMAP_MAX, _TRIM_THRESHOLD, _TOP_PAD = -8, -4, -1, -2  # of glibc's malloc.h


def keep_memory() -> None:
    """Make glibc keep freed memory: one arena, no mapping per allocation, nothing given back.

    A training step on a CPU takes a hundred megabytes of temporary buffers and frees them. By default glibc
    returns them to the kernel, and a third of a step is page faults. Call it before the first array. Without
    glibc it does nothing.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is None:
        return
    for option, value in ((_ARENA_MAX, 1), (_MMAP_MAX, 0), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 2**28)):
        mallopt(option, value)
