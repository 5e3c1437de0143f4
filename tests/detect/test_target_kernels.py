"""Cutting out the target and telling its faces' beams: kernels and NumPy select the same."""

from typing import Any

import numpy as np
import pytest

from lidarpose.detect.crop import inside_box
from lidarpose.detect.moved_points import moved_points
from lidarpose.detect.trihedral_corner import FaceMask
from lidarpose.geometry import compiled
from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose
from lidarpose.simulate.corner_scene import CornerSceneSpec, TargetKind, simulate_corner_session
from lidarpose.workflows.corner_target import find_target
from lidarpose.workflows.world import calibrate_world

pytestmark = pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")


def some_mask(rng: np.random.Generator, convex: bool) -> FaceMask:
    """A cube's corner some metres away that shows three faces from outside or inside, with ground at its foot."""
    corner = rng.uniform(1.5, 3.0, 3) * rng.choice([-1.0, 1.0], 3)
    towards = unit(corner)
    axes = Pose.exp(np.concatenate([np.zeros(3), rng.normal(size=3)])).rotation
    normals = np.stack([-a * np.sign(a @ towards) for a in axes.T])
    along = -normals if convex else normals
    outlines = []
    for k in range(3):
        u, v = along[(k + 1) % 3], along[(k + 2) % 3]
        angle = np.linspace(0.0, 2.0 * np.pi, 17)[:-1]
        outlines.append(corner + 0.3 * (1.0 + np.cos(angle)[:, None]) * u + 0.3 * (1.0 + np.sin(angle)[:, None]) * v)
    # As corners of faces come: in order as seen from the normal's side.
    ordered = [o if _area(o, n) > 0.0 else o[::-1] for o, n in zip(outlines, normals, strict=True)]
    ground = Plane(normals[0], float(normals[0] @ (corner + 0.4 * along[0])))
    obstacles = (ground,) if rng.random() < 0.5 else ()
    return FaceMask(corner, normals, convex, (ordered[0], ordered[1], ordered[2]), obstacles, 0.005)


def _area(outline: FloatArray, normal: FloatArray) -> float:
    return float(np.cross(outline, np.roll(outline, -1, axis=0)).sum(axis=0) @ normal)


@pytest.mark.parametrize("convex", [True, False])
@pytest.mark.parametrize("gate_m", [0.03, np.inf])
def test_the_same_beams_are_of_each_face(convex: bool, gate_m: float) -> None:
    rng = np.random.default_rng(5)
    selected = 0
    for _ in range(10):
        mask = some_mask(rng, convex)
        directions = unit(mask.corner + rng.uniform(-0.8, 0.8, (4000, 3)))
        with np.errstate(invalid="ignore"):
            range_m = mask.meet(directions)[1] + rng.normal(0.0, 0.02, len(directions))
        with compiled.forced(False):
            index, face = mask.select(directions, range_m, gate_m)
        with compiled.forced(True):
            quick_index, quick_face = mask.select(directions, range_m, gate_m)
        np.testing.assert_array_equal(quick_index, index)
        np.testing.assert_array_equal(quick_face, face)
        selected += len(index)
    assert selected > 3000


@pytest.mark.parametrize("convex", [True, False])
def test_the_same_beams_come_face_by_face(convex: bool) -> None:
    rng = np.random.default_rng(7)
    outside = 0
    for _ in range(5):
        mask = some_mask(rng, convex)
        directions = unit(mask.corner + rng.uniform(-0.8, 0.8, (4000, 3)))
        with np.errstate(invalid="ignore"):
            reach = mask.meet(directions)[1]
        points = directions * np.where(np.isfinite(reach), reach + rng.normal(0.0, 0.02, len(reach)), 1.0)[:, None]
        with compiled.forced(False):
            plain = mask.beams_of(points, 0.05)
        with compiled.forced(True):
            quick = mask.beams_of(points, 0.05)
        index, face = mask.select(directions, np.linalg.norm(points, axis=1), 0.05)
        for j, (one, other) in enumerate(zip(plain, quick, strict=True)):
            np.testing.assert_array_equal(one.index, index[face == j])
            np.testing.assert_array_equal(other.index, one.index)
            np.testing.assert_array_equal(other.on_rim, one.on_rim)
            np.testing.assert_allclose(other.rays, one.rays, atol=1e-15)
            np.testing.assert_allclose(other.range_m, one.range_m, rtol=1e-15)
            outside += int(np.count_nonzero(one.on_rim))
    assert outside > 100


@pytest.mark.parametrize("columns", [3, 4, 7])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_same_points_are_in_a_box(dtype: type[np.floating[Any]], columns: int) -> None:
    rng = np.random.default_rng(6)
    # As a file has them, with other columns beside; the last row ends with the last point's z.
    memory = rng.uniform(-4.0, 4.0, 20_000 * columns).astype(dtype)
    points = np.lib.stride_tricks.as_strided(
        memory[columns - 3 :], (20_000, 3), (columns * memory.itemsize, memory.itemsize)
    )
    points[::7] = np.nan
    points[::11, 1] = np.inf
    points[5], points[6] = [0.5, 1.0, -2.0], [1.5, 2.0, -1.0]  # just on the border, which is not inside
    for _ in range(20):
        low = rng.uniform(-4.0, 2.0, 3)
        high = low + rng.uniform(0.5, 3.0, 3)
        with compiled.forced(False):
            expected = inside_box(points, low, high)
        with compiled.forced(True):
            found = inside_box(points, low, high)
        assert found.dtype == dtype
        np.testing.assert_array_equal(found, expected)
    assert len(expected) > 10
    with compiled.forced(True):
        border = inside_box(points[5:7], np.array([0.5, 1.0, -2.0]), np.array([1.5, 2.0, -1.0]))
    assert len(border) == 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_same_points_have_moved(dtype: type[np.floating[Any]]) -> None:
    rng = np.random.default_rng(7)
    room = rng.uniform([-20.0, -5.0, -1.0], [20.0, 5.0, -0.8], (30_000, 3))
    frames = []
    for k in range(3):
        apart = rng.normal([2.0 + k, 1.0 - k, 0.5], 0.2, (800, 3))
        frames.append(np.concatenate([room + rng.normal(0.0, 0.01, room.shape), apart]).astype(dtype))
    with compiled.forced(False):
        expected = moved_points(frames)
    with compiled.forced(True):
        found = moved_points(frames)
    for mine, theirs in zip(expected, found, strict=True):
        np.testing.assert_array_equal(theirs, mine)
        assert len(mine) > 300


@pytest.mark.parametrize(("target", "seed"), [("cube", 8), ("arrow", 8), ("oblique", 9), ("concave", 10)])
def test_the_same_target_is_found(target: TargetKind, seed: int) -> None:
    spec = CornerSceneSpec(pose="1", target=target, room=True, frames=1, places=4, clutter=5, seed=seed)
    session, _ = simulate_corner_session(spec)
    found = []
    for way in (False, True):
        with compiled.forced(way):
            found.append(find_target(session))
    assert found[0].by_motion
    assert found[1].by_motion
    for one, other in zip(found[0].sightings, found[1].sightings, strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(other.corner, one.corner, atol=1e-12)
        np.testing.assert_allclose(other.normals, one.normals, atol=1e-12)
        assert (one.convex, one.support) == (other.convex, other.support)
        for mine, theirs in zip(one.outlines, other.outlines, strict=True):
            np.testing.assert_allclose(theirs, mine, atol=1e-12)
        for plane, same in zip(one.obstacles, other.obstacles, strict=True):
            np.testing.assert_allclose(
                np.append(same.normal, same.offset), np.append(plane.normal, plane.offset), atol=1e-6
            )


def test_a_calibration_is_the_same_but_for_rounding() -> None:
    session, _ = simulate_corner_session(CornerSceneSpec(pose="1", frames=2, places=4, seed=4))
    found = []
    for way in (False, True):
        with compiled.forced(way):
            found.append(calibrate_world(session))
    np.testing.assert_allclose(found[0].T_world_source.matrix, found[1].T_world_source.matrix, atol=1e-12)
    assert found[0].covariance is not None
    assert found[1].covariance is not None
    np.testing.assert_allclose(found[0].covariance, found[1].covariance, rtol=1e-8, atol=1e-16)
