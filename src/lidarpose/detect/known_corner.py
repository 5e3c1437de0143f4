"""A target's corner seen again: elsewhere, unturned, its three normals and outlines known from a first sighting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.cloud_planes import PlaneSearch, largest_component, segment_planes
from lidarpose.detect.crop import inside_box
from lidarpose.detect.plane_raster import mean_and_covariance
from lidarpose.detect.trihedral_corner import FaceMask, corner_of_faces, in_outline
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.planes import Plane
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.model.plane_patch import PlanePatch

# How far the corner may be from where it is looked for; and the faces' borders from the outlines known, which end at
# a scan line.
NEAR_M = 0.08
BORDER_M = 0.06
GATE_SIGMAS = 3.0
FEWEST = 30
# The share of the beams towards a face that have to end on it; what stands before it or beyond it takes the others.
SHARE = 0.6
MARGIN_M = 0.01
FIT_STEPS = 3
# What lies about the target beyond its faces, for the planes that border it.
AROUND_M = 0.15
# The same, and the rest of its faces, where its outlines show but a part of them.
MISSING_M = 0.35
STANDING_ROUNDS, STANDING_HYPOTHESES, STANDING_VOXEL_M = 2, 150, 0.04
VOXEL_KEY = np.array([1, 1 << 20, 1 << 40])


def corner_of_normals(points: NDArray[np.floating[Any]], normals: FloatArray, sigma_m: float) -> FloatArray:
    """The corner (3,) of three planes of known normals (3, 3), each where most of the points (N, 3) lie in it."""
    heights = normals @ points.T
    return np.asarray(np.linalg.solve(normals, [_mode(h, 4.0 * sigma_m) for h in heights]))


def _mode(values: FloatArray, width: float) -> float:
    """The mean of the values (N,) in the window of the width that holds most."""
    ordered = np.sort(values)
    ends = np.searchsorted(ordered, ordered + width, side="right")
    first = int(np.argmax(ends - np.arange(len(ordered))))
    return float(ordered[first : ends[first]].mean())


def surroundings(
    points: NDArray[np.floating[Any]], reference: CornerCandidate, corner: FloatArray, around_m: float = AROUND_M
) -> FloatArray:
    """The points (M, 3) of a cloud that `sight_again` has to see where the reference's target stands at a corner."""
    reach = max(float(np.linalg.norm(o - reference.corner, axis=1).max()) for o in reference.outlines)
    return _within(points, corner, 1.2 * reach + around_m)


def sight_again(
    places: Sequence[FloatArray],
    reference: CornerCandidate,
    corners: FloatArray,
    *,
    seed: int = 0,
    part_at: int | None = None,
) -> list[CornerCandidate] | None:
    """The reference's target near given spots at some places.

    Parameters
    ----------
    places : of (M, 3)
        For each place, the `surroundings` of its corner; the origin is at the sensor.
    reference
        A sighting of the target, which was not turned in between.
    corners : (P, 3)
        Where it should be at each place, to a few centimetres.
    part_at
        The place at which the reference was seen, where its outlines show but a part of each face; how far the faces
        reach is then found out there.

    Returns
    -------
    A sighting for each place, with the faces' own planes, outlines and obstacles. None where at some place one of the
    faces is not there, or most of the beams towards it end elsewhere.
    """
    planes, rest = [], []
    close = [
        _about(p, reference, c, AROUND_M if part_at is None else MISSING_M)
        for p, c in zip(places, corners, strict=True)
    ]
    for local, corner in zip(close, corners, strict=True):
        here = _planes(local, reference, corner)
        if here is None:
            return None
        planes.append(here)
        off = np.min([np.abs(plane.distance(local)) for plane in here], axis=0)
        rest.append(local[off > GATE_SIGMAS * reference.sigma_m])
    standing = _standing_planes(np.concatenate(rest), seed)
    if part_at is not None:
        whole = _whole(close[part_at], planes[part_at], standing, reference)
        if whole is None:
            return None
        reference = whole
    found = []
    for local, here, corner in zip(places, planes, corners, strict=True):
        sighting = _sighting(local, here, standing, reference, corner)
        if sighting is None:
            return None
        found.append(sighting)
    return found


def _whole(
    local: FloatArray, planes: Sequence[Plane], standing: Sequence[Plane], reference: CornerCandidate
) -> CornerCandidate | None:
    """The reference with whole faces: all that hangs together on each of its planes; None where that is no corner.

    What its outlines show belongs to it even so: on a face that is seen along, scan lines are far apart.
    """
    everywhere, columns, corner = np.arange(len(local)), np.ascontiguousarray(local.T), _meeting(planes)
    patches = _shared_out(local, [(plane, everywhere) for plane in planes], standing, reference.sigma_m)
    single = local.astype(np.float32)
    faces = []
    for k, patch in enumerate(patches[:3]):
        mine = np.zeros(len(local), dtype=bool)
        mine[patch.indices] = True
        whole = largest_component(single, mine, patch.plane)
        shown = _over_outline(columns, reference, k, corner, BORDER_M)[0]
        whole[shown[mine[shown]]] = True
        together = np.flatnonzero(whole)
        if len(together) < FEWEST:
            return None
        faces.append(replace(patch, indices=together))
    bordering = [patch for patch in patches[3:] if len(patch) >= FEWEST]
    found = corner_of_faces(local, (*faces, *bordering))
    if found is None or found.convex != reference.convex or found.support < reference.support // 2:
        return None
    return found if np.linalg.norm(found.corner - reference.corner) < NEAR_M else None


def _sighting(
    local: FloatArray,
    planes: Sequence[Plane],
    standing: Sequence[Plane],
    reference: CornerCandidate,
    corner: FloatArray,
) -> CornerCandidate | None:
    own = _meeting(planes)
    everything, local = local, _about(local, reference, own, AROUND_M)
    columns = np.ascontiguousarray(local.T)
    faces = [(plane, _over_outline(columns, reference, k, own, BORDER_M)[0]) for k, plane in enumerate(planes)]
    patches = _shared_out(local, faces, standing, reference.sigma_m)
    if min(len(patch) for patch in patches[:3]) < FEWEST:
        return None
    bordering = tuple(patch for patch in patches[3:] if len(patch) >= FEWEST)
    found = corner_of_faces(local, (*patches[:3], *bordering))
    if found is None or found.convex != reference.convex or np.linalg.norm(found.corner - corner) > NEAR_M:
        return None
    return found if _is_in_view(everything, found, reference) else None


def _about(points: FloatArray, reference: CornerCandidate, corner: FloatArray, margin_m: float) -> FloatArray:
    """The points (M, 3) of (N, 3) in the box about the reference's outlines, were the target's corner here."""
    outlines = np.concatenate(reference.outlines) + (corner - reference.corner)
    return np.asarray(inside_box(points, outlines.min(axis=0) - margin_m, outlines.max(axis=0) + margin_m))


def _meeting(planes: Sequence[Plane]) -> FloatArray:
    return np.asarray(np.linalg.solve([p.normal for p in planes], [p.offset for p in planes]))


def _within(points: NDArray[np.floating[Any]], centre: FloatArray, radius: float) -> FloatArray:
    """Points (M, 3) within a radius: most fall out by one coordinate alone."""
    slab = inside_box(points, centre - radius, centre + radius)
    offset = slab - centre
    near = np.flatnonzero(np.einsum("ij,ij->i", offset, offset) < radius * radius)
    return np.asarray(slab.take(near, axis=0), dtype=np.float64)


def _planes(local: FloatArray, reference: CornerCandidate, corner: FloatArray) -> list[Plane] | None:
    """The three planes of the target near their known places."""
    columns = np.ascontiguousarray(local.T)
    planes = []
    for k, normal in enumerate(reference.normals):
        chosen, height = _over_outline(columns, reference, k, corner, NEAR_M)
        if len(chosen) < FEWEST:
            return None
        middle = _mode(height, 4.0 * reference.sigma_m)
        plane = _fitted(local, chosen, Plane(normal, float(normal @ corner) + middle), reference.sigma_m)
        if plane is None:
            return None
        planes.append(plane)
    return planes if np.linalg.norm(_meeting(planes) - corner) < NEAR_M else None


def _over_outline(
    columns: FloatArray, reference: CornerCandidate, face: int, corner: FloatArray, within_m: float
) -> tuple[IntArray, FloatArray]:
    """Which points (3, N) lie near a face and over its known outline, widened by `within_m`, were the target's corner
    here, and their heights above it."""
    normal = reference.normals[face]
    height = normal @ columns - normal @ corner
    chosen = np.flatnonzero(np.abs(height) < within_m)
    flat = columns.take(chosen, axis=1) - normal[:, None] * height[chosen]
    chosen = chosen[in_outline(flat, reference.outlines[face] + (corner - reference.corner), normal, within_m)]
    return chosen, height[chosen]


def _fitted(local: FloatArray, chosen: IntArray, plane: Plane, sigma_m: float) -> Plane | None:
    members = local[chosen]
    for _ in range(FIT_STEPS):
        inside = members.take(np.flatnonzero(np.abs(plane.distance(members)) < GATE_SIGMAS * sigma_m), axis=0)
        if len(inside) < FEWEST:
            return None
        mean, covariance = mean_and_covariance(inside)
        values, axes = np.linalg.eigh(covariance)
        if values[1] < 4.0 * values[0]:
            return None
        normal = axes[:, 0] if axes[:, 0] @ plane.normal > 0.0 else -axes[:, 0]
        plane = Plane(normal, float(normal @ mean))
    return plane


def _standing_planes(rest: FloatArray, seed: int) -> list[Plane]:
    """What borders the target and stands still: the same planes at all places, found in all their points (N, 3)."""
    # Scan lines that fall on one another crowd, and look like lines and no surface: one point a voxel.
    _, first = np.unique(np.floor(rest / STANDING_VOXEL_M).astype(np.int64) @ VOXEL_KEY, return_index=True)
    search = PlaneSearch(
        min_points=FEWEST, max_rounds=STANDING_ROUNDS, from_sensor=True, seed=seed, hypotheses=STANDING_HYPOTHESES
    )
    return [patch.plane for patch in segment_planes(rest[first], search)]


def _shared_out(
    local: FloatArray, faces: Sequence[tuple[Plane, IntArray]], standing: Sequence[Plane], sigma_m: float
) -> tuple[PlanePatch, ...]:
    """The faces, and the planes that stand still, each with the points (N, 3) that are nearest to it."""
    everywhere = np.arange(len(local))
    surfaces = [*faces, *((plane, everywhere) for plane in standing)]
    distance = np.full((len(surfaces), len(local)), np.inf)
    for row, (plane, chosen) in zip(distance, surfaces, strict=True):
        row[chosen] = np.abs(plane.distance(local[chosen]))
    nearest = np.argmin(distance, axis=0)
    gate_m = GATE_SIGMAS * sigma_m
    patches = []
    for k, (plane, _) in enumerate(surfaces):
        mine = np.flatnonzero((nearest == k) & (distance[k] < gate_m))
        spread_m = float(np.sqrt(np.mean(distance[k, mine] ** 2))) if len(mine) else sigma_m
        patches.append(PlanePatch(plane, mine, spread_m))
    return tuple(patches)


def _is_in_view(local: FloatArray, found: CornerCandidate, reference: CornerCandidate) -> bool:
    """Whether most beams towards each face's known outline end on the face."""
    shift = found.corner - reference.corner
    a, b, c = (o + shift for o in reference.outlines)
    range_m = np.sqrt(np.einsum("ij,ij->i", local, local))
    mask = FaceMask(found.corner, found.normals, found.convex, (a, b, c), found.obstacles, MARGIN_M)
    rays = np.ascontiguousarray(local.T) / range_m
    towards, met = mask.select(rays.T, range_m, np.inf)
    _, expected = mask.meet(rays.take(towards, axis=1).T)
    on_face = met[np.abs(range_m[towards] - expected) < 2.0 * GATE_SIGMAS * found.sigma_m]
    wanted, there = np.bincount(met, minlength=3), np.bincount(on_face, minlength=3)
    return bool((there >= SHARE * wanted).all() and (there >= FEWEST // 2).all())
