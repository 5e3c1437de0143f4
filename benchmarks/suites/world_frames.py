"""The world job from 120 HDL-32 frames on disk, against reading them."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.report import Cell, Effort, Report, Table
from benchmarks.suites.files import touched
from benchmarks.timing import beside
from lidarpose.model.corner_session import CornerSession
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.storage.corner_session import read_corner_session, write_corner_session
from lidarpose.workflows.world import calibrate_world

PLACES = 6


def run(effort: Effort) -> Report:
    frames = effort.pick(20, 2)
    session, truth = simulate_corner_session(CornerSceneSpec(pose="1", frames=frames, seed=1))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "session"
        write_corner_session(folder, session)
        result = calibrate_world(read_corner_session(folder))
        _read(read_corner_session(folder))
        ways = {"calibrate, modules loaded": lambda: calibrate_world(read_corner_session(folder))}
        found = beside(lambda: _read(read_corner_session(folder)), ways, effort.pick(15, 1), least_s=0.2)
    metres, _ = result.T_world_source.distance(truth.T_world_lidar)
    points = sum(len(p.clouds[0].load()) for p in session.places) * frames
    text = f"{PLACES} places, {frames} frames each, {points} points in all; the answer is {1e3 * metres:.2f} mm off."
    rows: list[list[Cell]] = [["reading the frames", found.reference_s, 1.0]]
    rows += [[name, value, found.over[name]] for name, value in found.seconds.items()]
    (ratio,) = found.over.values()
    return Report({"world.reading": ratio}, [Table("The world job", ["work", "s", "over reading"], rows, text)])


def _read(session: CornerSession) -> float:
    """Every frame, every number looked at once: a memory map alone reads nothing."""
    return sum(touched(source.load().points) for place in session.places for source in place.clouds)
