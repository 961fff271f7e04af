"""Timing of calls side by side."""

import ctypes
import os
import time


def one_core():
    """Keep this process on one core: call it before JAX counts them."""
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})


def least(calls, repeats):
    """Return the least time of each call, in rounds of all; caches warm for each."""
    times = {name: [] for name in calls}
    for _ in range(repeats):
        for name, call in calls.items():
            call()
            start = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - start)
    return {name: min(x) for name, x in times.items()}


def keep_memory():
    """Keep memory that is freed: whoever asks for it again need not clear its pages.

    The C library gives arrays above 32 MB back to the system, and gets them anew in
    every call; what other threads ask for, too, when they do not share one arena. What
    that costs says nothing of the program. Call it before there are other threads.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mmap_max, trim_threshold, arena_max = -4, -1, -8
        mallopt(mmap_max, 0)
        mallopt(arena_max, 1)
        mallopt(trim_threshold, 2**31 - 1)
