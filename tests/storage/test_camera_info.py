"""ROS camera_info in both of its spellings, and its flaws."""

from pathlib import Path

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.storage.camera_info import read_camera_info, write_camera_info
from tests_support.cameras import small_camera

MESSAGE = """\
header: {frame_id: cam}
height: 480
width: 640
distortion_model: rational_polynomial
d: [1e-3, 0.1, 0, 0, 010, 0.2, 0.3, 0.4]
k: [500.0, 0.0, 320.0, 0.0, 510.0, 240.0, 0.0, 0.0, 1.0]
r: [1, 0, 0, 0, 1, 0, 0, 0, 1]
"""


def test_round_trip(tmp_path: Path) -> None:
    write_camera_info(tmp_path / "c.yaml", small_camera())
    again = read_camera_info(tmp_path / "c.yaml")
    np.testing.assert_array_equal(again.K, small_camera().K)
    np.testing.assert_array_equal(again.distortion, small_camera().distortion)
    assert (again.width, again.height, again.model) == (64, 48, "plumb_bob")


def test_a_message_is_read_and_its_numbers_are_yaml_1_2(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text(MESSAGE)
    camera = read_camera_info(tmp_path / "c.yaml")
    assert camera.model == "rational_polynomial"
    np.testing.assert_array_equal(camera.distortion, [1e-3, 0.1, 0, 0, 10, 0.2, 0.3, 0.4])
    assert (camera.width, camera.fy) == (640, 510.0)


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("width: 640", "width: 6.5", "image_width"),
        ("510.0", ".nan", "camera_matrix"),
        ("510.0", "-510.0", "camera_matrix"),
        (", 0.3, 0.4]", "]", "distortion_coefficients"),
        ("rational_polynomial", "magic", "distortion_model"),
        ("k: [", "q: [", "camera_matrix"),
        ("height: 480", "height: 480\nheight: 481", "YAML"),
        ("r: [1", "r: !!python/object/apply:os.system ['true']\nz: [1", "YAML"),
    ],
)
def test_flaws_are_named(tmp_path: Path, old: str, new: str, field: str) -> None:
    (tmp_path / "c.yaml").write_text(MESSAGE.replace(old, new))
    with pytest.raises(InputError, match=field):
        read_camera_info(tmp_path / "c.yaml")
