"""The world job from 120 HDL-32 frames on disk, against reading them."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.peers import peer
from benchmarks.report import Cell, Effort, Report, Table
from benchmarks.suites.files import touched
from benchmarks.timing import Contest, beside, lidarpose_calibrate, python
from lidarpose.detect.moved_points import moved_points
from lidarpose.geometry.compiled import forced, installed
from lidarpose.geometry.threads import one_blas_thread
from lidarpose.model.corner_session import CornerSession
from lidarpose.refine.corner_model import CornerState, fit_corner_model
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.storage.corner_session import read_corner_session, write_corner_session
from lidarpose.workflows.corner_target import find_target, gather, observe
from lidarpose.workflows.world import calibrate_world, locate_target, world_run

PLACES = 6


def run(effort: Effort) -> Report:
    frames = effort.pick(20, 2)
    session, truth = simulate_corner_session(CornerSceneSpec(pose="1", frames=frames, seed=1))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "session"
        write_corner_session(folder, session)
        result = calibrate_world(read_corner_session(folder))
        ways = {FIRST: partial(_calibrate, folder, False), **_parts(folder, False), OPEN3D: _open3d_reading(folder)}
        if installed():
            ways |= {KERNELS: partial(_calibrate, folder, True), **_parts(folder, True)}
            ways[MOVED] = partial(_by_one_way, partial(_moved, read_corner_session(folder)), True)
        ways[BYTES] = partial(_bytes_alone, sorted(folder.rglob("*.pcd")))
        works = {name: way for name, way in ways.items() if way is not None}
        for work in (lambda: _read(read_corner_session(folder)), *works.values()):
            work()
        found = beside(lambda: _read(read_corner_session(folder)), works, effort.pick(15, 1), least_s=0.2)
        processes = _processes(folder, effort.pick(9, 1))
    metres, _ = result.T_world_source.distance(truth.T_world_lidar)
    points = sum(len(p.clouds[0].load()) for p in session.places) * frames
    text = f"{PLACES} places, {frames} frames each, {points} points in all; the answer is {1e3 * metres:.2f} mm off."
    rows: list[list[Cell]] = [["reading the frames", found.reference_s, 1.0]]
    rows += [[name, value, found.over[name]] for name, value in found.seconds.items()]
    figures = {figure: found.over[name] for figure, name in _FIGURES.items() if name in found.over}
    if OPEN3D in found.over:
        figures["world.open3d_reading"] = found.over[FIRST] / found.over[OPEN3D]
    figures |= {figure: processes.over[name] for figure, name in _PROCESS_FIGURES.items()}
    if OPEN3D_PROCESS in processes.over:
        figures["world.process_open3d"] = processes.over[COMMAND] / processes.over[OPEN3D_PROCESS]
    whole: list[list[Cell]] = [["a process that reads the frames and does nothing else", processes.reference_s, 1.0]]
    whole += [[name, value, processes.over[name]] for name, value in processes.seconds.items()]
    tables = [
        Table("The world job", ["work", "s", "over reading"], rows, text),
        Table("The world job as a command", ["process", "s", "over reading"], whole, _PROCESSES),
    ]
    return Report(figures, tables)


FIRST = "calibrate, modules loaded"
KERNELS = "calibrate in a process that runs on (kernels loaded)"
FIND = "of it, finding the target"
CUT = "of it, reading all frames and cutting the target out"
ESTIMATE = "of it, the estimate and its verdict"
LEAST = "reading, cutting out, selecting the faces' beams and fitting once, all known before"
BY_KERNELS = ", by kernels"
MOVED = "of finding, a frame of each place read and what moved at three of them told, by kernels"
BYTES = "of cutting, the files' bytes alone into memory that is used again, on all cores"
_FIGURES = {
    "world.reading": FIRST,
    "world.find": FIND,
    "world.cut": CUT,
    "world.estimate": ESTIMATE,
    "world.least": LEAST,
    "world.kernels": KERNELS,
    "world.kernels_find": FIND + BY_KERNELS,
    "world.kernels_cut": CUT + BY_KERNELS,
    "world.kernels_estimate": ESTIMATE + BY_KERNELS,
    "world.kernels_least": LEAST + BY_KERNELS,
    "world.find_least": MOVED,
    "world.cut_least": BYTES,
}
OPEN3D = "Open3D's `read_point_cloud` of the same frames"


PLAIN_COMMAND, COMMAND = "lidarpose calibrate --no-report", "lidarpose calibrate"
OPEN3D_PROCESS = "a process that reads them with Open3D and does nothing else"
_PROCESS_FIGURES = {"world.process": COMMAND, "world.process_plain": PLAIN_COMMAND}
_PROCESSES = (
    "The same session by whole processes, Python's start and all imports included on both sides: what a user waits "
    "for, against what he would wait for if the frames were read and no more."
)
_READING_ALONE = """
import sys
from pathlib import Path
from lidarpose.storage.corner_session import read_corner_session
session = read_corner_session(Path(sys.argv[1]))
sum(float(source.load().points.sum()) for place in session.places for source in place.clouds)
"""
_OPEN3D_ALONE = """
import sys
from pathlib import Path
import numpy as np
import open3d as o3d
paths = sorted(Path(sys.argv[1]).rglob("*.pcd"))
sum(float(np.asarray(o3d.io.read_point_cloud(str(path)).points).sum()) for path in paths)
"""


def _processes(folder: Path, repeats: int) -> Contest:
    """Commands beside a process that only reads the frames, by our reader and by Open3D's."""
    ways: dict[str, Callable[[], object]] = {
        PLAIN_COMMAND: lambda: lidarpose_calibrate(folder, "--no-report"),
        COMMAND: lambda: lidarpose_calibrate(folder),
    }
    if peer("open3d") is not None:
        ways[OPEN3D_PROCESS] = lambda: python("-c", _OPEN3D_ALONE, str(folder))
    works = [lambda: python("-c", _READING_ALONE, str(folder)), *ways.values()]
    for work in works:
        work()
    return beside(works[0], ways, repeats)


def _calibrate(folder: Path, way: bool) -> object:
    with forced(way):
        return calibrate_world(read_corner_session(folder))


def _parts(folder: Path, way: bool) -> dict[str, Callable[[], object]]:
    """The job's parts by NumPy alone, or by kernels; and what no way of doing it can leave out: reading all frames, a
    pass for cutting out, one for selecting, and the last steps of the fit, all known beforehand."""
    session = read_corner_session(folder)
    located = locate_target(session)
    run = world_run(session, located=located)
    assert run.normals is not None
    assert run.calibration.quality is not None
    sigma_m = run.calibration.quality.figures["range_sigma_mm"] / 1000.0
    corners = np.stack([place.corner for place in run.places])
    state = CornerState(run.calibration.T_world_source, run.normals, 1.0, np.zeros((len(corners), 3)))

    def least() -> object:
        crops = gather(read_corner_session(folder), located.found)
        places, _ = observe(session, located.found, crops, corners, state.normals, sigma_m)
        return fit_corner_model(places, state, sigma_m, near=True)

    works: dict[str, Callable[[], object]] = {
        FIND: lambda: find_target(session),
        CUT: lambda: gather(session, located.found),
        ESTIMATE: lambda: world_run(session, located=located),
        LEAST: least,
    }
    return {name + way * BY_KERNELS: partial(_by_one_way, work, way) for name, work in works.items()}


def _by_one_way(work: Callable[[], object], way: bool) -> object:
    with forced(way), one_blas_thread():
        return work()


def _moved(session: CornerSession) -> object:
    """What any finding by what moves begins with: no search, no fit."""
    frames = [place.clouds[0].load().finite().points for place in session.places]
    return moved_points(frames[:3])


def _bytes_alone(paths: Sequence[Path]) -> None:
    """What any cutting has to wait for, whatever it does with them."""
    cores = os.cpu_count() or 1

    def read(share: Sequence[Path]) -> None:
        memory = bytearray(max((path.stat().st_size for path in share), default=0))
        for path in share:
            with path.open("rb", buffering=0) as file:
                file.readinto(memory)

    with ThreadPoolExecutor(cores) as pool:
        list(pool.map(read, [paths[k::cores] for k in range(cores)]))


def _open3d_reading(folder: Path) -> Callable[[], object] | None:
    """The frames by the reader that many users know, one after the other; None where it is not installed."""
    o3d = peer("open3d")
    if o3d is None:
        return None
    paths = sorted(str(path) for path in folder.rglob("*.pcd"))
    return lambda: sum(touched(np.asarray(o3d.io.read_point_cloud(path).points)) for path in paths)


def _read(session: CornerSession) -> float:
    """Every frame, every number looked at once: a memory map alone reads nothing."""
    return sum(touched(source.load().points) for place in session.places for source in place.clouds)
