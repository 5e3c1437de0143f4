"""Cameras as ROS camera_info describes them: a pinhole with plumb_bob, rational_polynomial or equidistant distortion.

Pixels have their origin at the centre of the upper left pixel. Points are in the camera's optical frame
(x right, y down, z forward), in metres.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray, as_float_array

DistortionModel = Literal["plumb_bob", "rational_polynomial", "equidistant"]

COEFFICIENT_COUNTS: dict[DistortionModel, tuple[int, ...]] = {
    "plumb_bob": (0, 4, 5),
    "rational_polynomial": (8,),
    "equidistant": (4,),
}
"""How many coefficients each model takes: plumb_bob k1 k2 p1 p2 [k3]; rational k1 k2 p1 p2 k3 k4 k5 k6;
equidistant k1 k2 k3 k4 (Kannala and Brandt, fisheye)."""


@dataclass(frozen=True, eq=False)
class Camera:
    """Intrinsics of one camera.

    Attributes
    ----------
    width, height
        Image size in pixels.
    K : (3, 3)
        fx 0 cx / 0 fy cy / 0 0 1, pixels.
    model
        ROS name of the distortion model.
    distortion : (n,)
        Its coefficients in ROS (and OpenCV) order; none for a camera without distortion.
    """

    width: int
    height: int
    K: FloatArray
    model: DistortionModel = "plumb_bob"
    distortion: FloatArray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        object.__setattr__(self, "K", as_float_array(self.K, (3, 3), "K"))
        object.__setattr__(self, "distortion", as_float_array(self.distortion, (None,), "distortion"))
        if self.width < 1 or self.height < 1:
            raise ValueError(f"an image of {self.width} x {self.height} pixels holds nothing")
        if not (np.all(np.isfinite(self.K)) and np.all(np.isfinite(self.distortion))):
            raise ValueError("camera intrinsics must be finite")
        if self.fx <= 0.0 or self.fy <= 0.0:
            raise ValueError(f"focal lengths must be positive, found {self.fx:g} and {self.fy:g}")
        if len(self.distortion) not in COEFFICIENT_COUNTS[self.model]:
            raise ValueError(
                f"{self.model} takes {' or '.join(map(str, COEFFICIENT_COUNTS[self.model]))} coefficients, "
                f"found {len(self.distortion)}"
            )

    @property
    def fx(self) -> float:
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        return float(self.K[1, 2])

    def distort(self, normalised: ArrayLike) -> FloatArray:
        """Distorted coordinates (..., 2) of ideal ones (x/z, y/z) (..., 2)."""
        return self._distort(np.asarray(normalised, dtype=np.float64))[0]

    def project(self, points_camera: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of points (..., 3); NaN for points that are not in front of the camera (z <= 0)."""
        p = np.asarray(points_camera, dtype=np.float64)
        z = np.where(p[..., 2] > 0.0, p[..., 2], np.nan)
        return self._to_pixels(self.distort(p[..., :2] / z[..., None]))

    def project_with_jacobian(self, points_camera: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Pixels (..., 2) and their derivative by the point (..., 2, 3)."""
        p = np.asarray(points_camera, dtype=np.float64)
        z = np.where(p[..., 2] > 0.0, p[..., 2], np.nan)
        normalised = p[..., :2] / z[..., None]
        distorted, J_distort = self._distort(normalised)
        J_normalise = np.zeros((*p.shape[:-1], 2, 3))
        J_normalise[..., 0, 0] = J_normalise[..., 1, 1] = 1.0 / z
        J_normalise[..., :, 2] = -normalised / z[..., None]
        return self._to_pixels(distorted), self.K[:2, :2] @ J_distort @ J_normalise

    def undistort(self, pixels: ArrayLike) -> FloatArray:
        """Ideal coordinates (x/z, y/z) (..., 2) of pixels (..., 2), by Newton's method to rounding.

        NaN where the distortion model has no inverse (pixels that no ray of its valid region reaches).
        """
        target = (np.asarray(pixels, dtype=np.float64) - self.K[:2, 2]) @ np.linalg.inv(self.K[:2, :2]).T
        ideal = self._first_guess(target)
        for _ in range(50):
            value, J = self._distort(ideal)
            determinant = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
            determinant = np.where(np.abs(determinant) < 1e-9, 1e-9, determinant)
            error = value - target
            step_x = (J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1]) / determinant
            step_y = (J[..., 0, 0] * error[..., 1] - J[..., 1, 0] * error[..., 0]) / determinant
            step = np.stack([step_x, step_y], -1)
            # A step longer than the field of view is a sign of the folded region: shorten, do not jump.
            ideal = ideal - step / np.maximum(1.0, np.linalg.norm(step, axis=-1, keepdims=True) / 0.5)
            if step.size == 0 or np.nanmax(np.abs(step), initial=0.0) < 1e-14:
                break
        value, J = self._distort(ideal)
        folded = (J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]) <= 0.0
        bad = folded | ~(np.abs(value - target).max(axis=-1) < 1e-9)
        return np.where(bad[..., None], np.nan, ideal)

    def rays(self, pixels: ArrayLike) -> FloatArray:
        """Directions (..., 3) with z = 1 through pixels (..., 2)."""
        ideal = self.undistort(pixels)
        return np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)

    def contains(self, pixels: ArrayLike) -> FloatArray:
        """True (...) for pixels (..., 2) inside the image."""
        u, v = np.moveaxis(np.asarray(pixels, dtype=np.float64), -1, 0)
        return np.asarray((u >= -0.5) & (v >= -0.5) & (u <= self.width - 0.5) & (v <= self.height - 0.5))

    def _to_pixels(self, distorted: FloatArray) -> FloatArray:
        return np.asarray(distorted @ self.K[:2, :2].T + self.K[:2, 2])

    def _first_guess(self, target: FloatArray) -> FloatArray:
        if self.model != "equidistant":
            return target.copy()
        angle = np.minimum(np.linalg.norm(target, axis=-1, keepdims=True), 1.4)
        return np.asarray(target * np.where(angle > 1e-9, np.tan(angle) / np.maximum(angle, 1e-9), 1.0))

    def _distort(self, ideal: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Distorted coordinates (..., 2) and their derivative (..., 2, 2) by the ideal ones."""
        if self.model == "equidistant":
            return _distort_equidistant(ideal, self.distortion)
        return _distort_rational(ideal, self.distortion)


def _distort_rational(ideal: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Brown's model with a rational radial part (OpenCV's calib3d chapter); plumb_bob has denominator 1."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.concatenate([coefficients, np.zeros(8 - len(coefficients))])
    x, y = ideal[..., 0], ideal[..., 1]
    r2 = x * x + y * y
    top = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bottom = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
    radial = top / bottom
    d_top = k1 + r2 * (2 * k2 + r2 * 3 * k3)
    d_bottom = k4 + r2 * (2 * k5 + r2 * 3 * k6)
    slope = 2.0 * (d_top - radial * d_bottom) / bottom
    out = np.empty_like(ideal)
    out[..., 0] = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    out[..., 1] = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    J = np.empty((*ideal.shape, 2))
    J[..., 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    J[..., 0, 1] = J[..., 1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y
    J[..., 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    return out, J


def _distort_equidistant(ideal: FloatArray, coefficients: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Kannala and Brandt (2006): the distorted radius is an odd polynomial of the angle from the optical axis."""
    k1, k2, k3, k4 = np.concatenate([coefficients, np.zeros(4 - len(coefficients))])
    r = np.linalg.norm(ideal, axis=-1)
    near = r < 1e-8
    safe = np.where(near, 1.0, r)
    angle = np.arctan(r)
    a2 = angle * angle
    bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    d_bent = (1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))) / (1 + r * r)
    scale = np.where(near, 1.0, bent / safe)
    d_scale = np.where(near, 0.0, (d_bent - scale) / safe**2)
    J = d_scale[..., None, None] * ideal[..., :, None] * ideal[..., None, :] + scale[..., None, None] * np.eye(2)
    return ideal * scale[..., None], J
