"""What is cut out around the target, and which beams meet which of its faces, compiled by numba; imported only where
that pays.

Decisions are those of the NumPy ways, point by point; a sum of three products may differ by its rounding from the one
that a library makes of it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel

# Points are asked so many at a time: most hold none that is wanted.
_BLOCK = 256


@kernel
def _flagged(flat: Any, start: int, count: int, middle: Any, half: Any, flags: Any) -> Any:
    """Flag those of the first `count` points, x, y, z after one another from a start, that are in a box; how many."""
    a, b, c = middle[0], middle[1], middle[2]
    p, q, r = half[0], half[1], half[2]
    # Flags as wide as coordinates, and places without a sign: that goes in vector instructions.
    found = np.int32(0)
    for k in range(count):
        i = np.uint64(start) + np.uint64(3) * np.uint64(k)
        x, y, z = flat[i] - a, flat[i + np.uint64(1)] - b, flat[i + np.uint64(2)] - c
        flags[k] = np.int32((abs(x) < p) & (abs(y) < q) & (abs(z) < r))
        found += flags[k]
    return found


@kernel
def points_in_box(flat: Any, step: int, count: int, middle: Any, half: Any) -> Any:
    """Those (M, 3) of `count` points that lie within `half` (3,) of `middle` (3,).

    The points stand in `flat`, so many numbers apart, three and more, x, y and z of each side by side.
    """
    room = 4 * _BLOCK
    inside = np.empty(3 * room, flat.dtype)
    block = np.empty(3 * _BLOCK, flat.dtype)
    flags, index = np.empty(_BLOCK, np.int32), np.empty(_BLOCK + 1, np.uint32)
    kept = 0
    for first in range(0, count, _BLOCK):
        few = min(_BLOCK, count - first)
        some, start = flat, 3 * first
        if step != 3:
            for k in range(few):
                for axis in range(3):
                    block[3 * k + axis] = flat[(first + k) * step + axis]
            some, start = block, 0
        found = _flagged(some, start, few, middle, half, flags)
        if found == 0:
            continue
        if kept + found > room:
            room *= 2
            more = np.empty(3 * room, flat.dtype)
            for j in range(3 * kept):
                more[j] = inside[j]
            inside = more
        last = np.uint64(0)
        for k in range(few):
            index[last] = k
            last += np.uint64(flags[k])
        for j in range(found):
            i, o = np.uint64(start) + np.uint64(3) * np.uint64(index[j]), np.uint64(3 * (kept + j))
            for axis in range(3):
                inside[o + np.uint64(axis)] = some[i + np.uint64(axis)]
        kept += found
    return inside[: 3 * kept].copy().reshape((kept, 3))


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
