"""Seconds and memory, measured so that a busy machine disturbs all contestants alike."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

Work = Callable[[], object]


def seconds(work: Work) -> float:
    """How long one call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def interleaved(ways: Mapping[str, Work], repeats: int, *, budget_s: float = 20.0) -> dict[str, float]:
    """Median seconds of each way, all of them in turn, `repeats` times; a slow one stops after `budget_s` of its own.

    Nothing is run beforehand: call what must be warm before.
    """
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            if not times[name] or sum(times[name]) + times[name][-1] <= budget_s:
                times[name].append(seconds(way))
    return {name: median(values) for name, values in times.items()}


def peak_of(work: Work) -> tuple[float, float]:
    """Seconds, and by how many MB this process's resident memory rose above where it stood; Linux only."""
    # Writing 5 sets the high-water mark back to what is resident now (proc(5), clear_refs).
    Path("/proc/self/clear_refs").write_text("5")
    before = _status_mb("VmHWM")
    elapsed = seconds(work)
    return elapsed, max(_status_mb("VmHWM") - before, 0.0)


def _status_mb(name: str) -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith(name)).split()[1]) / 1024


def in_child(module: str, *arguments: str) -> Any:
    """What `python -m module arguments` prints, as JSON: for figures that need a process of their own."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Slope of log(value) over log(size), by least squares."""
    import numpy as np

    return float(np.polyfit(np.log(sizes), np.log(np.maximum(values, 1e-9)), 1)[0])
