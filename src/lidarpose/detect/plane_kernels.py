"""The passes of `detect.plane_claims` over all points, compiled by numba; imported only where they pay.

Each is the NumPy way's, point by point in place of array by array. A library's matrix product sums in another order
and may fuse its operations, so that a point within a rounding error of a gate or a cell's border may fall on its other
side.

Positions are unsigned numbers: for others each access would ask whether they count from the end.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel, summing_kernel


@kernel
def _near(x: Any, y: Any, z: Any, row: Any, near: Any) -> None:
    """Whether points lie within 1 of a plane, 0 or 1."""
    a, b, c, d = row[0], row[1], row[2], row[3]
    for i in range(len(x)):
        near[i] = abs(a * x[i] + b * y[i] + c * z[i] + d) < np.float32(1.0)


@kernel
def _positions(near: Any, index: Any) -> int:
    """Write positions of what is near to `index`; how many there are."""
    found = np.uint64(0)
    for k in range(len(near)):
        index[found] = k
        found += np.uint64(near[k])
    return int(found)


@kernel
def _hold(x: Any, y: Any, z: Any, rows: Any, near: Any, width: int, allowed: Any, times: Any, terms: Any) -> int:
    """Of the points at the positions `near` write those in allowed cells to `terms`, as position, height, u and v, and
    count the holders of a point in `times`; how many there are."""
    index, height, along_u, along_v = terms
    h_x, h_y, h_z, h_1 = rows[0, 0], rows[0, 1], rows[0, 2], rows[0, 3]
    u_x, u_y, u_z, u_1 = rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3]
    v_x, v_y, v_z, v_1 = rows[2, 0], rows[2, 1], rows[2, 2], rows[2, 3]
    per_m, from_u, from_v = rows[3, 0], rows[3, 1], rows[3, 2]
    zero, line = np.float32(0.0), np.int32(width)
    last_u, last_v = np.float32(len(allowed) // width - 1), np.float32(width - 1)
    kept = np.uint64(0)
    for j in range(len(near)):
        i = np.uint64(near[j])
        p, q, r = x[i], y[i], z[i]
        u = u_x * p + u_y * q + u_z * r + u_1
        v = v_x * p + v_y * q + v_z * r + v_1
        # What lies outside ends on the border, which is never allowed.
        m = min(max(u * per_m + from_u, zero), last_u)
        n = min(max(v * per_m + from_v, zero), last_v)
        mine = allowed[np.uint64(np.int32(m) * line + np.int32(n))]
        index[kept] = i
        height[kept] = h_x * p + h_y * q + h_z * r + h_1
        along_u[kept] = u
        along_v[kept] = v
        times[i] += mine
        kept += np.uint64(mine)
    return int(kept)


@summing_kernel
def _add_moments(height: Any, along_u: Any, along_v: Any, lean: Any, gate: Any, sums: Any) -> None:
    """Add the products of (1, height, u, v) of points whose height over the leant plane is within the gate, those of
    the upper triangle, to `sums` (4, 4)."""
    lean_1, lean_u, lean_v = lean[0], lean[1], lean[2]
    s_1 = s_h = s_u = s_v = s_hu = s_hv = s_uu = s_uv = s_vv = s_hh = 0.0
    for j in range(len(height)):
        apart = abs(height[j] - along_u[j] * lean_u - along_v[j] * lean_v - lean_1)
        inside = 1.0 if apart < gate else 0.0
        h, u, v = np.float64(height[j]), np.float64(along_u[j]), np.float64(along_v[j])
        s_1 += inside
        h_in, u_in, v_in = h * inside, u * inside, v * inside
        s_h += h_in
        s_u += u_in
        s_v += v_in
        s_hh += h_in * h
        s_hu += h_in * u
        s_hv += h_in * v
        s_uu += u_in * u
        s_uv += u_in * v
        s_vv += v_in * v
    sums[0, 0] += s_1
    sums[0, 1] += s_h
    sums[0, 2] += s_u
    sums[0, 3] += s_v
    sums[1, 1] += s_hh
    sums[1, 2] += s_hu
    sums[1, 3] += s_hv
    sums[2, 2] += s_uu
    sums[2, 3] += s_uv
    sums[3, 3] += s_vv


@kernel
def moments_of(height: Any, along_u: Any, along_v: Any, disputed: Any, lean: Any, gate: Any) -> Any:
    """The sums (4, 4) of products of (1, height, u, v) over those points (M,) whose height over the leant plane (3,),
    in single precision as the gate is, lies within that, without those at the positions `disputed`."""
    sums, others = np.zeros((4, 4)), np.zeros((4, 4))
    _add_moments(height, along_u, along_v, lean, gate, sums)
    n = len(disputed)
    h, u, v = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    for k in range(n):
        at = np.uint64(disputed[k])
        h[k], u[k], v[k] = height[at], along_u[at], along_v[at]
    _add_moments(h, u, v, lean, gate, others)
    for i in range(4):
        for k in range(i, 4):
            sums[i, k] -= others[i, k]
            sums[k, i] = sums[i, k]
    return sums


@kernel
def claims_of_block(points: Any, free: Any, rows: Any, allowed: Any, starts: Any, widths: Any, gates: Any) -> Any:
    """What each of K slabs holds of a block of points (N, 3), of those with `free` (N,), or of all where that is empty.

    Parameters
    ----------
    rows : (K, 5, 4), single precision
        Take (x, y, z, 1) to the height in units of the gate for claims, the height, u and v; the last one holds cells a
        metre, and what to add to u and to v in cells.
    allowed, starts, widths
        All slabs' cells as one row of 0 and 1, where each slab's begin (K + 1,), and how many each has in a line (K,).
    gates : (K,), single precision
        The gates for moments, metres.

    Returns
    -------
    Positions, heights, u and v (L,) of what is held, slab after slab, and where each slab's end (K,); the disputed ones
    among each slab's, and where those end (K,); the moments (K, 4, 4).
    """
    n, slabs = len(points), len(rows)
    x, y, z = np.empty(n, np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    flat = points.reshape(-1)
    for i in range(n):
        at = np.uint64(i) * np.uint64(3)
        x[i], y[i], z[i] = flat[at], flat[at + np.uint64(1)], flat[at + np.uint64(2)]
    near, times, index = np.empty(n, np.uint8), np.zeros(n, np.uint8), np.empty(n + 1, np.uint32)
    size = 2 * n
    held, height = np.empty(size, np.uint32), np.empty(size, np.float32)
    along_u, along_v = np.empty(size, np.float32), np.empty(size, np.float32)
    ends, disputed_ends = np.empty(slabs, np.int64), np.empty(slabs, np.int64)
    total = 0
    for k in range(slabs):
        _near(x, y, z, rows[k, 0], near)
        if len(free) > 0:
            for i in range(n):
                near[i] &= free[i]
        found = _positions(near, index)
        if total + found + 1 > size:
            size = 2 * (total + n)
            held, height = _longer(held, size), _longer(height, size)
            along_u, along_v = _longer(along_u, size), _longer(along_v, size)
        cells = allowed[starts[k] : starts[k + 1]]
        terms = held[total:], height[total:], along_u[total:], along_v[total:]
        total += _hold(x, y, z, rows[k, 1:], index[:found], widths[k], cells, times, terms)
        ends[k] = total
    disputed, disputes = np.empty(total + 1, np.uint32), np.uint64(0)
    sums, level = np.zeros((slabs, 4, 4)), np.zeros(3, np.float32)
    first = 0
    for k in range(slabs):
        begun = int(disputes)
        for j in range(first, ends[k]):
            disputed[disputes] = j - first
            disputes += np.uint64(times[np.uint64(held[np.uint64(j)])] > 1)
        mine = slice(first, ends[k])
        theirs = disputed[begun : int(disputes)]
        of_slab = moments_of(height[mine], along_u[mine], along_v[mine], theirs, level, gates[k])
        for i in range(4):
            for j in range(4):
                sums[k, i, j] = of_slab[i, j]
        first, disputed_ends[k] = ends[k], disputes
    return held, height, along_u, along_v, ends, disputed[: int(disputes)].copy(), disputed_ends, sums


@kernel
def _longer(values: Any, size: int) -> Any:
    more = np.empty(size, values.dtype)
    for i in range(len(values)):
        more[i] = values[i]
    return more


@kernel
def members_of(
    index: Any, height: Any, along_u: Any, along_v: Any, disputed: Any, lean: Any, gate: Any, first: int, taken: Any
) -> Any:
    """Numbers (M,), counted from `first`, of the points at the positions `index` whose height over the leant plane is
    within the gate; of those at the places `disputed` only where `taken` is not yet set, which they then set."""
    n = len(index)
    mine = np.empty(n, np.uint8)
    lean_1, lean_u, lean_v = lean[0], lean[1], lean[2]
    for j in range(n):
        mine[j] = abs(height[j] - along_u[j] * lean_u - along_v[j] * lean_v - lean_1) < gate
    for k in range(len(disputed)):
        at = np.uint64(disputed[k])
        i = np.uint64(index[at])
        first_taker = mine[at] & (taken[i] ^ 1)
        taken[i] |= mine[at]
        mine[at] = first_taker
    members = np.empty(n + 1, np.int64)
    found = np.uint64(0)
    for j in range(n):
        members[found] = first + np.int64(index[j])
        found += np.uint64(mine[j])
    return members[: int(found)]


@kernel
def heights_of_some(index: Any, height: Any, along_u: Any, along_v: Any, every: int, run: int, lean: Any) -> Any:
    """Heights (M,) over the leant plane of those points whose positions, ascending, lie in every so manieth run."""
    heights = np.empty(len(index), np.float32)
    lean_1, lean_u, lean_v = lean[0], lean[1], lean[2]
    found = j = begin = 0
    while j < len(index):
        # The first at or beyond a run, by halving.
        low, high = j, min(j + max(begin - int(index[j]), 0), len(index))
        while low < high:
            middle = (low + high) // 2
            if int(index[middle]) < begin:
                low = middle + 1
            else:
                high = middle
        j = low
        while j < len(index) and int(index[j]) < begin + run:
            heights[found] = height[j] - along_u[j] * lean_u - along_v[j] * lean_v - lean_1
            found += 1
            j += 1
        begin += run * every
    return heights[:found]
