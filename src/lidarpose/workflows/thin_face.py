"""A target with a face that hardly a scan line meets, like the top of a box seen at a grazing angle by 16 lines.

At a single place such a face has no plane of its own: what looks like one holds the line and the beams. But its returns
are known by the other two faces: behind both (of a concave corner before both) nothing else can be seen. And the places
together, seen at different heights, determine its plane: by the joint estimate, started from the edge of the other two.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.detect.trihedral_corner import convex_outline, in_outline
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray, unit
from lidarpose.geometry.planes import Plane
from lidarpose.model.corner_result import CornerCandidate, CornerPlaceFaces, FaceReturns
from lidarpose.refine.corner_model import CornerFit, CornerState, fit_corner_model
from lidarpose.solve.corner_alignment import svd_pose
from lidarpose.workflows.corner_target import FoundTarget, PlaceCrop

# A face's plane is looked for this near the sighting's, and its returns this near its plane.
NEAR_M, GATE_M = 0.08, 0.03
# Returns behind both of the other faces by this (before them, in a concave corner) are of no other face; the third may
# rise or fall by so much.
BEHIND_M, RISE_M = 0.02, 0.25
BORDER_M = 0.05
FEWEST, FEWEST_THIN = 12, 8
START_SIGMA_M = 0.02
# Ranges that scatter by more about the three planes are of something else.
WORST_SIGMA_M = 0.02


@dataclass(frozen=True, eq=False)
class _Edge:
    """Two faces that were seen well, their outlines about the corner, and the direction along their edge, out of the
    third: towards the sensor."""

    faces: tuple[int, int]
    thin: int
    normals: FloatArray
    outlines: tuple[FloatArray, FloatArray]
    reach_m: float
    convex: bool

    @property
    def along(self) -> FloatArray:
        return np.asarray(self.normals[2])


def with_thin_face(found: FoundTarget, crops: Sequence[PlaceCrop]) -> FoundTarget | None:
    """The target with the plane of its thinnest face from all places together; None where they do not give it.

    Parameters
    ----------
    found, crops
        The target as single frames show it, and its surroundings at each place.
    """
    edge = _edge(found, crops)
    if edge is None:
        return None
    expected = found.match.T_world_lidar.inverse() @ found.world
    seen = [_returns(crop, edge, corner) for crop, corner in zip(crops, expected, strict=True)]
    known = [k for k, s in enumerate(seen) if s is not None]
    if len(known) < 3:
        return None
    parts = [s for s in seen if s is not None]
    best: CornerFit | None = None
    for normal in _starting_normals(edge, parts):
        fit = _fit(edge, parts, found.world[known], normal)
        if fit is not None and (best is None or fit.range_sigma_m < best.range_sigma_m):
            best = fit
    if best is None or best.range_sigma_m > WORST_SIGMA_M:
        return None
    return _mended(found, edge, best, dict(zip(known, parts, strict=True)))


@dataclass(frozen=True, eq=False)
class _Seen:
    """The points (N, 3) of a place on the edge's two faces, and on the thin one; the two planes' offsets (2,)."""

    points: tuple[FloatArray, FloatArray, FloatArray]
    offsets: FloatArray


def _edge(found: FoundTarget, crops: Sequence[PlaceCrop]) -> _Edge | None:
    sighted = [(s, crop) for s, crop in zip(found.sightings, crops, strict=True) if s is not None]
    reference = max((s for s, _ in sighted), key=lambda s: s.support)
    # Of edges the third face is the thin one; else that of fewest returns.
    thin = 2 if found.by_edges else int(np.argmin(_counts(sighted)))
    i, j = (k for k in range(3) if k != thin)
    mean = unit(np.mean([s.normals for s, _ in sighted], axis=0))
    along = np.cross(mean[i], mean[j])
    if np.linalg.norm(along) < 0.4:
        return None
    along = unit(along if along @ mean[thin] > 0.0 else -along)
    # A single sighting may hold only a part of a face.
    outlines = []
    for k in (i, j):
        plane = Plane(mean[k], 0.0)
        relative = np.concatenate([s.outlines[k] - s.corner for s, _ in sighted])
        outlines.append(convex_outline(plane.project(relative), plane))
    reach = max(float(np.linalg.norm(o, axis=1).max()) for o in outlines)
    return _Edge((i, j), thin, np.stack([mean[i], mean[j], along]), (outlines[0], outlines[1]), reach, reference.convex)


def _counts(sighted: Sequence[tuple[CornerCandidate, PlaceCrop]]) -> FloatArray:
    """Returns near each of the three faces (3,) at all places."""
    counts = np.zeros(3)
    for s, crop in sighted:
        for j in range(3):
            plane = Plane(s.normals[j], float(s.normals[j] @ s.corner))
            counts[j] += np.count_nonzero(_over(crop.points, plane, s.outlines[j], 0.0) < GATE_M)
    return counts


def _over(points: FloatArray, plane: Plane, outline: FloatArray, border_m: float) -> FloatArray:
    """Distances (N,) of points from a plane; inf where they are not over the outline."""
    height = plane.distance(points)
    flat = points - height[:, None] * plane.normal
    over = in_outline(np.ascontiguousarray(flat.T), plane.project(outline), plane.normal, border_m)
    return np.where(over, np.abs(height), np.inf)


def _returns(crop: PlaceCrop, edge: _Edge, corner: FloatArray) -> _Seen | None:
    """What a place shows of the three faces, by its own two planes near those of the edge."""
    points = crop.points
    offsets, members = [], []
    for normal, outline in zip(edge.normals[:2], edge.outlines, strict=True):
        plane = Plane(normal, float(normal @ corner))
        near = points[_over(points, plane, outline + corner, BORDER_M) < NEAR_M]
        if len(near) < FEWEST:
            return None
        heights = near @ normal
        middle = _densest(heights)
        members.append(near[np.abs(heights - middle) < GATE_M])
        offsets.append(middle)
    first, second = (points @ n - o for n, o in zip(edge.normals[:2], offsets, strict=True))
    rise = (points - corner) @ edge.along
    side = -1.0 if edge.convex else 1.0
    behind = (side * first > BEHIND_M) & (side * second > BEHIND_M) & (np.abs(rise) < RISE_M)
    thin = points[behind & (np.linalg.norm(points - corner, axis=1) < edge.reach_m + BORDER_M)]
    if len(thin) < FEWEST_THIN:
        return None
    return _Seen((members[0], members[1], thin), np.array(offsets))


def _densest(values: FloatArray) -> float:
    """The median of the values (N,) within `GATE_M` of where they are densest."""
    ordered = np.sort(values)
    ends = np.searchsorted(ordered, ordered + GATE_M, side="right")
    first = int(np.argmax(ends - np.arange(len(ordered))))
    return float(np.median(ordered[first : ends[first]]))


def _starting_normals(edge: _Edge, seen: Sequence[_Seen]) -> list[FloatArray]:
    """The thin face's normal were it square to the edge, and as its returns at all places lie to one another."""
    starts = [edge.along]
    rows, rises = [], []
    for s in seen:
        # Each place has its own height: only slopes are common.
        across = s.points[2] @ edge.normals[:2].T - s.offsets
        rise = s.points[2] @ edge.along
        rows.append(np.column_stack([across, np.ones(len(rise))]) - np.append(across.mean(axis=0), 1.0))
        rises.append(rise - rise.mean())
    A, b = np.concatenate(rows)[:, :2], np.concatenate(rises)
    spread = np.linalg.svd(A / np.sqrt(len(A)), compute_uv=False)
    if spread[1] > 0.02:
        slope = np.linalg.lstsq(A, b, rcond=None)[0]
        starts.append(unit(edge.along - slope @ edge.normals[:2]))
    return [n for n in starts if all(n @ s.points[2].mean(axis=0) < 0.0 for s in seen)]


def _fit(edge: _Edge, seen: Sequence[_Seen], world: FloatArray, normal: FloatArray) -> CornerFit | None:
    i, j = edge.faces
    normals = np.empty((3, 3))
    normals[[i, j, edge.thin]] = np.stack([edge.normals[0], edge.normals[1], normal])
    corners, places = [], []
    for k, s in enumerate(seen):
        offset = float(np.median(s.points[2] @ normal))
        corners.append(np.linalg.solve(normals[[i, j, edge.thin]], np.append(s.offsets, offset)))
        faces = {face: _as_returns(p) for face, p in zip((i, j, edge.thin), s.points, strict=True)}
        places.append(CornerPlaceFaces(str(k), world[k], faces, 1))
    start = CornerState(svd_pose(world, np.stack(corners)), normals, 1.0, np.zeros((len(seen), 3)))
    try:
        return fit_corner_model(places, start, START_SIGMA_M)
    except (UndeterminedError, np.linalg.LinAlgError):
        return None


def _as_returns(points: FloatArray) -> FaceReturns:
    range_m = np.linalg.norm(points, axis=1)
    frame: IntArray = np.zeros(len(points), dtype=np.int64)
    return FaceReturns(points / range_m[:, None], range_m, frame)


def _mended(found: FoundTarget, edge: _Edge, fit: CornerFit, seen: dict[int, _Seen]) -> FoundTarget:
    """Sightings by the estimate where the faces were seen; what borders them stands still, at whatever place seen."""
    state = fit.state
    own = dict(zip(seen, state.corners(fit.world), strict=True))
    outlines: list[FloatArray] = [np.zeros((0, 3))] * 3
    for k, face in enumerate((*edge.faces, edge.thin)):
        plane = Plane(state.normals[face], 0.0)
        relative = np.concatenate([s.points[k] - own[place] for place, s in seen.items()])
        outlines[face] = convex_outline(plane.project(relative), plane)
    standing = tuple(plane for s in found.sightings if s is not None for plane in s.obstacles)
    sightings: list[CornerCandidate | None] = [None] * len(found.world)
    for place, s in seen.items():
        a, b, c = (outline + own[place] for outline in outlines)
        support = min(len(points) for points in s.points)
        sightings[place] = CornerCandidate(
            own[place], state.normals, edge.convex, (a, b, c), standing, support, 0.5 * fit.range_sigma_m
        )
    match = replace(found.match, T_world_lidar=state.T_world_lidar)
    strays = {place: words for place, words in found.strays.items() if place not in seen}
    return replace(found, sightings=tuple(sightings), match=match, strays=strays)
