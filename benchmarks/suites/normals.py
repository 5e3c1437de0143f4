"""Normals of a cloud by Open3D and small_gicp. lidarpose computes none: it fits planes."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.peers import peer
from benchmarks.report import Effort, Report, Table
from benchmarks.suites.plane_search import ours, scene
from benchmarks.timing import interleaved
from lidarpose.geometry.arrays import FloatArray

NEIGHBOURS = 20
LIDARPOSE = "lidarpose: three planes of the same cloud, for comparison"


def run(effort: Effort) -> Report:
    n = effort.pick(700_000, 60_000)
    points, _ = scene(n, None, 1)
    ways: dict[str, Callable[[], object] | None] = {
        LIDARPOSE: partial(ours, points),
        f"Open3D estimate_normals, {NEIGHBOURS} neighbours": _open3d(points),
        f"small_gicp estimate_normals, {NEIGHBOURS} neighbours": _small_gicp(points),
    }
    ours(points)
    times = interleaved({name: way for name, way in ways.items() if way is not None}, effort.pick(3, 1))
    rows = [[name, times.get(name)] for name in ways]
    text = f"{n} points. lidarpose has no normals a point; what it needs them for is done by planes."
    return Report({}, [Table("Normals", ["contestant", "s"], rows, text)])


def _open3d(points: FloatArray) -> Callable[[], object] | None:
    o3d = peer("open3d")
    if o3d is None:
        return None
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    search = o3d.geometry.KDTreeSearchParamKNN(NEIGHBOURS)
    return partial(cloud.estimate_normals, search)


def _small_gicp(points: FloatArray) -> Callable[[], object] | None:
    library = peer("small_gicp")
    if library is None:
        return None

    def estimate() -> object:
        cloud = library.PointCloud(np.asarray(points))
        return library.estimate_normals(cloud, num_neighbors=NEIGHBOURS, num_threads=os.cpu_count() or 1)

    return estimate
