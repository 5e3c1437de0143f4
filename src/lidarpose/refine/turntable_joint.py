"""The joint estimate of a turntable session: one robust maximum-likelihood solution over all places.

Corners, stripe pixels and ranges together determine each panel's pose, the turntable's axis and the LiDAR's mounting.
Gauss-Newton steps with damping, weights of a redescending loss, and variance components that are estimated along the way:
one factor on the stated standard deviations a kind, and the variance of what whole lines are off by (see
docs/methods-joint.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.robust import huber_weights, mad_sigma
from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import TurntableObservations
from lidarpose.model.turntable import TurntableMotion
from lidarpose.model.turntable_result import Kind
from lidarpose.refine.least_squares import (
    LineEffects,
    NormalEquations,
    add_lines,
    covariance_and_condition,
    line_moments,
    take_out_effects,
)
from lidarpose.refine.noise import information_correction, robust_scale
from lidarpose.refine.turntable_model import (
    EXTRAS,
    N_GLOBAL,
    N_MOTION,
    CornerResiduals,
    JointData,
    JointState,
    LineResiduals,
    Lines,
    corner_residuals,
    lay_out,
    range_residuals,
    start_state,
    stripe_residuals,
)

Start = tuple[TurntableMotion, Mapping[str, tuple[Pose | None, ...]]]

_FOCAL = EXTRAS.index("focal_scale")
_LINE_REJECT = 36.0
"""A line whose shift and slope have this chi-square of two degrees of freedom (6 sigma) or more is left out."""


@dataclass(frozen=True)
class JointOptions:
    """What to estimate beside the 22 numbers, and what the user wants.

    Attributes
    ----------
    estimate
        Extra parameters, names of `lidarpose.refine.turntable_model.EXTRAS`.
    use_stripes
        False: work from boards and scans alone.
    want_mm, want_deg
        The standard deviation of position and orientation, inside the recorded arc, that still counts as good.
    max_iterations
        Of the solver.
    restart
        Makes a start from observations; lets the search for contradictions try alternatives (a scan reversed, panels
        swapped) from a start of their own. The workflow gives the closed form.
    search_alternatives
        Whether to look for an explanation when the residuals are bad.
    """

    estimate: tuple[str, ...] = ()
    use_stripes: bool = True
    want_mm: float = 2.0
    want_deg: float = 0.2
    max_iterations: int = 60
    restart: Callable[[TurntableObservations], Start] | None = None
    search_alternatives: bool = True

    def __post_init__(self) -> None:
        unknown = [name for name in self.estimate if name not in EXTRAS]
        if unknown:
            raise ValueError(f"unknown parameter {unknown[0]!r}; known are {', '.join(EXTRAS)}")
        if not (self.want_mm > 0.0 and self.want_deg > 0.0):
            raise ValueError("the wanted standard deviations must be positive")


@dataclass(frozen=True, eq=False)
class LineNoise:
    """Noise of one kind of lines: factor on the stated sigma, variance of a line's shift and slope, weights."""

    factor: float
    place_variance: float
    row_weights: FloatArray
    line_weights: FloatArray
    correction: float = 1.0
    neighbour_factor: float = 1.0


@dataclass(frozen=True, eq=False)
class CornerNoise:
    factor: float
    weights: tuple[FloatArray, ...]
    correction: float = 1.0


@dataclass(frozen=True, eq=False)
class Noise:
    """All variance components and weights."""

    corners: CornerNoise
    lines: Mapping[Kind, LineNoise]


@dataclass(frozen=True, eq=False)
class Linearised:
    """Residuals and derivatives at one state."""

    state: JointState
    corners: tuple[CornerResiduals, ...]
    lines: Mapping[Kind, LineResiduals]


@dataclass(frozen=True, eq=False)
class Solution:
    """A converged (or given up) joint estimate in the internal parameters.

    Attributes
    ----------
    covariance : (n, n)
        Of the active internal parameters, `active` (n,) being their indices.
    """

    data: JointData
    at: Linearised
    noise: Noise
    equations: NormalEquations
    active: FloatArray
    covariance: FloatArray
    condition_number: float
    weakest: FloatArray
    iterations: int
    converged: bool
    redundancy: Mapping[Kind, float] = field(default_factory=dict)

    @property
    def state(self) -> JointState:
        return self.at.state


def lines_of(data: JointData, kind: Kind) -> Lines:
    return data.stripes.lines if kind == "stripes" else data.ranges.lines


def linearise(data: JointData, state: JointState) -> Linearised:
    lines: dict[Kind, LineResiduals] = {}
    if data.stripes.lines.count:
        lines["stripes"] = stripe_residuals(data, state)
    if data.ranges.lines.count:
        lines["ranges"] = range_residuals(data, state)
    return Linearised(state, tuple(corner_residuals(data, state, k) for k in range(len(data.slots))), lines)


def solve_joint(data: JointData, start: JointState, options: JointOptions) -> Solution:
    """Iterate to the estimate.

    Raises
    ------
    UndeterminedError
        If there is no panel or no scan line to work from.
    """
    _require_enough(data)
    active = active_parameters(data, options.estimate)
    at = linearise(data, start)
    noise = first_noise(data, at)
    damping, converged, iteration, calm = 1e-6, False, 0, 0
    for iteration in range(1, options.max_iterations + 1):
        equations = normal_equations(data, at, noise)
        reduced = _restricted(equations, active)
        at, damping, decrease = _damped_step(data, at, noise, reduced, active, damping)
        old = noise
        noise = update_noise(data, at, noise, active, soft=iteration <= 3, with_places=iteration >= 3)
        calm = calm + 1 if decrease < 1e-5 and _noise_change(old, noise) < 2e-3 else 0
        if calm >= 2 and iteration > 5:
            converged = True
            break
    return _finish(data, at, noise, active, iteration, converged)


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


def active_parameters(data: JointData, estimate: tuple[str, ...]) -> FloatArray:
    """Indices of the parameters that are estimated: ten, the chosen extras, six a panel."""
    extras = [N_MOTION + i for i, name in enumerate(EXTRAS) if name in estimate]
    panels = range(N_GLOBAL, N_GLOBAL + 6 * len(data.slots))
    return np.array([*range(N_MOTION), *extras, *panels])


def _restricted(equations: NormalEquations, active: FloatArray) -> NormalEquations:
    return NormalEquations(
        equations.information[np.ix_(active, active)], equations.gradient[active], equations.sum_of_squares
    )


def _damped_step(
    data: JointData, at: Linearised, noise: Noise, equations: NormalEquations, active: FloatArray, damping: float
) -> tuple[Linearised, float, float]:
    """One accepted step, or none: the new point, the next damping, and how much the cost was to fall."""
    for _ in range(12):
        step = equations.solve(damping)
        full = np.zeros(N_GLOBAL + 6 * len(data.slots))
        full[active] = step
        expected = float(step @ equations.gradient)
        new = linearise(data, at.state.moved(full, data.centres))
        cost = sum_of_squares(data, new, noise)
        if cost <= equations.sum_of_squares * (1.0 + 1e-12) + 1e-9:
            return new, max(damping * 0.1, 1e-12), expected
        if expected < 1e-7 * max(1.0, equations.sum_of_squares * 1e-6):
            return at, damping, 0.0
        damping = max(damping, 1e-9) * 10.0
    return at, damping, 0.0


# --- normal equations -----------------------------------------------------------------------------------------------


def _row_weight(lines: Lines, residuals: LineResiduals, noise: LineNoise) -> FloatArray:
    return np.asarray(np.where(residuals.valid, noise.row_weights / (lines.sigma * noise.factor) ** 2, 0.0))


def _reduced_moments(lines: Lines, residuals: LineResiduals, noise: LineNoise) -> tuple[FloatArray, LineEffects]:
    weight = _row_weight(lines, residuals, noise)
    moments = line_moments(residuals.basis, lines.along, residuals.residual, weight, lines.start)
    reduced, effects = take_out_effects(moments, noise.place_variance)
    scale = noise.line_weights * noise.correction / noise.neighbour_factor
    return reduced * scale[:, None, None], effects


def _corner_weight(data: JointData, noise: CornerNoise, k: int) -> FloatArray:
    sigma = np.repeat(data.corners[k].sigma_px, 2)
    return np.asarray(noise.weights[k] * noise.correction / (sigma * noise.factor) ** 2)


def normal_equations(data: JointData, at: Linearised, noise: Noise) -> NormalEquations:
    """Of all parameters, active or not, at the noise as it is known."""
    n = N_GLOBAL + 6 * len(data.slots)
    information, gradient, total = np.zeros((n, n)), np.zeros(n), 0.0
    for k, corner in enumerate(at.corners):
        weight = _corner_weight(data, noise.corners, k)
        columns = [*range(N_GLOBAL + 6 * k, N_GLOBAL + 6 * k + 6), N_MOTION + _FOCAL]
        information[np.ix_(columns, columns)] += corner.jacobian.T @ (weight[:, None] * corner.jacobian)
        gradient[columns] -= corner.jacobian.T @ (weight * corner.residual)
        total += float(weight @ corner.residual**2)
    for kind, residuals in at.lines.items():
        lines = lines_of(data, kind)
        reduced, _ = _reduced_moments(lines, residuals, noise.lines[kind])
        total += add_lines(reduced, residuals.to_parameters, lines.slot, N_GLOBAL, (information, gradient))
    return NormalEquations(information, gradient, total)


def sum_of_squares(data: JointData, at: Linearised, noise: Noise) -> float:
    """The weighted sum of squares alone, for accepting a step."""
    total = 0.0
    for k, corner in enumerate(at.corners):
        total += float(_corner_weight(data, noise.corners, k) @ corner.residual**2)
    for kind, residuals in at.lines.items():
        lines, noise_of = lines_of(data, kind), noise.lines[kind]
        weight = _row_weight(lines, residuals, noise_of)
        moments = line_moments(np.zeros((len(weight), 0)), lines.along, residuals.residual, weight, lines.start)
        reduced, _ = take_out_effects(moments, noise_of.place_variance)
        scale = noise_of.line_weights * noise_of.correction / noise_of.neighbour_factor
        total += float((reduced[:, 0, 0] * scale).sum())
    return total


# --- variance components --------------------------------------------------------------------------------------------


def first_noise(data: JointData, at: Linearised) -> Noise:
    """Factors from the median absolute deviations at the start, Huber's weights."""
    lines: dict[Kind, LineNoise] = {}
    for kind, residuals in at.lines.items():
        layout = lines_of(data, kind)
        z = np.where(residuals.valid, residuals.residual / layout.sigma, 0.0)
        factor = _floor(mad_sigma(z[residuals.valid], centred=True))
        lines[kind] = LineNoise(factor, 0.0, huber_weights(z / factor), np.ones(layout.count))
    z_corners = _standardised_corners(data, at)
    factor = _floor(mad_sigma(np.concatenate(z_corners), centred=True))
    return Noise(CornerNoise(factor, tuple(huber_weights(z / factor) for z in z_corners)), lines)


def _floor(factor: float) -> float:
    """Perfect data must not divide by zero: a billionth of the stated noise is the least."""
    return max(factor, 1e-9) if np.isfinite(factor) else 1.0


def _standardised_corners(data: JointData, at: Linearised) -> list[FloatArray]:
    return [c.residual / np.repeat(data.corners[k].sigma_px, 2) for k, c in enumerate(at.corners)]


def update_noise(
    data: JointData, at: Linearised, noise: Noise, active: FloatArray, *, soft: bool, with_places: bool
) -> Noise:
    """New factors, place variances and weights at the present residuals."""
    information = normal_equations(data, at, noise).information[np.ix_(active, active)]
    covariance, _, _ = covariance_and_condition(information)
    full = np.zeros((N_GLOBAL + 6 * len(data.slots),) * 2)
    full[np.ix_(active, active)] = covariance
    lines: dict[Kind, LineNoise] = {}
    for kind, residuals in at.lines.items():
        lines[kind] = _update_lines(lines_of(data, kind), residuals, noise.lines[kind], full, soft, with_places)
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
        weight = _corner_weight(data, noise, k)
        paid += float(np.einsum("ij,ij->", J.T @ (weight[:, None] * J), covariance[own, own]))
    factor, weights = robust_scale(together, min(paid, 6.0 * len(z)))
    factor = _floor(factor)
    if soft:
        weights = huber_weights(together / factor)
    correction = 1.0 if soft else information_correction(together / factor, weights)
    cuts = np.cumsum([len(each) for each in z])[:-1]
    return CornerNoise(factor, tuple(np.split(weights, cuts)), correction)


def _update_lines(
    lines: Lines, residuals: LineResiduals, noise: LineNoise, covariance: FloatArray, soft: bool, with_places: bool
) -> LineNoise:
    weight = _row_weight(lines, residuals, noise)
    moments = line_moments(residuals.basis, lines.along, residuals.residual, weight, lines.start)
    spread = _parameter_spread(residuals, lines, moments, covariance)
    place_variance, line_weights = 0.0, np.ones(lines.count)
    if with_places:
        place_variance, line_weights = _place_variance(moments, spread, noise.line_weights)
    reduced, effects = take_out_effects(moments, place_variance)
    shift = effects.predicted[lines.line_of_row]
    own = residuals.residual - shift[:, 0] - np.sqrt(3.0) * lines.along * shift[:, 1]
    use = residuals.valid & (line_weights[lines.line_of_row] > 0.0)
    paid = float(np.einsum("sij,sij->", reduced[:, :-1, :-1], spread.of_basis))
    paid += _effect_freedom(effects, place_variance)
    z = own / lines.sigma
    factor, used_weights = robust_scale(z[use], min(paid, 0.5 * use.sum()))
    factor = _floor(factor)
    row_weights = np.zeros(len(z))
    row_weights[use] = huber_weights(z[use] / factor) if soft else used_weights
    dropped = residuals.valid & ~use
    row_weights[dropped] = huber_weights(z[dropped] / factor)
    correction = 1.0 if soft else information_correction(z[use] / factor, used_weights)
    return LineNoise(factor, place_variance, row_weights, line_weights, correction)


@dataclass(frozen=True, eq=False)
class _Spread:
    """What the parameters' uncertainty does to lines: covariance (S, b, b) of the basis' coefficients."""

    of_basis: FloatArray


def _parameter_spread(
    residuals: LineResiduals, lines: Lines, moments: FloatArray, covariance: FloatArray
) -> _Spread:
    out = np.empty((lines.count, residuals.basis.shape[1], residuals.basis.shape[1]))
    for k in np.unique(lines.slot):
        mine = lines.slot == k
        index = np.array([*range(N_GLOBAL), *range(N_GLOBAL + 6 * k, N_GLOBAL + 6 * k + 6)])
        to = residuals.to_parameters[mine]
        out[mine] = to @ covariance[np.ix_(index, index)] @ np.swapaxes(to, 1, 2)
    return _Spread(out)


def _effect_freedom(effects: LineEffects, variance: float) -> float:
    """Degrees of freedom of the rows that the predicted shifts and slopes take."""
    if variance <= 0.0:
        return 0.0
    return float(2.0 * len(effects.shrink) - np.trace(effects.shrink, axis1=1, axis2=2).sum() / variance)


def _place_variance(moments: FloatArray, spread: _Spread, line_weights: FloatArray) -> tuple[float, FloatArray]:
    """The variance of lines' shifts and slopes beyond what their rows' scatter explains, and the lines' weights.

    Each line's own least-squares shift and slope (2 numbers) has the covariance V + variance * I, V from the rows; the
    parameters have absorbed part of it (redundancy). Estimated by Fisher scoring of the restricted likelihood with what
    the parameters absorbed taken as shared out evenly; set to zero unless it is significant at the 5 % level.
    """
    from scipy.stats import chi2

    S, size, _ = moments.shape
    inner = moments[:, size - 3 : size - 1, size - 3 : size - 1]
    good = np.linalg.det(inner) > 1e-12 * np.maximum(inner[:, 0, 0], 1e-300) ** 2
    if good.sum() < 3:
        return 0.0, np.ones(S)
    V = np.linalg.inv(np.where(good[:, None, None], inner, np.eye(2)))
    coupling = moments[:, size - 3 : size - 1, :]
    own = (V @ coupling[:, :, -1:])[:, :, 0]
    absorbed = V @ coupling[:, :, : size - 3]
    absorbed = absorbed @ spread.of_basis @ np.swapaxes(absorbed, 1, 2)
    variance = _robust_start(own[good], V[good])
    weights = np.ones(S)
    for _ in range(30):
        total = V + variance * np.eye(2)
        inverse = np.linalg.inv(total)
        square = np.einsum("si,sij,sj->s", own, inverse, own)
        out = good & (square > _LINE_REJECT)
        # More than a quarter of the lines cannot all be the odd ones out: then the model is wrong, not they.
        if out.sum() > 0.25 * good.sum():
            out[np.argsort(square)[: -max(int(0.25 * good.sum()), 1)]] = False
        use = good & ~out
        weights = np.where(out, 0.0, 1.0)
        freedom = np.maximum(2.0 - np.einsum("sij,sji->s", inverse, absorbed), 0.0)
        if variance == 0.0:
            threshold = float(chi2.ppf(0.95, max(freedom[use].sum(), 1.0)))
            if square[use].sum() <= threshold:
                return 0.0, weights
        score = float((np.einsum("si,si->s", (inverse @ own[:, :, None])[:, :, 0], (inverse @ own[:, :, None])[:, :, 0])[use]).sum())
        trace = np.trace(inverse, axis1=1, axis2=2)
        share = freedom / 2.0
        fisher = float(np.einsum("sij,sji->s", inverse, inverse)[use].sum())
        change = (score - float((trace * share)[use].sum())) / max(fisher, 1e-300)
        new = max(variance + change, 0.0)
        if abs(new - variance) <= 1e-4 * max(variance, 1e-300):
            variance = new
            break
        variance = new
        if variance == 0.0:
            break
    if variance > 0.0:
        inverse = np.linalg.inv(V)
        use = good & (weights > 0.0)
        square = np.einsum("si,sij,sj->s", own, inverse, own)[use].sum()
        freedom = np.maximum(2.0 - np.einsum("sij,sji->s", inverse, absorbed), 0.0)[use].sum()
        if square <= float(chi2.ppf(0.95, max(freedom, 1.0))):
            variance = 0.0
    return variance, weights


def _robust_start(own: FloatArray, V: FloatArray) -> float:
    """From the median of the squared standardised shifts, whose value for pure noise is 1.386 (chi-square, 2)."""
    square = np.einsum("si,sij,sj->s", own, np.linalg.inv(V), own)
    ratio = float(np.median(square)) / 1.3862943611
    return max(ratio - 1.0, 0.0) * float(np.median(np.trace(V, axis1=1, axis2=2))) / 2.0


def _noise_change(a: Noise, b: Noise) -> float:
    change = abs(a.corners.factor / b.corners.factor - 1.0)
    for kind, old in a.lines.items():
        new = b.lines[kind]
        change = max(change, abs(old.factor / new.factor - 1.0))
        larger = max(old.place_variance, new.place_variance)
        if larger > 0.0:
            change = max(change, 0.1 * abs(old.place_variance - new.place_variance) / larger)
        change = max(change, float(np.abs(old.line_weights - new.line_weights).max(initial=0.0)))
    return change


def _finish(
    data: JointData, at: Linearised, noise: Noise, active: FloatArray, iterations: int, converged: bool
) -> Solution:
    equations = normal_equations(data, at, noise)
    covariance, condition, weakest = covariance_and_condition(equations.information[np.ix_(active, active)])
    return Solution(data, at, noise, equations, active, covariance, condition, weakest, iterations, converged)
