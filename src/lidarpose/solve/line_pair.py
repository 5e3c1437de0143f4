"""The two scan lines in the LiDAR frame with the angle between them held (turntable paper, section 1.4).

Lines are unit normals and offsets, so nothing is singular where a line is vertical (eqs. (7) to (11) are), and the
second line may lie to either side of the first ((8) holds for one only). The lines of all places are fitted as one
table: for single ones NumPy's calls would cost more than its sums.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.lines import Line2
from lidarpose.geometry.robust import MAD_TO_SIGMA, row_medians, tukey_weights
from lidarpose.model.observation import ScanLine
from lidarpose.model.scan import polar_to_points

# Sines of the angle between lines below this have no common point.
PARALLEL = 1e-12


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
class FittedLines:
    """Many of them, as arrays (L, ...) of the same; `normal` (L, 2) and `offset` (L,) are the lines.

    A line whose points determine none is NaN throughout.
    """

    normal: FloatArray
    offset: FloatArray
    middle: FloatArray
    ends: FloatArray
    direction_sigma_rad: FloatArray
    offset_sigma_m: FloatArray
    rms_m: FloatArray

    @staticmethod
    def of(lines: Sequence[FittedLine]) -> FittedLines:
        return FittedLines(
            np.array([f.line.normal for f in lines]),
            np.array([f.line.offset for f in lines]),
            np.array([f.middle for f in lines]),
            np.array([f.ends for f in lines]),
            np.array([f.direction_sigma_rad for f in lines]),
            np.array([f.offset_sigma_m for f in lines]),
            np.array([f.rms_m for f in lines]),
        )

    def take(self, index: IntArray) -> FittedLines:
        return FittedLines(*(getattr(self, name)[index] for name in self.__dataclass_fields__))

    def one(self, k: int) -> FittedLine:
        """Line k. Raises ValueError if its points determine none."""
        if not np.isfinite(self.offset[k]):
            raise ValueError("a scan line needs two points")
        return FittedLine(
            Line2(self.normal[k], float(self.offset[k])),
            self.middle[k],
            self.ends[k],
            float(self.direction_sigma_rad[k]),
            float(self.offset_sigma_m[k]),
            float(self.rms_m[k]),
        )

    @property
    def direction(self) -> FloatArray:
        """Unit directions (L, 2): the normals turned by -90 degrees."""
        return np.stack([self.normal[:, 1], -self.normal[:, 0]], axis=1)


@dataclass(frozen=True, eq=False)
class LinePairs:
    """Pairs of lines that leave their common point E.

    Attributes
    ----------
    E_lidar : (C, 2)
    directions_lidar : (C, 2, 2)
        Unit directions from E towards each line's points (eq. (12)).
    extents_m : (C, 2, 2)
        Nearest and farthest end of each line, as distances from E.
    covariance : (C, 3, 3)
        Of (x, y, turn): how well both lines together fix the LiDAR's place and turn in the scan plane, m and rad.
    """

    E_lidar: FloatArray
    directions_lidar: FloatArray
    extents_m: FloatArray
    covariance: FloatArray

    def take(self, index: IntArray) -> LinePairs:
        return LinePairs(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def fit_scan_line(scan_line: ScanLine, *, robust: bool = True) -> FittedLine:
    """Weighted line through a scan line's points, as `fit_scan_lines` fits many.

    Raises
    ------
    ValueError
        If there are fewer than two points.
    """
    return fit_scan_lines([scan_line], robust=robust).one(0)


def fit_scan_lines(scan_lines: Sequence[ScanLine], *, robust: bool = True) -> FittedLines:
    """Weighted total least squares lines through the points of scan lines.

    A point weighs by its range's standard deviation seen across the line; with `robust`, by Tukey's biweight too.
    """
    count = np.array([len(line) for line in scan_lines])
    there: BoolArray = np.arange(count.max(initial=0)) < count[:, None]
    beams, points = np.zeros((2, *there.shape, 2))
    stated = np.ones(there.shape)
    angle = np.concatenate([line.angle_rad for line in scan_lines])
    beams[there] = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points[there] = polar_to_points(angle, np.concatenate([line.range_m for line in scan_lines]))
    stated[there] = np.maximum(np.concatenate([line.sigma_m for line in scan_lines]), 1e-9)
    with np.errstate(invalid="ignore", divide="ignore"):
        start = _weighted_lines(points, there.astype(np.float64))[0]
        first_weight = there / _sigma_across(start, beams, stated) ** 2
        normal, offset, weight = _settled(points, beams, stated, there, first_weight, robust)
        return _described(normal, offset, weight, points, count)


def _settled(
    points: FloatArray, beams: FloatArray, stated: FloatArray, there: BoolArray, weight: FloatArray, robust: bool
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Lines and weights after steps that each line takes until it has settled: ten at most, one if not robust."""
    normal, offset = np.empty((len(points), 2)), np.empty(len(points))
    active = np.arange(len(points))
    for _ in range(10 if robust else 1):
        x, old = points[active], weight[active]
        normal[active], offset[active] = n, d = _weighted_lines(x, old)
        sigma = _sigma_across(n, beams[active], stated[active])
        new = there[active] / sigma**2
        if robust:
            standardised = (_along(x, n) - d[:, None]) / sigma
            scale = MAD_TO_SIGMA * row_medians(np.abs(standardised), there[active])
            new = new * tukey_weights(standardised / np.maximum(scale, 1.0)[:, None])
        weight[active] = new
        active = active[np.abs(new - old).max(axis=1) > 1e-4 * old.max(axis=1)]
        if len(active) == 0:
            break
    return normal, offset, weight


def _weighted_lines(points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals (L, 2) and offsets (L,) of the lines through points (L, N, 2); NaN where they determine none."""
    mean = (weight[:, None, :] @ points)[:, 0] / weight.sum(axis=1)[:, None]
    d = (points - mean[:, None]) * np.sqrt(weight)[..., None]
    scatter = np.swapaxes(d, 1, 2) @ d
    # In closed form: twice the direction's angle is that of (difference of variances, twice the covariance).
    direction = 0.5 * np.arctan2(2.0 * scatter[:, 0, 1], scatter[:, 0, 0] - scatter[:, 1, 1])
    determined = (np.count_nonzero(weight > 0.0, axis=1) >= 2) & (scatter[:, 0, 0] + scatter[:, 1, 1] > 0.0)
    direction = np.where(determined, direction, np.nan)
    normal = np.stack([-np.sin(direction), np.cos(direction)], axis=1)
    return normal, np.einsum("li,li->l", normal, mean)


def _described(
    normal: FloatArray, offset: FloatArray, weight: FloatArray, points: FloatArray, count: IntArray
) -> FittedLines:
    """Middles, ends and standard deviations of fitted lines."""
    total = weight.sum(axis=1)
    middle = (weight[:, None, :] @ points)[:, 0] / total[:, None]
    along = _along(points - middle[:, None], np.stack([normal[:, 1], -normal[:, 0]], axis=1))
    squares = (_along(points, normal) - offset[:, None]) ** 2
    used = weight > 0.0
    n = np.count_nonzero(used, axis=1)
    excess = np.maximum(1.0, (weight * squares).sum(axis=1) / np.maximum(n - 2, 1))
    ends = np.stack([points[:, 0], points[np.arange(len(points)), np.maximum(count - 1, 0)]], axis=1)
    ends = ends - (_along(ends, normal) - offset[:, None])[..., None] * normal[:, None]
    return FittedLines(
        normal,
        offset,
        middle - (np.einsum("li,li->l", middle, normal) - offset)[:, None] * normal,
        ends,
        np.sqrt(excess / np.maximum((weight * along**2).sum(axis=1), 1e-300)),
        np.sqrt(excess / total),
        np.sqrt((squares * used).sum(axis=1) / np.maximum(n, 1)),
    )


def _along(points: FloatArray, direction: FloatArray) -> FloatArray:
    """Components (L, N) of points (L, N, 2) along one direction (L, 2) a line."""
    return np.asarray((points @ direction[..., None])[..., 0])


def fit_line_pairs(first: FittedLines, second: FittedLines, alpha_rad: FloatArray) -> LinePairs:
    """Pairs of lines with the angle between them held at `alpha_rad` (C,) (eqs. (7) to (12)).

    The three numbers of the paper are the direction of the first line and both offsets. Where each line's direction
    and its offset at the middle of its points are independent, as least squares makes them, the offsets stay, and the
    misfit of alpha is shared according to how well each direction is known: that is the paper's fit, solved exactly
    up to the square of the misfit. Which side the second line lies to is taken from the lines fitted apart. Pairs of
    parallel lines are NaN.
    """
    fitted = (first, second)
    free = leaving_directions(first, second)[1]
    turn = np.where(_cross(free[:, 0], free[:, 1]) > 0.0, alpha_rad, -alpha_rad)
    angles = np.arctan2(free[:, :, 1], free[:, :, 0])
    misfit = (angles[:, 1] - angles[:, 0] - turn + np.pi) % (2.0 * np.pi) - np.pi
    variances = [f.direction_sigma_rad**2 for f in fitted]
    beta = angles[:, 0] + misfit * variances[0] / (variances[0] + variances[1])
    normals = [np.stack([-np.sin(b), np.cos(b)], axis=1) for b in (beta, beta + turn)]
    held = [_with_normal(f, n) for f, n in zip(fitted, normals, strict=True)]
    E, directions = leaving_directions(held[0], held[1])
    extents = [
        np.sort(((f.ends - E[:, None]) @ directions[:, k, :, None])[..., 0], axis=1) for k, f in enumerate(fitted)
    ]
    return LinePairs(E, directions, np.stack(extents, axis=1), _covariance(held))


def leaving_directions(first: FittedLines, second: FittedLines) -> tuple[FloatArray, FloatArray]:
    """Common points (C, 2), and unit directions (C, 2, 2) from there towards each line's points; NaN if parallel."""
    det = _cross(first.normal, second.normal)
    with np.errstate(invalid="ignore", divide="ignore"):
        det = np.where(np.abs(det) < PARALLEL, np.nan, det)
        E = np.stack(
            [
                (first.offset * second.normal[:, 1] - second.offset * first.normal[:, 1]) / det,
                (second.offset * first.normal[:, 0] - first.offset * second.normal[:, 0]) / det,
            ],
            axis=1,
        )
    directions = []
    for fitted in (first, second):
        ahead = np.einsum("ci,ci->c", fitted.middle - E, fitted.direction) > 0.0
        directions.append(np.where(ahead[:, None], fitted.direction, -fitted.direction))
    directions = [np.where(np.isnan(det)[:, None], np.nan, d) for d in directions]
    return E, np.stack(directions, axis=1)


def free_directions(first: FittedLine, second: FittedLine) -> FloatArray:
    """Unit directions (2, 2) from the common point towards each line's points. Raises ValueError if parallel."""
    E = first.line.intersection(second.line)
    return np.stack([_leaving(E, fitted.line, fitted.middle) for fitted in (first, second)])


def _with_normal(lines: FittedLines, normal: FloatArray) -> FittedLines:
    """The same, turned about their middles."""
    offset = np.einsum("ci,ci->c", normal, lines.middle)
    return FittedLines(
        normal,
        offset,
        lines.middle,
        lines.ends,
        lines.direction_sigma_rad,
        lines.offset_sigma_m,
        lines.rms_m,
    )


def _covariance(lines: Sequence[FittedLines]) -> FloatArray:
    """Covariances (C, 3, 3) of (x, y, turn) in the scan plane."""
    J = np.zeros((len(lines[0].offset), 4, 3))
    for k, line in enumerate(lines):
        n, m = line.normal, line.middle
        J[:, 2 * k] = np.stack([n[:, 0], n[:, 1], _cross(m, n)], axis=1) / line.offset_sigma_m[:, None]
        J[:, 2 * k + 1, 2] = 1.0 / line.direction_sigma_rad
    return np.asarray(np.linalg.inv(np.swapaxes(J, 1, 2) @ J))


def _sigma_across(normal: FloatArray, beams: FloatArray, stated: FloatArray) -> FloatArray:
    """A range's standard deviation as distance from the line; at grazing incidence never below a tenth of it."""
    return np.asarray(np.maximum(np.abs(_along(beams, normal)), 0.1) * stated)


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def _leaving(E: FloatArray, line: Line2, middle: FloatArray) -> FloatArray:
    """The line's direction (2,) from E towards its points."""
    return line.direction if (middle - E) @ line.direction > 0.0 else -line.direction
