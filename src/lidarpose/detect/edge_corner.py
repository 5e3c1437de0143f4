"""The corner at the end of an edge of two faces, where the third is no patch: seen by a scan line or two.

Behind both planes of a convex edge, or before both of a concave one, and at its end that shows itself to the sensor,
only the third face can be seen. Its few returns tell how high it is, and the edge's direction stands for its normal.
"""

from __future__ import annotations

from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.trihedral_corner import convex_outline
from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.planes import Plane
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.model.plane_patch import PlanePatch

# Faces farther from the edge than this are no part of the target; they come at least so near to it.
REACH_M, NEAR_M = 0.8, 0.12
LEAST_SINE = 0.5
LEAST_COMMON_M = 0.1
FEWEST, FEWEST_THIRD = 12, 8
ONE_SIDED = 0.9
# Returns of the third face lie behind the other two by this, and so near to where those end.
BEHIND_M, RISE_M = 0.02, 0.25
# Sine of the angle by which the third face may lean against the plane square to the edge.
MOST_LEAN = 0.35


def find_edge_corners(
    points: NDArray[np.floating[Any]], patches: tuple[PlanePatch, ...]
) -> tuple[CornerCandidate, ...]:
    """Corners at the visible ends of edges between two patches.

    Parameters
    ----------
    points : (N, 3)
        The cloud, its origin at the sensor.
    patches
        What `segment_planes` found in it.

    Returns
    -------
    Candidates whose third normal is the direction of the edge, towards the sensor; the third outline is where the
    third face's returns lie.
    """
    members = [points[p.indices].astype(np.float64) for p in patches]
    found = []
    for a, b in combinations(range(len(patches)), 2):
        candidate = _corner(points, (patches[a], patches[b]), (members[a], members[b]))
        if candidate is not None:
            found.append(candidate)
    return tuple(sorted(found, key=lambda c: -c.support))


def _corner(
    points: NDArray[np.floating[Any]], patches: tuple[PlanePatch, PlanePatch], members: tuple[FloatArray, FloatArray]
) -> CornerCandidate | None:
    planes = [p.plane for p in patches]
    along = np.cross(planes[0].normal, planes[1].normal)
    if np.linalg.norm(along) < LEAST_SINE:
        return None
    along = unit(along)
    foot = np.linalg.solve([planes[0].normal, planes[1].normal, along], [planes[0].offset, planes[1].offset, 0.0])
    local = [_beside(m, foot, along) for m in members]
    if min(len(m) for m in local) < FEWEST:
        return None
    sigma_m = max(p.sigma_m for p in patches)
    side = _side(local, planes, 3.0 * sigma_m)
    if side == 0.0:
        return None
    spans = [np.quantile(m @ along, [0.02, 0.98]) for m in local]
    if min(s[1] for s in spans) - max(s[0] for s in spans) < LEAST_COMMON_M:
        return None
    low, high = min(s[0] for s in spans), max(s[1] for s in spans)
    # A convex corner's other two faces lie below its third, a concave one's above it.
    ends = ((along, high), (-along, -low)) if side < 0.0 else ((along, low), (-along, -high))
    for direction, height in ends:
        end = foot + height * direction
        # The end that shows its face: the sensor is beyond the face, which may lean against the edge.
        if height < MOST_LEAN * np.linalg.norm(end):
            candidate = _with_third_face(points, planes, local, end, direction, side, sigma_m)
            if candidate is not None:
                return candidate
    return None


def _beside(points: FloatArray, foot: FloatArray, along: FloatArray) -> FloatArray:
    """Points (M, 3) within reach of the edge; none if they all keep away from it."""
    offset = points - foot
    offset -= np.outer(offset @ along, along)
    distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
    if distance.min() > NEAR_M:
        return points[:0]
    return np.asarray(points[distance < REACH_M])


def _side(local: list[FloatArray], planes: list[Plane], tolerance: float) -> float:
    """-1 if each face lies behind the other's plane, 1 if before it, 0 if neither."""
    heights = [planes[1 - k].distance(points) for k, points in enumerate(local)]
    for side in (-1.0, 1.0):
        if all(float(np.mean(side * h > -tolerance)) >= ONE_SIDED for h in heights):
            return side
    return 0.0


def _with_third_face(
    points: NDArray[np.floating[Any]],
    planes: list[Plane],
    local: list[FloatArray],
    end: FloatArray,
    along: FloatArray,
    side: float,
    sigma_m: float,
) -> CornerCandidate | None:
    offset = points - end.astype(points.dtype)
    near = points[np.einsum("ij,ij->i", offset, offset) < REACH_M**2].astype(np.float64)
    # No farther from either plane than the other face reaches: beyond its far edge other things are seen.
    far = [max(float(np.quantile(side * planes[1 - k].distance(p), 0.98)), 0.1) for k, p in enumerate(local)]
    behind = np.abs((near - end) @ along) < RISE_M
    for plane, reach in zip(planes, (far[1], far[0]), strict=True):
        depth = side * plane.distance(near)
        behind &= (depth > BEHIND_M) & (depth < reach)
    third = near[behind]
    if len(third) < FEWEST_THIRD:
        return None
    height = float(np.median(third @ along))
    corner = end + (height - float(end @ along)) * along
    faces = [*planes, Plane(along, height)]
    outlines = [convex_outline(plane.project(p), plane) for plane, p in zip(faces, [*local, third], strict=True)]
    if any(len(outline) < 3 for outline in outlines):
        return None
    return CornerCandidate(
        corner,
        np.stack([plane.normal for plane in faces]),
        side < 0.0,
        (outlines[0], outlines[1], outlines[2]),
        (),
        min(len(p) for p in local),
        sigma_m,
    )
