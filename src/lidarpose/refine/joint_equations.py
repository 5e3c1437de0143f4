"""The joint estimate of a turntable session at one state: residuals with their derivatives, moments of its lines, the
noise, and the normal equations that follow (docs/methods-joint.md)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.model.turntable_result import Kind
from lidarpose.refine.least_squares import (
    NormalEquations,
    add_lines,
    line_moments,
    moved_moments,
    take_out_effects,
)
from lidarpose.refine.turntable_layout import JointData, Lines
from lidarpose.refine.turntable_parameters import CAMERA_EXTRAS, N_GLOBAL, RANGE_EXTRAS
from lidarpose.refine.turntable_residuals import (
    CornerResiduals,
    Frames,
    LineResiduals,
    corner_residuals,
    range_residuals,
    stripe_residuals,
)
from lidarpose.refine.turntable_state import JointState

Moments = dict[Kind, FloatArray]
"""By kind: `line_moments` (S, b + 3, b + 3)."""


@dataclass(frozen=True, eq=False)
class LineNoise:
    """Noise of one kind of lines: factor on the stated sigma, variance of a line's shift and slope, weights.

    `rows_as_one`: how many neighbouring rows are worth one. `certainty_factor`: what the variance of whole lines costs
    for being estimated from few of them, see `PlaceEffects`.
    """

    factor: float
    place_variance: float
    row_weights: FloatArray
    line_weights: FloatArray
    correction: float = 1.0
    neighbour_factor: float = 1.0
    rows_as_one: float = 1.0
    certainty_factor: float = 1.0


@dataclass(frozen=True, eq=False)
class CornerNoise:
    """Noise of corners: factor on the stated sigma, weights, how far smooth parts of the residuals exceed it, and the
    standard deviations of what all corners of a panel are off by together (`JointData.common_corner_modes`)."""

    factor: float
    weights: tuple[FloatArray, ...]
    correction: float = 1.0
    smooth_factor: float = 1.0
    common_sigmas_px: tuple[float, ...] = ()


@dataclass(frozen=True, eq=False)
class Noise:
    """All variance components and weights."""

    corners: CornerNoise
    lines: Mapping[Kind, LineNoise]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals and derivatives at one state.

    `strayed`: how far small steps have led since the derivatives were taken (m, rad and the extras' units), at most.
    """

    state: JointState
    corners: tuple[CornerResiduals, ...]
    lines: Mapping[Kind, LineResiduals]
    strayed: float = 0.0


COMMON_CORNER_SIGMAS_PX = (0.0016, 0.0016, 0.0009)
"""What all corners of a panel are off by together: in x, in y, and away from the middle (root mean square). It looks
like a board elsewhere, so no residual shows it. Measured against the truth on 946 rendered panels (images of 1100 to
1624 px, corners that scatter by 0.014 px); a turn in the image and a stretch along one diagonal show nothing beyond
scatter. 0.7 of the shift is the same in all placements of a session."""


def lines_of(data: JointData, kind: Kind) -> Lines:
    return data.stripes.lines if kind == "stripes" else data.ranges.lines


def linearise(data: JointData, state: JointState, active: IntArray | None = None) -> Linearised:
    """Residuals and derivatives at a state; of lines by the `active` parameters only, if these are given."""
    frames = Frames.at(data, state)
    extras = {*CAMERA_EXTRAS, *RANGE_EXTRAS} if active is None else set(active.tolist())
    lines: dict[Kind, LineResiduals] = {}
    if data.stripes.lines.count:
        lines["stripes"] = stripe_residuals(data, state, frames, of_camera=not extras.isdisjoint(CAMERA_EXTRAS))
    if data.ranges.lines.count:
        lines["ranges"] = range_residuals(data, state, frames, extras=extras)
    return Linearised(state, tuple(corner_residuals(data, state, k) for k in range(len(data.slots))), lines)


def moved(
    data: JointData, at: Linearised, state: JointState, step: FloatArray, moments: Moments, strayed: float
) -> tuple[Linearised, Moments]:
    """Residuals and moments after a small step (n,) of all parameters to a state, to first order."""
    lines: dict[Kind, LineResiduals] = {}
    found: Moments = {}
    for kind, residuals in at.lines.items():
        layout = lines_of(data, kind)
        shift = residuals.shift_by(step, layout.slot)
        lines[kind] = residuals.moved(shift, layout.line_of_row)
        found[kind] = moved_moments(moments[kind], shift)
    return Linearised(state, tuple(c.moved(step, k) for k, c in enumerate(at.corners)), lines, strayed), found


def row_weight(lines: Lines, residuals: LineResiduals, noise: LineNoise) -> FloatArray:
    return np.asarray(
        np.where(residuals.valid, noise.row_weights / (noise.rows_as_one * (lines.sigma * noise.factor) ** 2), 0.0)
    )


def all_moments(data: JointData, at: Linearised, noise: Noise) -> Moments:
    """Moments of all lines, by kind, at the noise as it is known."""
    out: Moments = {}
    for kind, residuals in at.lines.items():
        lines = lines_of(data, kind)
        weight = row_weight(lines, residuals, noise.lines[kind])
        out[kind] = line_moments(residuals.columns, weight, lines.start)
    return out


def reduced_moments(moments: FloatArray, noise: LineNoise) -> FloatArray:
    reduced, _ = take_out_effects(moments, noise.place_variance)
    scale = noise.line_weights * noise.correction / noise.neighbour_factor
    return np.asarray(reduced * scale[:, None, None])


def corner_weight(data: JointData, noise: CornerNoise, k: int) -> FloatArray:
    sigma = np.repeat(data.corners[k].sigma_px, 2)
    return np.asarray(noise.weights[k] * noise.correction / (noise.smooth_factor * (sigma * noise.factor) ** 2))


def _add_corners(
    data: JointData, at: Linearised, noise: CornerNoise, into: tuple[FloatArray, FloatArray] | None = None
) -> float:
    """Add corners' normal equations to (information, gradient), if given; return their weighted sum of squares.

    What all corners of a panel are off by together, the same in all of its placements, is integrated out.
    """
    n, total = N_GLOBAL + 6 * len(data.slots), 0.0
    shared = {slot.panel: (np.zeros((n, 3)), np.zeros((3, 3)), np.zeros(3)) for slot in data.slots}
    for k, (slot, corner) in enumerate(zip(data.slots, at.corners, strict=True)):
        weight = corner_weight(data, noise, k)
        coupling, own, pull = shared[slot.panel]
        modes = weight[:, None] * data.common_corner_modes[k]
        own += data.common_corner_modes[k].T @ modes
        pull += modes.T @ corner.residual
        total += float(weight @ corner.residual**2)
        if into is not None:
            information, gradient = into
            columns = [*range(N_GLOBAL + 6 * k, N_GLOBAL + 6 * k + 6), *CAMERA_EXTRAS]
            weighted = weight[:, None] * corner.jacobian
            information[np.ix_(columns, columns)] += corner.jacobian.T @ weighted
            gradient[columns] -= weighted.T @ corner.residual
            coupling[columns] += corner.jacobian.T @ modes
    if noise.common_sigmas_px:
        for coupling, own, pull in shared.values():
            shrink = np.linalg.inv(own + np.diag(1.0 / np.square(noise.common_sigmas_px)))
            total -= float(pull @ shrink @ pull)
            if into is not None:
                into[0][...] -= coupling @ shrink @ coupling.T
                into[1][...] += coupling @ shrink @ pull
    return total


def normal_equations(data: JointData, at: Linearised, noise: Noise, moments: Moments) -> NormalEquations:
    """Of all parameters, active or not, at the noise as it is known."""
    n = N_GLOBAL + 6 * len(data.slots)
    information, gradient = np.zeros((n, n)), np.zeros(n)
    total = _add_corners(data, at, noise.corners, (information, gradient))
    for kind, residuals in at.lines.items():
        reduced = reduced_moments(moments[kind], noise.lines[kind])
        slot = lines_of(data, kind).slot
        total += add_lines(reduced, residuals.to_parameters, slot, N_GLOBAL, (information, gradient))
    return NormalEquations(information, gradient, total)


def sum_of_squares(data: JointData, at: Linearised, noise: Noise, moments: Moments) -> float:
    """The weighted sum of squares alone, for accepting a step."""
    total = _add_corners(data, at, noise.corners)
    for kind in at.lines:
        total += float(reduced_moments(moments[kind], noise.lines[kind])[:, -1, -1].sum())
    return total
