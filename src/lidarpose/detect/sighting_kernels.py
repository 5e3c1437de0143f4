"""The steps of `detect.known_corner` and the heart of `detect.trihedral_corner`, compiled by numba; imported only where
they pay.

Decisions are those of the NumPy ways; sums and products may differ by their rounding.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.detect.patch_kernels import eigen, mean_and_products, pair_across
from lidarpose.detect.target_kernels import faces_met, points_in_box
from lidarpose.geometry.compiled import kernel


@kernel
def over_outlines(points: Any, normals: Any, heights: Any, inward: Any, least: Any, starts: Any, within: float) -> Any:
    """Which points (N, 3) lie near each of three faces and over its outline (3, N), and how high above it (3, N).

    The outlines' edges are those of `trihedral_corner.outline_edges`, all after one another; each begins at its start.
    """
    flags, height = np.zeros((3, len(points)), np.bool_), np.empty((3, len(points)))
    for face in range(3):
        a, b, c, offset = normals[face, 0], normals[face, 1], normals[face, 2], heights[face]
        edges, ends = inward[starts[face] : starts[face + 1]], least[starts[face] : starts[face + 1]]
        for i in range(len(points)):
            up = a * points[i, 0] + b * points[i, 1] + c * points[i, 2] - offset
            height[face, i] = up
            if not abs(up) < within:
                continue
            x, y, z = points[i, 0] - up * a, points[i, 1] - up * b, points[i, 2] - up * c
            inside = True
            for e in range(len(ends)):
                if not edges[e, 0] * x + edges[e, 1] * y + edges[e, 2] * z > ends[e]:
                    inside = False
                    break
            flags[face, i] = inside
    return flags, height


@kernel
def _mode(values: Any, width: float) -> Any:
    """`known_corner._mode`."""
    ordered = np.sort(values)
    best = first = end = 0
    for k in range(len(ordered)):
        while end < len(ordered) and ordered[end] <= ordered[k] + width:
            end += 1
        if end - k > best:
            best, first = end - k, k
    total = 0.0
    for k in range(first, first + best):
        total += ordered[k]
    return total / best


@kernel
def _fitted(points: Any, chosen: Any, plane: Any, gate: float, steps: int, fewest: int) -> Any:
    """Fit a plane, normal and offset (4,), to those of the chosen points that are near it, in place; whether it is
    one."""
    near = np.empty((len(chosen), 3))
    for _ in range(steps):
        count = 0
        for i in chosen:
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if abs(plane[0] * x + plane[1] * y + plane[2] * z - plane[3]) < gate:
                near[count, 0], near[count, 1], near[count, 2] = x, y, z
                count += 1
        if count < fewest:
            return False
        mean, products = mean_and_products(near[:count], count - 1.0)
        values, axes = eigen(products)
        if values[1] < 4.0 * values[0]:
            return False
        along = axes[0, 0] * plane[0] + axes[1, 0] * plane[1] + axes[2, 0] * plane[2]
        offset = 0.0
        for axis in range(3):
            plane[axis] = axes[axis, 0] if along > 0.0 else -axes[axis, 0]
            offset += plane[axis] * mean[axis]
        plane[3] = offset
    return True


@kernel
def planes_near(
    points: Any,
    normals: Any,
    corner: Any,
    inward: Any,
    least: Any,
    starts: Any,
    within: float,
    sigma: float,
    gate: float,
    steps: int,
    fewest: int,
) -> Any:
    """Planes (K, 4) as normal and offset of the three faces near where they should be; fewer if one is not there."""
    planes, heights = np.empty((3, 4)), np.empty(3)
    for face in range(3):
        heights[face] = normals[face, 0] * corner[0] + normals[face, 1] * corner[1] + normals[face, 2] * corner[2]
    flags, height = over_outlines(points, normals, heights, inward, least, starts, within)
    for face in range(3):
        chosen = np.flatnonzero(flags[face])
        if len(chosen) < fewest:
            return planes[:face]
        for i in range(3):
            planes[face, i] = normals[face, i]
        planes[face, 3] = heights[face] + _mode(height[face][chosen], 4.0 * sigma)
        if not _fitted(points, chosen, planes[face], gate, steps, fewest):
            return planes[:face]
    return planes


@kernel
def shared_out(points: Any, planes: Any, eligible: Any, gate: float) -> Any:
    """Which of the planes (K, 4) each point (N, 3) is nearest to, -1 for none, and their points' root mean square
    distance (K,). On the first ones only eligible points (E, N) count."""
    owner = np.empty(len(points), np.int8)
    count, squares = np.zeros(len(planes), np.int64), np.zeros(len(planes))
    for i in range(len(points)):
        best, nearest = np.inf, 0
        for k in range(len(planes)):
            if k < len(eligible) and not eligible[k, i]:
                continue
            off = abs(
                planes[k, 0] * points[i, 0] + planes[k, 1] * points[i, 1] + planes[k, 2] * points[i, 2] - planes[k, 3]
            )
            if off < best:
                best, nearest = off, k
        owner[i] = -1
        if best < gate:
            owner[i] = nearest
            count[nearest] += 1
            squares[nearest] += best * best
    for k in range(len(planes)):
        squares[k] = np.sqrt(squares[k] / count[k]) if count[k] > 0 else np.nan
    return owner, squares


@kernel
def _quantile(values: Any, share: float) -> Any:
    """`geometry.robust.quantile`."""
    ordered = np.sort(values)
    at = share * (len(ordered) - 1)
    k = int(at)
    low, high, part = ordered[k], ordered[min(k + 1, len(ordered) - 1)], at - k
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part)


@kernel
def _common_side(height: Any, face: Any, near: Any, tolerance: Any, one_sided: float, fewest: int) -> int:
    """`trihedral_corner._common_side`: 1 convex, 0 concave, -1 neither; of the points that are near, where enough are.

    `height` (3, N) above each of the planes, `face` (N,) of each point, -1 for none.
    """
    found = -2
    for i in range(3):
        count = together = 0
        for n in range(len(face)):
            together += face[n] == i
            count += (face[n] == i) & near[n]
        everyone = count < fewest
        count = together if everyone else count
        for j in range(3):
            if i == j:
                continue
            below = above = 0
            for n in range(len(face)):
                if face[n] == i and (everyone or near[n]):
                    below += height[j, n] < tolerance[i, j]
                    above += height[j, n] > -tolerance[i, j]
            side = 1 if below / count >= one_sided else 0 if above / count >= one_sided else -1
            if side < 0 or (found >= 0 and side != found):
                return -1
            found = side
    return found


@kernel
def faces_of_corner(
    points: Any,
    starts: Any,
    corner: Any,
    planes: Any,
    tolerance: Any,
    reach: float,
    missing: float,
    fewest: int,
    one_sided: float,
) -> Any:
    """How the three faces of a corner meet: 1 convex, 0 concave, -1 not at all; and which of their points are kept.

    `points` (N, 3) of one face after the other, each from its start; `planes` (3, 4); `tolerance` (3, 3) m.
    """
    n = len(points)
    keep, face = np.zeros(n, np.bool_), np.full(n, -1, np.int8)
    distance, height = np.empty(n), np.empty((3, n))
    nearest = np.inf
    for k in range(3):
        closest, count = np.inf, 0
        for i in range(starts[k], starts[k + 1]):
            x, y, z = points[i, 0] - corner[0], points[i, 1] - corner[1], points[i, 2] - corner[2]
            distance[i] = np.sqrt(x * x + y * y + z * z)
            closest = min(closest, distance[i])
            if distance[i] < reach:
                face[i] = k
                count += 1
        if count < fewest or closest > missing:
            return -1, keep
        mine = face[starts[k] : starts[k + 1]] == k
        nearest = min(nearest, _quantile(distance[starts[k] : starts[k + 1]][mine], 0.98))
    for i in range(n):
        for k in range(3):
            height[k, i] = (
                planes[k, 0] * points[i, 0] + planes[k, 1] * points[i, 1] + planes[k, 2] * points[i, 2] - planes[k, 3]
            )
    side = _common_side(height, face, distance <= 0.7 * nearest, tolerance, one_sided, fewest)
    if side < 0:
        narrowest = _narrowest(points, face, corner, planes)
        side = _common_side(height, face, distance <= 0.7 * narrowest, tolerance, one_sided, fewest)
    if side < 0:
        return -1, keep
    for i in range(n):
        k = face[i]
        if k < 0 or distance[i] > 1.3 * nearest:
            continue
        good = True
        for j in range(3):
            if j != k and not (height[j, i] < tolerance[k, j] if side == 1 else height[j, i] > -tolerance[k, j]):
                good = False
        keep[i] = good
    return side, keep


@kernel
def _narrowest(points: Any, face: Any, corner: Any, planes: Any) -> Any:
    """`trihedral_corner._narrowest_m`."""
    found = np.inf
    for first in range(2):
        for second in range(first + 1, 3):
            a, b = planes[first], planes[second]
            x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
            length = np.sqrt(x * x + y * y + z * z)
            for k in (first, second):
                mine = np.flatnonzero(face == k)
                along = np.empty(len(mine))
                for j in range(len(mine)):
                    i = mine[j]
                    p, q, r = points[i, 0] - corner[0], points[i, 1] - corner[1], points[i, 2] - corner[2]
                    along[j] = abs(p * x + q * y + r * z) / length
                found = min(found, _quantile(along, 0.98))
    return found


@kernel
def farthest(points: Any, directions: Any) -> Any:
    """The point (D,) of points (N, 3) that is farthest out in each direction (D, 3)."""
    found = np.zeros(len(directions), np.int64)
    for d in range(len(directions)):
        a, b, c = directions[d, 0], directions[d, 1], directions[d, 2]
        best = -np.inf
        for i in range(len(points)):
            out = a * points[i, 0] + b * points[i, 1] + c * points[i, 2]
            if out > best:
                best = out
                found[d] = i
    return found


@kernel
def _outline(points: Any, plane: Any, around: Any) -> Any:
    """`trihedral_corner.convex_outline` of points (N, 3) on a plane (4,), from the directions around it (D, 2)."""
    pair = pair_across(plane)
    directions = np.empty((len(around), 3))
    for d in range(len(around)):
        for axis in range(3):
            directions[d, axis] = around[d, 0] * pair[0, axis] + around[d, 1] * pair[1, axis]
    far = farthest(points, directions)
    outline = np.empty((len(around), 3))
    count = 0
    for d in range(len(around)):
        if far[d] == far[d - 1]:
            continue
        i = far[d]
        height = plane[0] * points[i, 0] + plane[1] * points[i, 1] + plane[2] * points[i, 2] - plane[3]
        for axis in range(3):
            outline[count, axis] = points[i, axis] - height * plane[axis]
        count += 1
    return outline[:count]


@kernel
def _sine(a: Any, b: Any) -> float:
    """Of the angle between two unit vectors."""
    x, y, z = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    return float(np.sqrt(x * x + y * y + z * z))


@kernel
def in_view(
    points: Any,
    corner: Any,
    planes: Any,
    convex: bool,
    outlines: Any,
    inward: Any,
    least: Any,
    starts: Any,
    obstacles: Any,
    cone_m: float,
    margin_m: float,
    gate_m: float,
) -> Any:
    """How many beams to points (N, 3) are towards each face of a corner (3,), and how many of these end on it (3,).

    `outlines` (V, 3) of all faces say how far a beam may be from the corner; the rest is as in `faces_met`.
    """
    distance = np.sqrt(corner[0] ** 2 + corner[1] ** 2 + corner[2] ** 2)
    a, b, c = corner[0] / distance, corner[1] / distance, corner[2] / distance
    cosine = 1.0
    for v in range(len(outlines)):
        x, y, z = outlines[v, 0], outlines[v, 1], outlines[v, 2]
        cosine = min(cosine, (a * x + b * y + c * z) / np.sqrt(x * x + y * y + z * z))
    cosine = np.cos(min(np.arccos(cosine) + cone_m / distance, np.pi))
    rays, range_m = np.empty((3, len(points))), np.empty(len(points))
    count = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        length = np.sqrt(x * x + y * y + z * z)
        if a * x + b * y + c * z > cosine * length:
            rays[0, count], rays[1, count], rays[2, count] = x / length, y / length, z / length
            range_m[count] = length
            count += 1
    normals, heights = np.empty((3, 3)), np.empty(3)
    margins, gaps = np.empty((3, 3)), np.empty((3, len(obstacles)))
    for j in range(3):
        heights[j] = planes[j, 0] * corner[0] + planes[j, 1] * corner[1] + planes[j, 2] * corner[2]
        for k in range(3):
            normals[j, k] = planes[j, k]
            margins[j, k] = margin_m * _sine(planes[j], planes[k])
        for k in range(len(obstacles)):
            gaps[j, k] = max(_sine(planes[j], obstacles[k]), 0.2) * (2.0 * margin_m + 0.01)
    wanted, there = np.zeros(3, np.int64), np.zeros(3, np.int64)
    some = rays[:, :count].copy()
    towards = faces_met(
        some, range_m[:count], np.inf, normals, heights, convex, inward, least, starts, margins, obstacles, gaps
    )
    for i in range(count):
        k = towards[i]
        if k >= 0:
            slope = normals[k, 0] * some[0, i] + normals[k, 1] * some[1, i] + normals[k, 2] * some[2, i]
            wanted[k] += 1
            there[k] += abs(range_m[i] - heights[k] / slope) < gate_m
    return wanted, there


@kernel
def _borders(members: Any, kept: Any, low: Any, high: Any, plane: Any, spread: float) -> bool:
    """Whether a surface with points (M, 3) on a plane (4,) borders a target with points (N, 3) within a box; see
    `trihedral_corner._obstacles`."""
    near = 0
    for i in range(len(members)):
        inside = True
        for axis in range(3):
            middle, half = 0.5 * (low[axis] + high[axis]), 0.5 * (high[axis] - low[axis])
            inside = inside and abs(members[i, axis] - middle) < half
        near += inside
    if near < 20:
        return False
    free, least = 0, np.inf
    for i in range(len(kept)):
        height = plane[0] * kept[i, 0] + plane[1] * kept[i, 1] + plane[2] * kept[i, 2] - plane[3]
        free += height > -3.0 * spread
        least = min(least, height)
    return bool(free / len(kept) > 0.97 and least < 0.2)


@kernel
def _in_box_of(points: Any, outlines: Any, shift: Any, margin_m: float) -> Any:
    """Those (M, 3) of points (N, 3) in the box about outlines (V, 3) that are shifted."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for v in range(len(outlines)):
        for axis in range(3):
            low[axis] = min(low[axis], outlines[v, axis] + shift[axis])
            high[axis] = max(high[axis], outlines[v, axis] + shift[axis])
    middle, half = np.empty(3), np.empty(3)
    for axis in range(3):
        middle[axis] = 0.5 * ((low[axis] - margin_m) + (high[axis] + margin_m))
        half[axis] = 0.5 * ((high[axis] + margin_m) - (low[axis] - margin_m))
    return points_in_box(points.reshape(-1), 3, len(points), middle, half)


@kernel
def faces_seen(
    points: Any,
    own: Any,
    planes: Any,
    normals: Any,
    outlines: Any,
    inward: Any,
    least: Any,
    starts: Any,
    lengths: Any,
    fewest: Any,
    one_sided: float,
    around: Any,
) -> Any:
    """What `known_corner._sighting` does up to the view: all that a place's points show of a target.

    Parameters
    ----------
    points, own : (N, 3), (3,)
        What lies about the target, and its corner.
    planes : (3 + S, 4)
        The three faces as fitted here, and what stands still.
    normals, outlines, inward, least, starts
        The reference's: normals (3, 3), outlines (V, 3), and their edges, were its corner the origin.
    lengths
        In metres: about the outlines, about their borders, how far a face reaches, how far it may end from the corner;
        and the gate.
    fewest
        Points: of a patch, of a face next to the corner.

    Returns
    -------
    1 for convex, 0 for concave, -1 where it is no corner; by face: outlines (3, D, 3), their lengths, points; by plane:
    root mean square distances, whether it borders the target.
    """
    count, size, borders = np.zeros(3, np.int64), np.zeros(3, np.int64), np.zeros(len(planes), np.bool_)
    shown, heights, all_least = np.empty((3, len(around), 3)), np.empty(3), np.empty(len(least))
    local = _in_box_of(points, outlines, own, lengths[0])
    for face in range(3):
        heights[face] = normals[face, 0] * own[0] + normals[face, 1] * own[1] + normals[face, 2] * own[2]
    for e in range(len(least)):
        all_least[e] = least[e] + (inward[e, 0] * own[0] + inward[e, 1] * own[1] + inward[e, 2] * own[2]) - lengths[1]
    over, _ = over_outlines(local, normals, heights, inward, all_least, starts, lengths[1])
    owner, spread = shared_out(local, planes, over, lengths[4])
    members = [local[owner == k] for k in range(len(planes))]
    begin = np.zeros(4, np.int64)
    for k in range(3):
        begin[k + 1] = begin[k] + len(members[k])
        if len(members[k]) < fewest[0]:
            return -1, shown, size, count, spread, borders
    tolerance, faces = np.empty((3, 3)), np.empty((begin[3], 3))
    for j in range(3):
        faces[begin[j] : begin[j + 1]] = members[j]
        for k in range(3):
            tolerance[j, k] = 3.0 * max(spread[j], spread[k])
    side, keep = faces_of_corner(faces, begin, own, planes[:3], tolerance, lengths[2], lengths[3], fewest[1], one_sided)
    if side < 0:
        return -1, shown, size, count, spread, borders
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    kept = faces[keep]
    for i in range(len(kept)):
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], kept[i, axis] - 0.1), max(high[axis], kept[i, axis] + 0.1)
    for k in range(3):
        mine = faces[begin[k] : begin[k + 1]][keep[begin[k] : begin[k + 1]]]
        count[k] = len(mine)
        if count[k] < fewest[1]:
            return -1, shown, size, count, spread, borders
        outline = _outline(mine, planes[k], around)
        size[k] = len(outline)
        shown[k, : len(outline)] = outline
    for k in range(3, len(planes)):
        if len(members[k]) >= fewest[0]:
            borders[k] = _borders(members[k], kept, low, high, planes[k], spread[k])
    return side, shown, size, count, spread, borders
