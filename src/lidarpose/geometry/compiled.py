"""When kernels compiled by numba (the `fast` extra) pay, for all who have such kernels.

Importing numba and loading kernels from the disk takes a process about 0.6 s, once. Whoever has a way by NumPy
and one by kernels asks `pays` each time, and says how much sooner the kernels would be done. They are taken

- never where numba is not installed or cannot be imported,
- always where it has been imported already,
- else as soon as what they would have saved so far, the work at hand included, is worth the import: the rule of those
  who rent skis until they have paid the price of a pair. One run costs at most twice what it would have cost by the
  better of both ways, and a process that goes on comes to the kernels by itself.

Both ways give the same answer, to the bit or to its rounding, so that it does not matter which one ran.

A module of kernels imports `kernel` from here, and is itself imported only where `pays` has said yes.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from threading import Lock
from typing import Any, TypeVar, cast

# Seconds of a process: importing numba and loading some kernels; the same where nothing can be stored, so that each
# process compiles anew.
LOADING_S = 0.6
COMPILING_S = 5.0

Function = TypeVar("Function", bound=Callable[..., Any])


class _Ledger:
    """What the NumPy way has cost this process beyond the kernels', and what has been decided."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.lost_s = 0.0
        self.usable: bool | None = None
        self.forced: bool | None = None


_ledger = _Ledger()


def pays(saves_s: float) -> bool:
    """Whether to take the kernels, for work that they do `saves_s` seconds sooner than NumPy.

    True means that numba has been imported. Where the answer is no, the saving counts as lost, so that enough small
    pieces of work bring a later yes.
    """
    with _ledger.lock:
        if _ledger.forced is not None:
            return _ledger.forced
        if _ledger.usable is None and "numba" not in sys.modules:
            _ledger.lost_s += saves_s
            if _ledger.lost_s < (LOADING_S if _can_store() else COMPILING_S):
                return False
        if _ledger.usable is None:
            _ledger.usable = _importable()
        return _ledger.usable


def installed() -> bool:
    """Whether numba is there, without importing it."""
    return find_spec("numba") is not None


@contextmanager
def forced(way: bool) -> Iterator[None]:
    """Within it, `pays` always says `way`: for tests and benchmarks, which compare both."""
    if way and not _importable():
        raise ImportError("numba cannot be imported")
    before, _ledger.forced = _ledger.forced, way
    try:
        yield
    finally:
        _ledger.forced = before


def kernel(function: Function) -> Function:
    """Compile a function when it is called first, or load it from where an earlier process stored it.

    It then runs without the interpreter's lock, in threads as NumPy does, rounds every operation as NumPy does (no
    fused or reordered ones), and divides by zero as NumPy does. Where there is no folder to store it in, each process
    compiles it for itself.
    """
    from numba import njit

    try:
        compiled = njit(cache=True, nogil=True, error_model="numpy")(function)
    except RuntimeError:  # "cannot cache function: no locator available"
        compiled = njit(nogil=True, error_model="numpy")(function)
    return cast(Function, compiled)


def _importable() -> bool:
    """Import numba; False where it is missing or does not go with this NumPy."""
    try:
        import_module("numba")
    except Exception:
        return False
    return True


def _can_store() -> bool:
    """Whether numba will find a folder for compiled kernels: beside this package's byte code, or the user's cache."""
    if os.environ.get("NUMBA_CACHE_DIR"):
        return True
    beside = Path(__file__).parent
    try:
        cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    except RuntimeError:  # a user without a home
        cache = os.devnull
    # A folder that is not there yet is made where its parent can be written to.
    choices = ((beside / "__pycache__", beside), (Path(cache) / "numba", Path(cache), Path(cache).parent))
    nearest = (next((folder for folder in folders if folder.is_dir()), None) for folders in choices)
    return any(folder is not None and os.access(folder, os.W_OK) for folder in nearest)
