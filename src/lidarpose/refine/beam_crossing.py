"""Whether the beams of a multi-beam LiDAR seem to cross before its axis, which the clouds leave out.

Such a beam leaves the axis ``crossing * tan(elevation)`` below where the cloud has it start, at any distance. It is
one more parameter beside the joint estimate, and beside offsets of all rings, which would otherwise pass for it: one
linear step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.rings import tangent_of_elevation
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.corner_model import CornerFit
from lidarpose.refine.ring_offsets import RingEquations, Rings, ring_equations

# So many standard deviations are no chance; what edges and mixed pixels do to faces passes for some millimetres.
SEEN_SIGMAS = 3.5
LEAST_M = 0.01
# A VLP-16's, by its manual, and how well its elevations are nominal in the clouds that its drivers make.
MAKERS_CROSSING_M = 0.0419
_SAME_DEG = 0.03
# Of rings that are not off: what single precision leaves.
_LEAST_RING_SIGMA_M = 1e-5


@dataclass(frozen=True, eq=False)
class SeenCrossing:
    """Where beams seem to cross before the axis, beyond what the clouds hold already.

    Attributes
    ----------
    crossing_m, sigma_m
        The distance, and its standard deviation.
    by_metre : (n,)
        What the joint estimate's parameters change by, for each metre of it.
    freedom
        Degrees of freedom that the standard deviation rests on, where the world's noise was estimated with it.
    """

    crossing_m: float
    sigma_m: float
    by_metre: FloatArray
    freedom: float = np.inf

    @property
    def move(self) -> FloatArray:
        """What the joint estimate's parameters (n,) would change by."""
        return np.asarray(self.crossing_m * self.by_metre)

    @property
    def told(self) -> bool:
        """Whether the data speak for it."""
        return abs(self.crossing_m) > max(_student(self.freedom) * self.sigma_m, LEAST_M)

    @property
    def makers_chance(self) -> float:
        """How likely the distance is `MAKERS_CROSSING_M` and not zero, if either is, and beforehand as likely."""

        def twice_log_likelihood(far_m: float) -> float:
            square = ((self.crossing_m - far_m) / self.sigma_m) ** 2
            return -square if np.isinf(self.freedom) else -(self.freedom + 1.0) * np.log1p(square / self.freedom)

        gain = twice_log_likelihood(MAKERS_CROSSING_M) - twice_log_likelihood(0.0)
        return float(1.0 / (1.0 + np.exp(np.clip(-0.5 * gain, -700.0, 700.0))))


@dataclass(frozen=True, eq=False)
class OpenCrossing:
    """A crossing that the LiDAR's maker states, and of which the data do not tell whether the clouds hold it.

    Attributes
    ----------
    chance
        That they do not.
    move : (n,)
        What the joint estimate's parameters are then off by.
    """

    chance: float
    move: FloatArray

    @property
    def covariance(self) -> FloatArray:
        """Mean square (n, n) of that."""
        return np.asarray(self.chance * np.outer(self.move, self.move))


def open_crossing(seen: SeenCrossing, rings: Rings) -> OpenCrossing | None:
    """What a VLP-16's crossing may do to the estimate; None for another LiDAR, where nothing is known of any."""
    if seen.told or not _are_a_vlp16s(rings):
        return None
    return OpenCrossing(seen.makers_chance, np.asarray(MAKERS_CROSSING_M * seen.by_metre))


def _are_a_vlp16s(rings: Rings) -> bool:
    """Whether all beams rise by odd degrees, as seen from the origin: where clouds hold the crossing, they do not."""
    elevation_deg = np.degrees(rings.elevation_rad)
    odd = 2.0 * np.round((elevation_deg - 1.0) / 2.0) + 1.0
    return bool(np.all(np.abs(elevation_deg - odd) < _SAME_DEG) and np.all(np.abs(elevation_deg) < 16.0))


def _student(freedom: float) -> float:
    """As improbable with so many degrees of freedom as `SEEN_SIGMAS` with any number (Wallace, Biometrika 46, 1959)."""
    if not np.isfinite(freedom):
        return SEEN_SIGMAS
    if freedom < 1.0:
        return float("inf")
    shrunk = SEEN_SIGMAS * (8.0 * freedom + 3.0) / (8.0 * freedom + 1.0)
    return float(np.sqrt(freedom * np.expm1(shrunk**2 / freedom)))


def without_crossing(places: Sequence[CornerPlaceFaces], fit: CornerFit, crossing_m: float) -> list[CornerPlaceFaces]:
    """The places with the ranges that their beams would have from the origin."""
    return [
        replace(
            p,
            faces={
                j: replace(f, range_m=f.range_m - crossing_m * _by_crossing(f, fit.state.normals[j]))
                for j, f in p.faces.items()
            },
        )
        for p in places
    ]


def _by_crossing(returns: FaceReturns, normal: FloatArray) -> FloatArray:
    """A beam starts lower by crossing * tan(elevation), and meets the face so much later."""
    return np.asarray(tangent_of_elevation(returns.directions) * normal[2] / (returns.directions @ normal))


def seen_crossing(
    fit: CornerFit,
    places: Sequence[CornerPlaceFaces],
    rings: Rings,
    ring_sigma_m: float,
    common_error: float,
    equations: RingEquations | None = None,
) -> SeenCrossing | None:
    """One linear step for the crossing.

    Parameters
    ----------
    fit, places, rings
        A joint estimate, and returns with their rings; their ranges as measured.
    ring_sigma_m
        Standard deviation of the rings' offsets, 0 where they have none.
    common_error
        By how much spots' means scatter more than the noise allows, in squares.
    equations
        `ring_equations` of the first three, where they are known.

    Returns
    -------
    The crossing; None where the faces do not tell it.
    """
    equations = equations or ring_equations(fit, places, rings)
    if not equations.determined:
        return None
    count, n = len(rings.elevation_rad), len(equations.pull)
    own, pull, crossed = 0.0, 0.0, np.zeros(n + count)
    for (i, j), ring in rings.numbers.items():
        returns, normal = places[i].faces[j], fit.state.normals[j]
        residual, rows, weight = equations.weighted[i, j]
        by = _by_crossing(returns, normal)
        own += float(weight @ by**2)
        pull += float(weight @ (by * residual))
        crossed[:n] += equations.jacobians[i, j].T @ (rows @ (weight * by))
        crossed[n:] += np.bincount(ring, weight * by, count)
    prior = common_error / max(ring_sigma_m, _LEAST_RING_SIGMA_M) ** 2
    others = np.block([[equations.parameters, equations.cross], [equations.cross.T, np.diag(equations.rings + prior)]])
    along = np.linalg.solve(others, crossed)
    left = own - float(along @ crossed)
    if not left > 1e-9 * own:
        return None
    crossing = (pull - float(along @ np.concatenate([equations.pull, equations.ring_pull]))) / left
    return SeenCrossing(crossing, float(np.sqrt(common_error / left)), -along[:n])
