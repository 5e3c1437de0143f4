"""The world job as one would do it with a general library: planes, corner and singular values; or registration."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.peers import peer
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.planes import Plane, intersect_three_planes
from lidarpose.geometry.se3 import Pose
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.model.corner_session import CornerSession
from lidarpose.solve.corner_alignment import svd_pose
from lidarpose.workflows.world import LocatedTarget

THRESHOLD_M = 0.02
ITERATIONS = 1000
GROUND_CLEARANCE_M = 0.04
ICP_REACH_M = 0.05
Method = Callable[[CornerSession, LocatedTarget], Pose]


def regions(located: LocatedTarget) -> list[tuple[CornerCandidate, FloatArray]]:
    """Where the target was sighted, and all returns around there but the ground's: every peer is given as much."""
    found = []
    for sighting, crop in zip(located.found.sightings, located.crops, strict=True):
        if sighting is None:
            raise ValueError("the target was not sighted at every place")
        reach = min(float(np.linalg.norm(o - sighting.corner, axis=1).max()) for o in sighting.outlines)
        points = crop.points[np.linalg.norm(crop.points - sighting.corner, axis=1) < min(0.85 * reach, 0.6)]
        for ground in sighting.obstacles:
            points = points[ground.distance(points) > GROUND_CLEARANCE_M]
        found.append((sighting, points.astype(np.float64)))
    return found


def open3d_corners() -> Method | None:
    """Three planes by Open3D's `segment_plane`, their common point at every place, then Umeyama's singular values."""
    o3d = peer("open3d")
    if o3d is None:
        return None

    def calibrate(session: CornerSession, located: LocatedTarget) -> Pose:
        corners = [_corner(o3d, points) for _, points in regions(located)]
        return svd_pose(np.stack([p.corner_world for p in session.places]), np.stack(corners))

    return calibrate


def _corner(o3d: Any, points: FloatArray) -> FloatArray:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    o3d.utility.random.seed(1)
    planes = []
    for _ in range(3):
        if len(cloud.points) < 10:
            raise ValueError("fewer than three planes")
        model, inliers = cloud.segment_plane(THRESHOLD_M, 3, ITERATIONS)
        planes.append(Plane(np.asarray(model[:3]), -float(model[3])))
        cloud = cloud.select_by_index(inliers, invert=True)
    return intersect_three_planes((planes[0], planes[1], planes[2]))


def registered_places() -> Method | None:
    """Point-to-plane ICP (Chen and Medioni 1992; Open3D) of every place's returns on the first place's.

    It tells how the target moved, not where its corner is: that comes from the first place's planes.
    """
    o3d = peer("open3d")
    if o3d is None:
        return None

    def calibrate(session: CornerSession, located: LocatedTarget) -> Pose:
        seen = regions(located)
        first_sighting, first = seen[0]
        target = _with_normals(o3d, first)
        corner = _corner(o3d, first)
        estimation = o3d.pipelines.registration.TransformationEstimationPointToPlane()
        corners = [corner]
        for sighting, points in seen[1:]:
            start = np.eye(4)
            start[:3, 3] = first_sighting.corner - sighting.corner
            source = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
            moved = o3d.pipelines.registration.registration_icp(source, target, ICP_REACH_M, start, estimation)
            back = Pose.from_matrix(np.array(moved.transformation)).inverse()
            corners.append(back @ corner)
        return svd_pose(np.stack([p.corner_world for p in session.places]), np.stack(corners))

    return calibrate


def _with_normals(o3d: Any, points: FloatArray) -> Any:
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    # A metric radius: a fixed number of neighbours would stay on one scan line.
    cloud.estimate_normals(o3d.geometry.KDTreeSearchParamRadius(0.15))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud
