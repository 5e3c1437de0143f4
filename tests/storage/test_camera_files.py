"""Cameras from other programs' files: OpenCV's own writer, Kalibr's camchain, ROS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.model.camera import Camera
from lidarpose.storage.camera_files import read_camera
from lidarpose.storage.camera_info import write_camera_info

K = np.array([[1000.5, 0.0, 320.25], [0.0, 999.75, 240.5], [0.0, 0.0, 1.0]])


def write_opencv(path: Path, distortion: np.ndarray, **more: Any) -> Path:
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", distortion)
    storage.write("calibration_time", "Sat Nov 21 2026")
    for key, value in more.items():
        storage.write(key, value)
    storage.release()
    return path


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml"])
@pytest.mark.parametrize(
    ("distortion", "model"),
    [
        ([0.1, -0.05, 1e-3, 2e-4, 1e-3], "plumb_bob"),
        ([0.1, -0.05, 1e-3, 2e-4], "plumb_bob"),
        ([0.1, -0.05, 1e-3, 2e-4, 1e-3, 0.2, 0.01, 1e-4], "rational_polynomial"),
        ([0.1, -0.05, 1e-3, 2e-4, 1e-3, 0.2, 0.01, 1e-4, 0, 0, 0, 0, 0, 0], "rational_polynomial"),
    ],
)
def test_what_opencv_writes(tmp_path: Path, suffix: str, distortion: list[float], model: str) -> None:
    camera = read_camera(write_opencv(tmp_path / f"camera.{suffix}", np.array([distortion])))
    np.testing.assert_array_equal(camera.K, K)
    np.testing.assert_array_equal(camera.distortion, distortion[:8])
    assert (camera.width, camera.height, camera.model) == (640, 480, model)


def test_opencv_s_fisheye(tmp_path: Path) -> None:
    path = write_opencv(tmp_path / "c.yml", np.array([[0.1, 0.0, 1e-3, 0.0]]), fisheye_model=1)
    assert read_camera(path).model == "equidistant"


@pytest.mark.parametrize("suffix", ["yml", "xml"])
@pytest.mark.parametrize(
    ("key", "value", "named"),
    [
        ("camera_matrix", np.array([[np.nan, 0, 1], [0, 1, 1], [0, 0, 1]]), "camera_matrix"),
        ("camera_matrix", np.ones((2, 2)), "camera_matrix"),
        ("camera_matrix", np.ones((3, 3)), "camera matrix"),
        ("distortion_coefficients", np.ones((1, 3)), "distortion_coefficients"),
        ("distortion_coefficients", np.ones((1, 12)), "distortion_coefficients"),
        ("image_width", 0, "image_width"),
    ],
)
def test_an_opencv_file_with_a_wrong_key(tmp_path: Path, suffix: str, key: str, value: Any, named: str) -> None:
    entries: dict[str, Any] = {
        "image_width": 640,
        "image_height": 480,
        "camera_matrix": K,
        "distortion_coefficients": np.zeros((1, 5)),
    }
    for left_out in (False, True):
        storage = cv2.FileStorage(str(tmp_path / f"c.{suffix}"), cv2.FILE_STORAGE_WRITE)
        for name, entry in entries.items():
            if name != key:
                storage.write(name, entry)
            elif not left_out:
                storage.write(name, value)
        storage.release()
        with pytest.raises(InputError, match=key if left_out else named):
            read_camera(tmp_path / f"c.{suffix}")


CAMCHAIN = """cam0:
  T_cam_imu:
  - [1.0, 0.0, 0.0, 1e-3]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [-0.28, 0.07, 1e-3, 1.8e-05]
  distortion_model: radtan
  intrinsics: [458.6, 457.3, 367.2, 248.4]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""


def test_kalibr_s_camchain(tmp_path: Path) -> None:
    path = tmp_path / "camchain.yaml"
    path.write_text(CAMCHAIN)
    camera = read_camera(path)
    np.testing.assert_array_equal(camera.K, [[458.6, 0, 367.2], [0, 457.3, 248.4], [0, 0, 1]])
    np.testing.assert_array_equal(camera.distortion, [-0.28, 0.07, 1e-3, 1.8e-05])
    path.write_text(CAMCHAIN.replace("radtan", "equidistant"))
    assert read_camera(path).model == "equidistant"


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("camera_model: pinhole", "camera_model: omni", "camera_model"),
        ("radtan", "fov", "distortion_model"),
        ("radtan", "[radtan]", "distortion_model"),
        ("458.6", "1" + 400 * "0", "intrinsics"),
        ("[458.6, 457.3, 367.2, 248.4]", "[458.6, 457.3]", "intrinsics"),
        ("[458.6, 457.3, 367.2, 248.4]", "[458.6, -457.3, 367.2, 248.4]", "focal"),
        ("[458.6,", "[.nan,", "intrinsics"),
        ("[458.6,", "['458.6',", "intrinsics"),
        ("  resolution: [752, 480]\n", "", "image_width"),
        ("-0.28, ", "", "coefficients"),
        ("cam0:\n", "cam1: {intrinsics: [1, 1, 1, 1]}\ncam0:\n", "2 cameras"),
    ],
)
def test_a_camchain_that_cannot_be_used(tmp_path: Path, old: str, new: str, named: str) -> None:
    assert old in CAMCHAIN
    (tmp_path / "c.yaml").write_text(CAMCHAIN.replace(old, new))
    with pytest.raises(InputError, match=named):
        read_camera(tmp_path / "c.yaml")


def test_ros_camera_info_is_still_one(tmp_path: Path) -> None:
    camera = Camera(640, 480, K, "plumb_bob", np.array([0.1, 0.0, 0.0, 0.0, 0.0]))
    write_camera_info(tmp_path / "c.yaml", camera)
    np.testing.assert_array_equal(read_camera(tmp_path / "c.yaml").K, K)


@pytest.mark.parametrize("value", ["1" + 400 * "0", "-.inf", "[1]", "yes", "1e999"])
@pytest.mark.parametrize("key", ["distortion_model: ", "  data: [", "image_width: "])
def test_a_camera_info_with_something_else_for_a_number(tmp_path: Path, key: str, value: str) -> None:
    write_camera_info(tmp_path / "c.yaml", Camera(640, 480, K))
    text = (tmp_path / "c.yaml").read_text()
    start = text.index(key) + len(key)
    end = min(k for k in (text.find(mark, start) for mark in ",\n") if k > 0)
    (tmp_path / "c.yaml").write_text(text[:start] + value + text[end:])
    with pytest.raises(InputError, match=r"c\.yaml"):
        read_camera(tmp_path / "c.yaml")


@pytest.mark.parametrize(
    "text",
    [
        "a: !!python/object/apply:os.system ['touch {marker}']",
        "!!python/object/apply:os.system ['touch {marker}']",
        "camera_matrix: !!python/name:os.system",
        '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><opencv_storage>&x;</opencv_storage>',
        '<?xml version="1.0"?><!DOCTYPE a [<!ENTITY x "xx"><!ENTITY y "&x;&x;">]><opencv_storage>&y;</opencv_storage>',
        "<opencv_storage>",
        "<html/>",
        "",
        "[1, 2]",
        "a: 1\na: 2",
        "a: 1\n" * 20000,
        "- " * 30000,
        "[" * 60000,
    ],
)
def test_nothing_is_executed_and_nothing_expands(tmp_path: Path, text: str) -> None:
    marker = tmp_path / "marker"
    (tmp_path / "c.yaml").write_text(text.replace("{marker}", str(marker)))
    with pytest.raises(InputError, match=r"c\.yaml"):
        read_camera(tmp_path / "c.yaml")
    assert not marker.exists()
