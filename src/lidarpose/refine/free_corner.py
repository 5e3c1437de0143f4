"""The corner of one place by itself: three planes, free of what other places say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.robust import mad_sigma
from lidarpose.model.corner_result import FaceReturns
from lidarpose.refine.face_systems import (
    MAX_STEPS,
    MIN_SIGMA_M,
    face_residuals,
    face_sums,
    solved,
    tangents,
    wide_enough,
    without_first,
)


@dataclass(frozen=True, eq=False)
class FreeCorner:
    """Three free planes at one place: corner (3,), normals (3, 3), range noise, information (3, 2, 2) of the tilts."""

    corner: FloatArray
    normals: FloatArray
    sigma_m: float
    tilt_information: FloatArray

    def turn_statistic(self, normals: FloatArray) -> tuple[float, float]:
        """How far other normals (3, 3) are: the largest tilt in radians, and a chi-square of six degrees of freedom."""
        total, worst = 0.0, 0.0
        for own, other, information in zip(self.normals, normals, self.tilt_information, strict=True):
            tilt = tangents(own).T @ (other - own)
            worst = max(worst, float(np.linalg.norm(tilt)))
            total += float(tilt @ information @ tilt)
        return worst, total


def fit_corner(
    faces: Mapping[int, FaceReturns],
    normals: FloatArray,
    corner: FloatArray,
    sigma_m: float,
    *,
    tolerance_m: float = 1e-7,
) -> FreeCorner:
    """Three free planes through one place's returns.

    Parameters
    ----------
    faces
        Returns of all three faces.
    normals, corner, sigma_m
        Where to start.
    tolerance_m
        The last step of the corner.

    Raises
    ------
    UndeterminedError
        If a face's returns do not determine its plane.
    """
    first = [face_residuals(faces[j], normals[j], corner) for j in range(3)]
    sigma_m = wide_enough(sigma_m, first)
    for _ in range(MAX_STEPS):
        residuals, moves, tilts = [], [], []
        for j in range(3):
            sums = face_sums(faces[j], normals[j], corner, sigma_m)
            residuals.append(sums.residual)
            tilts.append(without_first(sums.system.information))
            moves.append(solved(sums.system.information, sums.system.gradient, f"face {j + 1} of the target"))
        tilted = np.stack([unit(n + tangents(n) @ m[1:]) for n, m in zip(normals, moves, strict=True)])
        shift = np.linalg.solve(tilted, [m[0] for m in moves])
        normals, corner = tilted, corner + shift
        sigma_m = max(mad_sigma(np.concatenate(residuals), centred=True), MIN_SIGMA_M)
        if np.linalg.norm(shift) < tolerance_m:
            break
    return FreeCorner(corner, normals, sigma_m, np.stack(tilts))
