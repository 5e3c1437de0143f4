"""Clouds written and read against numpy's raw bytes, and by other libraries."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.peers import peer
from benchmarks.report import Effort, Report, Table
from benchmarks.timing import Work, beside
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds import read_cloud, write_cloud


@dataclass(frozen=True)
class _Way:
    """How somebody writes and reads one format; None where the library is not installed."""

    write: Work | None
    read: Work | None


def run(effort: Effort) -> Report:
    n = effort.pick(3_000_000, 500_000)
    points = np.random.default_rng(0).uniform(-20.0, 20.0, (n, 3)).astype(np.float32)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        ways = _ways(folder, points)
        writing = _Held({name: way.write for name, way in ways.items()}, effort, folder)
        reading = _Held({name: way.read for name, way in ways.items()}, effort)
    figures = {}
    for kind in ("pcd", "ply"):
        figures[f"files.{kind}_write"] = writing.over[f"lidarpose {kind}"]
        figures[f"files.{kind}_read"] = reading.over[f"lidarpose {kind}"]
    figures["files.laz_write"], figures["files.laz_read"] = writing.laz, reading.laz
    rows = [
        [name, writing.seconds.get(name), writing.over.get(name), reading.seconds.get(name), reading.over.get(name)]
        for name in ways
    ]
    text = (
        f"{n} points x, y, z of float32 ({points.nbytes / 1e6:.0f} MB), to new files in the page cache and from it, "
        "nothing flushed; reading looks at every number once."
    )
    columns = ["who", "write, s", "over np.save", "read, s", "over np.load"]
    return Report(figures, [Table("Cloud files", columns, rows, text)])


RAW = "np.save, np.load"


class _Held:
    """All ways beside numpy's, and our LAZ beside laspy's.

    Attributes
    ----------
    seconds, over
        By way, numpy's among them, what is installed only.
    laz
        The time of our LAZ over laspy's.
    """

    def __init__(self, works: Mapping[str, Work | None], effort: Effort, emptied: Path | None = None) -> None:
        """`emptied`: a folder that is made empty before each run; in the end, all ways have been called once more."""
        here = {name: work for name, work in works.items() if work is not None}
        raw = here.pop(RAW)
        least_s = effort.pick(1, 0) * 0.2

        def empty() -> None:
            # A file that replaces another is written out at once by some file systems, a new one is not.
            for path in emptied.iterdir() if emptied is not None else ():
                path.unlink()

        every = [raw, *here.values()]
        if emptied is None:
            for work in every:
                work()
        found = beside(raw, here, effort.pick(5, 1), budget_s=3.0, before_each=empty, least_s=least_s)
        laz = beside(
            here["laspy laz"],
            {"ours": here["lidarpose laz"]},
            effort.pick(5, 1),
            budget_s=6.0,
            before_each=empty,
            least_s=least_s,
        )
        if emptied is not None:
            for work in every:
                work()
        self.seconds = {RAW: found.reference_s, **found.seconds}
        self.over = {RAW: 1.0, **found.over}
        self.laz = laz.over["ours"]


def _ways(folder: Path, points: np.ndarray) -> dict[str, _Way]:
    raw = folder / "raw.npy"
    ways = {RAW: _Way(partial(np.save, raw, points), lambda: touched(np.load(raw)))}
    cloud = Cloud(points)
    for kind in ("npy", "ply", "pcd", "las", "laz", "e57"):
        path = folder / f"ours.{kind}"
        ways[f"lidarpose {kind}"] = _Way(partial(write_cloud, path, cloud), partial(_read_ours, path))
    ways |= _open3d(folder, points) | _plyfile(folder, points) | _laspy(folder, points)
    return ways


def touched(points: np.ndarray) -> float:
    """Every number looked at once, so that a memory map counts as read only when it is."""
    return float(points.sum())


def _read_ours(path: Path) -> float:
    return touched(read_cloud(path).points)


def _open3d(folder: Path, points: np.ndarray) -> dict[str, _Way]:
    o3d: Any = peer("open3d")
    if o3d is None:
        return {"Open3D ply": _Way(None, None), "Open3D pcd": _Way(None, None)}
    cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    ways = {}
    for kind in ("ply", "pcd"):
        path = str(folder / f"open3d.{kind}")
        write = partial(o3d.t.io.write_point_cloud, path, cloud)
        ways[f"Open3D {kind}"] = _Way(write, partial(_read_open3d, o3d, path))
    return ways


def _read_open3d(o3d: Any, path: str) -> float:
    return touched(o3d.t.io.read_point_cloud(path).point.positions.numpy())


def _plyfile(folder: Path, points: np.ndarray) -> dict[str, _Way]:
    library: Any = peer("plyfile")
    if library is None:
        return {"plyfile ply": _Way(None, None)}
    path = folder / "plyfile.ply"

    def write() -> None:
        rows = np.ascontiguousarray(points).view([(axis, "f4") for axis in "xyz"]).ravel()
        library.PlyData([library.PlyElement.describe(rows, "vertex")]).write(path)

    def read() -> float:
        vertex = library.PlyData.read(path)["vertex"]
        return sum(touched(vertex[axis]) for axis in "xyz")

    return {"plyfile ply": _Way(write, read)}


def _laspy(folder: Path, points: np.ndarray) -> dict[str, _Way]:
    import laspy

    def write(path: Path) -> None:
        header = laspy.LasHeader(point_format=6, version="1.4")
        header.scales = np.full(3, 1e-5)
        las = laspy.LasData(header)
        las.x, las.y, las.z = points.T
        las.write(path)

    def read(path: Path) -> float:
        return touched(np.asarray(laspy.read(path).xyz))

    paths = {kind: folder / f"laspy.{kind}" for kind in ("las", "laz")}
    return {f"laspy {kind}": _Way(partial(write, path), partial(read, path)) for kind, path in paths.items()}
