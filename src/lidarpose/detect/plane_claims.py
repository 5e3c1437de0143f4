"""From patches of a subsample to patches of the whole cloud, all of them in one pass over its points.

The pass goes through the cloud in blocks that stay in the cache. It keeps the points that lie near a patch's plane,
in the cells of it that the subsample occupies, with their heights over it, and sums the moments that the plane's
correction follows from. Points that two patches claim, along the seam of two faces, belong to the patch that was found
first and have no say in either plane: on one side of a seam only, the other face's points would tilt it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import count
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.plane_raster import PlaneRaster, grown, raster_of, spacing_m
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.robust import mad_sigma
from lidarpose.model.plane_patch import PlanePatch

Float32Array = NDArray[np.float32]
Result = TypeVar("Result")

# Points of a block, at most: its coordinates, heights and masks stay in a core's cache.
BLOCK = 64_000
# Matrix products of so many points and slabs are too small for OpenBLAS to share out among threads, which the blocks
# already keep busy; a single slab's would not be, as products with a vector have another limit.
POINTS_AT_ONCE = 32_000
SLABS_AT_ONCE = 2
# By how much kernels are done sooner, on two cores, where some planes are looked for.
SAVED_S_PER_POINT = 1e-8
GATE_SIGMAS = 3.0
# Claimed is more than is kept in the end: what lies around a slab tells whether it is a surface.
CLAIM_SIGMAS = 6.0
EVIDENCE_POINTS = 8000
# A patch is screened cell by cell where this share of its claims lies outside the gate; a clean one has 0.3 %.
CLUTTERED = 0.02
# A cell of a surface has at least this share of its claims within the gate.
STANDS_OUT = 0.7
# By how much the mean of normal heights follows where the gate stays: 1 - 6 phi(3) / (1 - 2 Phi(-3)).
FOLLOWED = 0.9733
# A step of more than this many standard deviations of the result is followed by another; sooner where it costs little,
# and in clutter, whose heights do not follow.
LARGE_STEP = 20.0
SMALL_STEP = 0.5
FEW_POINTS = 50_000
MOST_STEPS = 6
FEWEST = 6
SPREAD_POINTS = 10_000
# They are read in runs, as neighbours in memory cost hardly more than one alone.
RUN = 16
# Of the terms 1, height, u, v.
_ON_PLANE = [0, 2, 3]


@dataclass(frozen=True, eq=False)
class Slab:
    """A patch as a subsample shows it.

    Attributes
    ----------
    plane, sigma_m
        As fitted to the subsample's points.
    raster, allowed
        The cells of the plane that they occupy, and their neighbours; none on the raster's border.
    rows : (4, 4)
        Take (x, y, z, 1) to the terms: 1, the height over the plane, and two coordinates u and v on it from near the
        patch's middle.
    first_cell : (2,)
        Where that middle is in the raster, in cells.
    """

    plane: Plane
    sigma_m: float
    raster: PlaneRaster
    allowed: BoolArray
    rows: FloatArray
    first_cell: FloatArray

    @staticmethod
    def around(points: NDArray[np.floating], plane: Plane, sigma_m: float) -> Slab:
        """The slab of a patch with points (M, 3)."""
        raster, cells = raster_of(points, plane, spacing_m(points), 2)
        occupied = np.zeros(raster.shape[0] * raster.shape[1], dtype=bool)
        occupied[cells[cells >= 0]] = True
        allowed = grown(occupied.reshape(raster.shape))
        allowed[[0, -1]] = allowed[:, [0, -1]] = False
        middle = raster.axes @ points.mean(axis=0, dtype=np.float64)
        rows = np.zeros((4, 4))
        rows[0, 3] = 1.0
        rows[1] = np.append(plane.normal, -plane.offset)
        rows[2:, :3], rows[2:, 3] = raster.axes, -middle
        return Slab(plane, sigma_m, raster, allowed.ravel(), rows, middle / raster.cell_m - raster.origin)

    def holds(self, terms: Float32Array) -> BoolArray:
        """Which of points lie in allowed cells, by their terms (4, M)."""
        return np.asarray(self.allowed.take(self._numbers(terms), mode="clip"))

    def cells(self, terms: Float32Array) -> NDArray[np.int32]:
        """Numbers (M,) of the cells of points on the raster by their terms (4, M)."""
        return np.asarray(np.clip(self._numbers(terms), 0, len(self.allowed) - 1))

    def _numbers(self, terms: Float32Array) -> NDArray[np.int32]:
        across = terms[2:] * np.float32(1.0 / self.raster.cell_m)
        across += self.first_cell.astype(np.float32)[:, None]
        u, v = across
        # What lies outside ends on the border, which is never allowed, or beyond the first or last cell.
        np.maximum(v, np.float32(0.0), out=v)
        np.minimum(v, np.float32(self.raster.shape[1] - 1), out=v)
        numbers: NDArray[np.int32] = u.astype(np.int32)
        numbers *= np.int32(self.raster.shape[1])
        numbers += v.astype(np.int32)
        return numbers

    def turned(self, lean: FloatArray) -> FloatArray:
        """What takes (x, y, z, 1) to heights over the plane that has the heights lean . (1, u, v) over this one."""
        return np.asarray(self.rows[1] - lean @ self.rows[[0, 2, 3]])

    def leant(self, lean: FloatArray) -> Plane:
        """That plane."""
        turned = self.turned(lean)
        plane = Plane(turned[:3], -float(turned[3]))
        return plane if plane.offset <= 0.0 else plane.flipped()


class _Claims(Protocol):
    """Points of a block near one patch, at least those in its cells."""

    @property
    def index(self) -> NDArray[np.integer]:
        """Which of the block's (M,)."""
        ...

    @property
    def indices(self) -> IntArray:
        """Which of the cloud's (M,)."""
        ...

    @property
    def terms(self) -> Float32Array:
        """1, height, u and v (4, M)."""
        ...

    @property
    def held(self) -> BoolArray:
        """Which lie in the patch's cells (M,)."""
        ...

    @property
    def disputed(self) -> NDArray[np.integer]:
        """The positions among them of those that another patch claims too."""
        ...

    def held_count(self) -> int: ...

    def some(self, every: int) -> IntArray:
        """Of the points in the patch's cells those that are among every so manieth of the cloud's."""
        ...

    def some_rest(self, every: int, lean: FloatArray) -> Float32Array:
        """Heights over the leant plane of those in every so manieth run of the cloud's points."""
        ...

    def moments(self, slab: Slab, lean: FloatArray) -> FloatArray:
        """Sums (4, 4) of the terms' products within the gate of the leant plane and outside of seams."""
        ...

    def only(self, keep: BoolArray) -> _Claims:
        """These points without those that are not to be kept."""
        ...


@dataclass(frozen=True, eq=False)
class _Terms:
    """Claims as NumPy makes them: with all that is known of each point. `index` (M,) counts from number `first` on."""

    first: int
    index: IntArray
    terms: Float32Array
    held: BoolArray
    disputed: IntArray

    @property
    def indices(self) -> IntArray:
        return self.index + self.first

    def held_count(self) -> int:
        return int(np.count_nonzero(self.held))

    def some(self, every: int) -> IntArray:
        return self.indices[self.held & _runs(every, 1).take(self.index)]

    def some_rest(self, every: int, lean: FloatArray) -> Float32Array:
        few = np.flatnonzero(_runs(every, RUN).take(self.index))
        return _rest(self.terms.take(few[self.held.take(few)], axis=1), lean)

    def moments(self, slab: Slab, lean: FloatArray) -> FloatArray:
        rest = _rest(self.terms, lean) if lean.any() else self.terms[1]
        apart = np.abs(rest)
        apart[self.disputed] = np.inf
        inside = apart < np.float32(GATE_SIGMAS * slab.sigma_m)
        inside &= self.held
        return np.asarray((self.terms * inside.astype(np.float32)) @ self.terms.T)

    def only(self, keep: BoolArray) -> _Terms:
        return replace(self, held=self.held & keep)


@dataclass(frozen=True, eq=False)
class _Held:
    """Claims as kernels make them: of the points from number `first` on those at the positions `index` (M,), all of
    them in the patch's cells, with their terms but the first."""

    first: int
    index: NDArray[np.uint32]
    along: tuple[Float32Array, Float32Array, Float32Array]
    disputed: NDArray[np.integer]

    @property
    def indices(self) -> IntArray:
        return self.index + np.int64(self.first)

    @cached_property
    def terms(self) -> Float32Array:
        return np.stack([np.ones(len(self.index), dtype=np.float32), *self.along])

    @property
    def held(self) -> BoolArray:
        return np.ones(len(self.index), dtype=bool)

    def held_count(self) -> int:
        return len(self.index)

    def some(self, every: int) -> IntArray:
        return self.indices[_runs(every, 1)[self.index]]

    def some_rest(self, every: int, lean: FloatArray) -> Float32Array:
        from lidarpose.detect.plane_kernels import heights_of_some

        return np.asarray(heights_of_some(self.index, *self.along, every | 1, RUN, lean.astype(np.float32)))

    def moments(self, slab: Slab, lean: FloatArray) -> FloatArray:
        from lidarpose.detect.plane_kernels import moments_of

        gate_m = np.float32(GATE_SIGMAS * slab.sigma_m)
        return np.asarray(moments_of(*self.along, self.disputed, lean.astype(np.float32), gate_m))

    def only(self, keep: BoolArray) -> _Held:
        disputed = np.zeros(len(keep), dtype=bool)
        disputed[self.disputed] = True
        height, along_u, along_v = self.along
        along = height[keep], along_u[keep], along_v[keep]
        # As kernels know it: for another type they would be compiled again.
        places = np.flatnonzero(disputed[keep]).astype(np.uint32)
        return replace(self, index=self.index[keep], along=along, disputed=places)


@lru_cache(maxsize=64)
def _runs(every: int, run: int) -> BoolArray:
    """Which positions in a block lie in every so manieth run of neighbours; odd steps hit each ring of a LiDAR."""
    return np.asarray(np.arange(BLOCK) // run % (every | 1) == 0)


_Part = tuple[_Claims, FloatArray]


@dataclass(frozen=True, eq=False)
class _Fit:
    """What all blocks say of a slab: the plane's heights over the slab's, and the spread and extents of its points."""

    lean: FloatArray
    sigma_m: float
    variances: FloatArray


@dataclass(frozen=True, eq=False)
class Claim:
    """A patch of the whole cloud.

    Attributes
    ----------
    patch
        Its plane, points and spread.
    variances : (2,)
        Of its points along it, ascending.
    """

    patch: PlanePatch
    variances: FloatArray
    parts: Sequence[_Part]

    def around(self) -> IntArray:
        """Indices (M,) of some thousand of the points on it and up to twice as far off it, evenly drawn."""
        held = sum(claims.held_count() for claims, _ in self.parts)
        return np.concatenate([claims.some(held // EVIDENCE_POINTS + 1) for claims, _ in self.parts])


class _Team:
    """As many threads as cores, this one among them: each takes the next piece of work.

    A pool's own map has this thread wait for every piece, and wake for it: for 700 000 points by NumPy ten times as
    often.
    """

    def __init__(self, most: int) -> None:
        self._others = min(os.cpu_count() or 1, most) - 1
        self._pool = ThreadPoolExecutor(max(self._others, 1))

    def __enter__(self) -> _Team:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.shutdown()

    def each(self, work: Callable[..., Result], *pieces: Sequence[Any]) -> list[Result]:
        """As the built-in map, in a list."""
        done: dict[int, Result] = {}
        numbers = count()

        def take() -> None:
            while (k := next(numbers)) < len(pieces[0]):
                done[k] = work(*(of[k] for of in pieces))

        others = [self._pool.submit(take) for _ in range(self._others)]
        take()
        for other in others:
            other.result()
        return [done[k] for k in range(len(pieces[0]))]


def _blocks(x: NDArray[np.floating]) -> list[slice]:
    """An even number of blocks, all alike, for two cores to be busy equally long."""
    each = -(-len(x) // (2 * -(-len(x) // (2 * BLOCK)))) if len(x) else 1
    return [slice(first, min(first + each, len(x))) for first in range(0, len(x), each)]


def patches_of_slabs(
    x: NDArray[np.floating],
    free: BoolArray | None,
    slabs: Sequence[Slab],
    widest_m: float = np.inf,
) -> list[Claim | None]:
    """The patches of the whole cloud for those of a subsample, in their order.

    Parameters
    ----------
    x : (N, 3)
    free
        Which of them may be taken; None for all.
    widest_m
        No patch spreads more.

    Returns
    -------
    For each slab its patch; None where too few points are there. No point belongs to two.
    """
    blocks = _blocks(x)
    compiled = pays(SAVED_S_PER_POINT * len(x), "detect.plane_kernels")
    claim = _compiled_claims(x, free, slabs) if compiled else partial(_claim, x, free, slabs)
    members_in = _members_compiled if compiled else _members
    with _Team(len(blocks)) as team:
        parts = team.each(claim, blocks)
        of_slabs = team.each(_screened, slabs, [[part[k] for part in parts] for k in range(len(slabs))])
        fits = team.each(lambda slab, mine: _fit(slab, mine, widest_m), slabs, of_slabs)
        of_blocks = list(zip(*of_slabs, strict=True))
        members = team.each(lambda block, part: members_in(block, part, fits), blocks, of_blocks)
        indices = team.each(np.concatenate, list(zip(*members, strict=True)))
    patches: list[Claim | None] = []
    for k, fit in enumerate(fits):
        if fit is None:
            patches.append(None)
            continue
        patch = PlanePatch(slabs[k].leant(fit.lean), indices[k], fit.sigma_m)
        patches.append(Claim(patch, fit.variances, of_slabs[k]))
    return patches


def _claim(x: NDArray[np.floating], free: BoolArray | None, slabs: Sequence[Slab], block: slice) -> list[_Part]:
    """What each slab claims of a block of the points."""
    points = np.empty((4, block.stop - block.start), dtype=np.float32)
    # Rounded first: their own order is that of memory.
    points[:3] = x[block].astype(np.float32, copy=False).T
    points[3] = 1.0
    rows = np.zeros((-(-len(slabs) // SLABS_AT_ONCE) * SLABS_AT_ONCE, 4), dtype=np.float32)
    rows[: len(slabs)] = [s.rows[1] / (CLAIM_SIGMAS * s.sigma_m) for s in slabs]
    height = np.empty((len(rows), points.shape[1]), dtype=np.float32)
    for first in range(0, len(slabs), SLABS_AT_ONCE):
        some = slice(first, first + SLABS_AT_ONCE)
        for part in range(0, points.shape[1], POINTS_AT_ONCE):
            columns = slice(part, part + POINTS_AT_ONCE)
            np.matmul(rows[some], points[:, columns], out=height[some, columns])
    height = height[: len(slabs)]
    near = np.abs(height, out=height) < np.float32(1.0)
    if free is not None:
        near &= free[block]
    # Slabs are endless, so that many points lie in two of them; claimed twice are those that both patches hold.
    suspects = np.add.reduce(near, axis=0, dtype=np.uint8) > 1
    times = np.zeros(len(suspects), dtype=np.uint8)
    found = []
    for slab, mine in zip(slabs, near, strict=True):
        indices = np.flatnonzero(mine)
        to_slab = slab.rows.astype(np.float32)
        terms = to_slab @ points.take(indices, axis=1)
        held = slab.holds(terms)
        if np.count_nonzero(held) < 0.5 * len(held):
            indices, terms = indices[held], terms.compress(held, axis=1)
            held = np.ones(len(indices), dtype=bool)
        doubtful = np.flatnonzero(suspects.take(indices))
        doubtful = doubtful[held[doubtful]]
        times[indices[doubtful]] += 1
        found.append((indices, terms, held, doubtful))
    parts: list[_Part] = []
    for slab, (indices, terms, held, doubtful) in zip(slabs, found, strict=True):
        claims = _Terms(block.start, indices, terms, held, doubtful[times[indices[doubtful]] > 1])
        parts.append((claims, claims.moments(slab, np.zeros(3))))
    return parts


def _compiled_claims(
    x: NDArray[np.floating], free: BoolArray | None, slabs: Sequence[Slab]
) -> Callable[[slice], list[_Part]]:
    """`_claim` by kernels, which drop what is not held."""
    from lidarpose.detect.plane_kernels import claims_of_block

    gates = np.array([GATE_SIGMAS * s.sigma_m for s in slabs], dtype=np.float32)
    rows = np.zeros((len(slabs), 5, 4), dtype=np.float32)
    for k, slab in enumerate(slabs):
        rows[k, 0] = slab.rows[1] / (CLAIM_SIGMAS * slab.sigma_m)
        rows[k, 1:4] = slab.rows[1:]
        rows[k, 4, 0], rows[k, 4, 1:3] = 1.0 / slab.raster.cell_m, slab.first_cell
    allowed = np.concatenate([s.allowed for s in slabs]).view(np.uint8)
    starts = np.cumsum([0] + [len(s.allowed) for s in slabs])
    widths = np.array([s.raster.shape[1] for s in slabs])
    all_free = np.zeros(0, dtype=bool)

    def claim(block: slice) -> list[_Part]:
        of_block = all_free if free is None else free[block]
        index, *along, ends, disputed, their_ends, moments = claims_of_block(
            np.ascontiguousarray(x[block]), of_block, rows, allowed, starts, widths, gates
        )
        parts: list[_Part] = []
        first = first_disputed = 0
        for k in range(len(slabs)):
            mine, theirs = slice(first, ends[k]), slice(first_disputed, their_ends[k])
            height, along_u, along_v = (values[mine] for values in along)
            held = _Held(block.start, index[mine], (height, along_u, along_v), disputed[theirs])
            parts.append((held, moments[k]))
            first, first_disputed = ends[k], their_ends[k]
        return parts

    return claim


def _screened(slab: Slab, parts: Sequence[_Part]) -> Sequence[_Part]:
    """The claims without those in cells that hold hardly more than what lies around the slab there, where a chain of
    stray points led the subsample astray: few points, but far out. In clean surroundings nothing is asked."""
    if not _cluttered(parts):
        return parts
    cells = [slab.cells(claims.terms) for claims, _ in parts]
    inside, around = (np.zeros(len(slab.allowed)) for _ in range(2))
    for (claims, _), cell in zip(parts, cells, strict=True):
        near = np.abs(claims.terms[1]) < np.float32(GATE_SIGMAS * slab.sigma_m)
        inside += np.bincount(cell[claims.held & near], minlength=len(inside))
        around += np.bincount(cell[claims.held & ~near], minlength=len(inside))
    solid = inside > STANDS_OUT * (inside + around)
    kept = [claims.only(solid[cell]) for (claims, _), cell in zip(parts, cells, strict=True)]
    return [(claims, claims.moments(slab, np.zeros(3))) for claims in kept]


def _cluttered(parts: Sequence[_Part]) -> bool:
    """Whether many claims lie outside the gate."""
    within = sum(float(moments[0, 0]) for _, moments in parts)
    held = sum(claims.held_count() - len(claims.disputed) for claims, _ in parts)
    return held - within >= CLUTTERED * held


def _fit(slab: Slab, parts: Sequence[_Part], widest_m: float) -> _Fit | None:
    """Least squares of the heights within three sigmas of the plane itself, in steps from the subsample's.

    That plane is right to a small fraction of a sigma, so that heights over it are distances. A step is what the mean
    of normal heights within a gate that stays tells (one step of an M-estimate, Bickel 1975).
    """
    claims = [part[0] for part in parts]
    sums = [part[1] for part in parts]
    near_enough = SMALL_STEP if _cluttered(parts) else LARGE_STEP
    lean: FloatArray = np.zeros(3)
    for _ in range(MOST_STEPS):
        moments = np.asarray(np.sum(sums, axis=0, dtype=np.float64))
        count = moments[0, 0]
        if count < FEWEST:
            return None
        plain = moments[np.ix_(_ON_PLANE, _ON_PLANE)]
        variances = np.linalg.eigvalsh(plain[1:, 1:] / count - np.outer(plain[0, 1:], plain[0, 1:]) / count**2)
        if not variances[0] > 0.0:
            return None
        step = np.linalg.solve(plain, moments[_ON_PLANE, 1] - plain @ lean) / FOLLOWED
        lean = lean + step
        limit = SMALL_STEP if count < FEW_POINTS else near_enough
        if step @ plain @ step < (limit * slab.sigma_m) ** 2:
            break
        sums = [claim.moments(slab, lean) for claim in claims]
    every = int(count) // SPREAD_POINTS + 1
    rest = np.concatenate([claim.some_rest(every, lean) for claim in claims])
    rest = rest[np.abs(rest) < GATE_SIGMAS * slab.sigma_m]
    sigma_m = min(max(mad_sigma(rest, centred=True), 0.5 * slab.sigma_m), widest_m)
    return _Fit(lean, sigma_m, variances)


def _rest(terms: Float32Array, lean: FloatArray) -> Float32Array:
    """Heights over the leant plane; not by BLAS, which would share out so short a product among all cores."""
    at, along_u, along_v = lean.astype(np.float32)
    rest: Float32Array = terms[2] * -along_u
    rest -= terms[3] * along_v
    rest -= at
    rest += terms[1]
    return rest


def _members(block: slice, parts: Sequence[_Part], fits: Sequence[_Fit | None]) -> list[IntArray]:
    """Indices of the points of a block within three sigmas of each plane; in seams the first plane takes them."""
    taken = np.zeros(block.stop - block.start, dtype=bool)
    members = []
    for (claims, _), fit in zip(parts, fits, strict=True):
        if fit is None:
            members.append(np.zeros(0, dtype=np.int64))
            continue
        mine = (np.abs(_rest(claims.terms, fit.lean)) < np.float32(GATE_SIGMAS * fit.sigma_m)) & claims.held
        disputed = claims.disputed[mine[claims.disputed]]
        places = claims.index[disputed]
        mine[disputed] = ~taken[places]
        taken[places] = True
        members.append(claims.index[mine] + block.start)
    return members


def _members_compiled(block: slice, parts: Sequence[_Part], fits: Sequence[_Fit | None]) -> list[IntArray]:
    """`_members` by kernels."""
    from lidarpose.detect.plane_kernels import members_of

    taken = np.zeros(block.stop - block.start, dtype=np.uint8)
    members = []
    for (claims, _), fit in zip(parts, fits, strict=True):
        if fit is None or not isinstance(claims, _Held):
            members.append(np.zeros(0, dtype=np.int64))
            continue
        lean, gate_m = fit.lean.astype(np.float32), np.float32(GATE_SIGMAS * fit.sigma_m)
        members.append(members_of(claims.index, *claims.along, claims.disputed, lean, gate_m, claims.first, taken))
    return members
