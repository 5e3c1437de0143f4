"""Where the faces of a target end: what is seen just outside of them is left out, by all places' returns together.

A board is seen with its edge, a carton with the ground at its foot: surfaces that leave a face's plane by millimetres
over the first centimetre, within the noise of single returns, and always to the same side. At one place they are too
few to be told, yet many enough to turn the face by more than its returns' noise does. The target is the same at all
places, and the rays, which carry no noise, tell where on its faces each return lies: so the returns of all places near
one side of a face are taken together, ordered from the outside inwards, and tested for a step: the largest of all
means from the outermost return on, over its standard deviation (Page 1954).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, unit
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import medians
from lidarpose.geometry.threads import each
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.face_systems import subset_of, tangents

# A side's returns are tested this far inwards, or for this share of the face where that is less.
STRIP_M, STRIP_SHARE = 0.04, 0.2
# A mean of so many standard deviations is no noise: chance makes one on a side in fifty.
STEP_SIGMAS = 3.0
CLIP_SIGMAS = 4.0
# Beams that a LiDAR repeats frame by frame are as far out but for rounding, single precision's where clouds hold that:
# as far as they are taken to be, and no more than this share of the mean spacing.
TIED_RAD, TIED_SHARE = 1e-6, 0.1
# Half a beam's width, and a little: a beam this far inside a side meets the face alone.
GUARD_M, GUARD_RAD = 0.002, 0.0015
MOST_GRAZING, GUARD_SHARE = 0.2, 0.1
# Of a lone scan line nothing is tested, and a face's few returns are no face.
THINNEST_M, FEWEST_RETURNS = 0.01, 8
OUTLINE_DIRECTIONS = 128
MOST_FOR_OUTLINE = 4000
# Sides shorter than this share of the face are rounding of its outline; two this alike in direction are one.
SIDE_SHARE = 0.15
SAME_SIDE_COS = np.cos(np.radians(20.0))
# Where two faces meet, their edge is known by their planes.
SEAM_M, SEAM_COS = 0.03, 0.9
# By how much kernels are done sooner, on one core.
SAVED_S_PER_RETURN, KERNELS = 1e-8, "refine.corner_kernels"

# Half of the directions (D, 2): the others are their opposites.
_ANGLES = np.arange(OUTLINE_DIRECTIONS // 2) * (2.0 * np.pi / OUTLINE_DIRECTIONS)
_ROUND = np.column_stack([np.cos(_ANGLES), np.sin(_ANGLES)])


@dataclass(frozen=True, eq=False)
class _Face:
    """A face's returns at all places.

    Attributes
    ----------
    points : (2, N)
        Where the rays meet the face, in its plane, from the corner (m).
    residual : (N,)
        Measured minus expected range, in standard deviations of a single return.
    place : (N,)
        Which place each return is of, ascending.
    toward : (P, 2), distance_m : (P,)
        Of each place: the unit direction to the corner along the plane's axes, and the distance.
    """

    points: FloatArray
    residual: FloatArray
    place: IntArray
    toward: FloatArray
    distance_m: FloatArray


@dataclass(frozen=True, eq=False)
class _Side:
    """A straight side of a face: the direction (2,) outwards in its plane, and how far out it lies."""

    outward: FloatArray
    reach_m: float


def without_rims(
    places: Sequence[CornerPlaceFaces],
    normals: FloatArray,
    corners: FloatArray,
    sigma_m: float,
    common_error: float = 1.0,
) -> list[CornerPlaceFaces]:
    """The places without what lies outside the target's faces, or so near their sides that beams meet both.

    Parameters
    ----------
    places
        What seems to be of the faces.
    normals, corners : (3, 3), (P, 3)
        The faces' unit normals and the corner at each place, both nearly right.
    sigma_m
        The ranges' noise.
    common_error
        By how much spots' means scatter more than the noise allows, in squares.
    """
    rows = [[i for i, p in enumerate(places) if j in p.faces] for j in range(3)]

    def of_face(j: int) -> list[FaceReturns | None]:
        axes = tangents(normals[j]).T
        returns = [places[i].faces[j] for i in rows[j]]
        face = _face(returns, normals[j], axes, corners[rows[j]], sigma_m)
        seams = unit(np.stack([axes @ normals[k] for k in range(3) if k != j]))
        inside = _inside(face, _sides(face, seams), STEP_SIGMAS * np.sqrt(common_error))
        ends = np.cumsum([len(f) for f in returns])
        return [_kept(f, mine) for f, mine in zip(returns, np.split(inside, ends[:-1]), strict=True)]

    seen = [j for j in range(3) if rows[j]]
    kept: list[dict[int, FaceReturns]] = [{} for _ in places]
    for j, faces in zip(seen, each(of_face, seen, sum(len(f) for p in places for f in p.faces.values())), strict=True):
        for i, returns in zip(rows[j], faces, strict=True):
            if returns is not None:
                kept[i][j] = returns
    return [replace(p, faces=k) for p, k in zip(places, kept, strict=True)]


def _kept(returns: FaceReturns, mine: BoolArray) -> FaceReturns | None:
    count = np.count_nonzero(mine)
    if count < FEWEST_RETURNS:
        return None
    return returns if count == len(mine) else subset_of(returns, np.flatnonzero(mine))


def _face(
    returns: Sequence[FaceReturns], normal: FloatArray, axes: FloatArray, corners: FloatArray, sigma_m: float
) -> _Face:
    count = [len(f) for f in returns]
    points, residual = np.empty((2, sum(count))), np.empty(sum(count))
    ends = np.cumsum(count)
    compiled = pays(SAVED_S_PER_RETURN * len(residual), KERNELS)
    for f, corner, begin, end in zip(returns, corners, ends - count, ends, strict=True):
        put = _met_compiled if compiled else _met
        put(f, np.vstack([normal, axes]), corner, points[:, begin:end], residual[begin:end])
    residual *= 1.0 / sigma_m
    np.clip(residual, -CLIP_SIGMAS, CLIP_SIGMAS, out=residual)
    distance = np.linalg.norm(corners, axis=1)
    place = np.repeat(np.arange(len(returns)), count)
    return _Face(points, residual, place, corners @ axes.T / distance[:, None], distance)


def _met(returns: FaceReturns, axes: FloatArray, corner: FloatArray, points: FloatArray, residual: FloatArray) -> None:
    """Where a place's rays meet the face (2, N), in its plane from the corner, and measured minus expected ranges (N,);
    `axes` (3, 3) are its normal and two tangents."""
    along, at = axes @ returns.rays, axes @ corner
    expected = at[0] / along[0]
    np.multiply(along[1:], expected, out=points)
    points -= at[1:, None]
    np.subtract(returns.range_m, expected, out=residual)


def _met_compiled(
    returns: FaceReturns, axes: FloatArray, corner: FloatArray, points: FloatArray, residual: FloatArray
) -> None:
    from lidarpose.refine.corner_kernels import met_at

    range_m = np.ascontiguousarray(returns.range_m, dtype=np.float64)
    met_at(returns.rays, range_m, axes, axes @ corner, points[0], points[1], residual)


def _sides(face: _Face, seams: FloatArray) -> list[_Side]:
    """The straight sides of a face but those along the lines through 0 across `seams` (2, 2)."""
    few, vertices = _common_part(face)
    edges = np.roll(vertices, -1, axis=0) - vertices
    length = np.linalg.norm(edges, axis=1)
    outward = np.column_stack([edges[:, 1], -edges[:, 0]]) / np.maximum(length, 1e-12)[:, None]
    middle = vertices + 0.5 * edges
    seam = ((np.abs(middle @ seams.T) < SEAM_M) & (np.abs(outward @ seams.T) > SEAM_COS)).any(axis=1)
    sides: list[_Side] = []
    for k in np.argsort(-length):
        if length[k] < SIDE_SHARE * np.ptp(few, axis=1).max():
            break
        if not seam[k] and all(outward[k] @ other.outward < SAME_SIDE_COS for other in sides):
            sides.append(_Side(outward[k], float(outward[k] @ vertices[k])))
    return sides


def _common_part(face: _Face) -> tuple[FloatArray, FloatArray]:
    """Some of a face's points (2, N), those no farther out in any direction than half of the places reach; and those of
    them that are farthest out (V, 2), counter-clockwise.

    Where the ground lies 2 cm below a face, a single place may show it as the face's own.
    """
    step = max(len(face.place) // MOST_FOR_OUTLINE, 1)
    points, place = np.ascontiguousarray(face.points[:, ::step]), face.place[::step]
    begins = np.flatnonzero(np.diff(place, prepend=-1))
    if pays(10.0 * SAVED_S_PER_RETURN * len(place), KERNELS):
        from lidarpose.refine.corner_kernels import farthest_out, reaches, within

        most, least = (medians(ends, axis=0) for ends in reaches(points, _ROUND, np.append(begins, len(place))))
        near = np.flatnonzero(within(points, _ROUND, least - 1e-6, most + 1e-6))
        if FEWEST_RETURNS < near.size < place.size:
            points = points.take(near, axis=1)
        outermost = farthest_out(points, _ROUND)
    else:
        out = _ROUND @ points
        most, least = (medians(ends.reduceat(out, begins, axis=1), axis=1) for ends in (np.maximum, np.minimum))
        beyond = out > most[:, None] + 1e-6
        beyond |= out < least[:, None] - 1e-6
        near = np.flatnonzero(~beyond.any(axis=0))
        if FEWEST_RETURNS < near.size < place.size:
            points, out = points.take(near, axis=1), out.take(near, axis=1)
        outermost = np.concatenate([out.argmax(axis=1), out.argmin(axis=1)])
    return points, np.asarray(points[:, outermost[outermost != np.roll(outermost, 1)]].T)


def _inside(face: _Face, sides: Sequence[_Side], step_sigmas: float) -> BoolArray:
    """Which returns (N,) are of the face alone."""
    inside = np.ones(len(face.residual), dtype=bool)
    for side in sides:
        inwards = side.reach_m - side.outward @ face.points
        across = float(inwards.max())
        if across < THINNEST_M:
            continue
        inside[_foreign_beyond(face, inwards, step_sigmas)] = False
        strip = np.flatnonzero(inwards < min(STRIP_M, STRIP_SHARE * across))
        strip = strip[inside.take(strip)]
        if len(strip) == 0:
            continue
        end = _end_of_foreign(face, inwards, strip, step_sigmas)
        # A beam's width is stretched where it meets the face at a grazing angle.
        seen = np.sqrt(1.0 - (face.toward @ side.outward) ** 2)
        guard = (GUARD_M + GUARD_RAD * face.distance_m) / np.maximum(seen, MOST_GRAZING)
        limit = end + np.minimum(guard, GUARD_SHARE * across)
        outer = np.flatnonzero(inwards <= limit.max())
        inside[outer[inwards.take(outer) <= limit[face.place.take(outer)]]] = False
    return inside


def _end_of_foreign(face: _Face, inwards: FloatArray, strip: IntArray, step_sigmas: float) -> float:
    """How far inwards (m) reaches what is off the face among some returns (M,) of a side; if none is, its outermost.

    Returns of one beam are told apart by rounding alone: they are foreign together or not at all.
    """
    strip = strip[np.argsort(inwards.take(strip))]
    ordered = inwards.take(strip)
    tied_m = min(TIED_RAD * float(face.distance_m.min()), TIED_SHARE * float(ordered[-1] - ordered[0]) / len(ordered))
    last = np.append(np.flatnonzero(np.diff(ordered) > tied_m), len(ordered) - 1)
    sums = np.abs(np.cumsum(face.residual.take(strip)).take(last)) / np.sqrt(last + 1.0)
    step = int(np.argmax(sums))
    return float(ordered[last[step if sums[step] > step_sigmas else 0]])


def _foreign_beyond(face: _Face, inwards: FloatArray, step_sigmas: float) -> IntArray:
    """Which returns (M,) lie farther out than half of the places reach, at places where these are off the face."""
    beyond = np.flatnonzero(inwards < -TIED_RAD * face.distance_m.min())
    place = face.place.take(beyond)
    count = np.bincount(place, minlength=len(face.distance_m))
    total = np.bincount(place, face.residual.take(beyond), len(face.distance_m))
    foreign = np.abs(total) > step_sigmas * np.sqrt(np.maximum(count, 1))
    return np.asarray(beyond[foreign[place]])
