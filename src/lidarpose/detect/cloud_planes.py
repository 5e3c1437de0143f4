"""Planes of a cloud: connected flat patches, the largest first, on clouds of any density and order.

Strategy. A random subsample of a few thousand points keeps the cloud's own density (a voxel grid would even it out and
lose small dense faces). Around random points of it, planes through near neighbours are the hypotheses; all are scored
against the subsample at once, in one matrix product. The best is optimised locally, cut to its largest connected
patch, and refitted there on the full cloud, never over the unbounded slab. Its points leave, the scores of the others
follow by one product more, and only when the subsample is used up another is drawn from what is left, so that small
faces come up once the large ones are gone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.patch_evidence import (
    COUNTS,
    GATE_SIGMAS,
    GATES,
    KERNELS,
    LIMITS,
    WIDEST,
    Float32Array,
    first_in_each,
    heights,
    is_thin,
    moments,
    moments_compiled,
    spread,
    stands_out,
)
from lidarpose.detect.plane_claims import Slab, patches_of_slabs
from lidarpose.detect.plane_raster import (
    GAP_PER_RANGE,
    MIN_GAP_M,
    MOST_CELLS,
    PlaneRaster,
    cell_size_m,
    grown,
    largest_piece,
    raster_of,
)
from lidarpose.detect.plane_sample import (
    POINTS_PER_HYPOTHESIS,
    SAMPLE_SIZE,
    PlaneSample,
    draw_sample,
    one_of_each,
    shared_points,
)
from lidarpose.geometry.arrays import BoolArray, IntArray, perpendicular_pair
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.robust import median
from lidarpose.model.plane_patch import PlanePatch

# By how much they search a cloud sooner: its subsamples, and all points where a cloud is searched whole.
SAVED_S = 1.5e-3
SAVED_S_PER_POINT = 7e-8
# From this many points on, patches are found and tested in a subsample, and the whole cloud is asked once.
DENSE = 200_000
DENSE_SAMPLE = 8192
DENSE_HYPOTHESES = 400
FEWEST_OF_SAMPLE = 30
# A whole refit is a kernel's in clouds of no more points: NumPy sorts more of them sooner.
SMALL = 8000
# So many voxels of the subsample tell whether a patch is a surface.
ENOUGH_EVIDENCE = 1000
HYPOTHESES = 1000
# Of the hypotheses with most votes, how many are compared by their largest connected patch, and how often the best is
# refitted on the subsample. In a dense cloud that is done on more points afterwards.
RIVALS_AND_REFITS = (4, 3)
DENSE_RIVALS_AND_REFITS = (2, 1)
# Patches that spread by this factor more than neighbouring points are of bent surfaces: flat ones spread up to twice as
# much as the thinnest fifth of neighbourhoods, and none more than three times.
BENT = 2.3
# The share of the points found that patches of bent surfaces hold where those are wanted whole.
BENT_SHARE = 1.0 / 3.0


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
            left = np.flatnonzero(free)
            sample = draw_sample(x, left, sigma_m, search.hypotheses, rng, from_sensor=search.from_sensor)
            sample = replace(sample, seeds=None)
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
        sigma_m = median(np.array([p.sigma_m for p in patches]))
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
    chosen = one_of_each(count, DENSE_SAMPLE, rng)
    if count < len(x):
        chosen = np.flatnonzero(free)[chosen]
    few = x[chosen].astype(np.float32)
    share = count / len(few)
    fewest = max(int(least / share), FEWEST_OF_SAMPLE)
    jury = one_of_each(len(few), SAMPLE_SIZE, rng)
    hypotheses = min(search.hypotheses, DENSE_HYPOTHESES)
    sample = draw_sample(few, jury, sigma_m, hypotheses, rng, from_sensor=search.from_sensor)
    seen = _harvest(few, np.ones(len(few), dtype=bool), sample, fewest, at_most, DENSE_RIVALS_AND_REFITS)
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
        if not is_thin(np.append(0.0, claim.variances), patch.sigma_m):
            continue
        # Few voxels of the subsample say little of what a patch is: the cloud has more.
        if len(first_in_each(few[before.indices], GATE_SIGMAS * before.sigma_m)) < ENOUGH_EVIDENCE:
            local = x[claim.around()].astype(np.float32)
            if not stands_out(local, patch.plane.normal, patch.plane.offset, patch.sigma_m):
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
    chosen = one_of_each(len(x), DENSE // 2, rng)
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


def _harvest(
    x: Float32Array,
    free: BoolArray,
    sample: PlaneSample,
    least: int,
    at_most: int,
    rivals_and_refits: tuple[int, int] = RIVALS_AND_REFITS,
) -> list[PlanePatch]:
    """Take the patches of one subsample, best first; their points are no longer `free`."""
    patches: list[PlanePatch] = []
    active = np.ones(len(sample.points), dtype=bool)
    scale = max(np.count_nonzero(free) / len(sample.points), 1.0)
    # Fewer points of the subsample than this say too little; a later subsample has more of them.
    least_sample = max(least / scale, 12.0)
    dead = np.zeros(len(sample.planes), dtype=bool)
    while len(patches) < at_most and not dead.all():
        votes = shared_points(sample.near, active).astype(np.float32)
        votes[dead] = -1.0
        if votes.max() < least_sample:
            break
        candidate, component, hypothesis = _best_patch(sample, active, votes, *rivals_and_refits)
        size = int(np.count_nonzero(component))
        if size < least_sample:
            dead |= shared_points(sample.near, component) > 0.5 * max(size, 1)
            dead[hypothesis] = True
            continue
        patch = _refit(x, free, candidate, sample, component)
        if patch is None or len(patch) < least:
            dead[hypothesis] = True
            dead |= shared_points(sample.near, component) > 0.8 * size
            # What looked most like a plane here and is none would look so from many sides: no more votes from it.
            active[component] = False
            continue
        patches.append(patch)
        free[patch.indices] = False
        active &= free[sample.indices]
    return patches


def _best_patch(
    sample: PlaneSample, active: BoolArray, votes: Float32Array, rivals: int, refits: int
) -> tuple[Plane, BoolArray, int]:
    """Of the hypotheses with most votes the one whose largest connected patch is largest, optimised locally."""
    leaders = np.argsort(-votes)[: 6 * rivals : 6]
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
            sample.points, active, component, row, gate_m, refits, MIN_GAP_M, GAP_PER_RANGE, MOST_CELLS
        )
        return Plane(row[:3], float(row[3])), component, leader_index
    for _ in range(refits):
        if np.count_nonzero(component) < 6:
            break
        plane = _moment_plane(sample.points[component])
        distance = np.abs(heights(sample.points, plane.normal, plane.offset))
        inside = (distance < np.float32(GATE_SIGMAS * sample.sigma_m)) & active
        before, component = component, largest_component(sample.points, inside, plane)
        if np.array_equal(before, component):
            break
    return plane, component, leader_index


def _moment_plane(points: NDArray[np.floating]) -> Plane:
    """Total least squares plane; the normal points to the origin's side."""
    mean = points.mean(axis=0, dtype=np.float64)
    d = points - mean
    normal = np.linalg.eigh(d.T @ d)[1][:, 0]
    offset = float(normal @ mean)
    return Plane(normal, offset) if offset <= 0.0 else Plane(-normal, -offset)


def largest_component(points: Float32Array, inside: BoolArray, plane: Plane) -> BoolArray:
    """Of the points `inside` (S,), those of the largest piece that hangs together across gaps, on the plane."""
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import largest_piece as compiled

        axes = np.stack(perpendicular_pair(plane.normal))
        return np.asarray(compiled(points, inside, axes, MIN_GAP_M, GAP_PER_RANGE, MOST_CELLS))
    members = np.flatnonzero(inside)
    result = np.zeros(len(points), dtype=bool)
    if len(members) == 0:
        return result
    chosen = points[members]
    # A thinned subsample has gaps of its own: twice the spacing that its own number and extent give.
    raster, cells = raster_of(chosen, plane, cell_size_m(chosen), 0)
    counts = np.bincount(cells[cells >= 0], minlength=raster.shape[0] * raster.shape[1]).reshape(raster.shape)
    members = members[np.append(largest_piece(counts).ravel(), False)[cells]]
    result[members] = True
    return result


def _refit(
    x: Float32Array, free: BoolArray, plane: Plane, sample: PlaneSample, component: BoolArray
) -> PlanePatch | None:
    """The patch on the full cloud: free points near the plane in the cells that the component occupies."""
    seen = sample.points[component]
    if sample.seeds is None and len(x) <= SMALL and pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import refitted

        row = np.append(plane.normal, plane.offset)
        verdict, mine, spread_m = refitted(
            x, free, seen, row, sample.sigma_m, GATES, LIMITS, COUNTS, MIN_GAP_M, GAP_PER_RANGE, MOST_CELLS
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
    moments_of = moments_compiled if pays(0.0, KERNELS) else moments
    for _ in range(3):
        distance = heights(local, normal, offset)
        inside = np.abs(distance) < np.float32(GATE_SIGMAS * sigma_m)
        if np.count_nonzero(inside) < 6:
            return None
        normal, offset, variances = moments_of(local, inside)
        sigma_m = spread(distance[inside], sample.sigma_m)
    agree = None
    if sample.seeds is not None:
        seeds = sample.seeds.points
        on_patch = np.abs((seeds - centre) @ normal - offset) < GATE_SIGMAS * sigma_m
        agree = sample.seeds.agree(on_patch & allowed[raster.cells(seeds)], normal)
    if not is_thin(variances, sigma_m) or not stands_out(local, normal, offset, sigma_m, agree):
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
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import points_near

        normal, offset = plane.normal.astype(np.float32), np.float32(plane.offset)
        across = (raster.axes / raster.cell_m).astype(np.float32)
        cells = allowed[:-1].reshape(raster.shape)
        near, local = points_near(x, free, normal, offset, reach_m, across, raster.origin, cells, centre)
        return near, local
    near = np.flatnonzero((np.abs(heights(x, plane.normal, plane.offset)) < reach_m) & free)
    local = x[near]
    keep = allowed[raster.cells(local)]
    return near[keep], local[keep] - centre
