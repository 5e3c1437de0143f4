"""Subsamples of a cloud with the planes that neighbouring points suggest, and the votes for them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.patch_evidence import (
    GATE_SIGMAS,
    KERNELS,
    MIN_SIGMA_M,
    Float32Array,
    has_normal,
    local_planes_of,
    mostly_agree,
    nearest_points,
)
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import quantile

Bits = NDArray[np.uint64]

SAMPLE_SIZE = 4096
# Distances of so many planes are looked at together as fit into a core's own memory.
DISTANCES_AT_ONCE = 65_536
# Neighbours of fewer seeds are found sooner than a thread is started.
MANY_HYPOTHESES = 400
# So many hypotheses' neighbourhoods tell whether a patch is a surface.
ENOUGH_SEEDS = 12
# Neighbourhoods of a hypothesis, in nearest points of the subsample and of a quarter of it: wide ones reach
# across the gaps between the lines of a multi-beam LiDAR, narrow ones fit on small faces.
NEIGHBOURHOODS = (10, 20)
THINNED = 4
POINTS_PER_HYPOTHESIS = 10
# Sine of the angle below which a surface counts as seen edge-on.
EDGE_ON = 0.06


@dataclass(frozen=True, eq=False)
class PlaneSample:
    """A subsample with its hypotheses: planes (H, 4) as normal and offset, and who of S is near which, in bits (H, W).

    For a dense cloud also what the neighbourhoods of all hypotheses say of the surfaces that they lie on.
    """

    indices: IntArray
    points: Float32Array
    planes: FloatArray
    near: Bits
    sigma_m: float
    seeds: _Seeds | None = None


@dataclass(frozen=True, eq=False)
class _Seeds:
    """Points (H, 3) and the normals (H, 3) that their neighbours give, where they give one."""

    points: Float32Array
    normals: FloatArray

    def agree(self, on_patch: BoolArray, normal: FloatArray) -> bool | None:
        """Whether the normals on a patch are mostly its own; None where too few know."""
        if np.count_nonzero(on_patch) < ENOUGH_SEEDS:
            return None
        return mostly_agree(self.normals[on_patch], normal)


def one_of_each(count: int, parts: int, rng: np.random.Generator) -> IntArray:
    """One number at random out of each of `parts` like stretches of [0, count): as even as the cloud's own order."""
    if count <= parts:
        return np.arange(count)
    return np.asarray(((np.arange(parts) + rng.random(parts)) * (count / parts)).astype(np.int64))


def draw_sample(
    x: Float32Array,
    remaining: IntArray,
    sigma_m: float | None,
    hypotheses: int,
    rng: np.random.Generator,
    *,
    from_sensor: bool,
) -> PlaneSample:
    """Draw a subsample of the remaining points, and hypotheses around random points of it."""
    if len(remaining) > SAMPLE_SIZE:
        drawn = np.zeros(len(remaining), dtype=bool)
        drawn[rng.integers(0, len(remaining), SAMPLE_SIZE)] = True
        indices = remaining[drawn]
    else:
        indices = remaining
    points = x[indices]
    count = min(hypotheses, 4 * len(points))
    thinned = points[rng.random(len(points)) < 1.0 / THINNED]
    clouds = [points, thinned] if len(thinned) >= POINTS_PER_HYPOTHESIS else [points]
    draws = [_Neighbourhoods.drawn(cloud, count // 2, rng) for cloud in clouds]
    if count < MANY_HYPOTHESES:
        chosen = np.concatenate([draw.points() for draw in draws])
    else:
        with ThreadPoolExecutor(1) as pool:
            others = [pool.submit(draw.points) for draw in draws[1:]]
            chosen = np.concatenate([draws[0].points(), *(other.result() for other in others)])
    seeds = np.concatenate([draw.cloud[draw.seeds] for draw in draws])
    planes, variances = local_planes_of(chosen)
    flat = variances[:, 1] > 0.01 * variances[:, 2]
    if from_sensor:
        flat &= np.abs(planes[:, 3]) > EDGE_ON * np.linalg.norm(chosen.mean(axis=1), axis=1)
    thickness = np.sqrt(variances[:, 0] * POINTS_PER_HYPOTHESIS / (POINTS_PER_HYPOTHESIS - 3.0))
    if sigma_m is None:
        sigma_m = _noise_from_neighbourhoods(thickness[flat])
    known = has_normal(variances, sigma_m)
    thin = flat & (thickness < 4.0 * sigma_m)
    near = _near(points, planes[thin], GATE_SIGMAS * sigma_m)
    return PlaneSample(indices, points, planes[thin], near, sigma_m, _Seeds(seeds[known], planes[known, :3]))


def _near(points: Float32Array, planes: FloatArray, gate_m: float) -> Bits:
    """Which points (S, 3) lie within the gate of which planes (H, 4), in bits (H, W)."""
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import near_bits

        return np.asarray(near_bits(points, planes, float(gate_m))).view(np.uint64)
    near = np.empty((len(planes), -(-len(points) // 64)), dtype=np.uint64)
    rows, columns = planes.astype(np.float32), np.ascontiguousarray(points.T)
    together = max(DISTANCES_AT_ONCE // max(len(points), 1), 1)
    for first in range(0, len(planes), together):
        some = rows[first : first + together]
        # Rounded as the kernels round it, which a library's product is not.
        distance = some[:, :1] * columns[0]
        distance += some[:, 1:2] * columns[1]
        distance += some[:, 2:3] * columns[2]
        distance -= some[:, 3:]
        np.abs(distance, out=distance)
        near[first : first + together] = bits(distance < np.float32(gate_m))
    return near


def bits(flags: BoolArray) -> Bits:
    """Flags (..., S) in words of 64 (..., W), the last filled up with zeros."""
    packed = np.packbits(flags, axis=-1)
    lacking = -packed.shape[-1] % 8
    if lacking:
        packed = np.concatenate([packed, np.zeros((*packed.shape[:-1], lacking), dtype=np.uint8)], axis=-1)
    return packed.view(np.uint64)


def shared_points(near: Bits, flags: BoolArray) -> IntArray:
    """How many (H,) of the flagged points (S,) are near each plane."""
    both = near & bits(flags)
    if hasattr(np, "bitwise_count"):
        return np.asarray(np.bitwise_count(both).sum(axis=1, dtype=np.int64))
    return np.asarray(_BITS_OF_BYTE[both.view(np.uint8)].sum(axis=1, dtype=np.int64))  # NumPy 1


_BITS_OF_BYTE = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1).sum(axis=1, dtype=np.uint8)


@dataclass(frozen=True, eq=False)
class _Neighbourhoods:
    """Random points `seeds` (H,) of a cloud (S, 3), and `shares` (H, K) of their nearest points, the nearest 0."""

    cloud: Float32Array
    seeds: IntArray
    shares: FloatArray

    @staticmethod
    def drawn(cloud: Float32Array, count: int, rng: np.random.Generator) -> _Neighbourhoods:
        return _Neighbourhoods(cloud, rng.integers(0, len(cloud), count), rng.random((count, POINTS_PER_HYPOTHESIS)))

    def points(self) -> Float32Array:
        """(H, K, 3), by turns from more and from fewer of the nearest."""
        widest = min(NEIGHBOURHOODS[-1], len(self.cloud))
        neighbours = nearest_points(self.cloud, self.cloud[self.seeds], widest)
        reach = np.minimum(np.array(NEIGHBOURHOODS)[np.arange(len(self.seeds)) % len(NEIGHBOURHOODS)], widest)
        picks = (self.shares * reach[:, None]).astype(np.int64)
        return np.asarray(self.cloud[np.take_along_axis(neighbours, picks, axis=1)])


def _noise_from_neighbourhoods(thickness: FloatArray) -> float:
    """The noise across flat neighbourhoods: of all, the thinnest fifth is flat almost surely."""
    if len(thickness) == 0:
        return MIN_SIGMA_M
    return max(quantile(thickness, 0.2), MIN_SIGMA_M)
