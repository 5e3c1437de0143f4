"""Planes of a cloud one after the other by other libraries, as their documentation shows it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.peers import peer
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.planes import Plane, fit_plane

THRESHOLD_M = 0.01
PLANES = 3
Search = Callable[[FloatArray], FloatArray]


def open3d_planes(iterations: int) -> Search | None:
    """`PointCloud.segment_plane`, three times, each plane's inliers taken out."""
    o3d = peer("open3d")
    if o3d is None:
        return None

    def search(points: FloatArray) -> FloatArray:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        o3d.utility.random.seed(1)
        normals = []
        for _ in range(PLANES):
            if len(cloud.points) < 3:
                break
            # Open3D refits the plane to its inliers itself.
            model, inliers = cloud.segment_plane(THRESHOLD_M, 3, iterations)
            normals.append(np.asarray(model[:3]))
            cloud = cloud.select_by_index(inliers, invert=True)
        return np.array(normals).reshape(-1, 3)

    return search


def open3d_planes_of_subsample(size: int, iterations: int) -> Search | None:
    """The same on a random subsample, each plane then fitted to all points within the threshold of it."""
    search = open3d_planes(iterations)
    if search is None:
        return None

    def subsampled(points: FloatArray) -> FloatArray:
        rng = np.random.default_rng(1)
        o3d = peer("open3d")
        assert o3d is not None
        few = points[rng.integers(0, len(points), min(size, len(points)))]
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(few))
        o3d.utility.random.seed(1)
        planes: list[FloatArray] = []
        rest = points
        for _ in range(PLANES):
            model, inliers = cloud.segment_plane(THRESHOLD_M, 3, iterations)
            cloud = cloud.select_by_index(inliers, invert=True)
            near = np.abs(rest @ model[:3] + model[3]) < THRESHOLD_M
            planes.append(fit_plane(rest[near]).normal if near.sum() > 3 else np.asarray(model[:3]))
            rest = rest[~near]
        return np.array(planes)

    return subsampled


def pyransac3d_planes(iterations: int) -> Search | None:
    """`pyransac3d.Plane().fit`, three times, with the refit that it leaves to its user."""
    library = peer("pyransac3d")
    if library is None:
        return None

    def search(points: FloatArray) -> FloatArray:
        import random

        random.seed(1)
        rest, normals = points, []
        for _ in range(PLANES):
            _, inliers = library.Plane().fit(rest, THRESHOLD_M, maxIteration=iterations)
            plane: Plane = fit_plane(rest[inliers])
            normals.append(plane.normal)
            rest = np.delete(rest, inliers, axis=0)
        return np.array(normals).reshape(-1, 3)

    return search
