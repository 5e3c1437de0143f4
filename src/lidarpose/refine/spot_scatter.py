"""By how much returns of one spot err together, frame after frame: at grazing angles, and everywhere.

A beam that meets a face at a grazing angle is spread over it: what it returns is of any part of that, centimetres
apart, and the same part in every frame. How wide beams are in that sense is a variance component, by how much farther
the means of spots scatter on faces that are seen at such angles (maximum likelihood of scaled chi-squares); faces
are weighed by it, and where nothing speaks for it nothing changes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.compiled import pays
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.corner_model import CornerFit, face_jacobians, reweighted
from lidarpose.refine.direction_cells import DirectionGrid
from lidarpose.refine.face_systems import SAVED_S_PER_RETURN, face_residuals

CELL_RAD = np.radians(1.5)
# Beams that are wider than this in standard deviations are no beams, and narrower ones do nothing.
NARROWEST_RAD, WIDEST_RAD = 1e-4, 5e-3
# Twice the gain in log likelihood at which one more parameter pays for itself (Akaike 1974).
GAIN = 2.0


@dataclass(frozen=True)
class SpotScatter:
    """One face at one place: the sum of its spots' squared means over their variance by the noise, and how many."""

    total: float
    spots: int


def spot_scatter(fit: CornerFit, places: Sequence[CornerPlaceFaces]) -> dict[tuple[int, int], SpotScatter]:
    """By (place, face): the mean residual of each cell of 1.5 degrees, which should scatter as the range noise over its
    number of returns."""
    corners = fit.state.corners(fit.world)
    found = {}
    for i, place in enumerate(places):
        for j, returns in place.faces.items():
            squares, spots = _spots_off(returns, fit.state.normals[j], corners[i], 4.0 * fit.range_sigma_m)
            found[i, j] = SpotScatter(squares / fit.range_sigma_m**2, spots)
    return found


def _spots_off(returns: FaceReturns, normal: FloatArray, corner: FloatArray, most_m: float) -> tuple[float, int]:
    """The sum over cells of squared mean residuals times their number, of those below `most_m`; and how many cells."""
    if pays(2.0 * SAVED_S_PER_RETURN * len(returns), "refine.corner_kernels"):
        from lidarpose.refine.corner_kernels import spots_off

        range_m = np.ascontiguousarray(returns.range_m, dtype=np.float64)
        squares, spots = spots_off(returns.rays, range_m, normal, float(normal @ corner), 2.0 / CELL_RAD, most_m)
        return float(squares), int(spots)
    residual = face_residuals(returns, normal, corner)
    keep = np.flatnonzero(np.abs(residual) < most_m)
    # None: a place whose world coordinates are off by decimetres may stand by itself.
    cell = DirectionGrid.of(returns.rays, CELL_RAD).cell.take(keep)
    count = np.bincount(cell)
    total = np.bincount(cell, residual.take(keep))
    return float((total**2 / np.maximum(count, 1)).sum()), int(np.count_nonzero(count))


def common_error_factor(
    fit: CornerFit,
    places: Sequence[CornerPlaceFaces],
    rings_told: float = 0.0,
    scatter: Mapping[tuple[int, int], SpotScatter] | None = None,
) -> float:
    """How much wider the covariance has to be because returns of one spot err together, frame after frame.

    Faces that are not flat and beams with offsets of their own make spots scatter more than the noise does.

    Parameters
    ----------
    rings_told
        The degrees of freedom that offsets of rings have taken from the residuals.
    scatter
        Of these places, where it is known.
    """
    scatter = spot_scatter(fit, places) if scatter is None else scatter
    total = sum(s.total / fit.variance.get(key, 1.0) for key, s in scatter.items())
    dof = max(sum(s.spots for s in scatter.values()) - rings_told - 3.0 * len(scatter), 1.0)
    ratio = total / dof
    # Chance alone reaches one plus a few standard deviations of a chi-square over its degrees of freedom.
    return float(ratio) if ratio > 1.0 + 4.0 * np.sqrt(2.0 / dof) else 1.0


def weighed_by_angle(
    fit: CornerFit, places: Sequence[CornerPlaceFaces], scatter: Mapping[tuple[int, int], SpotScatter]
) -> CornerFit:
    """The estimate with faces that are met at grazing angles weighed by what their spots err together.

    Parameters
    ----------
    fit, places, scatter
        The joint estimate, the returns that it stands on, and `spot_scatter` of both.
    """
    keys = [key for key in fit.systems if key in scatter]
    corners = fit.state.corners(fit.world)
    spread = np.array([_spread_m2(places[i].faces[j], fit.state.normals[j], corners[i]) for i, j in keys])
    spread *= np.array([places[i].frames for i, _ in keys]) / fit.range_sigma_m**2
    total = np.array([scatter[key].total for key in keys])
    dof = np.maximum([scatter[key].spots for key in keys] - _taken(fit, keys), 1.0)
    width = np.geomspace(NARROWEST_RAD, WIDEST_RAD, 60)
    variance = 1.0 + width[:, None] ** 2 * spread
    gains = total.sum() - (total / variance).sum(axis=1) - np.log(variance) @ dof
    best = int(np.argmax(gains))
    if gains[best] < GAIN:
        return fit
    return reweighted(fit, dict(zip(keys, variance[best].tolist(), strict=True)))


def _spread_m2(returns: FaceReturns, normal: FloatArray, corner: FloatArray) -> float:
    """Mean square of how far a beam's range changes over a face as its direction turns by one radian."""
    few = returns.rays[:, :: max(len(returns) // 100, 1)]
    cosine = normal @ few
    return float((((normal @ corner) / cosine) ** 2 * (1.0 / cosine**2 - 1.0)).mean())


def _taken(fit: CornerFit, keys: Sequence[tuple[int, int]]) -> FloatArray:
    """Degrees of freedom that the estimate takes of each face's residuals."""
    covariance = fit.covariance / fit.loss_factor
    jacobians = face_jacobians(keys, fit.state, fit.world, fit.options)
    return np.array([np.trace(fit.systems[k].information @ jacobians[k] @ covariance @ jacobians[k].T) for k in keys])
