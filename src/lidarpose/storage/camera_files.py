"""Camera files of every kind that is read: ROS camera_info, OpenCV's FileStorage (YAML, XML), Kalibr's camchain."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.camera import Camera, DistortionModel
from lidarpose.storage.camera_info import camera_of_info
from lidarpose.storage.documents import MAX_XML_BYTES, read_opencv_xml, read_text, read_yaml, shown

_KINDS = "a ROS camera_info, OpenCV (camera_matrix, distortion_coefficients) or Kalibr camchain file"
# The names that OpenCV's own calibration programs, and those made after them, write.
_MATRIX = ("camera_matrix", "cameramatrix", "intrinsic_matrix", "intrinsics", "k", "m1")
_DISTORTION = ("distortion_coefficients", "distcoeffs", "dist_coeffs", "distortion", "d", "d1")
_WIDTH, _HEIGHT = ("image_width", "width"), ("image_height", "height")
_SIZE = ("image_size", "imagesize", "size")
_KALIBR_MODELS: dict[str, DistortionModel] = {"radtan": "plumb_bob", "equidistant": "equidistant", "none": "plumb_bob"}
_OPENCV_COUNTS: dict[int, DistortionModel] = {
    0: "plumb_bob",
    4: "plumb_bob",
    5: "plumb_bob",
    8: "rational_polynomial",
}


def read_camera(path: Path) -> Camera:
    """Read a camera from a file of any of the kinds, told apart by what is in it.

    Raises
    ------
    InputError
        If it is none of these, a key is missing or wrong, the model is one that `Camera` does not have, or a camchain
        holds several cameras.
    """
    path = Path(path)
    text = read_text(path, _KINDS, MAX_XML_BYTES).lstrip()
    if text.startswith("<"):
        return _opencv(path, read_opencv_xml(path))
    document = read_yaml(path)
    if not isinstance(document, dict):
        raise InputError(path, "holds no keys", expected=_KINDS)
    if any(isinstance(value, dict) and "intrinsics" in value for value in document.values()):
        return _kalibr(path, document)
    if text.startswith("%YAML:") or "!!opencv-matrix" in text:
        return _opencv(path, document)
    return camera_of_info(path, document)


def _opencv(path: Path, document: Mapping[str, Any]) -> Camera:
    keys = {str(key).lower(): value for key, value in document.items()}
    K = _matrix(path, keys, _MATRIX)
    if K.size != 9:
        raise InputError(path, f"holds {K.size} numbers", field="camera_matrix", expected="3 x 3")
    coefficients = _matrix(path, keys, _DISTORTION)
    width, height = _image_size(path, keys)
    model = _opencv_model(path, keys, coefficients)
    coefficients = coefficients[:8] if model == "rational_polynomial" else coefficients
    return _camera(path, width, height, K.reshape(3, 3), model, coefficients)


def _opencv_model(path: Path, keys: Mapping[str, Any], coefficients: FloatArray) -> DistortionModel:
    named = str(keys.get("distortion_model", keys.get("model", ""))).lower()
    if keys.get("fisheye_model") in (1, "1", True) or named in ("fisheye", "equidistant", "kannala_brandt"):
        return "equidistant"
    count = len(coefficients)
    if count > 8 and not coefficients[8:].any():
        count = 8  # thin prism and tilt terms that were not estimated
    if count not in _OPENCV_COUNTS:
        raise InputError(
            path,
            f"holds {len(coefficients)} coefficients",
            field="distortion_coefficients",
            expected="0, 4, 5 or 8 (the terms after the eighth must be 0)",
        )
    return _OPENCV_COUNTS[count]


def _image_size(path: Path, keys: Mapping[str, Any]) -> tuple[int, int]:
    pair = next((keys[name] for name in _SIZE if name in keys), None)
    if isinstance(pair, list | tuple) and len(pair) == 2:
        width, height = pair
    else:
        width = next((keys[name] for name in _WIDTH if name in keys), None)
        height = next((keys[name] for name in _HEIGHT if name in keys), None)
    for name, value in (("image_width", width), ("image_height", height)):
        if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 65535:
            found = "is missing" if value is None else f"is {shown(value)}"
            raise InputError(
                path, found, field=name, expected="the image's size in pixels, image_width and image_height"
            )
    return int(width), int(height)


def _matrix(path: Path, keys: Mapping[str, Any], names: tuple[str, ...]) -> FloatArray:
    found = next((name for name in names if name in keys), None)
    if found is None:
        raise InputError(path, "is missing", field=names[0], expected=_KINDS)
    value = keys[found]
    data = value.get("data") if isinstance(value, dict) else value
    if isinstance(value, dict) and isinstance(data, list):
        rows, columns = value.get("rows"), value.get("cols")
        if isinstance(rows, int) and isinstance(columns, int) and rows * columns != len(data):
            raise InputError(path, f"says {rows} x {columns}, but holds {len(data)} numbers", field=found)
    return _numbers(path, found, data)


def _numbers(path: Path, field: str, data: Any) -> FloatArray:
    flat = [x for row in data for x in (row if isinstance(row, list) else [row])] if isinstance(data, list) else None
    if flat is None or any(isinstance(x, bool) or not isinstance(x, int | float) for x in flat):
        raise InputError(path, "is no list of numbers", field=field, expected="finite numbers")
    try:
        array = np.array(flat, dtype=np.float64)
    except OverflowError:
        array = np.array([np.inf])
    if not np.isfinite(array).all():
        raise InputError(path, "holds NaN or infinity", field=field, expected="finite numbers")
    return array


def _kalibr(path: Path, document: Mapping[str, Any]) -> Camera:
    cameras = {key: value for key, value in document.items() if isinstance(value, dict) and "intrinsics" in value}
    if len(cameras) != 1:
        raise InputError(
            path,
            f"holds {len(cameras)} cameras ({', '.join(map(str, cameras))})",
            expected="one camera",
            remedy="Copy the camera that was used into a file of its own.",
        )
    name, entry = next(iter(cameras.items()))
    model = entry.get("camera_model", "pinhole")
    if model != "pinhole":
        raise InputError(path, f"is {shown(model)}", field=f"{name}.camera_model", expected="pinhole")
    distortion = entry.get("distortion_model", "none")
    if not isinstance(distortion, str) or distortion not in _KALIBR_MODELS:
        expected = " or ".join(_KALIBR_MODELS)
        raise InputError(path, f"is {shown(distortion)}", field=f"{name}.distortion_model", expected=expected)
    intrinsics = _numbers(path, f"{name}.intrinsics", entry["intrinsics"])
    if len(intrinsics) != 4:
        raise InputError(path, f"holds {len(intrinsics)} numbers", field=f"{name}.intrinsics", expected="fu fv pu pv")
    bent = entry.get("distortion_coeffs") if distortion != "none" else []
    coefficients = _numbers(path, f"{name}.distortion_coeffs", bent)
    fu, fv, pu, pv = intrinsics
    width, height = _image_size(path, {"size": entry.get("resolution")})
    K = np.array([[fu, 0.0, pu], [0.0, fv, pv], [0.0, 0.0, 1.0]])
    return _camera(path, width, height, K, _KALIBR_MODELS[distortion], coefficients)


def _camera(
    path: Path, width: int, height: int, K: FloatArray, model: DistortionModel, coefficients: FloatArray
) -> Camera:
    if np.any(K[[0, 1, 2, 2], [1, 0, 0, 1]] != 0.0) or K[2, 2] != 1.0:
        raise InputError(path, "is no camera matrix", field="camera_matrix", expected="fx 0 cx / 0 fy cy / 0 0 1")
    try:
        return Camera(width, height, K, model, coefficients)
    except ValueError as error:
        raise InputError(path, str(error)) from error
