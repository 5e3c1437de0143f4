"""The turntable paper from observations to the LiDAR's pose at any reading: method `paper`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import angle_between
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import UncertainPose
from lidarpose.model.camera import Camera
from lidarpose.model.observation import LeftOut, PanelCorners, PlaceObservation, TurntableObservations
from lidarpose.model.turntable import TurntableMotion
from lidarpose.solve.light_plane import StripePair, fit_light_planes, stripe_on_panel, stripe_pair
from lidarpose.solve.line_pair import fit_line_pairs, fit_scan_lines
from lidarpose.solve.panel_pose import PanelPose, panel_pose
from lidarpose.solve.single_pose import single_poses
from lidarpose.solve.turntable_function import (
    FunctionDeviations,
    fit_by_circles,
    fit_by_readings,
    require_readings,
)

LEAST_STRIPE_POINTS = 5
LEAST_SCAN_POINTS = 5
# Panels, or the two stripes, closer to parallel than this fix E only to centimetres.
LEAST_ANGLE_RAD = np.deg2rad(3.0)


@dataclass(frozen=True, eq=False)
class PaperSolution:
    """What the paper's closed forms make of a session.

    Attributes
    ----------
    motion
        The LiDAR's pose as a function of the reading.
    panel_poses
        By placement of the board, one a panel.
    samples
        The pose T_camera_lidar of each place that was used, by position (section 1).
    deviations
        Of the function from the samples (Table 1), in the order of `samples`.
    left_out
        Places that were not used, each with its reason.
    """

    motion: TurntableMotion
    panel_poses: Mapping[str, tuple[PanelPose, ...]]
    samples: Mapping[str, UncertainPose]
    deviations: FunctionDeviations
    left_out: tuple[LeftOut, ...]


def solve_paper(
    observations: TurntableObservations,
    *,
    function: Literal["readings", "circles"] = "readings",
    stripe_pairs: Mapping[str, StripePair] | None = None,
    panel_poses: Mapping[str, tuple[PanelPose, ...]] | None = None,
) -> PaperSolution:
    """Sections 1 and 2 of the paper.

    Parameters
    ----------
    observations
        Stripes and scan lines already assigned to their panels.
    function
        How section 2 is done, see `lidarpose.solve.turntable_function`.
    stripe_pairs
        By position, light planes and stripes that were fitted to these observations before (by `assign`); those of
        other places are fitted here.
    panel_poses
        By placement, as `board_poses` finds them, if they are known.

    Raises
    ------
    UndeterminedError
        If the board's panels are parallel, or fewer than three places at different readings can be used.
    """
    if observations.places and not any(len(s) for place in observations.places for s in place.stripes.values()):
        raise UndeterminedError(
            "The paper's method needs the laser's stripe, and no image shows it",
            remedy="Make the stripe visible (dark room, long exposure, no infrared filter), or record several "
            "placements of the board and use the joint estimate",
            details=tuple(f"{item.what}: {item.reason}" for item in observations.left_out),
        )
    if panel_poses is None:
        panel_poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    samples, left_out = _samples(observations, panel_poses, stripe_pairs or {})
    angles = [place.turntable_angle_rad for place in observations.places if place.position in samples]
    details = tuple(f"{item.what}: {item.reason}" for item in (*observations.left_out, *left_out))
    try:
        require_readings(np.array(angles))
    except UndeterminedError as error:
        raise UndeterminedError(error.what, remedy=error.remedy, details=details) from None
    poses = [sample.pose for sample in samples.values()]
    if function == "circles":
        fitted = fit_by_circles(angles, poses)
    else:
        fitted = fit_by_readings(angles, poses, [sample.covariance for sample in samples.values()])
    for position, good in zip(samples, fitted.inliers, strict=True):
        if not good:
            left_out.append(LeftOut(f"position {position}", "its pose does not fit the motion of the other places"))
    return PaperSolution(fitted.motion, panel_poses, samples, fitted.deviations, tuple(left_out))


def board_poses(camera: Camera, corners: Sequence[PanelCorners], placement: str = "") -> tuple[PanelPose, ...]:
    """Poses of a board's panels from their corners (section 1.2).

    Raises
    ------
    UndeterminedError
        If a panel has no pose, or two are parallel; the message names the board's `placement`.
    """
    where = f" of placement {placement}" if placement else ""
    try:
        poses = tuple(panel_pose(camera, panel) for panel in corners)
    except ValueError as reason:
        raise UndeterminedError(
            f"The panels{where} have no pose in the camera frame: {reason}",
            remedy="Record a board image that shows every corner of both panels",
        ) from None
    planes = [Plane.from_pose(p.T_camera_panel) for p in poses]
    for a in range(len(planes)):
        for b in range(a + 1, len(planes)):
            angle = float(angle_between(planes[a].normal, planes[b].normal))
            if min(angle, np.pi - angle) < LEAST_ANGLE_RAD:
                raise UndeterminedError(
                    f"The two panels{where} are parallel (to {np.rad2deg(min(angle, np.pi - angle)):.1f} degrees), "
                    "so the two stripes lie on one line and the LiDAR may slide along it",
                    remedy="Fold the board to a V, best between 90 and 150 degrees, and record again",
                )
    return poses


def _samples(
    observations: TurntableObservations,
    panel_poses: Mapping[str, Sequence[PanelPose]],
    known: Mapping[str, StripePair],
) -> tuple[dict[str, UncertainPose], list[LeftOut]]:
    """T_camera_lidar at each place (section 1), by position; and the places that have none, with the reason.

    `known`: stripes that are fitted already, by position.
    """
    stripes, reasons = _stripes(observations, panel_poses, known)
    left_out = [LeftOut(f"position {position}", reason) for position, reason in reasons.items()]
    places = [place for place in observations.places if place.position in stripes]
    if not places:
        return {}, left_out
    fits = fit_scan_lines([place.scan_lines[key] for key in (0, 1) for place in places])
    first = np.arange(len(places))
    own = [stripes[place.position] for place in places]
    alpha = np.array([s.alpha_rad for s in own])
    lines = fit_line_pairs(fits.take(first), fits.take(first + len(places)), alpha)
    usable = np.flatnonzero(np.isfinite(lines.E_lidar).all(axis=1))
    found = single_poses([own[k] for k in usable], lines.take(usable))
    parallel = np.setdiff1d(first, usable)
    left_out += [LeftOut(f"position {places[k].position}", "its two scan lines are parallel") for k in parallel]
    return {places[k].position: sample for k, sample in zip(usable, found, strict=True)}, left_out


def _stripes(
    observations: TurntableObservations,
    panel_poses: Mapping[str, Sequence[PanelPose]],
    known: Mapping[str, StripePair],
) -> tuple[dict[str, StripePair], dict[str, str]]:
    """Both stripes of each place that can be used, by position, fitted unless `known`; and why others cannot."""
    reasons = {p.position: reason for p in observations.places if (reason := _missing(p)) is not None}
    usable = [p for p in observations.places if p.position not in reasons]
    found = {p.position: known[p.position] for p in usable if p.position in known}
    new = [p for p in usable if p.position not in known]
    on_panels = []
    for place in new:
        poses = [panel_poses[place.placement][key].T_camera_panel for key in (0, 1)]
        first, second = (stripe_on_panel(observations.camera, poses[k], place.stripes[k]) for k in (0, 1))
        on_panels.append((first, second))
    for place, points, light in zip(new, on_panels, fit_light_planes(on_panels), strict=True):
        first_panel, second_panel = (Plane.from_pose(p.T_camera_panel) for p in panel_poses[place.placement][:2])
        try:
            if isinstance(light, ValueError):
                raise light
            found[place.position] = stripe_pair((first_panel, second_panel), points, light)
        except ValueError as reason:
            reasons[place.position] = str(reason)
    for position, pair in list(found.items()):
        if min(pair.alpha_rad, np.pi - pair.alpha_rad) < LEAST_ANGLE_RAD:
            reasons[position] = "the two stripes are nearly parallel, so the LiDAR may slide along them"
            del found[position]
    return found, reasons


def _missing(place: PlaceObservation) -> str | None:
    for key in (0, 1):
        if key not in place.stripes or len(place.stripes[key]) < LEAST_STRIPE_POINTS:
            return f"no usable stripe on panel {key + 1}"
        if key not in place.scan_lines or len(place.scan_lines[key]) < LEAST_SCAN_POINTS:
            return f"no usable scan line on panel {key + 1}"
    return None
