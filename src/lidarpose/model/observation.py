"""Observations: what detection finds in a session and estimation works from. Pixels are those of the raw image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from lidarpose.geometry.arrays import FloatArray, as_float_array
from lidarpose.model.camera import Camera
from lidarpose.model.scan import LidarSpec, polar_to_points
from lidarpose.model.session import DEFAULT_PLACEMENT
from lidarpose.model.targets import Panel


@dataclass(frozen=True, eq=False)
class PanelCorners:
    """A panel's inner corners in the image.

    Attributes
    ----------
    corners_panel : (N, 3)
        Where they are on the panel, metres, z = 0.
    pixels : (N, 2)
        Where they are in the image, distorted pixels.
    sigma_px : (N,)
        Standard deviation of each coordinate, as detection states it.
    first_dark
        Whether the square from the panel's origin along x and y is a black one; None where nobody looked.
    """

    corners_panel: FloatArray
    pixels: FloatArray
    sigma_px: FloatArray
    first_dark: bool | None = None

    def __post_init__(self) -> None:
        n = len(np.asarray(self.corners_panel))
        for name, shape in (("corners_panel", (n, 3)), ("pixels", (n, 2)), ("sigma_px", (n,))):
            object.__setattr__(self, name, as_float_array(getattr(self, name), shape, name))


@dataclass(frozen=True, eq=False)
class StripePoints:
    """Points of the laser's stripe on one panel.

    Attributes
    ----------
    pixels : (N, 2)
        Distorted pixels on the stripe's centre line.
    normals : (N, 2)
        Unit directions in the image across the stripe, along which each point was measured.
    sigma_px : (N,)
        Standard deviation along `normals`, as detection states it.
    """

    pixels: FloatArray
    normals: FloatArray
    sigma_px: FloatArray

    def __post_init__(self) -> None:
        n = len(np.asarray(self.pixels))
        for name, shape in (("pixels", (n, 2)), ("normals", (n, 2)), ("sigma_px", (n,))):
            object.__setattr__(self, name, as_float_array(getattr(self, name), shape, name))

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True, eq=False)
class ScanLine:
    """The beams of a scan that hit one flat panel, in ascending angle.

    Attributes
    ----------
    angle_rad, range_m : (N,)
    intensity : (N,) or None
    sigma_m : (N,)
        Standard deviation of the ranges, as stated by the user or by detection from their scatter.
    """

    angle_rad: FloatArray
    range_m: FloatArray
    sigma_m: FloatArray
    intensity: FloatArray | None = None

    def __post_init__(self) -> None:
        n = len(np.asarray(self.angle_rad))
        for name in ("angle_rad", "range_m", "sigma_m"):
            object.__setattr__(self, name, as_float_array(getattr(self, name), (n,), name))
        if self.intensity is not None:
            object.__setattr__(self, "intensity", as_float_array(self.intensity, (n,), "intensity"))

    def __len__(self) -> int:
        return len(self.angle_rad)

    def points_lidar(self) -> FloatArray:
        """Points (N, 2) in the scan plane."""
        return polar_to_points(self.angle_rad, self.range_m)


@dataclass(frozen=True)
class LeftOut:
    """Something that was not used, and why, in words for the user."""

    what: str
    reason: str


@dataclass(frozen=True)
class PlaceObservation:
    """What was found at one stop of the turntable, by panel: key 0 or 1, the panel's index in the session.

    `stripes` is empty for a session without visible stripe. Both mappings may lack a panel that was not hit.
    """

    position: str
    turntable_angle_rad: float
    stripes: Mapping[int, StripePoints]
    scan_lines: Mapping[int, ScanLine]
    placement: str = DEFAULT_PLACEMENT


@dataclass(frozen=True)
class TurntableObservations:
    """Everything that estimation of a turntable session needs, and nothing of its files.

    Attributes
    ----------
    corners
        By placement: the corners of each panel, in the session's order of panels.
    left_out
        Places and features that detection gave up, each with its reason.
    """

    camera: Camera
    panels: tuple[Panel, ...]
    corners: Mapping[str, tuple[PanelCorners, ...]]
    places: tuple[PlaceObservation, ...]
    lidar: LidarSpec = field(default_factory=LidarSpec)
    left_out: tuple[LeftOut, ...] = ()


@dataclass(frozen=True)
class PlaceFeatures:
    """What detection alone can tell of one stop: stripes by panel, and straight lines of the scan that nobody owns yet.

    Which of the `lines` lies on which panel is decided afterwards, by evidence, from all places together.
    """

    position: str
    turntable_angle_rad: float
    stripes: Mapping[int, StripePoints]
    lines: tuple[ScanLine, ...]
    placement: str = DEFAULT_PLACEMENT
