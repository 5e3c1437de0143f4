"""Which corners are the target's: the same three orientations everywhere, moved as the world's coordinates say.

A scene is full of corners. The target's are those whose faces keep their orientation from place to place and whose
distances from one another are those of the measured world coordinates; what stands still is no target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.solve.corner_alignment import svd_pose

# Faces found in one frame of a sparse LiDAR are tilted by up to a few degrees.
SAME_ORIENTATION_RAD = np.radians(8.0)
# Corners found in one frame are right to centimetres at worst.
TOLERANCE_M = 0.06
# Corners that stay within this while the world's coordinates move by more than `MOVED_M` belong to the background.
STILL_M = 0.05
MOVED_M = 0.15
MAX_SEEDS = 4000
# A target turned by more than this is not known again.
MAX_TURN_RAD = np.radians(44.0)
STRAY_SUPPORT = 40

_ORDERS = np.array(list(permutations(range(3))))


@dataclass(frozen=True, eq=False)
class CornerMatch:
    """One corner for each place (None where none fits), the pose that they give, and its RMS residual.

    `orders` tells for each place which of the corner's faces is the match's face 0, 1 and 2.
    """

    choice: tuple[int | None, ...]
    orders: tuple[tuple[int, int, int], ...]
    T_world_lidar: Pose
    rms_m: float

    @property
    def places(self) -> int:
        """How many places have a corner."""
        return sum(c is not None for c in self.choice)


@dataclass(eq=False)
class _Nodes:
    """All places' candidates in one list."""

    place: IntArray
    index: IntArray
    corner: FloatArray
    normals: FloatArray
    convex: BoolArray
    support: IntArray


def face_order(normals: FloatArray, reference: FloatArray) -> tuple[tuple[int, int, int], float]:
    """The order of faces (3, 3) that suits the reference's best, and the largest angle left, in radians."""
    worst = np.array([np.min(np.einsum("ij,ij->i", normals[order], reference)) for order in _ORDERS])
    best = int(np.argmax(worst))
    a, b, c = (int(k) for k in _ORDERS[best])
    return (a, b, c), float(np.arccos(np.clip(worst[best], -1.0, 1.0)))


def match_corners(
    candidates: Sequence[Sequence[CornerCandidate]], world: FloatArray, *, tolerance_m: float = TOLERANCE_M
) -> tuple[CornerMatch, ...]:
    """All ways to choose a corner at three or more places that fit the world's coordinates; the best first.

    Parameters
    ----------
    candidates
        By place: its corners.
    world : (P, 3)
        The measured corners.

    Returns
    -------
    Matches ordered by how many places have a corner, then by residual; each set of choices once.
    """
    nodes = _collect(candidates)
    if len(nodes.place) < 3:
        return ()
    moving = _moving(nodes, world)
    agree = _agreement(nodes, world, moving, tolerance_m)
    found: dict[tuple[int | None, ...], CornerMatch] = {}
    for seed in _seeds(nodes, agree, world):
        match = _extend(nodes, seed, world, moving, tolerance_m)
        if match is not None:
            kept = found.get(match.choice)
            if kept is None or match.rms_m < kept.rms_m:
                found[match.choice] = match
    return tuple(sorted(found.values(), key=lambda m: (-m.places, m.rms_m)))


def match_of(corners: Sequence[CornerCandidate], world: FloatArray) -> CornerMatch | None:
    """The match of one corner a place, faces in the same order at all; None if they do not fit the world."""
    points = np.stack([c.corner for c in corners])
    T = svd_pose(world, points)
    error = np.linalg.norm(T @ points - world, axis=1)
    turned = np.einsum("pij,ij->pi", np.stack([c.normals for c in corners]), corners[0].normals)
    if error.max() > TOLERANCE_M or turned.min() < np.cos(SAME_ORIENTATION_RAD):
        return None
    rms = float(np.sqrt((error**2).mean()))
    return CornerMatch(tuple(0 for _ in corners), tuple((0, 1, 2) for _ in corners), T, rms)


@dataclass(frozen=True, eq=False)
class Stray:
    """A corner at a place where none fits that is nearly the target's: what keeps it from fitting.

    Attributes
    ----------
    corner_world : (3,)
        Where it stands by the other places' pose.
    off : (3,)
        That, minus the place's world coordinates.
    turned_rad
        How far its faces are turned against the target's.
    bent_rad
        How far the angles between its faces are from those between the target's.
    """

    corner_world: FloatArray
    off: FloatArray
    turned_rad: float
    bent_rad: float


def nearest_strays(
    candidates: Sequence[Sequence[CornerCandidate]], match: CornerMatch, world: FloatArray
) -> dict[int, Stray]:
    """For places without a corner in a match: the corner there that is the target moved, or else the target turned.

    A target that stands elsewhere keeps its orientation; a target that was turned stands where it should.
    """
    nodes = _collect(candidates)
    if len(nodes.place) == 0:
        return {}
    # Not the background; but the target itself may have been left where it was at another place.
    expected = match.T_world_lidar.inverse() @ world
    known = (np.linalg.norm(nodes.corner[:, None] - expected, axis=-1) < TOLERANCE_M).any(axis=1)
    # A face of few returns is tilted, and its corner off, by chance alone.
    eligible = (_moving(nodes, world) | known) & (nodes.support >= STRAY_SUPPORT)
    first = next(p for p, c in enumerate(match.choice) if c is not None)
    reference = candidates[first][match.choice[first] or 0]
    found: dict[int, Stray] = {}
    for place in (p for p, c in enumerate(match.choice) if c is None):
        here = np.flatnonzero((nodes.place == place) & eligible & (nodes.convex == reference.convex))
        strays = [_stray(match, nodes.corner[k], nodes.normals[k], reference.normals, world[place]) for k in here]
        elsewhere = [s for s in strays if s.turned_rad < SAME_ORIENTATION_RAD]
        turned = [s for s in strays if np.linalg.norm(s.off) < 2.0 * TOLERANCE_M and _is_turn(s)]
        if turned and not any(np.linalg.norm(s.off) < 2.0 * TOLERANCE_M for s in elsewhere):
            found[place] = min(turned, key=lambda s: s.turned_rad)
        elif elsewhere:
            found[place] = min(elsewhere, key=lambda s: float(np.linalg.norm(s.off)))
    return found


def _stray(
    match: CornerMatch, corner: FloatArray, normals: FloatArray, reference: FloatArray, world: FloatArray
) -> Stray:
    stands = np.asarray(match.T_world_lidar @ corner)
    order, turned_rad = face_order(normals, reference)
    between = [
        np.arccos(np.clip((n @ n.T)[np.triu_indices(3, 1)], -1.0, 1.0)) for n in (normals[list(order)], reference)
    ]
    return Stray(stands, stands - world, turned_rad, float(np.abs(between[0] - between[1]).max()))


def _is_turn(stray: Stray) -> bool:
    """Whether all its faces are turned alike: a badly seen face is tilted against the others."""
    return stray.turned_rad < MAX_TURN_RAD and stray.bent_rad < 0.3 * stray.turned_rad


def _collect(candidates: Sequence[Sequence[CornerCandidate]]) -> _Nodes:
    flat = [(p, k, c) for p, here in enumerate(candidates) for k, c in enumerate(here)]
    return _Nodes(
        np.array([p for p, _, _ in flat], dtype=np.int64),
        np.array([k for _, k, _ in flat], dtype=np.int64),
        np.array([c.corner for _, _, c in flat]).reshape(-1, 3),
        np.array([c.normals for _, _, c in flat]).reshape(-1, 3, 3),
        np.array([c.convex for _, _, c in flat], dtype=bool),
        np.array([c.support for _, _, c in flat], dtype=np.int64),
    )


def _same_orientation(nodes: _Nodes) -> BoolArray:
    """(N, N): same kind of corner, and faces that can be paired within the tolerance."""
    cosine = np.einsum("aik,bjk->abij", nodes.normals, nodes.normals)
    worst = np.stack([cosine[:, :, range(3), order].min(axis=-1) for order in _ORDERS]).max(axis=0)
    return np.asarray((worst > np.cos(SAME_ORIENTATION_RAD)) & (nodes.convex[:, None] == nodes.convex))


def _moving(nodes: _Nodes, world: FloatArray) -> BoolArray:
    """Which corners (N,) are not seen again, unmoved, where the target is elsewhere."""
    distance = np.linalg.norm(nodes.corner[:, None] - nodes.corner, axis=-1)
    moved = np.linalg.norm(world[nodes.place][:, None] - world[nodes.place], axis=-1) > MOVED_M
    return np.asarray(~((distance < STILL_M) & moved & _same_orientation(nodes)).any(axis=1))


def _agreement(nodes: _Nodes, world: FloatArray, moving: BoolArray, tolerance_m: float) -> BoolArray:
    """(N, N): of different places, same orientation, and as far apart as the world's coordinates."""
    distance = np.linalg.norm(nodes.corner[:, None] - nodes.corner, axis=-1)
    wanted = np.linalg.norm(world[nodes.place][:, None] - world[nodes.place], axis=-1)
    return np.asarray(
        (np.abs(distance - wanted) < tolerance_m)
        & (nodes.place[:, None] != nodes.place)
        & _same_orientation(nodes)
        & moving[:, None]
        & moving
    )


def _seeds(nodes: _Nodes, agree: BoolArray, world: FloatArray) -> list[tuple[int, int, int]]:
    """Triples of corners that agree pairwise, widest triangles first."""
    found: list[tuple[float, tuple[int, int, int]]] = []
    for a, b in zip(*np.nonzero(np.triu(agree)), strict=True):
        both = np.flatnonzero(agree[a] & agree[b])
        for c in both[both > b]:
            p, q, r = world[nodes.place[[a, b, c]]]
            area = float(np.linalg.norm(np.cross(q - p, r - p)))
            if area > 0.01:
                found.append((area, (int(a), int(b), int(c))))
        if len(found) > 20 * MAX_SEEDS:
            break
    found.sort(key=lambda item: -item[0])
    return [triple for _, triple in found[:MAX_SEEDS]]


def _extend(
    nodes: _Nodes, seed: tuple[int, int, int], world: FloatArray, moving: BoolArray, tolerance_m: float
) -> CornerMatch | None:
    """The pose of three corners, then the corner next to where it puts the target at each other place."""
    chosen = {int(nodes.place[k]): k for k in seed}
    for _ in range(2):
        members = list(chosen.values())
        T = svd_pose(world[nodes.place[members]], nodes.corner[members])
        expected = T.inverse() @ world
        error = np.linalg.norm(nodes.corner - expected[nodes.place], axis=1)
        error[~moving] = np.inf
        reference = nodes.normals[seed[0]]
        chosen = {}
        for k in np.argsort(error):
            if error[k] > tolerance_m:
                break
            place = int(nodes.place[k])
            if place in chosen or nodes.convex[k] != nodes.convex[seed[0]]:
                continue
            if face_order(nodes.normals[k], reference)[1] < SAME_ORIENTATION_RAD:
                chosen[place] = int(k)
        if len(chosen) < 3:
            return None
    members = list(chosen.values())
    T = svd_pose(world[nodes.place[members]], nodes.corner[members])
    residual = T @ nodes.corner[members] - world[nodes.place[members]]
    rms = float(np.sqrt((residual**2).sum(axis=1).mean()))
    orders = {p: face_order(nodes.normals[k], nodes.normals[seed[0]])[0] for p, k in chosen.items()}
    places = range(len(world))
    choice = tuple(int(nodes.index[chosen[p]]) if p in chosen else None for p in places)
    return CornerMatch(choice, tuple(orders.get(p, (0, 1, 2)) for p in places), T, rms)
