"""`calibrate` for a turntable session of 87 places, against decoding its images alone on the same cores.

Run by hand: ``python -m benchmarks.calibrate [SESSION]``. Without a session one is simulated and written to a temporary
folder. Every run stands between two of decoding; what counts is the median of its ratios to them. Decoding is OpenCV's,
a thread a core.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path

import cv2

from benchmarks.timing import Contest, beside, lidarpose_calibrate, python
from lidarpose.geometry.compiled import forced, installed
from lidarpose.report.turntable_page import turntable_page
from lidarpose.storage.session import read_turntable_session
from lidarpose.workflows.forked import copies_allowed, share
from lidarpose.workflows.turntable import (
    assign_lines,
    calibrate_turntable,
    detect_features,
    refine,
    solve,
    start_of,
)

PLACES = 87
REPEATS = 7


def decode(folder: Path) -> None:
    """Every PNG of the session, read and decoded to grey."""
    files = sorted(folder.glob("**/*.png"))
    with ThreadPoolExecutor(os.cpu_count()) as executor:
        for path, image in zip(files, executor.map(lambda p: cv2.imread(str(p), 0), files), strict=True):
            if image is None:
                raise ValueError(f"{path} is no image")


def calibrate(folder: Path, *, report: bool) -> None:
    """What the command does, in a process that has its modules already."""
    session = read_turntable_session(folder)
    run = calibrate_turntable(session)
    if report:
        turntable_page(run, {name: sources[0].load() for name, sources in session.board_images.items()})


def by_numpy(folder: Path, *, report: bool) -> None:
    """The same where no kernels are loaded."""
    with forced(False):
        calibrate(folder, report=report)


def start(folder: Path) -> None:
    """What a command does, in a new process, before its images can be shared: start, import, read the session."""
    code = (
        "import lidarpose.cli.main as m; m.build_app(); import lidarpose.cli.calibrate, lidarpose.detect.scan_lines; "
    )
    code += (
        "import lidarpose.workflows.turntable; from lidarpose.storage.session import read_turntable_session as read; "
    )
    code += "import sys; from pathlib import Path; read(Path(sys.argv[1]))"
    python("-c", code, str(folder))


def decode_alone(folder: Path) -> None:
    """What `decode` does, in a new process that imports nothing for anything else."""
    python("-c", _DECODE_ALONE, str(folder))


_DECODE_ALONE = """
import os, sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import cv2
cv2.setNumThreads(1)
files = sorted(Path(sys.argv[1]).glob("**/*.png"))
with ThreadPoolExecutor(os.cpu_count()) as executor:
    assert all(image is not None for image in executor.map(lambda path: cv2.imread(str(path), 0), files))
"""


def decode_fastest(folder: Path) -> None:
    """The same images as `calibrate` decodes them: by the fastest decoder there is, shared with forked copies."""
    session = read_turntable_session(folder)
    sources = [source for shots in session.board_images.values() for source in shots]
    sources += [place.stripe_image for place in session.places if place.stripe_image is not None]
    share(lambda k: sources[k].load().shape, len(sources), copies=copies_allowed())


def stages(folder: Path) -> dict[str, float]:
    """Seconds of one calibration's parts, one after the other: the first on all cores, the others on one."""
    session = read_turntable_session(folder)
    started = [time.perf_counter()]
    features = detect_features(session)
    started.append(time.perf_counter())
    observations, fitted = assign_lines(session, features)
    start = start_of(solve(observations, fitted))
    started.append(time.perf_counter())
    refine(observations, start)
    started.append(time.perf_counter())
    return dict(zip(STAGES, (b - a for a, b in pairwise(started)), strict=True))


def simulate(folder: Path, places: int = PLACES) -> None:
    arguments = [sys.executable, "-m", "lidarpose", "simulate", "turntable", str(folder), "--places", str(places)]
    subprocess.run([*arguments, "--quiet"], check=True)


DECODING = "decoding the images alone"
PLAIN, REPORT = "calibrate, modules and kernels loaded, no report", "calibrate, modules and kernels loaded, report"
FASTEST = "decoding by the fastest decoder, shared by forked processes"
BY_NUMPY = "the same by NumPy, no report"
DECODING_ALONE = "a new process that decodes the images by OpenCV and does nothing else"
START = "a new process until its images can be shared: start, imports, session read"
STAGES = (
    "of that: boards, scan lines and stripes with decoding, all cores",
    "of that: assignment and closed form, one core",
    "of that: joint estimate, one core",
)
# What a stripe image may take beyond decoding.
STRIPE_S = 0.003
PLAIN_COMMAND, COMMAND = "lidarpose calibrate --no-report", "lidarpose calibrate"


def least_over(found: Contest, places: int = PLACES) -> float:
    """The least that any such calibration takes here, over decoding: images by the fastest decoder, and stripes at
    what they may take, shared by the cores without loss; nothing else."""
    cores = copies_allowed() + 1
    return found.over[FASTEST] + places * STRIPE_S / cores / found.reference_s


def least_command_over(found: Contest, places: int = PLACES) -> float:
    """The same for a command, which has to start first."""
    return least_over(found, places) + found.over[START]


def over_process(found: Contest, name: str) -> float:
    """A command over a process that only decodes: both with their start and imports."""
    return found.over[name] / found.over[DECODING_ALONE]


def measure(folder: Path, repeats: int = REPEATS) -> Contest:
    """Every way beside decoding, all of them in turn."""
    ways: dict[str, Callable[[], None]] = {
        FASTEST: lambda: decode_fastest(folder),
        PLAIN: lambda: calibrate(folder, report=False),
        REPORT: lambda: calibrate(folder, report=True),
        BY_NUMPY: lambda: by_numpy(folder, report=False),
        "the same by NumPy, report": lambda: by_numpy(folder, report=True),
        START: lambda: start(folder),
        DECODING_ALONE: lambda: decode_alone(folder),
        PLAIN_COMMAND: lambda: lidarpose_calibrate(folder, "--no-report"),
        COMMAND: lambda: lidarpose_calibrate(folder),
    }
    # What runs on comes to kernels by itself, after three sessions of this size; without numba there are none.
    with forced(installed()):
        calibrate(folder, report=True)
    calibrate(folder, report=True)
    lidarpose_calibrate(folder)
    decode(folder)
    return beside(lambda: decode(folder), ways, repeats)


def main() -> None:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(temporary) / "session"
        if len(sys.argv) == 1:
            simulate(folder)
        found = measure(folder)
    print(f"{'':70s} {'seconds':>8s} {'ratio':>6s}")
    print(f"{DECODING:70s} {found.reference_s:8.2f} {1.0:6.2f}")
    for name, value in found.seconds.items():
        print(f"{name:70s} {value:8.2f} {found.over[name]:6.2f}")
    for name in (PLAIN_COMMAND, COMMAND):
        print(f"{name + ', over a process that decodes':70s} {'':8s} {over_process(found, name):6.2f}")
    print(f"{'the least that any such job takes here':70s} {'':8s} {least_over(found):6.2f}")
    print(f"{'the least that any such command takes here':70s} {'':8s} {least_command_over(found):6.2f}")


if __name__ == "__main__":
    main()
