"""Rigs: every family gives rigs that a person would record with, and what its name says."""

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.model.rig_family import FAMILIES, Family
from lidarpose.simulate.rig import TurntableRig, draw_rig


def scan_plane_to_axis_deg(rig: TurntableRig) -> float:
    normal = rig.motion.T_turntable_lidar.rotation[:, 2]
    return float(np.rad2deg(np.arcsin(abs(normal[2]))))


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_sees_both_panels_from_everywhere(family: Family) -> None:
    for seed in range(2):
        rig = draw_rig(seed, family=family)
        for placement, poses in rig.T_camera_panel.items():
            for T_camera_panel, panel, plate in zip(poses, rig.panels, rig.plates, strict=True):
                assert np.all(rig.camera.contains(rig.camera.project(T_camera_panel @ panel.corners_panel())))
                assert np.all(rig.camera.contains(rig.camera.project(T_camera_panel @ plate.outline())))
                # The printed face looks at the camera and at the LiDAR: both are on the side z < 0.
                assert (T_camera_panel.inverse() @ np.zeros(3))[2] < -0.3
            for place in range(len(rig)):
                if rig.placement[place] == placement:
                    assert all(rig.T_panel_lidar(place, k).translation[2] < -0.3 for k in (0, 1))
        crossed = [all(rig.chord(place, k) is not None for k in (0, 1)) for place in range(len(rig))]
        assert np.mean(crossed) >= 0.97


def test_the_panels_meet_in_one_fold_at_about_120_degrees() -> None:
    rig = draw_rig(3)
    first, second = rig.T_camera_panel[""]
    inside = np.pi - np.arccos(first.rotation[:, 2] @ second.rotation[:, 2])
    assert np.deg2rad(118.0) <= inside <= np.deg2rad(122.0)
    # Each panel's first row lies margin + one square from the fold, in the other panel's plane's direction.
    reach = rig.margin_m + rig.panels[0].square_m
    fold_in_first = np.array([0.0, -reach, 0.0])
    assert abs((second.inverse() @ (first @ fold_in_first))[2]) < 1e-12


def test_the_families_are_what_they_say() -> None:
    def middle(family: Family) -> TurntableRig:
        return draw_rig(5, family=family)

    assert middle("left").T_camera_lidar(40).translation[0] < 0.0 < middle("right").T_camera_lidar(40).translation[0]
    assert middle("axis-up").motion.axis_direction_camera[1] < 0.0 < middle("axis-down").motion.axis_direction_camera[1]
    assert middle("far-axis").motion.radius_m > 0.3 > middle("paper").motion.radius_m
    assert middle("offset-readings").turntable_angle_rad[0] != 0.0 == middle("paper").turntable_angle_rad[0]
    assert scan_plane_to_axis_deg(middle("flat-scan-plane")) > 85.0
    assert scan_plane_to_axis_deg(middle("tilted-scan-plane")) >= 49.9
    assert scan_plane_to_axis_deg(middle("axis-in-scan-plane")) <= 2.1
    assert 3 <= len(middle("few-places")) <= 5
    assert len(middle("many-places")) == 200
    up_right = middle("paper").T_camera_lidar(40).rotation[:, 2] @ [1.0, -1.5, 0.0]
    upside_down = middle("upside-down").T_camera_lidar(40).rotation[:, 2] @ [1.0, -1.5, 0.0]
    assert up_right > 0.0 > upside_down
    folds: dict[Family, int] = {"fold-vertical": 1, "fold-horizontal": 0}
    for family, axis in folds.items():
        rig = draw_rig(5, family=family)
        fold = rig.T_camera_panel[""][0].rotation[:, 0]
        assert np.argmax(np.abs(fold)) == axis


def test_the_default_is_the_papers_set_up() -> None:
    rig = draw_rig(0)
    assert len(rig) == 87
    np.testing.assert_allclose(np.diff(rig.turntable_angle_rad), np.deg2rad(0.25), atol=1e-12)
    assert (rig.camera.width, rig.camera.height) == (1624, 1234)
    assert rig.camera.fx == 2757.4
    np.testing.assert_allclose(np.diff(rig.beam_angle_rad), np.deg2rad(1 / 12), atol=1e-12)


def test_a_seed_decides_everything() -> None:
    first, again, other = draw_rig(7, family="mixed"), draw_rig(7, family="mixed"), draw_rig(8, family="mixed")
    np.testing.assert_array_equal(first.motion.T_camera_turntable.matrix, again.motion.T_camera_turntable.matrix)
    np.testing.assert_array_equal(first.beam_angle_rad, again.beam_angle_rad)
    assert not np.allclose(first.motion.T_camera_turntable.matrix, other.motion.T_camera_turntable.matrix)


def test_placements_are_seen_from_all_readings() -> None:
    rig = draw_rig(2, places=10, placements=3)
    assert len(rig) == 30
    assert len(rig.T_camera_panel) == 3
    np.testing.assert_array_equal(rig.turntable_angle_rad[:10], rig.turntable_angle_rad[20:])


def test_what_is_impossible_is_refused() -> None:
    with pytest.raises(InputError, match="smaller arc"):
        draw_rig(0, places=90, step_deg=2.0)
    with pytest.raises(InputError, match="step"):
        draw_rig(0, step_deg=float("nan"))
    with pytest.raises(InputError, match="family"):
        draw_rig(0, family="nonsense")  # type: ignore[arg-type]


def test_other_boards_and_lenses_are_drawn() -> None:
    rigs = [draw_rig(seed, family="other-boards", places=5) for seed in range(12)]
    assert len({rig.panels for rig in rigs}) >= 5
    assert len({round(rig.margin_m, 4) for rig in rigs}) == len(rigs)
    cameras = [draw_rig(seed, family="other-lenses", places=5, size=(812, 617)).camera for seed in range(12)]
    assert {camera.model for camera in cameras} == {"plumb_bob", "rational_polynomial", "equidistant"}
    assert all((camera.width, camera.height) == (812, 617) for camera in cameras)
    for camera in cameras:
        # Every pixel shows something: the lens has an inverse all over the picture.
        u, v = np.meshgrid(np.linspace(0, 811, 12), np.linspace(0, 616, 12))
        pixels = np.stack([u, v], -1)
        np.testing.assert_allclose(camera.project(camera.rays(pixels)), pixels, atol=1e-6)
