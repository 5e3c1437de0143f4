"""The pose as sixteen numbers in four lines: what CloudCompare's "Apply transformation" and numpy.loadtxt read.

CloudCompare takes no comment in such a file; the direction is that of every pose here, p_parent = T p_child.
"""

from __future__ import annotations

from lidarpose.model.calibration import Calibration, TurntableCalibration
from lidarpose.storage.exports.common import ExportOptions, camera_pose, numbers


def text(calibration: Calibration, options: ExportOptions) -> str:
    """T_camera_lidar at a reading (0 unless given), or T_world_source with the scale in its first three columns."""
    if isinstance(calibration, TurntableCalibration):
        matrix = camera_pose(calibration, options)[1].matrix
    else:
        matrix = calibration.T_world_source.matrix.copy()
        matrix[:3, :3] *= calibration.scale
    return "".join(f"{numbers(row)}\n" for row in matrix)
