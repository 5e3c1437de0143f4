"""The two scan lines in the LiDAR frame with the angle between them held (turntable paper, section 1.4).

Lines are unit normals and offsets, so nothing is singular where a line is vertical (eqs. (7) to (11) are), and the
second line may lie to either side of the first ((8) holds for one only).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.lines import Line2, fit_line2
from lidarpose.geometry.robust import mad_sigma, tukey_weights
from lidarpose.model.observation import ScanLine


@dataclass(frozen=True, eq=False)
class FittedLine:
    """A straight line through a scan line's points.

    Attributes
    ----------
    line
    middle : (2,)
        Weighted middle of the points, on the line.
    ends : (2, 2)
        First and last point, projected on the line, in order of the beams.
    direction_sigma_rad, offset_sigma_m
        Standard deviations of the direction, and of the offset at `middle`; independent of each other.
    rms_m
        Of the distances from the line.
    """

    line: Line2
    middle: FloatArray
    ends: FloatArray
    direction_sigma_rad: float
    offset_sigma_m: float
    rms_m: float


@dataclass(frozen=True, eq=False)
class LinePair:
    """Two lines that leave their common point E.

    Attributes
    ----------
    lines
    E_lidar : (2,)
    directions_lidar : (2, 2)
        Unit directions from E towards each line's points (eq. (12)).
    alpha_rad
        The angle between them: the one that was held, or the free one.
    extents_m : (2, 2)
        Nearest and farthest end of each line, as distances from E.
    rms_m
        Of the distances of all points from their lines.
    covariance : (3, 3)
        Of (x, y, turn): how well both lines together fix the LiDAR's place and turn in the scan plane, m and rad.
    """

    lines: tuple[Line2, Line2]
    E_lidar: FloatArray
    directions_lidar: FloatArray
    alpha_rad: float
    extents_m: FloatArray
    rms_m: float
    covariance: FloatArray


def fit_scan_line(scan_line: ScanLine) -> FittedLine:
    """Robust, weighted line through a scan line's points.

    A point weighs by its range's standard deviation seen across the line. Raises ValueError for fewer than two points.
    """
    points, beams = scan_line.points_lidar(), _beams(scan_line)
    if len(points) < 2:
        raise ValueError("a scan line needs two points")
    line = fit_line2(points)
    weight = np.ones(len(points))
    for _ in range(10):
        sigma = _sigma_across(line.normal, beams, scan_line.sigma_m)
        standardised = line.distance(points) / sigma
        weight = tukey_weights(standardised / max(1.0, mad_sigma(standardised, centred=True))) / sigma**2
        refined = fit_line2(points, weight)
        done = abs(abs(refined.normal @ line.normal) - 1.0) < 1e-15 and len(points) > 2
        line = refined
        if done:
            break
    middle = weight @ points / weight.sum()
    along = (points - middle) @ line.direction
    excess = max(1.0, float(weight @ line.distance(points) ** 2) / max(1, int(np.count_nonzero(weight)) - 2))
    inlying = line.distance(points[weight > 0.0])
    return FittedLine(
        line,
        line.project(middle),
        line.project(points[[0, -1]]),
        float(np.sqrt(excess / max(float(weight @ along**2), 1e-300))),
        float(np.sqrt(excess / weight.sum())),
        float(np.sqrt(np.mean(inlying**2))),
    )


def fit_line_pair(first: ScanLine, second: ScanLine, alpha_rad: float) -> LinePair:
    """Both lines at once, with the angle between them held at `alpha_rad` (eqs. (7) to (12)).

    Three numbers are estimated: the direction of the first line and both offsets. Weighted and robust as
    `fit_scan_line`; which side the second line lies to is taken from the lines fitted apart.

    Raises
    ------
    ValueError
        If a line has fewer than two points, or the two are parallel.
    """
    fitted = (fit_scan_line(first), fit_scan_line(second))
    free = free_directions(*fitted)
    turn = alpha_rad if _cross(*free) > 0.0 else -alpha_rad
    points = (first.points_lidar(), second.points_lidar())
    beams = (_beams(first), _beams(second))
    stated = (first.sigma_m, second.sigma_m)
    # Start where the misfit of alpha is shared by both lines, each according to how well its direction is known.
    angles = np.arctan2(free[:, 1], free[:, 0])
    misfit = (angles[1] - angles[0] - turn + np.pi) % (2.0 * np.pi) - np.pi
    variances = np.array([f.direction_sigma_rad**2 for f in fitted])
    beta = float(angles[0] + misfit * variances[0] / variances.sum())
    weights: list[FloatArray] = []
    for _ in range(20):
        normals = [_normal(beta), _normal(beta + turn)]
        weights = [_weights(n, p, b, s) for n, p, b, s in zip(normals, points, beams, stated, strict=True)]
        change = _turn_to_fit(normals, points, weights)
        beta += change
        if abs(change) < 1e-15:
            break
    normals = [_normal(beta), _normal(beta + turn)]
    lines = [Line2(n, float(w @ (p @ n) / w.sum())) for n, p, w in zip(normals, points, weights, strict=True)]
    E = lines[0].intersection(lines[1])
    directions = np.stack([_leaving(E, line, f.middle) for line, f in zip(lines, fitted, strict=True)])
    extents = np.stack([np.sort((f.ends - E) @ d) for f, d in zip(fitted, directions, strict=True)])
    rms, covariance = _spread(lines, points, weights)
    return LinePair((lines[0], lines[1]), E, directions, alpha_rad, extents, rms, covariance)


def free_directions(first: FittedLine, second: FittedLine) -> FloatArray:
    """Unit directions (2, 2) from the common point towards each line's points. Raises ValueError if parallel."""
    E = first.line.intersection(second.line)
    return np.stack([_leaving(E, fitted.line, fitted.middle) for fitted in (first, second)])


def _spread(
    lines: list[Line2], points: tuple[FloatArray, FloatArray], weights: list[FloatArray]
) -> tuple[float, FloatArray]:
    """Root mean square distance, and covariance (3, 3) of (x, y, turn) in the scan plane."""
    p, w = np.vstack(points), np.concatenate(weights)
    n = np.vstack([np.broadcast_to(line.normal, q.shape) for line, q in zip(lines, points, strict=True)])
    distance = np.concatenate([line.distance(q) for line, q in zip(lines, points, strict=True)])
    rows = np.column_stack([n, p[:, 0] * n[:, 1] - p[:, 1] * n[:, 0]])
    used = int(np.count_nonzero(w))
    excess = max(1.0, float(w @ distance**2) / max(1, used - 3))
    covariance = np.linalg.inv(rows.T @ (rows * w[:, None])) * excess
    return float(np.sqrt(np.mean(distance[w > 0.0] ** 2))), np.asarray(covariance)


def _turn_to_fit(normals: list[FloatArray], points: tuple[FloatArray, FloatArray], weights: list[FloatArray]) -> float:
    """Newton's step of the common turn, with both offsets eliminated: exact up to the turn's own square."""
    slope, curvature = 0.0, 0.0
    for normal, p, w in zip(normals, points, weights, strict=True):
        centred = p - w @ p / w.sum()
        across = centred @ normal
        along = centred @ np.array([-normal[1], normal[0]])
        slope += float(w @ (across * along))
        curvature += float(w @ (along**2 - across**2))
    return -slope / curvature if curvature > 0.0 else 0.0


def _weights(normal: FloatArray, points: FloatArray, beams: FloatArray, stated: FloatArray) -> FloatArray:
    sigma = _sigma_across(normal, beams, stated)
    across = points @ normal
    standardised = (across - np.median(across)) / sigma
    scale = max(1.0, mad_sigma(standardised))
    return np.asarray(tukey_weights(standardised / scale) / sigma**2)


def _sigma_across(normal: FloatArray, beams: FloatArray, stated: FloatArray) -> FloatArray:
    """A range's standard deviation as distance from the line; at grazing incidence never below a tenth of it."""
    return np.asarray(np.maximum(np.abs(beams @ normal), 0.1) * np.maximum(stated, 1e-9))


def _beams(scan_line: ScanLine) -> FloatArray:
    return np.column_stack([np.cos(scan_line.angle_rad), np.sin(scan_line.angle_rad)])


def _normal(direction_angle: float) -> FloatArray:
    return np.array([-np.sin(direction_angle), np.cos(direction_angle)])


def _cross(a: FloatArray, b: FloatArray) -> float:
    return float(a[0] * b[1] - a[1] * b[0])


def _leaving(E: FloatArray, line: Line2, middle: FloatArray) -> FloatArray:
    """The line's direction (2,) from E towards its points."""
    return line.direction if (middle - E) @ line.direction > 0.0 else -line.direction
