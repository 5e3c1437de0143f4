"""Cameras for tests."""

import numpy as np

from lidarpose.model.camera import Camera


def small_camera() -> Camera:
    """64 x 48 pixels, with some distortion."""
    K = np.array([[80.0, 0.0, 31.5], [0.0, 81.0, 23.5], [0.0, 0.0, 1.0]])
    return Camera(64, 48, K, "plumb_bob", np.array([-0.076, 0.371, 0.001, -0.002, 0.0]))
