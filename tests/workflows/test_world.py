"""The world job end to end on simulated sessions: the target unaided, mistakes named, half a turn, the paper's ways."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, UncertainPose
from lidarpose.model.calibration import WorldCalibration
from lidarpose.model.corner_session import CornerSession, MemoryCloud
from lidarpose.simulate.corner_scene import CornerSceneSpec, CornerTruth, paper_rotation, simulate_corner_session
from lidarpose.simulate.multibeam import Defects
from lidarpose.workflows.corner_target import find_target
from lidarpose.workflows.moving_target import find_by_motion
from lidarpose.workflows.world import LocatedTarget, calibrate_world, locate_target, world_run

Simulated = tuple[CornerSession, CornerTruth, LocatedTarget]


@pytest.fixture(scope="module")
def simulated() -> Simulated:
    session, truth = simulate_corner_session(CornerSceneSpec(frames=6, room=True, clutter=6, seed=1, places=5))
    return session, truth, locate_target(session)


def with_world(session: CornerSession, world: FloatArray) -> CornerSession:
    places = tuple(replace(p, corner_world=w) for p, w in zip(session.places, world, strict=True))
    return replace(session, places=places)


def reasons(calibration: WorldCalibration) -> str:
    assert calibration.quality is not None
    assert calibration.quality.verdict != "good"
    return "; ".join(calibration.quality.reasons)


@pytest.mark.parametrize(
    ("method", "degrees", "millimetres"),
    [("joint", 0.02, 0.8), ("paper", 0.15, 5.0), ("paper-approx", 0.15, 5.0), ("ransac", 0.5, 20.0)],
)
def test_each_method_finds_the_pose(simulated: Simulated, method: str, degrees: float, millimetres: float) -> None:
    session, truth, located = simulated
    result = calibrate_world(session, method, located=located)  # type: ignore[arg-type]
    metres, radians = result.T_world_source.distance(truth.T_world_lidar)
    assert np.degrees(radians) < degrees
    assert 1e3 * metres < millimetres
    assert result.quality is not None
    if method == "joint":
        assert result.quality.verdict == "good"
        xi = result.T_world_source.minus(truth.T_world_lidar)
        assert result.covariance is not None
        assert xi @ np.linalg.solve(result.covariance, xi) < 22.5  # 99.9 % of chi-square with six degrees


def test_coordinates_of_unknown_precision_are_not_taken_for_exact(simulated: Simulated) -> None:
    # Half a millimetre at three places shows in no residual, and nobody stated it.
    session, truth, _ = simulated
    far_apart = [0, 1, 3]
    few = replace(session, places=tuple(session.places[k] for k in far_apart), world_sigma_m=None)
    world = np.stack([p.corner_world for p in few.places])
    rng = np.random.default_rng(5)
    errors = []
    for _ in range(10):
        moved = with_world(few, world + rng.normal(0.0, 5e-4, world.shape))
        errors.append(squared_error(calibrate_world(moved), truth))
    assert np.mean(errors) < 12.0
    assert squared_error(calibrate_world(few), truth) > 0.1


def test_coordinates_of_a_national_grid_give_the_same_answer(simulated: Simulated) -> None:
    # About an origin thousands of kilometres away a turn is all but a shift: the pose passed for undetermined.
    session, _, located = simulated
    grid = np.array([512345.678, 5412345.678, -210.4])
    world = np.stack([p.corner_world for p in session.places])
    near = calibrate_world(session, located=located)
    far = calibrate_world(with_world(session, world + grid))
    assert far.quality is not None
    assert far.quality.verdict == "good"
    back = Pose(np.eye(3), -grid)
    metres, radians = (back @ far.T_world_source).distance(near.T_world_source)
    assert metres < 1e-6
    assert radians < 1e-7
    assert near.covariance is not None
    assert far.covariance is not None
    centre = UncertainPose(near.T_world_source, near.covariance).centre_covariance()
    shifted = UncertainPose(far.T_world_source, far.covariance).centre_covariance()
    assert np.allclose(centre, shifted, rtol=0.02, atol=1e-9)
    assert np.allclose(near.covariance[3:, 3:], far.covariance[3:, 3:], rtol=1e-3, atol=1e-12)


def test_half_a_turn_of_yaw_costs_nothing() -> None:
    pose = Pose(paper_rotation(180.0, 25.0, 0.0), np.array([1.0, -2.0, 1.5]))
    session, truth = simulate_corner_session(CornerSceneSpec(pose=pose, frames=4, places=4, seed=2))
    located = locate_target(session)
    for method, limit_deg in (("joint", 0.03), ("paper", 0.15)):
        result = calibrate_world(session, method, located=located)  # type: ignore[arg-type]
        assert np.degrees(result.T_world_source.distance(truth.T_world_lidar)[1]) < limit_deg


@pytest.mark.parametrize(
    ("mistake", "named"),
    [
        ("millimetres", "millimetres"),
        ("mirrored", "left-handed"),
        ("swapped", "swapped"),
        ("5 cm", "p01"),
        ("1 %", "times"),
        ("10 cm", "p01 is left out: by the other places its corner stands 100 mm from its world coordinates (row 2"),
        ("not moved", "it stands at the coordinates of p03"),
    ],
)
def test_mistakes_in_the_coordinates_are_named(simulated: Simulated, mistake: str, named: str) -> None:
    session, _, _ = simulated
    world = np.stack([p.corner_world for p in session.places])
    wrong = {
        "millimetres": 1000.0 * world,
        "mirrored": world * [1.0, -1.0, 1.0],
        "swapped": world[[1, 0, 2, 3, 4]],
        "5 cm": world + 0.05 * np.outer(np.arange(5) == 1, [0.0, 1.0, 0.0]),
        "1 %": 1.01 * world,
        "10 cm": world + 0.1 * np.outer(np.arange(5) == 1, [0.0, 1.0, 0.0]),
        "not moved": world,
    }[mistake]
    changed = with_world(session, wrong)
    if mistake == "not moved":
        # The target was not moved between two places.
        places = list(changed.places)
        places[1] = replace(places[1], clouds=places[3].clouds)
        changed = replace(changed, places=tuple(places))
    assert named in reasons(calibrate_world(changed))


def squared_error(calibration: WorldCalibration, truth: CornerTruth) -> float:
    """Over the covariance: 6 in the mean if that is honest."""
    assert calibration.covariance is not None
    xi = calibration.T_world_source.minus(truth.T_world_lidar)
    return float(xi @ np.linalg.solve(calibration.covariance, xi))


@pytest.mark.parametrize("off_mm", [5.0, 20.0, 50.0])
def test_one_wrong_coordinate_is_named_and_left_out(simulated: Simulated, off_mm: float) -> None:
    session, truth, _ = simulated
    world = np.stack([p.corner_world for p in session.places])
    world[1] += 1e-3 * off_mm * np.array([0.6, 0.0, 0.8])
    result = calibrate_world(with_world(session, world))
    assert f"p01 is left out: by the other places its corner stands {off_mm:.0f} mm" in reasons(result)
    assert result.T_world_source.distance(truth.T_world_lidar)[0] < 0.001
    assert squared_error(result, truth) < 12.6


@pytest.mark.parametrize(
    ("places", "off_mm", "outcome"),
    [(5, 50.0, "p02 is left out"), (5, 15.0, "p02 is left out"), (4, 50.0, "")],
)
def test_a_height_that_is_wrong_is_not_passed_over(places: int, off_mm: float, outcome: str) -> None:
    # The top face of a place that seems too high has no return where the others put it, and nothing else contradicts.
    spec = CornerSceneSpec(places=places, frames=1, seed=7, target="cube", size_m=0.6, room=True)
    session, truth = simulate_corner_session(spec)
    world = np.stack([p.corner_world for p in session.places])
    world[2, 2] += 1e-3 * off_mm
    result = calibrate_world(with_world(session, world))
    assert result.quality is not None
    assert result.quality.verdict != "good"
    assert outcome in reasons(result)
    assert squared_error(result, truth) < 16.8


def test_a_face_that_stands_elsewhere_where_no_corner_was_seen_is_named() -> None:
    # Two faces of the place fit the others, and of three places alone nothing contradicts.
    pose = Pose(paper_rotation(20.0, 15.0, 0.0), np.array([0.0, 0.0, 1.5]))
    spec = CornerSceneSpec(pose=pose, places=4, frames=1, seed=10, target="cube", size_m=0.6, ground_m=0.0)
    session, truth = simulate_corner_session(spec)
    world = np.stack([p.corner_world for p in session.places])
    world[2, 2] += 0.03
    result = calibrate_world(with_world(session, world))
    assert "p02" in reasons(result)
    assert squared_error(result, truth) < 16.8


def test_every_place_that_may_be_wrong_is_named_where_more_than_one_may() -> None:
    # Of four places whose corners lie nearly in one plane, without either of two the others fit.
    pose = Pose(paper_rotation(20.0, 15.0, 0.0), np.array([0.0, 0.0, 1.5]))
    spec = CornerSceneSpec(pose=pose, places=4, frames=1, seed=3, target="cube", size_m=0.6, ground_m=0.0)
    session, truth = simulate_corner_session(spec)
    world = np.stack([p.corner_world for p in session.places])
    world[2, 2] += 0.03
    result = calibrate_world(with_world(session, world))
    assert "the world coordinates of p02 are off by 29" in reasons(result)
    assert "(or those of p00 by 2" in reasons(result)
    assert squared_error(result, truth) < 16.8


def test_a_place_that_fits_nothing_is_named() -> None:
    rng = np.random.default_rng([91, 407])
    kind = str(rng.choice(["cube", "arrow", "oblique", "concave"]))
    lidar = str(rng.choice(["hdl32", "vlp16", "turntable"]))
    pose = Pose(
        paper_rotation(rng.uniform(-180, 180), rng.uniform(-12, 28), rng.uniform(-10, 10)),
        np.array([rng.uniform(-1, 1), rng.uniform(-1, 1), 1.5]),
    )
    places, frames = int(rng.integers(4, 8)), int(rng.choice([1, 3]))
    spec = CornerSceneSpec(pose=pose, target=kind, lidar=lidar, places=places, frames=frames, seed=7407)  # type: ignore[arg-type]
    spec = replace(spec, ground_m=0.0)
    size_m, room, clutter = float(rng.uniform(0.3, 0.8)), bool(rng.random() < 0.5), int(rng.integers(0, 6))
    session, truth = simulate_corner_session(replace(spec, size_m=size_m, room=room, clutter=clutter))
    world = np.stack([p.corner_world for p in session.places])
    off = int(rng.integers(places))
    rng.integers(places - 1)
    direction = rng.normal(size=3)
    world[off] += 0.1 * direction / np.linalg.norm(direction)
    result = calibrate_world(with_world(session, world))
    assert session.places[off].position in reasons(result)
    assert squared_error(result, truth) < 16.8


def test_no_coordinate_is_blamed_where_all_are_uncertain() -> None:
    found = []
    for seed in range(8):
        spec = CornerSceneSpec(frames=1, places=3 + 2 * (seed % 2), seed=seed, world_sigma_m=0.003, hints=True)
        session, truth = simulate_corner_session(spec)
        result = calibrate_world(replace(session, world_sigma_m=None))
        assert result.quality is not None
        assert not any("if all others are right" in reason for reason in result.quality.reasons)
        found.append(squared_error(result, truth))
    # Without what a noise of three to nine degrees of freedom leaves open their mean is 20.
    assert np.mean(found) < 10.0


def test_coordinates_that_fit_better_mirrored_are_left_handed() -> None:
    # Places nearly in one plane: without one of them the others fit unmirrored, to 5 mm.
    pose = Pose(paper_rotation(86.40232, 23.70012, -8.81169), np.array([-0.483387, -0.865126, 1.5]))
    spec = CornerSceneSpec(pose=pose, target="oblique", places=6, frames=1, seed=7001, ground_m=0.0, size_m=0.42400202)
    spec = replace(spec, room=True, clutter=4)
    session, _ = simulate_corner_session(spec)
    world = np.stack([p.corner_world for p in session.places])
    assert "left-handed" in reasons(calibrate_world(with_world(session, world * [1.0, -1.0, 1.0])))


def test_a_target_turned_far_is_named() -> None:
    spec = CornerSceneSpec(frames=2, places=5, seed=3, turned_place=2, turned_deg=15.0)
    session, truth = simulate_corner_session(spec)
    result = calibrate_world(session)
    assert "p02 is left out: the target seems turned by 15 deg" in reasons(result)
    assert result.T_world_source.distance(truth.T_world_lidar)[0] < 0.003


def test_a_turned_target_is_named() -> None:
    spec = CornerSceneSpec(frames=4, places=4, seed=3, turned_place=2, turned_deg=2.0)
    session, _ = simulate_corner_session(spec)
    assert "turned" in reasons(calibrate_world(session))


def test_places_in_one_plane_that_turn_the_sensor_upside_down_are_doubted(simulated: Simulated) -> None:
    session, truth, _ = simulated
    heights = truth.corners_world[:, 2]
    flat = [k for k in range(5) if abs(heights[k] - np.median(heights)) < 0.01]
    if len(flat) < 3:
        pytest.skip("this seed raises the target too often")
    few = replace(session, places=tuple(session.places[k] for k in flat))
    world = np.stack([p.corner_world for p in few.places]) * [1.0, -1.0, 1.0]
    assert "upside down" in reasons(calibrate_world(with_world(few, world)))


def test_three_places_in_a_slanted_plane_that_turn_the_sensor_over_are_doubted() -> None:
    # Their plane is 26 degrees from level.
    pose = Pose(paper_rotation(9.31806, -5.05184, 8.86981), np.array([0.004539, 0.996407, 1.5]))
    spec = CornerSceneSpec(pose=pose, places=3, frames=1, seed=7002, ground_m=0.0, size_m=0.6013956, clutter=9)
    session, truth = simulate_corner_session(spec)
    right = calibrate_world(session)
    assert right.T_world_source.distance(truth.T_world_lidar)[0] < 0.005
    assert right.quality is not None
    assert right.quality.verdict == "good"
    world = np.stack([p.corner_world for p in session.places])
    for mirrored in (world * [1.0, -1.0, 1.0], world[:, [1, 0, 2]]):
        assert "left-handed" in reasons(calibrate_world(with_world(session, mirrored)))


def test_a_target_that_stands_still_is_no_answer(simulated: Simulated) -> None:
    session, _, _ = simulated
    still = tuple(replace(p, clouds=session.places[0].clouds[:1]) for p in session.places[:3])
    with pytest.raises(UndeterminedError, match="no corner"):
        calibrate_world(replace(session, places=still))


def test_hints_give_the_same_answer(simulated: Simulated) -> None:
    session, truth, _ = simulated
    hinted = tuple(
        replace(p, near=c + [0.1, -0.1, 0.05]) for p, c in zip(session.places, truth.corners_lidar, strict=True)
    )
    result = calibrate_world(replace(session, places=hinted))
    assert result.T_world_source.distance(truth.T_world_lidar)[0] < 1e-3


def test_what_moves_gives_the_same_corners_as_the_full_search(simulated: Simulated) -> None:
    session, truth, _ = simulated
    world = np.stack([p.corner_world for p in session.places])
    found = find_by_motion(session, world)
    assert found is not None
    for candidate, corner in zip(found, truth.corners_lidar, strict=True):
        assert np.linalg.norm(candidate.corner - corner) < 0.02
    # A place recorded before the target was moved shows the last place's: nobody is at its own.
    places = list(session.places)
    places[1] = replace(places[1], clouds=places[3].clouds)
    assert find_by_motion(replace(session, places=tuple(places)), world) is None


def test_a_frame_in_which_the_target_was_bumped_is_left_out(simulated: Simulated) -> None:
    session, truth, _ = simulated
    places = list(session.places)
    clouds = list(places[2].clouds)
    cloud = clouds[3].load()
    clouds[3] = MemoryCloud("bumped", replace(cloud, points=cloud.points + np.float32(0.03)))
    places[2] = replace(places[2], clouds=tuple(clouds))
    run = world_run(replace(session, places=tuple(places)))
    used = run.places[2].frame_used
    assert not used[3]
    assert used.sum() >= 4
    assert run.calibration.T_world_source.distance(truth.T_world_lidar)[0] < 0.0008


def test_faces_that_end_just_above_the_ground_take_nothing_from_it() -> None:
    """Boards 2 cm thick that lie on the ground: at 8 mm of noise the ground around them hardly differs from them."""
    statistic = 0.0
    for seed in range(4):
        scene = CornerSceneSpec(
            pose=Pose(paper_rotation(40.0 * seed, 10.0, 3.0), np.array([0.2, -0.4, 1.5])),
            target="concave",
            ground_m=0.0,
            lidar="turntable",
            frames=1,
            size_m=0.6,
            seed=900 + seed,
        )
        session, truth = simulate_corner_session(scene)
        calibration = calibrate_world(session)
        assert calibration.covariance is not None
        error = calibration.T_world_source.minus(truth.T_world_lidar)
        statistic += float(error @ np.linalg.solve(calibration.covariance, error))
    # Chi-square of 24 degrees of freedom: one draw in a thousand is above.
    assert statistic < 51.2


@pytest.mark.slow
def test_targets_are_found_in_the_noise_of_a_data_sheet() -> None:
    # 30 mm, a single frame a place, 16 lines: all were refused, since the ground's slab is too thin for the faces.
    found = 0
    for seed in (11, 13, 17):
        spec = CornerSceneSpec(
            lidar="vlp16", frames=1, places=4, target="concave", seed=seed, defects=Defects(range_sigma_m=0.03)
        )
        session, truth = simulate_corner_session(spec)
        try:
            target = find_target(session)
        except UndeterminedError:
            continue
        found += 1
        for sighting, corner in zip(target.sightings, truth.corners_lidar, strict=True):
            assert sighting is None or np.linalg.norm(sighting.corner - corner) < 0.06
    assert found >= 2
