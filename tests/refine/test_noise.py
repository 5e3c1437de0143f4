"""Noise learnt from residuals: neighbours that resemble each other, wrongly stated sigmas, few lines, shared shifts."""

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray
from lidarpose.refine.joint_equations import COMMON_CORNER_SIGMAS_PX, CornerNoise, _add_corners, linearise
from lidarpose.refine.least_squares import line_columns, line_moments
from lidarpose.refine.noise import growth_of_scatter, rows_that_count_as_one
from lidarpose.refine.place_effects import place_effects
from lidarpose.refine.turntable_layout import lay_out
from lidarpose.refine.turntable_parameters import N_GLOBAL
from lidarpose.refine.turntable_state import start_state
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import draw_rig


@pytest.mark.parametrize(("window", "expected"), [(1, 1.0), (3, 3.0), (5, 5.0)])
def test_rows_of_a_moving_average_are_worth_what_it_leaves(window: int, expected: float) -> None:
    rng = np.random.default_rng(window)
    lines, rows = 12, 150
    noise = rng.standard_normal((lines, rows + window - 1))
    smooth = np.array([np.convolve(each, np.ones(window) / np.sqrt(window), "valid") for each in noise])
    smooth -= smooth.mean(axis=1, keepdims=True)
    found = rows_that_count_as_one(smooth.ravel(), np.repeat(np.arange(lines), rows), lines)
    assert found == pytest.approx(expected, rel=0.15)


def test_neighbours_of_different_lines_and_unused_rows_do_not_count() -> None:
    rng = np.random.default_rng(0)
    values = np.repeat(rng.standard_normal(400), 2)
    # Pairs of equal values: side by side in one line they are worth half, in two lines nothing is known of them.
    assert rows_that_count_as_one(values, np.zeros(800, dtype=np.int64), 0.0) == pytest.approx(2.0, abs=0.15)
    assert rows_that_count_as_one(values, np.arange(800) // 2 + np.arange(800) % 2, 0.0) == 1.0
    values[::2] = 0.0
    assert rows_that_count_as_one(values, np.zeros(800, dtype=np.int64), 0.0) == 1.0
    assert rows_that_count_as_one(np.zeros(50), np.zeros(50, dtype=np.int64), 0.0) == 1.0


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 1.5])
def test_scatter_that_grows_otherwise_than_stated_is_seen(power: float) -> None:
    rng = np.random.default_rng(4)
    stated = np.exp(rng.uniform(np.log(0.02), np.log(0.1), 2000))
    true = 0.05 * (stated / 0.05) ** power
    assert growth_of_scatter(true * rng.standard_normal(2000) / stated, stated) == pytest.approx(power, abs=0.12)
    assert growth_of_scatter(rng.standard_normal(2000), np.full(2000, 0.1)) == 1.0
    assert growth_of_scatter(rng.standard_normal(40), stated[:40]) == 1.0


def moments_of_lines(shift: FloatArray, rows: int, rng: np.random.Generator) -> FloatArray:
    """Of lines (S, 2) off by a shift and a slope, rows of unit noise, and no parameters."""
    along = np.linspace(-1.0, 1.0, rows)
    residual = shift[:, :1] + np.sqrt(3.0) * along * shift[:, 1:] + rng.standard_normal((len(shift), rows))
    columns = line_columns([np.zeros(residual.size)], np.tile(along, len(shift)), residual.ravel())
    return line_moments(columns, np.ones(residual.size), rows * np.arange(len(shift) + 1))


@pytest.mark.parametrize("ratio", [0.0, 0.65, 2.0])
def test_few_lines_state_what_their_squared_errors_come_to(ratio: float) -> None:
    """A sixth off at most in the mean, whether lines are off together, a little, or not at all."""
    rng = np.random.default_rng(7)
    lines, rows = 8, 50
    stated = []
    for _ in range(200):
        shift = np.sqrt(ratio / rows) * rng.standard_normal((lines, 2))
        found = place_effects(moments_of_lines(shift, rows, rng), np.zeros((lines, 1, 1)))
        stated.append((1.0 + rows * found.variance) * found.certainty_factor)
    assert 0.85 < np.mean((1.0 + ratio) / np.array(stated)) < 1.17


def test_what_corners_share_is_integrated_out_as_with_their_full_covariance() -> None:
    rig = draw_rig(3, places=3, placements=2)
    observations = simulate_observations(rig, corner_sigma_px=0.02, stripe_step_px=40.0, seed=1)
    data = lay_out(observations)
    at = linearise(data, start_state(data, rig.motion, rig.T_camera_panel))
    noise = CornerNoise(1.0, tuple(np.ones(len(c.residual)) for c in at.corners), 1.0, 1.0, COMMON_CORNER_SIGMAS_PX)
    n = N_GLOBAL + 6 * len(data.slots)
    information, gradient = np.zeros((n, n)), np.zeros(n)
    total = _add_corners(data, at, noise, (information, gradient))
    assert _add_corners(data, at, noise) == pytest.approx(total)
    for panel in (0, 1):
        mine = [k for k, slot in enumerate(data.slots) if slot.panel == panel]
        assert len(mine) == 2
        J = np.zeros((sum(len(at.corners[k].residual) for k in mine), n))
        row = 0
        for k in mine:
            rows = slice(row, row + len(at.corners[k].residual))
            J[rows, N_GLOBAL + 6 * k : N_GLOBAL + 6 * k + 6] = at.corners[k].jacobian[:, :6]
            row = rows.stop
        modes = np.concatenate([data.common_corner_modes[k] for k in mine])
        residual = np.concatenate([at.corners[k].residual for k in mine])
        covariance = 0.02**2 * np.eye(len(J)) + modes @ np.diag(np.square(COMMON_CORNER_SIGMAS_PX)) @ modes.T
        dense = J.T @ np.linalg.solve(covariance, J)
        keep = np.flatnonzero(np.abs(J).sum(axis=0))
        assert np.allclose(information[np.ix_(keep, keep)], dense[np.ix_(keep, keep)], rtol=1e-8, atol=1e-3)
        assert np.allclose(gradient[keep], -(J.T @ np.linalg.solve(covariance, residual))[keep], rtol=1e-6, atol=1e-3)
        total -= float(residual @ np.linalg.solve(covariance, residual))
    assert total == pytest.approx(0.0, abs=1e-6)
