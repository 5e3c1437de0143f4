"""Disks and round holes: found unaided in a grid of beams, measured by the beams that cross their edge."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.circles import Circle2
from lidarpose.geometry.planes import Plane
from lidarpose.measure.beams import Beams, fit_plane_to_ranges, moved_plane, plane_frame, plane_ranges
from lidarpose.measure.edge_model import EdgeBeams, EdgeFit, fit_edge, tells_threshold
from lidarpose.measure.outline import (
    LEAST_GAP,
    Kind,
    RoundOutline,
    border,
    find_circle,
    grid_step,
    in_plane,
    judge,
    rim,
    without_pinholes,
)
from lidarpose.measure.patches import Patch, find_patches

# Beams within this of the edge may have a spot on both sides, whatever the distance between beams.
_WIDEST_SPOT_M = 0.004
_NEIGHBOURS = 14


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
    box = _box(beams, patch)
    if np.nanmedian(np.abs(box.direction[patch.mask] @ patch.plane.normal)) < 0.17:
        # Seen at less than ten degrees: a slice through the air, or nothing that could be measured.
        return []
    frame = plane_frame(patch.plane, box.points[patch.mask])
    distance = plane_ranges(patch.plane, box)
    place = in_plane(box.origin + distance[..., None] * box.direction, patch.plane, frame)
    step = grid_step(place, patch.mask)
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


def _box(beams: Beams, patch: Patch) -> Beams:
    part = patch.rows, patch.columns
    light = None if beams.light is None else beams.light[part]
    return Beams(beams.origin[part], beams.direction[part], beams.range_m[part], light)


@dataclass(frozen=True, eq=False)
class _View:
    """All beams of a patch's box as a list, on its refined plane."""

    beams: Beams
    index: IntArray
    on: BoolArray
    plane: Plane
    plane_covariance: FloatArray
    plane_rms: float
    plane_used: IntArray
    frame: FloatArray
    place: FloatArray
    excess: FloatArray
    step: float


def _measure(beams: Beams, patch: Patch, outline: RoundOutline, sigma: float, seed: int) -> RoundMeasurement | None:
    circle = outline.circle
    for _ in range(3):
        view, place_circle = _view(beams, patch, circle, outline.kind, sigma)
        chosen = _edge_beams(view, place_circle, outline.kind, sigma)
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
        if moved < 0.75 * view.step:
            break
    return _result(view, outline, index, edge, fit)


def _in_patch_axes(circle: Circle2, view: _View, patch: Patch, beams: Beams) -> Circle2:
    """A circle in the view's axes, in those of the patch's first plane, where the next round starts."""
    frame = plane_frame(patch.plane, _box(beams, patch).points[patch.mask])
    centre = view.frame[0] + circle.centre @ view.frame[1:]
    return Circle2(in_plane(centre, patch.plane, frame), circle.radius)


def _view(beams: Beams, patch: Patch, circle: Circle2, kind: Kind, sigma: float) -> tuple[_View, Circle2]:
    """The box on its plane refitted to the ranges away from the edge, and the circle in the new axes."""
    N, M = beams.range_m.shape
    index = np.arange(N * M).reshape(N, M)[patch.rows, patch.columns]
    box = _box(beams, patch)
    frame = plane_frame(patch.plane, box.points[patch.mask])
    distance = plane_ranges(patch.plane, box)
    place = in_plane(box.origin + distance[..., None] * box.direction, patch.plane, frame)
    step = grid_step(place, patch.mask)
    guard = 1.5 * step + 0.5 * _WIDEST_SPOT_M
    s = circle.distance(place) * (1.0 if kind == "disk" else -1.0)
    inner = patch.mask & (s < -min(guard, 0.4 * circle.radius))
    centre = frame[0] + circle.centre @ frame[1:]
    flat = box.at(np.ones(box.range_m.shape, dtype=bool))
    plane, covariance, rms, used = fit_plane_to_ranges(patch.plane, flat.at(inner.ravel()), max(sigma, 1e-6))
    new_frame = plane_frame(plane, flat.at(inner.ravel()).points)
    distance = plane_ranges(plane, flat)
    new_place = in_plane(flat.origin + distance[:, None] * flat.direction, plane, new_frame)
    view = _View(
        flat,
        index.ravel(),
        patch.mask.ravel(),
        plane,
        covariance,
        rms,
        np.flatnonzero(inner.ravel())[used],
        new_frame,
        new_place,
        flat.range_m - distance,
        step,
    )
    return view, Circle2(in_plane(centre, plane, new_frame), circle.radius)


def _edge_beams(view: _View, circle: Circle2, kind: Kind, sigma: float) -> tuple[IntArray, EdgeBeams, float] | None:
    """The beams that cross the edge where it is free, with the background each would see; None if too few."""
    noise = max(sigma, view.plane_rms)
    s = circle.distance(view.place) * (1.0 if kind == "disk" else -1.0)
    zone = max(1.5 * _WIDEST_SPOT_M, 3.0 * view.step)
    zone = min(zone, 0.5 * circle.radius)
    first = min(max(_WIDEST_SPOT_M, 1.5 * view.step), 0.6 * circle.radius)
    reference = np.flatnonzero((s > first) & (s < first + 5.0 * view.step))
    near = np.flatnonzero(np.abs(s) < zone)
    if len(reference) < _NEIGHBOURS or len(near) < 20:
        return None
    front = np.isfinite(view.excess) & (view.excess < -5.0 * noise)
    near = near[~front[near]]
    if front.any():
        gap, _ = cKDTree(view.place[front & np.isfinite(view.place[:, 0])]).query(view.place[near])
        near = near[gap > 2.0 * view.step + _WIDEST_SPOT_M]
    inner = s < -first
    dropout = float(np.mean(~np.isfinite(view.beams.range_m[inner]))) if inner.any() else 0.0
    dropout = min(max(dropout, 1e-4), 0.5)
    kept, open_, depth, depth_sigma = _backgrounds(view, reference, near, noise)
    if np.count_nonzero(kept) < 20:
        return None
    near, slope = near[kept], view.beams.direction[near[kept]] @ view.frame[1:].T
    light, light_sigma = _light(view, inner, near)
    light = None if light is None else np.where(open_[kept], light, np.nan)
    edge = EdgeBeams(view.place[near], slope, depth[kept], depth_sigma[kept], open_[kept], light, light_sigma)
    if not _mixes(edge, s[near], view.step, dropout):
        near, edge = _hits_and_misses(near, edge)
    return near, edge, dropout


def _mixes(edge: EdgeBeams, s: FloatArray, step: float, dropout: float) -> bool:
    """True if spots on two surfaces are seen to give what neither gives alone: ranges between, or no return.

    Where none is seen among all beams that cross the edge, the instrument decides for one surface by a threshold that
    the data do not tell.
    """
    near = ~edge.open & (np.abs(s) < 1.5 * step + 0.5 * _WIDEST_SPOT_M)
    # Only where a range between can be told from both.
    clear = near & (edge.depth_sigma.max(axis=1) < 1.0 / 15.0)
    if np.count_nonzero(clear) < 0.5 * np.count_nonzero(near):
        return True
    depth, sigma = edge.depth[clear], edge.depth_sigma[clear]
    between = (depth > 5.0 * sigma[:, 0]) & (depth < 1.0 - 5.0 * sigma[:, 1])
    lost = float(np.mean(~np.isfinite(depth))) if depth.size else 0.0
    return int(np.count_nonzero(between)) > max(1, depth.size // 200) or lost > 2.0 * dropout + 0.02


def _hits_and_misses(near: IntArray, edge: EdgeBeams) -> tuple[IntArray, EdgeBeams]:
    """Beams of an instrument that never mixes: on the material or not."""
    known = edge.open | np.isfinite(edge.depth)
    depth = np.where(edge.depth < 0.5, 0.0, np.nan)
    return near[known], replace(edge, depth=depth, open=np.ones(len(edge), dtype=bool)).at(known)


def _light(view: _View, inner: BoolArray, near: IntArray) -> tuple[FloatArray | None, float]:
    """Light of beams relative to the material's, and its noise; None where it does not fall towards the edge."""
    if view.beams.light is None:
        return None, 1.0
    material = view.beams.light[inner & view.on]
    if len(material) < 20:
        return None, 1.0
    full = float(np.median(material))
    spread = 1.4826 * float(np.median(np.abs(material - full)))
    if not (full > 0.0 and spread < 0.15 * full):
        return None, 1.0
    light, sigma = view.beams.light[near] / full, max(spread / full, 1e-3)
    hit = np.isfinite(view.excess[near]) & view.on[near]
    faint = hit & (light < 1.0 - max(5.0 * sigma, 0.1))
    return (light, sigma) if np.count_nonzero(faint) >= 5 else (None, 1.0)


def _backgrounds(
    view: _View, reference: IntArray, near: IntArray, noise: float
) -> tuple[BoolArray, BoolArray, FloatArray, FloatArray]:
    """For beams near the edge: usable (n,), open (n,), depth (n,), and the depth's noise on both sides (n, 2).

    The background's range at the edge is drawn there from the nearest beams that see it alone, as a plane.
    """
    tree = cKDTree(view.place[reference])
    _, neighbours = tree.query(view.place[near], k=_NEIGHBOURS)
    around = reference[neighbours]
    excess = view.excess[around]
    behind = excess > 5.0 * noise
    share_none = (~np.isfinite(excess)).mean(axis=1)
    blocked = (np.isfinite(excess) & ~behind).sum(axis=1) >= 2
    offset = view.place[around] - view.place[near][:, None]
    design = np.concatenate([np.ones((*behind.shape, 1)), offset / view.step], axis=-1)
    weight = behind.astype(float)
    normal = np.einsum("nki,nk,nkj->nij", design, weight, design) + 1e-3 * np.diag([0.0, 1.0, 1.0])
    normal += np.where(behind.any(axis=1), 0.0, 1.0)[:, None, None] * np.eye(3)
    value = np.where(behind, excess, 0.0)
    solution = np.linalg.solve(normal, np.einsum("nki,nk->ni", design, weight * value)[..., None])[..., 0]
    residual = np.where(behind, value - np.einsum("nki,ni->nk", design, solution), 0.0)
    count = np.maximum(behind.sum(axis=1) - 3, 1)
    spread = np.sqrt((residual**2).sum(axis=1) / count)
    delta = solution[:, 0]
    drawn = spread * np.sqrt(np.linalg.inv(normal)[:, 0, 0])
    bounded = (share_none < 0.6) & (behind.sum(axis=1) >= 5) & (delta > 4.0 * noise)
    bounded &= spread < 5.0 * noise + 0.1 * np.abs(delta)
    open_ = share_none > 0.7
    # A background that is there but no plane (clutter, another edge): a beam ends on the material or behind it.
    clutter = ~bounded & ~open_ & (excess > 5.0 * noise).any(axis=1)
    usable = (bounded | open_ | clutter) & ~blocked
    safe = np.where(bounded, delta, 1.0)
    depth = view.excess[near] / safe
    depth = np.where(open_ & np.isfinite(depth), 0.0, depth)
    depth = np.where(clutter, np.where(view.excess[near] < 5.0 * noise, 0.0, np.nan), depth)
    far = np.sqrt(noise**2 + spread**2 + drawn**2)
    sigma = np.stack([np.full(len(near), noise), far], -1) / safe[:, None]
    # Something returned from behind where nothing else does: no edge of this disk.
    usable &= ~(open_ & (view.excess[near] > 5.0 * noise))
    return usable, open_ | clutter, depth, sigma


def _result(view: _View, outline: RoundOutline, near: IntArray, edge: EdgeBeams, fit: EdgeFit) -> RoundMeasurement:
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


def _plane_sigma(view: _View, near: IntArray, support: EdgeSupport) -> float:
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


def with_calibration(
    measurement: RoundMeasurement,
    perturbed_beams: Callable[[FloatArray, IntArray], Beams],
    covariance: FloatArray,
) -> RoundMeasurement:
    """The measurement with the calibration's share of the diameter's standard deviation.

    Parameters
    ----------
    perturbed_beams
        Gives the beams of flat indices under a small change (n,) of the calibration's parameters.
    covariance : (n, n)
        Of these parameters.
    """
    support = measurement.support
    plane_index = support.plane_index[:: max(1, len(support.plane_index) // 1500)]
    gradient = np.zeros(len(covariance))
    for k in range(len(covariance)):
        step = np.zeros(len(covariance))
        step[k] = 1e-5
        radii = []
        for sign in (1.0, -1.0):
            plane = fit_plane_to_ranges(support.plane, perturbed_beams(sign * step, plane_index), np.inf)[0]
            radii.append(circle_on_plane(perturbed_beams(sign * step, support.edge_index), plane, support))
        gradient[k] = (radii[0] - radii[1]) / 2e-5
    share = 2.0 * float(np.sqrt(max(float(gradient @ covariance @ gradient), 0.0)))
    return replace(measurement, calibration_sigma_m=share)
