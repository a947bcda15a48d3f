"""What the C library does with freed memory: fresh pages cost a CPU training step as much time as its arithmetic."""

import ctypes
import platform

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3
"""Names of glibc's ``mallopt(3)``."""
NEVER = -1
LARGEST_ON_HEAP = 1 << 30
"""Blocks below this size [bytes] come from the heap, which is kept."""


def keep_freed_memory() -> bool:
    """Let glibc reuse freed blocks of up to 1 GiB instead of returning them to the system; tells whether it will.

    By default each tensor above 32 MiB is mapped anew, and every page of it faults when first written. The process then
    stays at its peak size. Other C libraries have no such setting: nothing changes there.
    """
    if platform.libc_ver()[0] != "glibc":
        return False
    libc = ctypes.CDLL(None)
    return bool(libc.mallopt(M_MMAP_THRESHOLD, LARGEST_ON_HEAP) and libc.mallopt(M_TRIM_THRESHOLD, NEVER))


def return_freed_memory() -> None:
    """Let glibc give what is free back to the system; by itself it does so only at the heap's end.

    Other C libraries have no such call: nothing changes there.
    """
    if platform.libc_ver()[0] == "glibc":
        ctypes.CDLL(None).malloc_trim(0)
