"""Large arrays shared by the cores: NumPy loops over thousands of elements without the interpreter's lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

# Arrays of fewer elements are done with before a thread is waited for.
LARGE = 4000

Item = TypeVar("Item")
Result = TypeVar("Result")


def each(work: Callable[[Item], Result], items: Sequence[Item], elements: int) -> list[Result]:
    """What `work` makes of each item, in order; in threads, where an item's arrays have many `elements`."""
    cores = min(os.cpu_count() or 1, len(items))
    if cores < 2 or elements < LARGE:
        return [work(item) for item in items]
    with ThreadPoolExecutor(cores) as pool:
        return list(pool.map(work, items))
