"""A target's corner seen again: elsewhere, unturned, its three normals and outlines known from a first sighting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.cloud_planes import PlaneSearch, largest_component, segment_planes
from lidarpose.detect.crop import inside_box
from lidarpose.detect.patch_evidence import first_in_each
from lidarpose.detect.plane_raster import mean_and_covariance
from lidarpose.detect.trihedral_corner import (
    KERNELS,
    MAX_MISSING_M,
    MIN_FACE_POINTS,
    ONE_SIDED,
    REACH_M,
    RIM_M,
    ROUND,
    FaceMask,
    corner_of_faces,
    outline_edges,
)
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, unit
from lidarpose.geometry.compiled import pays
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
# Beams farther from the outlines than this are towards no face.
VIEW_MARGIN_M = 0.1
FIT_STEPS = 3
# What lies about the target beyond its faces, for the planes that border it.
AROUND_M = 0.15
# The same, and the rest of its faces, where its outlines show but a part of them.
MISSING_M = 0.35
STANDING_ROUNDS, STANDING_HYPOTHESES, STANDING_VOXEL_M = 2, 150, 0.04
# By how much kernels have a place done sooner.
SAVED_S_PER_PLACE = 2e-3


@dataclass(frozen=True, eq=False)
class _Edges:
    """The outlines of a reference's faces as edges, all after one another: unit directions inward (E, 3), how far along
    each a face's points lie at least (E,), and where each face's begin (4,)."""

    inward: FloatArray
    least: FloatArray
    starts: IntArray
    vertices: FloatArray

    @staticmethod
    def of(reference: CornerCandidate) -> _Edges:
        """Of the reference, were its corner the origin."""
        edges = [
            outline_edges(o - reference.corner, n) for o, n in zip(reference.outlines, reference.normals, strict=True)
        ]
        inward, least = (np.concatenate(parts) for parts in zip(*edges, strict=True))
        vertices = np.concatenate(reference.outlines) - reference.corner
        return _Edges(inward, least, np.cumsum([0, *(len(least) for _, least in edges)]), vertices)

    def least_at(self, corner: FloatArray, slack_m: float) -> FloatArray:
        """How far along each edge's direction (E,) points lie at least, with the corner here and outlines widened."""
        return np.asarray(self.least + self.inward @ corner - slack_m)

    def by_face_at(self, corner: FloatArray) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """By face, its edges with the corner here."""
        least = self.least_at(corner, 0.0)
        return tuple((self.inward[i:j], least[i:j]) for i, j in pairwise(self.starts.tolist()))


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
    missing_m: float = MAX_MISSING_M,
    held: bool = False,
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
    pays(SAVED_S_PER_PLACE * len(places), KERNELS)
    planes, rest = [], []
    edges = _Edges.of(reference)
    close = [
        _about(p, reference, c, AROUND_M if part_at is None else MISSING_M)
        for p, c in zip(places, corners, strict=True)
    ]
    for local, corner in zip(close, corners, strict=True):
        here = (_held_planes if held else _planes)(local, reference, edges, corner)
        if here is None:
            return None
        planes.append(here)
        rest.append(_off_planes(local, here, GATE_SIGMAS * reference.sigma_m))
    standing = _standing_planes(np.concatenate(rest), seed)
    if part_at is not None:
        whole = _whole(close[part_at], planes[part_at], standing, reference, edges)
        if whole is None:
            return None
        reference, edges = whole, _Edges.of(whole)
    found = []
    for local, here, corner in zip(places, planes, corners, strict=True):
        sighting = _sighting(local, here, standing, reference, edges, corner, missing_m)
        if sighting is None:
            return None
        found.append(sighting)
    return found


def _whole(
    local: FloatArray,
    planes: Sequence[Plane],
    standing: Sequence[Plane],
    reference: CornerCandidate,
    edges: _Edges,
) -> CornerCandidate | None:
    """The reference with whole faces: all that hangs together on each of its planes; None where that is no corner.

    What its outlines show belongs to it even so: on a face that is seen along, scan lines are far apart.
    """
    corner = _meeting(planes)
    everywhere = np.ones((3, len(local)), dtype=bool)
    patches = _shared_out(local, [*planes, *standing], everywhere, reference.sigma_m)
    shown = _over_outlines(local, reference, edges, corner, BORDER_M)
    single = local.astype(np.float32)
    faces = []
    for k, patch in enumerate(patches[:3]):
        mine = np.zeros(len(local), dtype=bool)
        mine[patch.indices] = True
        together = np.flatnonzero(largest_component(single, mine, patch.plane) | (shown[k] & mine))
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
    edges: _Edges,
    corner: FloatArray,
    missing_m: float,
) -> CornerCandidate | None:
    own = _meeting(planes)
    if pays(0.0, KERNELS):
        return _sighting_compiled(local, own, [*planes, *standing], reference, edges, corner, missing_m)
    everything, local = local, _about(local, reference, own, AROUND_M)
    shown = _over_outlines(local, reference, edges, own, BORDER_M)
    patches = _shared_out(local, [*planes, *standing], shown, reference.sigma_m)
    if min(len(patch) for patch in patches[:3]) < FEWEST:
        return None
    bordering = tuple(patch for patch in patches[3:] if len(patch) >= FEWEST)
    found = corner_of_faces(local, (*patches[:3], *bordering), missing_m)
    if found is None or found.convex != reference.convex or np.linalg.norm(found.corner - corner) > NEAR_M:
        return None
    return found if _is_in_view(everything, found, reference, edges) else None


def _sighting_compiled(
    local: FloatArray,
    own: FloatArray,
    planes: Sequence[Plane],
    reference: CornerCandidate,
    edges: _Edges,
    corner: FloatArray,
    missing_m: float,
) -> CornerCandidate | None:
    """`_sighting` by kernels, the target's own corner known."""
    from lidarpose.detect.sighting_kernels import faces_seen, in_view

    rows = np.array([[*plane.normal, plane.offset] for plane in planes])
    lengths = np.array([AROUND_M, BORDER_M, REACH_M, missing_m, GATE_SIGMAS * reference.sigma_m])
    side, outlines, sizes, counts, spreads, borders = faces_seen(
        local,
        own,
        rows,
        np.ascontiguousarray(reference.normals),
        edges.vertices,
        edges.inward,
        edges.least,
        edges.starts,
        lengths,
        np.array([FEWEST, MIN_FACE_POINTS]),
        ONE_SIDED,
        ROUND,
    )
    if side != int(reference.convex) or sizes.min() < 3 or np.linalg.norm(own - corner) > NEAR_M:
        return None
    sigma_m = float(np.sort(spreads[:3])[1])
    seen_at = edges.vertices + own
    least, gate_m = edges.least_at(own, RIM_M), 2.0 * GATE_SIGMAS * sigma_m
    wanted, there = in_view(
        local,
        own,
        rows[:3],
        bool(reference.convex),
        seen_at,
        edges.inward,
        least,
        edges.starts,
        rows[borders],
        VIEW_MARGIN_M,
        MARGIN_M,
        gate_m,
    )
    if not _mostly_ends(wanted, there):
        return None
    a, b, c = (outline[:size].copy() for outline, size in zip(outlines, sizes, strict=True))
    obstacles = tuple(plane for plane, is_one in zip(planes, borders, strict=True) if is_one)
    return CornerCandidate(own, rows[:3, :3].copy(), reference.convex, (a, b, c), obstacles, int(counts.min()), sigma_m)


def _about(points: FloatArray, reference: CornerCandidate, corner: FloatArray, margin_m: float) -> FloatArray:
    """The points (M, 3) of (N, 3) in the box about the reference's outlines, were the target's corner here."""
    outlines = np.concatenate(reference.outlines) + (corner - reference.corner)
    return np.asarray(inside_box(points, outlines.min(axis=0) - margin_m, outlines.max(axis=0) + margin_m))


def _meeting(planes: Sequence[Plane]) -> FloatArray:
    return np.asarray(np.linalg.solve([p.normal for p in planes], [p.offset for p in planes]))


def _within(points: NDArray[np.floating[Any]], centre: FloatArray, radius: float) -> FloatArray:
    """Points (M, 3) within a radius: most fall out by one coordinate alone."""
    slab = inside_box(points, centre - radius, centre + radius)
    if slab.flags.c_contiguous and pays(0.0, "detect.target_kernels"):
        from lidarpose.detect.target_kernels import points_within

        return np.asarray(points_within(slab, centre, float(radius)))
    offset = slab - centre
    near = np.flatnonzero(np.einsum("ij,ij->i", offset, offset) < radius * radius)
    return np.asarray(slab.take(near, axis=0), dtype=np.float64)


def _planes(local: FloatArray, reference: CornerCandidate, edges: _Edges, corner: FloatArray) -> list[Plane] | None:
    """The three planes of the target near their known places."""
    if pays(0.0, KERNELS):
        from lidarpose.detect.sighting_kernels import planes_near

        least, gate_m = edges.least_at(corner, NEAR_M), GATE_SIGMAS * reference.sigma_m
        normals, sigma_m = np.ascontiguousarray(reference.normals), reference.sigma_m
        rows = planes_near(
            local, normals, corner, edges.inward, least, edges.starts, NEAR_M, sigma_m, gate_m, FIT_STEPS, FEWEST
        )
        planes = [Plane(row[:3], float(row[3])) for row in rows]
    else:
        planes = []
        columns = np.ascontiguousarray(local.T)
        for k, normal in enumerate(reference.normals):
            chosen, height = _over_outline(columns, reference, edges, k, corner, NEAR_M)
            plane = _fitted_near(local, chosen, height, normal, float(normal @ corner), reference.sigma_m)
            if plane is None:
                return None
            planes.append(plane)
    return planes if len(planes) == 3 and np.linalg.norm(_meeting(planes) - corner) < NEAR_M else None


def _held_planes(
    local: FloatArray, reference: CornerCandidate, edges: _Edges, corner: FloatArray
) -> list[Plane] | None:
    """`_planes` with the reference's own normals: each where most of what lies over its outline is."""
    planes = []
    columns = np.ascontiguousarray(local.T)
    for k, normal in enumerate(reference.normals):
        chosen, height = _over_outline(columns, reference, edges, k, corner, NEAR_M)
        if len(chosen) < FEWEST:
            return None
        planes.append(Plane(normal, float(normal @ corner) + _mode(height, 4.0 * reference.sigma_m)))
    return planes if np.linalg.norm(_meeting(planes) - corner) < NEAR_M else None


def _over_outlines(
    local: FloatArray, reference: CornerCandidate, edges: _Edges, corner: FloatArray, within_m: float
) -> BoolArray:
    """Which points (N, 3) lie near each face and over its known outline (3, N), widened, with the corner here."""
    if pays(0.0, KERNELS):
        from lidarpose.detect.sighting_kernels import over_outlines

        normals, least = np.ascontiguousarray(reference.normals), edges.least_at(corner, within_m)
        flags, _ = over_outlines(local, normals, normals @ corner, edges.inward, least, edges.starts, within_m)
        return np.asarray(flags)
    columns = np.ascontiguousarray(local.T)
    flags = np.zeros((3, len(local)), dtype=bool)
    for k, row in enumerate(flags):
        row[_over_outline(columns, reference, edges, k, corner, within_m)[0]] = True
    return flags


def _over_outline(
    columns: FloatArray, reference: CornerCandidate, edges: _Edges, face: int, corner: FloatArray, within_m: float
) -> tuple[IntArray, FloatArray]:
    """Which points (3, N) lie near a face and over its known outline, and their heights above it."""
    normal, mine = reference.normals[face], slice(edges.starts[face], edges.starts[face + 1])
    height = normal @ columns - normal @ corner
    chosen = np.flatnonzero(np.abs(height) < within_m)
    flat = columns.take(chosen, axis=1) - normal[:, None] * height[chosen]
    least = edges.least_at(corner, within_m)[mine]
    chosen = chosen[(edges.inward[mine] @ flat > least[:, None]).all(axis=0)]
    return chosen, height[chosen]


def _fitted_near(
    local: FloatArray, chosen: IntArray, height: FloatArray, normal: FloatArray, offset: float, sigma_m: float
) -> Plane | None:
    """The plane through those of the chosen points at whose height above a first one most lie."""
    if len(chosen) < FEWEST:
        return None
    return _fitted(local, chosen, Plane(normal, offset + _mode(height, 4.0 * sigma_m)), sigma_m)


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
    if len(rest) == 0:
        return []
    # Scan lines that fall on one another crowd, and look like lines and no surface: one point a voxel.
    few = rest[first_in_each(rest, STANDING_VOXEL_M)]
    search = PlaneSearch(
        min_points=FEWEST, max_rounds=STANDING_ROUNDS, from_sensor=True, seed=seed, hypotheses=STANDING_HYPOTHESES
    )
    return [patch.plane for patch in segment_planes(few, search)]


def _shared_out(
    local: FloatArray, planes: Sequence[Plane], eligible: BoolArray, sigma_m: float
) -> tuple[PlanePatch, ...]:
    """Planes, each with the points (N, 3) nearest to it; on the first ones only eligible points (E, N) count."""
    gate_m = GATE_SIGMAS * sigma_m
    rows = np.array([[*plane.normal, plane.offset] for plane in planes])
    if pays(0.0, KERNELS):
        from lidarpose.detect.sighting_kernels import shared_out

        owner, spread_m = shared_out(local, rows, eligible, gate_m)
        patches = [np.flatnonzero(owner == k) for k in range(len(planes))]
        return tuple(
            PlanePatch(plane, mine, float(spread) if len(mine) else sigma_m)
            for plane, mine, spread in zip(planes, patches, spread_m, strict=True)
        )
    distance = np.abs(rows[:, :3] @ local.T - rows[:, 3:])
    distance[: len(eligible)][~eligible] = np.inf
    nearest = np.argmin(distance, axis=0)
    patches = [np.flatnonzero((nearest == k) & (row < gate_m)) for k, row in enumerate(distance)]
    return tuple(
        PlanePatch(plane, mine, float(np.sqrt(np.mean(row[mine] ** 2))) if len(mine) else sigma_m)
        for plane, mine, row in zip(planes, patches, distance, strict=True)
    )


def _off_planes(local: FloatArray, planes: Sequence[Plane], gate_m: float) -> FloatArray:
    """The points (M, 3) of (N, 3) that are near none of the planes."""
    rows = np.array([[*plane.normal, plane.offset] for plane in planes])
    if pays(0.0, KERNELS):
        from lidarpose.detect.sighting_kernels import shared_out

        owner, _ = shared_out(local, rows, np.empty((0, len(local)), dtype=bool), gate_m)
        return np.asarray(local[owner < 0])
    off = np.abs(rows[:, :3] @ local.T - rows[:, 3:]).min(axis=0)
    return local.take(np.flatnonzero(off >= gate_m), axis=0)


def _is_in_view(local: FloatArray, found: CornerCandidate, reference: CornerCandidate, edges: _Edges) -> bool:
    """Whether most beams towards each face's known outline end on the face."""
    shift = found.corner - reference.corner
    a, b, c = (o + shift for o in reference.outlines)
    range_m = np.sqrt(np.einsum("ij,ij->i", local, local))
    axis, cosine = _cone(np.concatenate([a, b, c]), found.corner)
    index = np.flatnonzero(local @ axis > cosine * range_m)
    range_m = range_m[index]
    rays = local.take(index, axis=0) / range_m[:, None]
    mask = FaceMask(
        found.corner, found.normals, found.convex, (a, b, c), found.obstacles, MARGIN_M, edges.by_face_at(found.corner)
    )
    wanted, there = mask.endings(rays, range_m, 2.0 * GATE_SIGMAS * found.sigma_m)
    return _mostly_ends(wanted, there)


def _mostly_ends(wanted: IntArray, there: IntArray) -> bool:
    """Whether most of the beams towards each face (3,) end there (3,)."""
    return bool((there >= SHARE * wanted).all() and (there >= FEWEST // 2).all())


def _cone(points: FloatArray, corner: FloatArray) -> tuple[FloatArray, float]:
    """All directions to points (N, 3) about a corner, and a little more: a cone's axis (3,) and its angle's cosine."""
    axis = unit(corner)
    widest = float(np.arccos(min((unit(points) @ axis).min(), 1.0))) + VIEW_MARGIN_M / float(np.linalg.norm(corner))
    return axis, float(np.cos(min(widest, np.pi)))
