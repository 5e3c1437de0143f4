"""A box whose three faces show next to their corner at one place alone: at each other, a face of it is hidden there."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.detect.trihedral_corner import find_corners
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, rotation_z
from lidarpose.model.cloud import Cloud
from lidarpose.model.corner_session import CornerPlace, CornerSession, MemoryCloud
from lidarpose.workflows import corner_target
from lidarpose.workflows.corner_target import find_target
from lidarpose.workflows.seen_once import SeenPlace, seen_elsewhere
from lidarpose.workflows.world import calibrate_world

EDGES = np.column_stack([*(rotation_z(np.radians(-40.0)).T[:2]), [0.0, 0.0, -1.0]]).T
SIDE_M, GROUND_M, SIGMA_M, HIDDEN_M = 0.6, -1.1, 0.004, 0.5
CORNERS = np.array([[2.0, 0.2, -0.5], [2.3, -0.4, -0.5], [2.5, 0.5, -0.3]])
WHOLE_ONCE = ((), (0,), (1,))
WORLD = Pose(rotation_z(1.0), np.array([3.0, -2.0, 1.0]))


def seen(corner: FloatArray, hidden: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
    """A box above the ground by 60 beams, a face of it hidden next to the corner; a second box stands still."""
    elevation, azimuth = np.meshgrid(np.radians(np.arange(-35.0, 10.0, 0.75)), np.radians(np.arange(-50.0, 50.0, 0.4)))
    e, a = elevation.ravel(), azimuth.ravel()
    rays = np.column_stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    with np.errstate(divide="ignore"):
        range_m = np.where(rays[:, 2] < 0.0, GROUND_M / rays[:, 2], np.inf)
        met = np.full(len(rays), -1)
        for box, apex in enumerate((corner, np.array([2.6, 1.6, GROUND_M + SIDE_M]))):
            for k in range(3):
                reach = (EDGES[k] @ apex) / (rays @ EDGES[k])
                along = (rays * reach[:, None] - apex) @ np.delete(EDGES, k, axis=0).T
                on = (reach > 0.0) & (along >= 0.0).all(axis=1) & (along <= SIDE_M).all(axis=1) & (reach < range_m)
                range_m = np.where(on, reach, range_m)
                met[on] = k if box == 0 else -1
    points = rays * np.minimum(range_m, 50.0)[:, None]
    kept = range_m < 15.0
    kept &= ~np.isin(met, hidden) | (np.linalg.norm(points - corner, axis=1) > HIDDEN_M)
    return np.asarray((points + rays * rng.normal(0.0, SIGMA_M, (len(rays), 1)))[kept])


def session_of(corners: FloatArray, hidden: tuple[tuple[int, ...], ...]) -> CornerSession:
    rng = np.random.default_rng(5)
    places = tuple(
        CornerPlace(f"p{k}", WORLD @ c, (MemoryCloud(str(k), Cloud(seen(c, h, rng))),))
        for k, (c, h) in enumerate(zip(corners, hidden, strict=True))
    )
    return CornerSession("boxes", places)


def test_a_target_seen_whole_at_one_place_is_found_at_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    # A box so near has edges of two faces at all places, too.
    monkeypatch.setattr(corner_target, "_find_by_edges", lambda session, seed: None)
    session = session_of(CORNERS, WHOLE_ONCE)
    for place, corner in zip(session.places[1:], CORNERS[1:], strict=True):
        points = place.clouds[0].load().points
        alone = find_corners(points, segment_planes(points, PlaneSearch(min_points=15, from_sensor=True)))
        assert all(np.linalg.norm(c.corner - corner) > 0.1 for c in alone)
    found = find_target(session)
    assert found.doubt
    assert not found.ambiguous
    assert found.match.places == 3
    for sighting, corner in zip(found.sightings, CORNERS, strict=True):
        assert sighting is not None
        assert np.linalg.norm(sighting.corner - corner) < 0.01
    calibration = calibrate_world(session)
    assert calibration.covariance is not None
    assert calibration.quality is not None
    assert calibration.quality.verdict != "good"
    assert any("few places show the target whole" in reason for reason in calibration.quality.reasons)
    xi = calibration.T_world_source.minus(WORLD)
    assert xi @ np.linalg.solve(calibration.covariance, xi) < 22.5  # 99.9 % of chi-square with six degrees


def test_coordinates_that_are_not_the_target_s_find_nothing() -> None:
    session = session_of(CORNERS, WHOLE_ONCE)
    rng = np.random.default_rng(1)
    for _ in range(2):
        off = rng.uniform(0.2, 0.4, 3) * rng.choice([-1.0, 1.0], 3)
        wrong = replace(session.places[2], corner_world=session.places[2].corner_world + off)
        with pytest.raises(UndeterminedError, match="no corner"):
            find_target(replace(session, places=(*session.places[:2], wrong)))


def test_what_stands_still_is_not_looked_for_elsewhere() -> None:
    session = session_of(CORNERS, ((), (), ()))
    places = []
    for place in session.places:
        points = place.clouds[0].load().points
        patches = segment_planes(points, PlaneSearch(min_points=15, from_sensor=True))
        places.append(SeenPlace.of(points, patches, find_corners(points, patches)))
    assert all(len(place.corners) == 2 for place in places)
    started = [sightings[k] for k, sightings in enumerate(seen_elsewhere(places, WORLD @ CORNERS))]
    assert len(started) == 3
    for here, corner in zip(started, CORNERS, strict=True):
        assert np.linalg.norm(here[0].corner - corner) < 0.01
