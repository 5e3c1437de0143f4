"""Where faces end: edges of boards are kept out, faces themselves are kept, lone scan lines are not lost."""

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.face_rims import without_rims

SIGMA_M = 0.008
SIZE_M = 0.5
# A room's corner before the sensor: the floor and two walls, of SIZE_M each.
NORMALS = unit(np.array([[0.0, 0.0, 1.0], [-1.0, 1.0, 0.0], [-1.0, -1.0, 0.0]]))
CORNERS = np.array([[2.0, 0.0, -0.8], [2.4, 0.5, -0.7], [1.8, -0.4, -0.6], [2.2, 0.2, -0.9]])


def faces_of_a_place(corner: FloatArray, slope: float, rng: np.random.Generator) -> dict[int, FaceReturns]:
    """Returns on each face and 8 mm beyond it, where the surface falls back by `slope` of the way outwards."""
    edges = np.linalg.inv(NORMALS).T
    edges = unit(edges)
    faces = {}
    for j in range(3):
        a, b = (edges[k] for k in range(3) if k != j)
        along = rng.uniform(0.01, SIZE_M + 0.008, (2, 1500))
        points = corner + along[0][:, None] * a + along[1][:, None] * b
        range_m = np.linalg.norm(points, axis=1)
        beyond = np.maximum(along.max(axis=0) - SIZE_M, 0.0)
        measured = range_m + slope * beyond + rng.normal(0.0, SIGMA_M, len(range_m))
        faces[j] = FaceReturns(points / range_m[:, None], measured, np.zeros(len(range_m), dtype=np.int64))
    return faces


def places(slope: float, seed: int) -> list[CornerPlaceFaces]:
    rng = np.random.default_rng(seed)
    return [CornerPlaceFaces(str(k), c, faces_of_a_place(c, slope, rng), 1) for k, c in enumerate(CORNERS)]


def beyond_m(place: CornerPlaceFaces, face: int) -> FloatArray:
    """How far outside of a face each of its returns' rays meets its plane (N,)."""
    corner = CORNERS[int(place.position)]
    rays = place.faces[face].directions
    points = rays * ((NORMALS[face] @ corner) / (rays @ NORMALS[face]))[:, None] - corner
    along = np.linalg.solve(unit(np.linalg.inv(NORMALS).T).T, points.T)
    return np.asarray(along.max(axis=0) - SIZE_M)


@pytest.mark.parametrize("seed", range(4))
def test_what_lies_beyond_a_faces_edge_is_left_out(seed: int) -> None:
    found = places(2.0, seed)
    for before, after in zip(found, without_rims(found, NORMALS, CORNERS, SIGMA_M), strict=True):
        for j in range(3):
            assert np.count_nonzero(beyond_m(before, j) > 0.0) > 25
            assert np.count_nonzero(beyond_m(after, j) > 0.0) <= 3
            assert len(after.faces[j]) > 0.85 * len(before.faces[j])


def test_a_flat_face_loses_half_a_beams_width_at_its_sides() -> None:
    found = places(0.0, 0)
    left = [len(f) for p in without_rims(found, NORMALS, CORNERS, SIGMA_M) for f in p.faces.values()]
    assert min(left) > 0.93 * 1500
    assert max(left) < 0.99 * 1500


def test_spots_that_err_together_move_no_edge() -> None:
    """With the spots' common error stated, a step as large as it is no edge."""
    found = places(1.0, 1)
    plain = without_rims(found, NORMALS, CORNERS, SIGMA_M)
    wary = without_rims(found, NORMALS, CORNERS, SIGMA_M, common_error=100.0)
    assert sum(len(p.faces[0]) for p in wary) > sum(len(p.faces[0]) for p in plain)


def test_a_face_of_one_scan_line_is_kept() -> None:
    found = places(0.0, 2)
    line = found[0].faces[0].directions[:20]
    corner = CORNERS[0]
    on_line = corner + np.linspace(0.05, 0.4, 20)[:, None] * unit(line[0] - line[1])[None]
    on_line -= np.outer((on_line - corner) @ NORMALS[0], NORMALS[0])
    range_m = np.linalg.norm(on_line, axis=1)
    thin = FaceReturns(on_line / range_m[:, None], range_m, np.zeros(20, dtype=np.int64))
    single = [CornerPlaceFaces("0", corner, {0: thin}, 1)]
    assert len(without_rims(single, NORMALS, CORNERS[:1], SIGMA_M)[0].faces[0]) >= 15


def test_ground_that_one_place_takes_for_a_face_is_left_out() -> None:
    """The ground 2 cm below the floor, seen as far as 0.4 m beyond it, at one place of four."""
    found, rng = places(0.0, 3), np.random.default_rng(3)
    along = np.column_stack([rng.uniform(0.0, SIZE_M, 1000), rng.uniform(SIZE_M, SIZE_M + 0.4, 1000)])
    edges = unit(np.linalg.inv(NORMALS).T)[1:]
    ground = CORNERS[1] + along @ edges
    to_face = np.linalg.norm(ground, axis=1)
    rays = ground / to_face[:, None]
    measured = to_face - 0.02 / (rays @ NORMALS[0]) + rng.normal(0.0, SIGMA_M, 1000)
    floor = found[1].faces[0]
    both = FaceReturns(
        np.concatenate([floor.directions, rays]),
        np.concatenate([floor.range_m, measured]),
        np.zeros(2500, dtype=np.int64),
    )
    found[1] = CornerPlaceFaces("1", CORNERS[1], {**found[1].faces, 0: both}, 1)
    left = without_rims(found, NORMALS, CORNERS, SIGMA_M)[1].faces[0]
    assert 1300 < len(left) <= 1510
    assert np.count_nonzero(np.isin(left.range_m, measured)) <= 10


def repeated(place: CornerPlaceFaces, frames: int, rng: np.random.Generator) -> CornerPlaceFaces:
    """The place seen in many frames by beams that go the same ways, but for the rounding of what they return."""
    faces = {}
    for j, f in place.faces.items():
        directions = unit(np.tile(f.directions, (frames, 1)) * rng.uniform(0.5, 2.0, (frames * len(f), 1)))
        range_m = np.tile(f.range_m, frames) + rng.normal(0.0, SIGMA_M, frames * len(f))
        faces[j] = FaceReturns(directions, range_m, np.repeat(np.arange(frames), len(f)))
    return CornerPlaceFaces(place.position, place.corner_world, faces, frames)


@pytest.mark.parametrize("slope", [0.0, 2.0])
def test_beams_that_repeat_are_kept_together_whatever_the_last_digit(slope: float) -> None:
    rng = np.random.default_rng(5)
    found = [repeated(p, 10, rng) for p in places(slope, 5)]
    plain = without_rims(found, NORMALS, CORNERS, SIGMA_M)
    for _ in range(5):
        off = 1e-13 * rng.standard_normal((3, 3))
        again = without_rims(found, NORMALS + off, CORNERS, SIGMA_M)
        for before, after in zip(plain, again, strict=True):
            assert all(np.array_equal(before.faces[j].range_m, after.faces[j].range_m) for j in range(3))
