"""Section 2 of the paper on a real table: markers on a stepper turntable, 1.125 degrees a step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.camera import Camera
from lidarpose.model.observation import PanelCorners
from lidarpose.solve.panel_pose import panel_pose
from lidarpose.solve.turntable_function import angles_shown, fit_by_circles, fit_by_readings

DATA = Path(__file__).parents[3] / "shared" / "data" / "turntable_srv"
STEP_DEG = 1.125
SIDE_M = 0.030
SQUARE = SIDE_M * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])

pytestmark = [
    pytest.mark.skipif(not DATA.is_dir(), reason=f"the recordings are not at {DATA}"),
    pytest.mark.filterwarnings("ignore:Reading .*npy.* or .*npz.* file:UserWarning"),  # written by Python 2
]


def marker_corners() -> tuple[Camera, FloatArray, list[dict[int, FloatArray]]]:
    """Camera, steps (N,) of the motor, and by image the corners (4, 2) of each marker."""
    K = np.load(DATA / "cameraCalibMatrix4.npy")
    distortion = np.load(DATA / "cameraCalibDistCoeff4.npy").ravel()
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50), parameters)
    steps: list[float] = []
    images: list[dict[int, FloatArray]] = []
    for path in sorted((DATA / "table").glob("*.jpg")):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None, path
        corners, ids, _ = detector.detectMarkers(image)
        steps.append(float(path.stem[-3:]))
        keys = [] if ids is None else [int(key) for key in ids.ravel()]
        found = dict(zip(keys, corners, strict=True)) if keys else {}
        images.append({key: np.asarray(value, dtype=float).reshape(4, 2) for key, value in found.items()})
    return Camera(640, 480, K, "plumb_bob", distortion[:5]), np.array(steps), images


def table_pose(camera: Camera, layout: dict[int, FloatArray], seen: dict[int, FloatArray]) -> Any:
    keys = [key for key in seen if key in layout]
    points = np.vstack([layout[key] for key in keys])
    pixels = np.vstack([seen[key] for key in keys])
    board = PanelCorners(np.column_stack([points, np.zeros(len(points))]), pixels, np.full(len(points), 0.2))
    return panel_pose(camera, board)


def square_at(points: FloatArray) -> FloatArray:
    """The marker's square (4, 2), moved in the plane to lie nearest to four points."""
    a, b = SQUARE - SQUARE.mean(axis=0), points - points.mean(axis=0)
    turn = np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.asarray(a @ R.T + points.mean(axis=0))


def estimated_layout(camera: Camera, images: list[dict[int, FloatArray]]) -> dict[int, FloatArray]:
    """Where the four markers' corners lie on the flat table, in the first marker's frame."""
    first = min(min(seen) for seen in images if seen)
    layout: dict[int, FloatArray] = {first: SQUARE}
    for _ in range(30):
        on_table: dict[int, list[FloatArray]] = {}
        for seen in images:
            if not set(seen) & set(layout):
                continue
            back = table_pose(camera, layout, seen).T_camera_panel.inverse()
            for key, pixels in seen.items():
                directions = back.rotate(camera.rays(pixels))
                scale = -back.translation[2] / directions[:, 2]
                on_table.setdefault(key, []).append((back.translation + scale[:, None] * directions)[:, :2])
        layout = {key: square_at(np.asarray(np.median(np.stack(values), axis=0))) for key, values in on_table.items()}
    return layout


@pytest.mark.parametrize("fit", [fit_by_readings, fit_by_circles])
def test_a_real_turntable_makes_its_steps(fit: Any) -> None:
    """Motor steps counted by the makers of the recording; the first few images show the table's slack."""
    camera, steps, images = marker_corners()
    layout = estimated_layout(camera, images)
    assert sorted(layout) == [5, 18, 27, 42]
    found = [table_pose(camera, layout, seen) for seen in images]
    poses = [p.T_camera_panel for p in found]
    readings = np.deg2rad(STEP_DEG * steps)
    function = fit(readings, poses)
    table = function.deviations.table()
    assert table["centre_mean_mm"] < 1.0
    assert table["z_mean_deg"] < 0.4
    assert table["x_mean_deg"] < 0.5
    shown = np.rad2deg(angles_shown(function.motion, readings, poses))
    slope = np.polyfit(steps, shown, 1)[0]
    overall = (shown[-1] - shown[0]) / (steps[-1] - steps[0])
    assert slope == pytest.approx(STEP_DEG, abs=0.005)
    assert overall == pytest.approx(STEP_DEG, abs=0.005)


def test_the_axis_turns_right_handed_as_the_reading_grows() -> None:
    camera, steps, images = marker_corners()
    layout = estimated_layout(camera, images)
    poses = [table_pose(camera, layout, seen).T_camera_panel for seen in images]
    growing = fit_by_readings(np.deg2rad(STEP_DEG * steps), poses).motion.axis_direction_camera
    falling = fit_by_readings(np.deg2rad(-STEP_DEG * steps), poses).motion.axis_direction_camera
    np.testing.assert_allclose(growing, -falling, atol=1e-6)
