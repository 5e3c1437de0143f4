"""Calibrations for other programs: ROS 2, URDF, Kalibr, OpenCV, CSV, a bare matrix.

Each file but the matrix states its direction in a comment.

Numbers have all the digits of a double, so that what another program computes from a file agrees with `pose`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from lidarpose.errors import InputError
from lidarpose.model.calibration import Calibration
from lidarpose.storage.atomic import write_text
from lidarpose.storage.exports import kalibr, matrix, opencv, poses_csv, ros2, urdf
from lidarpose.storage.exports.common import ExportOptions, FrameNames

_TEXTS: dict[str, Callable[[Calibration, ExportOptions], str]] = {
    "ros2": ros2.text,
    "urdf": urdf.text,
    "kalibr": kalibr.text,
    "opencv": opencv.text,
    "csv": poses_csv.text,
    "matrix": matrix.text,
}
EXPORT_FORMATS = tuple(_TEXTS)
"""What `export_text` knows."""

__all__ = ["EXPORT_FORMATS", "ExportOptions", "FrameNames", "export_text", "write_export"]


def export_text(calibration: Calibration, to: str, options: ExportOptions | None = None) -> str:
    """The file's text in the format `to`, one of `EXPORT_FORMATS`.

    Raises
    ------
    InputError
        If there is no such format, or it cannot hold this calibration (a scale other than 1, a camera that is not
        there).
    """
    if to not in _TEXTS:
        raise InputError("--to", f"is {to!r}", expected=" or ".join(EXPORT_FORMATS))
    return _TEXTS[to](calibration, options or ExportOptions())


def write_export(path: Path, calibration: Calibration, to: str, options: ExportOptions | None = None) -> None:
    """Write `export_text` to a file, whole or not at all. OpenCV's is XML where the suffix is .xml, else YAML."""
    options = options or ExportOptions()
    if to == "opencv" and Path(path).suffix.lower() == ".xml":
        write_text(path, opencv.xml_text(calibration, options))
    else:
        write_text(path, export_text(calibration, to, options))
