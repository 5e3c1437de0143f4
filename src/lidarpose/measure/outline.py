"""Round outlines: which flat patches end in a circle, and roughly where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.circles import Circle2, fit_circle2
from lidarpose.geometry.planes import Plane

Kind = Literal["disk", "hole"]

LEAST_GAP = 9
"""Gaps in a patch of fewer beams than this are no holes."""
_SECTORS = 36
_LEAST_COVERED = 0.3


@dataclass(frozen=True, eq=False)
class RoundOutline:
    """A circle that the border of a patch follows.

    Attributes
    ----------
    kind
        "disk" if the material is inside.
    circle
        In the plane's axes, metres, through the outermost points on the material.
    covered
        Share of the circle that border beams lie on.
    """

    kind: Kind
    circle: Circle2
    covered: float


def without_pinholes(mask: BoolArray) -> BoolArray:
    """A mask with gaps of fewer than `LEAST_GAP` beams filled: lost returns and outliers."""
    labels, count = ndimage.label(~mask)
    small = np.bincount(labels.ravel(), minlength=count + 1) < LEAST_GAP
    small[0] = False
    return np.asarray(mask | small[labels])


def border(mask: BoolArray) -> BoolArray:
    """Beams of a mask with a neighbour (of four) outside it; the grid's own border does not count."""
    inner = ndimage.binary_erosion(mask, border_value=1)
    return np.asarray(mask & ~inner)


def rim(cavity: BoolArray, mask: BoolArray, place: FloatArray, step: float) -> FloatArray:
    """Points (n, 2) half-way between the last beam on a patch and the first in a gap of it.

    Neighbours much farther apart than `step` (rings of a LiDAR that lie far from each other) bracket the rim too widely
    to be of use.
    """
    points = []
    for axis in (0, 1):
        first = (slice(None, -1), slice(None)) if axis == 0 else (slice(None), slice(None, -1))
        second = (slice(1, None), slice(None)) if axis == 0 else (slice(None), slice(1, None))
        crosses = (cavity[first] & mask[second]) | (mask[first] & cavity[second])
        near = np.linalg.norm(place[first] - place[second], axis=-1) < 2.0 * step
        points.append(0.5 * (place[first] + place[second])[crosses & near])
    return np.concatenate(points)


def grid_step(place: FloatArray, mask: BoolArray) -> float:
    """The larger of the median distances between neighbours of a grid (N, M, 2) along its two axes, on a mask."""
    steps = []
    for axis in (0, 1):
        both = mask[1:] & mask[:-1] if axis == 0 else mask[:, 1:] & mask[:, :-1]
        length = np.linalg.norm(np.diff(place, axis=axis), axis=-1)[both]
        if length.size:
            steps.append(float(np.median(length)))
    return max(steps, default=0.0)


def in_plane(points: FloatArray, plane: Plane, frame: FloatArray) -> FloatArray:
    """Coordinates (..., 2) along the frame's axes (rows 1 and 2 of `frame`, origin in row 0)."""
    return np.asarray((points - frame[0]) @ frame[1:].T)


def find_circle(edge: FloatArray, tolerance: float, *, smallest: float, largest: float, seed: int) -> Circle2 | None:
    """The circle that most border points (n, 2) lie near: RANSAC from triples, then refits."""
    if len(edge) < 8:
        return None
    rng = np.random.default_rng(seed)
    triples = edge[rng.integers(0, len(edge), (600, 3))]
    centres, radii = _through_three(triples)
    ok = np.isfinite(radii) & (radii > smallest) & (radii < largest)
    if not ok.any():
        return None
    centres, radii = centres[ok], radii[ok]
    sample = edge if len(edge) <= 600 else edge[rng.choice(len(edge), 600, replace=False)]
    near = np.abs(np.linalg.norm(sample[None] - centres[:, None], axis=-1) - radii[:, None]) < tolerance
    best = int(np.argmax(near.sum(axis=1)))
    circle = Circle2(centres[best], float(radii[best]))
    for _ in range(5):
        inliers = np.abs(circle.distance(edge)) < tolerance
        if np.count_nonzero(inliers) < 7:
            return None
        try:
            circle = fit_circle2(edge[inliers])
        except ValueError:
            return None
    return circle


def _through_three(triples: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Circles through triples (k, 3, 2): centres (k, 2) and radii (k,), not finite where the points are on a line."""
    a, b, c = triples[:, 0], triples[:, 1], triples[:, 2]
    u, v = b - a, c - a
    twice_area = 2.0 * (u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0])
    uu, vv = (u**2).sum(axis=1), (v**2).sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (v[:, 1] * uu - u[:, 1] * vv) / twice_area
        y = (u[:, 0] * vv - v[:, 0] * uu) / twice_area
    centres = np.stack([x, y], -1)
    return centres + a, np.asarray(np.linalg.norm(centres, axis=1))


def judge(
    circle: Circle2,
    edge: FloatArray,
    place: FloatArray,
    on: BoolArray,
    beyond: BoolArray,
    none: BoolArray,
    step: float,
) -> RoundOutline | None:
    """What a circle bounds, or None if it is no outline of material.

    Parameters
    ----------
    edge : (n, 2)
        Border points.
    place : (k, 2)
        Where all beams of the box meet the plane.
    on, beyond, none : (k,)
        Beams that end on the plane, beams that pass it (a longer range or no return), beams without return.
    """
    s = circle.distance(place)
    inner, outer = (s < -1.5 * step) & (s > -0.9 * circle.radius - 1.5 * step), (s > 1.5 * step) & (s < 5.0 * step)
    if np.count_nonzero(inner) < 6 or np.count_nonzero(outer) < 6:
        return None
    near = edge[np.abs(circle.distance(edge)) < 1.2 * step] - circle.centre
    sectors = min(_SECTORS, max(8, len(near)))
    covered = len(np.unique(_sector(near, sectors))) / sectors
    if covered < _LEAST_COVERED:
        return None
    # What stands before a disk may hide some of it; nothing may be seen through it.
    seen = on | (beyond & ~none)
    solid = on[inner].mean() > 0.4 and on[inner & seen].mean() > 0.9
    if solid and on[outer].mean() < 0.5 and beyond[outer].mean() > 0.3:
        return RoundOutline("disk", circle, covered)
    if on[outer].mean() > 0.6 and on[inner].mean() < 0.1 and beyond[inner].mean() > 0.8:
        return RoundOutline("hole", circle, covered)
    return None


def _sector(offset: FloatArray, sectors: int) -> IntArray:
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    return np.asarray(np.floor((angle / (2.0 * np.pi) + 0.5) * sectors).astype(np.int64) % sectors)


def nothing_round(kind: Kind) -> UndeterminedError:
    """The error for a recording without a round outline."""
    what = {"disk": "No flat patch with a round outline was found", "hole": "No round hole in a plane was found"}[kind]
    return UndeterminedError(
        what,
        remedy="The disk (or hole) must be crossed by at least eight sweeps with eight beams each, with at least a "
        "third of its outline free; record it nearer or with finer steps.",
    )
