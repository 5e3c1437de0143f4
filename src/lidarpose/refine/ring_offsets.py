"""What single beams of a multi-beam LiDAR measure too far or too near: a random effect a ring, estimated with the pose.

The ranges of one ring err together, at all places and in all frames, by millimetres that no averaging removes. Each
ring meets several faces at several places; what its returns are off by there, once the faces are where they are, tells
its offset. How large offsets are, their standard deviation, is estimated from the data by restricted maximum
likelihood (Patterson and Thompson 1971): where nothing speaks for them it is zero and nothing changes, and what the
data do not tell of a ring shrinks to zero and stays in the covariance of the pose, such as an offset that all share.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.rings import ring_numbers
from lidarpose.geometry.robust import median
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.corner_model import CornerFit, face_jacobians, joint_information
from lidarpose.refine.face_systems import MIN_RETURNS, FaceSystem, weighted_rows

# Twice the gain in log likelihood from which offsets are believed in: chance reaches it once in a thousand times.
CONVINCING_GAIN = 9.0
# Returns from which it is found out whether rings are off at all.
FEW_RETURNS = 20_000
# Rings told apart by elevation belong to one LiDAR if the typical one is seen by so many returns.
RING_RETURNS = 8


@dataclass(frozen=True, eq=False)
class Rings:
    """The ring of each return, by (place, face), and each ring's mean elevation (K,)."""

    numbers: dict[tuple[int, int], IntArray]
    elevation_rad: FloatArray


@dataclass(frozen=True, eq=False)
class RingOffsets:
    """What rings are off by.

    Attributes
    ----------
    offset_m : (K,)
        Measured minus true range, as far as the data tell: shrunk towards zero.
    sigma_m
        Their standard deviation in the instrument.
    gain
        Twice the log likelihood that they gain.
    covariance : (n, n)
        Of the joint estimate's parameters, offsets unknown, before it is widened by what spots err together.
    told
        Of how many offsets the data tell, in degrees of freedom.
    """

    rings: Rings
    offset_m: FloatArray
    sigma_m: float
    gain: float
    covariance: FloatArray
    told: float

    @property
    def figures(self) -> dict[str, Any]:
        """For the calibration file: the standard deviation, and each ring's offset by its elevation in degrees."""
        by_ring = zip(np.degrees(self.rings.elevation_rad), self.offset_m, strict=True)
        return {
            "ring_sigma_mm": 1e3 * self.sigma_m,
            "ring_offsets_mm": {f"{elevation:.2f}": round(1e3 * float(off), 2) for elevation, off in by_ring},
        }

    def corrected(self, places: Sequence[CornerPlaceFaces]) -> list[CornerPlaceFaces]:
        """The places with true ranges in place of measured ones."""
        return [
            replace(p, faces={j: self._corrected(f, self.rings.numbers.get((i, j))) for j, f in p.faces.items()})
            for i, p in enumerate(places)
        ]

    def _corrected(self, returns: FaceReturns, ring: IntArray | None) -> FaceReturns:
        return returns if ring is None else replace(returns, range_m=returns.range_m - self.offset_m[ring])


def find_rings(places: Sequence[CornerPlaceFaces]) -> Rings | None:
    """The rings that the faces' returns are of; None where directions come in no rings."""
    keys = [(i, j) for i, p in enumerate(places) for j, f in sorted(p.faces.items()) if len(f) >= MIN_RETURNS]
    if not keys:
        return None
    directions = np.concatenate([places[i].faces[j].directions for i, j in keys])
    ring = ring_numbers(directions)
    if ring is None:
        return None
    count = np.bincount(ring)
    if median(count.astype(np.float64)) < RING_RETURNS:
        return None
    elevation = np.arcsin(np.clip(np.bincount(ring, directions[:, 2]) / count, -1.0, 1.0))
    ends = np.cumsum([len(places[i].faces[j]) for i, j in keys])
    return Rings(dict(zip(keys, np.split(ring, ends[:-1]), strict=True)), elevation)


@dataclass(frozen=True, eq=False)
class RingEquations:
    """Normal equations of the estimate's parameters (n) and the offsets (K): blocks of the information, gradients.

    `weighted` are the `weighted_rows` that they are of, and `jacobians` the faces', by (place, face).
    """

    parameters: FloatArray
    cross: FloatArray
    rings: FloatArray
    pull: FloatArray
    ring_pull: FloatArray
    weighted: Mapping[tuple[int, int], tuple[FloatArray, FloatArray, FloatArray]]
    jacobians: Mapping[tuple[int, int], FloatArray]

    @property
    def determined(self) -> bool:
        """Whether the returns that are in rings tell all parameters by themselves: faces of few returns are not."""
        scale = np.sqrt(np.diag(self.parameters))
        if not scale.min() > 0.0:
            return False
        return bool(np.linalg.eigvalsh(self.parameters / np.outer(scale, scale))[0] > 1e-12)

    def reduced(self) -> tuple[FloatArray, FloatArray]:
        """Information (K, K) and gradient (K,) of the offsets, the parameters being free."""
        solved = np.linalg.solve(self.parameters, np.column_stack([self.cross, self.pull]))
        information = np.diag(self.rings) - self.cross.T @ solved[:, :-1]
        return 0.5 * (information + information.T), self.ring_pull - self.cross.T @ solved[:, -1]


def ring_equations(fit: CornerFit, places: Sequence[CornerPlaceFaces], rings: Rings) -> RingEquations:
    """Of a joint estimate beside offsets of all rings, at the estimate."""
    count = len(rings.elevation_rad)
    own, ring_pull, systems, crossed, seen = np.zeros(count), np.zeros(count), {}, {}, {}
    corners = fit.state.corners(fit.world)
    for (i, j), ring in rings.numbers.items():
        seen[i, j] = weighted_rows(places[i].faces[j], fit.state.normals[j], corners[i], fit.range_sigma_m)
        residual, rows, weight = seen[i, j]
        weighted = rows * weight
        systems[i, j] = FaceSystem(weighted @ rows.T, weighted @ residual)
        crossed[i, j] = np.stack([np.bincount(ring, row, count) for row in weighted])
        own += np.bincount(ring, weight, count)
        ring_pull += np.bincount(ring, weight * residual, count)
    parameters, pull = joint_information(fit, systems)
    cross = np.zeros((len(pull), count))
    jacobians = face_jacobians(list(systems), fit.state, fit.world, fit.options)
    for key, jacobian in jacobians.items():
        cross += jacobian.T @ crossed[key]
    return RingEquations(parameters, cross, own, pull, ring_pull, seen, jacobians)


def _estimate_sigma(information: FloatArray, gradient: FloatArray) -> tuple[float, float]:
    """The offsets' standard deviation by restricted maximum likelihood, and twice the gain in log likelihood."""
    values, vectors = np.linalg.eigh(information)
    values, along = np.maximum(values, 0.0), (vectors.T @ gradient) ** 2
    grid = np.geomspace(1e-5, 0.1, 81) ** 2
    grown = 1.0 + grid[:, None] * values
    gains = (grid[:, None] * along / grown - np.log(grown)).sum(axis=1)
    best = int(np.argmax(gains))
    return float(np.sqrt(grid[best])), float(gains[best])


def ring_offsets(
    fit: CornerFit,
    places: Sequence[CornerPlaceFaces],
    rings: Rings,
    before: FloatArray | None = None,
    common_error: float = 1.0,
    equations: RingEquations | None = None,
) -> RingOffsets | None:
    """Estimate the offsets of all rings beside a joint estimate.

    Parameters
    ----------
    fit, places
        The joint estimate, and the returns that it stands on.
    rings
        Of these returns.
    before : (K,)
        Offsets that the places' ranges are already free of.
    common_error
        By how much spots' means scatter more than the noise allows, in squares, offsets apart.
    equations
        `ring_equations` of all these, where they are known.

    Returns
    -------
    The offsets; None where nothing speaks for any.
    """
    equations = equations or ring_equations(fit, places, rings)
    if not equations.determined:
        return None
    information, gradient = equations.reduced()
    if before is not None:
        gradient = gradient + information @ before
    sigma_m, gain = _estimate_sigma(information / common_error, gradient / common_error)
    if gain < CONVINCING_GAIN:
        return None
    prior = common_error / sigma_m**2 * np.eye(len(gradient))
    offset = np.linalg.solve(information + prior, gradient)
    taken = np.linalg.solve(np.diag(equations.rings) + prior, equations.cross.T)
    covariance = np.linalg.inv(equations.parameters - equations.cross @ taken) * fit.loss_factor
    told = float(np.trace(np.linalg.solve(information + prior, information)))
    return RingOffsets(rings, offset, sigma_m, gain, covariance, told)


def some_returns(places: Sequence[CornerPlaceFaces]) -> list[CornerPlaceFaces]:
    """The places with some thousand of their returns."""
    total = sum(len(f) for p in places for f in p.faces.values())
    step = max(total // FEW_RETURNS, 1)
    return [replace(p, faces={j: _every(f, step) for j, f in p.faces.items()}) for p in places]


def _every(returns: FaceReturns, step: int) -> FaceReturns:
    rays, range_m, frame = returns.rays[:, ::step], returns.range_m[::step], returns.frame[::step]
    return FaceReturns(np.ascontiguousarray(rays).T, np.ascontiguousarray(range_m), np.ascontiguousarray(frame))
