"""Independent pieces of one job, done by this process and by forked copies of it on the other cores.

NumPy on small arrays holds the interpreter's lock, so that threads gain nothing there. A forked copy starts within
milliseconds and has all that this process has. But a fork copies one thread only, and a lock that another one holds at
that moment stays locked in the copy for ever: it is used where this process has no other thread, on Linux, and nowhere
else. Who has no copies does all pieces himself, to the same result.

A copy only ever saves work. A piece that it could not do, whatever the reason, is done again here, so that an error
arises where it would arise without copies, and a copy that is killed costs time only.
"""

from __future__ import annotations

import os
import pickle
import select
import signal
import struct
import sys
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn, TypeVar

T = TypeVar("T")

MOST_COPIES = 3
"""Beyond this the memory of the copies grows, and reading the files bounds the work."""

_QUEUED = struct.Struct("I")
_FRAME = struct.Struct("IQ")
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
# A copy that takes this many times as long as the slowest piece here, and these seconds, has got stuck.
_PATIENCE, _PATIENCE_S = 20.0, 10.0


class NotAloneError(Exception):
    """This process has a thread that Python does not know of, so that a copy of it may hang."""


def copies_allowed() -> int:
    """How many copies of this process would have a core of their own; 0 where it must not, or cannot, be forked."""
    copies = copies_likely()
    return copies if copies > 0 and _is_alone() else 0


def copies_likely() -> int:
    """The same, but for threads that Python does not know of: `share` looks for them once it has forked.

    To ask a fork beforehand takes as long as to make a copy.
    """
    if sys.platform != "linux" or not hasattr(os, "memfd_create"):
        return 0
    if threading.active_count() > 1 or threading.current_thread() is not threading.main_thread():
        return 0
    copies = min(len(os.sched_getaffinity(0)) - 1, MOST_COPIES)
    if copies <= 0:
        return 0
    try:
        os.close(os.memfd_create("probe"))
    except OSError:  # a container may forbid it
        return 0
    return copies


def _is_alone() -> bool:
    """Whether a fork would copy all threads of this process, those included that Python does not know of.

    Libraries that can be forked (OpenBLAS) end their threads for it; what is left then is another's. So it is tried.
    """
    if _one_thread():
        return True
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # it says what is asked here
        try:
            pid = _fork()
        except OSError:
            return False
        if pid == 0:
            os._exit(0)
    try:
        return _one_thread(tries=3)
    finally:
        _wait_for(pid)


def _one_thread(tries: int = 1) -> bool:
    """Whether the system knows of a single thread of this process."""
    try:
        for left in reversed(range(tries)):
            if sum(1 for _ in Path("/proc/self/task").iterdir()) == 1:
                return True
            if left:
                time.sleep(0.0005)  # a thread that has been joined, or ended for a fork, may be seen for a moment more
    except OSError:
        pass
    return False


def share(
    work: Callable[[int], T],
    count: int,
    *,
    copies: int,
    first: Callable[[], object] = lambda: None,
    done: Callable[[int], object] = lambda k: None,
) -> list[T]:
    """`[work(0), ..., work(count - 1)]`, by this process and at most `copies` copies of it.

    Parameters
    ----------
    work
        Does piece k; what it changes besides its result may be lost. Results are pickled.
    copies
        As `copies_allowed` or `copies_likely` says, or 0.
    first
        What this process does before it takes pieces, while the copies have begun.
    done
        Called here with k for each piece that is known to be done, in no order.

    Raises
    ------
    NotAloneError, before anything is done here, where a copy was made beside a thread that Python does not know of.
    What `first` raises, else what `work` raises at the first piece, in their order, at which it does.
    """
    queue = os.memfd_create("queue") if copies > 0 and sys.platform == "linux" else -1
    if queue < 0:
        first()
        return _the_rest(work, {}, count, done)
    started: list[_Copy] = []
    results: dict[int, T] = {}
    try:
        os.pwrite(queue, b"".join(_QUEUED.pack(k) for k in range(count)), 0)
        _start(started, copies, queue, work)
        first()
        slowest = _own_pieces(work, queue, results, started, done)
        for copy in started:
            copy.wait(_PATIENCE_S + _PATIENCE * slowest)
            copy.collect(results, done)
    finally:
        for copy in started:
            copy.end()
        os.close(queue)
    return _the_rest(work, results, count, done)


def _the_rest(work: Callable[[int], T], results: dict[int, T], count: int, done: Callable[[int], object]) -> list[T]:
    for k in range(count):
        if k not in results:
            results[k] = work(k)
            done(k)
    return [results[k] for k in range(count)]


def _own_pieces(
    work: Callable[[int], T],
    queue: int,
    results: dict[int, T],
    copies: list[_Copy],
    done: Callable[[int], object],
) -> float:
    """Pieces from the queue until it is empty, or until one fails; seconds that the slowest took."""
    slowest = 0.0
    while (k := _next(queue)) is not None:
        started = time.perf_counter()
        try:
            results[k] = work(k)
        except Exception:
            # Done once more when all before it are done, so that the first of several errors is the one that is told.
            os.ftruncate(queue, 0)
            break
        done(k)
        slowest = max(slowest, time.perf_counter() - started)
        for copy in copies:
            copy.collect(results, done)
    return slowest


def _next(queue: int) -> int | None:
    """The next piece that nobody has taken: the processes share the file's position, and the kernel guards it."""
    token = os.read(queue, _QUEUED.size)
    return int(_QUEUED.unpack(token)[0]) if len(token) == _QUEUED.size else None


def _fork() -> int:
    """os.fork, without a signal's handler being called in the copy."""
    kept = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    pid = -1
    try:
        pid = os.fork()
    finally:
        if pid != 0:
            signal.pthread_sigmask(signal.SIG_SETMASK, kept)
    return pid


def _start(started: list[_Copy], copies: int, queue: int, work: Callable[[int], object]) -> None:
    """Fork; where that fails go on with fewer copies, or none. Raises NotAloneError after the first, see `share`."""
    this = os.getpid()
    for _ in range(copies):
        results = os.memfd_create("results")
        ended, alive = os.pipe()
        started.append(_Copy(ended, results))
        try:
            started[-1].pid = _fork()
        except OSError:
            os.close(alive)
            return
        if started[-1].pid == 0:
            _copy_lives(this, queue, results, work)
        os.close(alive)
        # Libraries that can be forked have ended their threads for it.
        if len(started) == 1 and not _one_thread(tries=3):
            raise NotAloneError


def _copy_lives(parent: int, queue: int, results: int, work: Callable[[int], object]) -> NoReturn:
    """All that a copy does; it never returns, and leaves without the ceremonies of the process that it was."""
    try:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the keyboard's signal reaches both; the other one ends this one
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _SIGNALS)
        while os.getppid() == parent and (k := _next(queue)) is not None:
            found = pickle.dumps(work(k), protocol=pickle.HIGHEST_PROTOCOL)
            _write(results, _FRAME.pack(k, len(found)) + found)
    finally:
        os._exit(0)


def _write(file: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]


@dataclass
class _Copy:
    """A forked copy: a pipe that ends when it ends, a file in memory that it writes results to, and its process."""

    ended: int
    results: int
    pid: int = -1
    read: int = 0

    def collect(self, results: dict[int, T], done: Callable[[int], object]) -> None:
        """Take what has been written since the last time."""
        while len(head := os.pread(self.results, _FRAME.size, self.read)) == _FRAME.size:
            k, length = _FRAME.unpack(head)
            data = os.pread(self.results, length, self.read + _FRAME.size)
            if len(data) < length:
                return
            self.read += _FRAME.size + length
            results[k] = pickle.loads(data)
            done(k)

    def wait(self, seconds: float) -> None:
        """Until it has ended, or for so long."""
        select.select([self.ended], [], [], seconds)

    def end(self) -> None:
        """Whatever it does; it is gone afterwards."""
        if self.pid > 0:
            _wait_for(self.pid, kill=True)
        os.close(self.ended)
        os.close(self.results)


def _wait_for(pid: int, *, kill: bool = False) -> None:
    try:
        if kill and os.waitpid(pid, os.WNOHANG)[0] == 0:
            os.kill(pid, signal.SIGKILL)
            os.waitpid(pid, 0)
        elif not kill:
            os.waitpid(pid, 0)
    except ChildProcessError:
        pass  # this process lets the system wait for its children
