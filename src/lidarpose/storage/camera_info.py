"""ROS camera_info: the YAML of ROS's camera calibration, or a CameraInfo message as `ros2 topic echo` prints it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.model.camera import COEFFICIENT_COUNTS, Camera
from lidarpose.storage.atomic import write_text
from lidarpose.storage.documents import read_yaml, shown

_MESSAGE_KEYS = {"width": "image_width", "height": "image_height", "k": "camera_matrix", "d": "distortion_coefficients"}


def read_camera_info(path: Path) -> Camera:
    """Read a camera from a ROS camera_info file.

    Raises
    ------
    InputError
        Naming the key at fault: missing, of a wrong length or size, not finite, or an unknown distortion model.
    """
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise InputError(path, "holds no keys", expected="a ROS camera_info file")
    return camera_of_info(path, document)


def camera_of_info(path: Path, document: Mapping[Any, Any]) -> Camera:
    """The camera of a camera_info that has been read from a file. Raises as `read_camera_info` does."""
    lowered = {str(key).lower(): value for key, value in document.items()}
    keys = {_MESSAGE_KEYS.get(key, key): value for key, value in lowered.items()}
    K = np.array(_numbers(path, keys, "camera_matrix", (9,))).reshape(3, 3)
    _check_matrix(path, K)
    model = keys.get("distortion_model", "plumb_bob")
    if model in ("fisheye", "kannala_brandt"):
        model = "equidistant"
    if not isinstance(model, str) or model not in COEFFICIENT_COUNTS:
        raise InputError(path, f"is {shown(model)}", field="distortion_model", expected=" or ".join(COEFFICIENT_COUNTS))
    distortion = _numbers(path, keys, "distortion_coefficients", COEFFICIENT_COUNTS[model])
    try:
        return Camera(
            _size(path, keys, "image_width"), _size(path, keys, "image_height"), K, model, np.array(distortion)
        )
    except ValueError as error:
        raise InputError(path, str(error)) from error


def write_camera_info(path: Path, camera: Camera, name: str = "camera") -> None:
    """Write a camera as ROS's calibration YAML."""

    def rows(matrix: Any) -> str:
        return "[" + ", ".join(repr(float(x)) for x in np.ravel(matrix)) + "]"

    projection = np.hstack([camera.K, np.zeros((3, 1))])
    blocks = [
        f"image_width: {camera.width}",
        f"image_height: {camera.height}",
        f"camera_name: {name}",
        f"camera_matrix:\n  rows: 3\n  cols: 3\n  data: {rows(camera.K)}",
        f"distortion_model: {camera.model}",
        f"distortion_coefficients:\n  rows: 1\n  cols: {len(camera.distortion)}\n  data: {rows(camera.distortion)}",
        f"rectification_matrix:\n  rows: 3\n  cols: 3\n  data: {rows(np.eye(3))}",
        f"projection_matrix:\n  rows: 3\n  cols: 4\n  data: {rows(projection)}",
    ]
    write_text(path, "\n".join(blocks) + "\n")


def _numbers(path: Path, keys: dict[str, Any], key: str, counts: tuple[int, ...]) -> list[float]:
    if key not in keys:
        raise InputError(path, "is missing", field=key, expected="a ROS camera_info file")
    value = keys[key]
    if isinstance(value, dict):
        value = value.get("data")
    expected = f"{' or '.join(map(str, counts))} finite numbers"
    if not isinstance(value, list) or len(value) not in counts:
        found = f"holds {len(value)} numbers" if isinstance(value, list) else "is no list of numbers"
        raise InputError(path, found, field=key, expected=expected)
    for entry in value:
        # The comparison fails for NaN, infinity, and whole numbers too large for a float.
        if isinstance(entry, bool) or not isinstance(entry, int | float) or not abs(entry) < 1e300:
            raise InputError(path, f"holds {shown(entry)}", field=key, expected=expected)
    return [float(entry) for entry in value]


def _size(path: Path, keys: dict[str, Any], key: str) -> int:
    value = keys.get(key)
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 65535:
        raise InputError(path, f"is {shown(value)}", field=key, expected="the image's size in pixels")
    return value


def _check_matrix(path: Path, K: np.ndarray[Any, Any]) -> None:
    pattern = np.array([[1, 1, 1], [0, 1, 1], [0, 0, 1]])
    if np.any(K[pattern == 0] != 0.0) or K[2, 2] != 1.0 or K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
        raise InputError(
            path,
            "is no camera matrix",
            field="camera_matrix",
            expected="fx 0 cx 0 fy cy 0 0 1 in pixels, row by row",
        )
