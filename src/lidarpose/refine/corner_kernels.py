"""Passes over all returns from the faces of a target, compiled by numba; imported only where that pays.

Sums are added in another order than NumPy's; everything else is rounded as NumPy rounds it, but for the order of three
products.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel, summing_kernel


@summing_kernel
def collapse(
    rays: Any, range_m: Any, starts: Any, axes: Any, along: Any, reach_m: float, residual: Any, sums: Any
) -> None:
    """Residuals of a face's returns, and sums of the normal equations of its plane, part by part.

    Parameters
    ----------
    rays, range_m : (3, N), (N,)
        Unit beam directions and measured ranges.
    starts : (S + 1,)
        Where parts begin, and where the last one ends.
    axes, along : (3, 3), (3,)
        The plane's normal and its two tangents as rows; the corner along them.
    reach_m
        From where on a residual carries no weight.
    residual : (N,)
        Receives measured minus expected ranges.
    sums : (S, 10)
        Receives, by part: six of the information, rows of its upper triangle; three of the gradient; how many returns
        carry weight. In units of the ranges' squares.
    """
    x, y, z = rays[0], rays[1], rays[2]
    nx, ny, nz = axes[0, 0], axes[0, 1], axes[0, 2]
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    vx, vy, vz = axes[2, 0], axes[2, 1], axes[2, 2]
    height, by_u, by_v = along[0], along[1], along[2]
    inverse = 1.0 / reach_m
    for part in range(len(sums)):
        ss, su, sv, uu, uv, vv = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        rs, ru, rv, used = 0.0, 0.0, 0.0, 0.0
        for i in range(starts[part], starts[part + 1]):
            shift = 1.0 / (nx * x[i] + ny * y[i] + nz * z[i])
            expected = height * shift
            u = (by_u - expected * (ux * x[i] + uy * y[i] + uz * z[i])) * shift
            v = (by_v - expected * (vx * x[i] + vy * y[i] + vz * z[i])) * shift
            off = range_m[i] - expected
            residual[i] = off
            share = off * inverse
            left = 1.0 - share * share
            left = left if left > 0.0 else 0.0
            used += 1.0 if left > 0.0 else 0.0
            weight = left * left
            ws, wu, wv = weight * shift, weight * u, weight * v
            ss += ws * shift
            su += ws * u
            sv += ws * v
            uu += wu * u
            uv += wu * v
            vv += wv * v
            rs += ws * off
            ru += wu * off
            rv += wv * off
        sums[part, 0], sums[part, 1], sums[part, 2] = ss, su, sv
        sums[part, 3], sums[part, 4], sums[part, 5] = uu, uv, vv
        sums[part, 6], sums[part, 7], sums[part, 8], sums[part, 9] = rs, ru, rv, used


@summing_kernel
def loss_powers(residual: Any, reach_m: float) -> Any:
    """Sums of v, v^2, v^4 and v^5 for v = 1 - (residual / reach)^2 of residuals (N,), or 0 where that is less."""
    inverse = 1.0 / reach_m
    first, second, fourth, fifth = 0.0, 0.0, 0.0, 0.0
    for i in range(len(residual)):
        share = residual[i] * inverse
        v = 1.0 - share * share
        v = v if v > 0.0 else 0.0
        v2 = v * v
        first += v
        second += v2
        fourth += v2 * v2
        fifth += v2 * v2 * v
    return first, second, fourth, fifth


@summing_kernel
def middle_of(rays: Any) -> Any:
    """The unit direction (3,) of the sum of rays (3, N)."""
    x, y, z = 0.0, 0.0, 0.0
    for i in range(rays.shape[1]):
        x += rays[0, i]
        y += rays[1, i]
        z += rays[2, i]
    length = np.sqrt(x * x + y * y + z * z)
    if not length > 0.0:
        raise ValueError("a vector of length zero has no direction")
    return x / length, y / length, z / length


@kernel
def grid_cells(rays: Any, scale: float) -> Any:
    """The cell (N,) of a grid of angles that each ray (3, N) is in, and the grid's width; see `DirectionGrid`."""
    a, b, c = middle_of(rays)
    # Across it, as `perpendicular_pair` has it.
    p, q, r = -b, a, 0.0
    if abs(a) <= abs(b) and abs(a) <= abs(c):
        p, q, r = 0.0, -c, b
    elif abs(b) <= abs(c):
        p, q, r = c, 0.0, -a
    across = np.sqrt(p * p + q * q + r * r)
    p, q, r = p / across, q / across, r / across
    s, t, w = b * r - c * q, c * p - a * r, a * q - b * p
    x, y, z = rays[0], rays[1], rays[2]
    count = len(x)
    row, column = np.empty(count), np.empty(count)
    least_row, least_column, most_column = np.inf, np.inf, -np.inf
    for i in range(count):
        ahead = 1.0 + (a * x[i] + b * y[i] + c * z[i])
        share = scale / (ahead if ahead > 1e-12 else 1e-12)
        u = (p * x[i] + q * y[i] + r * z[i]) * share
        v = (s * x[i] + t * y[i] + w * z[i]) * share
        row[i], column[i] = u, v
        least_row = u if u < least_row else least_row
        least_column = v if v < least_column else least_column
        most_column = v if v > most_column else most_column
    first_row, first_column = np.floor(least_row), np.floor(least_column)
    width = np.int64(most_column - first_column) + 3
    cell = np.empty(count, np.int64)
    for i in range(count):
        cell[i] = (np.int64(row[i] - first_row) + 1) * width + np.int64(column[i] - first_column) + 1
    return cell, width


@kernel
def spots_off(rays: Any, range_m: Any, normal: Any, height: float, scale: float, most_m: float) -> Any:
    """The sum of squared means of a face's residuals by cell of a grid of angles, times how many each has, and how many
    cells have any; of rays (3, N) and ranges (N,), without residuals of `most_m` and more."""
    cell, _ = grid_cells(rays, scale)
    x, y, z = rays[0], rays[1], rays[2]
    a, b, c = normal[0], normal[1], normal[2]
    cells = cell.max() + 1
    count, total = np.zeros(cells), np.zeros(cells)
    for i in range(len(x)):
        off = range_m[i] - height / (a * x[i] + b * y[i] + c * z[i])
        if abs(off) < most_m:
            count[cell[i]] += 1.0
            total[cell[i]] += off
    squares, spots = 0.0, 0
    for k in range(cells):
        if count[k] > 0.0:
            squares += total[k] * total[k] / count[k]
            spots += 1
    return squares, spots


@kernel
def seen_on_face(rays: Any, range_m: Any, normal: Any, corner: Any, scale: float) -> Any:
    """Of a face's returns: measured minus expected ranges (N,), how far each lies towards the corner (N,), and cells
    (N,) and width of a grid of angles."""
    cell, width = grid_cells(rays, scale)
    x, y, z = rays[0], rays[1], rays[2]
    a, b, c = normal[0], normal[1], normal[2]
    p, q, r = corner[0], corner[1], corner[2]
    height = a * p + b * q + c * r
    residual, nearness = np.empty(len(x)), np.empty(len(x))
    for i in range(len(x)):
        residual[i] = range_m[i] - height / (a * x[i] + b * y[i] + c * z[i])
        nearness[i] = p * x[i] + q * y[i] + r * z[i]
    return residual, nearness, cell, width


@kernel
def sums_by_cell(residual: Any, cell: Any, sure: Any, cells: int) -> Any:
    """By cell (M,): how many returns it holds, the sum of their residuals (N,), and how many of those that `sure` (K,)
    names; and the residuals (K,) of these."""
    count, total, mine = np.zeros(cells, np.int64), np.zeros(cells), np.zeros(cells, np.int64)
    off = np.empty(len(sure))
    for i in range(len(cell)):
        count[cell[i]] += 1
        total[cell[i]] += residual[i]
    for k in range(len(sure)):
        mine[cell[sure[k]]] += 1
        off[k] = residual[sure[k]]
    return count, total, mine, off


@kernel
def plane_by_cell(rays: Any, index: Any, residual: Any, cell: Any, cells: int, axes: Any, along: Any) -> Any:
    """Normal equations (3, 3), (3,) of the plane of a face's returns, those that `index` (N,) names of rays (3, L); and
    the sums (M, 3) of their derivatives by cell.

    `axes` (3, 3) are the plane's normal and tangents, `along` (3,) the corner along them; `residual` and `cell` (N,)
    are the named ones'.
    """
    normal, pull, by_cell = np.zeros((3, 3)), np.zeros(3), np.zeros((cells, 3))
    height, by_u, by_v = along[0], along[1], along[2]
    for k in range(len(index)):
        i = index[k]
        x, y, z = rays[0, i], rays[1, i], rays[2, i]
        shift = 1.0 / (axes[0, 0] * x + axes[0, 1] * y + axes[0, 2] * z)
        expected = height * shift
        u = (by_u - expected * (axes[1, 0] * x + axes[1, 1] * y + axes[1, 2] * z)) * shift
        v = (by_v - expected * (axes[2, 0] * x + axes[2, 1] * y + axes[2, 2] * z)) * shift
        off, m = residual[k], cell[k]
        normal[0, 0] += shift * shift
        normal[0, 1] += shift * u
        normal[0, 2] += shift * v
        normal[1, 1] += u * u
        normal[1, 2] += u * v
        normal[2, 2] += v * v
        pull[0] += shift * off
        pull[1] += u * off
        pull[2] += v * off
        by_cell[m, 0] += shift
        by_cell[m, 1] += u
        by_cell[m, 2] += v
    normal[1, 0], normal[2, 0], normal[2, 1] = normal[0, 1], normal[0, 2], normal[1, 2]
    return normal, pull, by_cell


@kernel
def met_at(rays: Any, range_m: Any, axes: Any, along: Any, u: Any, v: Any, residual: Any) -> None:
    """Where rays (3, N) meet a plane, along its tangents (N,) from the corner, and measured minus expected ranges (N,).

    `axes` (3, 3) are the plane's normal and tangents, `along` (3,) the corner along them.
    """
    x, y, z = rays[0], rays[1], rays[2]
    nx, ny, nz = axes[0, 0], axes[0, 1], axes[0, 2]
    ux, uy, uz = axes[1, 0], axes[1, 1], axes[1, 2]
    vx, vy, vz = axes[2, 0], axes[2, 1], axes[2, 2]
    height, at_u, at_v = along[0], along[1], along[2]
    for i in range(len(x)):
        expected = height / (nx * x[i] + ny * y[i] + nz * z[i])
        u[i] = (ux * x[i] + uy * y[i] + uz * z[i]) * expected - at_u
        v[i] = (vx * x[i] + vy * y[i] + vz * z[i]) * expected - at_v
        residual[i] = range_m[i] - expected


@kernel
def reaches(points: Any, directions: Any, starts: Any) -> Any:
    """By part of points (2, N), which begin at `starts` (P + 1,): how far they reach along and against directions
    (D, 2), both (P, D)."""
    cosine, sine = directions[:, 0].copy(), directions[:, 1].copy()
    most = np.full((len(starts) - 1, len(cosine)), -np.inf)
    least = np.full((len(starts) - 1, len(cosine)), np.inf)
    for part in range(len(most)):
        high, low = most[part], least[part]
        for i in range(starts[part], starts[part + 1]):
            x, y = points[0, i], points[1, i]
            for k in range(len(cosine)):
                out = cosine[k] * x + sine[k] * y
                high[k] = out if out > high[k] else high[k]
                low[k] = out if out < low[k] else low[k]
    return most, least


@kernel
def within(points: Any, directions: Any, least: Any, most: Any) -> Any:
    """Which of points (2, N) lie between two bounds (D,) along all directions (D, 2)."""
    inside = np.ones(points.shape[1], np.bool_)
    x, y = points[0], points[1]
    for k in range(len(directions)):
        cosine, sine, low, high = directions[k, 0], directions[k, 1], least[k], most[k]
        for i in range(len(inside)):
            out = cosine * x[i] + sine * y[i]
            inside[i] &= (out >= low) & (out <= high)
    return inside


@kernel
def farthest_out(points: Any, directions: Any) -> Any:
    """Which (2 D,) of points (2, N), the first of equals, is farthest along each of directions (D, 2); then against."""
    many = len(directions)
    cosine, sine = directions[:, 0].copy(), directions[:, 1].copy()
    most, least = np.full(many, -np.inf), np.full(many, np.inf)
    index = np.zeros(2 * many, np.int64)
    for i in range(points.shape[1]):
        x, y = points[0, i], points[1, i]
        for k in range(many):
            out = cosine[k] * x + sine[k] * y
            index[k] = i if out > most[k] else index[k]
            most[k] = out if out > most[k] else most[k]
            index[many + k] = i if out < least[k] else index[many + k]
            least[k] = out if out < least[k] else least[k]
    return index


@kernel
def gathered(rays: Any, range_m: Any, frame: Any, index: Any) -> Any:
    """Rays (3, M), ranges (M,) and frames (M,) that `index` (M,) tells of rays (3, N), ranges and frames."""
    count = len(index)
    some, far, at = np.empty((3, count)), np.empty(count), np.empty(count, np.int64)
    x, y, z = rays[0], rays[1], rays[2]
    for k in range(count):
        i = np.uint64(index[k])
        some[0, k], some[1, k], some[2, k] = x[i], y[i], z[i]
        far[k], at[k] = range_m[i], frame[i]
    return some, far, at
