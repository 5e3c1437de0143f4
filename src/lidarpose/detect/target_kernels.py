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
_POINTS = 256
# Beams that are asked together.
_BEAMS = 512


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
    room = 4 * _POINTS
    inside = np.empty(3 * room, flat.dtype)
    block = np.empty(3 * _POINTS, flat.dtype)
    flags, index = np.empty(_POINTS, np.int32), np.empty(_POINTS + 1, np.uint32)
    kept = 0
    for first in range(0, count, _POINTS):
        few = min(_POINTS, count - first)
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
def points_within(points: Any, centre: Any, radius: float) -> Any:
    """Those (M, 3) of points (N, 3) that lie within a radius of a centre (3,), in double precision."""
    index = np.empty(len(points) + 1, np.uint32)
    kept = np.uint64(0)
    for i in range(len(points)):
        x, y, z = points[i, 0] - centre[0], points[i, 1] - centre[1], points[i, 2] - centre[2]
        index[kept] = i
        kept += np.uint64(x * x + y * y + z * z < radius * radius)
    inside = np.empty((np.int64(kept), 3))
    for j in range(len(inside)):
        for axis in range(3):
            inside[j, axis] = points[index[j], axis]
    return inside


@kernel
def mark_cells(flat: Any, low: Any, scale: Any, reach: Any, strides: Any, bit: Any, taken: Any) -> Any:
    """Set a bit in `taken` for each cell that holds any point; the cell (N,) of each, -1 beyond reach.

    `flat` (3 N,) holds x, y, z of points one after the other; see `moved_points`.
    """
    cells = np.empty(len(flat) // 3, np.int32)
    a, b, c = low[0], low[1], low[2]
    p, q, r = np.int32(strides[0]), np.int32(strides[1]), np.int32(strides[2])
    for k in range(len(cells)):
        i = np.uint64(3) * np.uint64(k)
        x, y, z = np.float32(flat[i]), np.float32(flat[i + np.uint64(1)]), np.float32(flat[i + np.uint64(2)])
        cell = np.int32((x - a) * scale) * p + np.int32((y - b) * scale) * q + np.int32((z - c) * scale) * r
        cells[k] = cell if (abs(x) < reach) & (abs(y) < reach) & (abs(z) < reach) else np.int32(-1)
    for k in range(len(cells)):
        if cells[k] >= 0:
            taken[np.uint32(cells[k])] |= bit
    return cells


@kernel
def left_alone(
    flat: Any,
    cells: Any,
    low: Any,
    scale: Any,
    strides: Any,
    others: Any,
    taken: Any,
    slack: Any,
    fewest: int,
) -> Any:
    """Those (M,) of points in and nearly in whose cells no others are, in cells that hold enough such points.

    `flat` and `cells` as `mark_cells` has them.
    """
    alone = np.empty(len(cells) + 1, np.uint32)
    first = np.uint64(0)
    for k in range(len(cells)):
        alone[first] = k
        first += np.uint64((cells[k] >= 0) & ((taken[np.uint32(max(cells[k], 0))] & others) == 0))
    left = 0
    ends = np.empty((3, 2), np.int64)
    for j in range(np.int64(first)):
        i = np.int64(alone[j])
        # From the cell that holds a point moved back to the one that holds it moved on, along all axes.
        for axis in range(3):
            at = (np.float32(flat[3 * i + axis]) - low[axis]) * scale
            ends[axis, 0], ends[axis, 1] = np.int32(at - slack), np.int32(at + slack)
        met = np.uint8(0)
        for n in range(8):
            met |= taken[ends[0, n & 1] * strides[0] + ends[1, n >> 1 & 1] * strides[1] + ends[2, n >> 2] * strides[2]]
        if met & others:
            continue
        alone[left] = i
        left += 1
    ordered = np.empty(left, np.int32)
    for j in range(left):
        ordered[j] = cells[alone[j]]
    ordered.sort()
    kept = 0
    for j in range(left):
        last = np.searchsorted(ordered, cells[alone[j]]) + fewest - 1
        if last < left and ordered[last] == cells[alone[j]]:
            alone[kept] = alone[j]
            kept += 1
    return alone[:kept].astype(np.int64)


@kernel
def first_met(
    x: Any, y: Any, z: Any, normals: Any, heights: Any, convex: bool, size: int, face: Any, reach: Any
) -> None:
    """The face that each of `size` beams meets first of a convex corner's planes, last of a concave one's, and where;
    inf where it meets none."""
    sign = 1.0 if convex else -1.0
    h0, h1, h2 = sign * heights[0], sign * heights[1], sign * heights[2]
    a0, a1, a2 = normals[0, 0], normals[0, 1], normals[0, 2]
    b0, b1, b2 = normals[1, 0], normals[1, 1], normals[1, 2]
    c0, c1, c2 = normals[2, 0], normals[2, 1], normals[2, 2]
    for i in range(size):
        u = a0 * x[i] + a1 * y[i] + a2 * z[i]
        v = b0 * x[i] + b1 * y[i] + b2 * z[i]
        w = c0 * x[i] + c1 * y[i] + c2 * z[i]
        best = h0 / u if u < -0.02 else -np.inf
        second = h1 / v if v < -0.02 else -np.inf
        third = h2 / w if w < -0.02 else -np.inf
        met = 1 if second > best else 0
        best = second if second > best else best
        met = 2 if third > best else met
        best = third if third > best else best
        # Whoever leaves one of a convex corner's planes behind never enters the solid.
        away = max(max(u, v), w) >= -0.02
        reach[i] = np.inf if convex and away else sign * best
        face[i] = met


@kernel
def far_inside(points: Any, inward: Any, least: Any, begin: int, end: int) -> Any:
    """By how much (N,) points (3, N) lie inside the nearest of some edges: below 0 outside."""
    x, y, z = points[0], points[1], points[2]
    inside = np.full(len(x), np.inf)
    for e in range(begin, end):
        a, b, c, start = inward[e, 0], inward[e, 1], inward[e, 2], least[e]
        for i in range(len(x)):
            along = a * x[i] + b * y[i] + c * z[i] - start
            inside[i] = along if along < inside[i] else inside[i]
    return inside


@kernel
def _off_others(
    beams: Any,
    first: Any,
    reach: Any,
    size: int,
    gate_m: float,
    normals: Any,
    heights: Any,
    margins_m: Any,
    obstacles: Any,
    gaps_m: Any,
    good: Any,
) -> None:
    """Which of `size` beams, rays and ranges (4, N), end where they meet their face, off the other faces' planes and
    what borders them; without branches, for vector instructions."""
    x, y, z, far = beams[0], beams[1], beams[2], beams[3]
    for k in range(size):
        good[k] = np.int64(abs(far[k] - reach[k]) < gate_m)
    for other in range(3):
        a, b, c, height = normals[other, 0], normals[other, 1], normals[other, 2], heights[other]
        # Of a face's own plane nothing is asked.
        p = margins_m[0, other] if other != 0 else -np.inf
        q = margins_m[1, other] if other != 1 else -np.inf
        r = margins_m[2, other] if other != 2 else -np.inf
        for k in range(size):
            slope = a * x[k] + b * y[k] + c * z[k]
            least = r if first[k] == 2 else (q if first[k] == 1 else p)
            good[k] &= np.int64(abs(slope * reach[k] - height) > least)
    for n in range(len(obstacles)):
        a, b, c, offset = obstacles[n, 0], obstacles[n, 1], obstacles[n, 2], obstacles[n, 3]
        p, q, r = gaps_m[0, n], gaps_m[1, n], gaps_m[2, n]
        for k in range(size):
            off = a * (x[k] * reach[k]) + b * (y[k] * reach[k]) + c * (z[k] * reach[k]) - offset
            least = r if first[k] == 2 else (q if first[k] == 1 else p)
            good[k] &= np.int64(off > least)


@kernel
def _met_by_face(
    beams: Any,
    size: int,
    gate_m: float,
    normals: Any,
    heights: Any,
    convex: bool,
    margins_m: Any,
    obstacles: Any,
    gaps_m: Any,
    first: Any,
    reach: Any,
    good: Any,
    point: Any,
    who: Any,
    many: Any,
) -> None:
    """Of `size` beams, rays and ranges (4, N), those that end on a face's plane, off the others and what borders them,
    by face: where they meet it (3, 3, N), which they are (3, N), and how many (3,).

    `first`, `reach` and `good` (N,) are room for what is asked of each beam on the way.
    """
    first_met(beams[0], beams[1], beams[2], normals, heights, convex, size, first, reach)
    _off_others(beams, first, reach, size, gate_m, normals, heights, margins_m, obstacles, gaps_m, good)
    many[:] = 0
    for k in range(size):
        if good[k]:
            face, expected = first[k], reach[k]
            at = many[face]
            for row in range(3):
                point[face, row, at] = beams[row, k] * expected
            who[face, at] = k
            many[face] += 1


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
    found = np.full(len(range_m), -1, np.int8)
    # Everything is asked of many beams at a time, which vector instructions do together.
    beams = np.empty((4, _BEAMS))
    first, reach, good = np.empty(_BEAMS, np.int64), np.empty(_BEAMS), np.empty(_BEAMS, np.int64)
    point, who, many = np.empty((3, 3, _BEAMS)), np.empty((3, _BEAMS), np.int64), np.empty(3, np.int64)
    planes, near = (normals, heights, convex), (margins_m, obstacles, gaps_m)
    for begin in range(0, len(range_m), _BEAMS):
        size = min(_BEAMS, len(range_m) - begin)
        for k in range(size):
            beams[0, k], beams[1, k], beams[2, k] = rays[0, begin + k], rays[1, begin + k], rays[2, begin + k]
            beams[3, k] = range_m[begin + k]
        _met_by_face(beams, size, gate_m, *planes, *near, first, reach, good, point, who, many)
        for face in range(3):
            inside = far_inside(point[face, :, : many[face]], inward, least, starts[face], starts[face + 1])
            for at in range(many[face]):
                if inside[at] > 0.0:
                    found[begin + who[face, at]] = face
    return found


@kernel
def outside(rays: Any, normal: Any, height: float, inward: Any, least: Any) -> Any:
    """Which rays (3, N) to a plane meet it outside of an outline's edges, or on them."""
    x, y, z = rays[0], rays[1], rays[2]
    a, b, c = normal[0], normal[1], normal[2]
    points = np.empty((3, len(x)))
    for i in range(len(x)):
        reach = height / (a * x[i] + b * y[i] + c * z[i])
        points[0, i], points[1, i], points[2, i] = x[i] * reach, y[i] * reach, z[i] * reach
    return far_inside(points, inward, least, 0, len(least)) <= 0.0


@kernel
def one_after_other(of_face: Any, which: Any, on_rim: Any, total: Any) -> Any:
    """What has been found face by face, the first `total` (3,) of each, as `beams_of_faces` has it."""
    count = total.sum()
    index, ranges, outside_of = np.empty(count, np.int64), np.empty(count), np.empty(count, np.bool_)
    rays, start = np.empty(3 * count), 0
    for face in range(3):
        size = total[face]
        for row in range(3):
            rays[3 * start + row * size : 3 * start + (row + 1) * size] = of_face[face, row, :size]
        ranges[start : start + size] = of_face[face, 3, :size]
        index[start : start + size] = which[face, :size]
        outside_of[start : start + size] = on_rim[face, :size]
        start += size
    return index, rays, ranges, outside_of


@kernel
def beams_of_faces(
    points: Any,
    gate_m: float,
    normals: Any,
    heights: Any,
    convex: bool,
    inward: Any,
    least: Any,
    rim_m: float,
    starts: Any,
    margins_m: Any,
    obstacles: Any,
    gaps_m: Any,
) -> Any:
    """Of points (N, 3), those that are of each face, one face after the other; parameters as those of `faces_met`, but
    for `least`, which is the outlines' own, and `rim_m`, by how much faces are wider.

    Returns
    -------
    Which points (M,), how many of each face (3,), their rays (3 M,), three rows for each face, their ranges (M,), and
    which (M,) lie outside the outlines.
    """
    beams = np.empty((4, _BEAMS))
    first, reach, good = np.empty(_BEAMS, np.int64), np.empty(_BEAMS), np.empty(_BEAMS, np.int64)
    point, who, many = np.empty((3, 3, _BEAMS)), np.empty((3, _BEAMS), np.int64), np.empty(3, np.int64)
    planes, near = (normals, heights, convex), (margins_m, obstacles, gaps_m)
    of_face, which = np.empty((3, 4, len(points))), np.empty((3, len(points)), np.int64)
    on_rim, total = np.empty((3, len(points)), np.bool_), np.zeros(3, np.int64)
    for begin in range(0, len(points), _BEAMS):
        size = min(_BEAMS, len(points) - begin)
        for k in range(size):
            x, y, z = points[begin + k, 0], points[begin + k, 1], points[begin + k, 2]
            far = np.sqrt(x * x + y * y + z * z)
            beams[0, k], beams[1, k], beams[2, k], beams[3, k] = x / far, y / far, z / far, far
        _met_by_face(beams, size, gate_m, *planes, *near, first, reach, good, point, who, many)
        for face in range(3):
            inside = far_inside(point[face, :, : many[face]], inward, least, starts[face], starts[face + 1])
            last = total[face]
            for at in range(many[face]):
                k = who[face, at]
                for row in range(4):
                    of_face[face, row, last] = beams[row, k]
                which[face, last], on_rim[face, last] = begin + k, not inside[at] > 0.0
                last += inside[at] > -rim_m
            total[face] = last
    index, rays, ranges, outside_of = one_after_other(of_face, which, on_rim, total)
    return index, total, rays, ranges, outside_of
