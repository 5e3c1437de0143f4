"""In which sense beams and table turn, in words that a person can check by looking at the rig.

A scan whose beams are written the other way round is, to every estimate, a LiDAR mounted upside down; readings of the
other sign are an axis that points the other way. The answer holds for the files as they are written; nothing in them
tells how the rig really turns. So it is said.
"""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.turntable import TurntableMotion

_VIEWS = (("from the camera", np.array([0.0, 0.0, -1.0])), ("from above the image", np.array([0.0, -1.0, 0.0])))
_SIDE = ("from the right of the image", np.array([1.0, 0.0, 0.0]))


def turning_sense(motion: TurntableMotion, turntable_angle_rad: float) -> str:
    """How growing beam angles and growing readings turn, each seen from where it is plainest."""
    beams = _as_seen(motion.pose(turntable_angle_rad).rotation[:, 2])
    table = _as_seen(motion.axis_direction_camera)
    return (
        f"As the files have it, growing beam angles turn {beams}, and growing readings turn {table}. If the rig turns "
        "otherwise, angles are written with the other sign; the result then holds for files written the same way only."
    )


def _as_seen(axis_camera: FloatArray) -> str:
    """The sense of a right-handed turn about an axis, seen along the camera axis that it is nearest to."""
    where, towards = max((*_VIEWS, _SIDE), key=lambda view: abs(float(view[1] @ axis_camera)))
    return f"{'anticlockwise' if float(towards @ axis_camera) > 0.0 else 'clockwise'} seen {where}"
