"""Errors of the turntable's readings that differ from place to place: an encoder's noise, play in a gear.

Such an error turns all that is seen at its place together, stripes and ranges of both panels. Taken for what each line
is off by on its own, it is averaged over lines that share it, and the covariance comes out too small. Here each place's
reading has an error of its own, random about zero: how much the misfit would fall with it tells the variance of such
errors (restricted likelihood), and what they do to the estimate, to first order, belongs to its covariance.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.robust import chi2_tail
from lidarpose.refine.joint_equations import (
    Noise,
    linearise,
    lines_of,
    normal_equations,
    reduced_moments,
)
from lidarpose.refine.least_squares import NormalEquations, covariance_and_condition, moved_moments
from lidarpose.refine.place_effects import place_effects
from lidarpose.refine.turntable_joint import Solution, parameter_spread
from lidarpose.refine.turntable_parameters import N_GLOBAL

# Chance shows errors that are not there in so many sessions; what it adds to their covariance is little.
_SIGNIFICANCE = 0.1
_ROUNDS = 4
"""What lines are off by on their own has taken the errors' part at first, and gives it back round by round."""
_LEAST_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class ReadingNoise:
    """Standard deviation of the readings' errors, and the estimate that counts with them."""

    sigma_rad: float
    solution: Solution


@dataclass(frozen=True, eq=False)
class _Errors:
    """The places' errors (P,) as further parameters: their own information (P,), their score (P,) and their coupling
    (P, n) with all others, whose `equations` are at hand, and the covariance (a, a) of the active ones among these.

    With the active parameters free: how well the errors are told, as eigenvalues (m,) and vectors (P, m) of their
    information, and the score along these (m,).
    """

    own: FloatArray
    score: FloatArray
    cross: FloatArray
    equations: NormalEquations
    covariance: FloatArray
    values: FloatArray
    vectors: FloatArray
    along: FloatArray

    def significant(self) -> bool:
        found = len(self.values)
        return found > 0 and chi2_tail(float((self.along**2 / self.values).sum()), found) < _SIGNIFICANCE

    def variance(self) -> float:
        """Of the errors, by Fisher scoring of the restricted likelihood."""
        value = max(float(np.median(self.along**2 / self.values - 1.0)) / float(np.median(self.values)), 0.0)
        for _ in range(50):
            spread = self.values + value * self.values**2
            step = ((self.along**2 - spread) * (self.values / spread) ** 2).sum() / (self.values**4 / spread**2).sum()
            before, value = value, max(value + float(step), 0.0)
            if abs(value - before) <= 1e-6 * value:
                break
        return value

    def certainty_factor(self, variance: float) -> float:
        """As `PlaceEffects.certainty_factor`, of as many degrees of freedom as tell the variance."""
        gain = variance * self.values
        freedom = float((gain / (1.0 + gain)).sum())
        return freedom / (freedom - 2.0) if freedom > 3.0 else 3.0

    def predicted(self, variance: float) -> FloatArray:
        """The best linear prediction (P,) of the errors."""
        return np.asarray(self.vectors @ (variance / (1.0 + variance * self.values) * self.along))

    def integrated_out(self, variance: float) -> NormalEquations:
        """The equations of all other parameters, the errors being normal with mean 0 (Henderson, 1950)."""
        shrunk = self.cross / (self.own + 1.0 / variance)[:, None]
        return NormalEquations(
            self.equations.information - shrunk.T @ self.cross,
            self.equations.gradient - shrunk.T @ self.score,
            self.equations.sum_of_squares - float((self.score**2 / (self.own + 1.0 / variance)).sum()),
        )


def reading_noise(solution: Solution) -> ReadingNoise | None:
    """Errors of the readings from place to place; None where the residuals show none."""
    turns, noise = _turns(solution), solution.noise
    errors = _errors(solution, noise, turns, solution.equations, solution.covariance)
    if not errors.significant():
        return None
    variance = errors.variance()
    for _ in range(_ROUNDS):
        noise = _own_effects(solution, noise, turns, errors, variance)
        errors = _errors(solution, noise, turns, *_equations(solution, noise))
        variance = errors.variance()
    if variance == 0.0:
        return None
    return ReadingNoise(float(np.sqrt(variance)), _with_errors(solution, noise, errors, variance))


def _with_errors(solution: Solution, noise: Noise, errors: _Errors, variance: float) -> Solution:
    """The estimate with the errors integrated out: one step from the one without them."""
    data, use = solution.data, np.asarray(solution.active)
    equations = errors.integrated_out(variance)
    covariance, condition, weakest = covariance_and_condition(equations.information[np.ix_(use, use)])
    step = np.zeros(len(equations.gradient))
    step[use] = covariance @ equations.gradient[use]
    covariance = errors.covariance + errors.certainty_factor(variance) * (covariance - errors.covariance)
    at = linearise(data, solution.state.moved(step, data.centres))
    return replace(
        solution,
        at=at,
        noise=noise,
        equations=replace(equations, gradient=equations.gradient - equations.information @ step),
        covariance=covariance,
        condition_number=condition,
        weakest=weakest,
    )


def _turns(solution: Solution) -> FloatArray:
    """Changes (P, 6) of the LiDAR's pose at the reference reading that act at a place as a turn about the axis does."""
    data, state = solution.data, solution.state
    _, _, J_place = state.turned(data.angles_rad, data.reference_rad)
    axis = state.T_camera_axis.adjoint()[:, 5]
    return np.asarray(np.linalg.solve(J_place[:, :, :6], np.tile(axis[:, None], (len(J_place), 1, 1)))[:, :, 0])


def _equations(solution: Solution, noise: Noise) -> tuple[NormalEquations, FloatArray]:
    """At another noise of whole lines: the equations, and the covariance of the active parameters."""
    equations = normal_equations(solution.data, solution.at, noise, solution.moments)
    return equations, covariance_and_condition(equations.information[np.ix_(solution.active, solution.active)])[0]


def _errors(
    solution: Solution, noise: Noise, turns: FloatArray, equations: NormalEquations, covariance: FloatArray
) -> _Errors:
    data, use = solution.data, np.asarray(solution.active)
    places, n = len(data.angles_rad), N_GLOBAL + 6 * len(data.slots)
    own, score, cross = np.zeros(places), np.zeros(places), np.zeros((places, n))
    for kind, residuals in solution.at.lines.items():
        lines, reduced = lines_of(data, kind), reduced_moments(solution.moments[kind], noise.lines[kind])
        by_error = (residuals.to_parameters[:, :, :6] @ turns[lines.place][:, :, None])[:, :, 0]
        pull = (by_error[:, None, :] @ reduced[:, :-1, :])[:, 0, :]
        to = (pull[:, None, :-1] @ residuals.to_parameters)[:, 0, :]
        np.add.at(own, lines.place, (pull[:, :-1] * by_error).sum(axis=1))
        np.add.at(score, lines.place, -pull[:, -1])
        for j, (place, slot) in enumerate(zip(lines.place, lines.slot, strict=True)):
            cross[place, :N_GLOBAL] += to[j, :N_GLOBAL]
            cross[place, N_GLOBAL + 6 * slot : N_GLOBAL + 6 * slot + 6] += to[j, N_GLOBAL:]
    settle = cross[:, use] @ covariance
    values, vectors = np.linalg.eigh(np.diag(own) - settle @ cross[:, use].T)
    told = values > _LEAST_SHARE * own.max(initial=1e-300)
    along = vectors[:, told].T @ (score - settle @ equations.gradient[use])
    return _Errors(own, score, cross, equations, covariance, values[told], vectors[:, told], along)


def _own_effects(solution: Solution, noise: Noise, turns: FloatArray, errors: _Errors, variance: float) -> Noise:
    """The noise with what lines are off by on their own, once the readings' errors are taken from them."""
    data, use, moments = solution.data, np.asarray(solution.active), solution.moments
    predicted = errors.predicted(variance)
    n = N_GLOBAL + 6 * len(data.slots)
    step, covariance = np.zeros(n), np.zeros((n, n))
    step[use] = errors.covariance @ (errors.equations.gradient - errors.cross.T @ predicted)[use]
    covariance[np.ix_(use, use)] = errors.covariance
    out = dict(noise.lines)
    for kind, residuals in solution.at.lines.items():
        lines, before = lines_of(data, kind), noise.lines[kind]
        turned = residuals.to_parameters[:, :, :6] @ (turns * predicted[:, None])[lines.place][:, :, None]
        shift = residuals.shift_by(step, lines.slot) + turned[:, :, 0]
        spread = parameter_spread(residuals, lines, moments[kind], covariance)
        found = place_effects(moved_moments(moments[kind], shift), spread, before.place_variance)
        out[kind] = replace(before, place_variance=found.variance)
    return replace(noise, lines=out)
