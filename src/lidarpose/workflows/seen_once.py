"""A target whose three faces are found together at one or two places only: the others' by what is known from there.

Elsewhere a face is often found with its neighbours in one patch, or hidden next to the corner, while two others are
plain. Two planes of known normals hold the edge between them; the world coordinates tell how far along it the corner
is from where it was seen: two spots, and in one of them the target has to stand as it was seen before.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from lidarpose.detect.known_corner import sight_again, surroundings
from lidarpose.geometry.arrays import FloatArray, cross3, unit
from lidarpose.geometry.planes import Plane
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.model.plane_patch import PlanePatch
from lidarpose.solve.corner_matching import MOVED_M, SAME_ORIENTATION_RAD, STRAY_SUPPORT, TOLERANCE_M

# Corners of a place that are looked for elsewhere, best supported first; nearer to one another they are the same.
MOST_CORNERS, SAME_M = 8, 0.05
# By how much a face may be hidden next to a corner that is known.
HIDDEN_M = 0.6
# Planes have an edge where they are turned against one another by more than this.
LEAST_SINE = 0.3
# Noise makes a target of what is no target where a face's own place is known no better than this.
KNOWN_M = 0.003
# Spots nearer to one another are looked at once.
SAME_SPOT_M = 0.03


@dataclass(frozen=True, eq=False)
class SeenPlace:
    """What is seen at a place: points (N, 3) of one frame or more, its flat patches as planes, with the box of each
    (P, 3), and its corners."""

    points: FloatArray
    planes: tuple[Plane, ...]
    low: FloatArray
    high: FloatArray
    corners: Sequence[CornerCandidate]

    @staticmethod
    def of(points: FloatArray, patches: Sequence[PlanePatch], corners: Sequence[CornerCandidate]) -> SeenPlace:
        low = [points[patch.indices].min(axis=0) for patch in patches]
        high = [points[patch.indices].max(axis=0) for patch in patches]
        planes = tuple(patch.plane for patch in patches)
        return SeenPlace(points, planes, np.reshape(low, (-1, 3)), np.reshape(high, (-1, 3)), corners)


def seen_elsewhere(places: Sequence[SeenPlace], world: FloatArray) -> Iterator[list[list[CornerCandidate]]]:
    """For each corner that stands at one place alone: it, and by place where the same target may stand at the others.

    Corners that are seen at the same spot at other places as well stand still, and are left out.

    Parameters
    ----------
    world : (P, 3)
        The measured corners, metres.
    """
    for k, place in enumerate(places):
        for corner in _distinct(place.corners):
            if any(_stands(places[j], corner, corner.corner) for j in _elsewhere(k, world)):
                continue
            apart_m = np.linalg.norm(world - world[k], axis=1)
            found = [[corner] if j == k else _sighted(other, corner, apart_m[j]) for j, other in enumerate(places)]
            yield [
                [s for s in here if not any(_stands(places[i], s, s.corner) for i in _elsewhere(j, world))]
                for j, here in enumerate(found)
            ]


def _distinct(corners: Sequence[CornerCandidate]) -> list[CornerCandidate]:
    kept: list[CornerCandidate] = []
    for corner in sorted(corners, key=lambda c: -c.support):
        # A face of few returns is tilted, and its corner off, by chance alone.
        if corner.support >= STRAY_SUPPORT and all(
            np.linalg.norm(corner.corner - other.corner) > SAME_M for other in kept
        ):
            kept.append(corner)
    return kept[:MOST_CORNERS]


def _elsewhere(place: int, world: FloatArray) -> list[int]:
    """The places at which the target stands plainly elsewhere than at this one."""
    return np.flatnonzero(np.linalg.norm(world - world[place], axis=1) > MOVED_M).tolist()


def _stands(place: SeenPlace, corner: CornerCandidate, spot: FloatArray) -> CornerCandidate | None:
    """The corner's target at a spot of a place, if it is there."""
    around = [surroundings(place.points, corner, spot)]
    for held in (False, True):
        seen = sight_again(around, corner, spot[None], missing_m=HIDDEN_M, held=held)
        if seen is not None:
            return seen[0]
    return None


def _sighted(place: SeenPlace, corner: CornerCandidate, apart_m: float) -> list[CornerCandidate]:
    """The corner's target at a place, a distance from where it was seen, by two of its faces there and all three."""
    found = []
    for spot in _spots(place, corner, apart_m):
        seen = _stands(place, corner, spot)
        if seen is None or seen.sigma_m > KNOWN_M * np.sqrt(seen.support):
            continue
        if abs(float(np.linalg.norm(seen.corner - corner.corner)) - apart_m) < TOLERANCE_M:
            found.append(seen)
    return found


def _spots(place: SeenPlace, corner: CornerCandidate, apart_m: float) -> list[FloatArray]:
    """Where (3,) on the edges between two patches turned as two faces the corner may stand, by its distance."""
    normals = np.array([plane.normal for plane in place.planes]).reshape(-1, 3)
    alike = normals @ corner.normals.T > np.cos(SAME_ORIENTATION_RAD)
    spots: list[FloatArray] = []
    for a, b in combinations(range(3), 2):
        for i in np.flatnonzero(alike[:, a]).tolist():
            for j in np.flatnonzero(alike[:, b]).tolist():
                reach = [place.low[[i, j]].max(axis=0) - HIDDEN_M, place.high[[i, j]].min(axis=0) + HIDDEN_M]
                for spot in _at_distance(place.planes[i], place.planes[j], corner.corner, apart_m):
                    inside = (spot > reach[0]).all() and (spot < reach[1]).all()
                    if inside and all(np.linalg.norm(spot - other) > SAME_SPOT_M for other in spots):
                        spots.append(spot)
    return spots


def _at_distance(one: Plane, other: Plane, centre: FloatArray, distance_m: float) -> list[FloatArray]:
    """The points (3,) of two planes' edge at a distance from a point; the nearest where it hardly misses them."""
    across = cross3(one.normal, other.normal)
    if np.linalg.norm(across) < LEAST_SINE:
        return []
    along = unit(across)
    offsets = np.array([one.offset, other.offset, float(along @ centre)])
    foot = np.linalg.solve(np.stack([one.normal, other.normal, along]), offsets)
    off_m = float(np.linalg.norm(foot - centre))
    if off_m > distance_m + TOLERANCE_M:
        return []
    half = np.sqrt(max(distance_m**2 - off_m**2, 0.0))
    return [foot + half * along, foot - half * along]
