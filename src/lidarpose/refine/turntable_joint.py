"""The joint estimate of a turntable session: one robust maximum-likelihood solution over all places.

Corners, stripe pixels and ranges together determine each panel's pose, the turntable's axis and the LiDAR's mounting.
Gauss-Newton steps with damping, weights of a redescending loss, and variance components that are estimated along the
way: one factor on the stated standard deviations a kind, and the variance of what whole lines are off by
(docs/methods-joint.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.robust import huber_weights, mad_sigma
from lidarpose.model.turntable_result import Kind
from lidarpose.refine.drift import Drift, drift, smooth_factor
from lidarpose.refine.joint_equations import (
    COMMON_CORNER_SIGMAS_PX,
    CornerNoise,
    Linearised,
    LineNoise,
    Moments,
    Noise,
    all_moments,
    corner_weight,
    linearise,
    lines_of,
    moved,
    normal_equations,
    row_weight,
    sum_of_squares,
)
from lidarpose.refine.joint_options import JointOptions
from lidarpose.refine.least_squares import (
    SQRT3,
    LineEffects,
    NormalEquations,
    covariance_and_condition,
    line_moments,
    own_effects,
    take_out_effects,
)
from lidarpose.refine.noise import (
    growth_of_scatter,
    information_correction,
    robust_scale,
    rows_that_count_as_one,
    taper_weights,
)
from lidarpose.refine.place_effects import PlaceEffects, place_effects
from lidarpose.refine.turntable_layout import JointData, Lines, thinned
from lidarpose.refine.turntable_parameters import EXTRAS, N_GLOBAL, N_MOTION
from lidarpose.refine.turntable_residuals import LineResiduals
from lidarpose.refine.turntable_state import JointState


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged (or given up) joint estimate in the internal parameters.

    Attributes
    ----------
    covariance : (n, n)
        Of the active internal parameters, `active` (n,) being their indices.
    drift
        See `lidarpose.refine.drift`.
    suspicious
        The same, with lines and corners taken as independent: what explains a misfit is looked for there, for the
        misfit itself is not the noise.
    """

    data: JointData
    at: Linearised
    noise: Noise
    equations: NormalEquations
    active: IntArray
    covariance: FloatArray
    condition_number: float
    weakest: FloatArray
    iterations: int
    converged: bool
    drift: Drift | None = None
    suspicious: Solution | None = None

    @property
    def state(self) -> JointState:
        return self.at.state

    @cached_property
    def moments(self) -> Moments:
        """Of all lines, at the estimate."""
        return all_moments(self.data, self.at, self.noise)


def solve_joint(data: JointData, start: JointState, options: JointOptions) -> Solution:
    """Iterate to the estimate.

    Raises
    ------
    UndeterminedError
        If there is no panel or no scan line to work from.
    """
    _require_enough(data)
    active = active_parameters(data, options.estimate)
    solution = _solve(data, start, active, options.max_iterations, with_places=True)
    sharp = Noise(
        replace(solution.noise.corners, smooth_factor=1.0, common_sigmas_px=()),
        {kind: replace(n, rows_as_one=1.0) for kind, n in solution.noise.lines.items()},
    )
    plain = _finish(data, solution.at, sharp, active, solution.iterations, solution.converged, pay=False)
    if solution.drift is None or solution.drift.ratio < _NOT_RANDOM:
        return replace(solution, suspicious=plain)
    # Lines that drift like this are off by no random amount of their own: with that for a model the corners alone would
    # lead the estimate away. The lines keep their full weight then, and the covariance pays for the drift.
    full_weight = _solve(data, start, active, options.max_iterations, with_places=False)
    return replace(full_weight, suspicious=plain)


def at_stated_noise(data: JointData, state: JointState) -> Solution:
    """Information and covariance at a state, with all standard deviations as they are stated: nothing is estimated.

    Raises UndeterminedError as `solve_joint` does.
    """
    _require_enough(data)
    at = linearise(data, state)
    lines = {
        kind: LineNoise(1.0, 0.0, np.ones(len(r.residual)), np.ones(lines_of(data, kind).count))
        for kind, r in at.lines.items()
    }
    corners = CornerNoise(
        1.0, tuple(np.ones(len(c.residual)) for c in at.corners), common_sigmas_px=COMMON_CORNER_SIGMAS_PX
    )
    active = active_parameters(data, ())
    return _finish(data, at, Noise(corners, lines), active, 0, True, pay=False)


_COARSE_ROWS = 32
_NOT_RANDOM = 8.0


def _solve(data: JointData, start: JointState, active: IntArray, max_iterations: int, *, with_places: bool) -> Solution:
    rows = len(data.stripes.pixels) + len(data.ranges.range_m)
    state, spent, earlier = start, 0, None
    if rows > 2 * _COARSE_ROWS * (data.stripes.lines.count + data.ranges.lines.count):
        # Most of the way on few rows of each line; the last steps on all of them.
        few = thinned(data, _COARSE_ROWS)
        coarse = _iterate(few, start, active, max_iterations, None, with_places)
        # How many neighbouring rows are worth one is found anew where others are neighbours.
        noise = replace(coarse.noise, lines={k: replace(n, rows_as_one=1.0) for k, n in coarse.noise.lines.items()})
        state, spent, earlier = coarse.at.state, coarse.iterations, noise
        data = _with_growth(data, _growth(data, _among_all(data, coarse, active)))
    done = _iterate(data, state, active, max_iterations, earlier, with_places)
    if earlier is None:
        growth = _growth(data, done)
        if any(power != 1.0 for power in growth.values()):
            data, spent = _with_growth(data, growth), done.iterations
            done = _iterate(data, done.at.state, active, max_iterations, done.noise, with_places)
    noise = done.noise
    if not with_places:
        moments = all_moments(data, done.at, noise)
        information = _restricted(normal_equations(data, done.at, noise, moments), active).information
        noise = update_noise(data, done.at, noise, moments, information, active, soft=False, with_places=True)
    whole = linearise(data, done.at.state)
    return _finish(data, whole, noise, active, spent + done.iterations, done.converged)


def _among_all(data: JointData, coarse: _Progress, active: IntArray) -> _Progress:
    """An estimate on few rows, as it lies among all rows."""
    at = linearise(data, coarse.at.state, active)
    return replace(coarse, at=at, noise=carried_over(data, at, coarse.noise))


def _growth(data: JointData, done: _Progress) -> dict[Kind, float]:
    """By kind, the power of the stated standard deviations with which scatter grows."""
    found: dict[Kind, float] = {}
    for kind, residuals in done.at.lines.items():
        lines, noise = lines_of(data, kind), done.noise.lines[kind]
        moments = line_moments(residuals.columns, row_weight(lines, residuals, noise), lines.start)
        _, effects = take_out_effects(moments, noise.place_variance)
        use = residuals.valid & (noise.line_weights[lines.line_of_row] > 0.0) & (noise.row_weights > 0.0)
        z = _without_effects(lines, residuals, effects)[use] / (lines.sigma[use] * noise.factor)
        found[kind] = growth_of_scatter(z, lines.sigma[use])
    return found


def _with_growth(data: JointData, growth: Mapping[Kind, float]) -> JointData:
    stripes, ranges = data.stripes, data.ranges
    return replace(
        data,
        stripes=replace(stripes, lines=stripes.lines.with_growth(growth.get("stripes", 1.0))),
        ranges=replace(ranges, lines=ranges.lines.with_growth(growth.get("ranges", 1.0))),
    )


@dataclass(frozen=True, eq=False)
class _Progress:
    at: Linearised
    noise: Noise
    iterations: int
    converged: bool


def _iterate(
    data: JointData,
    start: JointState,
    active: IntArray,
    max_iterations: int,
    earlier: Noise | None,
    with_places: bool,
) -> _Progress:
    """Steps until neither parameters nor noise move. `earlier`: the noise of a nearly finished estimate."""
    at = linearise(data, start, active)
    noise = first_noise(data, at) if earlier is None else carried_over(data, at, earlier)
    soft_until, least = (_SOFT_STEPS, _SOFT_STEPS) if earlier is None else (0, 2)
    damping, calm, iteration, places = 1e-6, 0, 0, with_places and earlier is not None
    moments = all_moments(data, at, noise)
    for iteration in range(1, max_iterations + 1):
        equations = _restricted(normal_equations(data, at, noise, moments), active)
        at, moments, damping, decrease = _damped_step(data, at, noise, moments, equations, active, damping)
        old, soft = noise, iteration <= soft_until
        noise = update_noise(data, at, noise, moments, equations.information, active, soft=soft, with_places=places)
        moments = all_moments(data, at, noise)
        calm = calm + 1 if decrease < 1e-3 and _noise_change(old, noise) < 1e-2 else 0
        # What whole lines are off by can be told once all else has settled.
        if with_places and not places and not soft and (calm or iteration >= _STEPS_WITHOUT_PLACES):
            places, calm = True, 0
        if calm >= (2 if earlier is None else 1) and iteration >= least:
            return _Progress(at, noise, iteration, True)
    return _Progress(at, noise, iteration, False)


_SOFT_STEPS = 3
"""First steps that take Huber's weights."""
_STEPS_WITHOUT_PLACES = 7


def _require_enough(data: JointData) -> None:
    if not data.slots:
        raise UndeterminedError(
            "no panel of the board was found in the image of any placement that the scans saw",
            remedy="Check the board's numbers of columns and rows, and record a sharp image of the whole board.",
        )
    if not data.ranges.lines.count:
        raise UndeterminedError(
            "no scan line lies on a panel, so nothing ties the LiDAR to the camera",
            remedy="Turn the LiDAR so that its scan crosses the board at three or more readings of the turntable.",
        )


def active_parameters(data: JointData, estimate: tuple[str, ...]) -> IntArray:
    """Indices of the parameters that are estimated: ten, the chosen extras, six a panel."""
    extras = [N_MOTION + i for i, name in enumerate(EXTRAS) if name in estimate]
    panels = range(N_GLOBAL, N_GLOBAL + 6 * len(data.slots))
    return np.array([*range(N_MOTION), *extras, *panels])


def _restricted(equations: NormalEquations, active: IntArray) -> NormalEquations:
    return NormalEquations(
        equations.information[np.ix_(active, active)], equations.gradient[active], equations.sum_of_squares
    )


def _damped_step(
    data: JointData,
    at: Linearised,
    noise: Noise,
    moments: Moments,
    equations: NormalEquations,
    active: IntArray,
    damping: float,
) -> tuple[Linearised, Moments, float, float]:
    """One accepted step, or none: the new point, its moments, the next damping, and how much the cost was to fall."""
    for _ in range(12):
        step = equations.solve(damping)
        full = np.zeros(N_GLOBAL + 6 * len(data.slots))
        full[active] = step
        expected = float(step @ equations.gradient)
        state, strayed = at.state.moved(full, data.centres), at.strayed + float(np.abs(step).max())
        if strayed < _STRAIGHT:
            new, new_moments = moved(data, at, state, full, moments, strayed)
        else:
            new = linearise(data, state, active)
            new_moments = all_moments(data, new, noise)
        cost = sum_of_squares(data, new, noise, new_moments)
        if cost <= equations.sum_of_squares * (1.0 + 1e-9) + 1e-9:
            return new, new_moments, max(damping * 0.1, 1e-12), expected
        if expected < 1e-6:
            break
        damping = max(damping, 1e-9) * 10.0
    return at, moments, damping, 0.0


_STRAIGHT = 1e-4
"""Steps that lead no further than this (m, rad) since derivatives were taken are taken to first order: the second order
moves a line some metres away by less than a ten-thousandth of a millimetre."""


# --- variance components --------------------------------------------------------------------------------------------


def first_noise(data: JointData, at: Linearised) -> Noise:
    """Factors from the median absolute deviations at the start, Huber's weights."""
    lines: dict[Kind, LineNoise] = {}
    for kind, residuals in at.lines.items():
        layout = lines_of(data, kind)
        z = np.where(residuals.valid, residuals.residual / layout.sigma, 0.0)
        factor = _floor(mad_sigma(z[residuals.valid], centred=True), kind, layout.sigma)
        lines[kind] = LineNoise(factor, 0.0, huber_weights(z / factor), np.ones(layout.count))
    z_corners = _standardised_corners(data, at)
    factor = _floor(mad_sigma(np.concatenate(z_corners), centred=True), "corners", _corner_sigmas(data))
    return Noise(CornerNoise(factor, tuple(huber_weights(z / factor) for z in z_corners)), lines)


_LEAST_SIGMA: dict[Kind, float] = {"corners": 1e-3, "stripes": 1e-3, "ranges": 1e-6}
"""px, px and m: no instrument is better. Perfect data must neither divide by zero nor, where one kind alone is perfect,
make the equations so uneven that they cannot be solved."""


def _floor(factor: float, kind: Kind, stated_sigma: FloatArray) -> float:
    if not np.isfinite(factor):
        return 1.0
    finite = stated_sigma[np.isfinite(stated_sigma)]
    return max(factor, _LEAST_SIGMA[kind] / float(np.median(finite))) if len(finite) else max(factor, 1e-9)


def _corner_sigmas(data: JointData) -> FloatArray:
    return np.concatenate([corners.sigma_px for corners in data.corners])


def _standardised_corners(data: JointData, at: Linearised) -> list[FloatArray]:
    return [c.residual / np.repeat(data.corners[k].sigma_px, 2) for k, c in enumerate(at.corners)]


def carried_over(data: JointData, at: Linearised, earlier: Noise) -> Noise:
    """The noise of an estimate on fewer rows, with weights for all rows."""
    lines: dict[Kind, LineNoise] = {}
    for kind, residuals in at.lines.items():
        layout, known = lines_of(data, kind), earlier.lines[kind]
        weights = np.ones(len(residuals.residual))
        rough = replace(known, row_weights=weights)
        moments = line_moments(residuals.columns, row_weight(layout, residuals, rough), layout.start)
        _, effects = take_out_effects(moments, known.place_variance)
        z = _without_effects(layout, residuals, effects) / (layout.sigma * known.factor)
        lines[kind] = replace(known, row_weights=taper_weights(z))
    return Noise(earlier.corners, lines)


def _without_effects(lines: Lines, residuals: LineResiduals, effects: LineEffects) -> FloatArray:
    """Residuals (N,) less the predicted shift and slope of their lines."""
    return _less(lines, residuals, effects.predicted)


def _less(lines: Lines, residuals: LineResiduals, of_line: FloatArray) -> FloatArray:
    """Residuals (N,) less a shift and a slope (S, 2) of their lines."""
    row = lines.line_of_row
    out = lines.along * (SQRT3 * of_line[:, 1])[row]
    out += of_line[:, 0][row]
    return np.asarray(np.subtract(residuals.residual, out, out=out))


def update_noise(
    data: JointData,
    at: Linearised,
    noise: Noise,
    moments: Moments,
    information: FloatArray,
    active: IntArray,
    *,
    soft: bool,
    with_places: bool,
) -> Noise:
    """New factors, place variances and weights at the present residuals.

    `moments` and `information` (n, n) on the active parameters are those of the old noise.
    """
    covariance, _, _ = covariance_and_condition(information)
    full = np.zeros((N_GLOBAL + 6 * len(data.slots),) * 2)
    full[np.ix_(active, active)] = covariance
    lines: dict[Kind, LineNoise] = {}
    for kind, residuals in at.lines.items():
        lines[kind] = _update_lines(
            kind, lines_of(data, kind), residuals, noise.lines[kind], moments[kind], full, soft, with_places
        )
    return Noise(_update_corners(data, at, noise.corners, full, soft), lines)


def _update_corners(
    data: JointData, at: Linearised, noise: CornerNoise, covariance: FloatArray, soft: bool
) -> CornerNoise:
    z = _standardised_corners(data, at)
    together = np.concatenate(z)
    paid = 0.0
    for k, corner in enumerate(at.corners):
        own = slice(N_GLOBAL + 6 * k, N_GLOBAL + 6 * k + 6)
        J = corner.jacobian[:, :6]
        weight = corner_weight(data, noise, k)
        paid += float(np.einsum("ij,ij->", J.T @ (weight[:, None] * J), covariance[own, own]))
    factor, weights = robust_scale(together, min(paid, 6.0 * len(z)))
    factor = _floor(factor, "corners", _corner_sigmas(data))
    if soft:
        weights = huber_weights(together / factor)
    correction = 1.0 if soft else information_correction(together / factor, weights)
    cuts = np.cumsum([len(each) for each in z])[:-1]
    return CornerNoise(factor, tuple(np.split(weights, cuts)), correction, 1.0, COMMON_CORNER_SIGMAS_PX)


def _update_lines(
    kind: Kind,
    lines: Lines,
    residuals: LineResiduals,
    noise: LineNoise,
    moments: FloatArray,
    covariance: FloatArray,
    soft: bool,
    with_places: bool,
) -> LineNoise:
    spread = parameter_spread(residuals, lines, moments, covariance)
    places = PlaceEffects(0.0, np.ones(lines.count))
    if with_places:
        places = place_effects(moments, spread, noise.place_variance)
    variance, line_weights = places.variance, places.weight
    reduced, effects = take_out_effects(moments, variance)
    own = _without_effects(lines, residuals, effects)
    use = residuals.valid & (line_weights[lines.line_of_row] > 0.0)
    # Rows that say the same over again lose as much freedom as if each stood for itself.
    paid = noise.rows_as_one * float(np.einsum("sij,sij->", reduced[:, :-1, :-1], spread))
    paid += noise.rows_as_one * _effect_freedom(effects, variance)
    z = own / lines.sigma
    factor, used_weights = robust_scale(z[use], min(paid, 0.5 * use.sum()))
    factor = _floor(factor, kind, lines.sigma)
    row_weights = np.zeros(len(z))
    row_weights[use] = huber_weights(z[use] / factor) if soft else used_weights
    dropped = residuals.valid & ~use
    # Full weights within a line that was dropped: whether it stays out must not depend on its being out.
    row_weights[dropped] = 1.0
    correction = 1.0 if soft else information_correction(z[use] / factor, used_weights)
    as_one = noise.rows_as_one
    if with_places:
        by_line, good = own_effects(moments)
        psi = np.where(use & good[lines.line_of_row], row_weights * _less(lines, residuals, by_line) / lines.sigma, 0.0)
        found = rows_that_count_as_one(psi, lines.line_of_row, 2.0 * lines.count)
        # Half-way once it is known: weights and correlations follow each other.
        as_one = found if as_one == 1.0 else 0.5 * (as_one + found)
    return LineNoise(
        factor, variance, row_weights, line_weights, correction, noise.neighbour_factor, as_one, places.certainty_factor
    )


def parameter_spread(residuals: LineResiduals, lines: Lines, moments: FloatArray, covariance: FloatArray) -> FloatArray:
    """What the parameters' uncertainty does to lines: covariance (S, b, b) of the basis' coefficients."""
    out = np.empty((lines.count, residuals.basis.shape[1], residuals.basis.shape[1]))
    for k in np.unique(lines.slot):
        mine = lines.slot == k
        index = np.array([*range(N_GLOBAL), *range(N_GLOBAL + 6 * k, N_GLOBAL + 6 * k + 6)])
        to = residuals.to_parameters[mine]
        out[mine] = to @ covariance[np.ix_(index, index)] @ np.swapaxes(to, 1, 2)
    return out


def _effect_freedom(effects: LineEffects, variance: float) -> float:
    """Degrees of freedom of the rows that the predicted shifts and slopes take."""
    if variance <= 0.0:
        return 0.0
    return float(2.0 * len(effects.shrink) - np.trace(effects.shrink, axis1=1, axis2=2).sum() / variance)


def _noise_change(a: Noise, b: Noise) -> float:
    change = abs(a.corners.factor / b.corners.factor - 1.0)
    for kind, old in a.lines.items():
        new = b.lines[kind]
        change = max(change, abs(old.factor / new.factor - 1.0), 0.1 * abs(old.rows_as_one / new.rows_as_one - 1.0))
        larger = max(old.place_variance, new.place_variance)
        if larger > 0.0:
            change = max(change, 0.1 * abs(old.place_variance - new.place_variance) / larger)
        change = max(change, 0.1 * float(np.abs(old.line_weights - new.line_weights).max(initial=0.0)))
    return change


def _finish(
    data: JointData,
    at: Linearised,
    noise: Noise,
    active: IntArray,
    iterations: int,
    converged: bool,
    *,
    pay: bool = True,
) -> Solution:
    moments = all_moments(data, at, noise)
    found = drift(data, moments, {kind: n.line_weights for kind, n in noise.lines.items()})
    factor = found.inflation if found is not None and pay else 1.0
    prices = {k: factor * (n.certainty_factor if pay else 1.0) for k, n in noise.lines.items()}
    noise = replace(noise, lines={k: replace(n, neighbour_factor=prices[k]) for k, n in noise.lines.items()})
    if pay:
        # Bent corners are paid for in the covariance alone: with less weight they would let the panels drift away.
        bent = max(noise.corners.smooth_factor, smooth_factor(data.corners, at.corners))
        noise = replace(noise, corners=replace(noise.corners, smooth_factor=bent))
    equations = normal_equations(data, at, noise, moments)
    covariance, condition, weakest = covariance_and_condition(equations.information[np.ix_(active, active)])
    return Solution(data, at, noise, equations, active, covariance, condition, weakest, iterations, converged, found)
