"""The sense of turning in words, on motions whose sense is plain."""

import numpy as np
import pytest

from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.calibration import Quality
from lidarpose.model.sense import Sense, StatedSense
from lidarpose.model.turntable import TurntableMotion
from lidarpose.workflows.turning_sense import check_sense, compared, turning_sense

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


def test_a_statement_fills_what_another_leaves_open_and_is_said() -> None:
    on_command_line, in_session = StatedSense("clockwise-from-above"), StatedSense("anticlockwise-from-camera", None)
    assert on_command_line.filled_from(in_session) == on_command_line
    both = StatedSense(table="anticlockwise-from-above").filled_from(in_session)
    assert both == StatedSense("anticlockwise-from-camera", "anticlockwise-from-above")
    motion = TurntableMotion(UP, UPRIGHT)
    assert "Both were compared" in turning_sense(motion, 0.3, both)
    asked = turning_sense(motion, 0.3, on_command_line)
    assert "this would be --table-turns anticlockwise-from-above" in asked  # and not what is stated already
    assert "this would be --beams-turn anticlockwise-from-above --table-turns" in turning_sense(motion, 0.3)


READINGS = (0.1, 0.3, 0.5)


def test_a_true_statement_changes_nothing() -> None:
    stated = StatedSense("anticlockwise-from-above", "anticlockwise-from-above")
    check = check_sense(TurntableMotion(UP, UPRIGHT), READINGS, stated)
    assert check.contradictions == check.notes == ()
    good = Quality("good")
    assert compared(good, check) is good


def test_a_scan_in_reverse_contradicts_and_is_rejected_with_the_remedy() -> None:
    check = check_sense(
        TurntableMotion(UP, UPSIDE_DOWN), READINGS, StatedSense("anticlockwise-from-above", "anticlockwise-from-above")
    )
    (reason,) = check.contradictions
    assert "written in reverse" in reason
    assert "Negate the beam angles" in reason
    quality = compared(Quality("good", ("note: something",)), check)
    assert quality is not None
    assert quality.verdict == "rejected"
    assert quality.reasons == (reason, "note: something")


def test_negated_readings_contradict() -> None:
    down = Pose(exp_so3([-np.pi / 2, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    check = check_sense(TurntableMotion(down, UPRIGHT), READINGS, StatedSense(table="anticlockwise-from-above"))
    (reason,) = check.contradictions
    assert "readings are negated" in reason
    assert "positions.csv" in reason


@pytest.mark.parametrize("sense", ["clockwise-from-camera", "anticlockwise-from-right"])
def test_an_axis_seen_from_its_side_is_not_judged(sense: Sense) -> None:
    check = check_sense(TurntableMotion(UP, UPRIGHT), READINGS, StatedSense(sense, None))
    assert check.contradictions == ()
    (note,) = check.notes
    assert "could not be judged" in note
    assert "from above the image" in note
    quality = compared(Quality("good"), check)
    assert quality is not None
    assert quality.verdict == "good"
    assert quality.reasons == (f"note: {note}",)


@pytest.mark.parametrize("pitch_deg", [-50.0, -30.0, 20.0])
def test_a_camera_that_looks_down_or_up_still_sees_a_vertical_axis_from_above(pitch_deg: float) -> None:
    tilted = Pose(exp_so3([np.deg2rad(pitch_deg), 0.0, 0.0]), np.zeros(3)) @ UP
    true = check_sense(TurntableMotion(tilted, UPRIGHT), READINGS, StatedSense(table="anticlockwise-from-above"))
    false = check_sense(TurntableMotion(tilted, UPRIGHT), READINGS, StatedSense(table="clockwise-from-above"))
    assert true.contradictions == true.notes == ()
    assert false.contradictions
