"""What surfaces that are bent do to a mounting found from their flatness.

A wall that bulges by a millimetre over metres leaves residuals that are alike over all of it: many patches, but hardly
more than one piece of evidence. Each surface is given random smooth shapes across it, of second and third order, all of
one spread; how large that is, is told by the residuals' share in those shapes (maximum likelihood of a variance
component, Harville, J. Am. Stat. Assoc. 72, 1977), and what shapes of that size move the mounting by is a covariance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.spun_scan import FlatReturns
from lidarpose.refine.flatness import Solution

# u^2, uv, v^2, u^3, u^2 v, u v^2, v^3.
POWERS = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
# A surface with fewer returns tells of no shapes, and one along which a shape hardly changes does not tell of that one.
LEAST_RETURNS = 50
LEAST_CHANGE = 1e-6
LARGEST_SHAPE_M = 0.3


@dataclass(frozen=True, eq=False)
class Bend:
    """Smooth shapes of the surfaces.

    Attributes
    ----------
    spread_m
        Standard deviation of each shape's size, a size being its root mean square over the surface.
    covariance : (p, p)
        Of the parameters, by shapes of that spread.
    """

    spread_m: float
    covariance: FloatArray


def bend_of(solution: Solution, returns: FlatReturns, by: FloatArray) -> Bend:
    """How far the surfaces are bent, and what that does to parameters; `by` (n, p) are the ranges' derivatives."""
    line, weight = solution.line, solution.weight
    p = by.shape[1]
    information, gradient = np.zeros((p, p)), []
    crossed: list[FloatArray] = []
    own: list[FloatArray] = []
    for k in range(returns.surfaces):
        mine = np.flatnonzero((returns.surface == k) & (weight > 0.0))
        root = np.sqrt(weight[mine])[:, None]
        rows, shapes = _rows(root * by[mine], root * line.by_plane[mine])
        information += rows.T @ rows
        crossed.append(shapes.T @ rows)
        own.append(shapes.T @ shapes)
        gradient.append(shapes.T @ (root[:, 0] * line.residual[mine]))
    C, s = np.concatenate(crossed), np.concatenate(gradient)
    if not len(s):
        return Bend(0.0, np.zeros((p, p)))
    M = -C @ np.linalg.solve(information, C.T)
    at = 0
    for block in own:
        M[at : at + len(block), at : at + len(block)] += block
        at += len(block)
    size, axes = np.linalg.eigh(0.5 * (M + M.T))
    told = size > 1e-9 * max(float(size.max()), 1e-300)
    spread = _spread(axes.T[told] @ s, size[told])
    move = spread * np.linalg.solve(information, C.T)
    return Bend(spread, np.asarray(move @ move.T))


def without_plane(columns: FloatArray, by_plane: FloatArray) -> FloatArray:
    """Columns (m, q) of one surface less what its plane, (m, 3), can take over."""
    if len(columns) <= by_plane.shape[1]:
        return np.zeros_like(columns)
    basis = np.linalg.qr(by_plane)[0]
    return np.asarray(columns - basis @ (basis.T @ columns))


def _rows(by: FloatArray, by_plane: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted derivatives (m, p) by the parameters and (m, q) by the shapes, the surface's own plane taken out."""
    rows = without_plane(by, by_plane)
    if len(by) < LEAST_RETURNS:
        return rows, np.zeros((len(by), 0))
    # A plane's tilts are minus the place along it over the cosine, its offset is one over the cosine.
    across = -by_plane[:, :2] / by_plane[:, 2:]
    u, v = ((across - across.mean(axis=0)) / np.maximum(across.std(axis=0), LEAST_CHANGE)).T
    shapes = without_plane(np.stack([u**i * v**j for i, j in POWERS], axis=1) * by_plane[:, 2:], by_plane)
    # Orthogonal to each other, and each of root mean square 1 over the surface.
    columns, upper = np.linalg.qr(shapes)
    kept = np.abs(np.diag(upper)) > LEAST_CHANGE * np.linalg.norm(by_plane[:, 2])
    return rows, columns[:, kept] * np.linalg.norm(by_plane[:, 2])


def _spread(score: FloatArray, information: FloatArray) -> float:
    """The spread whose square t makes scores of variance information + t information^2 likeliest."""

    def minus_log_likelihood(t: FloatArray) -> FloatArray:
        variance = information + np.square(t)[:, None] * np.square(information)
        return np.asarray(0.5 * (np.log(variance) + np.square(score) / variance).sum(axis=1))

    spreads = np.concatenate([[0.0], np.geomspace(1e-6, LARGEST_SHAPE_M, 400)])
    cost = minus_log_likelihood(spreads)
    # The mean over the likelihood, not its peak: with few shapes the peak is often at zero, and never the worst case.
    chance = np.exp(cost.min() - cost) * np.gradient(spreads)
    return float(np.sqrt((chance * spreads**2).sum() / chance.sum()))
