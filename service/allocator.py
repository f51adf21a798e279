"""How the C library keeps the memory of a process that receives long bodies."""

import ctypes

TRIM_THRESHOLD, MMAP_THRESHOLD = -1, -3  # glibc's names for mallopt, without M_
KEPT, LARGE = 16 * 2**20, 4 * 2**20  # bytes


def keep_freed_memory() -> None:
    """Have glibc keep what is freed, up to KEPT, and give back at once what is LARGE, such as a body.

    By itself it gives back little more than it took: the memory of each read of a socket is then new, 800 page faults
    for 2.4 MiB. And once a body is freed it keeps twice that body. Where the library is another, nothing changes.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(TRIM_THRESHOLD, KEPT)
        mallopt(MMAP_THRESHOLD, LARGE)
