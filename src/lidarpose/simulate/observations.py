"""What a perfect detector would find on a rig, straight from geometry, with noise and blunders as asked for.

With every sigma at zero the observations are exact to rounding: corners, stripe points and ranges satisfy the rig.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, unit
from lidarpose.model.observation import PanelCorners, PlaceObservation, ScanLine, StripePoints, TurntableObservations
from lidarpose.simulate.board_pattern import is_black
from lidarpose.simulate.light_sheet import beams_to_panel
from lidarpose.simulate.rig import TurntableRig

ALBEDO_WHITE = 0.85
ALBEDO_BLACK = 0.07
# A stated sigma must be positive, even where nothing is noisy.
_LEAST_SIGMA_PX = 1e-3
_LEAST_SIGMA_M = 1e-6


@dataclass(frozen=True)
class Blunders:
    """What goes wrong beyond noise.

    Attributes
    ----------
    stripe_share, stripe_px
        Share of stripe points that lie anywhere within `stripe_px` of the stripe (glare, other bright things).
    range_share, range_m
        Share of beams whose range is off by anything up to `range_m` (mixed pixels).
    range_offset_m
        Added to every range (an offset of the instrument).
    black_range_bias_m
        Added to ranges on black squares.
    corner_share, corner_px
        Share of corners off by anything up to `corner_px`.
    """

    stripe_share: float = 0.0
    stripe_px: float = 30.0
    range_share: float = 0.0
    range_m: float = 0.1
    range_offset_m: float = 0.0
    black_range_bias_m: float = 0.0
    corner_share: float = 0.0
    corner_px: float = 5.0


def simulate_observations(
    rig: TurntableRig,
    *,
    corner_sigma_px: float = 0.1,
    stripe_sigma_px: float = 0.15,
    range_sigma_m: float | None = None,
    turntable_sigma_rad: float = 0.0,
    stripe_step_px: float = 1.0,
    with_stripe: bool = True,
    blunders: Blunders | None = None,
    seed: int = 0,
) -> TurntableObservations:
    """Corners, stripe points and scan lines of a rig.

    Parameters
    ----------
    corner_sigma_px, stripe_sigma_px
        Standard deviation of each corner coordinate, and of stripe points across the stripe.
    range_sigma_m
        Standard deviation of ranges; the rig's own unless given.
    turntable_sigma_rad
        Standard deviation of the readings (zero: they are exact).
    stripe_step_px
        Distance between neighbouring points along the stripe, on average.
    with_stripe
        False for a session whose stripe no camera can see.
    blunders
        Errors beyond noise; none unless given.
    """
    rng = np.random.default_rng([seed, 1])
    wrong = blunders or Blunders()
    sigma_m = rig.range_sigma_m if range_sigma_m is None else range_sigma_m
    corners = {
        name: tuple(_corners(rig, name, k, corner_sigma_px, wrong, rng) for k in range(len(rig.panels)))
        for name in rig.T_camera_panel
    }
    places = []
    for place in range(len(rig)):
        stripes: dict[int, StripePoints] = {}
        lines: dict[int, ScanLine] = {}
        for panel in range(len(rig.panels)):
            stripe = _stripe(rig, place, panel, stripe_sigma_px, stripe_step_px, wrong, rng)
            if with_stripe and stripe is not None:
                stripes[panel] = stripe
            line = _scan_line(rig, place, panel, sigma_m, wrong, rng)
            if line is not None:
                lines[panel] = line
        reading = float(rig.turntable_angle_rad[place] + turntable_sigma_rad * rng.standard_normal())
        places.append(PlaceObservation(f"{place:03d}", reading, stripes, lines, rig.placement[place]))
    return TurntableObservations(rig.camera, rig.panels, corners, tuple(places), rig.lidar)


def _corners(
    rig: TurntableRig, placement: str, panel: int, sigma_px: float, wrong: Blunders, rng: np.random.Generator
) -> PanelCorners:
    corners_panel = rig.panels[panel].corners_panel()
    pixels = rig.camera.project(rig.T_camera_panel[placement][panel] @ corners_panel)
    pixels = pixels + sigma_px * rng.standard_normal(pixels.shape)
    bad = rng.random(len(pixels)) < wrong.corner_share
    pixels = pixels + bad[:, None] * rng.uniform(-wrong.corner_px, wrong.corner_px, pixels.shape)
    return PanelCorners(corners_panel, pixels, np.full(len(pixels), max(sigma_px, _LEAST_SIGMA_PX)))


def _stripe(
    rig: TurntableRig,
    place: int,
    panel: int,
    sigma_px: float,
    step_px: float,
    wrong: Blunders,
    rng: np.random.Generator,
) -> StripePoints | None:
    """Points on the light sheet's line on a panel, displaced across their image."""
    ends = rig.chord(place, panel)
    if ends is None:
        return None
    T_camera_panel = rig.T_camera_panel[rig.placement[place]][panel]
    ends_camera = T_camera_panel @ ends
    length_px = float(np.linalg.norm(np.diff(rig.camera.project(ends_camera), axis=0)))
    count = int(length_px / step_px)
    if count < 2:
        return None
    share = (np.arange(count) + 0.5) / count
    points = (1.0 - share[:, None]) * ends_camera[0] + share[:, None] * ends_camera[1]
    pixels, J = rig.camera.project_with_jacobian(points)
    tangent = unit(J @ (ends_camera[1] - ends_camera[0]))
    normals = np.column_stack([-tangent[:, 1], tangent[:, 0]])
    off = sigma_px * rng.standard_normal(count)
    bad = rng.random(count) < wrong.stripe_share
    off = off + bad * rng.uniform(-wrong.stripe_px, wrong.stripe_px, count)
    return StripePoints(pixels + off[:, None] * normals, normals, np.full(count, max(sigma_px, _LEAST_SIGMA_PX)))


def _scan_line(
    rig: TurntableRig, place: int, panel: int, sigma_m: float, wrong: Blunders, rng: np.random.Generator
) -> ScanLine | None:
    """The beams that hit a panel, away from its edges by half a beam's footprint."""
    ranges, points = beams_to_panel(rig.T_panel_lidar(place, panel), rig.beam_angle_rad)
    on = (ranges > 0.0) & rig.plates[panel].contains(points, inset_m=0.004)
    if np.count_nonzero(on) < 2:
        return None
    black = is_black(rig.panels[panel], points[on])
    intensity = reflected(rig, place, panel, rig.beam_angle_rad[on], black)
    noisy = ranges[on] + sigma_m * rng.standard_normal(len(black)) + wrong.range_offset_m
    noisy = noisy + wrong.black_range_bias_m * black
    bad = rng.random(len(black)) < wrong.range_share
    noisy = noisy + bad * rng.uniform(-wrong.range_m, wrong.range_m, len(black))
    intensity = intensity * (1.0 + 0.02 * rng.standard_normal(len(black)))
    return ScanLine(
        rig.beam_angle_rad[on], noisy, np.full(len(black), max(sigma_m, _LEAST_SIGMA_M)), np.round(intensity, 1)
    )


def reflected(rig: TurntableRig, place: int, panel: int, angle_rad: FloatArray, black: BoolArray) -> FloatArray:
    """Intensities (N,) of a matt panel: albedo times the cosine of incidence, 1000 for a white face."""
    R = rig.T_panel_lidar(place, panel).rotation
    cosine = np.abs(np.cos(angle_rad) * R[2, 0] + np.sin(angle_rad) * R[2, 1])
    return np.asarray(1000.0 * np.where(black, ALBEDO_BLACK, ALBEDO_WHITE) * cosine)
