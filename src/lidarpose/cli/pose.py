"""``lidarpose pose``: the LiDAR's pose at a turntable angle."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from lidarpose.cli.console import out, print_json
from lidarpose.cli.options import FiniteFloat, Json

if TYPE_CHECKING:
    from lidarpose.geometry.se3 import Pose, UncertainPose


def pose(
    calibration: Path,
    /,
    *,
    angle_deg: Annotated[FiniteFloat, Parameter(help="The turntable's reading, in degrees.")],
    json: Json = False,
) -> None:
    """Print T_camera_lidar at an angle of the turntable, with its standard deviations.

    The pose maps points from the LiDAR's frame to the camera's: p_camera = T_camera_lidar @ p_lidar.

    Parameters
    ----------
    calibration
        A turntable calibration file.
    """
    import numpy as np

    from lidarpose.storage.calibration import read_turntable_calibration

    loaded = read_turntable_calibration(calibration)
    at_angle = loaded.pose(float(np.deg2rad(angle_deg)))
    uncertain = loaded.uncertain_pose(float(np.deg2rad(angle_deg)))
    if json:
        print_json(_document(angle_deg, at_angle, uncertain))
    else:
        _print_table(angle_deg, at_angle, uncertain)


def _sigmas(uncertain: UncertainPose) -> tuple[list[float], list[float]]:
    """Standard deviations of the LiDAR's centre in mm, and of its orientation in degrees, along the camera's axes."""
    import numpy as np

    centre = np.sqrt(np.diag(uncertain.centre_covariance()))
    rotation = np.sqrt(np.diag(uncertain.rotation_covariance()))
    return (1e3 * centre).tolist(), np.rad2deg(rotation).tolist()


def _document(angle_deg: float, at_angle: Pose, uncertain: UncertainPose | None) -> dict[str, Any]:
    document: dict[str, Any] = {"angle_deg": angle_deg, "matrix": at_angle.matrix.tolist()}
    if uncertain is None:
        return {**document, "covariance": None, "sigma_translation_mm": None, "sigma_rotation_deg": None}
    translation_mm, rotation_deg = _sigmas(uncertain)
    return {
        **document,
        "covariance": uncertain.covariance.tolist(),
        "sigma_translation_mm": translation_mm,
        "sigma_rotation_deg": rotation_deg,
    }


def _print_table(angle_deg: float, at_angle: Pose, uncertain: UncertainPose | None) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(box=SIMPLE_HEAD, title=f"T_camera_lidar at {angle_deg:g} degrees", title_justify="left")
    columns = ("", "x axis", "y axis", "z axis", "centre mm") + (() if uncertain is None else ("± mm", "± deg"))
    for column in columns:
        table.add_column(column, justify="right")
    for k, name in enumerate(("camera x", "camera y", "camera z")):
        cells = [name, *(f"{value:+.5f}" for value in at_angle.rotation[k]), f"{1e3 * at_angle.translation[k]:.3f}"]
        if uncertain is not None:
            translation_mm, rotation_deg = _sigmas(uncertain)
            cells += [f"{translation_mm[k]:.3f}", f"{rotation_deg[k]:.4f}"]
        table.add_row(*cells)
    out().print(table)
    quaternion = " ".join(f"{value:.7f}" for value in at_angle.quaternion_xyzw)
    out().print(
        "p_camera = T_camera_lidar p_lidar. Columns: the LiDAR's axes and centre, seen from the camera (x right, y "
        f"down, z forward). Quaternion x y z w: {quaternion}"
    )
    if uncertain is None:
        out().print("The calibration file holds no covariance: how sure this is, is not known.")
