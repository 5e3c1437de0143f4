"""Work that is counted, not timed: calls of functions, and memory allocated at the most; the same on a busy machine."""

from __future__ import annotations

import sys
import threading
import time
import tracemalloc
from types import FrameType
from typing import Any

from benchmarks.timing import Work


def calls(work: Work) -> int:
    """How many functions are called, Python's and C's, in this thread and in those that the work starts."""
    count = 0
    lock = threading.Lock()

    def main_thread(_: FrameType, event: str, __: Any) -> None:
        nonlocal count
        if event in ("call", "c_call"):
            count += 1

    def other_thread(_: FrameType, event: str, __: Any) -> None:
        nonlocal count
        if event in ("call", "c_call"):
            with lock:
                count += 1

    before, before_threads = sys.getprofile(), threading.getprofile()
    threading.setprofile(other_thread)
    sys.setprofile(main_thread)
    try:
        work()
    finally:
        sys.setprofile(before)
        threading.setprofile(before_threads)
    return count


def peak_bytes(work: Work) -> int:
    """The most memory that Python and NumPy hold at once during the work, beyond what they held before."""
    tracing = tracemalloc.is_tracing()
    if not tracing:
        tracemalloc.start()
    try:
        tracemalloc.reset_peak()
        before = tracemalloc.get_traced_memory()[0]
        work()
        return tracemalloc.get_traced_memory()[1] - before
    finally:
        if not tracing:
            tracemalloc.stop()


def over_reference(work: Work, reference: Work, repeats: int = 7) -> float:
    """CPU time of this process for the work over that for a reference of the same kind, the least of some runs each.

    CPU time, since other processes only take the wall's; the least, since they spoil caches too.
    """
    best = [float("inf"), float("inf")]
    for _ in range(repeats):
        for k, one in enumerate((work, reference)):
            start = time.process_time()
            one()
            best[k] = min(best[k], time.process_time() - start)
    return best[0] / best[1]
