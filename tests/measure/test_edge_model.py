"""The edge's posterior against sampling, on beams drawn without any simulator of scenes."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from lidarpose.measure.edge_model import EdgeBeams, fit_edge, fit_straight_edge, usual_spot

RADIUS = 0.05
STEP = 0.002


def beams(rng: np.random.Generator, spot: float, contrast: float = 1.0) -> EdgeBeams:
    """Beams on a lattice that lies anyhow, with a Gaussian spot and a background 0.5 m behind."""
    x = np.arange(-0.06, 0.06, STEP)
    place = np.stack(np.meshgrid(x + rng.uniform(0, STEP), x + rng.uniform(0, STEP)), -1).reshape(-1, 2)
    s = np.linalg.norm(place, axis=1) - RADIUS
    place, s = place[np.abs(s) < 0.006], s[np.abs(s) < 0.006]
    F = norm.cdf(-s / spot)
    depth = contrast * (1.0 - F) / (F + contrast * (1.0 - F)) + rng.normal(0.0, 0.002, len(s))
    sigma = np.full((len(s), 2), 0.002)
    return EdgeBeams(place, np.zeros_like(place), depth, sigma, np.zeros(len(s), dtype=bool))


@pytest.mark.parametrize("contrast", [1.0, 0.4])
def test_radius_and_sigma_over_lattices(contrast: float) -> None:
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(6):
        some = beams(rng, 0.0005, contrast)
        fit = fit_edge(some, np.array([3e-4, -4e-4]), RADIUS - 8e-4, inside=True, dropout=1e-4, reach=STEP)
        errors.append((fit.radius - RADIUS) / np.sqrt(fit.covariance[2, 2]))
        assert abs(fit.radius - RADIUS) < 6e-5
        assert fit.spot_m == pytest.approx(0.0005, rel=0.1)
    assert np.sqrt(np.mean(np.square(errors))) < 2.5


def test_a_hole_is_a_disk_inside_out() -> None:
    some = beams(np.random.default_rng(2), 0.0005)
    inside_out = EdgeBeams(some.place, some.slope, 1.0 - some.depth, some.depth_sigma, some.open)
    disk = fit_edge(some, np.zeros(2), RADIUS, inside=True, dropout=1e-4, reach=STEP)
    hole = fit_edge(inside_out, np.zeros(2), RADIUS, inside=False, dropout=1e-4, reach=STEP)
    assert hole.radius == pytest.approx(disk.radius, abs=2e-5)


def test_hits_and_misses_state_what_the_threshold_may_make() -> None:
    some = beams(np.random.default_rng(3), 0.0005)
    open_ = np.ones(len(some), dtype=bool)
    # What is seen when half of a spot is on the disk, and when a twentieth of a 10 mm spot is.
    for beyond, spot_m in ((0.0, 0.0005), (1.64, 0.0025)):
        hits = np.where(np.linalg.norm(some.place, axis=1) < RADIUS + beyond * spot_m, 0.0, np.nan)
        sharp = EdgeBeams(some.place, some.slope, hits, some.depth_sigma, open_, usual_spot_m=usual_spot(2.0))
        fit = fit_edge(sharp, np.array([2e-4, 1e-4]), RADIUS + 1e-3, inside=True, dropout=1e-4, reach=STEP)
        assert abs(fit.radius - RADIUS - beyond * spot_m) < 2e-4
        assert abs(fit.radius - RADIUS) < 1.5 * np.sqrt(fit.covariance[2, 2]) < 0.01


def test_a_spot_of_another_kind_widens_sigma() -> None:
    """Square spots of even light, which the model does not have: the beams' number does not average that out."""
    rng = np.random.default_rng(6)
    some = beams(rng, 0.0005)
    offset = some.place[:, None] + 0.0012 * np.stack(np.meshgrid(*[np.linspace(-1, 1, 21)] * 2), -1).reshape(-1, 2)
    F = (np.linalg.norm(offset, axis=-1) < RADIUS).mean(axis=1)
    square = replace(some, depth=1.0 - F + rng.normal(0.0, 0.002, len(F)))
    sigmas = []
    for each in (some, square):
        fit = fit_edge(each, np.zeros(2), RADIUS, inside=True, dropout=1e-4, reach=STEP)
        sigmas.append(np.sqrt(fit.covariance[2, 2]))
        assert abs(fit.radius - RADIUS) < 2.5 * sigmas[-1]
    assert sigmas[1] > 1.5 * sigmas[0]


def test_a_straight_edge() -> None:
    rng = np.random.default_rng(4)
    x = np.arange(-0.006, 0.006, STEP)
    place = np.stack(np.meshgrid(x + rng.uniform(0, STEP), np.arange(-0.05, 0.05, 0.0013)), -1).reshape(-1, 2)
    place[:, 0] += 0.31 * place[:, 1] % STEP
    F = norm.cdf(-(place[:, 0] - 4e-4) / 0.0006)
    sigma = np.full((len(place), 2), 0.002)
    depth = 1.0 - F + rng.normal(0.0, 0.002, len(F))
    some = EdgeBeams(place, np.zeros_like(place), depth, sigma, np.zeros(len(F), dtype=bool))
    offset, variance, spot = fit_straight_edge(some, 0.0, dropout=1e-4, reach=STEP)
    assert abs(offset - 4e-4) < max(4.0 * np.sqrt(variance), 1e-5)
    assert np.sqrt(variance) < 5e-5
    assert spot == pytest.approx(0.0006, rel=0.1)


def test_the_same_beams_give_the_same_answer() -> None:
    some = beams(np.random.default_rng(5), 0.0004)
    once, again = (fit_edge(some, np.zeros(2), RADIUS, inside=True, dropout=1e-4, reach=STEP) for _ in range(2))
    assert once.radius == again.radius
    assert np.array_equal(once.covariance, again.covariance)
