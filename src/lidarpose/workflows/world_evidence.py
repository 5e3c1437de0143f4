"""What a world calibration shows of itself: each place's faces, its own corner, and the corners of its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.calibration import WorldCalibration
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.model.corner_session import CornerSession
from lidarpose.model.world_run import WorldPlace, WorldRun
from lidarpose.refine.corner_model import CornerFit

# More points than this a face say nothing new to the eye.
MOST_POINTS_A_FACE = 2000


def joint_run(
    session: CornerSession,
    calibration: WorldCalibration,
    fit: CornerFit,
    used: Sequence[CornerPlaceFaces],
    by_frame: Mapping[str, FloatArray],
) -> WorldRun:
    """The run of the joint estimate.

    Parameters
    ----------
    used
        The places behind `fit`, without the frames that were left out.
    by_frame
        By position: the corner of each of its frames (F, 3), left out or not.
    """
    moves, _, known = fit.discrepancies
    own = fit.state.corners(fit.world) + np.where(known[:, None], moves[:, :3], 0.0)
    places = []
    for place, corner in zip(used, own, strict=True):
        corners = by_frame.get(place.position, np.zeros((0, 3)))
        kept = _has_returns(place)[: len(corners)]
        faces = {k: _points(returns) for k, returns in sorted(place.faces.items())}
        places.append(WorldPlace(place.position, place.corner_world, corner, faces, corners, kept))
    return WorldRun("joint", session, calibration, tuple(places), fit.state.normals)


def corners_run(
    session: CornerSession,
    calibration: WorldCalibration,
    method: str,
    corners: Mapping[str, tuple[FloatArray, FloatArray]],
) -> WorldRun:
    """The run of a method that knows corners alone: by position, the corner in the world and in the clouds' frame."""
    none = np.zeros((0, 3))
    places = [
        WorldPlace(position, world, corner, {}, none, np.zeros(0, dtype=bool))
        for position, (world, corner) in corners.items()
    ]
    return WorldRun(method, session, calibration, tuple(places))


def _has_returns(place: CornerPlaceFaces) -> BoolArray:
    """Which frames (F,) have any on the faces."""
    found = np.zeros(place.frames, dtype=bool)
    for returns in place.faces.values():
        found[returns.frame] = True
    return found


def _points(returns: FaceReturns) -> FloatArray:
    step = max(1, len(returns) // MOST_POINTS_A_FACE)
    return np.asarray(returns.directions[::step] * returns.range_m[::step, None])


def provenance(session: CornerSession, method: str) -> dict[str, Any]:
    """What of the session and the method goes into the calibration's record."""
    frames = sum(len(p.clouds) for p in session.places)
    return {
        "session": session.name,
        "method": method,
        "places": len(session.places),
        "frames": frames,
    }
