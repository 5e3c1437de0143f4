"""Observations of a turntable session laid out for the estimate: one row a measurement, rows in lines.

A line is a stripe or a scan line on one panel at one place. What cannot be used is left out here, with its reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, inverse_2x2
from lidarpose.model.camera import Camera
from lidarpose.model.observation import LeftOut, PanelCorners, ScanLine, StripePoints, TurntableObservations


@dataclass(frozen=True)
class Slot:
    """One panel in one placement: six numbers of the estimate."""

    placement: str
    panel: int


@dataclass(frozen=True, eq=False)
class Lines:
    """Measured lines of one kind, row after row; `start[j]:start[j + 1]` are the rows of line j.

    Attributes
    ----------
    place, slot : (S,)
        Which place and which panel each line belongs to.
    along : (N,)
        Where a row is on its line, from -1 to 1.
    sigma : (N,)
        Stated standard deviations, px or m.
    """

    place: IntArray
    slot: IntArray
    start: IntArray
    along: FloatArray
    sigma: FloatArray

    @property
    def count(self) -> int:
        return len(self.place)

    @cached_property
    def line_of_row(self) -> IntArray:
        return np.repeat(np.arange(self.count), np.diff(self.start))

    def with_growth(self, exponent: float) -> Lines:
        """The same with standard deviations that grow as this power of the stated ones; their median stays."""
        finite = self.sigma[np.isfinite(self.sigma)]
        if exponent == 1.0 or not len(finite):
            return self
        middle = float(np.median(finite))
        return replace(self, sigma=middle * (self.sigma / middle) ** max(exponent, 1e-3))


@dataclass(frozen=True, eq=False)
class StripeRows:
    """Stripe pixels as rays (z = 1), with their derivatives by a pixel across the stripe and by the camera's extras."""

    lines: Lines
    pixels: FloatArray
    normals: FloatArray
    rays: FloatArray
    ray_per_px: FloatArray
    ray_per_focal: FloatArray
    ray_per_x: FloatArray
    ray_per_y: FloatArray

    @cached_property
    def joined(self) -> FloatArray:
        """The ray and its derivatives side by side (N, 15)."""
        return np.concatenate([self.rays, *(getattr(self, name) for name in RAY_DERIVATIVES)], axis=1)

    @cached_property
    def ray_size_px(self) -> FloatArray:
        """Length (N,) of the ray's derivative by a pixel."""
        return np.asarray(np.linalg.norm(self.ray_per_px, axis=1))


RAY_DERIVATIVES = ("ray_per_px", "ray_per_focal", "ray_per_x", "ray_per_y")


@dataclass(frozen=True, eq=False)
class RangeRows:
    """Beams: angle, range, and how dark the target is (0 white, 1 black; NaN-free, zero where unknown)."""

    lines: Lines
    angle_rad: FloatArray
    range_m: FloatArray
    darkness: FloatArray

    @cached_property
    def beams(self) -> FloatArray:
        """Directions (2, N) in the scan plane."""
        return np.stack([np.cos(self.angle_rad), np.sin(self.angle_rad)])


@dataclass(frozen=True, eq=False)
class JointData:
    """Observations laid out for the estimate."""

    camera: Camera
    slots: tuple[Slot, ...]
    corners: tuple[PanelCorners, ...]
    centres: FloatArray
    positions: tuple[str, ...]
    angles_rad: FloatArray
    reference_rad: float
    stripes: StripeRows
    ranges: RangeRows
    has_intensity: bool
    left_out: tuple[LeftOut, ...]

    @cached_property
    def common_corner_modes(self) -> tuple[FloatArray, ...]:
        """By slot, what all corners of a panel can be off by together (2N, 3): in x, in y, and away from the middle.

        The first two are 1 where they are not 0, the third has a root mean square of 1.
        """
        return tuple(_common_modes(corners.pixels) for corners in self.corners)


def _common_modes(pixels: FloatArray) -> FloatArray:
    out = np.zeros((2 * len(pixels), 3))
    out[0::2, 0] = out[1::2, 1] = 1.0
    away = (pixels - pixels.mean(axis=0)).ravel()
    out[:, 2] = away / np.sqrt((away**2).mean())
    return out


def lay_out(observations: TurntableObservations, *, use_stripes: bool = True) -> JointData:
    """Rows of all measurements. Lines on panels without corners, and rows that are not finite, are left out."""
    slots = _slots(observations)
    index = {slot: k for k, slot in enumerate(slots)}
    left_out: list[LeftOut] = []
    stripes, ranges = [], []
    for i, place in enumerate(observations.places):
        for panel, stripe in place.stripes.items() if use_stripes else ():
            k = index.get(Slot(place.placement, panel))
            if k is None:
                left_out.append(LeftOut(f"stripe of {place.position} on panel {panel}", "the panel has no corners"))
            elif len(stripe) >= 2:
                stripes.append((i, k, stripe))
        for panel, line in place.scan_lines.items():
            k = index.get(Slot(place.placement, panel))
            if k is None:
                left_out.append(LeftOut(f"scan line of {place.position} on panel {panel}", "the panel has no corners"))
            elif len(line) >= 2:
                ranges.append((i, k, line))
    corners = tuple(observations.corners[s.placement][s.panel] for s in slots)
    angles = np.array([p.turntable_angle_rad for p in observations.places], dtype=np.float64)
    has_intensity = bool(ranges) and all(line.intensity is not None for _, _, line in ranges)
    return JointData(
        camera=observations.camera,
        slots=slots,
        corners=corners,
        centres=np.array([c.corners_panel.mean(axis=0) for c in corners]).reshape(-1, 3),
        positions=tuple(p.position for p in observations.places),
        angles_rad=angles,
        reference_rad=float(0.5 * (angles.min() + angles.max())) if len(angles) else 0.0,
        stripes=_stripe_rows(observations.camera, stripes),
        ranges=_range_rows(ranges, has_intensity),
        has_intensity=has_intensity,
        left_out=tuple(left_out),
    )


def thinned(data: JointData, rows_a_line: int) -> JointData:
    """The same with at most so many rows of each line, evenly spread."""
    stripes, ranges = data.stripes, data.ranges
    s_keep, s_lines = _thin_lines(stripes.lines, rows_a_line)
    r_keep, r_lines = _thin_lines(ranges.lines, rows_a_line)
    return replace(
        data,
        stripes=StripeRows(
            s_lines,
            *(getattr(stripes, name)[s_keep] for name in ("pixels", "normals", "rays", *RAY_DERIVATIVES)),
        ),
        ranges=RangeRows(r_lines, *(getattr(ranges, n)[r_keep] for n in ("angle_rad", "range_m", "darkness"))),
    )


def _thin_lines(lines: Lines, rows_a_line: int) -> tuple[IntArray, Lines]:
    keep = [np.zeros(0, dtype=np.int64)]
    for a, b in zip(lines.start[:-1], lines.start[1:], strict=True):
        n = min(int(b - a), rows_a_line)
        keep.append(a + (np.arange(n) * (b - a)) // max(n, 1))
    index = np.concatenate(keep)
    start = np.cumsum([len(k) for k in keep], dtype=np.int64)
    return index, Lines(lines.place, lines.slot, start, lines.along[index], lines.sigma[index])


def _slots(observations: TurntableObservations) -> tuple[Slot, ...]:
    used = {(p.placement, k) for p in observations.places for k in (*p.stripes, *p.scan_lines)}
    return tuple(
        Slot(placement, k)
        for placement, corners in observations.corners.items()
        for k in range(len(corners))
        if (placement, k) in used and len(corners[k].pixels) >= 4
    )


def _of_two_rows(good: BoolArray, count: Sequence[int]) -> tuple[list[int], IntArray, BoolArray]:
    """Lines with two good rows or more: which, their numbers of good rows, and the rows (N,) that are kept."""
    line = np.repeat(np.arange(len(count)), count)
    left = np.bincount(line[good], minlength=len(count))
    return np.flatnonzero(left >= 2).tolist(), left[left >= 2], np.asarray(good & (left >= 2)[line])


def _starts(count: IntArray) -> IntArray:
    """Where lines of so many rows begin, and where the last one ends."""
    return np.concatenate([[0], np.cumsum(count, dtype=np.int64)]).astype(np.int64)


def _lines(owners: Sequence[tuple[int, int]], count: IntArray, coordinate: FloatArray, sigma: FloatArray) -> Lines:
    """Lines of so many rows each on places and slots; rows' coordinates along them and standard deviations (N,)."""
    start = _starts(count)
    along = coordinate
    if len(count):
        low, high = (np.repeat(end.reduceat(coordinate, start[:-1]), count) for end in (np.minimum, np.maximum))
        along = (2.0 * coordinate - low - high) / np.maximum(high - low, 1e-12)
    place, slot = np.array(owners, dtype=np.int64).reshape(-1, 2).T
    return Lines(place, slot, start, along, sigma)


def _stripe_rows(camera: Camera, items: list[tuple[int, int, StripePoints]]) -> StripeRows:
    if not items:
        none = np.zeros((0, 2))
        return stripe_rays(camera, _lines([], np.zeros(0, dtype=np.int64), none[:, 0], none[:, 0]), none, none)
    pixels, normals = (np.concatenate([getattr(s, name) for _, _, s in items]) for name in ("pixels", "normals"))
    sigma = np.concatenate([s.sigma_px for _, _, s in items])
    good = np.isfinite(pixels).all(axis=1) & np.isfinite(normals).all(axis=1) & (sigma > 0.0) & np.isfinite(sigma)
    kept, count, good = _of_two_rows(good, [len(s) for _, _, s in items])
    pixels, normals, sigma = pixels[good], normals[good], sigma[good]
    # Along the direction that a stripe's normals have least of.
    scatter = np.zeros((0, 2, 2))
    if kept:
        scatter = np.add.reduceat(normals[:, :, None] * normals[:, None, :], _starts(count)[:-1])
    main = np.repeat(np.linalg.eigh(scatter)[1][:, :, 0], count, axis=0)
    lines = _lines([items[k][:2] for k in kept], count, (pixels * main).sum(axis=1), sigma)
    return stripe_rays(camera, lines, pixels, normals)


def stripe_rays(camera: Camera, lines: Lines, pixels: FloatArray, normals: FloatArray) -> StripeRows:
    """The rays of stripe pixels; pixels outside the distortion model's valid region get a direction without weight."""
    ideal = camera.undistort(pixels)
    lost = np.asarray(~np.isfinite(ideal).all(axis=1))
    ideal = np.where(lost[:, None], 0.0, ideal)
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    _, J = camera.project_with_jacobian(rays) if len(rays) else (None, np.zeros((0, 2, 3)))
    inverse = inverse_2x2(J[:, :, :2])
    per_px = (inverse @ normals[:, :, None])[:, :, 0]
    per_focal = (inverse @ (camera.K[:2, 2] - pixels)[:, :, None])[:, :, 0]
    flat = np.zeros((len(rays), 1))
    if lost.any():
        lines = replace(lines, sigma=np.where(lost, np.inf, lines.sigma))
    derivatives = [per_px, per_focal, -inverse[:, :, 0], -inverse[:, :, 1]]
    return StripeRows(lines, pixels, normals, rays, *(np.hstack([d, flat]) for d in derivatives))


def _range_rows(items: list[tuple[int, int, ScanLine]], has_intensity: bool) -> RangeRows:
    if not items:
        none = np.zeros(0)
        return RangeRows(_lines([], np.zeros(0, dtype=np.int64), none, none), none, none, none)
    angle, measured, sigma = (
        np.concatenate([getattr(line, name) for _, _, line in items]) for name in ("angle_rad", "range_m", "sigma_m")
    )
    good = np.isfinite(angle) & np.isfinite(measured) & (measured > 0.0) & np.isfinite(sigma) & (sigma > 0.0)
    kept, count, good = _of_two_rows(good, [len(line) for _, _, line in items])
    angle, measured = angle[good], measured[good]
    darkness: FloatArray = np.zeros(len(angle))
    if has_intensity:
        darkness = _darkness(
            np.concatenate([line.intensity for _, _, line in items if line.intensity is not None])[good]
        )
    return RangeRows(_lines([items[k][:2] for k in kept], count, angle, sigma[good]), angle, measured, darkness)


def _darkness(intensity: FloatArray) -> FloatArray:
    """0 for the brighter of two classes of beams (Otsu's threshold), 1 for the darker; in between for mixed ones."""
    finite = np.isfinite(intensity)
    if finite.sum() < 10:
        return np.zeros(len(intensity))
    values = np.sort(intensity[finite])
    n = len(values)
    below = np.cumsum(values)[:-1]
    count = np.arange(1, n)
    between = (below / count - (below[-1] + values[-1] - below) / (n - count)) ** 2 * count * (n - count)
    cut = int(np.argmax(between)) + 1
    # Within a class brightness still varies with distance and slant; only what lies between the classes is mixed.
    dark, bright = float(np.quantile(values[:cut], 0.95)), float(np.quantile(values[cut:], 0.05))
    if not bright > dark:
        return np.asarray(np.where(finite, intensity < values[cut], 0.0))
    return np.asarray(np.where(finite, np.clip((bright - intensity) / (bright - dark), 0.0, 1.0), 0.0))
