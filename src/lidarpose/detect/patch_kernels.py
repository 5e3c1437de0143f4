"""The small steps of `detect.cloud_planes` over a subsample, compiled by numba; imported only where they pay.

Each is the NumPy way's; sums are taken in double precision in place of single. Small arrays are filled by loops, which
compile in a fraction of the time that assignments of slices and functions of NumPy take.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel, summing_kernel

# Points are looked through in so many groups, each of every so manieth.
_GROUPS = 64


@kernel
def _columns(points: Any) -> Any:
    """Points (N, 3) as x, y and z, filled up with infinity to a multiple of the groups."""
    n = -(-len(points) // _GROUPS) * _GROUPS
    x, y, z = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    for i in range(len(points)):
        x[i], y[i], z[i] = points[i, 0], points[i, 1], points[i, 2]
    for i in range(len(points), n):
        x[i] = y[i] = z[i] = np.inf
    return x, y, z


@kernel
def _squares(x: Any, y: Any, z: Any, a: Any, b: Any, c: Any, squares: Any, least: Any) -> None:
    """Squared distances of points from (a, b, c), and the least in each group."""
    for group in range(_GROUPS):
        least[group] = np.inf
    for first in range(0, len(x), _GROUPS):
        for group in range(_GROUPS):
            i = np.uint64(first) + np.uint64(group)
            p, q, r = x[i] - a, y[i] - b, z[i] - c
            square = p * p + q * q + r * r
            squares[i] = square
            least[group] = square if square < least[group] else least[group]


@kernel
def _insert(value: Any, which: int, kept: Any, numbers: Any, filled: int) -> int:
    """Insert a value into those kept in ascending order, of which the last may drop out; how many there are."""
    if filled == len(kept):
        if not value < kept[filled - 1]:
            return filled
        filled -= 1
    j = filled
    while j > 0 and kept[j - 1] > value:
        kept[j], numbers[j] = kept[j - 1], numbers[j - 1]
        j -= 1
    kept[j], numbers[j] = value, which
    return filled + 1


@kernel
def nearest(points: Any, seeds: Any, count: int) -> Any:
    """Positions (H, count) of the points (N, 3) nearest to others (H, 3), the nearest first.

    The nearest of so many groups bound how far off those wanted are, so that most groups need no second look. That
    takes half the time of a tree's building and its queries.
    """
    x, y, z = _columns(points)
    squares, least = np.empty(len(x), np.float32), np.empty(_GROUPS, np.float32)
    found, unused = np.empty((len(seeds), count), np.int64), np.empty(count, np.int64)
    kept = np.empty(count, np.float32)
    for s in range(len(seeds)):
        _squares(x, y, z, seeds[s, 0], seeds[s, 1], seeds[s, 2], squares, least)
        filled = 0
        for group in range(_GROUPS):
            filled = _insert(least[group], group, kept, unused, filled)
        bound = kept[count - 1] if filled == count else np.float32(np.inf)
        filled = 0
        for group in range(_GROUPS):
            if least[group] > bound:
                continue
            for i in range(group, len(points), _GROUPS):
                if squares[i] <= bound:
                    filled = _insert(squares[i], i, kept, found[s], filled)
    return found


@kernel
def eigen(matrix: Any) -> Any:
    """Eigenvalues (3,), ascending, of a symmetric matrix (3, 3), and their vectors in columns: Jacobi's rotations."""
    a, v = np.empty((3, 3)), np.zeros((3, 3))
    for p in range(3):
        v[p, p] = 1.0
        for q in range(3):
            a[p, q] = matrix[p, q]
    for _ in range(30):
        off = a[0, 1] ** 2 + a[0, 2] ** 2 + a[1, 2] ** 2
        if not off > 1e-36 * (a[0, 0] ** 2 + a[1, 1] ** 2 + a[2, 2] ** 2):
            break
        for p in range(2):
            for q in range(p + 1, 3):
                if a[p, q] == 0.0:
                    continue
                theta = 0.5 * (a[q, q] - a[p, p]) / a[p, q]
                t = 1.0 / (abs(theta) + np.sqrt(theta * theta + 1.0))
                t = t if theta >= 0.0 else -t
                c = 1.0 / np.sqrt(t * t + 1.0)
                s = t * c
                for k in range(3):
                    a[k, p], a[k, q] = c * a[k, p] - s * a[k, q], s * a[k, p] + c * a[k, q]
                for k in range(3):
                    a[p, k], a[q, k] = c * a[p, k] - s * a[q, k], s * a[p, k] + c * a[q, k]
                    v[k, p], v[k, q] = c * v[k, p] - s * v[k, q], s * v[k, p] + c * v[k, q]
    for p, q in ((0, 1), (1, 2), (0, 1)):
        if a[q, q] < a[p, p]:
            a[p, p], a[q, q] = a[q, q], a[p, p]
            for k in range(3):
                v[k, p], v[k, q] = v[k, q], v[k, p]
    values = np.empty(3)
    for k in range(3):
        values[k] = a[k, k]
    return values, v


@kernel
def mean_and_products(points: Any, count: float = 1.0) -> Any:
    """Mean (3,) of points (N, 3), and the sums of their products around it over a count (3, 3)."""
    mean, second = np.zeros(3), np.zeros((3, 3))
    n = len(points)
    for j in range(n):
        for i in range(3):
            mean[i] += points[j, i]
    for i in range(3):
        mean[i] /= n
    for j in range(n):
        p, q, r = points[j, 0] - mean[0], points[j, 1] - mean[1], points[j, 2] - mean[2]
        second[0, 0] += p * p
        second[0, 1] += p * q
        second[0, 2] += p * r
        second[1, 1] += q * q
        second[1, 2] += q * r
        second[2, 2] += r * r
    for i in range(3):
        for j in range(i, 3):
            second[i, j] /= count
            second[j, i] = second[i, j]
    return mean, second


@kernel
def local_planes(chosen: Any) -> Any:
    """Planes (H, 4) through neighbourhoods (H, K, 3), and the variances (H, 3) of their points, ascending."""
    hypotheses = chosen.shape[0]
    planes, variances = np.empty((hypotheses, 4)), np.empty((hypotheses, 3))
    for h in range(hypotheses):
        mean, second = mean_and_products(chosen[h], float(chosen.shape[1]))
        values, vectors = eigen(second)
        offset = 0.0
        for i in range(3):
            planes[h, i] = vectors[i, 0]
            offset += vectors[i, 0] * mean[i]
            variances[h, i] = max(values[i], 0.0)
        planes[h, 3] = offset
    return planes, variances


@kernel
def _spacing(points: Any) -> float:
    """`plane_raster.spacing_m`."""
    n = len(points)
    if n < 4:
        return 0.0
    values = eigen(mean_and_products(points, n - 1.0)[1])[0]
    area = 144.0 * max(values[1], 0.0) * max(values[2], 0.0)
    return float(2.0 * area**0.25 / np.sqrt(n))


@kernel
def cell_size(points: Any, least_gap: float, gap_per_range: float) -> float:
    """`plane_raster.cell_size_m`."""
    ranges = np.empty(len(points), np.float32)
    for k in range(len(points)):
        p, q, r = points[k, 0], points[k, 1], points[k, 2]
        ranges[k] = np.sqrt(p * p + q * q + r * r)
    gap = max(least_gap, gap_per_range * float(np.median(ranges)))
    return max(gap, _spacing(points))


@kernel
def _cells_along(points: Any, axes: Any, cell_m: float) -> Any:
    """Cells (N, 2) of points (N, 3) on a plane with the axes (2, 3), and each axis's least and greatest (2,)."""
    along, low, high = np.empty((len(points), 2), np.int64), np.empty(2, np.int64), np.empty(2, np.int64)
    for i in range(2):
        a, b, c = np.float32(axes[i, 0] / cell_m), np.float32(axes[i, 1] / cell_m), np.float32(axes[i, 2] / cell_m)
        for k in range(len(points)):
            cell = np.int64(np.floor(a * points[k, 0] + b * points[k, 1] + c * points[k, 2]))
            along[k, i] = cell
            low[i] = cell if k == 0 else min(low[i], cell)
            high[i] = cell if k == 0 else max(high[i], cell)
    return along, low, high


@kernel
def largest_piece(points: Any, inside: Any, axes: Any, least_gap: float, gap_per_range: float, most_cells: int) -> Any:
    """Of the points (S, 3) that are `inside` (S,), those (S,) of the largest piece that hangs together on the plane
    with the axes (2, 3)."""
    result = np.zeros(len(points), np.bool_)
    members, chosen = np.empty(len(points), np.int64), np.empty((len(points), 3), np.float32)
    n = 0
    for j in range(len(points)):
        if inside[j]:
            members[n] = j
            for i in range(3):
                chosen[n, i] = points[j, i]
            n += 1
    if n == 0:
        return result
    cell_m = cell_size(chosen[:n], least_gap, gap_per_range)
    along, low, high = _cells_along(chosen[:n], axes, cell_m)
    height, width = min(high[0] - low[0] + 1, most_cells), min(high[1] - low[1] + 1, most_cells)
    # A frame of empty cells, so that each has eight neighbours.
    line = width + 2
    count = np.zeros((height + 2) * line, np.int32)
    cells = np.empty(n, np.int64)
    for k in range(n):
        u, v = along[k, 0] - low[0], along[k, 1] - low[1]
        cells[k] = (u + 1) * line + v + 1 if u < height and v < width else 0
        if cells[k] > 0:
            count[cells[k]] += 1
    label = np.zeros(len(count), np.int32)
    stack = np.empty(len(count), np.int64)
    best = pieces = 0
    best_size = 0
    for first in range(line, len(count) - line):
        if count[first] == 0 or label[first] > 0:
            continue
        pieces += 1
        size, top = 0, 1
        stack[0] = first
        label[first] = pieces
        while top > 0:
            top -= 1
            cell = stack[top]
            size += count[cell]
            for step in range(9):
                other = cell + (step // 3 - 1) * line + step % 3 - 1
                if count[other] > 0 and label[other] == 0:
                    label[other] = pieces
                    stack[top] = other
                    top += 1
        if size > best_size:
            best, best_size = pieces, size
    for k in range(n):
        if cells[k] > 0 and label[cells[k]] == best:
            result[members[k]] = True
    return result


@kernel
def points_near(
    points: Any, free: Any, normal: Any, offset: Any, reach: Any, across: Any, origin: Any, allowed: Any, centre: Any
) -> Any:
    """Of the free ones among points (N, 3), which (M,) lie within reach of a plane in the allowed cells (n, m) of it,
    and where, from the centre (M, 3)."""
    n = len(points)
    near, local = np.empty(n + 1, np.int64), np.empty((n + 1, 3), np.float32)
    flags = np.empty(n, np.uint8)
    flat = points.reshape(-1)
    a, b, c = normal[0], normal[1], normal[2]
    for i in range(n):
        at = np.uint64(i) * np.uint64(3)
        x, y, z = flat[at], flat[at + np.uint64(1)], flat[at + np.uint64(2)]
        flags[i] = (abs(a * x + b * y + c * z - offset) < reach) & free[i]
    found = np.uint64(0)
    for i in range(n):
        near[found] = i
        found += np.uint64(flags[i])
    kept = np.uint64(0)
    height, width = allowed.shape
    for k in range(int(found)):
        i = near[k]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        u = int(np.floor(across[0, 0] * x + across[0, 1] * y + across[0, 2] * z)) - origin[0]
        v = int(np.floor(across[1, 0] * x + across[1, 1] * y + across[1, 2] * z)) - origin[1]
        near[kept] = i
        local[kept, 0], local[kept, 1], local[kept, 2] = x - centre[0], y - centre[1], z - centre[2]
        inside = (u >= 0) & (u < height) & (v >= 0) & (v < width)
        kept += np.uint64(inside and allowed[u, v])
    return near[: int(kept)], local[: int(kept)]


@summing_kernel
def moments(local: Any, inside: Any) -> Any:
    """Mean (3,) and covariance (3, 3) of those of the points (M, 3) that are inside (M,), 0 or 1."""
    flat = local.reshape(-1)
    s_1 = s_x = s_y = s_z = s_xx = s_xy = s_xz = s_yy = s_yz = s_zz = 0.0
    for i in range(len(inside)):
        at = np.uint64(i) * np.uint64(3)
        x, y, z = np.float64(flat[at]), np.float64(flat[at + np.uint64(1)]), np.float64(flat[at + np.uint64(2)])
        weight = np.float64(inside[i])
        x_in, y_in, z_in = x * weight, y * weight, z * weight
        s_1 += weight
        s_x += x_in
        s_y += y_in
        s_z += z_in
        s_xx += x_in * x
        s_xy += x_in * y
        s_xz += x_in * z
        s_yy += y_in * y
        s_yz += y_in * z
        s_zz += z_in * z
    mean, second = np.empty(3), np.empty((3, 3))
    mean[0], mean[1], mean[2] = s_x / s_1, s_y / s_1, s_z / s_1
    second[0, 0], second[1, 1], second[2, 2] = s_xx, s_yy, s_zz
    second[0, 1], second[0, 2], second[1, 2] = s_xy, s_xz, s_yz
    second[1, 0], second[2, 0], second[2, 1] = s_xy, s_xz, s_yz
    for i in range(3):
        for j in range(3):
            second[i, j] = second[i, j] / s_1 - mean[i] * mean[j]
    return mean, second


@kernel
def pair_across(normal: Any) -> Any:
    """`geometry.arrays.perpendicular_pair` of the first three numbers of a normal or plane, as rows (2, 3)."""
    length = np.sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2])
    x, y, z = normal[0] / length, normal[1] / length, normal[2] / length
    p, q, r = 0.0, -z, y
    if abs(y) < abs(x):
        p, q, r = z, 0.0, -x
    if abs(z) < min(abs(x), abs(y)):
        p, q, r = -y, x, 0.0
    across = np.sqrt(p * p + q * q + r * r)
    p, q, r = p / across, q / across, r / across
    pair = np.empty((2, 3))
    pair[0, 0], pair[0, 1], pair[0, 2] = p, q, r
    pair[1, 0], pair[1, 1], pair[1, 2] = y * r - z * q, z * p - x * r, x * q - y * p
    return pair


@kernel
def _near_plane(points: Any, normal: Any, offset: float, gate: float) -> Any:
    """Distances (N,) of points (N, 3) from a plane, in single precision, and which are within the gate (N,)."""
    a, b, c, d = np.float32(normal[0]), np.float32(normal[1]), np.float32(normal[2]), np.float32(offset)
    distance, inside, width = np.empty(len(points), np.float32), np.empty(len(points), np.uint8), np.float32(gate)
    for i in range(len(points)):
        distance[i] = a * points[i, 0] + b * points[i, 1] + c * points[i, 2] - d
        inside[i] = abs(distance[i]) < width
    return distance, inside


@kernel
def improved(
    points: Any, active: Any, component: Any, plane: Any, gate: float, refits: int, gap: float, share: float, most: int
) -> Any:
    """`cloud_planes._best_patch`'s local optimisation: a plane (4,) and the component (S,) of points (S, 3) on it."""
    for _ in range(refits):
        chosen = points[component]
        if len(chosen) < 6:
            break
        mean, products = mean_and_products(chosen, 1.0)
        axes = eigen(products)[1]
        offset = axes[0, 0] * mean[0] + axes[1, 0] * mean[1] + axes[2, 0] * mean[2]
        sign = 1.0 if offset <= 0.0 else -1.0
        for axis in range(3):
            plane[axis] = sign * axes[axis, 0]
        plane[3] = sign * offset
        _, inside = _near_plane(points, plane, plane[3], gate)
        found = largest_piece(points, (inside > 0) & active, pair_across(plane), gap, share, most)
        same = True
        for i in range(len(found)):
            same = same and found[i] == component[i]
        component = found
        if same:
            break
    return component


@kernel
def first_in_each(points: Any, side: Any) -> Any:
    """`cloud_planes.first_in_each`, the side in the points' precision; empty where no word holds cell and number."""
    n = len(points)
    cells, low, high = np.empty((n, 3), np.int64), np.empty(3, np.int64), np.empty(3, np.int64)
    for axis in range(3):
        for i in range(n):
            cell = np.int64(np.floor(points[i, axis] / side))
            cells[i, axis] = cell
            low[axis] = cell if i == 0 else min(low[axis], cell)
            high[axis] = cell if i == 0 else max(high[axis], cell)
    bits = 0
    while n >> bits:
        bits += 1
    wide, deep = high[1] - low[1] + 1, high[2] - low[2] + 1
    if float(high[0] - low[0] + 1) * float(wide) * float(deep) * 2.0**bits > 2.0**62:
        return np.empty(0, np.int64)
    # A table by the cells' hashed numbers; sorted are then the first points alone.
    size = 1
    while size < 2 * n:
        size *= 2
    table, words = np.full(size, -1, np.int64), np.empty(n, np.int64)
    kept = 0
    for i in range(n):
        cell = ((cells[i, 0] - low[0]) * wide + (cells[i, 1] - low[1])) * deep + (cells[i, 2] - low[2])
        at = ((np.uint64(cell) * np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(32)) & np.uint64(size - 1)
        while table[at] >= 0 and table[at] != cell:
            at = (at + np.uint64(1)) & np.uint64(size - 1)
        if table[at] < 0:
            table[at] = cell
            words[kept] = cell << bits | i
            kept += 1
    first = np.sort(words[:kept])
    for i in range(kept):
        first[i] &= (1 << bits) - 1
    return first


@kernel
def _cells_around(seen: Any, axes: Any, cell_m: float, most: int) -> Any:
    """Cells (n, m) that points (M, 3) occupy on a plane with the axes (2, 3), and those next to them, and where the
    first cell lies (2,); see `plane_raster`."""
    along, low, high = _cells_along(seen, axes, cell_m)
    low -= 1
    height, width = min(high[0] + 2 - low[0], most), min(high[1] + 2 - low[1], most)
    allowed = np.zeros((height, width), np.bool_)
    for k in range(len(seen)):
        u, v = along[k, 0] - low[0], along[k, 1] - low[1]
        if u >= height or v >= width:
            continue
        for p in range(max(u - 1, 0), min(u + 2, height)):
            for q in range(max(v - 1, 0), min(v + 2, width)):
                allowed[p, q] = True
    return allowed, low


@kernel
def _spread(distance: Any, inside: Any, few: int, least: float, first: float, widest: float) -> float:
    """`patch_evidence.spread` of the distances (M,) that are inside."""
    chosen = np.abs(distance[inside > 0])
    chosen = np.sort(chosen[:: max(len(chosen) // few, 1)])
    n = len(chosen)
    middle = 0.5 * (np.float64(chosen[(n - 1) // 2]) + np.float64(chosen[n // 2]))
    return float(min(max(1.4826022185056018 * middle, least, 0.5 * first), widest * first))


@kernel
def _agree(points: Any, normal: Any, sigma: float, limits: Any, counts: Any) -> bool:
    """`patch_evidence._neighbours_agree`."""
    neighbours, asked_points = counts[0], counts[1]
    if len(points) <= neighbours:
        return True
    seeds = points[:: max(len(points) // asked_points, 1)].copy()
    found = nearest(points, seeds, neighbours)
    chosen = np.empty((len(seeds), neighbours, 3), np.float32)
    for s in range(len(seeds)):
        for k in range(neighbours):
            for axis in range(3):
                chosen[s, k, axis] = points[found[s, k], axis]
    planes, variances = local_planes(chosen)
    known = agree = 0
    for s in range(len(seeds)):
        if variances[s, 1] > (limits[0] * sigma) ** 2 and variances[s, 1] > limits[1] * variances[s, 2]:
            known += 1
            along = planes[s, 0] * normal[0] + planes[s, 1] * normal[1] + planes[s, 2] * normal[2]
            agree += abs(along) > limits[2]
    return bool(known < limits[3] * len(seeds) or agree >= limits[4] * known)


@kernel
def stands_out(local: Any, normal: Any, offset: float, sigma: float, gates: Any, limits: Any, counts: Any) -> int:
    """`patch_evidence.stands_out` with the neighbours asked: 1 or 0; -1 where points are too far apart for it."""
    points = local[:: max(len(local) // counts[2], 1)].copy()
    first = first_in_each(points, np.float32(gates[0] * sigma))
    if len(first) == 0:
        return -1
    points = points[first]
    distance, inside = _near_plane(points, normal, offset, gates[0] * sigma)
    around = np.abs(distance) < np.float32(2.0 * gates[0] * sigma)
    within = np.int64(0)
    for i in range(len(inside)):
        within += inside[i]
    if within < max(gates[3] * np.count_nonzero(around), 4.0):
        return 0
    variances = eigen(moments(points, inside)[1])[0]
    if not variances[0] < gates[4] ** 2 * variances[1]:
        return 0
    return int(_agree(points[around], normal, sigma, limits, counts))


@kernel
def refitted(
    x: Any,
    free: Any,
    seen: Any,
    plane: Any,
    sigma: float,
    gates: Any,
    limits: Any,
    counts: Any,
    gap: float,
    share: float,
    most: int,
) -> Any:
    """`cloud_planes._refit` of a subsample's plane (4,), in place, found by its points `seen` (C, 3).

    Returns 1 for a patch, 0 for none and -1 where that cannot be told here; the patch's points (M,) among x (N, 3), and
    their spread. `gates`, `limits` and `counts` are the thresholds that `cloud_planes` has gathered.
    """
    nothing = np.empty(0, np.int64)
    axes, cell_m = pair_across(plane), cell_size(seen, gap, share)
    allowed, origin = _cells_around(seen, axes, cell_m, most)
    centre, normal = np.empty(3), plane[:3].copy()
    for axis in range(3):
        total = 0.0
        for k in range(len(seen)):
            total += seen[k, axis]
        centre[axis] = total / len(seen)
    middle = centre.astype(np.float32)
    reach = np.float32(2.0 * gates[1] * gates[0] * sigma)
    across = (axes / cell_m).astype(np.float32)
    near, local = points_near(
        x, free, normal.astype(np.float32), np.float32(plane[3]), reach, across, origin, allowed, middle
    )
    if len(near) < 6:
        return 0, nothing, sigma
    offset = plane[3] - (normal[0] * centre[0] + normal[1] * centre[1] + normal[2] * centre[2])
    spread = sigma
    inside, variances = np.empty(0, np.uint8), np.empty(3)
    for _ in range(3):
        distance, inside = _near_plane(local, normal, offset, gates[0] * spread)
        within = np.int64(0)
        for i in range(len(inside)):
            within += inside[i]
        if within < 6:
            return 0, nothing, spread
        mean, second = moments(local, inside)
        variances, vectors = eigen(second)
        for axis in range(3):
            normal[axis] = vectors[axis, 0]
        offset = normal[0] * mean[0] + normal[1] * mean[1] + normal[2] * mean[2]
        spread = _spread(distance, inside, counts[3], gates[2], sigma, gates[1])
    # Thin beside its extents.
    if not (spread**2 < 0.35**2 * variances[1] and spread**2 < 0.1**2 * variances[2]):
        return 0, nothing, spread
    verdict = stands_out(local, normal, offset, spread, gates, limits, counts)
    if verdict < 1:
        return verdict, nothing, spread
    offset += normal[0] * centre[0] + normal[1] * centre[1] + normal[2] * centre[2]
    sign = 1.0 if offset <= 0.0 else -1.0
    for axis in range(3):
        plane[axis] = sign * normal[axis]
    plane[3] = sign * offset
    return 1, near[inside > 0], spread


@kernel
def near_bits(points: Any, planes: Any, gate: float) -> Any:
    """`plane_sample._near` as bytes (H, W), the number of points rounded up to words of 64."""
    count = len(points)
    near = np.zeros((len(planes), (count + 63) // 64 * 8), np.uint8)
    x, y, z = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    for i in range(count):
        x[i], y[i], z[i] = points[i, 0], points[i, 1], points[i, 2]
    inside, width = np.zeros(near.shape[1] * 8, np.uint8), np.float32(gate)
    for h in range(len(planes)):
        a, b, c, d = np.float32(planes[h, 0]), np.float32(planes[h, 1]), np.float32(planes[h, 2]), planes[h, 3]
        offset = np.float32(d)
        for i in range(count):
            inside[i] = abs(a * x[i] + b * y[i] + c * z[i] - offset) < width
        for j in range(near.shape[1]):
            word = np.uint8(0)
            for k in range(8):
                word |= np.uint8(inside[8 * j + k] << (7 - k))
            near[h, j] = word
    return near
