"""Kernels and NumPy find the same lines in made-up rooms."""

import numpy as np
import pytest

from lidarpose.detect.scan_lines import Beams, find_lines
from lidarpose.geometry import compiled
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.circles import fit_circle2
from lidarpose.model.observation import ScanLine
from lidarpose.model.scan import LidarSpec, Scan

pytestmark = pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")


def room(rng: np.random.Generator, noise: float, step: float, sweeps: int) -> Scan:
    """Walls, boxes, poles and a bent sheet, all round, with mixed pixels, strays and missing returns."""
    angle = np.arange(-np.pi, np.pi - 1e-9, step)
    rays = np.column_stack([np.cos(angle), np.sin(angle)])
    ranges = np.full(len(angle), np.inf)
    for distance, turn in zip(rng.uniform(2.0, 4.0, 5), rng.uniform(-np.pi, np.pi, 5), strict=True):
        seen = rays @ [np.cos(turn), np.sin(turn)]
        ranges = np.where(seen > 0.05, np.minimum(ranges, distance / np.maximum(seen, 0.05)), ranges)
    for width in rng.uniform(0.05, 0.5, 6):
        turn, lean = rng.uniform(-np.pi, np.pi), rng.uniform(-1.0, 1.0)
        seen = np.abs(np.angle(np.exp(1j * (angle - turn)))) < 0.5 * width
        ranges[seen] = rng.uniform(0.8, 1.8) / np.cos(angle[seen] - turn + lean)
    for radius in rng.uniform(0.05, 0.4, 4):
        centre = rng.uniform(0.7, 2.0) * np.array([np.cos(turn := rng.uniform(-np.pi, np.pi)), np.sin(turn)])
        along, off = rays @ centre, rays @ [-centre[1], centre[0]]
        inside = (along > 0.0) & (np.abs(off) < radius)
        ranges[inside] = np.minimum(ranges[inside], along[inside] - np.sqrt(radius**2 - off[inside] ** 2))
    many = np.tile(ranges, sweeps) + noise * rng.standard_normal(sweeps * len(angle))
    stray = rng.random(len(many)) < 0.005
    many[stray] += rng.uniform(-0.3, 0.3, stray.sum())
    many[(rng.random(len(many)) < 0.01) | ~(many > 0.1)] = np.nan
    return Scan(np.tile(angle, sweeps), many, sweep=np.repeat(np.arange(sweeps), len(angle)))


def both_ways(scan: Scan, spec: LidarSpec | None) -> tuple[tuple[ScanLine, ...], tuple[ScanLine, ...]]:
    with compiled.forced(False):
        plain = find_lines(scan, spec)
    with compiled.forced(True):
        return plain, find_lines(scan, spec)


@pytest.mark.parametrize("noise", [1e-6, 1e-4, 0.001, 0.004, 0.015])
@pytest.mark.parametrize("sweeps", [1, 4])
def test_the_same_lines_are_found(noise: float, sweeps: int) -> None:
    found = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        scan = room(rng, noise, np.deg2rad([0.25, 0.5, 1.0][seed % 3]), sweeps)
        plain, quick = both_ways(scan, LidarSpec(range_sigma_m=0.002) if seed % 2 else None)
        assert len(plain) == len(quick)
        for a, b in zip(plain, quick, strict=True):
            np.testing.assert_array_equal(b.angle_rad, a.angle_rad)
            np.testing.assert_array_equal(b.range_m, a.range_m)
            np.testing.assert_allclose(b.sigma_m, a.sigma_m, rtol=1e-9)
        found += len(plain)
    assert found > 30


@pytest.mark.parametrize("beams", [0, 3, 6, 7, 8, 13])
def test_few_beams_are_told_alike(beams: int) -> None:
    angle = np.deg2rad(np.arange(beams) * 0.5)
    plain, quick = both_ways(Scan(angle, 2.0 / np.cos(angle)), None)
    assert [len(line) for line in plain] == [len(line) for line in quick]


def circle(polar: FloatArray, noise: float) -> float:
    """Chi-squared of the circle through beams, from the package's own fit."""
    points = (polar[:2] * polar[2]).T
    found = fit_circle2(points)
    outward = (points - found.centre) / np.linalg.norm(points - found.centre, axis=1)[:, None]
    lean = np.maximum(np.abs((outward * polar[:2].T).sum(axis=1)), 0.2)
    return float(np.sum((found.distance(points) / lean / noise) ** 2 * polar[3]))


@pytest.mark.parametrize("noise", [1e-6, 1e-3])
def test_a_circle_fits_as_well_as_by_singular_values(noise: float) -> None:
    from lidarpose.detect.scan_line_kernels import _circle_chi2

    rng = np.random.default_rng(2)
    for _ in range(30):
        turn = np.sort(rng.uniform(-1.0, 1.0, 12)) * rng.uniform(0.1, 1.4)
        points = np.array([2.0, 0.4]) + rng.uniform(0.05, 0.8) * np.column_stack([-np.cos(turn), np.sin(turn)])
        points += noise * rng.standard_normal(points.shape)
        angle, range_m = np.arctan2(points[:, 1], points[:, 0]), np.hypot(*points.T)
        polar = Beams(angle, range_m, rng.integers(1, 12, 12), None).polar
        assert _circle_chi2(polar, 0, 12, noise) == pytest.approx(circle(polar, noise), rel=1e-6)
