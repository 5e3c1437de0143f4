"""Boards and scans alone: the family of poses of one place, the derivatives, the motion from several placements."""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.planes import Plane
from lidarpose.simulate.observations import simulate_observations
from lidarpose.simulate.rig import TurntableRig, draw_rig
from lidarpose.solve.line_pair import fit_scan_line
from lidarpose.solve.planes_only import PlaceOnPlanes, _moved, _System, poses_of_place, solve_planes_only


def exact_places(placements: int) -> tuple[list[PlaceOnPlanes], TurntableRig]:
    rig = draw_rig(11, family="paper", places=5, placements=placements)
    observations = simulate_observations(rig, range_sigma_m=0.0, with_stripe=False)
    places = []
    for p in observations.places:
        T = rig.T_camera_panel[p.placement]
        grids = [panel.corners_panel() for panel in rig.panels]
        places.append(
            PlaceOnPlanes(
                p.turntable_angle_rad,
                (fit_scan_line(p.scan_lines[0]), fit_scan_line(p.scan_lines[1])),
                (Plane.from_pose(T[0]), Plane.from_pose(T[1])),
                (T[0] @ grids[0].mean(axis=0), T[1] @ grids[1].mean(axis=0)),
                (0.35, 0.35),
            )
        )
    return places, rig


def test_the_family_of_poses_puts_both_lines_on_both_planes() -> None:
    places, _ = exact_places(1)
    poses = poses_of_place(places[0], np.deg2rad(np.arange(30.0, 160.0, 10.0)), np.array([-0.1, 0.05]))
    assert len(poses) > 10
    for T in poses:
        for line, plane in zip(places[0].lines, places[0].panels, strict=True):
            ends = T @ np.column_stack([line.ends, np.zeros(2)])
            np.testing.assert_allclose(plane.distance(ends), 0.0, atol=1e-9)


def test_derivatives_agree_with_differences() -> None:
    places, _ = exact_places(1)
    system = _System.of(places)
    rng = np.random.default_rng(0)
    state = np.concatenate([np.linalg.qr(rng.normal(size=(2, 2, 3, 3)))[0], rng.normal(size=(2, 2, 3, 1))], axis=3)
    state[..., :3] *= np.linalg.det(state[..., :3])[..., None, None]
    J = system.residuals(state)[1]
    h = 1e-6
    for k in range(12):
        step = np.zeros((2, 12))
        step[:, k] = h
        numeric = (system.residuals(_moved(state, step))[0] - system.residuals(_moved(state, -step))[0]) / (2 * h)
        np.testing.assert_allclose(J[..., k], numeric, rtol=1e-5, atol=1e-3)


def test_three_placements_give_the_motion_exactly() -> None:
    places, rig = exact_places(3)
    (best, *_) = solve_planes_only(places)
    for place in places:
        metres, radians = best.motion.pose(place.angle_rad).distance(rig.motion.pose(place.angle_rad))
        assert metres < 1e-6
        assert radians < 1e-6
