"""How one job grows, for the growth suite: memory of one size in a process of its own, or the time of all sizes.

python -m benchmarks.growing memory {places,frames,points,assembled,written} SIZE SESSION
python -m benchmarks.growing time {places,frames,points,assembled,written} SIZE,SIZE,... SESSION ROUNDS
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.timing import Work, peak_of, processor_seconds


def places(size: int, session: Path) -> tuple[Work, Work]:
    """`calibrate` on the first places of a session on disk."""
    from lidarpose.storage.session import read_turntable_session
    from lidarpose.workflows.turntable import calibrate_turntable

    whole = read_turntable_session(session)
    few = [int(k) for k in np.linspace(0, len(whole.places) - 1, size)]

    def calibrate(indices: list[int]) -> object:
        return calibrate_turntable(replace(whole, places=tuple(whole.places[k] for k in indices)))

    return lambda: calibrate(few[:: max(1, size // 4)]), lambda: calibrate(few)


def frames(size: int, session: Path) -> tuple[Work, Work]:
    """The world job on the first frames of every place of a session on disk."""
    from lidarpose.storage.corner_session import read_corner_session
    from lidarpose.workflows.world import calibrate_world

    whole = read_corner_session(session)

    def calibrate(each: int) -> object:
        return calibrate_world(replace(whole, places=tuple(replace(p, clouds=p.clouds[:each]) for p in whole.places)))

    return lambda: calibrate(1), lambda: calibrate(max(1, size // len(whole.places)))


def points(size: int, _: Path) -> tuple[Work, Work]:
    """Three planes of a cloud in memory."""
    from benchmarks.suites.plane_search import ours, scene

    few, many = scene(20_000, None, 1)[0], scene(size, None, 1)[0]
    return lambda: ours(few), lambda: ours(many)


def assembled(size: int, _: Path) -> tuple[Work, Work]:
    """A cloud of a recording in memory."""
    from benchmarks.assemble import MOTION, recording
    from lidarpose.measure.assemble import assemble

    few, many = recording(64, 2000), recording(size // 2000, 2000)
    return lambda: assemble(few, MOTION), lambda: assemble(many, MOTION)


def written(size: int, _: Path) -> tuple[Work, Work]:
    """A cloud in memory to a PLY."""
    from lidarpose.model.cloud import Cloud
    from lidarpose.storage.clouds import write_cloud

    cloud = Cloud(np.random.default_rng(0).uniform(-9.0, 9.0, (size, 3)).astype(np.float32))
    path = Path(tempfile.mkdtemp()) / "cloud.ply"

    def write(count: int) -> None:
        write_cloud(path, Cloud(cloud.points[:count]))
        path.unlink()

    return lambda: write(1000), lambda: write(size)


JOBS: dict[str, Callable[[int, Path], tuple[Work, Work]]] = {
    "places": places,
    "frames": frames,
    "points": points,
    "assembled": assembled,
    "written": written,
}


# Jobs shorter than this are done several times: the system counts processor time in steps.
LEAST_S = 0.1


def memory(name: str, size: int, session: Path) -> float:
    """MB above the input."""
    warm, work = JOBS[name](size, session)
    # Imports, caches and thread pools are no part of how the work grows.
    warm()
    return peak_of(work)[1]


def rounds(name: str, sizes: list[int], session: Path, repeats: int) -> list[list[float]]:
    """Processor seconds of every size, all of them in turn, after a round that makes the process warm."""
    works = [JOBS[name](size, session)[1] for size in sizes]
    calls = [max(1, round(LEAST_S / max(processor_seconds(work), 1e-4))) for work in works]

    def each(work: Work, times: int) -> float:
        return processor_seconds(lambda: [work() for _ in range(times)]) / times

    return [[each(work, times) for work, times in zip(works, calls, strict=True)] for _ in range(repeats)]


def main() -> None:
    what, name, sizes, session = sys.argv[1:5]
    if what == "memory":
        print(json.dumps(memory(name, int(sizes), Path(session))))
    else:
        print(json.dumps(rounds(name, [int(size) for size in sizes.split(",")], Path(session), int(sys.argv[5]))))


if __name__ == "__main__":
    main()
