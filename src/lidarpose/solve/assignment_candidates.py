"""What each place may be by itself: ordered pairs of its scan lines that can lie on both panels, with their poses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.robust import median
from lidarpose.geometry.se3 import UncertainPose
from lidarpose.model.camera import Camera
from lidarpose.model.observation import PlaceFeatures, ScanLine, StripePoints
from lidarpose.solve.light_plane import (
    LightPlane,
    StripeOnPanel,
    StripePair,
    fit_light_planes,
    stripe_pairs,
    stripes_on_panel,
)
from lidarpose.solve.line_pair import FittedLine, FittedLines, fit_line_pairs, fit_scan_lines, leaving_directions
from lidarpose.solve.panel_pose import PanelPose
from lidarpose.solve.single_pose import single_poses
from lidarpose.solve.turntable_function import (
    Motions,
    information_in_own_frame,
)

LEAST_STRIPE_POINTS = 5
# Points of a stripe that the choice is made from.
STRIPE_POINTS = 150
# How far the lines' angle may differ from the stripes' beyond five sigma.
ALPHA_SLACK_RAD = np.deg2rad(1.0)
# A line may reach this far over the fold: noise of E, and a fold that is not sharp.
FOLD_SLACK_M = 0.03
# Share of a scan line that its stripe covers, at least, and of a stripe that its scan line covers: half, or where that
# leaves a place none, as a piece of the line is lost or hidden, a fifth.
LEAST_LINE_COVERED = 0.35
LEAST_STRIPE_COVERED = (0.5, 0.2)


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

    def misfits(self, motions: Motions) -> FloatArray:
        """Distances (M, C) of the candidates from each motion, in their own sigmas."""
        e = motions.residuals(self.angle_rad, self.rotation, self.translation)
        weighted = (e[:, :, None] @ self.information)[:, :, 0]
        return np.asarray(np.sqrt((weighted * e).sum(axis=2) / 6.0))


def candidates_of(
    camera: Camera, panel_poses: Mapping[str, Sequence[PanelPose]], places: Sequence[PlaceFeatures]
) -> tuple[list[Candidate], dict[int, str]]:
    """Ordered pairs of the places' lines that may be the board; for places without any, by index, the reason."""
    reasons: dict[int, str] = {}
    planes = {name: [Plane.from_pose(p.T_camera_panel) for p in poses] for name, poses in panel_poses.items()}
    on_panels = stripes_on_both_panels(camera, panel_poses, places)
    stripes = _stripe_pairs(planes, places, on_panels, reasons)
    fits = fit_scan_lines([line for place in places for line in place.lines], robust=False)
    first_line = np.cumsum([0, *(len(place.lines) for place in places)]).tolist()
    pairs: list[tuple[int, int, int]] = []
    for k, place in enumerate(places):
        if k not in reasons and len(place.lines) < 2:
            reasons[k] = f"the scan shows {len(place.lines)} straight lines; the board needs two"
        if k not in reasons:
            pairs += [(k, i, j) for i, j in permutations(range(len(place.lines)), 2)]
    found = _candidates(planes, places, stripes, on_panels, fits, first_line, pairs)
    for k in set(range(len(places))) - {c.place for c in found} - reasons.keys():
        reasons[k] = "no two lines of the scan match the two stripes in angle, length and side"
    return found, reasons


def _stripe_pairs(
    planes: Mapping[str, Sequence[Plane]],
    places: Sequence[PlaceFeatures],
    on_panels: Mapping[int, tuple[StripeOnPanel, StripeOnPanel]],
    reasons: dict[int, str],
) -> dict[int, StripePair]:
    """Light plane and stripes by the place's index; where there are none, the reason is added to `reasons`."""
    found: dict[int, StripePair] = {}
    lit = list(on_panels)
    lights: dict[int, LightPlane] = {}
    for k, light in zip(lit, fit_light_planes([on_panels[k] for k in lit]), strict=True):
        if isinstance(light, ValueError):
            reasons[k] = str(light)
        else:
            lights[k] = light
    both = [(planes[places[k].placement][0], planes[places[k].placement][1]) for k in lights]
    for k, pair in zip(lights, stripe_pairs(both, [on_panels[k] for k in lights], list(lights.values())), strict=True):
        if isinstance(pair, ValueError):
            reasons[k] = str(pair)
        else:
            found[k] = pair
    for k, place in enumerate(places):
        if k not in on_panels:
            missing = next(key for key in (0, 1) if not _has_stripe(place, key))
            reasons[k] = f"no usable stripe on panel {missing + 1}"
    return found


def _candidates(
    planes: Mapping[str, Sequence[Plane]],
    places: Sequence[PlaceFeatures],
    stripes: Mapping[int, StripePair],
    on_panels: Mapping[int, tuple[StripeOnPanel, StripeOnPanel]],
    fits: FittedLines,
    first_line: Sequence[int],
    pairs: Sequence[tuple[int, int, int]],
) -> list[Candidate]:
    """Of pairs (place, line, line), those that may be the board."""
    if not pairs:
        return []
    ones = [fits.take(np.array([first_line[pair[0]] + pair[side] for pair in pairs])) for side in (1, 2)]
    alpha = np.array([stripes[k].alpha_rad for k, _, _ in pairs])
    extents = np.array([stripes[k].extents_m for k, _, _ in pairs])
    covered = _covered(ones[0], ones[1], alpha, extents)
    plausible = covered >= LEAST_STRIPE_COVERED[0]
    whole = {pair[0] for pair, is_plausible in zip(pairs, plausible, strict=True) if is_plausible}
    plausible |= (covered >= LEAST_STRIPE_COVERED[1]) & [k not in whole for k, _, _ in pairs]
    kept = np.flatnonzero(_either_way(pairs, plausible))
    pairs = [pairs[c] for c in kept.tolist()]
    lines = fit_line_pairs(ones[0].take(kept), ones[1].take(kept), alpha[kept])
    samples = single_poses([stripes[k] for k, _, _ in pairs], lines)
    single = {}
    found = []
    for c, (k, i, j) in enumerate(pairs):
        centre = samples[c].pose.translation
        # The panels show their faces to the camera, at the origin: the LiDAR must stand on the same side.
        if all(plane.distance(centre) * -plane.offset > 0.0 for plane in planes[places[k].placement]):
            for line in (i, j):
                if (k, line) not in single:
                    single[k, line] = fits.one(first_line[k] + line), _spacing(places[k].lines[line])
            (fit_i, spacing_i), (fit_j, spacing_j) = single[k, i], single[k, j]
            spacing, rays = max(spacing_i, spacing_j), (on_panels[k][0].rays_camera, on_panels[k][1].rays_camera)
            found.append(
                Candidate(k, (i, j), samples[c], lines.extents_m[c], spacing, (fit_i, fit_j), stripes[k], rays)
            )
    return found


def _either_way(pairs: Sequence[tuple[int, int, int]], plausible: BoolArray) -> BoolArray:
    """Pairs that are plausible themselves or exchanged.

    Broken lines may cover one panel's stripe just enough and the other's just not. If that kept one order and dropped
    the other, the one that is left would have no rival however badly it fits: lengths are weighed later, by all places.
    """
    good = {pair for pair, is_good in zip(pairs, plausible, strict=True) if is_good}
    return np.array([(k, i, j) in good or (k, j, i) in good for k, i, j in pairs])


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


def _covered(first: FittedLines, second: FittedLines, alpha: FloatArray, extents: FloatArray) -> FloatArray:
    """The share (C,) of either stripe, the lesser, that pairs of lines cover; 0 where they cannot be the board's.

    Angle, gap at the fold and lengths are held against the stripes': angle (C,), extents (C, 2, 2); all as loosely as
    sensors and edges are.
    """
    E, directions = leaving_directions(first, second)
    between = np.arccos(np.clip((directions[:, 0] * directions[:, 1]).sum(axis=1), -1.0, 1.0))
    slack = 5.0 * np.hypot(first.direction_sigma_rad, second.direction_sigma_rad) + ALPHA_SLACK_RAD
    # Comparisons with NaN, of lines that are parallel, are false.
    good = np.abs(between - alpha) <= slack
    covered = np.ones(len(alpha))
    for k, fit in enumerate((first, second)):
        along = np.sort(((fit.ends - E[:, None]) @ directions[:, k, :, None])[..., 0], axis=1)
        (low, high), (near, far) = along.T, extents[:, k].T
        common = np.minimum(high, far) - np.maximum(low, near)
        good &= low >= -FOLD_SLACK_M - 0.1 * (high - low)
        good &= common >= LEAST_LINE_COVERED * (high - low)
        covered = np.minimum(covered, common / (far - near))
    return np.where(good, covered, 0.0)


def _spacing(line: ScanLine) -> float:
    """Typical distance of neighbouring points of a scan line."""
    return median(np.linalg.norm(np.diff(line.points_lidar(), axis=0), axis=1))


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
