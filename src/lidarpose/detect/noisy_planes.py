"""Planes of clouds whose ranges are noisy beside the size of what is looked for, told by the beams they end.

Where ranges are good to centimetres, the spread across a surface follows from how it is seen: a floor looked at along
spreads by millimetres, a face that is looked at squarely by the whole noise. One slab of one width for all, as
`cloud_planes` has it, then misses the faces. Here each return is judged along its own beam. A plane `q . x = 1` ends
the beam of unit direction u at the range `1 / (q . u)`: inverse ranges are linear in q, the directions hold no noise,
and so a plane through few and noisy neighbours is unbiased and says how far its own normal may be off.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.cloud_planes import largest_component
from lidarpose.detect.plane_raster import cell_size_m, grown, raster_of
from lidarpose.detect.plane_sample import Bits, bits, shared_points
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.robust import mad_sigma, quantile
from lidarpose.model.plane_patch import PlanePatch

SAMPLE_SIZE = 5000
SEEDS = 900
ROUNDS = 3
MOST_PLANES = 40
NEAREST_M = 1e-3
# Neighbours of a seed, and how far they may be: wide enough for a normal in noise, and no wider than a face.
NEIGHBOURS = 40
REACHES_M = (0.10, 0.20, 0.20)
FEWEST_NEIGHBOURS = 6
# A neighbourhood's own normal may be off by this, a patch's by a third of what the faces' match allows.
HYPOTHESIS_RAD = np.radians(20.0)
PATCH_RAD = np.radians(3.0)
GATE_SIGMAS = 2.5
# Of the returns within twice the gate on a patch's area, the share that lies within the gate: 0.99 on a plane.
STANDS_OUT = 0.6
# How much wider than the noise a patch may spread.
WIDEST = 1.6
# Cosine of incidence below which a surface counts as seen edge-on.
EDGE_ON = 0.06
# A surface is rough, and rings are off, by so much even where ranges are perfect.
FLOOR_M = 0.002
RIVALS, REFITS = 8, 3
# Distances of so many planes fit into a core's own memory.
PLANES_AT_ONCE = 16
# A sample that showed so many slabs and no surface since the last one has none to show.
MOST_FAILURES = 20


@dataclass(frozen=True, eq=False)
class _Beams:
    """Points (N, 3) by their unit directions (N, 3), ranges (N,) and inverse ranges (N,)."""

    points: FloatArray
    rays: FloatArray
    range_m: FloatArray
    inverse: FloatArray

    @staticmethod
    def of(points: NDArray[np.floating]) -> _Beams:
        x = np.asarray(points, dtype=np.float64)
        range_m = np.maximum(np.sqrt(np.einsum("ij,ij->i", x, x)), NEAREST_M)
        return _Beams(x, x / range_m[:, None], range_m, 1.0 / range_m)

    def take(self, index: IntArray) -> _Beams:
        return _Beams(self.points[index], self.rays[index], self.range_m[index], self.inverse[index])

    def off_m(self, q: FloatArray) -> FloatArray:
        """How far (N,) the returns lie behind a plane q (3,), along their beams."""
        return np.asarray((self.rays @ q - self.inverse) * self.range_m**2)

    def met(self, q: FloatArray, gate_m: float) -> BoolArray:
        """Which returns (N,) end on a plane, within the gate, and see it from not too far aside."""
        return np.asarray((np.abs(self.off_m(q)) < gate_m) & (self.rays @ q > EDGE_ON * np.linalg.norm(q)))


def segment_noisy_planes(
    points: NDArray[np.floating], *, range_sigma_m: float | None = None, min_points: int = 15, seed: int = 0
) -> tuple[PlanePatch, ...]:
    """Find the flat patches of a noisy cloud.

    Parameters
    ----------
    points : (N, 3)
        Metres, finite; of one frame or of several, with the sensor at the frame's origin.
    range_sigma_m
        The noise of one range, if it is stated; it counts where neighbouring returns do not spread more.
    min_points
        Patches of fewer points are not reported.

    Returns
    -------
    The patches, in the order found. No point belongs to two. Each determines its own normal to `PATCH_RAD`.
    """
    rng = np.random.default_rng(seed)
    beams = _Beams.of(points)
    # Beams without return stand at the origin in some drivers' clouds.
    index = np.flatnonzero(beams.range_m > NEAREST_M)
    beams = beams.take(index)
    patches: list[PlanePatch] = []
    sigma_m = range_sigma_m
    for k in range(ROUNDS):
        if len(index) < max(min_points, FEWEST_NEIGHBOURS) or len(patches) >= MOST_PLANES:
            break
        drawn = np.arange(len(index))
        if len(index) > SAMPLE_SIZE:
            drawn = np.sort(rng.choice(len(index), SAMPLE_SIZE, replace=False))
        sample = beams.take(drawn)
        planes, spread_m = _hypotheses(sample, sigma_m, rng)
        if k == 0:
            sigma_m = max(range_sigma_m or 0.0, spread_m, FLOOR_M)
        assert sigma_m is not None
        free = np.ones(len(index), dtype=bool)
        found = _harvest(beams, free, drawn, sample, planes, sigma_m, min_points, MOST_PLANES - len(patches))
        if not found and len(drawn) == len(index):
            break
        patches += [replace(patch, indices=index[patch.indices]) for patch in found]
        left = np.flatnonzero(free)
        beams, index = beams.take(left), index[left]
    return tuple(patches)


def _hypotheses(sample: _Beams, sigma_m: float | None, rng: np.random.Generator) -> tuple[FloatArray, float]:
    """Planes q (H, 3) through the neighbours of random points, as far as they have a normal; and the noise of one
    range by the flattest of these neighbourhoods."""
    # Of a quarter of the points, neighbours reach beyond the few beams that return in all frames alike.
    thinned = np.flatnonzero(rng.random(len(sample.points)) < 0.25)
    everyone = np.arange(len(sample.points))
    parts = [everyone, everyone, thinned if len(thinned) >= NEIGHBOURS else everyone]
    drawn = [
        _neighbours(sample, part, rng.integers(0, len(part), SEEDS // 3), reach)
        for part, reach in zip(parts, REACHES_M, strict=True)
    ]
    near, weight, seeds = (np.concatenate(group) for group in zip(*drawn, strict=True))
    rays, inverse, squared = sample.rays[near], sample.inverse[near], sample.range_m[seeds] ** 2
    information = np.einsum("hki,hk,hkj->hij", rays, weight, rays)
    right = np.einsum("hki,hk,hk->hi", rays, weight, inverse)
    scale = np.trace(information, axis1=1, axis2=2)
    inverted = np.linalg.inv(information + (1e-9 * scale[:, None, None] + 1e-12) * np.eye(3))
    q = np.einsum("hij,hj->hi", inverted, right)
    off = (np.einsum("hki,hi->hk", rays, q) - inverse) * squared[:, None]
    spread = np.sqrt((weight * off**2).sum(axis=1) / np.maximum(weight.sum(axis=1) - 3.0, 1.0))
    noise_m = quantile(spread, 0.25) if len(spread) else FLOOR_M
    sigma_m = max(sigma_m or 0.0, noise_m, FLOOR_M)
    tilt = _tilt_rad(inverted, q, sigma_m / squared)
    facing = np.einsum("hi,hi->h", sample.rays[seeds], q) > EDGE_ON * np.linalg.norm(q, axis=1)
    return q[(tilt < HYPOTHESIS_RAD) & facing & (spread < 2.0 * sigma_m)], noise_m


def _neighbours(
    sample: _Beams, part: IntArray, seeds: IntArray, reach_m: float
) -> tuple[IntArray, FloatArray, IntArray]:
    """Of seeds among part (S,) of a sample that have enough: their neighbours there (H, K), which of them are near
    enough, as weights (H, K), and the seeds (H,), all by their places in the sample."""
    from scipy.spatial import cKDTree

    count = min(NEIGHBOURS, len(part))
    points = sample.points[part]
    found = cKDTree(points).query(points[seeds], k=count)
    distance, near = np.asarray(found[0]), np.asarray(found[1])
    # Scan lines may be farther apart than that: as far as the cloud is sparse there.
    weight = (distance < np.maximum(reach_m, distance[:, min(9, count - 1)])[:, None]).astype(np.float64)
    enough = np.count_nonzero(weight, axis=1) >= FEWEST_NEIGHBOURS
    return part[near[enough]], weight[enough], part[seeds[enough]]


def _tilt_rad(inverted: FloatArray, q: FloatArray, sigma: FloatArray | float) -> FloatArray:
    """How far the normals of planes q (H, 3) may be off (1 sigma, the larger way), from the inverses of their normal
    equations (H, 3, 3) and the noise (H,) of inverse ranges."""
    length = np.linalg.norm(q, axis=1)
    across = np.eye(3) - np.einsum("hi,hj->hij", q, q) / np.maximum(length, 1e-12)[:, None, None] ** 2
    largest = np.linalg.eigvalsh(across @ inverted @ across)[:, -1]
    return np.asarray(sigma * np.sqrt(np.maximum(largest, 0.0)) / np.maximum(length, 1e-12))


def _harvest(
    beams: _Beams,
    free: BoolArray,
    drawn: IntArray,
    sample: _Beams,
    planes: FloatArray,
    sigma_m: float,
    min_points: int,
    at_most: int,
) -> list[PlanePatch]:
    """The patches that one sample shows, best first; their points are no longer `free`."""
    near = _near(sample, planes, GATE_SIGMAS * sigma_m)
    active = np.ones(len(drawn), dtype=bool)
    dead = np.zeros(len(planes), dtype=bool)
    share = max(np.count_nonzero(free) / len(drawn), 1.0)
    least = max(min_points / share, 8.0)
    single = sample.points.astype(np.float32)
    patches: list[PlanePatch] = []
    failures = 0
    while len(patches) < at_most and failures < MOST_FAILURES and not dead.all():
        votes = np.where(dead, -1, shared_points(near, active))
        leaders = np.argsort(-votes, kind="stable")[: 4 * RIVALS : 4]
        best, size, leader = None, 0, int(leaders[0])
        for k in leaders:
            if votes[k] <= max(size, least):
                break
            flags = np.unpackbits(near[k].view(np.uint8), count=len(active)).view(bool)
            piece = largest_component(single, flags & active, _plane(planes[k]))
            if np.count_nonzero(piece) > size:
                best, size, leader = piece, int(np.count_nonzero(piece)), int(k)
        if best is None:
            break
        patch = _refitted(beams, free, sample, active, best, sigma_m)
        if patch is None or len(patch) < min_points or size < least:
            failures += 1
            dead[leader] = True
            dead |= shared_points(near, best) > 0.8 * size
            continue
        failures = 0
        patches.append(patch)
        free[patch.indices] = False
        active &= free[drawn]
        dead |= shared_points(near, active) < least
    return patches


def _near(sample: _Beams, planes: FloatArray, gate_m: float) -> Bits:
    """Which returns (N,) end on which planes q (H, 3), in bits (H, W)."""
    columns = np.ascontiguousarray((sample.rays * (sample.range_m**2)[:, None]).T, dtype=np.float32)
    range_m, inverse = sample.range_m.astype(np.float32), sample.inverse.astype(np.float32)
    rows, edge_on = planes.astype(np.float32), (EDGE_ON * np.linalg.norm(planes, axis=1)).astype(np.float32)
    near = []
    for first in range(0, len(planes), PLANES_AT_ONCE):
        some = slice(first, first + PLANES_AT_ONCE)
        # A return that ends on a plane has the inverse range that the plane gives it.
        near.append(bits((np.abs(rows[some] @ columns - range_m) < gate_m) & (inverse > edge_on[some, None])))
    return np.concatenate(near) if near else np.empty((0, 0), dtype=np.uint64)


def _plane(q: FloatArray) -> Plane:
    length = float(np.linalg.norm(q))
    return Plane(-q / length, -1.0 / length)


def _fit(beams: _Beams, sigma_m: float) -> tuple[FloatArray, float]:
    """The plane q (3,) through all returns, by their noise along the beams, and how far its normal may be off."""
    weight = beams.range_m**4
    information = (beams.rays * weight[:, None]).T @ beams.rays
    inverted = np.linalg.pinv(information, rcond=1e-13, hermitian=True)
    q = inverted @ (beams.rays.T @ (weight * beams.inverse))
    return q, float(_tilt_rad(inverted[None], q[None], sigma_m)[0])


def _refitted(
    beams: _Beams, free: BoolArray, sample: _Beams, active: BoolArray, piece: BoolArray, sigma_m: float
) -> PlanePatch | None:
    """The patch about a piece of the sample, of all free points; None where it is no surface of its own."""
    single, gate_m = sample.points.astype(np.float32), GATE_SIGMAS * sigma_m
    for _ in range(REFITS):
        if np.count_nonzero(piece) < FEWEST_NEIGHBOURS:
            return None
        q, _ = _fit(sample.take(np.flatnonzero(piece)), sigma_m)
        before, piece = piece, largest_component(single, sample.met(q, gate_m) & active, _plane(q))
        if np.array_equal(before, piece):
            break
    seen = sample.points[piece]
    if len(seen) < FEWEST_NEIGHBOURS:
        return None
    raster, cells = raster_of(seen, _plane(q), cell_size_m(seen), 1)
    occupied = np.zeros(raster.shape[0] * raster.shape[1] + 1, dtype=bool)
    occupied[cells] = True
    allowed = np.append(grown(occupied[:-1].reshape(raster.shape)).ravel(), False)
    around = np.flatnonzero(beams.met(q, 3.0 * gate_m) & free)
    around = around[allowed[raster.cells(beams.points[around])]]
    local = beams.take(around)
    for _ in range(REFITS):
        inside = local.met(q, gate_m)
        if np.count_nonzero(inside) < FEWEST_NEIGHBOURS:
            return None
        chosen = local.take(np.flatnonzero(inside))
        q, tilt_rad = _fit(chosen, sigma_m)
    inside = local.met(q, gate_m)
    count = np.count_nonzero(inside)
    if count < max(STANDS_OUT * np.count_nonzero(local.met(q, 2.0 * gate_m)), FEWEST_NEIGHBOURS):
        return None
    plane = _plane(q)
    spread_m = mad_sigma(local.off_m(q)[inside], centred=True)
    if tilt_rad > PATCH_RAD or spread_m > WIDEST * sigma_m:
        return None
    height = local.points[inside] @ plane.normal - plane.offset
    return PlanePatch(plane, around[inside], max(float(np.sqrt(np.mean(height**2))), FLOOR_M))
