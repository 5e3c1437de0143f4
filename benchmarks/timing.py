"""Seconds and memory, measured so that a busy machine, or one whose speed varies, disturbs all contestants alike."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

Work = Callable[[], object]
# Runs shorter than this are repeated and averaged: a single one is a matter of luck.
LEAST_S = 0.05
MOST_CALLS = 50


def seconds(work: Work) -> float:
    """How long one call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def processor_seconds(work: Work) -> float:
    """Processor time of one call, that of ended child processes included: other processes take only the wall's."""
    start = _processor_s()
    work()
    return _processor_s() - start


def _processor_s() -> float:
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def interleaved(ways: Mapping[str, Work], repeats: int, *, budget_s: float = 20.0) -> dict[str, float]:
    """Median seconds of each way, all of them in turn, `repeats` times; a slow one stops after `budget_s` of its own.

    Nothing is run beforehand: call what must be warm before.
    """
    times: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(repeats):
        for name, way in ways.items():
            if _within(times[name], budget_s):
                times[name].append(seconds(way))
    return {name: median(values) for name, values in times.items()}


@dataclass(frozen=True)
class Contest:
    """Several ways held against a reference.

    Attributes
    ----------
    reference_s
        Median seconds of the reference.
    seconds
        Median seconds of each way.
    over
        Of each way the median of its time over the reference's, runs just before and just after it: a machine that is
        slow for a minute is slow for both.
    """

    reference_s: float
    seconds: dict[str, float]
    over: dict[str, float]


def beside(
    reference: Work,
    ways: Mapping[str, Work],
    repeats: int,
    *,
    budget_s: float = 20.0,
    before_each: Callable[[], object] = lambda: None,
    least_s: float = LEAST_S,
) -> Contest:
    """Time ways between runs of a reference, all of them in turn, `repeats` times.

    Nothing is run beforehand: call what must be warm before. A slow way stops after `budget_s` of its own.

    Parameters
    ----------
    before_each
        Called before every run and not timed, to remove what the last one left.
    least_s
        A run is repeated until it has taken this long.
    """

    def timed(work: Work) -> float:
        total, calls = 0.0, 0
        while not calls or (total < least_s and calls < MOST_CALLS):
            before_each()
            total += seconds(work)
            calls += 1
        return total / calls

    times: dict[str, list[float]] = {name: [] for name in ways}
    over: dict[str, list[float]] = {name: [] for name in ways}
    references = [timed(reference)]
    for _ in range(repeats):
        for name, way in ways.items():
            if _within(times[name], budget_s):
                times[name].append(timed(way))
                references.append(timed(reference))
                over[name].append(2.0 * times[name][-1] / (references[-2] + references[-1]))
    return Contest(
        median(references),
        {name: median(values) for name, values in times.items()},
        {name: median(values) for name, values in over.items()},
    )


def _within(times: Sequence[float], budget_s: float) -> bool:
    return not times or sum(times) + times[-1] <= budget_s


def pace() -> float:
    """A fixed piece of work, some hundredths of a second of Python and NumPy.

    How long it takes while a suite runs says how fast the machine was then; seconds of two runs are compared by it.
    """
    import numpy as np

    values = np.linspace(0.0, 1.0, 20_000)
    total = 0.0
    for k in range(100):
        total += float(np.sort(np.sin(values * k))[k])
        total += sum(i & k for i in range(1000))
    return total


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


def python(*arguments: str) -> None:
    """A new process of this Python from its start to its end, with its byte code at hand as in every installation."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL, env=environment)


def lidarpose_calibrate(session: Path, *options: str) -> None:
    """The command as a user calls it, in a new process; its results are thrown away."""
    with tempfile.TemporaryDirectory() as out:
        python("-m", "lidarpose", "calibrate", str(session), "-o", out, "--quiet", *options)


def in_child(module: str, *arguments: str) -> Any:
    """What `python -m module arguments` prints, as JSON: for figures that need a process of their own."""
    command = [sys.executable, "-m", module, *arguments]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    return json.loads(done.stdout.splitlines()[-1])


def exponent(sizes: Sequence[float], values: Sequence[float]) -> float:
    """Slope of log(value) over log(size), by least squares."""
    import numpy as np

    return float(np.polyfit(np.log(sizes), np.log(np.maximum(values, 1e-9)), 1)[0])
