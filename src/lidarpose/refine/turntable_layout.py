"""Observations of a turntable session laid out for the estimate: one row a measurement, rows in lines.

A line is a stripe or a scan line on one panel at one place. What cannot be used is left out here, with its reason.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
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


def _lines(items: list[tuple[int, int, FloatArray, FloatArray]]) -> Lines:
    """`items`: place, slot, coordinate along the line, sigma."""
    start = np.concatenate([[0], np.cumsum([len(item[2]) for item in items], dtype=np.int64)]).astype(np.int64)
    along = []
    for _, _, coordinate, _ in items:
        low, high = coordinate.min(), coordinate.max()
        along.append((2.0 * coordinate - low - high) / max(high - low, 1e-12))
    return Lines(
        np.array([item[0] for item in items], dtype=np.int64),
        np.array([item[1] for item in items], dtype=np.int64),
        start,
        np.concatenate([*along, np.zeros(0)]),
        np.concatenate([*(item[3] for item in items), np.zeros(0)]),
    )


def _stripe_rows(camera: Camera, items: list[tuple[int, int, StripePoints]]) -> StripeRows:
    kept: list[tuple[int, int, FloatArray, FloatArray]] = []
    pixels: list[FloatArray] = [np.zeros((0, 2))]
    normals: list[FloatArray] = [np.zeros((0, 2))]
    for place, slot, stripe in items:
        good = np.isfinite(stripe.pixels).all(1) & np.isfinite(stripe.normals).all(1) & (stripe.sigma_px > 0.0)
        good &= np.isfinite(stripe.sigma_px)
        if good.sum() < 2:
            continue
        normal = stripe.normals[good]
        main = np.linalg.eigh(normal.T @ normal)[1][:, 0]
        kept.append((place, slot, stripe.pixels[good] @ main, stripe.sigma_px[good]))
        pixels.append(stripe.pixels[good])
        normals.append(normal)
    return stripe_rays(camera, _lines(kept), np.concatenate(pixels), np.concatenate(normals))


def stripe_rays(camera: Camera, lines: Lines, pixels: FloatArray, normals: FloatArray) -> StripeRows:
    """The rays of stripe pixels; pixels outside the distortion model's valid region get a direction without weight."""
    ideal = camera.undistort(pixels)
    lost = np.asarray(~np.isfinite(ideal).all(axis=1))
    ideal = np.where(lost[:, None], 0.0, ideal)
    rays = np.column_stack([ideal, np.ones(len(ideal))])
    _, J = camera.project_with_jacobian(rays) if len(rays) else (None, np.zeros((0, 2, 3)))
    inverse = np.linalg.inv(J[:, :, :2]) if len(rays) else np.zeros((0, 2, 2))
    per_px = np.einsum("nij,nj->ni", inverse, normals)
    per_focal = np.einsum("nij,nj->ni", inverse, -(pixels - camera.K[:2, 2]))
    flat = np.zeros((len(rays), 1))
    if lost.any():
        lines = replace(lines, sigma=np.where(lost, np.inf, lines.sigma))
    derivatives = [per_px, per_focal, -inverse[:, :, 0], -inverse[:, :, 1]]
    return StripeRows(lines, pixels, normals, rays, *(np.hstack([d, flat]) for d in derivatives))


def _range_rows(items: list[tuple[int, int, ScanLine]], has_intensity: bool) -> RangeRows:
    kept: list[tuple[int, int, FloatArray, FloatArray]] = []
    angles: list[FloatArray] = [np.zeros(0)]
    ranges: list[FloatArray] = [np.zeros(0)]
    intensities: list[FloatArray] = [np.zeros(0)]
    for place, slot, line in items:
        good = np.isfinite(line.angle_rad) & np.isfinite(line.range_m) & (line.range_m > 0.0)
        good &= np.isfinite(line.sigma_m) & (line.sigma_m > 0.0)
        if good.sum() < 2:
            continue
        kept.append((place, slot, line.angle_rad[good], line.sigma_m[good]))
        angles.append(line.angle_rad[good])
        ranges.append(line.range_m[good])
        intensities.append(np.zeros(int(good.sum())) if line.intensity is None else line.intensity[good])
    intensity = np.concatenate(intensities)
    darkness = _darkness(intensity) if has_intensity else np.zeros(len(intensity))
    return RangeRows(_lines(kept), np.concatenate(angles), np.concatenate(ranges), darkness)


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
