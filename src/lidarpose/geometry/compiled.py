"""When kernels compiled by numba (the `fast` extra) pay, for all who have such kernels.

Importing numba and loading kernels from the disk takes a process about 0.6 s, once. Whoever has a way by NumPy
and one by kernels asks `pays` each time, and says which kernels, and how much sooner they would be done. They are taken

- never where numba is not installed or cannot be imported,
- always where it has been imported already and these kernels are stored on the disk,
- else as soon as what they would have saved so far, the work at hand included, is worth the import: the rule of those
  who rent skis until they have paid the price of a pair. One run costs at most twice what it would have cost by the
  better of both ways, and a process that goes on comes to the kernels by itself. The import is paid by all kernels
  that are stored. Those that are not have to be worth their own compiling.

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

# Seconds of a process: importing numba and loading some kernels; the same where they have to be compiled first.
LOADING_S = 0.6
COMPILING_S = 12.0

Function = TypeVar("Function", bound=Callable[..., Any])


class _Ledger:
    """What the NumPy way has cost this process beyond each module of kernels, and what has been decided."""

    def __init__(self) -> None:
        self.lock = Lock()
        self.lost_s: dict[str, float] = {}
        self.stored: dict[str, bool] = {}
        self.taken: set[str] = set()
        self.usable: bool | None = None
        self.forced: bool | None = None

    def paid(self, kernels: str) -> bool:
        """Whether what was lost so far is worth these kernels."""
        if kernels not in self.stored:
            self.stored[kernels] = _stored(kernels)
        if not self.stored[kernels]:
            return self.lost_s[kernels] >= COMPILING_S
        together = sum(lost for other, lost in self.lost_s.items() if self.stored.get(other))
        return "numba" in sys.modules or together >= LOADING_S


_ledger = _Ledger()


def pays(saves_s: float, kernels: str) -> bool:
    """Whether to take the kernels of a module of this package, for work that they do `saves_s` seconds sooner.

    Parameters
    ----------
    kernels
        The module's name within the package, as "detect.plane_kernels".

    Returns
    -------
    True means that numba has been imported. Where the answer is no, the saving counts as lost, so that enough small
    pieces of work bring a later yes.
    """
    with _ledger.lock:
        if _ledger.forced is not None:
            return _ledger.forced
        if _ledger.usable is False or kernels in _ledger.taken:
            return _ledger.usable is True
        _ledger.lost_s[kernels] = _ledger.lost_s.get(kernels, 0.0) + saves_s
        if not _ledger.paid(kernels):
            return False
        if _ledger.usable is None:
            _ledger.usable = _importable()
        _ledger.taken.add(kernels)
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
    return _compiled(function, reorders=False)


def summing_kernel(function: Function) -> Function:
    """The same for sums, whose terms are added in an order that goes with vector instructions, as a library's matrix
    product adds them."""
    return _compiled(function, reorders=True)


def _compiled(function: Function, *, reorders: bool) -> Function:
    from numba import njit

    fast: bool | set[str] = {"reassoc"} if reorders else False
    try:
        compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath=fast)(function)
    except RuntimeError:  # "cannot cache function: no locator available"
        compiled = njit(nogil=True, error_model="numpy", fastmath=fast)(function)
    _stamp_with_callees(compiled, function)
    return cast(Function, compiled)


def _stamp_with_callees(compiled: Any, function: Callable[..., Any]) -> None:
    """Let stored code go out of date with the kernels of other modules as well.

    It holds a copy of all that it calls, but numba asks only whether the function's own file has changed.
    """
    own = _stamped_file(compiled)
    called = (each for each in function.__globals__.values() if hasattr(each, "py_func"))
    files = (_stamped_file(each) for each in called if each.py_func.__module__ != function.__module__)
    stamps = sorted({str(file._source_stamp) for file in files if file is not None})
    if own is not None and stamps:
        own._source_stamp = (own._source_stamp, *stamps)


def _stamped_file(compiled: Any) -> Any:
    """Where numba keeps what a kernel was compiled from; None where nothing is stored."""
    return getattr(compiled._cache, "_cache_file", None)


def _importable() -> bool:
    """Import numba; False where it is missing or does not go with this NumPy."""
    try:
        import_module("numba")
    except Exception:
        return False
    return True


def _stored(kernels: str) -> bool:
    """Whether an earlier process has stored kernels of this module, as it is now, for this Python."""
    package, module = kernels.split(".")
    source = Path(__file__).parents[1] / package / f"{module}.py"
    tag = f"{module}.*.py{sys.version_info.major}{sys.version_info.minor}*.nbi"
    try:
        changed = source.stat().st_mtime
        return any(index.stat().st_mtime >= changed for folder in _stores(package) for index in folder.glob(tag))
    except OSError:
        return False


def _stores(package: str) -> list[Path]:
    """Folders in which numba stores kernels of a package's modules: beside their byte code, or in a cache."""
    beside = [Path(__file__).parents[1] / package / "__pycache__"]
    if chosen := os.environ.get("NUMBA_CACHE_DIR"):
        return list(Path(chosen).glob(f"{package}_*"))
    try:
        cache = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    except RuntimeError:  # a user without a home
        return beside
    return [*beside, *(Path(cache) / "numba").glob(f"{package}_*")]
