"""Rings of multi-beam LiDARs, and where their beams start."""

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.rings import crossing_of_points, ring_numbers, with_beams_crossing

CROSSING_M = 0.0419


def beams(rng: np.random.Generator, elevation_deg: FloatArray, count: int = 40) -> tuple[FloatArray, FloatArray]:
    """Azimuth and elevation (N,), shuffled."""
    elevation = np.radians(np.repeat(elevation_deg, count))
    azimuth = rng.uniform(-np.pi, np.pi, len(elevation))
    order = rng.permutation(len(elevation))
    return azimuth[order], elevation[order]


def instrument(azimuth: FloatArray, elevation: FloatArray, wall_m: float) -> tuple[FloatArray, FloatArray]:
    """Points that beams meet which start at the crossing, and what a driver makes of their ranges that lets all beams
    start at the origin. The range counts from the axis along the beam."""
    level = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.zeros_like(azimuth)])
    start = CROSSING_M * level
    direction = np.cos(elevation)[:, None] * level + np.sin(elevation)[:, None] * [0.0, 0.0, 1.0]
    # A cone about the axis, so that every beam meets it and distances differ along each ring.
    reach = wall_m * (1.0 + 0.3 * np.sin(3.0 * azimuth))
    range_m = reach + CROSSING_M / np.cos(elevation)
    return start + reach[:, None] * direction, range_m[:, None] * direction


def test_points_are_put_to_where_their_beams_met_the_wall() -> None:
    rng = np.random.default_rng(0)
    met, driven = instrument(*beams(rng, -15.0 + 2.0 * np.arange(16)), 1.2)
    assert np.abs(driven - met).max() > 0.01
    np.testing.assert_allclose(with_beams_crossing(driven, CROSSING_M), met, atol=1e-12)
    assert with_beams_crossing(driven.astype(np.float32), CROSSING_M).dtype == np.float32


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_cloud_tells_whether_its_beams_start_at_one_point(dtype: type) -> None:
    rng = np.random.default_rng(1)
    azimuth, elevation = beams(rng, -15.0 + 2.0 * np.arange(16))
    met, driven = instrument(azimuth, elevation, 1.2)
    noise = rng.normal(0.0, 0.01, (len(driven), 1)) * driven / np.linalg.norm(driven, axis=1, keepdims=True)
    apart = crossing_of_points((met + noise).astype(dtype))
    together = crossing_of_points((driven + noise).astype(dtype))
    assert apart is not None
    assert together is not None
    assert apart[0] == pytest.approx(CROSSING_M, abs=1e-4)
    assert together[0] == pytest.approx(0.0, abs=1e-5)
    assert apart[1] < 1e-4


def test_rings_are_told_by_elevation() -> None:
    rng = np.random.default_rng(2)
    elevation_deg = np.array([-30.0, -22.0, -9.5, -9.0, 1.0, 4.0])
    azimuth, elevation = beams(rng, elevation_deg)
    _, driven = instrument(azimuth, elevation, 3.0)
    ring = ring_numbers(driven)
    assert ring is not None
    np.testing.assert_array_equal(elevation_deg[ring], np.round(np.degrees(elevation), 6))


def test_directions_that_come_in_no_rings_have_none() -> None:
    rng = np.random.default_rng(3)
    assert ring_numbers(rng.normal(size=(5000, 3))) is None
    assert ring_numbers(np.zeros((0, 3))) is None
    # Two scan lines say nothing of rings.
    _, driven = instrument(*beams(rng, np.array([-1.0, 1.0])), 2.0)
    assert ring_numbers(driven) is None
    assert crossing_of_points(driven) is None
