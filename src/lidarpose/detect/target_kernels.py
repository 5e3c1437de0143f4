"""What is cut out around the target, and which beams meet which of its faces, compiled by numba; imported only where
that pays.

Decisions are those of the NumPy ways, point by point; a sum of three products may differ by its rounding from the one
that a library makes of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel


@kernel
def points_in_box(points: Any, order: Any, middle: Any, half: Any) -> Any:
    """Those (M, 3) of points (N, 3) that lie within `half` (3,) of `middle` (3,), coordinates asked in the order."""
    first, second, third = order[0], order[1], order[2]
    index = np.empty(len(points) + 1, np.uint32)
    found = np.uint64(0)
    for k in range(len(points)):
        index[found] = k
        found += np.uint64(abs(points[k, first] - middle[first]) < half[first])
    kept = np.uint64(0)
    for j in range(found):
        i = np.uint64(index[np.uint64(j)])
        index[kept] = i
        near = abs(points[i, second] - middle[second]) < half[second]
        kept += np.uint64(near and abs(points[i, third] - middle[third]) < half[third])
    inside = np.empty((np.int64(kept), 3), points.dtype)
    for j in range(len(inside)):
        i = np.uint64(index[np.uint64(j)])
        for axis in range(3):
            inside[j, axis] = points[i, axis]
    return inside


@kernel
def faces_met(
    rays: Any,
    range_m: Any,
    gate_m: float,
    normals: Any,
    heights: Any,
    convex: bool,
    inward: Any,
    least: Any,
    starts: Any,
    margins_m: Any,
    obstacles: Any,
    gaps_m: Any,
) -> Any:
    """The face (N,) that each return is of, 0 to 2, or -1.

    Parameters
    ----------
    rays, range_m : (3, N), (N,)
        Unit beam directions and measured ranges.
    gate_m
        How far a range may be from the one expected.
    normals, heights
        The three planes (3, 3), (3,).
    inward, least, starts
        All outlines' edges (E, 3), how far along each a point has to lie (E,), and where each outline's begin (4,).
    margins_m : (3, 3)
        How far a point of one face has to be from the plane of another.
    obstacles, gaps_m
        Planes as normal and offset (B, 4), and how far off them a point of each face has to be (3, B).
    """
    x, y, z = rays[0], rays[1], rays[2]
    found = np.full(len(range_m), -1, np.int8)
    reach = np.empty(3)
    slope = np.empty(3)
    for i in range(len(range_m)):
        facing = 0
        for k in range(3):
            slope[k] = normals[k, 0] * x[i] + normals[k, 1] * y[i] + normals[k, 2] * z[i]
            if slope[k] < -0.02:
                facing += 1
                reach[k] = heights[k] / slope[k]
            else:
                reach[k] = -np.inf if convex else np.inf
        face = 0
        for k in range(1, 3):
            if (reach[k] > reach[face]) if convex else (reach[k] < reach[face]):
                face = k
        expected = reach[face]
        # Whoever leaves one of a convex corner's planes behind never enters the solid.
        if (convex and facing < 3) or not abs(range_m[i] - expected) < gate_m:
            continue
        px, py, pz = x[i] * expected, y[i] * expected, z[i] * expected
        good = True
        for e in range(starts[face], starts[face + 1]):
            if not inward[e, 0] * px + inward[e, 1] * py + inward[e, 2] * pz > least[e]:
                good = False
                break
        if not good:
            continue
        for k in range(3):
            if k != face and not abs(slope[k] * expected - heights[k]) > margins_m[face, k]:
                good = False
        for b in range(len(obstacles)):
            off = obstacles[b, 0] * px + obstacles[b, 1] * py + obstacles[b, 2] * pz - obstacles[b, 3]
            if not off > gaps_m[face, b]:
                good = False
        if good:
            found[i] = face
    return found
