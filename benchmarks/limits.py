"""The Cramer-Rao bound of a turntable rig, from a measurement function that shares nothing with the estimator."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.observation import StripePoints
from lidarpose.model.turntable import TurntableMotion
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import TurntableRig

CORNER_PX, STRIPE_PX = 0.1, 0.15
STEP_PX = 12.0
N_MOTION, N_PANELS = 10, 12
_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class _Seen:
    """What the clean data of one placement consist of.

    Attributes
    ----------
    stripes
        Place and panel of each stripe, the rays (N, 3) through its points, and how they change (N, 3) a pixel along
        the points' normals; none where no camera sees it.
    beams
        By place and panel, the angles (N,) of the beams that hit it.
    """

    stripes: list[tuple[int, int, FloatArray, FloatArray]]
    beams: list[dict[int, FloatArray]]


def motion_bound(rig: TurntableRig, *, with_stripe: bool = True) -> FloatArray:
    """Cramer-Rao bound (10, 10) of the motion, the panels' poses estimated too; central differences.

    Corners of `CORNER_PX`, stripe points of `STRIPE_PX` a pixel along the stripe, the rig's own range noise. Each
    placement of the board has panels of its own, so its information on the motion adds up.
    """
    total = np.zeros((N_MOTION, N_MOTION))
    for name in rig.T_camera_panel:
        information = _information(_one_placement(rig, name), with_stripe)
        m, p = slice(0, N_MOTION), slice(N_MOTION, None)
        total += information[m, m] - information[m, p] @ np.linalg.solve(information[p, p], information[p, m])
    return np.asarray(np.linalg.inv(total))


def pose_limits(rig: TurntableRig, bound: FloatArray, reading: float) -> tuple[float, float]:
    """Standard deviations that the bound allows at a reading: of the centre in metres, of the rotation in radians."""
    J = rig.motion.pose_jacobian(reading)
    centre = rig.motion.pose(reading).translation
    J_centre = J[:3] + np.array([np.cross(J[3:, k], centre) for k in range(N_MOTION)]).T
    metres = np.sqrt(np.trace(J_centre @ bound @ J_centre.T))
    return float(metres), float(np.sqrt(np.trace(J[3:] @ bound @ J[3:].T)))


def _one_placement(rig: TurntableRig, name: str) -> TurntableRig:
    places = [k for k, placement in enumerate(rig.placement) if placement == name]
    return replace(
        rig,
        T_camera_panel={name: rig.T_camera_panel[name]},
        turntable_angle_rad=rig.turntable_angle_rad[places],
        placement=(name,) * len(places),
    )


def _information(rig: TurntableRig, with_stripe: bool) -> FloatArray:
    """Information (22, 22) on the motion and both panels' poses."""
    clean = simulate_observations(
        rig,
        corner_sigma_px=0.0,
        stripe_sigma_px=0.0,
        range_sigma_m=0.0,
        stripe_step_px=STEP_PX,
        with_stripe=with_stripe,
    )
    seen = _Seen(
        [(i, k, *_rays(rig, s)) for i, p in enumerate(clean.places) for k, s in p.stripes.items()],
        [{k: line.angle_rad for k, line in p.scan_lines.items()} for p in clean.places],
    )
    columns = [
        (_measurements(_moved(rig, step), seen) - _measurements(_moved(rig, -step), seen)) / (2.0 * _STEP)
        for step in _STEP * np.eye(N_MOTION + N_PANELS)
    ]
    J = np.column_stack(columns)
    return np.asarray(J.T @ J)


def _measurements(rig: TurntableRig, seen: _Seen) -> FloatArray:
    """Corners, stripe offsets and ranges of a rig, each over its standard deviation, straight from geometry."""
    (poses,) = rig.T_camera_panel.values()
    out = [
        rig.camera.project(pose @ panel.corners_panel()).ravel() / CORNER_PX
        for pose, panel in zip(poses, rig.panels, strict=True)
    ]
    for place, k, rays, slopes in seen.stripes:
        # The stripe and the camera's centre span a plane: how far along the normal until the ray lies in it.
        panel, lidar = poses[k], rig.T_camera_lidar(place)
        n, m = panel.rotation[:, 2], lidar.rotation[:, 2]
        normal = (panel.translation @ n) * m - (lidar.translation @ m) * n
        out.append(-(rays @ normal) / (slopes @ normal) / (STRIPE_PX / np.sqrt(STEP_PX)))
    for place, beams in enumerate(seen.beams):
        for k, angle in beams.items():
            T = rig.T_panel_lidar(place, k)
            height = np.cos(angle) * T.rotation[2, 0] + np.sin(angle) * T.rotation[2, 1]
            out.append(-T.translation[2] / height / rig.range_sigma_m)
    return np.concatenate(out)


def _rays(rig: TurntableRig, stripe: StripePoints) -> tuple[FloatArray, FloatArray]:
    """Rays (N, 3) through a stripe's points, and their derivative (N, 3) by a pixel along the points' normals."""
    h = 0.01
    ahead, behind = (rig.camera.rays(stripe.pixels + sign * h * stripe.normals) for sign in (1.0, -1.0))
    return rig.camera.rays(stripe.pixels), (ahead - behind) / (2.0 * h)


def _moved(rig: TurntableRig, step: FloatArray) -> TurntableRig:
    """The rig after a step in the ten numbers of the motion and six a panel."""
    T = Pose.exp(step[:6]) @ rig.motion.T_camera_turntable
    mount = rig.motion.T_turntable_lidar
    lidar = Pose(Pose.exp(np.r_[0, 0, 0, step[7:10]]).rotation @ mount.rotation, mount.translation + [step[6], 0, 0])
    ((name, poses),) = rig.T_camera_panel.items()
    panels = tuple(Pose.exp(step[10 + 6 * k : 16 + 6 * k]) @ p for k, p in enumerate(poses))
    return replace(rig, motion=TurntableMotion(T, lidar), T_camera_panel={name: panels})
