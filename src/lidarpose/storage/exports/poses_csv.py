"""CSV: a table of poses over angles, for spreadsheets and scripts."""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.se3 import Pose, UncertainPose
from lidarpose.model.calibration import Calibration, TurntableCalibration
from lidarpose.storage.exports.common import ExportOptions, number

_POSE = "x_m,y_m,z_m,qx,qy,qz,qw"
_SIGMA = "sigma_x_m,sigma_y_m,sigma_z_m,sigma_rx_rad,sigma_ry_rad,sigma_rz_rad"


def text(calibration: Calibration, options: ExportOptions) -> str:
    """One pose a line, with standard deviations where the calibration knows them."""
    if isinstance(calibration, TurntableCalibration):
        return _turntable(calibration, options)
    T, source = calibration.T_world_source, calibration.source
    uncertain = None if calibration.covariance is None else UncertainPose(T, calibration.covariance)
    header = f"# p_world = scale R(q) p_{source} + (x, y, z). Metres; quaternion x y z w.\n"
    columns = f"scale,{_POSE}" + (f",{_SIGMA}" if uncertain else "") + "\n"
    return header + columns + ",".join([number(calibration.scale), *_cells(T, uncertain)]) + "\n"


def _turntable(calibration: TurntableCalibration, options: ExportOptions) -> str:
    angles = options.angles_rad if options.angle_rad is None else (options.angle_rad,)
    known = calibration.motion_covariance is not None
    lines = [
        "# p_camera = R(q) p_lidar + (x, y, z) at each reading of the turntable. Metres; quaternion x y z w;",
        "# camera is the optical frame (x right, y down, z forward); sigmas along and about its axes.",
        f"angle_deg,{_POSE}" + (f",{_SIGMA}" if known else ""),
    ]
    for angle in angles:
        cells = _cells(calibration.pose(angle), calibration.uncertain_pose(angle))
        lines.append(",".join([number(np.rad2deg(angle)), *cells]))
    return "\n".join(lines) + "\n"


def _cells(pose: Pose, uncertain: UncertainPose | None) -> list[str]:
    values = [*pose.translation, *pose.quaternion_xyzw]
    if uncertain is not None:
        values += [*np.sqrt(np.diag(uncertain.centre_covariance()))]
        values += [*np.sqrt(np.diag(uncertain.rotation_covariance()))]
    return [number(value) for value in values]
