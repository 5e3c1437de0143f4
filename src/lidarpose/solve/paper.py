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
from lidarpose.solve.light_plane import StripePair, stripe_on_panel, stripe_pair
from lidarpose.solve.line_pair import fit_line_pair, fit_scan_line
from lidarpose.solve.panel_pose import PanelPose, panel_pose
from lidarpose.solve.single_pose import single_pose
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
    panel_poses = {name: board_poses(observations.camera, c, name) for name, c in observations.corners.items()}
    samples: dict[str, UncertainPose] = {}
    angles: list[float] = []
    left_out: list[LeftOut] = []
    for place in observations.places:
        try:
            known = (stripe_pairs or {}).get(place.position)
            sample = sample_pose(observations, panel_poses[place.placement], place, known)
        except ValueError as reason:
            left_out.append(LeftOut(f"position {place.position}", str(reason)))
            continue
        samples[place.position] = sample
        angles.append(place.turntable_angle_rad)
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


def sample_pose(
    observations: TurntableObservations,
    panel_poses: tuple[PanelPose, ...],
    place: PlaceObservation,
    stripes: StripePair | None = None,
) -> UncertainPose:
    """T_camera_lidar at one place (section 1); `stripes` if they are fitted already.

    Raises ValueError with the reason if it cannot be found.
    """
    for key in (0, 1):
        if key not in place.stripes or len(place.stripes[key]) < LEAST_STRIPE_POINTS:
            raise ValueError(f"no usable stripe on panel {key + 1}")
        if key not in place.scan_lines or len(place.scan_lines[key]) < LEAST_SCAN_POINTS:
            raise ValueError(f"no usable scan line on panel {key + 1}")
    if stripes is None:
        poses = [panel_poses[key].T_camera_panel for key in (0, 1)]
        points = [stripe_on_panel(observations.camera, poses[key], place.stripes[key]) for key in (0, 1)]
        stripes = stripe_pair((Plane.from_pose(poses[0]), Plane.from_pose(poses[1])), (points[0], points[1]))
    if min(stripes.alpha_rad, np.pi - stripes.alpha_rad) < LEAST_ANGLE_RAD:
        raise ValueError("the two stripes are nearly parallel, so the LiDAR may slide along them")
    lines = fit_line_pair(fit_scan_line(place.scan_lines[0]), fit_scan_line(place.scan_lines[1]), stripes.alpha_rad)
    return single_pose(stripes, lines)
