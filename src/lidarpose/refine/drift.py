"""Smooth misfit: lines that drift over the arc, corners that bend over a panel.

Noise differs from one line or corner to the next. What a wrong model, a lens or a plate that is not flat leaves changes
smoothly, and then many measurements are worth less than their number. Both tests compare smooth parts of residuals with
the rest of the same residuals, so neither needs a noise level.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.observation import PanelCorners
from lidarpose.model.turntable_result import Kind
from lidarpose.refine.least_squares import own_effects
from lidarpose.refine.turntable_layout import JointData
from lidarpose.refine.turntable_parameters import N_MOTION

_SMOOTH_TERMS = 5
_SIGNIFICANT_DRIFT = 1.6
"""Above this (2.3 standard deviations for two panels and two kinds) neighbouring lines count as correlated."""
_SMOOTH_DEGREE = 2
_SIGNIFICANT_SMOOTH = 1.5


@dataclass(frozen=True)
class Drift:
    """Whether what lines are off by changes smoothly over the arc, as a wrong model makes it.

    `ratio`: mean square of the smooth part of the lines' effects over that of the rest; near 1 for a sound model.
    """

    ratio: float
    freedom: int

    @property
    def inflation(self) -> float:
        """By how much the variance of an estimate exceeds what independent lines would give."""
        return self.ratio if self.ratio > _SIGNIFICANT_DRIFT else 1.0


def drift(data: JointData, moments: Mapping[Kind, FloatArray], line_weights: Mapping[Kind, FloatArray]) -> Drift | None:
    """Smooth part of the lines' shifts and slopes over the readings, against their scatter from place to place.

    None where there are too few places to tell the two apart.
    """
    smooth = smooth_count = 0.0
    for kind, m in moments.items():
        lines = data.stripes.lines if kind == "stripes" else data.ranges.lines
        own, good = own_effects(m)
        good &= line_weights[kind] > 0.5
        for slot in np.unique(lines.slot):
            mine = good & (lines.slot == slot)
            if mine.sum() < 4 * _SMOOTH_TERMS:
                continue
            ratio = _smooth_against_rest(own[mine], data.angles_rad[lines.place[mine]])
            smooth += float(ratio.sum())
            smooth_count += _SMOOTH_TERMS * len(ratio)
    # The parameters of motion have taken as many of the smooth terms as there are of them.
    smooth_count -= N_MOTION
    if smooth_count < 2.0:
        return None
    return Drift(smooth / smooth_count, int(smooth_count))


def _smooth_against_rest(effects: FloatArray, angles: FloatArray) -> FloatArray:
    """Sum of squares of the smooth terms of each effect (columns), over the mean square of the rest."""
    x = (2.0 * angles - angles.min() - angles.max()) / max(float(np.ptp(angles)), 1e-12)
    Q = np.linalg.qr(np.polynomial.chebyshev.chebvander(x, _SMOOTH_TERMS - 1))[0]
    explained = Q.T @ effects
    left = effects - Q @ explained
    scale = (left**2).sum(axis=0) / max(len(x) - _SMOOTH_TERMS, 1)
    return np.asarray((explained**2).sum(axis=0) / np.maximum(scale, 1e-300))


class _Residuals(Protocol):
    """Residuals (2N,) of a panel's corners and their derivatives (2N, 6 or more) by its pose."""

    @property
    def residual(self) -> FloatArray: ...
    @property
    def jacobian(self) -> FloatArray: ...


def smooth_factor(corners: Sequence[PanelCorners], found: Sequence[_Residuals]) -> float:
    """By how much quadratic parts of the corners' residuals, which no pose explains, exceed the noise; at least 1.

    What bends the residuals over a panel (lens, intrinsics, a plate that is not flat) also shifts and tilts them, where
    it is not seen: the shifts are taken to be as much above the noise as the bends are. One number for all panels, 1
    unless it is significant.
    """
    squares = [_smooth_squares(c, f) for c, f in zip(corners, found, strict=True) if len(c.pixels) >= 12]
    count = sum(n for _, n in squares)
    if not count:
        return 1.0
    ratio = sum(s for s, _ in squares) / count
    return ratio if ratio > 1.0 + (_SIGNIFICANT_SMOOTH - 1.0) * np.sqrt(24.0 / count) and ratio > 1.2 else 1.0


def _smooth_squares(corners: PanelCorners, found: _Residuals) -> tuple[float, int]:
    """Sum of squares of the quadratic terms over the mean square of the rest, and the number of terms."""
    xy = corners.corners_panel[:, :2]
    xy = 2.0 * (xy - xy.min(axis=0)) / np.maximum(np.ptp(xy, axis=0), 1e-12) - 1.0
    powers = [(i, j) for i in range(_SMOOTH_DEGREE + 1) for j in range(_SMOOTH_DEGREE + 1 - i)]
    terms = np.column_stack([xy[:, 0] ** i * xy[:, 1] ** j for i, j in powers])
    shape = np.zeros((2 * len(xy), 2 * len(powers)))
    shape[0::2, : len(powers)] = shape[1::2, len(powers) :] = terms
    by_pose = np.linalg.qr(found.jacobian[:, :6])[0]
    U, values, _ = np.linalg.svd(shape - by_pose @ (by_pose.T @ shape), full_matrices=False)
    U = U[:, values > 1e-6 * values[0]]
    residual = _clipped(found.residual)
    residual = residual - by_pose @ (by_pose.T @ residual)
    smooth = U.T @ residual
    rest = residual - U @ smooth
    scale = float(rest @ rest) / max(len(rest) - U.shape[1] - 6, 1)
    return float(smooth @ smooth) / max(scale, 1e-300), U.shape[1]


def _clipped(residual: FloatArray) -> FloatArray:
    """Residuals without outliers, which would pass for bends."""
    limit = 4.0 * 1.4826 * float(np.median(np.abs(residual)))
    return np.asarray(np.clip(residual, -limit, limit))
