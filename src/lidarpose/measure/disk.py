"""Disks and round holes: found unaided in a grid of beams, measured by the beams that cross their edge."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.circles import Circle2
from lidarpose.geometry.planes import Plane
from lidarpose.measure.beams import (
    Beams,
    MovedBeams,
    calibration_sigmas,
    fit_plane_to_ranges,
    moved_plane,
    plane_frame,
    plane_ranges,
)
from lidarpose.measure.edge_beams import (
    WIDEST_SPOT_M,
    PlaneView,
    box_of,
    edge_beams,
    places_on,
    spot_ends,
    view_of_patch,
)
from lidarpose.measure.edge_model import EdgeBeams, EdgeFit, fit_edge, tells_threshold
from lidarpose.measure.outline import (
    LEAST_GAP,
    Kind,
    RoundOutline,
    border,
    find_circle,
    in_plane,
    judge,
    rim,
    without_pinholes,
)
from lidarpose.measure.patches import Patch, find_patches


@dataclass(frozen=True, eq=False)
class RoundMeasurement:
    """A measured disk or hole, in the camera frame.

    Attributes
    ----------
    diameter_m, centre, normal
        The normal points towards the LiDAR.
    edge_sigma_m, plane_sigma_m
        Standard deviations of the diameter from the edge (beams, spot and mixing) and from the plane.
    calibration_sigma_m
        From the calibration's covariance; None where it carries none.
    outermost_diameter_m
        The circle through the outermost points, as the turntable paper measures it: biased, for comparison.
    edge
        Posterior of the edge in the plane.
    covered
        Share of the circumference that beams determine.
    edge_beams, plane_beams
        How many beams took part.
    plane_rms_m
        Residuals of the ranges to the plane.
    open_share
        Share of the edge beams of which only hit or miss is known.
    threshold_known
        False if nothing tells which part of a spot must be on the material to be seen; the standard deviation then
        holds what that may make.
    support
        What is needed to see how the calibration moves the answer.
    """

    kind: Kind
    diameter_m: float
    centre: FloatArray
    normal: FloatArray
    edge_sigma_m: float
    plane_sigma_m: float
    calibration_sigma_m: float | None
    outermost_diameter_m: float
    edge: EdgeFit
    covered: float
    edge_beams: int
    plane_beams: int
    plane_rms_m: float
    open_share: float
    threshold_known: bool
    support: EdgeSupport

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the diameter, the calibration's share included where it is known."""
        parts = [self.edge_sigma_m, self.plane_sigma_m, self.calibration_sigma_m or 0.0]
        return float(np.linalg.norm(parts))


@dataclass(frozen=True, eq=False)
class EdgeSupport:
    """The beams behind a measurement: flat indices into the grid, and each edge beam's distance from the circle."""

    plane: Plane
    plane_index: IntArray
    edge_index: IntArray
    distance: FloatArray
    centre: FloatArray
    radius: float


def measure_round(
    beams: Beams, sigma: float, kind: Kind, *, sees_behind: bool = True, seed: int = 0
) -> list[RoundMeasurement]:
    """All disks (or holes) in a grid of beams, the best determined first.

    Parameters
    ----------
    beams
        A grid (N, M), in the camera frame.
    sigma
        Range noise, metres.
    sees_behind
        False if the viewpoint is not known well enough to say which beam passes the edge: then only the points on the
        plane count, and gaps between them.

    Returns
    -------
    Measurements without the calibration's share; empty if nothing round is there.
    """
    found = []
    for patch in find_patches(beams.points, sigma):
        for outline in _outlines(beams, patch, kind, seed):
            measurement = _measure(
                beams if sees_behind else _on_plane(beams, patch, sigma), patch, outline, sigma, seed
            )
            if measurement is not None and measurement.covered > 0.3:
                found.append(measurement)
    return sorted(found, key=lambda m: -m.covered * np.sqrt(m.edge_beams))


def _on_plane(beams: Beams, patch: Patch, sigma: float) -> Beams:
    """The beams with nothing but what lies on the patch's plane."""
    on = np.abs(beams.range_m - plane_ranges(patch.plane, beams)) < 6.0 * sigma
    return replace(beams, range_m=np.where(on, beams.range_m, np.nan))


def _outlines(beams: Beams, patch: Patch, kind: Kind, seed: int) -> list[RoundOutline]:
    box = box_of(beams, patch)
    if np.nanmedian(np.abs(box.direction[patch.mask] @ patch.plane.normal)) < 0.17:
        # Seen at less than ten degrees: a slice through the air, or nothing that could be measured.
        return []
    place, _, step = places_on(beams, patch)
    distance = plane_ranges(patch.plane, box)
    with np.errstate(invalid="ignore"):
        beyond = ~patch.mask & ~(box.range_m < distance)
    flat = np.isfinite(place).all(axis=-1)
    if kind == "disk":
        edges = [place[border(without_pinholes(patch.mask)) & flat]]
    else:
        edges = [rim(cavity, patch.mask, place, step) for cavity in _cavities(patch.mask)]
    outlines = []
    for edge in edges:
        extent = float(np.ptp(edge, axis=0).max()) if len(edge) else 0.0
        circle = find_circle(edge, 0.75 * step, smallest=3.0 * step, largest=0.75 * extent, seed=seed)
        if circle is None:
            continue
        none = ~np.isfinite(box.range_m)
        outline = judge(circle, edge, place[flat], patch.mask[flat], beyond[flat], none[flat], step)
        if outline is not None and outline.kind == kind:
            outlines.append(outline)
    return outlines


def _cavities(mask: BoolArray) -> list[BoolArray]:
    """The enclosed gaps of a patch."""
    labels, count = ndimage.label(~mask)
    outside = set(np.unique(np.r_[labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    cavities = [k for k in range(1, count + 1) if k not in outside and sizes[k] >= LEAST_GAP]
    return [labels == k for k in cavities]


def _measure(beams: Beams, patch: Patch, outline: RoundOutline, sigma: float, seed: int) -> RoundMeasurement | None:
    circle, spot = outline.circle, WIDEST_SPOT_M
    for _ in range(4):
        view, place_circle = _view(beams, patch, circle, outline.kind, sigma, spot)
        chosen = _chosen(view, place_circle, outline.kind, sigma, spot)
        if chosen is None:
            return None
        index, edge, dropout = chosen
        fit = fit_edge(
            edge,
            place_circle.centre,
            place_circle.radius,
            inside=outline.kind == "disk",
            dropout=dropout,
            reach=view.step,
            seed=seed,
        )
        moved = max(abs(fit.radius - place_circle.radius), float(np.linalg.norm(fit.centre - place_circle.centre)))
        circle = _in_patch_axes(Circle2(fit.centre, fit.radius), view, patch, beams)
        wide, spot = spot_ends(fit.spot_m) > 1.3 * spot, max(spot, spot_ends(fit.spot_m))
        if moved < 0.75 * view.step and not wide:
            break
    return _result(view, outline, index, edge, fit)


def _in_patch_axes(circle: Circle2, view: PlaneView, patch: Patch, beams: Beams) -> Circle2:
    """A circle in the view's axes, in those of the patch's first plane, where the next round starts."""
    frame = plane_frame(patch.plane, box_of(beams, patch).points[patch.mask])
    centre = view.frame[0] + circle.centre @ view.frame[1:]
    return Circle2(in_plane(centre, patch.plane, frame), circle.radius)


def _view(
    beams: Beams, patch: Patch, circle: Circle2, kind: Kind, sigma: float, spot: float
) -> tuple[PlaneView, Circle2]:
    """The box on its plane refitted to the ranges away from the edge, and the circle in the new axes."""
    place, frame, step = places_on(beams, patch)
    guard = 1.5 * step + 0.5 * spot
    s = circle.distance(place) * (1.0 if kind == "disk" else -1.0)
    view = view_of_patch(beams, patch, patch.mask & (s < -min(guard, 0.4 * circle.radius)), sigma)
    centre = frame[0] + circle.centre @ frame[1:]
    return view, Circle2(in_plane(centre, view.plane, view.frame), circle.radius)


def _chosen(
    view: PlaneView, circle: Circle2, kind: Kind, sigma: float, spot: float
) -> tuple[IntArray, EdgeBeams, float] | None:
    s = circle.distance(view.place) * (1.0 if kind == "disk" else -1.0)
    return edge_beams(view, s, circle.radius, sigma, spot=spot)


def _result(view: PlaneView, outline: RoundOutline, near: IntArray, edge: EdgeBeams, fit: EdgeFit) -> RoundMeasurement:
    normal = view.plane.normal
    if float(np.mean(view.beams.direction[near] @ normal)) > 0.0:
        normal = -normal
    offset = edge.place - fit.centre
    s = np.linalg.norm(offset, axis=1) - fit.radius
    support = EdgeSupport(view.plane, view.index[view.plane_used], view.index[near], s, fit.centre, fit.radius)
    count = min(72, max(8, len(near) // 4))
    sectors = np.unique(np.floor(np.arctan2(offset[:, 1], offset[:, 0]) / (2.0 * np.pi) * count))
    draft = RoundMeasurement(
        outline.kind,
        2.0 * fit.radius,
        view.frame[0] + fit.centre @ view.frame[1:],
        normal,
        2.0 * float(np.sqrt(fit.covariance[2, 2])),
        0.0,
        None,
        2.0 * outline.circle.radius,
        fit,
        min(1.0, len(sectors) / count),
        len(near),
        len(view.plane_used),
        view.plane_rms,
        float(edge.open.mean()),
        tells_threshold(edge),
        support,
    )
    return replace(draft, plane_sigma_m=_plane_sigma(view, near, support))


def _plane_sigma(view: PlaneView, near: IntArray, support: EdgeSupport) -> float:
    """Standard deviation of the diameter from that of the plane."""
    edge = view.beams.at(near)
    gradient = np.zeros(3)
    for k, h in enumerate((1e-4, 1e-4, 1e-4)):
        step = np.zeros(3)
        step[k] = h
        ends = [circle_on_plane(edge, moved_plane(view.plane, view.frame, sign * step), support) for sign in (1, -1)]
        gradient[k] = (ends[0] - ends[1]) / (2.0 * h)
    return 2.0 * float(np.sqrt(gradient @ view.plane_covariance @ gradient))


def circle_on_plane(edge: Beams, plane: Plane, support: EdgeSupport) -> float:
    """Radius of the circle that keeps each edge beam at its distance when the plane or the beams move.

    The edge lies where it does among the beams; when beams or plane move it moves along. Least squares.
    """
    distance = plane_ranges(plane, edge)
    hits = edge.origin + distance[:, None] * edge.direction
    frame = plane_frame(plane, hits)
    place = in_plane(hits, plane, frame)
    near = np.abs(support.distance) <= np.median(np.abs(support.distance))
    place, s = place[near], support.distance[near]
    centre, radius = place.mean(axis=0), support.radius
    for _ in range(20):
        offset = place - centre
        length = np.linalg.norm(offset, axis=1)
        J = np.column_stack([-offset / length[:, None], -np.ones(len(length))])
        step = np.linalg.lstsq(J, s - (length - radius), rcond=None)[0]
        centre, radius = centre + step[:2], radius + float(step[2])
        if np.abs(step).max() < 1e-12:
            break
    return radius


def with_calibration(measurement: RoundMeasurement, moved: MovedBeams, covariance: FloatArray) -> RoundMeasurement:
    """The measurement with the calibration's share of the diameter's standard deviation.

    Parameters
    ----------
    moved
        Gives the beams of flat indices under a small change (n,) of the calibration's parameters.
    covariance : (n, n)
        Of these parameters.
    """
    support = measurement.support
    plane_index = support.plane_index[:: max(1, len(support.plane_index) // 1500)]

    def diameter(change: FloatArray) -> FloatArray:
        plane = fit_plane_to_ranges(support.plane, moved(change, plane_index), np.inf)[0]
        return np.array([2.0 * circle_on_plane(moved(change, support.edge_index), plane, support)])

    return replace(measurement, calibration_sigma_m=float(calibration_sigmas(diameter, covariance)[0]))
