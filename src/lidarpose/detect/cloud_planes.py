"""Planes of a cloud: connected flat patches, the largest first, on clouds of any density and order.

Strategy. A random subsample of a few thousand points keeps the cloud's own density (a voxel grid would even it out and
lose small dense faces). Around random points of it, planes through near neighbours are the hypotheses; all are scored
against the subsample at once, in one matrix product. The best is optimised locally, cut to its largest connected
patch, and refitted there on the full cloud, never over the unbounded slab. Its points leave, the scores of the others
follow by one product more, and only when the subsample is used up another is drawn from what is left, so that small
faces come up once the large ones are gone.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.plane_claims import Slab, patches_of_slabs
from lidarpose.detect.plane_raster import (
    GAP_PER_RANGE,
    MIN_GAP_M,
    MOST_CELLS,
    PlaneRaster,
    cell_size_m,
    grown,
    mean_and_covariance,
    raster_of,
)
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, perpendicular_pair
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.robust import mad_sigma, quantile
from lidarpose.model.plane_patch import PlanePatch

Float32Array = NDArray[np.float32]
Bits = NDArray[np.uint64]

KERNELS = "detect.patch_kernels"
# By how much they search a cloud sooner: its subsamples, and all points where a cloud is searched whole.
SAVED_S = 1.5e-3
SAVED_S_PER_POINT = 7e-8
SAMPLE_SIZE = 4096
# Distances of so many planes are looked at together as fit into a core's own memory.
DISTANCES_AT_ONCE = 65_536
# From this many points on, patches are found and tested in a subsample, and the whole cloud is asked once.
DENSE = 200_000
DENSE_SAMPLE = 8192
DENSE_HYPOTHESES = 400
FEWEST_OF_SAMPLE = 30
# Neighbours of fewer seeds are found sooner than a thread is started.
MANY_HYPOTHESES = 400
# A whole refit is a kernel's in clouds of no more points: NumPy sorts more of them sooner.
SMALL = 8000
# So many distances are looked through by kernels sooner than a tree is built.
FEW_DISTANCES = 400_000
# So many voxels of the subsample tell whether a patch is a surface, and so many hypotheses' neighbourhoods.
ENOUGH_EVIDENCE = 1000
ENOUGH_SEEDS = 12
HYPOTHESES = 1000
# Neighbourhoods of a hypothesis, in nearest points of the subsample and of a quarter of it: wide ones reach
# across the gaps between the lines of a multi-beam LiDAR, narrow ones fit on small faces.
NEIGHBOURHOODS = (10, 20)
THINNED = 4
# Of the hypotheses with most votes, how many are compared by their largest connected patch, and how often the best is
# refitted on the subsample. In a dense cloud that is done on more points afterwards.
RIVALS = 4
REFITS = 3
DENSE_RIVALS = 2
DENSE_REFITS = 1
POINTS_PER_HYPOTHESIS = 10
# Of trees that are asked few times: wide leaves are built sooner.
LEAF_SIZE = 32
GATE_SIGMAS = 3.0
MIN_SIGMA_M = 2e-4
# A patch spreads more than its neighbourhoods say, by up to this factor; a wider slab would take in two surfaces.
WIDEST = 3.0
# Patches that spread by this factor more than neighbouring points are of bent surfaces: flat ones spread up to twice as
# much as the thinnest fifth of neighbourhoods, and none more than three times.
BENT = 2.3
# The share of the points found that patches of bent surfaces hold where those are wanted whole.
BENT_SHARE = 1.0 / 3.0
# Of the voxels within twice a patch's thickness, the share that lies within it; and its thickness over its width.
STANDS_OUT = 0.7
THIN = 0.15
EVIDENCE_POINTS = 60_000
# The second screening: neighbours that make a point's own normal, points asked, and how many have to agree how well.
SCREENING_NEIGHBOURS = 12
SCREENING_WIDTH = 1.5
LINED_UP = 0.15
SCREENED_POINTS = 200
SCREENING_RAD = np.radians(25.0)
SCREENED_SHARE = 0.55
ASKED_SHARE = 0.35
# Sine of the angle below which a surface counts as seen edge-on.
EDGE_ON = 0.06
# Of how many distances the spread is taken.
SPREAD_POINTS = 20_000
# What kernels need of these, by kind.
_GATES = np.array([GATE_SIGMAS, WIDEST, MIN_SIGMA_M, STANDS_OUT, THIN])
_LIMITS = np.array([SCREENING_WIDTH, LINED_UP, np.cos(SCREENING_RAD), ASKED_SHARE, SCREENED_SHARE])
_COUNTS = np.array([SCREENING_NEIGHBOURS, SCREENED_POINTS, EVIDENCE_POINTS, SPREAD_POINTS])


@dataclass(frozen=True)
class PlaneSearch:
    """What to look for.

    Attributes
    ----------
    max_planes, min_points, min_share
        The search ends early at `max_planes`; patches of fewer points, or of a smaller share of all, are not reported.
    from_sensor
        The origin is where the sensor stands. Then planes seen edge-on are no surfaces: each scan line of a multi-beam
        LiDAR lies in one.
    hypotheses
        Planes tried on each subsample.
    bent
        Surfaces that are not flat to the noise, as of most buildings and of clouds put together a little wrong, are
        wanted whole. Where many patches spread far more than neighbouring points do, the search begins again at their
        own scale. Without it they come in pieces, each as flat as neighbours are.
    """

    max_planes: int = 40
    min_points: int = 30
    min_share: float = 0.0
    max_rounds: int = 6
    from_sensor: bool = False
    seed: int = 0
    hypotheses: int = HYPOTHESES
    bent: bool = False


@dataclass(eq=False)
class _Sample:
    """A subsample with its hypotheses: planes (H, 4) as normal and offset, and who of S is near which, in bits (H, W).

    For a dense cloud also what the neighbourhoods of all hypotheses say of the surfaces that they lie on.
    """

    indices: IntArray
    points: Float32Array
    planes: FloatArray
    near: Bits
    sigma_m: float
    seeds: _Seeds | None = None
    rivals: int = RIVALS
    refits: int = REFITS


@dataclass(frozen=True, eq=False)
class _Seeds:
    """Points (H, 3) and the normals (H, 3) that their neighbours give, where they give one."""

    points: Float32Array
    normals: FloatArray

    def agree(self, on_patch: BoolArray, normal: FloatArray) -> bool | None:
        """Whether the normals on a patch are mostly its own; None where too few know."""
        if np.count_nonzero(on_patch) < ENOUGH_SEEDS:
            return None
        return _mostly_agree(self.normals[on_patch], normal)


def segment_planes(points: NDArray[np.floating], search: PlaneSearch | None = None) -> tuple[PlanePatch, ...]:
    """Find the connected flat patches of a cloud.

    Parameters
    ----------
    points : (N, 3)
        Metres, finite; the frame's origin is where the sensor stands (normals point there).
    search
        Limits of the search, and its seed.

    Returns
    -------
    The patches, in the order found (roughly by size). No point belongs to two.
    """
    search = search or PlaneSearch()
    x = np.asarray(points)
    rng = np.random.default_rng(search.seed)
    least = max(search.min_points, int(search.min_share * len(x)))
    free = np.ones(len(x), dtype=bool)
    patches: list[PlanePatch] = []
    sigma_m: float | None = None
    settled = not search.bent
    # What follows asks again, for nothing more.
    pays(SAVED_S + SAVED_S_PER_POINT * (len(x) if len(x) <= DENSE else 0), KERNELS)
    for _ in range(search.max_rounds):
        at_most = search.max_planes - len(patches)
        count = int(np.count_nonzero(free))
        if count < max(least, POINTS_PER_HYPOTHESIS) or at_most <= 0:
            break
        if count > DENSE:
            found, near_m = _harvest_dense(x, free, count, sigma_m, search, least, at_most, rng)
        else:
            x = np.ascontiguousarray(x, dtype=np.float32)
            sample = _draw(x, np.flatnonzero(free), sigma_m, search, rng)
            sample.seeds = None
            found, near_m = _harvest(x, free, sample, least, at_most), sample.sigma_m
        if not found:
            break
        if not settled and _mostly_bent(found, near_m):
            if len(x) > DENSE:
                return _bent_patches(x, search, least, rng)
            settled, sigma_m = True, WIDEST * near_m
            free[:] = True
            continue
        settled = True
        patches += found
        sigma_m = float(np.median([p.sigma_m for p in patches]))
    return tuple(patches)


def _harvest_dense(
    x: NDArray[np.floating],
    free: BoolArray,
    count: int,
    sigma_m: float | None,
    search: PlaneSearch,
    least: int,
    at_most: int,
    rng: np.random.Generator,
) -> tuple[list[PlanePatch], float]:
    """Patches of the `count` free points of a cloud so dense that a subsample shows them; the whole cloud is asked
    once for all of them. With them the spread of neighbouring points."""
    chosen = _one_of_each(count, DENSE_SAMPLE, rng)
    if count < len(x):
        chosen = np.flatnonzero(free)[chosen]
    few = x[chosen].astype(np.float32)
    share = count / len(few)
    fewest = max(int(least / share), FEWEST_OF_SAMPLE)
    jury = _one_of_each(len(few), SAMPLE_SIZE, rng)
    fewer = replace(search, hypotheses=min(search.hypotheses, DENSE_HYPOTHESES))
    sample = _draw(few, jury, sigma_m, fewer, rng)
    sample.rivals, sample.refits = DENSE_RIVALS, DENSE_REFITS
    seen = _harvest(few, np.ones(len(few), dtype=bool), sample, fewest, at_most)
    slabs = [Slab.around(few[p.indices], p.plane, p.sigma_m) for p in seen]
    if not slabs:
        return [], sample.sigma_m
    found = []
    among = None if count == len(x) else free
    claims = patches_of_slabs(x, among, slabs, WIDEST * sample.sigma_m)
    for before, claim in zip(seen, claims, strict=True):
        if claim is None or len(claim.patch) < least:
            continue
        patch = claim.patch
        if not _is_thin(np.append(0.0, claim.variances), patch.sigma_m):
            continue
        # Few voxels of the subsample say little of what a patch is: the cloud has more.
        if len(first_in_each(few[before.indices], GATE_SIGMAS * before.sigma_m)) < ENOUGH_EVIDENCE:
            local = x[claim.around()].astype(np.float32)
            if not _stands_out(local, patch.plane.normal, patch.plane.offset, patch.sigma_m):
                continue
        found.append(patch)
    if len(found) < at_most:
        for patch in found:
            free[patch.indices] = False
    return found, sample.sigma_m


def _bent_patches(
    x: NDArray[np.floating], search: PlaneSearch, least: int, rng: np.random.Generator
) -> tuple[PlanePatch, ...]:
    """Bent surfaces of a dense cloud: found in a part of its points, and then all their points.

    The planes stay as found: what is not flat to its noise has no optimum that a step from there leads to.
    """
    chosen = _one_of_each(len(x), DENSE // 2, rng)
    few = x[chosen].astype(np.float32)
    fewest = max(int(least * len(few) / len(x)), FEWEST_OF_SAMPLE)
    seen = segment_planes(few, replace(search, min_points=fewest, min_share=0.0))
    free = np.ones(len(x), dtype=bool)
    patches = []
    for found in seen:
        points = few[found.indices]
        raster, cells = raster_of(points, found.plane, cell_size_m(points), 1)
        occupied = np.zeros(raster.shape[0] * raster.shape[1] + 1, dtype=bool)
        occupied[cells] = True
        occupied[-1] = False
        height = x @ found.plane.normal.astype(x.dtype) - x.dtype.type(found.plane.offset)
        near = np.flatnonzero((np.abs(height) < GATE_SIGMAS * found.sigma_m) & free)
        mine = near[occupied[raster.cells(x[near])]]
        if len(mine) >= least:
            free[mine] = False
            patches.append(PlanePatch(found.plane, mine, found.sigma_m))
    return tuple(patches)


def _mostly_bent(patches: list[PlanePatch], near_m: float) -> bool:
    """Whether patches that spread far more than neighbouring points, which tell too little of it, hold a good share."""
    bent = sum(len(p) for p in patches if p.sigma_m > BENT * near_m)
    return bent > BENT_SHARE * sum(map(len, patches))


def _one_of_each(count: int, parts: int, rng: np.random.Generator) -> IntArray:
    """One number at random out of each of `parts` like stretches of [0, count): as even as the cloud's own order."""
    if count <= parts:
        return np.arange(count)
    return np.asarray(((np.arange(parts) + rng.random(parts)) * (count / parts)).astype(np.int64))


def _draw(
    x: Float32Array, remaining: IntArray, sigma_m: float | None, search: PlaneSearch, rng: np.random.Generator
) -> _Sample:
    """Draw a subsample of the remaining points, and hypotheses around random points of it."""
    if len(remaining) > SAMPLE_SIZE:
        drawn = np.zeros(len(remaining), dtype=bool)
        drawn[rng.integers(0, len(remaining), SAMPLE_SIZE)] = True
        indices = remaining[drawn]
    else:
        indices = remaining
    points = x[indices]
    count = min(search.hypotheses, 4 * len(points))
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
    planes, variances = _local_planes(chosen)
    flat = variances[:, 1] > 0.01 * variances[:, 2]
    if search.from_sensor:
        flat &= np.abs(planes[:, 3]) > EDGE_ON * np.linalg.norm(chosen.mean(axis=1), axis=1)
    thickness = np.sqrt(variances[:, 0] * POINTS_PER_HYPOTHESIS / (POINTS_PER_HYPOTHESIS - 3.0))
    if sigma_m is None:
        sigma_m = _noise_from_neighbourhoods(thickness[flat])
    known = _has_normal(variances, sigma_m)
    thin = flat & (thickness < 4.0 * sigma_m)
    near = _near(points, planes[thin], GATE_SIGMAS * sigma_m)
    return _Sample(indices, points, planes[thin], near, sigma_m, _Seeds(seeds[known], planes[known, :3]))


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
        distance = some[:, :3] @ columns
        distance -= some[:, 3:]
        np.abs(distance, out=distance)
        near[first : first + together] = _bits(distance < np.float32(gate_m))
    return near


def _bits(flags: BoolArray) -> Bits:
    """Flags (..., S) in words of 64 (..., W), the last filled up with zeros."""
    packed = np.packbits(flags, axis=-1)
    lacking = -packed.shape[-1] % 8
    if lacking:
        packed = np.concatenate([packed, np.zeros((*packed.shape[:-1], lacking), dtype=np.uint8)], axis=-1)
    return packed.view(np.uint64)


def _shared(near: Bits, flags: BoolArray) -> IntArray:
    """How many (H,) of the flagged points (S,) are near each plane."""
    both = near & _bits(flags)
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
        neighbours = self._nearest(widest)
        reach = np.minimum(np.array(NEIGHBOURHOODS)[np.arange(len(self.seeds)) % len(NEIGHBOURHOODS)], widest)
        picks = (self.shares * reach[:, None]).astype(np.int64)
        return np.asarray(self.cloud[np.take_along_axis(neighbours, picks, axis=1)])

    def _nearest(self, count: int) -> IntArray:
        """Positions (H, count) of the points nearest to each seed, the nearest first."""
        if len(self.seeds) * len(self.cloud) < FEW_DISTANCES and pays(0.0, KERNELS):
            from lidarpose.detect.patch_kernels import nearest

            return np.asarray(nearest(self.cloud, self.cloud[self.seeds], count))
        from scipy.spatial import cKDTree

        tree = cKDTree(self.cloud, LEAF_SIZE, compact_nodes=False, balanced_tree=False)
        return np.asarray(tree.query(self.cloud[self.seeds], k=count)[1])


def _local_planes(chosen: Float32Array) -> tuple[FloatArray, FloatArray]:
    """Planes (H, 4) through neighbourhoods (H, K, 3), and the variances (H, 3) of their points, ascending."""
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import local_planes

        planes, variances = local_planes(chosen)
        return planes, variances
    mean = chosen.mean(axis=1, dtype=np.float64)
    d = chosen - mean[:, None, :]
    values, vectors = np.linalg.eigh(d.swapaxes(1, 2) @ d / chosen.shape[1])
    normals = vectors[:, :, 0]
    planes = np.column_stack([normals, np.einsum("hi,hi->h", normals, mean)])
    return planes, np.maximum(values, 0.0)


def _has_normal(variances: FloatArray, sigma_m: float) -> BoolArray:
    """Of neighbourhoods with variances (H, 3), which have a normal: wider than the noise, and not along a line."""
    return (variances[:, 1] > (SCREENING_WIDTH * sigma_m) ** 2) & (variances[:, 1] > LINED_UP * variances[:, 2])


def _mostly_agree(normals: FloatArray, normal: FloatArray) -> bool:
    agree = np.abs(normals @ normal) > np.cos(SCREENING_RAD)
    return bool(np.count_nonzero(agree) >= SCREENED_SHARE * len(agree))


def _noise_from_neighbourhoods(thickness: FloatArray) -> float:
    """The noise across flat neighbourhoods: of all, the thinnest fifth is flat almost surely."""
    if len(thickness) == 0:
        return MIN_SIGMA_M
    return max(quantile(thickness, 0.2), MIN_SIGMA_M)


def _harvest(x: Float32Array, free: BoolArray, sample: _Sample, least: int, at_most: int) -> list[PlanePatch]:
    """Take the patches of one subsample, best first; their points are no longer `free`."""
    patches: list[PlanePatch] = []
    active = np.ones(len(sample.points), dtype=bool)
    scale = max(np.count_nonzero(free) / len(sample.points), 1.0)
    # Fewer points of the subsample than this say too little; a later subsample has more of them.
    least_sample = max(least / scale, 12.0)
    dead = np.zeros(len(sample.planes), dtype=bool)
    while len(patches) < at_most and not dead.all():
        votes = _shared(sample.near, active).astype(np.float32)
        votes[dead] = -1.0
        if votes.max() < least_sample:
            break
        candidate, component, hypothesis = _best_patch(sample, active, votes)
        size = int(np.count_nonzero(component))
        if size < least_sample:
            dead |= _shared(sample.near, component) > 0.5 * max(size, 1)
            dead[hypothesis] = True
            continue
        patch = _refit(x, free, candidate, sample, component)
        if patch is None or len(patch) < least:
            dead[hypothesis] = True
            dead |= _shared(sample.near, component) > 0.8 * size
            # What looked most like a plane here and is none would look so from many sides: no more votes from it.
            active[component] = False
            continue
        patches.append(patch)
        free[patch.indices] = False
        active &= free[sample.indices]
    return patches


def _best_patch(sample: _Sample, active: BoolArray, votes: Float32Array) -> tuple[Plane, BoolArray, int]:
    """Of the hypotheses with most votes the one whose largest connected patch is largest, optimised locally."""
    leaders = np.argsort(-votes)[: 6 * sample.rivals : 6]
    best: tuple[int, Plane, BoolArray, int] | None = None
    for leader in leaders:
        if best is not None and votes[leader] <= best[0]:
            break
        near = np.unpackbits(sample.near[leader].view(np.uint8), count=len(active)).view(bool)
        inside = near & active
        plane = Plane(sample.planes[leader, :3], sample.planes[leader, 3])
        component = largest_component(sample.points, inside, plane)
        size = int(np.count_nonzero(component))
        if best is None or size > best[0]:
            best = size, plane, component, int(leader)
    assert best is not None
    _, plane, component, leader_index = best
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import improved

        row, gate_m = np.append(plane.normal, plane.offset), GATE_SIGMAS * sample.sigma_m
        component = improved(
            sample.points, active, component, row, gate_m, sample.refits, MIN_GAP_M, GAP_PER_RANGE, MOST_CELLS
        )
        return Plane(row[:3], float(row[3])), component, leader_index
    for _ in range(sample.refits):
        if np.count_nonzero(component) < 6:
            break
        plane = _moment_plane(sample.points[component])
        distance = np.abs(sample.points @ plane.normal.astype(np.float32) - np.float32(plane.offset))
        inside = (distance < GATE_SIGMAS * sample.sigma_m) & active
        before, component = component, largest_component(sample.points, inside, plane)
        if np.array_equal(before, component):
            break
    return plane, component, leader_index


def _moment_plane(points: NDArray[np.floating]) -> Plane:
    """Total least squares plane; the normal points to the origin's side."""
    mean = points.mean(axis=0, dtype=np.float64)
    d = points - mean.astype(points.dtype)
    normal = np.linalg.eigh((d.T @ d).astype(np.float64))[1][:, 0]
    offset = float(normal @ mean)
    return Plane(normal, offset) if offset <= 0.0 else Plane(-normal, -offset)


def largest_component(points: Float32Array, inside: BoolArray, plane: Plane) -> BoolArray:
    """Of the points `inside` (S,), those of the largest piece that hangs together across gaps, on the plane."""
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import largest_piece

        axes = np.stack(perpendicular_pair(plane.normal))
        return np.asarray(largest_piece(points, inside, axes, MIN_GAP_M, GAP_PER_RANGE, MOST_CELLS))
    from scipy import ndimage

    members = np.flatnonzero(inside)
    result = np.zeros(len(points), dtype=bool)
    if len(members) == 0:
        return result
    chosen = points[members]
    # A thinned subsample has gaps of its own: twice the spacing that its own number and extent give.
    raster, cells = raster_of(chosen, plane, cell_size_m(chosen), 0)
    occupied = np.bincount(cells[cells >= 0], minlength=raster.shape[0] * raster.shape[1]).reshape(raster.shape)
    labels, pieces = ndimage.label(occupied > 0, structure=np.ones((3, 3)))
    if pieces > 1:
        sizes = np.bincount(labels.ravel(), weights=occupied.ravel())
        sizes[0] = 0
        keep = (cells >= 0) & (labels.ravel()[cells] == int(np.argmax(sizes)))
        members = members[keep]
    result[members] = True
    return result


def _refit(x: Float32Array, free: BoolArray, plane: Plane, sample: _Sample, component: BoolArray) -> PlanePatch | None:
    """The patch on the full cloud: free points near the plane in the cells that the component occupies."""
    seen = sample.points[component]
    if sample.seeds is None and len(x) <= SMALL and pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import refitted

        row = np.append(plane.normal, plane.offset)
        verdict, mine, spread_m = refitted(
            x, free, seen, row, sample.sigma_m, _GATES, _LIMITS, _COUNTS, MIN_GAP_M, GAP_PER_RANGE, MOST_CELLS
        )
        if verdict >= 0:
            return PlanePatch(Plane(row[:3], float(row[3])), mine, float(spread_m)) if verdict else None
    raster, cells = raster_of(seen, plane, cell_size_m(seen), 1)
    occupied = np.zeros(raster.shape[0] * raster.shape[1] + 1, dtype=bool)
    occupied[cells] = True
    allowed = np.append(grown(occupied[:-1].reshape(raster.shape)).ravel(), False)
    # Twice the widest slab: what lies just outside it tells a plane from something else.
    reach = np.float32(2.0 * WIDEST * GATE_SIGMAS * sample.sigma_m)
    centre = seen.mean(axis=0, dtype=np.float64)
    near, local = _points_near(x, free, plane, reach, raster, allowed, centre.astype(np.float32))
    if len(near) < 6:
        return None
    sigma_m, normal, offset = sample.sigma_m, plane.normal, plane.offset - float(plane.normal @ centre)
    moments = _moments_compiled if pays(0.0, KERNELS) else _moments
    for _ in range(3):
        distance = local @ normal.astype(np.float32) - np.float32(offset)
        inside = np.abs(distance) < np.float32(GATE_SIGMAS * sigma_m)
        if np.count_nonzero(inside) < 6:
            return None
        normal, offset, variances = moments(local, inside)
        sigma_m = _spread(distance[inside], sample.sigma_m)
    agree = None
    if sample.seeds is not None:
        seeds = sample.seeds.points
        on_patch = np.abs((seeds - centre) @ normal - offset) < GATE_SIGMAS * sigma_m
        agree = sample.seeds.agree(on_patch & allowed[raster.cells(seeds)], normal)
    if not _is_thin(variances, sigma_m) or not _stands_out(local, normal, offset, sigma_m, agree):
        return None
    offset += float(normal @ centre)
    final = Plane(normal, offset) if offset <= 0.0 else Plane(-normal, -offset)
    return PlanePatch(final, near[inside], sigma_m)


def _points_near(
    x: Float32Array,
    free: BoolArray,
    plane: Plane,
    reach_m: np.float32,
    raster: PlaneRaster,
    allowed: BoolArray,
    centre: Float32Array,
) -> tuple[IntArray, Float32Array]:
    """Which free points (M,) of x (N, 3) lie within reach of the plane in allowed cells, and where, from the centre."""
    normal, offset = plane.normal.astype(np.float32), np.float32(plane.offset)
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import points_near

        across = (raster.axes / raster.cell_m).astype(np.float32)
        cells = allowed[:-1].reshape(raster.shape)
        near, local = points_near(x, free, normal, offset, reach_m, across, raster.origin, cells, centre)
        return near, local
    near = np.flatnonzero((np.abs(x @ normal - offset) < reach_m) & free)
    local = x[near]
    keep = allowed[raster.cells(local)]
    return near[keep], local[keep] - centre


def _stands_out(
    local: Float32Array, normal: FloatArray, offset: float, sigma_m: float, neighbours_agree: bool | None = None
) -> bool:
    """Whether a plane is more than a slab through something else: a scanner's mount, clutter, a dense blob.

    Of the points (M, 3) around it, the slab has to hold most of what lies up to twice as far off, and to be thin
    beside both its extents. One point a voxel counts: where beams crowd, as at the pole of a turntable, they are no
    more evidence than elsewhere, and whatever lies there would look flat. Whether neighbours agree with the plane is
    found out here if it is not known.
    """
    points = local[:: max(len(local) // EVIDENCE_POINTS, 1)]
    points = points[first_in_each(points, GATE_SIGMAS * sigma_m)]
    height = np.abs(points @ normal.astype(np.float32) - np.float32(offset))
    inside = height < GATE_SIGMAS * sigma_m
    around = height < 2.0 * GATE_SIGMAS * sigma_m
    if np.count_nonzero(inside) < max(STANDS_OUT * np.count_nonzero(around), 4.0):
        return False
    variances = _variances(points, inside)
    if not variances[0] < THIN**2 * variances[1]:
        return False
    return _neighbours_agree(points[around], normal, sigma_m) if neighbours_agree is None else neighbours_agree


def _neighbours_agree(points: Float32Array, normal: FloatArray, sigma_m: float) -> bool:
    """The corner paper's second screening, of a whole patch: whether the normals that points (V, 3) have by their own
    neighbours are mostly the plane's. Neighbours along one scan line, no wider than the noise, have no normal; where
    two thirds are such, nobody is asked."""
    if len(points) <= SCREENING_NEIGHBOURS:
        return True
    seeds = points[:: -(-len(points) // SCREENED_POINTS)]
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import nearest

        neighbours = nearest(points, seeds, SCREENING_NEIGHBOURS)
    else:
        from scipy.spatial import cKDTree

        tree = cKDTree(points, LEAF_SIZE, compact_nodes=False, balanced_tree=False)
        neighbours = tree.query(seeds, k=SCREENING_NEIGHBOURS)[1]
    planes, variances = _local_planes(points[neighbours])
    known = _has_normal(variances, sigma_m)
    if np.count_nonzero(known) < ASKED_SHARE * len(known):
        return True
    return _mostly_agree(planes[known, :3], normal)


def first_in_each(points: NDArray[np.floating], side_m: float) -> IntArray:
    """The first point (V,) in each cube of the side that holds any of points (M, 3)."""
    x, y, z = np.floor(points.T / points.dtype.type(side_m)).astype(np.int64)
    y -= y.min()
    z -= z.min()
    cells = (x - x.min()) * (int(y.max()) + 1)
    cells += y
    cells *= int(z.max()) + 1
    cells += z
    # Cell and number of a point in one word, where they fit: sorting words is five times as quick as sorting numbers
    # by cells.
    bits = len(points).bit_length()
    if int(cells.max()) >> (63 - bits):
        return np.asarray(np.unique(cells, return_index=True)[1], dtype=np.int64)
    words = np.sort((cells << bits) | np.arange(len(points)))
    cells = words >> bits
    first = np.append(True, cells[1:] != cells[:-1])
    return np.asarray(words[first] & ((1 << bits) - 1), dtype=np.int64)


def _moments(local: Float32Array, inside: BoolArray) -> tuple[FloatArray, float, FloatArray]:
    """Normal, offset and variances (3,), ascending, of the points (M, 3) that are inside; near the origin, so that
    single precision holds their moments."""
    weight = inside.astype(np.float32)
    count = float(np.count_nonzero(inside))
    mean = (weight @ local).astype(np.float64) / count
    second = ((local * weight[:, None]).T @ local).astype(np.float64) / count - np.outer(mean, mean)
    variances, axes = np.linalg.eigh(second)
    return axes[:, 0], float(axes[:, 0] @ mean), variances


def _variances(points: Float32Array, inside: BoolArray) -> FloatArray:
    """Of those of the points (M, 3) that are inside, ascending (3,)."""
    if pays(0.0, KERNELS):
        return _moments_compiled(points, inside)[2]
    return np.asarray(np.linalg.eigvalsh(mean_and_covariance(points[inside])[1]))


def _moments_compiled(local: Float32Array, inside: BoolArray) -> tuple[FloatArray, float, FloatArray]:
    """`_moments` by kernels."""
    from lidarpose.detect.patch_kernels import eigen, moments

    mean, second = moments(local, inside.view(np.uint8))
    variances, axes = eigen(second)
    return axes[:, 0].copy(), float(axes[:, 0] @ mean), variances


def _spread(distance: Float32Array, first_sigma_m: float) -> float:
    """Robust spread of distances (M,) across a plane, within a factor of the subsample's."""
    few = distance[:: max(len(distance) // SPREAD_POINTS, 1)]
    return min(max(mad_sigma(few, centred=True), MIN_SIGMA_M, 0.5 * first_sigma_m), WIDEST * first_sigma_m)


def _is_thin(variances: FloatArray, sigma_m: float) -> bool:
    """Whether points with these variances extend both ways well beyond their spread across."""
    return bool(sigma_m**2 < 0.35**2 * variances[1] and sigma_m**2 < 0.1**2 * variances[2])
