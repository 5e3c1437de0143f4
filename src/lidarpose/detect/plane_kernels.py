"""The passes of `detect.plane_claims` over all points, compiled by numba; imported only where they pay.

Each is the NumPy way's, point by point in place of array by array. A library's matrix product sums in another order
and may fuse its operations, so that a point within a rounding error of a gate or a cell's border may fall on its other
side.

Positions are unsigned numbers: for others each access would ask whether they count from the end.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel


@kernel
def fill_columns(points: Any, columns: Any) -> None:
    """Points (N, 3) as rows (3, N) in single precision."""
    x, y, z = columns[0], columns[1], columns[2]
    for i in range(len(points)):
        x[i], y[i], z[i] = points[i, 0], points[i, 1], points[i, 2]


@kernel
def _near(x: Any, y: Any, z: Any, row: Any, near: Any) -> None:
    """Whether points lie within 1 of a plane, 0 or 1."""
    a, b, c, d = row[0], row[1], row[2], row[3]
    for i in range(len(x)):
        near[i] = abs(a * x[i] + b * y[i] + c * z[i] + d) < np.float32(1.0)


@kernel
def _hold(x: Any, y: Any, z: Any, rows: Any, near: Any, width: int, allowed: Any, times: Any, index: Any) -> int:
    """Write positions of those near points that lie in allowed cells to `index`, count holders of a point in `times`;
    how many there are."""
    found = np.uint64(0)
    for k in range(len(near)):
        index[found] = k
        found += np.uint64(near[k])
    u_x, u_y, u_z, u_1 = rows[3, 0], rows[3, 1], rows[3, 2], rows[3, 3]
    v_x, v_y, v_z, v_1 = rows[4, 0], rows[4, 1], rows[4, 2], rows[4, 3]
    zero, border = np.float32(0.0), np.float32(width - 1)
    first, last, line = np.int32(0), np.int32(len(allowed) - 1), np.int32(width)
    kept = np.uint64(0)
    for j in range(found):
        i = np.uint64(index[np.uint64(j)])
        u = u_x * x[i] + u_y * y[i] + u_z * z[i] + u_1
        v = v_x * x[i] + v_y * y[i] + v_z * z[i] + v_1
        # What lies outside ends on the border, which is never allowed, or beyond the first or last cell.
        v = v if v > zero else zero
        v = v if v < border else border
        cell = np.int32(np.int32(u) * line + np.int32(v))
        cell = cell if cell > first else first
        cell = cell if cell < last else last
        mine = allowed[np.uint64(cell)]
        index[kept] = i
        times[i] += mine
        kept += np.uint64(mine)
    return int(kept)


@kernel
def moments_of(columns: Any, index: Any, times: Any, rows: Any, lean: Any, gate: float, disputed: Any) -> Any:
    """The sums (4, 4) of products of (1, height, u, v) over those of the points (3, N) at `index` that nobody else
    holds and whose height over the leant plane is within the gate, and how many others there are.

    `times` (N,) says how many hold each point; positions in `index` of those with several are written to `disputed`,
    unless that is empty.
    """
    x, y, z = columns[0], columns[1], columns[2]
    lean_1, lean_u, lean_v = lean[0], lean[1], lean[2]
    h_x, h_y, h_z, h_1 = rows[0, 0], rows[0, 1], rows[0, 2], rows[0, 3]
    u_x, u_y, u_z, u_1 = rows[1, 0], rows[1, 1], rows[1, 2], rows[1, 3]
    v_x, v_y, v_z, v_1 = rows[2, 0], rows[2, 1], rows[2, 2], rows[2, 3]
    disputes = np.uint64(0)
    s_1 = s_h = s_u = s_v = s_hu = s_hv = s_uu = s_uv = s_vv = s_hh = 0.0
    for j in range(len(index)):
        i = np.uint64(index[j])
        if times[i] > 1:
            if len(disputed) > 0:
                disputed[disputes] = j
            disputes += np.uint64(1)
            continue
        h = np.float64(h_x * x[i] + h_y * y[i] + h_z * z[i] + h_1)
        u = np.float64(u_x * x[i] + u_y * y[i] + u_z * z[i] + u_1)
        v = np.float64(v_x * x[i] + v_y * y[i] + v_z * z[i] + v_1)
        if abs(h - lean_1 - lean_u * u - lean_v * v) < gate:
            s_1 += 1.0
            s_h += h
            s_u += u
            s_v += v
            s_hh += h * h
            s_hu += h * u
            s_hv += h * v
            s_uu += u * u
            s_uv += u * v
            s_vv += v * v
    sums = np.empty((4, 4))
    sums[0, 0], sums[1, 1], sums[2, 2], sums[3, 3] = s_1, s_hh, s_uu, s_vv
    sums[0, 1], sums[0, 2], sums[0, 3], sums[1, 2], sums[1, 3], sums[2, 3] = s_h, s_u, s_v, s_hu, s_hv, s_uv
    sums[1, 0], sums[2, 0], sums[3, 0], sums[2, 1], sums[3, 1], sums[3, 2] = s_h, s_u, s_v, s_hu, s_hv, s_uv
    return sums, int(disputes)


@kernel
def claims_of_block(columns: Any, free: Any, rows: Any, allowed: Any, starts: Any, widths: Any, gates: Any) -> Any:
    """What each of K slabs holds of a block of points (3, N), of those with `free` (N,), or of all where that is empty.

    Parameters
    ----------
    rows : (K, 5, 4), single precision
        Take (x, y, z, 1) to the height in units of the gate for claims, to u and v, and to both in cells.
    allowed, starts, widths
        All slabs' cells as one row of 0 and 1, where each slab's begin (K + 1,), and how many each has in a line (K,).
    gates : (K, 2)
        The gates for claims and for moments, metres.

    Returns
    -------
    Positions of what is held, slab after slab, and where each slab's end (K,); the disputed ones among each slab's, and
    where those end (K,); the moments (K, 4, 4); how many hold each point (N,).
    """
    x, y, z = columns[0], columns[1], columns[2]
    n, slabs = len(x), len(rows)
    near, times = np.empty(n, np.uint8), np.zeros(n, np.uint8)
    held = np.empty(2 * n, np.uint32)
    ends, disputed_ends = np.empty(slabs, np.int64), np.empty(slabs, np.int64)
    total = 0
    for k in range(slabs):
        _near(x, y, z, rows[k, 0], near)
        if len(free) > 0:
            for i in range(n):
                near[i] &= free[i]
        if total + n + 1 > len(held):
            more = np.empty(2 * (total + n), np.uint32)
            more[:total] = held[:total]
            held = more
        cells = allowed[starts[k] : starts[k + 1]]
        total += _hold(x, y, z, rows[k], near, widths[k], cells, times, held[total:])
        ends[k] = total
    disputed, disputes, first = np.empty(total, np.uint32), 0, 0
    sums = np.zeros((slabs, 4, 4))
    scaled, level = rows.copy(), np.zeros(3)
    for k in range(slabs):
        scaled[k, 0] *= np.float32(gates[k, 0])
        mine = held[first : ends[k]]
        sums[k], others = moments_of(columns, mine, times, scaled[k], level, gates[k, 1], disputed[disputes:])
        disputes += others
        first, disputed_ends[k] = ends[k], disputes
    return held[:total].copy(), ends, disputed[:disputes].copy(), disputed_ends, sums, times


@kernel
def members_of(columns: Any, index: Any, disputed: Any, row: Any, first: int, taken: Any) -> Any:
    """Numbers (M,), counted from `first`, of those of the points (3, N) at `index` that lie within 1 of a plane; of
    those at the positions `disputed` only where `taken` (N,) is not yet set, which they then set."""
    x, y, z = columns[0], columns[1], columns[2]
    members = np.empty(len(index) + 1, np.int64)
    a, b, c, d = row[0], row[1], row[2], row[3]
    found = np.uint64(0)
    start = 0
    for part in range(len(disputed) + 1):
        stop = int(disputed[part]) if part < len(disputed) else len(index)
        for j in range(start, stop):
            i = np.uint64(index[np.uint64(j)])
            members[found] = first + np.int64(i)
            found += np.uint64(abs(a * x[i] + b * y[i] + c * z[i] + d) < np.float32(1.0))
        if part < len(disputed):
            i = np.uint64(index[stop])
            members[found] = first + np.int64(i)
            if abs(a * x[i] + b * y[i] + c * z[i] + d) < np.float32(1.0):
                found += np.uint64(not taken[i])
                taken[i] = True
        start = stop + 1
    return members[:found]


@kernel
def heights_of_some(columns: Any, index: Any, chosen: Any, row: Any) -> Any:
    """Heights (M,) over a plane of those of the points (3, N) at `index` that are chosen (N,)."""
    x, y, z = columns[0], columns[1], columns[2]
    heights = np.empty(len(index), np.float32)
    a, b, c, d = row[0], row[1], row[2], row[3]
    found = 0
    for j in range(len(index)):
        i = np.uint64(index[j])
        if chosen[i]:
            heights[found] = a * x[i] + b * y[i] + c * z[i] + d
            found += 1
    return heights[:found]
