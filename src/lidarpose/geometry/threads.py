"""Large arrays shared by the cores: NumPy loops over thousands of elements without the interpreter's lock."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import TypeVar

import numpy as np

# Arrays of fewer elements are done with before a thread is waited for.
LARGE = 4000

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(work: Callable[[Item], Result], items: Sequence[Item], elements: int) -> list[Result]:
    """What `work` makes of each item, in order; in threads, where an item's arrays have many `elements`.

    Whoever asks works as well: a thread less to start, and to change over to. An error is that of the first item, in
    their order, of which there is any.
    """
    cores = min(os.cpu_count() or 1, len(items))
    if cores < 2 or elements < LARGE:
        return [work(item) for item in items]
    made: dict[int, Result] = {}
    failed: dict[int, Exception] = {}
    left: SimpleQueue[int] = SimpleQueue()
    for k in range(len(items)):
        left.put(k)

    def some() -> None:
        while not failed:
            try:
                k = left.get_nowait()
            except Empty:
                return
            try:
                made[k] = work(items[k])
            except Exception as error:
                failed[k] = error

    with ThreadPoolExecutor(cores - 1) as pool:
        others = [pool.submit(some) for _ in range(cores - 1)]
        some()
    for other in others:
        other.result()
    if failed:
        raise failed[min(failed)]
    return [made[k] for k in range(len(items))]


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """NumPy's OpenBLAS without threads of its own; nothing where NumPy stands on another library.

    For work of many products of some thousand numbers: OpenBLAS shares out even these, and its threads then wait for
    the next one in a loop, on cores that others could use. Holds for the whole process while the block runs.
    """
    counters = _openblas()
    if counters is None:
        yield
        return
    get, put = counters
    before = get()
    put(1)
    try:
        yield
    finally:
        put(before)


@lru_cache(maxsize=1)
def _openblas() -> tuple[Callable[[], int], Callable[[int], None]] | None:
    """How to ask for and set the number of threads of the OpenBLAS in NumPy's wheels."""
    folder = Path(np.__file__).parents[1] / "numpy.libs"
    for path in sorted(folder.glob("*openblas*")):
        try:
            library = ctypes.CDLL(str(path))
        except OSError:
            continue
        for name in ("scipy_openblas", "openblas"):
            get = getattr(library, f"{name}_get_num_threads64_", None)
            put = getattr(library, f"{name}_set_num_threads64_", None)
            if get is not None and put is not None:
                return get, put
    return None
