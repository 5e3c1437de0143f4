"""What a process's first call by compiled kernels costs: numba's import, loading them, and compiling if need be."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from statistics import median

from lidarpose.geometry.compiled import COMPILING_S, LOADING_S, installed

_CALL = """
import time
from lidarpose.geometry.compiled import forced
{prepare}
def run(way):
    begin = time.perf_counter()
    with forced(way):
        {call}
    return time.perf_counter() - begin
run(False)
first = run(True)
print(first - run(True))
"""


@dataclass(frozen=True)
class FirstCall:
    """Seconds that a process's first call by kernels takes beyond its second one.

    Attributes
    ----------
    stored_s
        Where an earlier process stored the kernels on the disk.
    compiled_s
        Where it is the first on this machine.
    """

    stored_s: float
    compiled_s: float


def first_call(prepare: str, call: str, repeats: int = 3) -> FirstCall | None:
    """In new processes: `prepare` is not timed, `call` is; None without numba."""
    if not installed():
        return None
    code = _CALL.format(prepare=prepare, call=call)
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        times = [
            float(
                subprocess.run(
                    [sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True, env=environment
                ).stdout
            )
            for _ in range(1 + repeats)
        ]
    return FirstCall(median(times[1:]), times[0])


def in_words(first: FirstCall | None, work: str) -> str:
    """For the page."""
    if first is None:
        return "numba is not installed."
    return (
        f"Kernels are taken where they pay (docs/architecture.md): {work} until they would have saved a process "
        f"{LOADING_S} s ({COMPILING_S:.0f} s where none are stored yet), or from its first call where it imports "
        f"numba itself. That call then takes "
        f"{first.stored_s:.2f} s more, and {first.compiled_s:.1f} s more where it is the first on a machine, which "
        f"compiles and stores them."
    )
