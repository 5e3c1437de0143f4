"""Observations from geometry: exact without noise, by formulas that the simulator does not use."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

from lidarpose.geometry.se3 import Pose
from lidarpose.model.rig_family import Family
from lidarpose.simulate.observations import Blunders, simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig


def pose_by_matrices(rig: TurntableRig, place: int) -> Pose:
    """T_camera_lidar from 4x4 matrices and the plain definition of the motion."""
    a = rig.turntable_angle_rad[place]
    turn = np.array([[np.cos(a), -np.sin(a), 0, 0], [np.sin(a), np.cos(a), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    m = rig.motion
    return Pose.from_matrix(m.T_camera_turntable.matrix @ turn @ m.T_turntable_lidar.matrix)


def brown(camera: Any, x: Any, y: Any) -> Any:
    """The paper's lens model, written out."""
    k1, k2 = camera.distortion[:2]
    r2 = x * x + y * y
    s = 1 + k1 * r2 + k2 * r2 * r2
    return camera.K[0, 0] * x * s + camera.K[0, 2], camera.K[1, 1] * y * s + camera.K[1, 2]


@pytest.mark.parametrize("family", ["paper", "mixed", "flat-scan-plane", "upside-down"])
def test_exact_observations_satisfy_the_rig(family: Family) -> None:
    rig = draw_rig(11, family=family, places=5)
    observations = simulate_observations(rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0)
    for k, corners in enumerate(observations.corners[""]):
        for X, pixel in zip(corners.corners_panel, corners.pixels, strict=True):
            p = rig.T_camera_panel[""][k].matrix @ [*X, 1.0]
            np.testing.assert_allclose(pixel, brown(rig.camera, p[0] / p[2], p[1] / p[2]), atol=1e-9)
    for i, place in enumerate(observations.places):
        T_camera_lidar = pose_by_matrices(rig, i)
        for k in (0, 1):
            T_camera_panel = rig.T_camera_panel[""][k]
            line = place.scan_lines[k]
            for angle, distance in list(zip(line.angle_rad, line.range_m, strict=True))[::17]:
                # March along the beam until the panel's plane is crossed: no ray-plane formula.
                beam = T_camera_panel.inverse() @ T_camera_lidar, np.array([np.cos(angle), np.sin(angle), 0.0])
                root = brentq(height_above_panel, 0.05, 20.0, args=beam, xtol=1e-14, rtol=1e-14)
                assert abs(root - distance) < 1e-9
            # The panel's plane and the sheet, from three points each, as homogeneous 4-vectors.
            for plane_pose in (T_camera_panel, T_camera_lidar):
                triple = plane_pose @ np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
                normal = np.cross(triple[1] - triple[0], triple[2] - triple[0])
                pixels = place.stripes[k].pixels[::50]
                for pixel in pixels:
                    p = point_on_panel(rig, T_camera_panel, pixel)
                    assert abs((p - triple[0]) @ normal) < 1e-9


def height_above_panel(s: float, T_panel_lidar: Pose, direction_lidar: np.ndarray) -> float:
    return float((T_panel_lidar @ (s * direction_lidar))[2])


def point_on_panel(rig: TurntableRig, T_camera_panel: Pose, pixel: np.ndarray) -> np.ndarray:
    """Where the ray of a pixel meets a panel, by solving for the panel's coordinates (a 3x3 system)."""
    ray = rig.camera.rays(pixel)
    R, t = T_camera_panel.rotation, T_camera_panel.translation
    x, y, _ = np.linalg.solve(np.column_stack([R[:, 0], R[:, 1], -ray]), -t)
    return np.asarray(t + x * R[:, 0] + y * R[:, 1])


def test_stripe_normals_are_across_the_stripe() -> None:
    place = simulate_observations(draw_rig(0, places=3), stripe_sigma_px=0.0).places[1]
    for stripe in place.stripes.values():
        steps = np.diff(stripe.pixels, axis=0)
        # A chord of the slightly bent image of a line: neighbours are nearly perpendicular to the normal.
        assert np.abs((steps * stripe.normals[1:]).sum(axis=1)).max() < 1e-3
        np.testing.assert_allclose(np.linalg.norm(stripe.normals, axis=1), 1.0, atol=1e-12)
        assert 0.8 < np.median(np.linalg.norm(steps, axis=1)) < 1.2


def test_noise_has_the_stated_size() -> None:
    rig = draw_rig(1, places=12)
    clean = simulate_observations(rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0)
    noisy = simulate_observations(rig, corner_sigma_px=0.2, stripe_sigma_px=0.3, range_sigma_m=0.002, seed=4)
    corner = np.concatenate(
        [(n.pixels - c.pixels).ravel() for n, c in zip(noisy.corners[""], clean.corners[""], strict=True)]
    )
    stripes, ranges = [], []
    for n, c in zip(noisy.places, clean.places, strict=True):
        for k in (0, 1):
            stripes.append(((n.stripes[k].pixels - c.stripes[k].pixels) * c.stripes[k].normals).sum(axis=1))
            ranges.append(n.scan_lines[k].range_m - c.scan_lines[k].range_m)
    for sample, sigma in ((corner, 0.2), (np.concatenate(stripes), 0.3), (np.concatenate(ranges), 0.002)):
        assert abs(sample.std() / sigma - 1.0) < 4.0 / np.sqrt(2 * len(sample))
        assert abs(sample.mean()) < 4.0 * sigma / np.sqrt(len(sample))


def test_blunders_do_what_they_say() -> None:
    rig = draw_rig(1, places=12)
    clean = simulate_observations(rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0)
    wrong = Blunders(stripe_share=0.2, range_share=0.1, black_range_bias_m=0.004, range_offset_m=0.5)
    dirty = simulate_observations(
        rig, corner_sigma_px=0.0, stripe_sigma_px=0.0, range_sigma_m=0.0, blunders=wrong, seed=2
    )
    pairs = list(zip(dirty.places, clean.places, strict=True))
    off = np.concatenate([d.scan_lines[0].range_m - c.scan_lines[0].range_m for d, c in pairs])
    dark = np.concatenate([np.asarray(d.scan_lines[0].intensity) < 300.0 for d in dirty.places])
    assert np.median(off[dark]) == pytest.approx(0.504)
    assert np.median(off[~dark]) == pytest.approx(0.5)
    share = np.mean(np.abs(off - np.where(dark, 0.504, 0.5)) > 1e-9)
    assert 0.06 < share < 0.14
    moved = np.concatenate([np.linalg.norm(d.stripes[0].pixels - c.stripes[0].pixels, axis=1) for d, c in pairs])
    assert 0.17 < np.mean(moved > 1e-9) < 0.23
    assert moved.max() <= 30.0


def test_sessions_without_stripe_and_with_placements() -> None:
    rig = draw_rig(1, places=4, placements=2)
    observations = simulate_observations(rig, with_stripe=False)
    assert all(not place.stripes and len(place.scan_lines) == 2 for place in observations.places)
    assert set(observations.corners) == {"placement-1", "placement-2"} == {p.placement for p in observations.places}
