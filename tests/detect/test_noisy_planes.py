"""Planes in noise of centimetres: a carton's faces as 16 scan lines see them, few returns at a time, and no planes in
none."""

import numpy as np

from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.detect.noisy_planes import segment_noisy_planes
from lidarpose.detect.trihedral_corner import find_corners
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.cloud import Cloud
from lidarpose.model.corner_session import CornerPlace, MemoryCloud
from lidarpose.model.plane_patch import PlanePatch
from lidarpose.workflows.corner_target import noisy_corners

YAW = np.radians(-40.0)
EDGES = np.array([[np.cos(YAW), np.sin(YAW), 0.0], [-np.sin(YAW), np.cos(YAW), 0.0], [0.0, 0.0, -1.0]])


def carton(corner: FloatArray, side_m: float, sigma_m: float, step_deg: float, rng: np.random.Generator) -> FloatArray:
    """A carton on the ground as 16 beams see it: the nearest of ground and faces along each, plus noise."""
    elevation, azimuth = np.meshgrid(
        np.radians(np.arange(-23.0, 9.0, 2.0)), np.radians(np.arange(-40.0, 40.0, step_deg))
    )
    rays = np.column_stack(
        [
            (np.cos(elevation) * np.cos(azimuth)).ravel(),
            (np.cos(elevation) * np.sin(azimuth)).ravel(),
            np.sin(elevation).ravel(),
        ]
    )
    with np.errstate(divide="ignore"):
        range_m = np.where(rays[:, 2] < 0.0, (corner[2] - side_m) / rays[:, 2], np.inf)
        for k in range(3):
            reach = (EDGES[k] @ corner) / (rays @ EDGES[k])
            along = (rays * reach[:, None] - corner) @ np.delete(EDGES, k, axis=0).T
            on = (reach > 0.0) & (along >= 0.0).all(axis=1) & (along <= side_m).all(axis=1)
            range_m = np.where(on & (reach < range_m), reach, range_m)
    seen = range_m < 15.0
    noisy = range_m[seen] + rng.normal(0.0, sigma_m, int(seen.sum()))
    return np.asarray(rays[seen] * noisy[:, None])


def nearest_m(points: FloatArray, patches: tuple[PlanePatch, ...], corner: FloatArray) -> float:
    found = find_corners(points, patches)
    return min((float(np.linalg.norm(c.corner - corner)) for c in found if c.convex), default=np.inf)


def test_a_corner_is_found_in_half_of_the_scans_with_30_mm_of_noise() -> None:
    rng = np.random.default_rng(3)
    corner = np.array([1.9, -0.1, -0.55])
    search = PlaneSearch(min_points=15, from_sensor=True)
    scans = [carton(corner, 0.6, 0.03, 0.2, rng) for _ in range(4)]
    off_m = np.array([nearest_m(points, segment_noisy_planes(points), corner) for points in scans])
    # One slab of one width for ground and faces misses them.
    assert np.isinf([nearest_m(points, segment_planes(points, search), corner) for points in scans]).all()
    assert np.count_nonzero(off_m < 0.05) >= 2


def test_frames_together_show_faces_of_few_returns_each() -> None:
    corner = np.array([1.4, 0.1, -0.45])
    alone = together = 0
    for seed in range(4, 10):
        rng = np.random.default_rng(seed)
        frames = [carton(corner, 0.27, 0.01, 2.0, rng) for _ in range(10)]
        clouds = tuple(MemoryCloud(str(k), Cloud(points)) for k, points in enumerate(frames))
        for count in (1, 10):
            found = noisy_corners(CornerPlace("a", corner, clouds[:count]), None)
            seen = any(c.convex and np.linalg.norm(c.corner - corner) < 0.03 for c in found)
            alone, together = alone + (seen and count == 1), together + (seen and count == 10)
    assert alone == 0
    assert together >= 3


def test_patches_say_where_planes_are_and_scattered_points_have_none() -> None:
    rng = np.random.default_rng(5)
    points = carton(np.array([1.9, -0.1, -0.55]), 0.6, 0.02, 0.2, rng)
    patches = segment_noisy_planes(points, range_sigma_m=0.02)
    truth = [*(-EDGES), np.array([0.0, 0.0, 1.0])]
    big = [p for p in patches if len(p) > 100]
    assert len(big) >= 3
    for patch in big:
        assert max(float(n @ patch.plane.normal) for n in truth) > np.cos(np.radians(6.0))
        assert patch.plane.offset < 0.0
        assert np.abs(patch.plane.distance(points[patch.indices])).mean() < 0.03
    owners = np.concatenate([p.indices for p in patches])
    assert len(np.unique(owners)) == len(owners)
    scattered = rng.uniform(-1.0, 1.0, (3000, 3)) + np.array([4.0, 0.0, 0.0])
    assert len(segment_noisy_planes(scattered, range_sigma_m=0.02)) == 0
    assert segment_noisy_planes(points[:4]) == ()
    assert segment_noisy_planes(np.repeat(points[:1], 50, axis=0)) == ()


def test_beams_without_return_at_the_origin_count_for_nothing() -> None:
    rng = np.random.default_rng(5)
    points = carton(np.array([1.9, -0.1, -0.55]), 0.6, 0.02, 0.2, rng)
    alone = segment_noisy_planes(points, range_sigma_m=0.02)
    with_them = segment_noisy_planes(np.concatenate([points, np.zeros((3000, 3))]), range_sigma_m=0.02)
    assert [p.indices.tolist() for p in with_them] == [p.indices.tolist() for p in alone]
