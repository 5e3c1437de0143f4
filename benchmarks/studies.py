"""Monte Carlo studies on all cores, a process a core with one thread of linear algebra each."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TypeVar

import numpy as np

from lidarpose.geometry.arrays import FloatArray

Item = TypeVar("Item")
Result = TypeVar("Result")


def in_processes(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """The function of every item, in their order; both must be known by name to a new process."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"
    # Spawned, not forked: only a new process reads the variables above.
    with ProcessPoolExecutor(os.cpu_count(), mp_context=multiprocessing.get_context("spawn")) as pool:
        return list(pool.map(function, items))


def rms(rows: Sequence[FloatArray] | FloatArray) -> FloatArray:
    """Root mean squares over the first axis; NaN without rows."""
    values = np.asarray(rows, dtype=np.float64)
    if len(values) == 0:
        return np.full(values.shape[1:], np.nan)
    return np.asarray(np.sqrt((values**2).mean(axis=0)))


def by_chance(runs: int) -> str:
    """How sure a root mean square of so many runs is, at the worst: one direction that dominates all errors."""
    return (
        f"by chance alone, within {100.0 / np.sqrt(2.0 * max(runs, 1)):.0f} % of its true value two times out of three"
    )
