"""``lidarpose export``: a calibration for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from lidarpose.cli.options import FiniteFloat


def export(
    calibration: Path,
    /,
    *,
    to: Literal["ros2", "urdf", "kalibr", "opencv", "csv", "matrix"],
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    angle_deg: FiniteFloat | None = None,
    camera: Path | None = None,
    camera_frame: str = "camera_optical_frame",
    turntable_frame: str = "turntable",
    lidar_frame: str = "lidar",
    world_frame: str = "world",
) -> None:
    """Write a calibration for ROS 2, URDF, Kalibr, OpenCV, or as a table of poses.

    Parameters
    ----------
    calibration
        A calibration file.
    to
        ros2: a launch file; urdf: a robot description with the turntable as a joint; kalibr: a camchain;
        opencv: a FileStorage, XML if the output is named so, else YAML; csv: poses over angles; matrix:
        the pose in four lines of four numbers, for CloudCompare, Open3D and numpy.loadtxt.
    output
        The file to write.
    angle_deg
        The turntable's reading for which to write one pose. Without it: ros2 moves with the joint, csv has every
        degree of a turn, matrix holds the pose at 0, kalibr and opencv that and the two transforms that give all
        others.
    camera
        A camera file whose intrinsics go into kalibr and opencv.
    camera_frame
        The name of the camera's optical frame (x right, y down, z forward).
    turntable_frame
        The name of the turntable's frame.
    lidar_frame
        The name of the LiDAR's frame.
    world_frame
        The name of the world's frame.
    """
    import math

    from lidarpose.cli.console import err, out
    from lidarpose.errors import InputError
    from lidarpose.model.calibration import TurntableCalibration
    from lidarpose.storage.atomic import require_apart
    from lidarpose.storage.calibration import read_calibration
    from lidarpose.storage.camera_files import read_camera
    from lidarpose.storage.exports import ExportOptions, FrameNames, write_export

    require_apart(output, calibration, camera)
    loaded = read_calibration(calibration)
    scale = loaded.motion.reading_scale if isinstance(loaded, TurntableCalibration) else 1.0
    one_pose = to in ("ros2", "matrix") and angle_deg is not None
    if scale != 1.0 and to != "csv" and not one_pose:
        raise InputError(
            calibration,
            f"has readings that are off by a factor ({scale:.6g}); {to} knows none",
            expected="--to csv, or --to ros2 or matrix with --angle-deg for one pose",
        )
    if camera is not None and to not in ("kalibr", "opencv"):
        raise InputError("--camera", f"has no place in {to}", expected="--to kalibr or --to opencv")
    options = ExportOptions(
        angle_rad=None if angle_deg is None else math.radians(angle_deg),
        camera=None if camera is None else read_camera(camera),
        names=FrameNames(camera_frame, turntable_frame, lidar_frame, world_frame),
    )
    write_export(output, loaded, to, options)
    out().print(f"written: {output}", markup=False)
    if angle_deg is not None and (to == "urdf" or not isinstance(loaded, TurntableCalibration)):
        what = "a URDF's joint takes any reading" if isinstance(loaded, TurntableCalibration) else "it has no turntable"
        err().print(f"Note: --angle-deg changes nothing here: {what}.", markup=False)
    if loaded.quality is not None and loaded.quality.verdict != "good":
        reasons = "; ".join(loaded.quality.reasons)
        text = f"Note: the verdict on this calibration is {loaded.quality.verdict}"
        err().print(f"{text}: {reasons}" if reasons else f"{text}.", markup=False, soft_wrap=True)
