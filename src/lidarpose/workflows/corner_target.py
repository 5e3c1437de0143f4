"""The target of a corner session: found in one frame of each place, then gathered from all frames."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from itertools import combinations

import numpy as np

from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.detect.crop import inside_box
from lidarpose.detect.edge_corner import find_edge_corners
from lidarpose.detect.noisy_planes import segment_noisy_planes
from lidarpose.detect.trihedral_corner import FaceMask, find_corners
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.robust import median
from lidarpose.geometry.threads import each
from lidarpose.model.corner_result import CornerCandidate, CornerPlaceFaces, FaceReturns
from lidarpose.model.corner_session import NEAR_RADIUS_M, CornerPlace, CornerSession, look_at_points
from lidarpose.model.observation import LeftOut
from lidarpose.model.plane_patch import PlanePatch
from lidarpose.refine.face_screening import without_foreign_spots
from lidarpose.refine.free_corner import FreeCorner, fit_corner
from lidarpose.solve.corner_matching import (
    SAME_ORIENTATION_RAD,
    TOLERANCE_M,
    CornerMatch,
    Stray,
    match_corners,
    match_of,
    nearest_strays,
)
from lidarpose.workflows.moving_target import MIN_FACE_RETURNS, find_by_motion, load_points
from lidarpose.workflows.seen_once import SeenPlace, seen_elsewhere

# A hint is right within 0.3 m, and a target no larger than this beyond the corner.
HINT_CROP_M = 1.5
# A face in a single frame: at the first look, and at later ones where no target was found.
FACE_RETURNS, FEWEST_FACE_RETURNS = 30, 15
LOOKS = 4
# In noise a second look finds the target at one place in fifteen more: worth it for three or four, none of which may
# lack; no help where half of many do.
NOISY_LOOKS, NOISY_LOOKS_AT_MANY, MANY_PLACES = 2, 1, 5
# Where they fail, so many frames of a place at most, and points, are looked at together.
STACKED_FRAMES, STACKED_POINTS = 20, 300_000
SEEN_ONCE = (
    "few places show the target whole, and at the others two of its faces and its distance have told where it is: "
    "record it so that all three faces are seen up to the corner at each place"
)
# Corners farther apart than that are two.
APART_M = 0.1
GATE_SIGMAS = 6.5
FIRST_GATE_M = 0.05
# The share of a face next to the corner on which the first fit stands, before its far edges are trusted.
INNER_SHARE = 0.6
INNER_STEPS, FIT_STEPS = 2, 5
# A corner that moved by no more since its beams were selected selects the same ones.
SETTLED_M, INNER_SETTLED_M = 5e-4, 3e-3
# What is cut out around the faces as sighted: the fitted corner may be this far from the sighted one, but for a
# sighting that is a fit itself.
CROP_MARGIN_M, CLOSE_CROP_M = 0.15, 0.06
# Of the beams towards a face, the share that has to end on one surface for that to be the face, elsewhere.
SEEN_TOGETHER = 0.7
GOLDEN = 0.6180339887498949

Tick = Callable[[], None]


@dataclass(frozen=True, eq=False)
class FoundTarget:
    """The target at each place (None where it was not found), the match behind it, and what is odd about the world.

    Attributes
    ----------
    world : (P, 3)
        The world coordinates under which the corners fit: those of the session unless `oddity` names what is wrong.
    oddity
        Why the session's own coordinates do not fit, for the user; empty if they do.
    strays
        By place without a sighting: what stands there instead, for the user.
    by_edges
        The sightings are of two faces; the third's normal is but the direction of their edge.
    by_motion
        Each sighting's planes were fitted at its place to all that a frame has of the faces; none is turned far.
    doubt
        Why this may be another corner, for the user; empty if it cannot.
    """

    sightings: tuple[CornerCandidate | None, ...]
    match: CornerMatch
    world: FloatArray
    oddity: str
    ambiguous: bool
    strays: Mapping[int, str] = field(default_factory=dict)
    by_edges: bool = False
    by_motion: bool = False
    doubt: str = ""


@dataclass(frozen=True, eq=False)
class PlaceCrop:
    """What all frames of a place hold around the target: points (N, 3) and the frame (N,) of each, ascending."""

    points: FloatArray
    frame: IntArray
    frames: int

    @property
    def range_m(self) -> FloatArray:
        """(N,)"""
        return self._beams[1]

    @property
    def rays(self) -> FloatArray:
        """Unit beam directions as contiguous rows (3, N)."""
        return self._beams[0]

    @cached_property
    def _beams(self) -> tuple[FloatArray, FloatArray]:
        rays = np.ascontiguousarray(self.points.T)
        range_m = np.sqrt(np.einsum("ij,ij->j", rays, rays))
        rays = rays / range_m if np.shares_memory(rays, self.points) else np.divide(rays, range_m, out=rays)
        return rays, range_m

    @property
    def directions(self) -> FloatArray:
        """Unit beam directions (N, 3)."""
        return self.rays.T

    def thinned(self, most: int) -> PlaceCrop:
        """`most` of the points, spread evenly over all frames; all of them where there are hardly more.

        One of each stretch of them; the golden ratio's multiples, which say which, hit no period of the beams' order.
        """
        count = len(self.frame)
        if count < 1.5 * most:
            return self
        index = (_spread_evenly(most) * (count / most)).astype(np.int64)
        return PlaceCrop(self.points.take(index, axis=0), self.frame.take(index), self.frames)


@lru_cache(maxsize=4)
def _spread_evenly(most: int) -> FloatArray:
    """One number (N,) between each of 0 to `most` and the next."""
    step = np.arange(most)
    return np.asarray(step + step * GOLDEN % 1.0)


def world_coordinates(session: CornerSession) -> FloatArray:
    """The measured corners (P, 3)."""
    return np.stack([p.corner_world for p in session.places])


def check_layout(session: CornerSession) -> None:
    """Refuse places that determine no pose, whatever the clouds hold.

    Raises
    ------
    UndeterminedError
        For fewer than three places, places on one spot, and places on one line.
    """
    remedy = "Record the target at three or more places, well off one line."
    if len(session.places) < 3:
        raise UndeterminedError(
            f"{len(session.places)} places determine no pose; at least three are needed", remedy=remedy
        )
    world = world_coordinates(session)
    spread = np.linalg.svd(world - world.mean(axis=0), compute_uv=False) / np.sqrt(len(world))
    if spread[0] < 0.02:
        raise UndeterminedError(
            f"all places lie within {spread[0] * 1e3:.0f} mm of one spot: the rotation stays undetermined",
            remedy=remedy,
        )
    if spread[1] < max(0.01, 0.01 * spread[0]):
        raise UndeterminedError(
            f"all places lie on one line (collinear, to {spread[1] * 1e3:.0f} mm): "
            "the rotation about that line stays undetermined",
            remedy="Move the target off the line, or raise it, at one place or more.",
        )


def find_target(session: CornerSession, *, seed: int = 0, tick: Tick = lambda: None) -> FoundTarget:
    """Find the target in the first frame of each place, near its hint or unaided.

    First by what moves: where the target is the same at all places, nothing else has to be looked at. Else, or if
    anything is odd about the coordinates, by all corners of all places.

    Raises
    ------
    UndeterminedError
        If no corner, or more than one, moves as the world's coordinates say.
    """
    check_layout(session)
    world = world_coordinates(session)
    quick = find_by_motion(session, world, seed=seed)
    if quick is not None:
        for _ in session.places:
            tick()
        match = match_of(quick, world)
        if match is not None:
            return FoundTarget(tuple(quick), match, world, "", False, by_motion=True)

    def corners_at(place: CornerPlace) -> tuple[CornerCandidate, ...]:
        found = place_corners(place, seed)
        tick()
        return found

    with ThreadPoolExecutor(2) as pool:
        candidates = list(pool.map(corners_at, session.places))
    matches, world, oddity = _match_with_mistakes(candidates, world, session.estimate_scale)
    for attempt in range(1, LOOKS):
        missing = [k for k in range(len(world)) if not matches or matches[0].choice[k] is None]
        if not missing:
            break
        # Look again there, with another frame, another draw of samples, and for smaller faces.
        for k in missing:
            place = session.places[k]
            frame = attempt * len(place.clouds) // LOOKS
            candidates[k] += place_corners(place, seed + attempt, frame, FEWEST_FACE_RETURNS)
        matches, world, oddity = _match_with_mistakes(candidates, world_coordinates(session), session.estimate_scale)
    for attempt in range(NOISY_LOOKS if len(world) < MANY_PLACES else NOISY_LOOKS_AT_MANY):
        # Fewer than half of the places may fit by chance, and three of four; where more do, those left add but time.
        if matches and matches[0].places >= max(0.5 * len(world), min(len(world), 5)):
            break
        for k, place in enumerate(session.places):
            candidates[k] += noisy_corners(place, session.lidar.range_sigma_m, seed + attempt)
        matches, world, oddity = _match_with_mistakes(candidates, world_coordinates(session), session.estimate_scale)
    if not matches:
        by_edges = _find_by_edges(session, seed)
        found = by_edges or _find_seen_once(session, candidates, seed)
        if found is None:
            raise _not_found(session, candidates)
        return found
    return _found(session, candidates, matches, world, oddity)


def _find_by_edges(session: CornerSession, seed: int) -> FoundTarget | None:
    """The target by the edge of two of its faces, if one alone moves as the world coordinates say at all places but
    one at most."""
    world = world_coordinates(session)
    candidates = [_edges_at(place, seed) for place in session.places]
    matches = match_corners(candidates, world)
    if not matches or matches[0].places < max(3, len(world) - 1):
        return None
    return replace(_found(session, candidates, matches, world, ""), by_edges=True)


def _find_seen_once(
    session: CornerSession, candidates: Sequence[Sequence[CornerCandidate]], seed: int
) -> FoundTarget | None:
    """The target by what one place shows of it, if it stands so at most of the others, as the coordinates say."""
    world = world_coordinates(session)
    range_sigma_m = session.lidar.range_sigma_m
    places = [_seen(place, here, range_sigma_m, seed) for place, here in zip(session.places, candidates, strict=True)]
    followed = [
        [_near_it(place, here) for place, here in zip(session.places, everywhere, strict=True)]
        for everywhere in seen_elsewhere(places, world)
    ]
    found = [(match, sightings) for sightings in followed for match in match_corners(sightings, world)]
    # Fewer than half of the places may fit by chance.
    if not found or 2 * max(match.places for match, _ in found) <= len(world):
        return None
    found.sort(key=lambda one: (-one[0].places, one[0].rms_m))
    target = _found(session, found[0][1], [match for match, _ in found], world, "")
    return replace(target, ambiguous=target.ambiguous or _is_outdone(target, followed), doubt=SEEN_ONCE)


def _is_outdone(target: FoundTarget, followed: Sequence[Sequence[Sequence[CornerCandidate]]]) -> bool:
    """Whether another corner, seen better than the target, is found elsewhere too: it may be the target's, hidden at
    the other places, and this one of something that was moved with it."""
    corners = expected_corners(target)
    support = max(s.support for s in target.sightings if s is not None)
    for rival in followed:
        seen = [
            (min(here, key=lambda c: float(np.linalg.norm(c.corner - corner))), corner)
            for here, corner in zip(rival, corners, strict=True)
            if here
        ]
        apart = [float(np.linalg.norm(c.corner - corner)) for c, corner in seen]
        if len(seen) > 1 and max(c.support for c, _ in seen) > support and min(apart) > APART_M:
            return True
    return False


def _seen(place: CornerPlace, corners: Sequence[CornerCandidate], range_sigma_m: float | None, seed: int) -> SeenPlace:
    first = _near_hint(load_points(place.clouds[0]), place)
    plain = segment_planes(first, PlaneSearch(min_points=FEWEST_FACE_RETURNS, from_sensor=True, seed=seed))
    points, patches = _stacked(place, range_sigma_m, seed)
    # Frames are stacked with the first one first.
    return SeenPlace.of(points, (*plain, *patches), corners)


def _edges_at(place: CornerPlace, seed: int) -> tuple[CornerCandidate, ...]:
    points = _near_hint(load_points(place.clouds[0]), place)
    patches = segment_planes(points, PlaneSearch(min_points=FACE_RETURNS, from_sensor=True, seed=seed))
    return find_edge_corners(points, patches)


def _found(
    session: CornerSession,
    candidates: Sequence[Sequence[CornerCandidate]],
    matches: Sequence[CornerMatch],
    world: FloatArray,
    oddity: str,
) -> FoundTarget:
    best = matches[0]
    sightings = tuple(
        None if k is None else _reordered(here[k], order)
        for here, k, order in zip(candidates, best.choice, best.orders, strict=True)
    )
    strays = {
        k: stray_in_words(session, world, k, stray) for k, stray in nearest_strays(candidates, best, world).items()
    }
    return FoundTarget(sightings, best, world, oddity, _is_ambiguous(matches, world), strays)


def stray_in_words(session: CornerSession, world: FloatArray, place: int, stray: Stray) -> str:
    """What is wrong with a place whose target stands elsewhere, or turned."""
    if stray.turned_rad >= SAME_ORIENTATION_RAD:
        return (
            f"the target seems turned by {np.degrees(stray.turned_rad):.0f} deg there against the other places; it "
            "must keep its orientation"
        )
    x, y, z = (f"{1e3 * v:+.0f}" for v in stray.off)
    text = (
        f"by the other places its corner stands {1e3 * np.linalg.norm(stray.off):.0f} mm from its world coordinates "
        f"(row {place + 1} of the positions would fit with {x}, {y}, {z} mm)"
    )
    apart = np.linalg.norm(world - stray.corner_world, axis=1)
    apart[place] = np.inf
    other = int(np.argmin(apart))
    if apart[other] < TOLERANCE_M:
        text += f"; it stands at the coordinates of {session.places[other].position}: swapped?"
    return text


def place_corners(
    place: CornerPlace, seed: int = 0, frame: int = 0, min_points: int = FACE_RETURNS
) -> tuple[CornerCandidate, ...]:
    """All corners in one frame of a place, or those near the hint, of faces with `min_points` returns or more."""
    points = _near_hint(load_points(place.clouds[frame]), place)
    patches = segment_planes(points, PlaneSearch(min_points=min_points, from_sensor=True, seed=seed))
    return find_corners(points, patches, place.near, NEAR_RADIUS_M)


def noisy_corners(place: CornerPlace, range_sigma_m: float | None, seed: int = 0) -> tuple[CornerCandidate, ...]:
    """All corners at a place, or those near the hint, whose faces are noisy beside their size, or have but few returns
    in a frame: all frames are looked at together."""
    points, patches = _stacked(place, range_sigma_m, seed)
    return find_corners(points, patches, place.near, NEAR_RADIUS_M)


def _stacked(place: CornerPlace, range_sigma_m: float | None, seed: int) -> tuple[FloatArray, tuple[PlanePatch, ...]]:
    """The points (N, 3) of up to `STACKED_FRAMES` frames of a place, and their patches."""
    first = _near_hint(load_points(place.clouds[0]), place)
    count = int(np.clip(STACKED_POINTS // max(len(first), 1), 1, min(STACKED_FRAMES, len(place.clouds))))
    others = np.linspace(0, len(place.clouds) - 1, count).round().astype(int)[1:].tolist()
    points = np.concatenate([first, *(_near_hint(load_points(place.clouds[k]), place) for k in others)])
    return points, segment_noisy_planes(points, range_sigma_m=range_sigma_m, min_points=FEWEST_FACE_RETURNS, seed=seed)


def _near_it(place: CornerPlace, corners: Sequence[CornerCandidate]) -> list[CornerCandidate]:
    """Those of the corners that are near the place's hint, if it has one."""
    return [c for c in corners if place.near is None or np.linalg.norm(c.corner - place.near) <= NEAR_RADIUS_M]


def _near_hint(points: FloatArray, place: CornerPlace) -> FloatArray:
    if place.near is None:
        return points
    offset = points - place.near.astype(points.dtype)
    return np.asarray(points[np.einsum("ij,ij->i", offset, offset) < HINT_CROP_M**2])


def _reordered(candidate: CornerCandidate, order: tuple[int, int, int]) -> CornerCandidate:
    a, b, c = (candidate.outlines[k] for k in order)
    return replace(candidate, normals=candidate.normals[list(order)], outlines=(a, b, c))


def _is_ambiguous(matches: Sequence[CornerMatch], world: FloatArray) -> bool:
    """Whether another corner fits the world as well: as many places, elsewhere, a residual not much worse."""
    best = matches[0]
    corners = best.T_world_lidar.inverse() @ world
    for other in matches[1:]:
        apart = np.linalg.norm(other.T_world_lidar.inverse() @ world - corners, axis=1)
        if other.places == best.places and np.median(apart) > APART_M and other.rms_m < 3.0 * best.rms_m + 0.005:
            return True
    return False


_MIRROR = np.array([1.0, -1.0, 1.0])
_MIRRORED = "the world coordinates are left-handed (mirrored): one axis points the wrong way"


def _match_with_mistakes(
    candidates: Sequence[Sequence[CornerCandidate]], world: FloatArray, free_scale: bool
) -> tuple[tuple[CornerMatch, ...], FloatArray, str]:
    """Match under the coordinates as they are; where they fail, under the mistakes that people make."""
    plain = match_corners(candidates, world)
    count = len(world)
    if plain and plain[0].places >= max(3, count - 1):
        mirrored = match_corners(candidates, world * _MIRROR) if plain[0].places < count else ()
        if mirrored and mirrored[0].places == count and mirrored[0].rms_m < plain[0].rms_m:
            return mirrored, world * _MIRROR, _MIRRORED
        return plain, world, ""
    best = (plain, world, "")
    best_places = plain[0].places if plain else 0
    for mistaken, oddity in _mistakes(world, free_scale):
        matches = match_corners(candidates, mistaken)
        if matches and matches[0].places >= max(3, best_places + 1) and matches[0].places >= 0.6 * count:
            best, best_places = (matches, mistaken, oddity), matches[0].places
            if best_places == count:
                break
    return best


def _mistakes(world: FloatArray, free_scale: bool) -> Iterator[tuple[FloatArray, str]]:
    units = [(1e-3, "millimetres"), (1e-2, "centimetres"), (0.3048, "feet"), (0.0254, "inches")]
    for factor, unit_name in units:
        yield factor * world, f"the world coordinates look like {unit_name}, not metres"
    yield 1e3 * world, "the world coordinates look like kilometres, or the clouds are in millimetres"
    if free_scale:
        for factor in np.geomspace(0.8, 1.25, 19):
            yield factor * world, ""
    yield world * _MIRROR, _MIRRORED
    if len(world) <= 12:
        for a, b in combinations(range(len(world)), 2):
            swapped = world.copy()
            swapped[[a, b]] = world[[b, a]]
            yield swapped, f"the rows {a + 1} and {b + 1} of the positions look swapped"


def _not_found(session: CornerSession, candidates: Sequence[Sequence[CornerCandidate]]) -> UndeterminedError:
    details = tuple(
        f"{place.position}: {len(here)} corner{'s' * (len(here) != 1)} of three faces"
        + (" near the hint" if place.near is not None else "")
        for place, here in zip(session.places, candidates, strict=True)
    )
    return UndeterminedError(
        "no corner of three faces moves from place to place as the world coordinates say",
        remedy="Check the coordinates against the frames, see that three faces of the target are in view without "
        "turning it, or give the corner's rough place in near_x_m,near_y_m,near_z_m.",
        details=details,
    )


def gather(session: CornerSession, found: FoundTarget, *, tick: Tick = lambda: None) -> tuple[PlaceCrop, ...]:
    """Cut the target's surroundings from all frames of all places."""
    corners, radius = expected_corners(found), _crop_radius(found)
    margin_m = CLOSE_CROP_M if found.by_motion else CROP_MARGIN_M

    def crop(task: tuple[CornerPlace, FloatArray, CornerCandidate | None]) -> PlaceCrop:
        place, corner, sighting = task
        low, high = corner - radius, corner + radius
        if sighting is not None:
            outlines = np.concatenate(sighting.outlines)
            low, high = outlines.min(axis=0) - margin_m, outlines.max(axis=0) + margin_m
        parts = []
        for source in place.clouds:
            parts.append(look_at_points(source, lambda points: inside_box(points, low, high)))
            tick()
        frame = np.repeat(np.arange(len(parts)), [len(p) for p in parts])
        return PlaceCrop(np.concatenate(parts, dtype=np.float64), frame, len(parts))

    with ThreadPoolExecutor(2) as pool:
        return tuple(pool.map(crop, zip(session.places, corners, found.sightings, strict=True)))


def expected_corners(found: FoundTarget) -> FloatArray:
    """The corner (P, 3) at each place in the clouds' frame: as sighted, or as the match predicts."""
    predicted = found.match.T_world_lidar.inverse() @ found.world
    return np.stack([p if s is None else s.corner for s, p in zip(found.sightings, predicted, strict=True)])


def _crop_radius(found: FoundTarget) -> float:
    reach = [
        float(np.linalg.norm(outline - s.corner, axis=1).max())
        for s in found.sightings
        if s is not None
        for outline in s.outlines
    ]
    return max(reach) + CROP_MARGIN_M


def margin_m(corner: FloatArray) -> float:
    """How far from an edge a beam still meets one face alone: half a beam's width, and a little."""
    return 0.002 + 0.0015 * float(np.linalg.norm(corner))


def mask_of(candidate: CornerCandidate, corner: FloatArray, normals: FloatArray, share: float = 1.0) -> FaceMask:
    """The beams of a sighting's faces, for a better corner and better normals than its own.

    With `share` below 1, only the faces' parts next to the corner.
    """
    a, b, c = (corner + share * (outline - candidate.corner) for outline in candidate.outlines)
    return FaceMask(corner, normals, candidate.convex, (a, b, c), candidate.obstacles, margin_m(corner))


def select_faces(
    crop: PlaceCrop, mask: FaceMask, gate_m: float, sigma_m: float | None = None
) -> dict[int, FaceReturns]:
    """Each face's returns at a place; with the noise known, without the spots that are plainly something else."""
    faces = {}
    for j, beams in enumerate(mask.beams_of(crop.points, gate_m)):
        if len(beams.index) < MIN_FACE_RETURNS:
            continue
        returns = FaceReturns(beams.rays.T, beams.range_m, crop.frame.take(beams.index))
        if sigma_m is not None:
            returns = without_foreign_spots(returns, beams.on_rim, mask.normals[j], mask.corner, sigma_m)
        if len(returns) >= MIN_FACE_RETURNS:
            faces[j] = returns
    return faces


def fit_place(crop: PlaceCrop, sighting: CornerCandidate, sigma_m: float) -> FreeCorner | None:
    """Three free planes at one place, selected and fitted in turn; None where they do not settle."""
    corner, normals = sighting.corner, sighting.normals
    fit: FreeCorner | None = None
    gate_m = max(FIRST_GATE_M, GATE_SIGMAS * sigma_m)
    settled = False
    try:
        for step in range(FIT_STEPS):
            inner = step < INNER_STEPS
            if settled and inner:
                continue
            mask = mask_of(sighting, corner, normals, INNER_SHARE if inner else 1.0)
            faces = select_faces(crop, mask, gate_m, None if inner else sigma_m)
            if inner and (len(faces) < 3 or not _reaches_both_ways(faces)):
                # Too few scan lines cross the inner parts: the whole faces have to do.
                continue
            if len(faces) < 3:
                return None
            last = step == FIT_STEPS - 1
            fit = fit_corner(faces, normals, corner, sigma_m, tolerance_m=1e-5 if last else 2e-4)
            settled = bool(np.linalg.norm(fit.corner - corner) < (INNER_SETTLED_M if inner else SETTLED_M))
            corner, normals, sigma_m = fit.corner, fit.normals, fit.sigma_m
            gate_m = min(gate_m, max(GATE_SIGMAS * sigma_m, 0.002))
            if settled and not inner:
                break
    except UndeterminedError:
        return None
    return fit if np.linalg.norm(corner - sighting.corner) < CROP_MARGIN_M else None


def observe_inner(
    session: CornerSession,
    found: FoundTarget,
    crops: Sequence[PlaceCrop],
    corners: FloatArray,
    normals: FloatArray,
    sigma_m: float,
) -> list[CornerPlaceFaces]:
    """Returns of the faces' parts next to the corner, which are surely of the target; of whole faces where scan lines
    are too few for that."""
    places, _ = observe(session, found, crops, corners, normals, sigma_m, INNER_SHARE)
    if all(len(place.faces) == 3 and _reaches_both_ways(place.faces) for place in places):
        return places
    return observe(session, found, crops, corners, normals, sigma_m)[0]


def _reaches_both_ways(faces: Mapping[int, FaceReturns]) -> bool:
    """Whether each face's returns are spread over two directions, not along one scan line."""
    for returns in faces.values():
        off = returns.rays - returns.rays.mean(axis=1, keepdims=True)
        squares = np.linalg.eigvalsh(off @ off.T)
        if squares[1] < 0.1**2 * squares[2]:
            return False
    return True


def observe(
    session: CornerSession,
    found: FoundTarget,
    crops: Sequence[PlaceCrop],
    corners: FloatArray,
    normals: FloatArray,
    sigma_m: float,
    share: float = 1.0,
) -> tuple[list[CornerPlaceFaces], list[LeftOut]]:
    """Returns of the faces at each place, selected by common normals; what is left out, and why.

    With `share` below 1, only of the faces' parts next to the corner.
    """
    places, left_out = [], []
    reference = max((s for s in found.sightings if s is not None), key=lambda s: s.support)

    def select(task: tuple[CornerCandidate | None, PlaceCrop, FloatArray]) -> dict[int, FaceReturns]:
        sighting, crop, corner = task
        mask = mask_of(sighting or reference, corner, normals, share)
        # Next to the corner of a target that was sighted, hardly anything is foreign; the loss sees to that.
        screened = share == 1.0 or sighting is None
        return select_faces(crop, mask, GATE_SIGMAS * sigma_m, sigma_m if screened else None)

    tasks = list(zip(found.sightings, crops, corners, strict=True))
    selected = each(select, tasks, max(len(crop.frame) for crop in crops))
    for k, (place, (sighting, crop, corner), faces) in enumerate(zip(session.places, tasks, selected, strict=True)):
        if k in found.strays:
            faces = {}
        elif sighting is None:
            mask = mask_of(reference, corner, normals)
            faces = _trusted(faces, crop, mask, sigma_m)
            left_out += _displaced(place.position, faces, crop, mask, sigma_m)
        if not faces:
            reason = found.strays.get(k, "no target where the other places put it")
            left_out.append(LeftOut(place.position, reason))
        missing = [j for j in range(3) if faces and j not in faces]
        left_out += [LeftOut(f"{place.position}, face {j + 1}", "too few returns") for j in missing]
        places.append(CornerPlaceFaces(place.position, place.corner_world, faces, crop.frames))
    return places, left_out


def _trusted(faces: dict[int, FaceReturns], crop: PlaceCrop, mask: FaceMask, sigma_m: float) -> dict[int, FaceReturns]:
    """At a place where no whole corner was seen: only faces on which most beams end where they should."""
    _, face = mask.select(crop.directions, crop.range_m, 0.5)
    kept = {
        j: f for j, f in faces.items() if len(f) > 0.6 * np.count_nonzero(face == j) and len(f) >= 3 * MIN_FACE_RETURNS
    }
    return kept if len(kept) >= 2 else {}


def _displaced(
    position: str, faces: Mapping[int, FaceReturns], crop: PlaceCrop, mask: FaceMask, sigma_m: float
) -> list[LeftOut]:
    """Faces of a place where no whole corner was seen whose beams end together, but not where the other places put
    the face: where two faces fit, nothing else says that its coordinates are wrong."""
    index, face = mask.select(crop.directions, crop.range_m, NEAR_RADIUS_M)
    found = []
    for j in (j for j in range(3) if faces and j not in faces):
        mine = index[face == j]
        if len(mine) < 3 * MIN_FACE_RETURNS:
            continue
        along = mask.normals[j] @ crop.rays.take(mine, axis=1)
        off = crop.range_m[mine] * along - mask.normals[j] @ mask.corner
        middle = median(off)
        together = np.mean(np.abs(off - middle) < 3.0 * sigma_m)
        if abs(middle) > 2.0 * sigma_m and together > SEEN_TOGETHER:
            off_mm = 1e3 * abs(middle)
            found.append(
                LeftOut(
                    f"face {j + 1} at {position}",
                    f"its returns lie {off_mm:.0f} mm from where the other places put it: that place's coordinates may "
                    "be off, or something else is seen there",
                )
            )
    return found
