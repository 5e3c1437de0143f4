"""What a 2D LiDAR returns, and what is known of the instrument."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, as_float_array


@dataclass(frozen=True)
class LidarSpec:
    """What the user says of his LiDAR; all may be unknown.

    Attributes
    ----------
    beam_crossing_m
        Of a multi-beam LiDAR whose clouds are made as if all beams started at one point: how far before the axis they
        cross in truth (see `lidarpose.geometry.rings`).
    """

    model: str | None = None
    range_sigma_m: float | None = None
    beam_crossing_m: float | None = None


@dataclass(frozen=True, eq=False)
class Scan:
    """One or several sweeps of a 2D LiDAR that stands still.

    Attributes
    ----------
    angle_rad : (N,)
        Beam angles, in the order of the file.
    range_m : (N,)
        NaN where a beam has no return.
    intensity : (N,) or None
        In the instrument's own unit.
    sweep : (N,) or None
        Which sweep each beam belongs to; None is one sweep.
    """

    angle_rad: FloatArray
    range_m: FloatArray
    intensity: FloatArray | None = None
    sweep: IntArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "angle_rad", as_float_array(self.angle_rad, (None,), "angle_rad"))
        object.__setattr__(self, "range_m", as_float_array(self.range_m, self.angle_rad.shape, "range_m"))
        if self.intensity is not None:
            object.__setattr__(self, "intensity", as_float_array(self.intensity, self.angle_rad.shape, "intensity"))
        if self.sweep is not None and np.shape(self.sweep) != self.angle_rad.shape:
            raise ValueError(f"sweep has shape {np.shape(self.sweep)}, expected {self.angle_rad.shape}")

    def __len__(self) -> int:
        return len(self.angle_rad)

    @property
    def has_return(self) -> BoolArray:
        """(N,) beams with a finite range above zero."""
        return np.isfinite(self.range_m) & (self.range_m > 0.0)

    def points_lidar(self) -> FloatArray:
        """Points (N, 2) in the scan plane, NaN without return (turntable paper, eq. (6))."""
        return polar_to_points(self.angle_rad, self.range_m)


def polar_to_points(angle_rad: FloatArray, range_m: FloatArray) -> FloatArray:
    """Points (N, 2) of beams, turntable paper eq. (6): x along the beam at 0, y along the beam at +90 degrees."""
    return np.column_stack([range_m * np.cos(angle_rad), range_m * np.sin(angle_rad)])
