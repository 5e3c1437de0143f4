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


def fit_scan_line(scan_line: ScanLine, *, robust: bool = True) -> FittedLine:
    """Weighted line through a scan line's points.

    A point weighs by its range's standard deviation seen across the line; with `robust`, by Tukey's biweight too.

    Raises
    ------
    ValueError
        If there are fewer than two points.
    """
    points, beams = scan_line.points_lidar(), _beams(scan_line)
    if len(points) < 2:
        raise ValueError("a scan line needs two points")
    line = fit_line2(points)
    sigma = _sigma_across(line.normal, beams, scan_line.sigma_m)
    weight = 1.0 / sigma**2
    for _ in range(10 if robust else 1):
        line = fit_line2(points, weight)
        sigma = _sigma_across(line.normal, beams, scan_line.sigma_m)
        previous, weight = weight, 1.0 / sigma**2
        if robust:
            standardised = line.distance(points) / sigma
            weight = weight * tukey_weights(standardised / max(1.0, mad_sigma(standardised, centred=True)))
        if np.abs(weight - previous).max() <= 1e-4 * previous.max():
            break
    middle = weight @ points / weight.sum()
    along = (points - middle) @ line.direction
    used = weight > 0.0
    excess = max(1.0, float(weight @ line.distance(points) ** 2) / max(1, int(np.count_nonzero(used)) - 2))
    return FittedLine(
        line,
        line.project(middle),
        line.project(points[[0, -1]]),
        float(np.sqrt(excess / max(float(weight @ along**2), 1e-300))),
        float(np.sqrt(excess / weight.sum())),
        float(np.sqrt(np.mean(line.distance(points[used]) ** 2))),
    )


def fit_line_pair(first: FittedLine, second: FittedLine, alpha_rad: float) -> LinePair:
    """Both lines with the angle between them held at `alpha_rad` (eqs. (7) to (12)).

    The three numbers of the paper are the direction of the first line and both offsets. Where each line's direction
    and its offset at the middle of its points are independent, as least squares makes them, the offsets stay, and the
    misfit of alpha is shared according to how well each direction is known: that is the paper's fit, solved exactly
    up to the square of the misfit. Which side the second line lies to is taken from the lines fitted apart.

    Raises
    ------
    ValueError
        If the lines are parallel.
    """
    fitted = (first, second)
    free = free_directions(first, second)
    turn = alpha_rad if _cross(*free) > 0.0 else -alpha_rad
    angles = np.arctan2(free[:, 1], free[:, 0])
    misfit = float((angles[1] - angles[0] - turn + np.pi) % (2.0 * np.pi) - np.pi)
    variances = np.array([first.direction_sigma_rad**2, second.direction_sigma_rad**2])
    beta = float(angles[0] + misfit * variances[0] / variances.sum())
    normals = (_normal(beta), _normal(beta + turn))
    lines = [Line2(n, float(n @ f.middle)) for n, f in zip(normals, fitted, strict=True)]
    E = lines[0].intersection(lines[1])
    directions = np.stack([_leaving(E, line, f.middle) for line, f in zip(lines, fitted, strict=True)])
    extents = np.stack([np.sort((f.ends - E) @ d) for f, d in zip(fitted, directions, strict=True)])
    return LinePair(
        (lines[0], lines[1]),
        E,
        directions,
        alpha_rad,
        extents,
        float(np.hypot(first.rms_m, second.rms_m) / np.sqrt(2.0)),
        _covariance(lines, fitted),
    )


def free_directions(first: FittedLine, second: FittedLine) -> FloatArray:
    """Unit directions (2, 2) from the common point towards each line's points. Raises ValueError if parallel."""
    E = first.line.intersection(second.line)
    return np.stack([_leaving(E, fitted.line, fitted.middle) for fitted in (first, second)])


def _covariance(lines: list[Line2], fitted: tuple[FittedLine, FittedLine]) -> FloatArray:
    """Covariance (3, 3) of (x, y, turn) in the scan plane."""
    rows = []
    for line, f in zip(lines, fitted, strict=True):
        n, m = line.normal, f.middle
        rows.append(np.array([n[0], n[1], m[0] * n[1] - m[1] * n[0]]) / f.offset_sigma_m)
        rows.append(np.array([0.0, 0.0, 1.0 / f.direction_sigma_rad]))
    J = np.stack(rows)
    return np.asarray(np.linalg.inv(J.T @ J))


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
