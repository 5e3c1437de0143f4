"""Passes over all returns from the faces of a target, compiled by numba; imported only where that pays.

Sums are added in another order than NumPy's; everything else is rounded as NumPy rounds it, but for the order of three
products.
"""

from __future__ import annotations

from typing import Any

from lidarpose.geometry.compiled import summing_kernel


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
