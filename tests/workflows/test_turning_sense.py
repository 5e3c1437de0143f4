"""The sense of turning in words, on motions whose sense is plain."""

import numpy as np
import pytest

from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.turntable import TurntableMotion
from lidarpose.workflows.turning_sense import turning_sense

# From above the image, a turn about the camera's -y (up) is anticlockwise: x (right) goes to z (away).
UP = Pose(exp_so3([np.pi / 2, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
UPRIGHT = Pose(np.eye(3), np.array([0.1, 0.0, 0.0]))
UPSIDE_DOWN = Pose(np.diag([1.0, -1.0, -1.0]), np.array([0.1, 0.0, 0.0]))


def test_the_axis_of_the_example_points_up() -> None:
    motion = TurntableMotion(UP, UPRIGHT)
    before, after = motion.pose(0.0).translation, motion.pose(0.1).translation
    np.testing.assert_allclose(motion.axis_direction_camera, [0.0, -1.0, 0.0], atol=1e-12)
    assert before[0] == pytest.approx(0.1)
    assert after[2] > before[2]


@pytest.mark.parametrize(("mounting", "beams"), [(UPRIGHT, "anticlockwise"), (UPSIDE_DOWN, "clockwise")])
def test_upside_down_is_the_other_sense_of_the_beams(mounting: Pose, beams: str) -> None:
    text = turning_sense(TurntableMotion(UP, mounting), 0.3)
    assert f"beam angles turn {beams} seen from above the image" in text
    assert "readings turn anticlockwise seen from above the image" in text
