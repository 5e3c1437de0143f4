"""Beams that cross the edge of a flat patch, with the background each would see: what the edge model works from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.planes import Plane
from lidarpose.measure.beams import Beams, fit_plane_to_ranges, plane_frame, plane_ranges
from lidarpose.measure.edge_model import EdgeBeams, usual_spot
from lidarpose.measure.outline import grid_step, in_plane
from lidarpose.measure.patches import Patch

WIDEST_SPOT_M = 0.004
"""Beams whose axis passes the edge by less than this may have a spot on both sides, until a fit tells of wider ones."""
# Standard deviations of a spot from its axis to where nothing of it is left that matters.
_SPOT_ENDS = 2.5
_NEIGHBOURS = 14
# Noise of depths up to which those of one surface do not pass for mixed ones.
_CLEAR = 0.1


@dataclass(frozen=True, eq=False)
class PlaneView:
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

    @property
    def slant(self) -> float:
        """By what factor at most a round spot is drawn out on the plane: one over the cosine of the incidence."""
        return 1.0 / float(np.median(np.abs(self.beams.direction[self.plane_used] @ self.plane.normal)))


def spot_ends(spot_m: float) -> float:
    """How far a spot of this standard deviation reaches from its axis, at least `WIDEST_SPOT_M`."""
    return max(WIDEST_SPOT_M, _SPOT_ENDS * spot_m)


def box_of(beams: Beams, patch: Patch) -> Beams:
    """The part of the grid that the patch was looked for in."""
    part = patch.rows, patch.columns
    light = None if beams.light is None else beams.light[part]
    return Beams(beams.origin[part], beams.direction[part], beams.range_m[part], light)


def places_on(beams: Beams, patch: Patch) -> tuple[FloatArray, FloatArray, float]:
    """Where the box's beams meet the patch's plane (n, m, 2), the plane's frame, and the distance between beams."""
    box = box_of(beams, patch)
    frame = plane_frame(patch.plane, box.points[patch.mask])
    distance = plane_ranges(patch.plane, box)
    place = in_plane(box.origin + distance[..., None] * box.direction, patch.plane, frame)
    return place, frame, grid_step(place, patch.mask)


def view_of_patch(beams: Beams, patch: Patch, inner: BoolArray, sigma: float) -> PlaneView:
    """All beams of a patch's box on its plane, refitted to the ranges of the beams `inner` of the box.

    Raises
    ------
    ValueError
        If too few beams are left to fit the plane.
    """
    N, M = beams.range_m.shape
    index = np.arange(N * M).reshape(N, M)[patch.rows, patch.columns]
    _, _, step = places_on(beams, patch)
    flat = box_of(beams, patch).at(np.ones(patch.mask.shape, dtype=bool))
    on_plane = flat.at(inner.ravel())
    plane, covariance, rms, used = fit_plane_to_ranges(patch.plane, on_plane, max(sigma, 1e-6))
    frame = plane_frame(plane, on_plane.points)
    distance = plane_ranges(plane, flat)
    place = in_plane(flat.origin + distance[:, None] * flat.direction, plane, frame)
    return PlaneView(
        flat,
        index.ravel(),
        patch.mask.ravel(),
        plane,
        covariance,
        rms,
        np.flatnonzero(inner.ravel())[used],
        frame,
        place,
        flat.range_m - distance,
        step,
    )


def edge_beams(
    view: PlaneView,
    s: FloatArray,
    size: float,
    sigma: float,
    allowed: BoolArray | None = None,
    spot: float = WIDEST_SPOT_M,
) -> tuple[IntArray, EdgeBeams, float] | None:
    """The beams that cross an edge where it is free, with the background each would see; None if too few.

    Parameters
    ----------
    s : (n,)
        Each beam's distance from the edge, about, positive off the material.
    size
        Half the extent of what the edge bounds, metres: the zone does not reach farther than half of it.
    allowed : (n,)
        Beams to choose from; all if None.
    spot
        How far the beams' spots reach from their axes.
    """
    noise = max(sigma, view.plane_rms)
    spot = spot * view.slant
    zone = min(max(1.5 * spot, 3.0 * view.step), 0.5 * size)
    first = min(max(spot, 1.5 * view.step), 0.6 * size)
    allowed = np.ones(len(s), dtype=bool) if allowed is None else allowed
    reference = np.flatnonzero(allowed & (s > first) & (s < first + 5.0 * view.step))
    near = np.flatnonzero(allowed & (np.abs(s) < zone))
    if len(reference) < _NEIGHBOURS or len(near) < 20:
        return None
    front = np.isfinite(view.excess) & (view.excess < -5.0 * noise)
    near = near[~front[near]]
    if front.any():
        gap, _ = cKDTree(view.place[front & np.isfinite(view.place[:, 0])]).query(view.place[near])
        near = near[gap > 2.0 * view.step + spot]
    inner = s < -first
    dropout = float(np.mean(~np.isfinite(view.beams.range_m[inner]))) if inner.any() else 0.0
    dropout = min(max(dropout, 1e-4), 0.5)
    kept, open_, depth, depth_sigma = _backgrounds(view, reference, near, noise)
    if np.count_nonzero(kept) < 20:
        return None
    near, slope = near[kept], view.beams.direction[near[kept]] @ view.frame[1:].T
    light, light_sigma = _light(view, inner, near)
    light = None if light is None else np.where(open_[kept], light, np.nan)
    usual = usual_spot(float(np.median(view.beams.range_m[view.plane_used])))
    edge = EdgeBeams(view.place[near], slope, depth[kept], depth_sigma[kept], open_[kept], light, light_sigma, usual)
    mixes = _mixes(edge, s[near], 1.5 * view.step + 0.5 * spot, dropout)
    if mixes is False:
        near, edge = _hits_and_misses(near, edge)
    return near, replace(edge, mixing_seen=mixes is True), dropout


def _mixes(edge: EdgeBeams, s: FloatArray, reach: float, dropout: float) -> bool | None:
    """Whether spots on two surfaces are seen to give what neither gives alone: ranges between, or no return.

    Where none is seen among all beams that cross the edge, the instrument decides for one surface by a threshold that
    the data do not tell. None where noise hides it.
    """
    near = ~edge.open & (np.abs(s) < reach)
    depth, sigma = edge.depth[near], edge.depth_sigma[near]
    lost = float(np.mean(~np.isfinite(depth))) if depth.size else 0.0
    if lost > 2.0 * dropout + 0.02:
        return True
    # Only where a range between can be told from both.
    clear = sigma.max(axis=1) < _CLEAR
    depth, sigma = depth[clear], sigma[clear]
    if depth.size < max(0.5 * len(clear), 1):
        return None
    between = (depth > np.maximum(4.0 * sigma[:, 0], 0.2)) & (depth < 1.0 - np.maximum(4.0 * sigma[:, 1], 0.2))
    return bool(np.count_nonzero(between) > max(1, depth.size // 200))


def _hits_and_misses(near: IntArray, edge: EdgeBeams) -> tuple[IntArray, EdgeBeams]:
    """Beams of an instrument that never mixes: on the material or not."""
    known = edge.open | np.isfinite(edge.depth)
    depth = np.where(edge.depth < 0.5, 0.0, np.nan)
    return near[known], replace(edge, depth=depth, open=np.ones(len(edge), dtype=bool)).at(known)


def _light(view: PlaneView, inner: BoolArray, near: IntArray) -> tuple[FloatArray | None, float]:
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
    view: PlaneView, reference: IntArray, near: IntArray, noise: float
) -> tuple[BoolArray, BoolArray, FloatArray, FloatArray]:
    """For beams near the edge: usable (n,), open (n,), depth (n,), and the depth's noise on both sides (n, 2).

    The background's range at the edge is drawn there from the nearest beams that see it alone, as a plane.
    """
    tree = cKDTree(view.place[reference])
    _, neighbours = tree.query(view.place[near], k=_NEIGHBOURS)
    around = reference[neighbours]
    excess = view.excess[around]
    behind = excess > 5.0 * noise
    # The nearest beams that see something else than most of them (a face beside, a mixed range) tell nothing of it.
    far_off = np.abs(excess - _median_of(excess, behind))
    odd = behind & (far_off > 4.0 * np.maximum(1.4826 * _median_of(far_off, behind), noise))
    share_none = (~np.isfinite(excess)).mean(axis=1)
    blocked = (np.isfinite(excess) & ~behind).sum(axis=1) >= 2
    offset = view.place[around] - view.place[near][:, None]
    design = np.concatenate([np.ones((*behind.shape, 1)), offset / view.step], axis=-1)
    behind &= ~odd
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


def _median_of(values: FloatArray, chosen: BoolArray) -> FloatArray:
    """Medians (n, 1) of the chosen values of rows (n, k); 0 where none is chosen."""
    ordered = np.sort(np.where(chosen, values, np.inf), axis=1)
    count = chosen.sum(axis=1)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[:, None] // 2, axis=1)
    return np.where(np.isfinite(middle), middle, 0.0)
