"""The camera models against OpenCV's, and their Jacobians against differences."""

import cv2
import numpy as np
import pytest

from lidarpose.model.camera import Camera

K = np.array([[2757.4, 0.0, 831.6], [0.0, 2758.6, 638.9], [0.0, 0.0, 1.0]])
CAMERAS = {
    "none": Camera(1624, 1234, K),
    "plumb_bob": Camera(1624, 1234, K, "plumb_bob", np.array([-0.076, 0.371, 1e-3, -2e-3, 0.05])),
    "rational": Camera(
        1624, 1234, K, "rational_polynomial", np.array([0.2, -0.1, 1e-3, -2e-3, 0.03, 0.25, -0.05, 0.01])
    ),
    "equidistant": Camera(1624, 1234, K / [[4], [4], [1]], "equidistant", np.array([0.02, -0.01, 3e-3, -1e-3])),
}


@pytest.mark.parametrize("name", CAMERAS)
def test_projection_and_its_inverse(name: str) -> None:
    camera = CAMERAS[name]
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.25, 0.25, (200, 2)), rng.uniform(0.8, 1.2, 200)])
    zero = np.zeros(3)
    if name == "equidistant":
        theirs = cv2.fisheye.projectPoints(points[:, None], zero, zero, camera.K, camera.distortion)[0]
    else:
        theirs = cv2.projectPoints(points, zero, zero, camera.K, camera.distortion)[0]
    pixels, J = camera.project_with_jacobian(points)
    np.testing.assert_allclose(pixels, theirs.reshape(-1, 2), atol=1e-9)
    np.testing.assert_allclose(camera.undistort(pixels), points[:, :2] / points[:, 2:], atol=1e-12)
    for k in range(3):
        h = np.zeros(3)
        h[k] = 1e-6
        numeric = (camera.project(points + h) - camera.project(points - h)) / 2e-6
        np.testing.assert_allclose(J[..., k], numeric, atol=1e-4)


def test_points_behind_the_camera_have_no_pixel() -> None:
    assert np.isnan(CAMERAS["plumb_bob"].project([[0.1, 0.1, -1.0]])).all()


def test_pixels_that_no_ray_reaches_have_no_direction() -> None:
    folding = Camera(
        1000, 1000, np.array([[500.0, 0, 500], [0, 500, 500], [0, 0, 1]]), "plumb_bob", np.array([-0.5, 0, 0, 0])
    )
    assert np.isnan(folding.undistort([[500.0 + 600.0, 500.0]])).all()
    assert np.isfinite(folding.undistort([[600.0, 520.0]])).all()
