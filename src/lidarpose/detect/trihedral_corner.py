"""Corners of three faces in a cloud: candidates among its patches, and a known corner's returns face by face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.crop import inside_box
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, cross3, perpendicular_pair, unit
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.planes import Plane, intersect_three_planes
from lidarpose.geometry.robust import median, quantile
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.model.plane_patch import PlanePatch

# Faces of a wall or the ground count only this far from the corner.
REACH_M = 1.2
# A corner may be cropped or missing by this much and still be that of its faces.
MAX_MISSING_M = 0.35
# Three faces whose normals span less than this volume determine their corner badly.
MIN_VOLUME = 0.12
MIN_FACE_POINTS = 12
# Share of a face's points that have to lie on the right side of the other two.
ONE_SIDED = 0.9
OUTLINE_DIRECTIONS = 64
# An outline ends at a face's last scan line, and the face within this of it, if nothing else lies there.
RIM_M = 0.02
# By how much kernels are done sooner, on one core: a beam, or the faces of one corner.
SAVED_S_PER_BEAM = 1e-7
SAVED_S_PER_CORNER = 5e-4
KERNELS = "detect.sighting_kernels"


@dataclass(frozen=True, eq=False)
class _Surface:
    """A patch with its points (M, 3) and their bounding box."""

    patch: PlanePatch
    points: FloatArray

    @cached_property
    def low(self) -> FloatArray:
        return np.asarray(self._columns.min(axis=1))

    @cached_property
    def high(self) -> FloatArray:
        return np.asarray(self._columns.max(axis=1))

    @cached_property
    def _columns(self) -> FloatArray:
        # Along the columns NumPy finds a least number ten times as quickly as along the rows.
        return np.ascontiguousarray(self.points.T)


def find_corners(
    points: NDArray[np.floating], patches: tuple[PlanePatch, ...], near: FloatArray | None = None, radius_m: float = 0.3
) -> tuple[CornerCandidate, ...]:
    """All corners that three patches make, convex or concave; best supported first.

    Parameters
    ----------
    points : (N, 3)
        The cloud, its origin at the sensor.
    patches
        What `segment_planes` found in it.
    near, radius_m
        Only corners within `radius_m` of `near` (3,), if given.
    """
    if len(patches) < 3:
        return ()
    surfaces = [_Surface(p, points[p.indices].astype(np.float64)) for p in patches]
    triples, corners = _meeting_triples(surfaces)
    if near is not None:
        close = np.linalg.norm(corners - near, axis=1) <= radius_m
        triples, corners = triples[close], corners[close]
    found = [c for t, corner in zip(triples, corners, strict=True) if (c := _candidate(surfaces, t, corner))]
    return _without_doubles(sorted(found, key=lambda c: -c.support))


def corner_of_faces(
    points: NDArray[np.floating], patches: tuple[PlanePatch, ...], missing_m: float = MAX_MISSING_M
) -> CornerCandidate | None:
    """The corner of the first three of the patches (see `find_corners`), the others being what may border them; of no
    face may more be missing next to the corner."""
    surfaces = [_Surface(p, points[p.indices].astype(np.float64)) for p in patches]
    faces = [p.plane for p in patches[:3]]
    try:
        corner = intersect_three_planes((faces[0], faces[1], faces[2]))
    except ValueError:
        return None
    return _candidate(surfaces, np.arange(3), corner, missing_m)


def _meeting_triples(surfaces: list[_Surface]) -> tuple[IntArray, FloatArray]:
    """Triples (T, 3) of patches whose common point (T, 3) lies in the neighbourhood of all three."""
    normals = np.stack([s.patch.plane.normal for s in surfaces])
    offsets = np.array([s.patch.plane.offset for s in surfaces])
    triples = np.array(list(combinations(range(len(surfaces)), 3)))
    systems = normals[triples]
    good = np.abs(np.linalg.det(systems)) > MIN_VOLUME
    triples, systems = triples[good], systems[good]
    if len(triples) == 0:
        return triples, np.zeros((0, 3))
    corners = np.linalg.solve(systems, offsets[triples][..., None])[..., 0]
    low = np.stack([s.low for s in surfaces]) - MAX_MISSING_M
    high = np.stack([s.high for s in surfaces]) + MAX_MISSING_M
    inside = (corners[:, None] > low[triples]).all(axis=(1, 2)) & (corners[:, None] < high[triples]).all(axis=(1, 2))
    return triples[inside], np.asarray(corners[inside])


def _candidate(
    surfaces: list[_Surface], triple: IntArray, corner: FloatArray, missing_m: float = MAX_MISSING_M
) -> CornerCandidate | None:
    faces = [surfaces[k].patch for k in triple]
    points = [surfaces[k].points for k in triple]
    compiled = pays(SAVED_S_PER_CORNER, KERNELS)
    met = (_met_compiled if compiled else _met)(points, faces, corner, missing_m)
    if met is None or min(len(p) for p in met[1]) < MIN_FACE_POINTS:
        return None
    convex, local = met
    outlines = [convex_outline(p, f.plane) for p, f in zip(local, faces, strict=True)]
    if any(len(o) < 3 for o in outlines):
        return None
    obstacles = _obstacles(surfaces, triple, local)
    return CornerCandidate(
        corner,
        np.stack([f.plane.normal for f in faces]),
        convex,
        (outlines[0], outlines[1], outlines[2]),
        obstacles,
        min(len(p) for p in local),
        median(np.array([f.sigma_m for f in faces])),
    )


def _met(
    points: list[FloatArray], faces: list[PlanePatch], corner: FloatArray, missing_m: float
) -> tuple[bool, list[FloatArray]] | None:
    """Whether the edges of three faces are convex, and which of their points are next to the corner; None if these
    faces make none."""
    local, distances = [], []
    for around in points:
        offset = around - corner
        distance = np.sqrt(np.einsum("ij,ij->i", offset, offset))
        near = np.flatnonzero(distance < REACH_M)
        if len(near) < MIN_FACE_POINTS or distance.min() > missing_m:
            return None
        local.append(around.take(near, axis=0))
        distances.append(distance[near])
    reach = min(quantile(d, 0.98) for d in distances)
    convex = _common_side(_next_to_corner(local, distances, reach), faces)
    if convex is None:
        # A face may go on past a narrow one, as the floor does past the side of a niche.
        convex = _common_side(_next_to_corner(local, distances, _narrowest_m(local, faces, corner)), faces)
    if convex is None:
        return None
    # No farther from the corner than the smallest face reaches: a wall's or the ground's rest is no target.
    local = [p[d <= 1.3 * reach] for p, d in zip(local, distances, strict=True)]
    return convex, [_on_its_side(p, k, faces, convex) for k, p in enumerate(local)]


def _met_compiled(
    points: list[FloatArray], faces: list[PlanePatch], corner: FloatArray, missing_m: float
) -> tuple[bool, list[FloatArray]] | None:
    """`_met` by kernels."""
    from lidarpose.detect.sighting_kernels import faces_of_corner

    starts = np.cumsum([0, *(len(p) for p in points)])
    planes = np.array([[*face.plane.normal, face.plane.offset] for face in faces])
    sigmas = np.array([face.sigma_m for face in faces])
    tolerance = 3.0 * np.maximum(sigmas, sigmas[:, None])
    everyone = np.concatenate(points)
    side, keep = faces_of_corner(
        everyone, starts, corner, planes, tolerance, REACH_M, missing_m, MIN_FACE_POINTS, ONE_SIDED
    )
    if side < 0:
        return None
    return side == 1, [everyone[a:b][keep[a:b]] for a, b in pairwise(starts)]


def _common_side(local: list[FloatArray], faces: list[PlanePatch]) -> bool | None:
    """True if all edges are convex, False if all are concave, None if they are mixed or a face crosses another."""
    convex = []
    for i in range(3):
        for j in range(3):
            if i == j:
                continue
            height = faces[j].plane.distance(local[i])
            tolerance = 3.0 * max(faces[i].sigma_m, faces[j].sigma_m)
            if np.mean(height < tolerance) >= ONE_SIDED:
                convex.append(True)
            elif np.mean(height > -tolerance) >= ONE_SIDED:
                convex.append(False)
            else:
                return None
    return convex[0] if len(set(convex)) == 1 else None


def _narrowest_m(local: list[FloatArray], faces: list[PlanePatch], corner: FloatArray) -> float:
    """How far the faces reach from the corner along each of their common edges: the least of it."""
    reach = []
    for a, b in combinations(range(3), 2):
        edge = unit(cross3(faces[a].plane.normal, faces[b].plane.normal))
        reach += [quantile(np.abs((local[k] - corner) @ edge), 0.98) for k in (a, b)]
    return min(reach)


def _next_to_corner(local: list[FloatArray], distances: list[FloatArray], reach_m: float) -> list[FloatArray]:
    """The points that tell how the faces meet: farther out, a face's plane may go on behind another face."""
    close = [p[d <= 0.7 * reach_m] for p, d in zip(local, distances, strict=True)]
    return [c if len(c) >= MIN_FACE_POINTS else p for c, p in zip(close, local, strict=True)]


def _on_its_side(points: FloatArray, face: int, faces: list[PlanePatch], convex: bool) -> FloatArray:
    """Points of one face on the right side of the other two."""
    keep = np.ones(len(points), dtype=bool)
    for j in range(3):
        if j != face:
            height = faces[j].plane.distance(points)
            tolerance = 3.0 * max(faces[face].sigma_m, faces[j].sigma_m)
            keep &= height < tolerance if convex else height > -tolerance
    return np.asarray(points[keep])


_ANGLES = np.linspace(0.0, 2.0 * np.pi, OUTLINE_DIRECTIONS, endpoint=False)
ROUND = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


def convex_outline(points: FloatArray, plane: Plane) -> FloatArray:
    """The convex outline (K, 3) of points on a plane, counter-clockwise seen from the normal's side.

    Its vertices are the points farthest out in `OUTLINE_DIRECTIONS` directions.
    """
    directions = ROUND @ np.stack(perpendicular_pair(plane.normal))
    if points.dtype == np.float64 and points.flags.c_contiguous and pays(0.0, KERNELS):
        from lidarpose.detect.sighting_kernels import farthest as farthest_out

        farthest = farthest_out(points, directions)
    else:
        farthest = np.argmax(directions @ points.T, axis=1)
    corners = farthest[farthest != np.append(farthest[-1], farthest[:-1])]
    return plane.project(points[corners])


def _obstacles(surfaces: list[_Surface], triple: IntArray, local: list[FloatArray]) -> tuple[Plane, ...]:
    """Planes of other patches that touch the faces: what a face's beam meets below the target's foot."""
    all_local = np.concatenate(local)
    columns = np.ascontiguousarray(all_local.T)
    low, high = columns.min(axis=1) - 0.1, columns.max(axis=1) + 0.1
    found = []
    for k, surface in enumerate(surfaces):
        if k in triple or (surface.low > high).any() or (surface.high < low).any():
            continue
        if len(inside_box(surface.points, low, high)) < 20:
            continue
        height = surface.patch.plane.distance(all_local)
        # It borders the target only if the target stands wholly on its free side, and close to it.
        if np.mean(height > -3.0 * surface.patch.sigma_m) > 0.97 and height.min() < 0.2:
            found.append(surface.patch.plane)
    return tuple(found)


def _without_doubles(candidates: list[CornerCandidate]) -> tuple[CornerCandidate, ...]:
    kept: list[CornerCandidate] = []
    for candidate in candidates:
        if all(np.linalg.norm(candidate.corner - other.corner) > 0.05 for other in kept):
            kept.append(candidate)
    return tuple(kept)


@dataclass(frozen=True, eq=False)
class FaceBeams:
    """The beams that end on a face: which (M,) of all, ascending, their unit rays (3, M), contiguous, and ranges (M,);
    and which (M,) pass outside of the face's outline, within its rim."""

    index: IntArray
    rays: FloatArray
    range_m: FloatArray
    on_rim: BoolArray


@dataclass(frozen=True, eq=False)
class FaceMask:
    """Which beams meet which face of a corner, told by their direction alone.

    Selecting by the measured point would favour returns whose noise happens to suit the model; the direction has no
    noise. A beam belongs to the face that it meets first on a convex corner's, last on a concave one's planes.
    """

    corner: FloatArray
    normals: FloatArray
    convex: bool
    outlines: tuple[FloatArray, FloatArray, FloatArray]
    obstacles: tuple[Plane, ...]
    margin_m: float
    edges: tuple[tuple[FloatArray, FloatArray], ...] | None = None
    """The outlines' edges by face, as `outline_edges` has them, where they are known."""

    def select(self, directions: FloatArray, range_m: FloatArray, gate_m: float) -> tuple[IntArray, IntArray]:
        """Which returns are of the faces, and of which face each is.

        Parameters
        ----------
        directions, range_m : (N, 3), (N,)
            Unit beam directions and measured ranges.
        gate_m
            Returns farther than this from the range where their beam should end are something else.

        Returns
        -------
        Indices (M,), and the face (M,) of each: 0, 1 or 2.
        """
        rays = np.ascontiguousarray(directions.T)
        if pays(SAVED_S_PER_BEAM * len(range_m), "detect.target_kernels"):
            return self._select_compiled(rays, range_m, gate_m)
        face, predicted, slope = self._meet(rays)
        with np.errstate(invalid="ignore"):
            near = np.abs(range_m - predicted) < gate_m
        indices, faces = [], []
        for j in range(3):
            mine = np.flatnonzero(near & (face == j))
            on_face = predicted.take(mine)
            good = self._inside(j, rays.take(mine, axis=1) * on_face, slope.take(mine, axis=1) * on_face)
            indices.append(mine[good])
            faces.append(np.full(len(indices[-1]), j))
        return np.concatenate(indices), np.concatenate(faces)

    def _select_compiled(self, rays: FloatArray, range_m: FloatArray, gate_m: float) -> tuple[IntArray, IntArray]:
        found = self._faces_met(rays, range_m, gate_m)
        indices = [np.flatnonzero(found == j) for j in range(3)]
        return np.concatenate(indices), np.repeat(np.arange(3), [len(index) for index in indices])

    def _faces_met(self, rays: FloatArray, range_m: FloatArray, gate_m: float) -> NDArray[np.int8]:
        """By kernels: the face (N,) that each ray (3, N) and range is of, or -1."""
        from lidarpose.detect.target_kernels import faces_met

        planes, (inward, least, starts), near = self._for_kernels
        found: NDArray[np.int8] = faces_met(
            rays, np.asarray(range_m, dtype=np.float64), float(gate_m), *planes, inward, least - RIM_M, starts, *near
        )
        return found

    @cached_property
    def _for_kernels(
        self,
    ) -> tuple[
        tuple[FloatArray, FloatArray, bool],
        tuple[FloatArray, FloatArray, IntArray],
        tuple[FloatArray, FloatArray, FloatArray],
    ]:
        """What kernels ask for: the planes; the outlines' edges; margins, and what borders the faces."""
        edges = self._edges_of
        planes = np.array([[*plane.normal, plane.offset] for plane in self.obstacles]).reshape(-1, 4)
        return (
            (np.ascontiguousarray(self.normals), self.normals @ self.corner, bool(self.convex)),
            (
                np.concatenate([inward for inward, _ in edges]),
                np.concatenate([least for _, least in edges]),
                np.cumsum([0, *(len(least) for _, least in edges)]),
            ),
            (
                self._off_edges_m,
                planes,
                np.array([[self._off_obstacle_m(j, plane) for plane in self.obstacles] for j in range(3)]).reshape(
                    3, -1
                ),
            ),
        )

    def beams_of(self, points: FloatArray, gate_m: float) -> list[FaceBeams]:
        """By face: the beams of points (N, 3) that end on it, within the gate."""
        if points.flags.c_contiguous and pays(SAVED_S_PER_BEAM * len(points), "detect.target_kernels"):
            return self._beams_compiled(points, gate_m)
        rays = np.ascontiguousarray(points.T)
        range_m = np.sqrt(np.einsum("ij,ij->j", rays, rays))
        rays = rays / range_m
        index, face = self.select(rays.T, range_m, gate_m)
        parts = np.split(index, np.searchsorted(face, [1, 2]))
        return [
            FaceBeams(mine, part, range_m.take(mine), self.on_rim(j, part))
            for j, mine in enumerate(parts)
            for part in [rays.take(mine, axis=1)]
        ]

    def _beams_compiled(self, points: FloatArray, gate_m: float) -> list[FaceBeams]:
        from lidarpose.detect.target_kernels import beams_of_faces

        planes, (inward, least, starts), near = self._for_kernels
        index, count, rays, range_m, on_rim = beams_of_faces(
            points, float(gate_m), *planes, inward, least, RIM_M, starts, *near
        )
        ends = np.cumsum(count).tolist()
        return [
            FaceBeams(index[a:b], rays[3 * a : 3 * b].reshape(3, -1), range_m[a:b], on_rim[a:b])
            for a, b in pairwise([0, *ends])
        ]

    def endings(self, directions: FloatArray, range_m: FloatArray, gate_m: float) -> tuple[IntArray, IntArray]:
        """By face: how many of the beams (N, 3) are towards it (3,), and how many of their ranges (N,) end on it (3,),
        within the gate."""
        if pays(0.0, "detect.target_kernels"):
            rays = np.ascontiguousarray(directions.T)
            faces = (self._faces_met(rays, range_m, gate) for gate in (np.inf, gate_m))
            wanted, there = (np.bincount(face + 1, minlength=4)[1:] for face in faces)
            return wanted, there
        towards, met = self.select(directions, range_m, np.inf)
        _, expected = self.meet(directions[towards])
        on_face = met[np.abs(range_m[towards] - expected) < gate_m]
        return np.bincount(met, minlength=3), np.bincount(on_face, minlength=3)

    def on_rim(self, face: int, rays: FloatArray) -> BoolArray:
        """Which rays (3, N) to a face pass outside its outline, within its rim."""
        normal = self.normals[face]
        inward, least = self._edges_of[face]
        if pays(0.1 * SAVED_S_PER_BEAM * rays.shape[1], "detect.target_kernels"):
            from lidarpose.detect.target_kernels import outside

            return np.asarray(outside(rays, normal, normal @ self.corner, inward, least))
        return np.asarray((inward @ (rays * ((normal @ self.corner) / (normal @ rays))) <= least[:, None]).any(axis=0))

    @cached_property
    def _edges_of(self) -> Sequence[tuple[FloatArray, FloatArray]]:
        """By face: its outline's edges."""
        if self.edges is not None:
            return self.edges
        return outlines_edges(self.outlines, self.normals)

    @cached_property
    def _off_edges_m(self) -> FloatArray:
        """How far each face's points have to be from another's plane (3, 3) to be off their common edge."""
        cosines = self.normals @ self.normals.T
        return np.asarray(self.margin_m * np.sqrt(np.maximum(1.0 - cosines**2, 0.0)))

    def _off_obstacle_m(self, face: int, plane: Plane) -> float:
        """How far a face's points have to be from what borders it."""
        return max(float(np.linalg.norm(cross3(self.normals[face], plane.normal))), 0.2) * (2.0 * self.margin_m + 0.01)

    def meet(self, directions: FloatArray) -> tuple[NDArray[np.uint8], FloatArray]:
        """By direction (N, 3): the face met, and the range there; inf where the beam meets none."""
        face, best, _ = self._meet(np.ascontiguousarray(directions.T))
        return face, best

    def _meet(self, rays: FloatArray) -> tuple[NDArray[np.uint8], FloatArray, FloatArray]:
        """By ray (3, N): face and range as `meet` tells them, and the cosines (3, N) to the normals."""
        slope = self.normals @ rays
        away = slope >= -0.02
        with np.errstate(divide="ignore"):
            reach = (self.normals @ self.corner)[:, None] / slope
        reach[away] = -np.inf if self.convex else np.inf
        a, b, c = reach
        if self.convex:
            second, best = b > a, np.maximum(a, b)
            third = c > best
            np.maximum(best, c, out=best)
            # Whoever leaves one of a convex corner's planes behind never enters the solid.
            best[away[0] | away[1] | away[2]] = np.inf
        else:
            second, best = b < a, np.minimum(a, b)
            third = c < best
            np.minimum(best, c, out=best)
        return np.where(third, np.uint8(2), second.view(np.uint8)), best, slope

    def _inside(self, face: int, on_face: FloatArray, height: FloatArray) -> BoolArray:
        """Which predicted points (3, N) of a face lie in its outline, off its edges with others and off obstacles.

        `height` (3, N) are their projections onto the three normals.
        """
        inward, least = self._edges_of[face]
        good = (inward @ on_face > least[:, None] - RIM_M).all(axis=0)
        for k in range(3):
            if k != face:
                good &= np.abs(height[k] - self.normals[k] @ self.corner) > self._off_edges_m[face, k]
        for plane in self.obstacles:
            good &= plane.normal @ on_face - plane.offset > self._off_obstacle_m(face, plane)
        return np.asarray(good)


def outline_edges(outline: FloatArray, normal: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit directions (E, 3) inward from an outline's edges, and how far along each its points lie at least (E,)."""
    return outlines_edges([outline], normal[None])[0]


def outlines_edges(outlines: Sequence[FloatArray], normals: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
    """`outline_edges` of several outlines with their normals (F, 3)."""
    count = [len(outline) for outline in outlines]
    points = np.concatenate(outlines)
    ends = np.cumsum(count)
    following = np.arange(1, len(points) + 1)
    following[ends - 1] = ends - count
    x, y, z = (points.take(following, axis=0) - points).T
    a, b, c = normals.repeat(count, axis=0).T
    inward = np.column_stack([b * z - c * y, c * x - a * z, a * y - b * x])
    length = np.sqrt(np.einsum("ij,ij->i", inward, inward))
    keep = length > 1e-9
    inward /= np.where(keep, length, 1.0)[:, None]
    least = np.einsum("ij,ij->i", inward, points)
    found = [(inward[end - many : end], least[end - many : end]) for end, many in zip(ends, count, strict=True)]
    if keep.all():
        return found
    kept = [keep[end - many : end] for end, many in zip(ends, count, strict=True)]
    return [(edges[mine], low[mine]) for (edges, low), mine in zip(found, kept, strict=True)]


def in_outline(points: FloatArray, outline: FloatArray, normal: FloatArray, slack_m: float) -> BoolArray:
    """Which points (3, N) of a plane lie in a convex outline (K, 3), widened by `slack_m`."""
    inward, least = outline_edges(outline, normal)
    return np.asarray((inward @ points > (least - slack_m)[:, None]).all(axis=0))
