"""What moved between places, and a known corner seen again, on scenes built of plain points."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.detect.known_corner import corner_of_normals, sight_again, surroundings
from lidarpose.detect.moved_points import moved_points
from lidarpose.detect.trihedral_corner import FaceMask
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import exp_so3
from lidarpose.model.corner_result import CornerCandidate

SIGMA_M = 0.005
SIZE_M = 0.5


def ground(rng: np.random.Generator) -> FloatArray:
    """A floor a metre below the sensor, sampled by rings."""
    radius, angle = np.meshgrid(np.linspace(1.2, 4.0, 30), np.linspace(-1.0, 1.0, 200))
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(radius.shape, -1.0)], axis=-1)
    return noisy(flat.reshape(-1, 3), rng)


def noisy(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Points (N, 3) with an instrument's noise, along its beams."""
    factor = 1.0 + rng.normal(0.0, SIGMA_M, len(points)) / np.linalg.norm(points, axis=1)
    return np.asarray(points * factor[:, None])


def cube(corner: FloatArray, rng: np.random.Generator, turn: float = 0.0) -> tuple[FloatArray, FloatArray]:
    """Points on the three faces of a box that meet in a corner next to the sensor, and the faces' normals."""
    half = np.sqrt(0.5)
    normals = (
        np.array([[0.0, 0.0, 1.0], [-half, half, 0.0], [-half, -half, 0.0]]) @ exp_so3(np.array([0.0, 0.0, turn])).T
    )
    faces = []
    for k in range(3):
        a, b = -normals[(k + 1) % 3], -normals[(k + 2) % 3]
        u, v = rng.uniform(0.0, SIZE_M, (2, 400))
        faces.append(corner + np.outer(u, a) + np.outer(v, b))
    return noisy(np.concatenate(faces), rng), normals


CORNERS = np.array([[2.0, 0.0, -0.45], [2.2, 1.1, -0.45], [2.9, -0.8, -0.3]])


def sighting(rng: np.random.Generator) -> CornerCandidate:
    normals = cube(CORNERS[0], rng)[1]
    outlines = []
    for k in range(3):
        a, b = -SIZE_M * normals[(k + 1) % 3], -SIZE_M * normals[(k + 2) % 3]
        outlines.append(CORNERS[0] + np.stack([np.zeros(3), a, a + b, b]))
    a, b, c = outlines
    return CornerCandidate(CORNERS[0], normals, True, (a, b, c), (), 400, SIGMA_M)


def seen(floor: FloatArray, target: FloatArray, corner: FloatArray, reference: CornerCandidate) -> FloatArray:
    """Both, without what the target hides of the floor."""
    a, b, c = (outline + corner - reference.corner for outline in reference.outlines)
    range_m = np.linalg.norm(floor, axis=1)
    mask = FaceMask(corner, reference.normals, True, (a, b, c), (), 0.0)
    hidden, _ = mask.select(floor / range_m[:, None], range_m, np.inf)
    return np.concatenate([np.delete(floor, hidden, axis=0), target])


def test_what_moved_is_the_target() -> None:
    rng = np.random.default_rng(0)
    targets = [cube(corner, rng)[0] for corner in CORNERS]
    floors = [ground(rng) for _ in CORNERS]
    frames = [np.concatenate(pair).astype(np.float32) for pair in zip(floors, targets, strict=True)]
    for floor, index in zip(floors, moved_points(frames), strict=True):
        assert np.count_nonzero(index < len(floor)) < 0.01 * len(floor)
        # A cell by the ground is taken by the ground.
        assert np.count_nonzero(index >= len(floor)) > 0.7 * 1200


def test_known_normals_find_the_corner_among_strays() -> None:
    rng = np.random.default_rng(1)
    points, normals = cube(CORNERS[1], rng)
    strays = CORNERS[1] + rng.uniform(-0.4, 0.4, (200, 3))
    corner = corner_of_normals(np.concatenate([points, strays]), normals, SIGMA_M)
    assert np.linalg.norm(corner - CORNERS[1]) < 0.01


def test_the_target_is_seen_again_with_what_borders_it() -> None:
    rng = np.random.default_rng(2)
    reference = sighting(rng)
    frames = [seen(ground(rng), cube(corner, rng)[0], corner, reference) for corner in CORNERS]
    expected = CORNERS + rng.normal(0.0, 0.01, (3, 3))
    around = [surroundings(f, reference, c) for f, c in zip(frames, expected, strict=True)]
    found = sight_again(around, reference, expected)
    assert found is not None
    for candidate, corner in zip(found, CORNERS, strict=True):
        assert np.linalg.norm(candidate.corner - corner) < 0.004
        np.testing.assert_allclose(candidate.normals, reference.normals, atol=0.01)
    assert any(abs(plane.normal[2]) > 0.999 for plane in found[0].obstacles)


def test_whole_faces_are_seen_again_by_a_reference_that_shows_a_part_of_them() -> None:
    """As where what moved is told from what stood still: a face's foot is next to the ground, and counts as such."""
    rng = np.random.default_rng(4)
    whole = sighting(rng)
    part = replace(whole, outlines=tuple(o[0] + 0.6 * (o - o[0]) for o in whole.outlines), support=150)
    frames = [seen(ground(rng), cube(corner, rng)[0], corner, whole) for corner in CORNERS]
    around = [surroundings(f, part, c, 0.4) for f, c in zip(frames, CORNERS, strict=True)]
    found = sight_again(around, part, CORNERS, part_at=0)
    assert found is not None
    for candidate, corner in zip(found, CORNERS, strict=True):
        for outline in candidate.outlines:
            far = np.linalg.norm(outline - corner, axis=1).max()
            assert 0.9 * SIZE_M * np.sqrt(2.0) < far < 1.05 * SIZE_M * np.sqrt(2.0)
    # Where the rest of a face is something else, the corner is none.
    bent = around[0].copy()
    bent[:, 2] += np.where(np.linalg.norm(bent - CORNERS[0], axis=1) < 0.2, 0.0, 0.5)
    assert sight_again([bent, *around[1:]], part, CORNERS, part_at=0) is None


def test_scan_lines_far_apart_on_a_face_seen_along_do_not_cut_it_short() -> None:
    rng = np.random.default_rng(5)
    whole = replace(sighting(rng), support=150)
    frames = []
    for k, corner in enumerate(CORNERS):
        target, _ = cube(corner, rng)
        top, beyond_m = np.arange(len(target)) < 400, target[:, 0] - corner[0]
        lines = (np.abs(beyond_m - 0.15) < 0.1) | (np.abs(beyond_m - 0.66) < 0.06)
        frames.append(seen(ground(rng), target if k else target[~top | lines], corner, whole))
    around = [surroundings(f, whole, c, 0.4) for f, c in zip(frames, CORNERS, strict=True)]
    found = sight_again(around, whole, CORNERS, part_at=0)
    assert found is not None
    for candidate, corner in zip(found, CORNERS, strict=True):
        assert np.linalg.norm(candidate.outlines[0] - corner, axis=1).max() > 0.9 * SIZE_M * np.sqrt(2.0)


@pytest.mark.parametrize("wrong", ["gone", "a face hidden", "turned"])
def test_a_target_that_is_not_there_is_not_seen(wrong: str) -> None:
    rng = np.random.default_rng(3)
    reference = sighting(rng)
    target, _ = cube(CORNERS[1], rng, turn=np.radians(20.0) if wrong == "turned" else 0.0)
    if wrong == "gone":
        target = target[:1]
    if wrong == "a face hidden":
        # Something stands before one face.
        target[400:800] *= (1.0 - 0.2 / np.linalg.norm(target[400:800], axis=1))[:, None]
    around = surroundings(seen(ground(rng), target, CORNERS[1], reference), reference, CORNERS[1])
    assert sight_again([around], reference, CORNERS[1:2]) is None
