"""Work shared with forked copies, each time in a process of its own: the tests' own may have threads."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks are used on Linux alone")

TWO_CORES = pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="there is one core")


def run(code: str, *arguments: str | Path, timeout: float = 60.0) -> str:
    """What the code prints; it must leave no child behind."""
    start = """
    import os, signal, sys, threading, time
    from lidarpose.workflows import forked
    from lidarpose.workflows.forked import copies_allowed, share
    here = os.getpid()
    """
    end = """
    try:
        os.waitpid(-1, os.WNOHANG)
    except ChildProcessError:
        pass
    else:
        sys.exit("a child was left")
    assert len(os.listdir("/proc/self/fd")) == files, "files were left open"
    """
    files = 'files = len(os.listdir("/proc/self/fd"))'
    code = "\n".join([textwrap.dedent(start), files, textwrap.dedent(code), textwrap.dedent(end)])
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_results_come_in_order_from_all_processes() -> None:
    run("""
    def work(k):
        time.sleep(0.005)
        return k, os.getpid(), bytes(200_000)
    seen = []
    found = share(work, 40, copies=2, done=seen.append)
    assert [k for k, *_ in found] == list(range(40))
    assert sorted(seen) == list(range(40))
    assert len({pid for _, pid, _ in found}) == 3
    """)


def test_without_copies_all_is_done_here() -> None:
    run("""
    begun = []
    found = share(lambda k: (k, os.getpid(), len(begun)), 5, copies=0, first=lambda: begun.append(1))
    assert found == [(k, here, 1) for k in range(5)]
    assert share(lambda k: k, 0, copies=1) == []
    """)


def test_what_comes_first_is_done_while_the_copies_work() -> None:
    run("""
    found = share(lambda k: os.getpid(), 3, copies=1, first=lambda: time.sleep(0.5))
    assert here not in found
    """)


@pytest.mark.parametrize("copies", [0, 1, 3])
def test_the_first_error_of_all_arrives_whole(copies: int) -> None:
    run(f"""
    from lidarpose.errors import InputError
    def work(k):
        time.sleep(0.01)
        if k >= 5:
            raise InputError("image", f"number {{k}} is broken", remedy="Mend it.")
        return k
    try:
        share(work, 12, copies={copies})
    except InputError as error:
        assert error.problem == "number 5 is broken" and error.remedy == "Mend it."
        assert error.__traceback__.tb_next is not None
    else:
        raise SystemExit("no error")
    """)


def test_pieces_of_a_copy_that_is_killed_are_done_here() -> None:
    run("""
    def work(k):
        time.sleep(0.01)
        if os.getpid() != here and k > 3:
            os.kill(os.getpid(), signal.SIGKILL)
        return k
    assert share(work, 20, copies=2) == list(range(20))
    """)


def test_results_that_cannot_be_sent_are_made_here() -> None:
    run("""
    found = share(lambda k: (time.sleep(0.01), lambda: k)[1], 6, copies=1)
    assert [f() for f in found] == list(range(6))
    """)


def test_a_copy_that_got_stuck_is_not_waited_for() -> None:
    run("""
    forked._PATIENCE_S = 0.2
    def work(k):
        time.sleep(0.01 if os.getpid() == here else 1000.0)
        return k
    assert share(work, 6, copies=2) == list(range(6))
    """)


@pytest.mark.parametrize("where", ["first", "work"])
def test_an_interrupt_ends_the_copies_too(where: str) -> None:
    run(f"""
    def work(k):
        if "{where}" == "work" and os.getpid() == here:
            raise KeyboardInterrupt
        time.sleep(0.05)
    def first():
        if "{where}" == "first":
            raise KeyboardInterrupt
    try:
        share(work, 1000, copies=2, first=first)
    except KeyboardInterrupt:
        pass
    else:
        raise SystemExit("not interrupted")
    """)


def test_the_keyboards_signal_is_left_to_the_one_who_shares() -> None:
    run("""
    def work(k):
        if os.getpid() != here:
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.01)
        return os.getpid()
    assert len(set(share(work, 10, copies=1))) == 2
    """)


def test_a_system_that_forks_no_more_costs_time_only() -> None:
    run("""
    def refuse():
        raise BlockingIOError("no more processes")
    os.fork = refuse
    assert share(lambda k: k, 5, copies=2) == list(range(5))
    """)


def test_a_container_without_files_in_memory_gets_no_copies() -> None:
    run("""
    def refuse(name):
        raise PermissionError(1, "Operation not permitted")
    os.memfd_create = refuse
    assert copies_allowed() == 0
    """)


@TWO_CORES
def test_no_copies_beside_threads_or_on_one_core() -> None:
    run("""
    assert copies_allowed() > 0
    stop = threading.Event()
    other = threading.Thread(target=stop.wait)
    other.start()
    assert copies_allowed() == 0
    stop.set()
    other.join()
    found = []
    other = threading.Thread(target=lambda: found.append(copies_allowed()))
    other.start()
    other.join()
    assert found == [0]
    assert copies_allowed() > 0
    os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
    assert copies_allowed() == 0
    """)


@TWO_CORES
def test_threads_that_python_does_not_know_are_seen() -> None:
    run("""
    import cv2, numpy as np
    from lidarpose.detect.opencv_threads import one_opencv_thread
    big = np.random.default_rng(0).random((900, 900))
    big @ big  # the threads of NumPy's linear algebra end themselves for a fork
    assert copies_allowed() > 0
    cv2.setNumThreads(2)
    cv2.GaussianBlur(big, (0, 0), 5.0)
    cv2.warpAffine(big, np.eye(2, 3), (900, 900))
    if len(os.listdir("/proc/self/task")) > 1 and cv2.getNumThreads() == 2:
        with one_opencv_thread():
            assert copies_allowed() > 0
        assert cv2.getNumThreads() == 2
    files = len(os.listdir("/proc/self/fd"))
    """)


@TWO_CORES
def test_nothing_is_shared_beside_threads_that_python_does_not_know() -> None:
    run("""
    import ctypes
    c = ctypes.CDLL(None)
    thread = ctypes.c_ulong()
    # A thread of the C library's own that sleeps.
    entry = ctypes.cast(c.pause, ctypes.c_void_p)
    assert c.pthread_create(ctypes.byref(thread), None, entry, None) == 0
    assert forked.copies_likely() > 0 and copies_allowed() == 0
    begun = []
    try:
        share(lambda k: k, 5, copies=1, first=lambda: begun.append(1), done=begun.append)
    except forked.NotAloneError:
        assert not begun
    else:
        raise SystemExit("shared beside a thread")
    """)


def test_detection_is_the_same_with_and_without_copies(simulated_session: Path) -> None:
    run(
        """
    import pickle
    from pathlib import Path
    from lidarpose.storage.session import read_turntable_session
    from lidarpose.workflows import turntable
    session = read_turntable_session(Path(sys.argv[1]))
    turntable.IMAGES_AT_ONCE = 2
    found, steps = [], []
    for copies in (0, 1):
        turntable.copies_likely = lambda: copies
        found.append(turntable.detect_features(session, step=lambda: steps.append(copies)))
    def refused(*arguments, **options):
        raise forked.NotAloneError
    turntable.share = refused
    found.append(turntable.detect_features(session, step=lambda: steps.append(2)))
    assert len(found[0].places) >= 5 and steps == [k for k in range(3) for _ in session.places]
    assert not found[0].left_out
    def parts(features):
        return [pickle.dumps(part) for place in features.places for part in (*place.stripes.values(), *place.lines)]
    assert parts(found[0]) == parts(found[1]) == parts(found[2])
    files = len(os.listdir("/proc/self/fd"))
    """,
        simulated_session,
    )


def test_a_broken_image_is_told_the_same_way_with_copies(simulated_session: Path, tmp_path: Path) -> None:
    run(
        """
    import shutil
    from pathlib import Path
    from lidarpose.errors import InputError
    from lidarpose.storage.session import read_turntable_session
    from lidarpose.workflows import turntable
    folder = Path(sys.argv[2])
    shutil.copytree(sys.argv[1], folder)
    session = read_turntable_session(folder)
    for place in session.places[2:5]:
        place.stripe_image.path.write_bytes(place.stripe_image.path.read_bytes()[:-200])
    turntable.IMAGES_AT_ONCE = 1
    told = []
    for copies in (0, 1):
        turntable.copies_likely = lambda: copies
        try:
            turntable.detect_features(session)
        except InputError as error:
            told.append(str(error))
    assert len(told) == 2 and told[0] == told[1], told
    assert str(session.places[2].stripe_image.path) in told[0] and "cut off" in told[0]
    files = len(os.listdir("/proc/self/fd"))
    """,
        simulated_session,
        tmp_path / "broken",
    )
