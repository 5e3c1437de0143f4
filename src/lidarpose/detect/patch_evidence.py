"""Whether a patch of a cloud is a surface: its moments, its spread, and the normals of the points around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.plane_raster import mean_and_covariance
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import mad_sigma

Float32Array = NDArray[np.float32]

KERNELS = "detect.patch_kernels"
# So many distances are looked through sooner than a tree is built; without kernels nearly as soon, and sooner by far
# than SciPy's trees are imported. They are looked through in blocks that fit into a core's own memory.
FEW_DISTANCES = 500_000
DISTANCES_AT_ONCE = 32_768
# Of trees that are asked few times: wide leaves are built sooner.
LEAF_SIZE = 32
GATE_SIGMAS = 3.0
MIN_SIGMA_M = 2e-4
# A patch spreads more than its neighbourhoods say, by up to this factor; a wider slab would take in two surfaces.
WIDEST = 3.0
# Of the voxels within twice a patch's thickness, the share that lies within it; and its thickness over its width.
STANDS_OUT = 0.7
THIN = 0.15
EVIDENCE_POINTS = 60_000
# The second screening: neighbours that make a point's own normal, points asked (up to twice as many where they do not
# divide evenly), and how many have to agree how well.
SCREENING_NEIGHBOURS = 12
SCREENING_WIDTH = 1.5
LINED_UP = 0.15
SCREENED_POINTS = 200
SCREENING_RAD = np.radians(25.0)
SCREENED_SHARE = 0.55
ASKED_SHARE = 0.35
# Of how many distances the spread is taken.
SPREAD_POINTS = 20_000
# What kernels need of these, by kind.
GATES = np.array([GATE_SIGMAS, WIDEST, MIN_SIGMA_M, STANDS_OUT, THIN])
LIMITS = np.array([SCREENING_WIDTH, LINED_UP, np.cos(SCREENING_RAD), ASKED_SHARE, SCREENED_SHARE])
COUNTS = np.array([SCREENING_NEIGHBOURS, SCREENED_POINTS, EVIDENCE_POINTS, SPREAD_POINTS])


def local_planes_of(chosen: Float32Array) -> tuple[FloatArray, FloatArray]:
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


def heights(points: Float32Array, normal: FloatArray, offset: float) -> Float32Array:
    """How far points (M, 3) are from a plane, in single precision, rounded as the kernels round it: a library's product
    would leave points within rounding of a gate inside by the one way and outside by the other."""
    a, b, c = normal.astype(np.float32)
    height: Float32Array = points[:, 0] * a
    height += points[:, 1] * b
    height += points[:, 2] * c
    height -= np.float32(offset)
    return height


def has_normal(variances: FloatArray, sigma_m: float) -> BoolArray:
    """Of neighbourhoods with variances (H, 3), which have a normal: wider than the noise, and not along a line."""
    return (variances[:, 1] > (SCREENING_WIDTH * sigma_m) ** 2) & (variances[:, 1] > LINED_UP * variances[:, 2])


def mostly_agree(normals: FloatArray, normal: FloatArray) -> bool:
    agree = np.abs(normals @ normal) > np.cos(SCREENING_RAD)
    return bool(np.count_nonzero(agree) >= SCREENED_SHARE * len(agree))


def stands_out(
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
    height = np.abs(heights(points, normal, offset))
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
    seeds = points[:: max(len(points) // SCREENED_POINTS, 1)]
    neighbours = nearest_points(points, seeds, SCREENING_NEIGHBOURS)
    planes, variances = local_planes_of(points[neighbours])
    known = has_normal(variances, sigma_m)
    if np.count_nonzero(known) < ASKED_SHARE * len(known):
        return True
    return mostly_agree(planes[known, :3], normal)


def nearest_points(points: Float32Array, seeds: Float32Array, count: int) -> IntArray:
    """Positions (H, count) of the points (N, 3) nearest to each seed (H, 3), the nearest first."""
    if len(seeds) * len(points) > FEW_DISTANCES:
        from scipy.spatial import cKDTree

        tree = cKDTree(points, LEAF_SIZE, compact_nodes=False, balanced_tree=False)
        return np.asarray(tree.query(seeds, k=count)[1])
    if pays(0.0, KERNELS):
        from lidarpose.detect.patch_kernels import nearest

        return np.asarray(nearest(points, seeds, count))
    found = np.empty((len(seeds), count), dtype=np.int64)
    columns, together = np.ascontiguousarray(points.T), max(DISTANCES_AT_ONCE // len(points), 1)
    for first in range(0, len(seeds), together):
        found[first : first + together] = _nearest(columns, seeds[first : first + together], count)
    return found


def _nearest(columns: Float32Array, seeds: Float32Array, count: int) -> IntArray:
    """The same for few seeds and points in columns (3, N), by all distances."""
    squares = (columns[0] - seeds[:, :1]) ** 2
    for k in (1, 2):
        d = columns[k] - seeds[:, k : k + 1]
        d *= d
        squares += d
    near = np.argpartition(squares, count - 1, axis=1)[:, :count]
    order = np.argsort(np.take_along_axis(squares, near, axis=1), axis=1)
    return np.asarray(np.take_along_axis(near, order, axis=1))


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


def moments(local: Float32Array, inside: BoolArray) -> tuple[FloatArray, float, FloatArray]:
    """Normal, offset and variances (3,), ascending, of the points (M, 3) that are inside."""
    chosen = local.compress(inside, axis=0).astype(np.float64)
    mean = np.ones(len(chosen)) @ chosen / len(chosen)
    variances, axes = np.linalg.eigh(chosen.T @ chosen / len(chosen) - np.outer(mean, mean))
    return axes[:, 0], float(axes[:, 0] @ mean), variances


def _variances(points: Float32Array, inside: BoolArray) -> FloatArray:
    """Of those of the points (M, 3) that are inside, ascending (3,)."""
    if pays(0.0, KERNELS):
        return moments_compiled(points, inside)[2]
    return np.asarray(np.linalg.eigvalsh(mean_and_covariance(points[inside])[1]))


def moments_compiled(local: Float32Array, inside: BoolArray) -> tuple[FloatArray, float, FloatArray]:
    """`moments` by kernels."""
    from lidarpose.detect.patch_kernels import eigen, moments

    mean, second = moments(local, inside.view(np.uint8))
    variances, axes = eigen(second)
    return axes[:, 0].copy(), float(axes[:, 0] @ mean), variances


def spread(distance: Float32Array, first_sigma_m: float) -> float:
    """Robust spread of distances (M,) across a plane, within a factor of the subsample's."""
    few = distance[:: max(len(distance) // SPREAD_POINTS, 1)]
    return min(max(mad_sigma(few, centred=True), MIN_SIGMA_M, 0.5 * first_sigma_m), WIDEST * first_sigma_m)


def is_thin(variances: FloatArray, sigma_m: float) -> bool:
    """Whether points with these variances extend both ways well beyond their spread across."""
    return bool(sigma_m**2 < 0.35**2 * variances[1] and sigma_m**2 < 0.1**2 * variances[2])
