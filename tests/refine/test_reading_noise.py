"""Errors of the turntable's readings from place to place: seen, and in the covariance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.observation import TurntableObservations
from lidarpose.refine.joint_equations import linearise, lines_of
from lidarpose.refine.joint_options import JointOptions
from lidarpose.refine.reading_noise import _errors, _turns
from lidarpose.refine.turntable import refine_turntable
from lidarpose.refine.turntable_joint import Solution, solve_joint
from lidarpose.refine.turntable_layout import lay_out
from lidarpose.refine.turntable_state import start_state
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig


def _observed(rig: TurntableRig, errors_rad: FloatArray, seed: int) -> TurntableObservations:
    """What is seen where the table stood off its readings by `errors_rad`."""
    stood = replace(rig, turntable_angle_rad=rig.turntable_angle_rad + errors_rad)
    observations = simulate_observations(stood, stripe_step_px=12.0, seed=seed)
    places = tuple(
        replace(place, turntable_angle_rad=float(reading))
        for place, reading in zip(observations.places, rig.turntable_angle_rad, strict=True)
    )
    return replace(observations, places=places)


def _solved(rig: TurntableRig, observations: TurntableObservations) -> Solution:
    data = lay_out(observations, use_stripes=True)
    return solve_joint(data, start_state(data, rig.motion, rig.T_camera_panel), JointOptions())


def test_a_reading_that_is_off_moves_residuals_as_reckoned() -> None:
    rig = draw_rig(1, places=8)
    solution = _solved(rig, _observed(rig, np.zeros(8), seed=0))
    data, turns, step = solution.data, _turns(solution), 1e-6
    for k in (0, 5):
        off = np.where(np.arange(8) == k, step, 0.0)
        after, before = (
            linearise(replace(data, angles_rad=data.angles_rad + sign * off), solution.state) for sign in (1.0, -1.0)
        )
        for kind, residuals in solution.at.lines.items():
            lines = lines_of(data, kind)
            of_line = (residuals.to_parameters[:, :, :6] @ turns[lines.place][:, :, None])[:, :, 0]
            of_row = (residuals.basis * of_line[lines.line_of_row]).sum(axis=1)
            there = residuals.valid & (lines.place[lines.line_of_row] == k)
            numerical = (after.lines[kind].residual - before.lines[kind].residual) / (2.0 * step)
            assert numerical[there] == pytest.approx(of_row[there], rel=1e-5, abs=1e-6 * float(np.abs(of_row).max()))
            assert not numerical[~there & residuals.valid].any()


def test_the_errors_are_integrated_out_as_generalised_least_squares_does() -> None:
    rig = draw_rig(1, places=8)
    solution = _solved(rig, _observed(rig, np.deg2rad(0.05) * np.random.default_rng(1).standard_normal(8), seed=0))
    errors = _errors(solution, solution.noise, _turns(solution), solution.equations, solution.covariance)
    use, variance = solution.active, np.deg2rad(0.03) ** 2
    found = errors.integrated_out(variance)
    # All parameters and the errors side by side, with the errors' prior: the parameters' part of the inverse.
    both = np.block(
        [
            [errors.equations.information[np.ix_(use, use)], errors.cross[:, use].T],
            [errors.cross[:, use], np.diag(errors.own + 1.0 / variance)],
        ]
    )
    scale = 1.0 / np.sqrt(np.diag(both))
    inverse = scale[:, None] * np.linalg.inv(both * np.outer(scale, scale)) * scale
    pull = np.concatenate([errors.equations.gradient[use], errors.score])
    n = len(use)
    direct = np.linalg.inv(found.information[np.ix_(use, use)])
    sigma = np.sqrt(np.diag(direct))
    assert direct / np.outer(sigma, sigma) == pytest.approx(inverse[:n, :n] / np.outer(sigma, sigma), abs=1e-6)
    assert (direct @ found.gradient[use]) / sigma == pytest.approx((inverse @ pull)[:n] / sigma, abs=1e-6)
    assert errors.predicted(variance) == pytest.approx((inverse @ pull)[n:], rel=1e-6, abs=1e-9)


def test_errors_of_readings_are_found_and_paid_for() -> None:
    rig = draw_rig(1, places=8)
    rng = np.random.default_rng(3)
    middle = float(rig.turntable_angle_rad.mean())
    squares: list[float] = []
    found: list[float] = []
    for seed in range(12):
        observations = _observed(rig, np.deg2rad(0.05) * rng.standard_normal(8), seed)
        estimate = refine_turntable(observations, rig.motion, rig.T_camera_panel)
        pose = estimate.uncertain_pose(middle)
        xi = pose.pose.minus(rig.motion.pose(middle))
        squares.append(float(xi @ np.linalg.solve(pose.covariance, xi)))
        found.append(estimate.quality.figures["reading_sigma_deg"])
    # Twelve chi-squares of 6 degrees of freedom have a mean of 6 with a standard deviation of 1; few places tell the
    # variance, for which the covariance pays.
    assert 1.5 < np.mean(squares) < 9.0
    assert max(squares) < 22.5
    assert 0.03 < np.median(found) < 0.07


def test_true_readings_are_not_doubted() -> None:
    rig = draw_rig(1, places=8)
    found = []
    for seed in range(12):
        estimate = refine_turntable(_observed(rig, np.zeros(8), seed), rig.motion, rig.T_camera_panel)
        found.append(estimate.quality.figures["reading_sigma_deg"])
    assert np.median(found) == 0.0
    assert sum(each > 0.0 for each in found) <= 3
    assert max(found) < 0.01
