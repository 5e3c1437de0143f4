"""The world job from 120 HDL-32 frames on disk, against reading them."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.report import Effort, Report, Table
from benchmarks.suites.files import touched
from benchmarks.timing import interleaved
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
        ways = {
            "reading the frames": lambda: _read(read_corner_session(folder)),
            "calibrate, modules loaded": lambda: calibrate_world(read_corner_session(folder)),
        }
        result = calibrate_world(read_corner_session(folder))
        times = interleaved(ways, effort.pick(5, 1))
    reading, whole = times["reading the frames"], times["calibrate, modules loaded"]
    metres, _ = result.T_world_source.distance(truth.T_world_lidar)
    points = sum(len(p.clouds[0].load()) for p in session.places) * frames
    text = f"{PLACES} places, {frames} frames each, {points} points in all; the answer is {1e3 * metres:.2f} mm off."
    rows = [[name, value, value / reading] for name, value in times.items()]
    return Report(
        {"world.reading": whole / reading}, [Table("The world job", ["work", "s", "over reading"], rows, text)]
    )


def _read(session: CornerSession) -> float:
    """Every frame, every number looked at once: a memory map alone reads nothing."""
    return sum(touched(source.load().points) for place in session.places for source in place.clouds)
