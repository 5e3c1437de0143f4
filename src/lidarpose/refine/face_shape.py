"""Whether the target's faces are flat where all places together look: a bulge, or a board fixed beside a face.

What bends a face is the target's own, and the same at every place. A place's returns are too few to tell it, and no
mean over places gets rid of it: it leans the face everywhere alike, and moves the pose by more than the noise says.
The rays tell without noise where on its face each return lies, so the returns of all places are counted by parts of
the face. Where the parts' means scatter more than the noise allows (a chi-square), how far they are off is a variance
component (by moments, DerSimonian and Laird 1986), and what such parts do to the estimate belongs to its covariance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.corner_result import CornerPlaceFaces
from lidarpose.refine.corner_model import CornerFit, face_jacobians
from lidarpose.refine.face_systems import face_rows

# A face has so many parts along its greater extent.
PARTS = 5
# Chance leaves a chi-square below its degrees of freedom and so many standard deviations of it.
CHANCE_SIGMAS = 4.0
# Returns this far off, in standard deviations of the range, are of something else.
GATE_SIGMAS = 4.0
# Some ten thousand returns tell a shape.
MOST_RETURNS = 40_000


@dataclass(frozen=True, eq=False)
class FaceShape:
    """By face, the standard deviation in metres by which its parts are off a plane, of those whose parts are; and what
    that does to the estimate, as a covariance (n, n) of its parameters."""

    off_m: Mapping[int, float]
    covariance: FloatArray


@dataclass(frozen=True, eq=False)
class _Parts:
    """Part by part (C,) of a face, places together: the sum of weights, and of weighted residuals; and the pull (C, n)
    on the parameters of all returns there, were they off by a metre, times the range's variance."""

    weight: FloatArray
    residual: FloatArray
    pull: FloatArray


def face_shape(fit: CornerFit, places: Sequence[CornerPlaceFaces]) -> FaceShape | None:
    """How far the faces of a joint estimate's returns are from planes; None where they are flat to the noise."""
    off_m, pulls = {}, []
    for j in range(3):
        keys = [key for key in fit.systems if key[1] == j and j in places[key[0]].faces]
        if not keys:
            continue
        parts = _parts(fit, places, keys)
        variance_m2 = _variance_m2(parts, fit.range_sigma_m)
        if variance_m2 > 0.0:
            off_m[j] = float(np.sqrt(variance_m2))
            pulls.append(off_m[j] / fit.range_sigma_m**2 * parts.pull)
    if not off_m:
        return None
    moves = fit.covariance / fit.loss_factor @ np.concatenate(pulls).T
    return FaceShape(off_m, np.asarray(moves @ moves.T))


def _parts(fit: CornerFit, places: Sequence[CornerPlaceFaces], keys: Sequence[tuple[int, int]]) -> _Parts:
    normal = fit.state.normals[keys[0][1]]
    corners = fit.state.corners(fit.world)
    step = max(sum(len(f) for p in places for f in p.faces.values()) // MOST_RETURNS, 1)
    points, residuals, rows = [], [], []
    for i, j in keys:
        returns = places[i].faces[j]
        expected, derivatives = face_rows(returns.rays[:, ::step], normal, corners[i])
        residuals.append(returns.range_m[::step] - expected)
        points.append(derivatives[1:] / derivatives[0])
        rows.append(derivatives)
    every = np.concatenate(points, axis=1)
    low, side = every.min(axis=1, keepdims=True), max(float(np.ptp(every, axis=1).max()), 1e-9) / (PARTS - 1e-9)
    jacobians = face_jacobians(keys, fit.state, fit.world, fit.options)
    weight, residual, pull = np.zeros(PARTS**2), np.zeros(PARTS**2), np.zeros((PARTS**2, len(fit.names)))
    for key, where, off, row in zip(keys, points, residuals, rows, strict=True):
        share = step / fit.variance.get(key, 1.0)
        u, v = ((where - low) / side).astype(np.int64)
        near = np.flatnonzero(np.abs(off) < GATE_SIGMAS * fit.range_sigma_m)
        part = (PARTS * u + v).take(near)
        weight += share / step * np.bincount(part, minlength=PARTS**2)
        residual += share / step * np.bincount(part, off.take(near), PARTS**2)
        sums = np.stack([np.bincount(part, one.take(near), PARTS**2) for one in row], axis=1)
        pull += share * sums @ jacobians[key]
    return _Parts(weight, residual, pull)


def _variance_m2(parts: _Parts, sigma_m: float) -> float:
    """Of how far a face's parts are off a plane; zero where noise explains it."""
    there = parts.weight > 0.0
    weight, residual = parts.weight[there], parts.residual[there]
    dof = len(weight) - 3
    if dof < 1:
        return 0.0
    excess = float((residual**2 / weight).sum()) / sigma_m**2 - dof
    if excess < CHANCE_SIGMAS * np.sqrt(2.0 * dof):
        return 0.0
    return float(sigma_m**2 * excess / (weight.sum() - (weight**2).sum() / weight.sum()))
