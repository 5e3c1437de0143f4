"""Assembling against copying, and streaming to a PLY against writing the same bytes.

    python -m benchmarks.assemble [--sweeps 6000] [--beams 3240] [--stream-points 100000000]

Prints one JSON object. Every run stands between two of its reference, and the median of the ratios counts, as the
machine may be shared. Memory is the largest resident set of a process that streams the whole recording.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from benchmarks.timing import beside, seconds
from lidarpose.geometry.compiled import installed
from lidarpose.geometry.se3 import Pose
from lidarpose.measure.assemble import assemble
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import write_calibration
from lidarpose.storage.recording import write_recording

MOTION = TurntableMotion(
    Pose.exp([0.1, -0.2, 0.3, 0.4, 0.5, -0.6]),
    Pose(Pose.exp([0.0, 0.0, 0.0, 0.3, 0.2, 0.1]).rotation, np.array([0.05, 0.0, 0.0])),
)


def recording(sweeps: int, beams: int) -> SweepRecording:
    rng = np.random.default_rng(0)
    ranges = np.tile(rng.uniform(0.5, 10.0, (min(64, sweeps), beams)).astype(np.float32), (-(-sweeps // 64), 1))[
        :sweeps
    ]
    return SweepRecording("bench", np.arange(sweeps) * 0.01, np.linspace(-45.0, 225.0, beams), ranges)


def in_memory(sweeps: int, beams: int, repeats: int) -> dict[str, Any]:
    """Points a second of both ways and of a copy of the result."""
    source = recording(sweeps, beams)
    out = np.zeros((sweeps, beams, 3), dtype=np.float32)
    copy = np.zeros_like(out)
    ways: dict[str, Callable[[], Any]] = {
        "numpy": lambda: assemble(source, MOTION, out=out, compiled=False),
    }
    first: float | None = None
    if installed():
        first = seconds(lambda: assemble(source, MOTION, out=out, compiled=True))
        ways["compiled"] = lambda: assemble(source, MOTION, out=out, compiled=True)
    found = beside(lambda: np.copyto(copy, out), ways, repeats, least_s=0.2)
    times = {"copy": found.reference_s, **found.seconds}
    return {
        "points": sweeps * beams,
        "million_points_per_s": {name: sweeps * beams / value / 1e6 for name, value in times.items()},
        "time_over_copy": {"copy": 1.0, **found.over},
        "first_compiled_call_s": first,
    }


_ONE_SHOT = """
import sys, time
from benchmarks.assemble import MOTION, recording
points, beams, way = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
source = recording(points // beams, beams)
begin = time.perf_counter()
from lidarpose.measure.assemble import assemble
assemble(source, MOTION, compiled={"numpy": False, "compiled": True, "default": None}[way])
print(time.perf_counter() - begin)
"""


def first_compiling(beams: int) -> float | None:
    """Seconds of a process that finds no kernels on the disk and compiles them; None without numba."""
    if not installed():
        return None
    with tempfile.TemporaryDirectory() as empty:
        command = [sys.executable, "-c", _ONE_SHOT, str(100 * beams), str(beams), "compiled"]
        environment = {**os.environ, "NUMBA_CACHE_DIR": empty}
        done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    return float(done.stdout)


def one_shot(points: int, beams: int, repeats: int = 3) -> list[float | None]:
    """Seconds of assembling once in a new process: by NumPy, compiled, and as the package chooses by itself."""
    times: dict[str, list[float]] = {"numpy": [], "compiled": [], "default": []}
    if not installed():
        del times["compiled"]
    for _ in range(repeats):
        for way, values in times.items():
            command = [sys.executable, "-c", _ONE_SHOT, str(points), str(beams), way]
            values.append(float(subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True).stdout))
    return [median(times[way]) if way in times else None for way in ("numpy", "compiled", "default")]


def streamed(points: int, beams: int, repeats: int) -> dict[str, Any]:
    """`lidarpose scan` to a PLY in processes of its own, against writing the same bytes; largest memory in MB."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        write_recording(root / "rec", recording(points // beams, beams))
        write_calibration(root / "cal.json", TurntableCalibration(MOTION))
        memory = []

        def clean() -> None:
            # New files and an idle disk: to replace a file and to write back an earlier one takes what it likes.
            for name in ("cloud.ply", "raw"):
                (root / name).unlink(missing_ok=True)
            os.sync()

        def scan() -> None:
            _run_scan(root)
            memory.append(float((root / "memory").read_text()))

        scan()
        size = (root / "cloud.ply").stat().st_size
        # Each once beforehand: reading the recording from the disk is no part of it.
        found = beside(lambda: _write_raw(root, size), {"scan": scan}, repeats, before_each=clean, least_s=0.5)
    return {
        "points": points,
        "scan_s": found.seconds["scan"],
        "raw_write_s": found.reference_s,
        "ratio": found.over["scan"],
        "memory_mb": max(memory),
    }


_CHILD = """
import sys
from pathlib import Path
from lidarpose.cli.main import run
status = run(sys.argv[2:])
# Of this process alone: the usage that the system reports starts at the parent's.
peak = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmHWM"))
Path(sys.argv[1]).write_text(str(int(peak.split()[1]) / 1024))
sys.exit(status)
"""


def _run_scan(root: Path) -> None:
    arguments = ["scan", str(root / "rec"), str(root / "cal.json"), "-o", str(root / "cloud.ply")]
    command = [sys.executable, "-c", _CHILD, str(root / "memory"), *arguments]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


def _write_raw(root: Path, size: int) -> None:
    """As many bytes from memory to a new file, in the page cache as the scan's: neither is flushed to the disk."""
    block = np.ones(12 << 20, dtype=np.uint8).data
    with (root / "raw").open("wb") as file:
        for start in range(0, size, len(block)):
            file.write(block[: min(len(block), size - start)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sweeps", type=int, default=6000)
    parser.add_argument("--beams", type=int, default=3240)
    parser.add_argument("--stream-points", type=int, default=100_000_000)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    result = {
        "in_memory": in_memory(options.sweeps, options.beams, options.repeats),
        "streamed": streamed(options.stream_points, options.beams, max(1, options.repeats // 2)),
    }
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
