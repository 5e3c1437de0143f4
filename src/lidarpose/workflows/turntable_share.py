"""What the turntable's calibration adds to the covariance of world <- camera, where recordings stand for clouds.

An error of the calibration bends all clouds alike, so that neither residuals nor more places or frames tell of it. Each
parameter moves each point of a cloud by what `measure.point_sigma` knows; that changes the point's residual by as much
along the beam as its face is met off, and the estimate by what its normal equations make of that, to first order.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.model.corner_session import CornerSession
from lidarpose.refine.corner_model import CornerFit, face_jacobians, joint_information
from lidarpose.refine.face_systems import weighted_rows
from lidarpose.workflows.recorded_corners import ScannedCloud

# Shifts are smooth over a face.
MOST_RETURNS = 400


@dataclass(frozen=True, eq=False)
class TurntableShare:
    """By how much the estimate's parameters move with the turntable's.

    Attributes
    ----------
    sensitivity : (n, p)
        Derivative of the estimate's parameters by those of the calibration that move points.
    covariance : (n, n)
        What the calibration's covariance makes of that.
    """

    sensitivity: FloatArray
    covariance: FloatArray


def turntable_share(
    session: CornerSession, fit: CornerFit, places: Sequence[CornerPlaceFaces]
) -> TurntableShare | None:
    """The share of the turntable's calibration; None where clouds are no recordings, or its covariance is not known.

    Parameters
    ----------
    session
        With scanned clouds in place of recordings.
    fit, places
        The joint estimate, and the returns that it stands on.
    """
    clouds = {p.position: p.clouds for p in session.places}
    information, _ = joint_information(fit, fit.systems)
    jacobians = face_jacobians(list(fit.systems), fit.state, fit.world, fit.options)
    corners = fit.state.corners(fit.world)
    pull, C = None, None
    for i, place in enumerate(places):
        frame = min((int(f.frame.min()) for f in place.faces.values() if len(f)), default=0)
        cloud = clouds[place.position][frame]
        if not isinstance(cloud, ScannedCloud) or (C := cloud.parameter_covariance) is None:
            return None
        shifts = cloud.shifts()
        for j, returns in place.faces.items():
            if (i, j) not in fit.systems:
                continue
            own = _of_frame(returns, frame)
            by_parameters = _face_pull(own, fit.state.normals[j], corners[i], fit.range_sigma_m, shifts)
            weight = len(returns) / len(own) / fit.variance.get((i, j), 1.0)
            share = jacobians[i, j].T @ (weight * by_parameters)
            pull = share if pull is None else pull + share
    if pull is None or C is None:
        return None
    sensitivity = np.linalg.solve(information, pull)
    return TurntableShare(sensitivity, sensitivity @ C @ sensitivity.T)


def _of_frame(returns: FaceReturns, frame: int) -> FaceReturns:
    """A face's returns of one frame, not too many; of all frames where that one shows none of it."""
    mine = np.flatnonzero(returns.frame == frame)
    if len(mine) == 0:
        mine = np.arange(len(returns))
    return returns.subset(mine[:: max(len(mine) // MOST_RETURNS, 1)])


def _face_pull(
    returns: FaceReturns,
    normal: FloatArray,
    corner: FloatArray,
    sigma_m: float,
    shifts: Callable[[FloatArray], FloatArray],
) -> FloatArray:
    """Derivative (3, p) of a face's pull on its plane's shift and tilts by the calibration's parameters."""
    _, rows, weight = weighted_rows(returns, normal, corner, sigma_m)
    moved = shifts(returns.directions * returns.range_m[:, None])
    along = np.einsum("nkp,k->np", moved, normal) / (normal @ returns.rays)[:, None]
    return np.asarray((rows * weight) @ along)
