"""Boxes: edge lengths from the planes of the faces where two bound an edge, from the faces' own borders elsewhere.

One view shows at most three faces of a box. Each edge then ends at a visible face on one side; on the other it ends at
the border of the faces along it, estimated by the same model of the beam at the edge as a disk's, or at a plane that
the box stands on or leans against.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy import ndimage

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, unit
from lidarpose.geometry.planes import Plane
from lidarpose.measure.beams import Beams, MovedBeams, calibration_sigmas, fit_plane_to_ranges, plane_ranges
from lidarpose.measure.edge_beams import WIDEST_SPOT_M, PlaneView, edge_beams, spot_ends, view_of_patch
from lidarpose.measure.edge_model import fit_straight_edge
from lidarpose.measure.outline import in_plane
from lidarpose.measure.patches import Patch, find_patches

# Faces of a box stand at right angles to within this; edges' directions come from the faces, so that no more is needed.
_SQUARE_RAD = np.deg2rad(4.0)
_LARGEST_FACE_M = 5.0


@dataclass(frozen=True, eq=False)
class FaceSupport:
    """A plane, the beams behind it as flat indices into the grid; `sign` times its normal points out of the box."""

    plane: Plane
    sign: float
    index: IntArray


@dataclass(frozen=True, eq=False)
class EndSupport:
    """What ends an edge: a plane (at `beside`, a face along the edge, if the plane is no face of the box), or borders.

    A border is a face, the beams at its border, and its weight.
    """

    face: FaceSupport | None
    beside: FaceSupport | None = None
    borders: tuple[tuple[FaceSupport, IntArray, float], ...] = ()


@dataclass(frozen=True, eq=False)
class BoxEdge:
    """One of the three lengths of a box.

    Attributes
    ----------
    length_m
        The length.
    beams_sigma_m
        Its standard deviation from the planes and the borders.
    calibration_sigma_m
        From the calibration's covariance; None where it carries none.
    direction : (3,)
        Along the edge, outward at its end nearer to a visible face.
    by
        What bounds it at both ends: "face", "border" or "support" (the plane it stands on).
    axis, ends
        What is needed to see how the calibration moves the answer: the faces that give the direction (their normals'
        product, if two), and what bounds both ends.
    """

    length_m: float
    beams_sigma_m: float
    calibration_sigma_m: float | None
    direction: FloatArray
    by: tuple[str, str]
    axis: tuple[FaceSupport, ...]
    ends: tuple[EndSupport, EndSupport]

    @property
    def sigma_m(self) -> float:
        """Standard deviation of the length, the calibration's share included where it is known."""
        return float(np.hypot(self.beams_sigma_m, self.calibration_sigma_m or 0.0))


@dataclass(frozen=True, eq=False)
class BoxMeasurement:
    """A measured box, in the beams' frame: its edges, longest first, and the faces that were seen.

    `face_normals` (k, 3) point out of the box; `face_points` (k,) is how many points each has; `angles_deg` are the
    angles between neighbouring faces.
    """

    edges: tuple[BoxEdge, ...]
    face_normals: FloatArray
    face_points: tuple[int, ...]
    angles_deg: tuple[float, ...]


@dataclass(frozen=True, eq=False)
class _Face:
    """A face with its beams; the normal points out of the box, which is towards the LiDAR."""

    patch: Patch
    view: PlaneView
    normal: FloatArray
    offset: float
    middle: FloatArray
    places: FloatArray

    @property
    def support(self) -> FaceSupport:
        """The plane and at most 1500 of its beams."""
        index = self.view.index[self.view.plane_used]
        sign = 1.0 if float(self.normal @ self.view.plane.normal) > 0.0 else -1.0
        return FaceSupport(self.view.plane, sign, index[:: max(1, len(index) // 1500)])


@dataclass(frozen=True)
class _End:
    """Where the box ends in a direction: the offset along it, its variance in m^2, and what tells it."""

    position: float
    variance: float
    by: str
    support: EndSupport


def measure_box(beams: Beams, sigma: float, *, seed: int = 0) -> BoxMeasurement:
    """The box in a grid of beams (N, M): of all corners and edges of flat faces the one with most points.

    Raises
    ------
    UndeterminedError
        If no two faces meet at a right angle, pointing outward, or an end of an edge is not seen.
    """
    faces = [f for p in find_patches(beams.points, sigma) if (f := _face(beams, p, sigma)) is not None]
    found = _box_faces(faces, sigma)
    others = [f for f in faces if f not in found]
    chosen = _apart(beams, _apart(beams, found, sigma), sigma)
    axes: list[tuple[FloatArray, tuple[FaceSupport, ...]]] = [(f.normal, (f.support,)) for f in chosen]
    if len(axes) == 2:
        axes.append((unit(np.cross(axes[0][0], axes[1][0])), (axes[0][1][0], axes[1][1][0])))
    edges = [_edge(axis, given_by, chosen, others, sigma, seed) for axis, given_by in axes]
    edges.sort(key=lambda e: -e.length_m)
    angles = [float(np.rad2deg(np.arccos(np.clip(a.normal @ b.normal, -1.0, 1.0)))) for a, b in combinations(chosen, 2)]
    normals = np.stack([f.normal for f in chosen])
    return BoxMeasurement(tuple(edges), normals, tuple(f.patch.count for f in chosen), tuple(angles))


def _apart(beams: Beams, faces: list[_Face], sigma: float) -> list[_Face]:
    """The faces, each fitted anew without beams that end beyond an edge, on the next face.

    Noise lets a patch reach over; such beams lie behind the plane, all of them, and would draw it away from the LiDAR.
    """
    again = []
    for face in faces:
        view = face.view
        points = view.frame[0] + view.place @ view.frame[1:]
        inside = np.all([f.offset - points @ f.normal > 2.0 * view.step for f in faces if f is not face], axis=0)
        again.append(_face(beams, face.patch, sigma, inside.reshape(face.patch.mask.shape)) or face)
    return again


def _face(beams: Beams, patch: Patch, sigma: float, chosen: BoolArray | None = None) -> _Face | None:
    inner = ndimage.binary_erosion(patch.mask, iterations=2, border_value=0)
    if chosen is not None:
        inner &= chosen
    if np.count_nonzero(inner) < 30:
        return None
    try:
        view = view_of_patch(beams, patch, inner, sigma)
    except (ValueError, np.linalg.LinAlgError):
        return None
    direction = view.beams.direction[view.plane_used]
    normal, offset = view.plane.normal, view.plane.offset
    toward = float(np.median(direction @ normal))
    if abs(toward) < np.sin(np.deg2rad(6.0)):
        return None
    if toward > 0.0:
        normal, offset = -normal, -offset
    places = view.place[view.on]
    middle = view.frame[0] + np.median(places, axis=0) @ view.frame[1:]
    return _Face(patch, view, normal, offset, middle, places)


def _box_faces(faces: list[_Face], sigma: float) -> list[_Face]:
    """Three faces that meet pairwise, or two, with most points."""
    small = [f for f in faces if float(np.ptp(f.places, axis=0).max()) < _LARGEST_FACE_M]
    pairs = {(a, b) for a, b in combinations(range(len(small)), 2) if _are_neighbours(small[a], small[b], sigma)}
    triples = [t for t in combinations(range(len(small)), 3) if all(p in pairs for p in combinations(t, 2))]
    groups: list[tuple[int, ...]] = [*triples] or [*sorted(pairs)]
    if not groups:
        raise UndeterminedError(
            "No two flat faces that meet at a right angle, pointing outward, were found",
            remedy="Turn the box so that two or three of its faces are seen at more than ten degrees, with at least "
            "eight sweeps and eight beams on each.",
        )
    best = max(groups, key=lambda group: sum(small[k].patch.count for k in group))
    return [small[k] for k in best]


def _are_neighbours(a: _Face, b: _Face, sigma: float) -> bool:
    """True if two faces stand at a right angle, point away from each other, and touch along their common edge."""
    if abs(float(a.normal @ b.normal)) > np.sin(_SQUARE_RAD):
        return False
    if float(b.normal @ a.middle) > b.offset or float(a.normal @ b.middle) > a.offset:
        return False
    along = unit(np.cross(a.normal, b.normal))
    spans = []
    for one, other in ((a, b), (b, a)):
        points = one.view.frame[0] + one.places @ one.view.frame[1:]
        gap = other.offset - points @ other.normal
        near = np.abs(gap) < 4.0 * one.view.step + WIDEST_SPOT_M + 5.0 * sigma
        if np.count_nonzero(near) < 4:
            return False
        spans.append(np.percentile(points[near] @ along, [5.0, 95.0]))
    overlap = min(spans[0][1], spans[1][1]) - max(spans[0][0], spans[1][0])
    return bool(overlap > 0.5 * min(spans[0][1] - spans[0][0], spans[1][1] - spans[1][0]))


def _edge(
    axis: FloatArray,
    given_by: tuple[FaceSupport, ...],
    faces: list[_Face],
    others: list[_Face],
    sigma: float,
    seed: int,
) -> BoxEdge:
    first, second = (_end(sign * axis, faces, others, sigma, seed) for sign in (1.0, -1.0))
    sigmas = float(np.sqrt(first.variance)), float(np.sqrt(second.variance))
    # Borders at both ends are seen with the same spot, and err together.
    shared = first.by == second.by == "border"
    return BoxEdge(
        first.position + second.position,
        sum(sigmas) if shared else float(np.hypot(*sigmas)),
        None,
        axis,
        (first.by, second.by),
        given_by,
        (first.support, second.support),
    )


def _end(direction: FloatArray, faces: list[_Face], others: list[_Face], sigma: float, seed: int) -> _End:
    """Where the box ends in a direction."""
    along = [f for f in faces if abs(float(f.normal @ direction)) < 0.5]
    for face in faces:
        if float(face.normal @ direction) > 0.9:
            # The plane, taken where the other faces are.
            variance = _plane_variance(face, np.mean([f.middle for f in along], axis=0))
            return _End(face.offset, variance, "face", EndSupport(face.support))
    borders = [b for f in along if (b := _border(f, direction, sigma, seed)) is not None]
    if borders:
        weights = np.array([1.0 / b.variance for b in borders])
        position = float(weights @ [b.position for b in borders] / weights.sum())
        chi2 = sum((b.position - position) ** 2 / b.variance for b in borders)
        # Two borders that disagree are both worse than they say.
        parts = [b.support.borders[0] for b in borders]
        shares = tuple((part[0], part[1], float(w / weights.sum())) for part, w in zip(parts, weights, strict=True))
        # The spot is the same at both, so that their mean is no better than they are.
        mean_sigma = float(weights @ [np.sqrt(b.variance) for b in borders] / weights.sum())
        variance = max(1.0, chi2 / max(1, len(borders) - 1)) * mean_sigma**2
        return _End(position, variance, "border", EndSupport(None, borders=shares))
    support = _support(direction, along, others)
    if support is not None:
        return support
    raise UndeterminedError(
        "One end of the box is not seen: neither a face, nor a free border, nor a plane that it stands on",
        remedy="Leave its borders free against a background that is farther away, or record it from another side.",
    )


def _border(face: _Face, direction: FloatArray, sigma: float, seed: int) -> _End | None:
    """Where a face ends in a direction, by the beams that cross its border there; None if that is not free."""
    e = direction - float(direction @ face.normal) * face.normal
    e = unit(e)
    across = np.cross(face.normal, e)
    frame = np.stack([face.middle, e, across])
    place = in_plane(face.view.frame[0] + face.view.place @ face.view.frame[1:], face.view.plane, frame)
    on = place[face.view.on]
    last = float(np.percentile(on[:, 0], 99.5))
    size = 0.5 * float(np.ptp(on[:, 0]))
    near_border = on[on[:, 0] > last - 6.0 * face.view.step]
    low, high = np.percentile(near_border[:, 1], [2.0, 98.0])
    guard = 2.0 * face.view.step + WIDEST_SPOT_M
    middle = 0.5 * (low + high)
    allowed: BoolArray = (place[:, 1] > low + guard) & (place[:, 1] < high - guard)
    placed = np.column_stack([place[:, 0], place[:, 1] - middle])
    view = PlaneView(**{**face.view.__dict__, "place": placed, "frame": frame})
    offset, spot = last, WIDEST_SPOT_M
    for _ in range(3):
        chosen = edge_beams(view, place[:, 0] - offset, size, sigma, allowed, spot)
        if chosen is None:
            return None
        near, edge, dropout = chosen
        covered = float(np.ptp(edge.place[:, 1])) if len(edge) else 0.0
        if covered < 0.3 * (high - low) or covered < 6.0 * face.view.step:
            return None
        offset, variance, width = fit_straight_edge(edge, offset, dropout=dropout, reach=face.view.step, seed=seed)
        wide, spot = spot_ends(width) > 1.3 * spot, max(spot, spot_ends(width))
        if not wide:
            break
    border = face.middle + offset * e + middle * across
    # A plane that is off by a little moves the border of a face seen aslant along it.
    sight = face.view.beams.direction[near].mean(axis=0)
    slant = float(sight @ e) / float(sight @ face.normal)
    variance += slant**2 * _plane_variance(face, border)
    support = EndSupport(None, borders=((face.support, face.view.index[near], 1.0),))
    return _End(float(border @ direction), variance, "border", support)


def _support(direction: FloatArray, along: list[_Face], others: list[_Face]) -> _End | None:
    """A plane across the direction that the faces end at: a floor or a wall."""
    best: tuple[float, _End] | None = None
    for face in along:
        points = face.view.frame[0] + face.places @ face.view.frame[1:]
        last = float(np.percentile(points @ direction, 99.5))
        for other in others:
            if float(other.normal @ direction) > -np.cos(_SQUARE_RAD):
                continue
            position = float(face.middle @ direction) + (other.offset - float(other.normal @ face.middle)) / float(
                other.normal @ direction
            )
            gap = abs(position - last)
            if gap < 4.0 * face.view.step + 0.01 and (best is None or gap < best[0]):
                support = EndSupport(other.support, face.support)
                best = gap, _End(position, _plane_variance(other, face.middle), "support", support)
    return None if best is None else best[1]


def _plane_variance(face: _Face, point: FloatArray) -> float:
    """Variance of the distance of a face's plane from a point near it, m^2."""
    local = (point - face.view.frame[0]) @ face.view.frame[1:].T
    J = np.array([local[0], local[1], 1.0])
    return float(J @ face.view.plane_covariance @ J)


def with_calibration(box: BoxMeasurement, moved: MovedBeams, covariance: FloatArray) -> BoxMeasurement:
    """The measurement with the calibration's share of each length's standard deviation.

    Parameters
    ----------
    moved
        Gives the beams of flat indices under a small change (n,) of the calibration's parameters.
    covariance : (n, n)
        Of these parameters.
    """
    shares = calibration_sigmas(lambda change: edge_lengths(box, moved, change), covariance)
    edges = tuple(replace(e, calibration_sigma_m=float(s)) for e, s in zip(box.edges, shares, strict=True))
    return replace(box, edges=edges)


def edge_lengths(box: BoxMeasurement, moved: MovedBeams, change: FloatArray) -> FloatArray:
    """The edges' lengths, each up to a constant, under a change (n,): planes refitted, borders moved along."""
    fits: dict[int, Plane] = {}

    def plane(face: FaceSupport) -> Plane:
        key = int(face.index[0])
        if key not in fits:
            fits[key] = fit_plane_to_ranges(face.plane, moved(change, face.index), np.inf)[0]
        return fits[key]

    def middle(face: FaceSupport, index: IntArray) -> FloatArray:
        beams = moved(change, index)
        return np.asarray((beams.origin + plane_ranges(plane(face), beams)[:, None] * beams.direction).mean(axis=0))

    def position(end: EndSupport, direction: FloatArray) -> float:
        if end.face is None:
            return float(sum(w * (middle(face, index) @ direction) for face, index, w in end.borders))
        found = plane(end.face)
        if end.beside is None:
            return end.face.sign * found.offset
        start = middle(end.beside, end.beside.index)
        gap = (found.offset - float(found.normal @ start)) / float(found.normal @ direction)
        return float(start @ direction) + gap

    lengths = []
    for edge in box.edges:
        normals = [face.sign * plane(face).normal for face in edge.axis]
        axis = normals[0] if len(normals) == 1 else unit(np.cross(normals[0], normals[1]))
        lengths.append(position(edge.ends[0], axis) + position(edge.ends[1], -axis))
    return np.array(lengths)
