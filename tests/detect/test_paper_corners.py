"""The corner paper's planes, fitted along the beams."""

import numpy as np

from lidarpose.detect.paper_corners import _along_beams, _spread_both_ways
from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.planes import Plane


def face_beams(rng: np.random.Generator) -> FloatArray:
    """300 directions over a quarter of a radian."""
    return unit(np.column_stack([np.ones(300), rng.uniform(-0.12, 0.12, (300, 2))]))


def test_the_fit_along_beams_reaches_least_squares_and_forgets_where_it_began() -> None:
    rng = np.random.default_rng(1)
    normal = unit(np.array([-1.0, 0.4, -0.3]))
    plane = Plane(normal, -2.0)
    errors = []
    for _ in range(60):
        directions = face_beams(rng)
        exact = plane.offset / (directions @ normal)
        ranges = exact + rng.normal(0.0, 0.008, 300)
        ranges[:15] += rng.uniform(0.3, 1.0, 15)
        start = Plane(unit(normal + [0.0, 0.02, -0.02]), -2.008)
        fitted = _along_beams(directions, ranges, start)
        # Ranges to the plane m . u = 1 / range, solved by linear least squares on the good ones, as the reference.
        good = np.arange(300) >= 15
        weight = exact[good] ** 2
        m = np.linalg.lstsq(directions[good] * weight[:, None], weight / ranges[good], rcond=None)[0]
        best = Plane(m, 1.0)
        errors.append([np.degrees(np.arccos(min(1.0, abs(float(p.normal @ normal))))) for p in (fitted, best)])
    rms = np.sqrt((np.array(errors) ** 2).mean(axis=0))
    assert rms[0] < 1.1 * rms[1]


def test_one_scan_line_is_no_face() -> None:
    azimuth = np.linspace(-0.2, 0.2, 50)
    line = unit(np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(50, -0.1)]))
    assert not _spread_both_ways(line)
    second = unit(line + [0.0, 0.0, 0.03])
    assert _spread_both_ways(np.concatenate([line, second]))
    assert not _spread_both_ways(line[:5])
