"""The target of a corner session found by its motion: it alone stands elsewhere at each place, and unturned.

Three places, far from one another, tell what moved; one of them shows a corner in it; its normals find the corner at
the other two; and the three corners tell where to look at all places, in all that is there.
"""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.detect.known_corner import corner_of_normals, sight_again, surroundings
from lidarpose.detect.moved_points import moved_points
from lidarpose.detect.trihedral_corner import find_corners
from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.model.corner_session import CloudSource, CornerSession, look_at_points
from lidarpose.solve.corner_alignment import svd_pose
from lidarpose.solve.corner_matching import SAME_ORIENTATION_RAD, TOLERANCE_M, face_order

MIN_FACE_RETURNS = 12
FACE_RETURNS = 30
HYPOTHESES = 250
# Of so many places at most, the best triangle is sought.
MOST_PLACES = 12
# Corners that are tried, best supported first; a scene in which more has moved is for the full search.
MOST_CORNERS = 3
FEWEST_MOVED = 60
# A scan of more points is searched as a whole: a subsample of it shows the target as well.
MOST_POINTS = 4_000_000
# What lies about the target beyond what of it is known to have moved: the rest of its faces, and what borders them.
AROUND_M = 0.4

Points = NDArray[np.floating[Any]]


def load_points(source: CloudSource) -> FloatArray:
    """A frame's finite points (N, 3), as stored. Raises InputError if there are too few to see anything in."""
    points = source.load().finite().points
    if len(points) < 3 * MIN_FACE_RETURNS:
        raise InputError(
            source.name, f"holds {len(points)} points with coordinates", expected="a frame that shows the target"
        )
    return points


def find_by_motion(session: CornerSession, world: FloatArray, *, seed: int = 0) -> list[CornerCandidate] | None:
    """A sighting of the target at each place, if it can be had with little work; None if not, or with any hint given.

    Raises
    ------
    InputError
        If a cloud cannot be read.
    """
    if any(place.near is not None for place in session.places):
        return None
    three = _widest_triangle(world)
    frames = {k: load_points(session.places[k].clouds[0]) for k in three}
    if max(len(points) for points in frames.values()) > MOST_POINTS:
        return None
    moved = {k: f[i] for (k, f), i in zip(frames.items(), moved_points(list(frames.values())), strict=True)}
    if min(len(points) for points in moved.values()) < FEWEST_MOVED:
        return None
    first = max(moved, key=lambda k: len(moved[k]))
    search = PlaneSearch(min_points=FACE_RETURNS, from_sensor=True, seed=seed, hypotheses=HYPOTHESES)
    corners = find_corners(moved[first], segment_planes(moved[first], search))
    found = []
    for corner in corners[:MOST_CORNERS]:
        sightings = _followed(session, world, frames, moved, first, corner, search)
        if sightings is not None:
            found.append(sightings)
    # Two corners that move alike are for the full search to judge.
    return found[0] if len(found) == 1 else None


def _widest_triangle(world: FloatArray) -> tuple[int, int, int]:
    """The three places whose triangle has the greatest height."""
    few = np.linspace(0, len(world) - 1, min(len(world), MOST_PLACES)).round().astype(int).tolist()
    triples = np.array(list(combinations(few, 3)))
    p, q, r = world[triples].swapaxes(0, 1)
    longest = np.max([np.linalg.norm(side, axis=1) for side in (q - p, r - p, q - r)], axis=0)
    height = np.linalg.norm(np.cross(q - p, r - p), axis=1) / np.maximum(longest, 1e-9)
    a, b, c = triples[int(np.argmax(height))].tolist()
    return a, b, c


def _followed(
    session: CornerSession,
    world: FloatArray,
    frames: dict[int, Points],
    moved: dict[int, Points],
    first: int,
    corner: CornerCandidate,
    search: PlaneSearch,
) -> list[CornerCandidate] | None:
    """The corner at all places, if it moves as the world coordinates say."""
    three = list(frames)
    for elsewhere in (_by_normals, _by_search):
        corners = np.stack([corner.corner if k == first else elsewhere(moved[k], corner, search) for k in three])
        if not _as_far_apart(corners, world[three]):
            continue
        expected = svd_pose(world[three], corners).inverse() @ world
        around = []
        for k, place in enumerate(session.places):
            about = partial(surroundings, reference=corner, corner=expected[k], around_m=AROUND_M)
            around.append(about(frames[k]) if k in frames else look_at_points(place.clouds[0], about))
        sightings = sight_again(around, corner, expected, seed=search.seed, part_at=first)
        if sightings is not None:
            return sightings
    return None


def _by_normals(moved: Points, corner: CornerCandidate, search: PlaneSearch) -> FloatArray:
    """Where the corner's faces are among the moved points of another place, by their normals alone."""
    del search
    return corner_of_normals(moved, corner.normals, corner.sigma_m)


def _by_search(moved: Points, corner: CornerCandidate, search: PlaneSearch) -> FloatArray:
    """Where the corner is, by a search of its own; far away where there is none."""
    for other in find_corners(moved, segment_planes(moved, search)):
        if other.convex == corner.convex and face_order(other.normals, corner.normals)[1] < SAME_ORIENTATION_RAD:
            return other.corner
    return np.full(3, np.inf)


def _as_far_apart(corners: FloatArray, world: FloatArray) -> bool:
    pairs = ((0, 1), (0, 2), (1, 2))
    return bool(np.isfinite(corners).all()) and all(
        abs(np.linalg.norm(corners[a] - corners[b]) - np.linalg.norm(world[a] - world[b])) < TOLERANCE_M
        for a, b in pairs
    )
