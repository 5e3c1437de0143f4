"""What is fitted as one table is what each piece gives by itself, and what slower, independent ways give."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.geometry.lines import fit_line2
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.robust import row_medians
from lidarpose.geometry.se3 import Pose, exp_se3, log_se3, rotation_z
from lidarpose.model.observation import ScanLine
from lidarpose.solve.light_plane import (
    LightPlane,
    StripeOnPanel,
    StripePair,
    fit_light_plane,
    fit_light_planes,
    stripe_pair,
    stripe_pairs,
)
from lidarpose.solve.line_pair import fit_line_pairs, fit_scan_line, fit_scan_lines, free_directions
from lidarpose.solve.turntable_function import motions_of_pairs


def scan_line(rng: np.random.Generator, beams: int, *, outliers: int = 0) -> ScanLine:
    """Beams on a random wall, 1 mm off it."""
    middle, slant, distance = rng.uniform(-3.0, 3.0), rng.uniform(-0.8, 0.8), rng.uniform(0.4, 3.0)
    angle = middle + np.linspace(-0.15, 0.15, beams)
    ranges = distance / np.cos(angle - middle - slant) + rng.normal(scale=1e-3, size=beams)
    ranges[rng.choice(beams, outliers, replace=False)] += 0.1
    return ScanLine(angle, ranges, np.full(beams, 1e-3) * rng.uniform(0.5, 2.0, beams))


@pytest.mark.parametrize("robust", [False, True])
def test_lines_of_many_scans_are_fitted_as_each_alone(robust: bool) -> None:
    rng = np.random.default_rng(1)
    lines = [scan_line(rng, int(n), outliers=int(n) // 8) for n in rng.integers(2, 90, size=30)]
    together = fit_scan_lines(lines, robust=robust)
    for k, line in enumerate(lines):
        one, alone = together.one(k), fit_scan_line(line, robust=robust)
        np.testing.assert_allclose(one.line.normal, alone.line.normal, atol=1e-12)
        np.testing.assert_allclose(one.ends, alone.ends, atol=1e-12)
        np.testing.assert_allclose(one.middle, alone.middle, atol=1e-12)
        found = [one.direction_sigma_rad, one.offset_sigma_m, one.rms_m]
        np.testing.assert_allclose(found, [alone.direction_sigma_rad, alone.offset_sigma_m, alone.rms_m], rtol=1e-8)


def test_a_line_is_the_total_least_squares_one_of_its_weights() -> None:
    line = scan_line(np.random.default_rng(2), 40)
    fit = fit_scan_line(line, robust=False)
    points = line.points_lidar()
    start = fit_line2(points)
    beams = points / line.range_m[:, None]
    again = fit_line2(points, 1.0 / (np.maximum(np.abs(beams @ start.normal), 0.1) * line.sigma_m) ** 2)
    np.testing.assert_allclose(fit.line.normal * np.sign(fit.line.normal @ again.normal), again.normal, atol=1e-12)
    np.testing.assert_allclose(fit.line.distance(fit.ends), 0.0, atol=1e-12)


def test_a_line_of_one_point_is_none() -> None:
    rng = np.random.default_rng(3)
    fits = fit_scan_lines([scan_line(rng, 1), scan_line(rng, 9)])
    with pytest.raises(ValueError, match="two points"):
        fits.one(0)
    assert np.isfinite(fits.one(1).rms_m)


def test_pairs_keep_alpha_and_leave_their_common_point() -> None:
    rng = np.random.default_rng(4)
    fits = fit_scan_lines([scan_line(rng, 40) for _ in range(40)])
    first, second = fits.take(np.arange(20)), fits.take(np.arange(20, 40))
    free = np.stack([free_directions(fits.one(k), fits.one(k + 20)) for k in range(20)])
    alpha = np.arccos((free[:, 0] * free[:, 1]).sum(axis=1))
    found = fit_line_pairs(first, second, alpha)
    np.testing.assert_allclose(found.directions_lidar, free, atol=1e-9)
    held = fit_line_pairs(first, second, alpha + 1e-3).directions_lidar
    np.testing.assert_allclose(np.arccos((held[:, 0] * held[:, 1]).sum(axis=1)), alpha + 1e-3, atol=1e-9)
    # The one that is known better turns less, by the ratio of the variances.
    turned = np.abs(np.arccos(np.clip((held * free).sum(axis=2), -1.0, 1.0)))
    ratio = (first.direction_sigma_rad / second.direction_sigma_rad) ** 2
    np.testing.assert_allclose(turned[:, 0] / turned[:, 1], ratio, rtol=1e-3)


def test_parallel_lines_are_no_pair() -> None:
    fits = fit_scan_lines([scan_line(np.random.default_rng(5), 40)] * 2)
    found = fit_line_pairs(fits.take(np.array([0])), fits.take(np.array([1])), np.array([1.0]))
    assert np.isnan(found.E_lidar).all()


def stripes_of_place(rng: np.random.Generator, *, outliers: float) -> tuple[StripeOnPanel, StripeOnPanel]:
    normal = np.array([0.1, 1.0, 0.05]) + rng.normal(scale=0.1, size=3)
    normal /= np.linalg.norm(normal)
    found = []
    for side in (-1.0, 1.0):
        n = int(rng.integers(20, 150))
        line = np.array([side, 0.0, 0.4 * side])
        line -= (line @ normal) * normal
        points = np.array([0.0, 0.0, 1.0]) + rng.uniform(0.1, 0.6, n)[:, None] * line
        spread = rng.uniform(0.5, 2.0, n)[:, None] * 2e-4 * (normal + rng.normal(scale=0.3, size=3))
        off = rng.normal(size=n) + np.where(rng.random(n) < outliers, 40.0, 0.0)
        points = points + off[:, None] * spread
        found.append(StripeOnPanel(points, spread, points / points[:, 2:]))
    return found[0], found[1]


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_light_planes_of_many_places_are_fitted_as_each_alone(outliers: float) -> None:
    rng = np.random.default_rng(6)
    places = [stripes_of_place(rng, outliers=outliers) for _ in range(12)]
    for stripes, light in zip(places, fit_light_planes(places), strict=True):
        assert isinstance(light, LightPlane)
        alone = fit_light_plane(stripes)
        assert abs(light.plane.normal @ alone.plane.normal) > 1.0 - 1e-14
        np.testing.assert_allclose(light.covariance, alone.covariance, rtol=1e-6, atol=1e-16)
        assert [len(w) for w in light.weights] == [len(s.points_camera) for s in stripes]
        assert light.rms_m == pytest.approx(alone.rms_m, rel=1e-6)
        # Against a plain weighted fit with the weights that were found.
        points, weights = np.vstack([s.points_camera for s in stripes]), np.concatenate(light.weights)
        centred = (points - weights @ points / weights.sum()) * np.sqrt(weights)[:, None]
        normal = np.linalg.svd(centred)[2][2]
        assert abs(normal @ light.plane.normal) > 1.0 - 1e-12


def test_a_place_without_a_plane_leaves_the_others_theirs() -> None:
    rng = np.random.default_rng(7)
    good = stripes_of_place(rng, outliers=0.0)
    few = tuple(StripeOnPanel(s.points_camera[:1], s.spread_camera[:1], s.rays_camera[:1]) for s in good)
    line = np.outer(np.linspace(0.5, 1.0, 20), [0.1, 0.2, 1.0])
    straight = (
        StripeOnPanel(line, np.full((20, 3), 1e-4), line),
        StripeOnPanel(2.0 * line, np.full((20, 3), 1e-4), line),
    )
    found = fit_light_planes([few, good, straight])
    assert isinstance(found[0], ValueError)
    assert "four points" in str(found[0])
    assert isinstance(found[1], LightPlane)
    assert isinstance(found[2], ValueError)
    with pytest.raises(ValueError, match="four points"):
        fit_light_plane(few)


@pytest.mark.parametrize("outliers", [0.0, 0.2])
def test_stripes_of_many_places_leave_as_each_alone(outliers: float) -> None:
    rng = np.random.default_rng(9)
    panels = (Plane(np.array([0.6, 0.0, -0.8]), -1.0), Plane(np.array([-0.6, 0.05, -0.8]), -1.0))
    places = [stripes_of_place(rng, outliers=outliers) for _ in range(12)]
    lights = [light for light in fit_light_planes(places) if isinstance(light, LightPlane)]
    # One place on parallel panels, and one without points on a panel, have none.
    both = [panels] * 11 + [(panels[0], panels[0])]
    lights[3] = replace(lights[3], weights=(lights[3].weights[0], 0.0 * lights[3].weights[1]))
    for k, found in enumerate(stripe_pairs(both, places, lights)):
        if k in (3, 11):
            assert isinstance(found, ValueError)
            with pytest.raises(ValueError, match=str(found)):
                stripe_pair(both[k], places[k], lights[k])
            continue
        assert isinstance(found, StripePair)
        alone = stripe_pair(both[k], places[k], lights[k])
        np.testing.assert_allclose(found.E_camera, alone.E_camera, atol=1e-12)
        np.testing.assert_allclose(found.directions_camera, alone.directions_camera, atol=1e-12)
        np.testing.assert_allclose(found.extents_m, alone.extents_m, atol=1e-12)
        assert found.alpha_rad == pytest.approx(alone.alpha_rad, abs=1e-12)


def test_motions_go_through_their_pairs_of_poses() -> None:
    rng = np.random.default_rng(8)
    angles = rng.uniform(-3.0, 3.0, (15, 2))
    T_w, T_m = Pose.exp(rng.normal(size=6)), Pose.exp(0.5 * rng.normal(size=6))
    poses = [[T_w @ Pose(rotation_z(a), np.zeros(3)) @ T_m for a in two] for two in angles]
    R = np.array([[p.rotation for p in two] for two in poses])
    t = np.array([[p.translation for p in two] for two in poses])
    motions = motions_of_pairs(angles, R, t)
    everywhere = motions.residuals(angles.ravel(), R.reshape(-1, 3, 3), t.reshape(-1, 3))
    np.testing.assert_allclose(everywhere, 0.0, atol=1e-9)


def test_row_medians_are_numpys() -> None:
    rng = np.random.default_rng(9)
    values, there = rng.normal(size=(20, 13)), rng.random((20, 13)) < 0.6
    there[0] = False
    there[1] = True
    found = row_medians(values, there)
    assert np.isnan(found[0])
    np.testing.assert_array_equal(found[1:], [np.median(v[h]) for v, h in zip(values[1:], there[1:], strict=True)])


def test_twists_of_many_motions_are_those_of_each() -> None:
    xi = np.random.default_rng(10).normal(size=(3, 4, 6))
    R, t = exp_se3(xi)
    single = [Pose.exp(x) for x in xi.reshape(-1, 6)]
    np.testing.assert_allclose(R.reshape(-1, 3, 3), [p.rotation for p in single], atol=1e-15)
    np.testing.assert_allclose(t.reshape(-1, 3), [p.translation for p in single], atol=1e-15)
    np.testing.assert_allclose(log_se3(R, t).reshape(-1, 6), [p.log() for p in single], atol=1e-13)
