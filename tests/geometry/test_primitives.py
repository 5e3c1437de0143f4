"""Lines, planes, circles and robust fits on cases with known answers."""

import numpy as np
import pytest

from lidarpose.geometry.arrays import angle_between, perpendicular_pair, unit
from lidarpose.geometry.circles import fit_circle2, fit_circle3
from lidarpose.geometry.lines import Line2, fit_line2
from lidarpose.geometry.planes import Plane, fit_plane, intersect_three_planes
from lidarpose.geometry.robust import box_plot_inliers, chi2_tail, mad_sigma, ransac


def test_a_vertical_line_is_no_special_case() -> None:
    line = fit_line2([[2.0, -1.0], [2.0, 5.0], [2.0, 7.0]])
    np.testing.assert_allclose(np.abs(line.normal), [1.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(line.intersection(Line2(np.array([0.0, 2.0]), 6.0)), [2.0, 3.0])


def test_three_planes_meet_where_they_were_made_to_and_parallels_are_refused() -> None:
    rng = np.random.default_rng(2)
    corner = rng.normal(size=3)
    planes = [Plane(n, float(n @ corner)) for n in unit(rng.normal(size=(3, 3)))]
    np.testing.assert_allclose(intersect_three_planes((planes[0], planes[1], planes[2])), corner, atol=1e-10)
    with pytest.raises(ValueError, match="no single common point"):
        intersect_three_planes((planes[0], planes[1], planes[0]))


def test_a_plane_through_the_origin_is_no_special_case() -> None:
    points = np.random.default_rng(3).normal(size=(30, 3)) * [1.0, 1.0, 0.0]
    plane = fit_plane(points)
    assert abs(plane.offset) < 1e-12
    assert angle_between(plane.normal, [0.0, 0.0, 1.0]) % np.pi == pytest.approx(0.0, abs=1e-9)


def test_a_full_circle_in_space() -> None:
    normal = unit([1.0, 2.0, -0.5])
    u, v = perpendicular_pair(normal)
    t = np.linspace(0.0, 1.0, 20)[:, None]
    points = np.array([1.0, 2.0, 3.0]) + 0.4 * (np.cos(t) * u + np.sin(t) * v)
    circle = fit_circle3(points, normal)
    np.testing.assert_allclose(circle.centre, [1.0, 2.0, 3.0], atol=1e-12)
    assert circle.radius == pytest.approx(0.4, abs=1e-12)


def test_points_on_a_line_determine_no_circle() -> None:
    with pytest.raises(ValueError, match="no circle"):
        fit_circle2([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [5.0, 5.0]])


def test_ransac_tells_its_inliers() -> None:
    rng = np.random.default_rng(4)
    good = np.column_stack([np.linspace(0, 1, 60), 0.5 + 1e-3 * rng.normal(size=60)])
    bad = rng.uniform(0, 1, size=(40, 2)) * [1.0, 0.4]
    fit = ransac(np.vstack([good, bad]), fit_line2, 2, 3e-3, seed=0)
    assert fit.inliers[:60].sum() >= 58
    assert fit.inliers[60:].sum() <= 2
    assert fit.sigma == pytest.approx(1e-3, rel=0.4)


def test_spread_and_box_plot() -> None:
    x = np.random.default_rng(5).normal(size=2000)
    assert mad_sigma(np.r_[x, [1e9] * 50]) == pytest.approx(1.0, rel=0.1)
    assert list(box_plot_inliers(np.r_[np.zeros(5), 1.0, 2.0, 50.0]))[-1] is np.False_


@pytest.mark.parametrize("freedom", [0.7, 1.0, 2.0, 7.5, 80.0, 2500.0])
def test_the_tail_of_chi_squared_is_that_of_an_independent_library(freedom: float) -> None:
    from scipy.stats import chi2

    values = freedom + np.sqrt(2.0 * freedom) * np.array([-3.0, -0.9, -0.2, 0.0, 0.3, 1.0, 3.0, 6.0])
    found = [chi2_tail(float(v), freedom) for v in values]
    np.testing.assert_allclose(found, chi2.sf(values, freedom), rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("count", [1, 4, 7, 12, 599, 600, 601, 4001])
def test_the_robust_spread_is_the_median_absolute_deviation(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    expected = 1.4826022185056018 * np.median(np.abs(values - np.median(values)))
    assert mad_sigma(values) == pytest.approx(expected, rel=1e-15)
    assert np.isnan(mad_sigma([*values, np.nan]))
