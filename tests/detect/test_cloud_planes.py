"""Planes and corners in simulated clouds, dense and sparse, against the truth."""

from typing import Any

import numpy as np
import pytest

from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.detect.trihedral_corner import find_corners
from lidarpose.geometry.arrays import FloatArray, angle_between, unit
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.solve.corner_matching import match_corners


def three_faces_and_clutter(n: int, small_share: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Two large faces, a small one and 30 % clutter, 5 mm noise; and the faces' normals."""
    rng = np.random.default_rng(seed)
    normals = np.array([[0.0, 0.0, 1.0], [-1.0, 0.1, 0.0], [-0.1, -1.0, 0.0]])
    normals = unit(normals)
    corner = np.array([3.0, 2.0, -1.0])
    parts = []
    for k, share in enumerate((0.7 - small_share) * np.array([0.5, 0.5, 0.0]) + small_share * np.array([0, 0, 1.0])):
        u, v = np.linalg.svd(normals[k][None])[2][1:]
        size = 0.3 if k == 2 else 1.5
        flat = rng.uniform(-size, size, (int(n * share), 2))
        shift = np.array([-1.6, -0.2, 0.4]) if k == 2 else np.zeros(3)
        shift = shift - (shift @ normals[k]) * normals[k]
        points = corner + shift + flat @ np.stack([u, v])
        parts.append(points + rng.normal(0.0, 0.005, (len(points), 1)) * normals[k])
    parts.append(corner + rng.uniform(-1.5, 1.5, (n - sum(len(p) for p in parts), 3)))
    points = np.concatenate(parts)
    return points[rng.permutation(n)], normals


@pytest.mark.parametrize("n", [60_000, 300_000])
def test_three_faces_are_found_among_clutter_the_small_one_too(n: int) -> None:
    points, normals = three_faces_and_clutter(n, 0.02, 1)
    patches = segment_planes(points, PlaneSearch(max_planes=6))
    for normal in normals:
        errors = [float(angle_between(p.plane.normal * np.sign(p.plane.normal @ normal), normal)) for p in patches]
        assert np.degrees(min(errors)) < 0.1
    belonging = np.concatenate([p.indices for p in patches])
    assert len(np.unique(belonging)) == len(belonging)


def test_the_same_seed_gives_the_same_planes() -> None:
    points, _ = three_faces_and_clutter(20_000, 0.05, 2)
    first, again = segment_planes(points), segment_planes(points)
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a.indices, b.indices)


def test_scattered_points_have_no_planes_and_few_points_no_answer() -> None:
    rng = np.random.default_rng(3)
    assert segment_planes(rng.uniform(-2.0, 2.0, (5000, 3))) == ()
    assert segment_planes(np.zeros((0, 3))) == ()
    assert segment_planes(rng.normal(size=(5, 3))) == ()


def scanner_that_sees_its_mount(seed: int, step_deg: tuple[float, float] = (0.5, 2.0)) -> tuple[FloatArray, FloatArray]:
    """A half-plane scanner that turns about the vertical in a room, 8 mm noise; and which points are of its mount,
    a round foot 0.11 m below it, where all sweeps meet, with smears out to the room's floor."""
    rng = np.random.default_rng(seed)
    elevation, azimuth = np.radians(
        np.meshgrid(np.arange(-89.9, 90.0, step_deg[0]), np.arange(0.3, 360.0, step_deg[1]))
    )
    d = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    d = d.reshape(-1, 3)
    room = np.where(d > 0, np.array([2.5, 3.0, 1.7]) / d, np.array([-2.0, -1.5, -1.3]) / d).min(axis=1)
    below = np.degrees(elevation.ravel())
    foot = 0.11 + 0.02 * np.clip((below + 90.0) / 30.0, 0.0, 1.0)
    smear = rng.uniform(foot, 0.7)
    mount = below < -55.0
    ranges = np.where(below < -60.0, foot, np.where(mount, smear, room)) + rng.normal(0.0, 0.008, len(d))
    return ranges[:, None] * d, mount


def test_the_scanners_own_mount_is_no_plane() -> None:
    for seed in range(3):
        points, mount = scanner_that_sees_its_mount(seed)
        patches = segment_planes(points, PlaneSearch(from_sensor=True, seed=seed))
        assert sum(len(p) > 1000 for p in patches) == 6
        for patch in patches:
            assert np.count_nonzero(mount[patch.indices]) < 0.05 * np.count_nonzero(mount)


@pytest.mark.parametrize("target", ["cube", "concave", "oblique"])
@pytest.mark.parametrize("lidar", ["hdl32", "turntable"])
def test_the_target_is_told_from_clutter_by_its_moves(target: Any, lidar: Any) -> None:
    spec = CornerSceneSpec(target=target, frames=1, places=4, room=True, clutter=8, seed=7, lidar=lidar)
    session, truth = simulate_corner_session(spec)
    candidates = []
    for place in session.places:
        points = place.clouds[0].load().points
        candidates.append(find_corners(points, segment_planes(points)))
    matches = match_corners(candidates, np.stack([p.corner_world for p in session.places]))
    assert matches[0].places == 4
    for here, k, corner in zip(candidates, matches[0].choice, truth.corners_lidar, strict=True):
        assert k is not None
        assert np.linalg.norm(here[k].corner - corner) < 0.04


def test_the_mount_is_no_plane_in_a_dense_cloud_either() -> None:
    points, mount = scanner_that_sees_its_mount(0, step_deg=(0.2, 1.0))
    assert len(points) > 300_000
    patches = segment_planes(points, PlaneSearch(from_sensor=True))
    assert sum(len(p) > 9000 for p in patches) == 6
    for patch in patches:
        assert np.count_nonzero(mount[patch.indices]) < 0.05 * np.count_nonzero(mount)


def sagging_floor(count: int, sag_m: float) -> FloatArray:
    """A floor of 4 x 4 m, 1.5 m below the sensor, that sags in the middle, and a wall; noise of 3 mm across."""
    rng = np.random.default_rng(5)
    x, y = rng.uniform(0.5, 4.5, count), rng.uniform(-2.0, 2.0, count)
    z = -1.5 - sag_m * np.sin(np.pi * (x - 0.5) / 4.0) + rng.normal(0.0, 0.003, count)
    wall = np.column_stack(
        [
            4.5 + rng.normal(0.0, 0.003, count // 2),
            rng.uniform(-2.0, 2.0, count // 2),
            rng.uniform(-1.4, 1.0, count // 2),
        ]
    )
    return np.concatenate([np.column_stack([x, y, z]), wall])


@pytest.mark.parametrize("count", [20_000, 200_000])
def test_a_bent_surface_is_found_whole_if_asked_for(count: int) -> None:
    points = sagging_floor(count, 0.03)
    for seed in range(3):
        pieces = segment_planes(points, PlaneSearch(from_sensor=True, seed=seed))
        whole = segment_planes(points, PlaneSearch(from_sensor=True, seed=seed, bent=True))
        share = [max(np.count_nonzero(p.indices < count) for p in found) / count for found in (pieces, whole)]
        assert share[0] < 0.8
        assert share[1] > 0.9
        floor = max(whole, key=lambda p: np.count_nonzero(p.indices < count))
        assert np.degrees(np.arccos(abs(floor.plane.normal[2]))) < 0.5
        assert (np.diff(floor.indices) > 0).all()
        assert len(np.unique(np.concatenate([p.indices for p in whole]))) == sum(len(p) for p in whole)


@pytest.mark.parametrize("count", [20_000, 200_000])
def test_flat_surfaces_are_found_as_ever_if_bent_ones_are_asked_for(count: int) -> None:
    points = sagging_floor(count, 0.0)
    plain = segment_planes(points, PlaneSearch(from_sensor=True))
    asked = segment_planes(points, PlaneSearch(from_sensor=True, bent=True))
    assert len(plain) == len(asked)
    for a, b in zip(plain, asked, strict=True):
        np.testing.assert_array_equal(a.indices, b.indices)
