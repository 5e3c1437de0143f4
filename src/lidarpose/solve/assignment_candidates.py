"""What each place may be by itself: ordered pairs of its scan lines that can lie on both panels, with their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, UncertainPose, log_so3, rotation_z
from lidarpose.model.camera import Camera
from lidarpose.model.observation import PlaceFeatures, ScanLine, StripePoints
from lidarpose.solve.light_plane import StripeOnPanel, StripePair, stripe_pair, stripes_on_panel
from lidarpose.solve.line_pair import FittedLine, fit_line_pair, fit_scan_line, free_directions
from lidarpose.solve.panel_pose import PanelPose
from lidarpose.solve.single_pose import single_pose
from lidarpose.solve.turntable_function import (
    information_in_own_frame,
)

LEAST_STRIPE_POINTS = 5
# Points of a stripe that the choice is made from.
STRIPE_POINTS = 150
# How far the lines' angle may differ from the stripes' beyond five sigma.
ALPHA_SLACK_RAD = np.deg2rad(1.0)
# A line may reach this far over the fold: noise of E, and a fold that is not sharp.
FOLD_SLACK_M = 0.03
# Shares of a stripe that its scan line covers, and of a scan line that its stripe covers, at least.
LEAST_STRIPE_COVERED = 0.5
LEAST_LINE_COVERED = 0.35


@dataclass(frozen=True, eq=False)
class Candidate:
    """One place's hypothesis: `lines` are the indices of the scan lines on panel 0 and panel 1."""

    place: int
    lines: tuple[int, int]
    sample: UncertainPose
    extents_m: FloatArray
    spacing_m: float
    fits: tuple[FittedLine, FittedLine]
    stripes: StripePair
    rays_camera: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class Pool:
    """All candidates of all places as arrays."""

    candidates: tuple[Candidate, ...]
    place: IntArray
    angle_rad: FloatArray
    rotation: FloatArray
    translation: FloatArray
    information: FloatArray
    places: int

    def misfits(self, T_w: Pose, T_m: Pose) -> FloatArray:
        """Distance (C,) of each candidate from a motion, in its own sigmas."""
        turned = T_w.rotation @ rotation_z(self.angle_rad)
        back = np.swapaxes(turned @ T_m.rotation, -1, -2)
        shift = self.translation - (turned @ T_m.translation + T_w.translation)
        e = np.concatenate([(back @ shift[..., None])[..., 0], log_so3(back @ self.rotation)], axis=1)
        return np.asarray(np.sqrt(np.einsum("na,nab,nb->n", e, self.information, e) / 6.0))


def candidates_of(
    poses: Sequence[PanelPose],
    index: int,
    place: PlaceFeatures,
    on_panels: tuple[StripeOnPanel, StripeOnPanel] | None,
) -> list[Candidate]:
    """Ordered pairs of a place's lines that may be the board. Raises ValueError with the reason if there is none."""
    panels = [Plane.from_pose(p.T_camera_panel) for p in poses]
    if on_panels is None:
        missing = next(key for key in (0, 1) if not _has_stripe(place, key))
        raise ValueError(f"no usable stripe on panel {missing + 1}")
    stripes = stripe_pair((panels[0], panels[1]), on_panels)
    rays = (on_panels[0].rays_camera, on_panels[1].rays_camera)
    if len(place.lines) < 2:
        raise ValueError(f"the scan shows {len(place.lines)} straight lines; the board needs two")
    fits = [fit_scan_line(line, robust=False) for line in place.lines]
    found = []
    for i, j in _plausible_pairs(fits, stripes):
        lines = fit_line_pair(fits[i], fits[j], stripes.alpha_rad)
        sample = single_pose(stripes, lines)
        centre = sample.pose.translation
        # The panels show their faces to the camera, at the origin: the LiDAR must stand on the same side.
        if all(plane.distance(centre) * -plane.offset > 0.0 for plane in panels):
            spacing = max(_spacing(place.lines[i]), _spacing(place.lines[j]))
            found.append(Candidate(index, (i, j), sample, lines.extents_m, spacing, (fits[i], fits[j]), stripes, rays))
    if not found:
        raise ValueError("no two lines of the scan match the two stripes in angle, length and side")
    return found


def _has_stripe(place: PlaceFeatures, key: int) -> bool:
    return key in place.stripes and len(place.stripes[key]) >= LEAST_STRIPE_POINTS


def stripes_on_both_panels(
    camera: Camera, panel_poses: Mapping[str, Sequence[PanelPose]], places: Sequence[PlaceFeatures]
) -> dict[int, tuple[StripeOnPanel, StripeOnPanel]]:
    """Both stripes of each place, by the place's index, where it has both; those of one panel together."""
    found: dict[int, tuple[StripeOnPanel, StripeOnPanel]] = {}
    for placement, poses in panel_poses.items():
        lit = [k for k, p in enumerate(places) if p.placement == placement and _has_stripe(p, 0) and _has_stripe(p, 1)]
        if lit:
            first, second = (
                stripes_on_panel(camera, poses[key].T_camera_panel, [_thinned(places[k].stripes[key]) for k in lit])
                for key in (0, 1)
            )
            found.update(zip(lit, zip(first, second, strict=True), strict=True))
    return found


def _thinned(stripe: StripePoints) -> StripePoints:
    """Some of a stripe's points: enough for a choice."""
    if len(stripe) <= STRIPE_POINTS:
        return stripe
    some = np.unique(np.linspace(0, len(stripe) - 1, STRIPE_POINTS).astype(int))
    return StripePoints(stripe.pixels[some], stripe.normals[some], stripe.sigma_px[some])


def _plausible_pairs(fits: list[FittedLine], stripes: StripePair) -> list[tuple[int, int]]:
    return [(i, j) for i, j in permutations(range(len(fits)), 2) if _plausible(fits[i], fits[j], stripes)]


def _plausible(first: FittedLine, second: FittedLine, stripes: StripePair) -> bool:
    """Angle, gap at the fold and lengths of two lines against the stripes' (all as loose as sensors and edges are)."""
    cosine = abs(float(first.line.direction @ second.line.direction))
    sigma = float(np.hypot(first.direction_sigma_rad, second.direction_sigma_rad))
    slack = 5.0 * sigma + ALPHA_SLACK_RAD
    # Cheap first: the lines' directions without their senses.
    if abs(np.arccos(min(cosine, 1.0)) - min(stripes.alpha_rad, np.pi - stripes.alpha_rad)) > slack:
        return False
    try:
        directions = free_directions(first, second)
    except ValueError:
        return False
    alpha = float(np.arccos(np.clip(directions[0] @ directions[1], -1.0, 1.0)))
    if abs(alpha - stripes.alpha_rad) > slack:
        return False
    E = first.line.intersection(second.line)
    for fit, direction, (near, far) in zip((first, second), directions, stripes.extents_m, strict=True):
        low, high = np.sort((fit.ends - E) @ direction)
        common = min(high, far) - max(low, near)
        if low < -FOLD_SLACK_M - 0.1 * (high - low):
            return False
        if common < LEAST_STRIPE_COVERED * (far - near) or common < LEAST_LINE_COVERED * (high - low):
            return False
    return True


def _spacing(line: ScanLine) -> float:
    """Typical distance of neighbouring points of a scan line."""
    return float(np.median(np.linalg.norm(np.diff(line.points_lidar(), axis=0), axis=1)))


def pool_of(candidates: list[Candidate], angles: FloatArray) -> Pool:
    samples = [c.sample for c in candidates]
    information = information_in_own_frame([s.pose for s in samples], [s.covariance for s in samples])
    place = np.array([c.place for c in candidates])
    return Pool(
        tuple(candidates),
        place,
        angles[place],
        np.stack([c.sample.pose.rotation for c in candidates]),
        np.stack([c.sample.pose.translation for c in candidates]),
        information,
        len(angles),
    )
