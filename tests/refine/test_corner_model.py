"""The joint corner estimate on simulated returns: derivatives, efficiency, honest covariance, diagnosis.

Returns are made by intersecting beams with planes here, not by the estimator's formulas; the Cramer-Rao bound comes
from numerical derivatives of the same intersections.
"""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.corner_model import (
    CornerFit,
    CornerOptions,
    CornerState,
    estimate_world_sigma,
    fit_corner_model,
    place_discrepancies,
    reweighted,
)
from lidarpose.refine.face_shape import face_shape
from lidarpose.refine.frame_corners import PlaceFrames
from lidarpose.refine.free_corner import fit_corner
from lidarpose.refine.spot_scatter import spot_scatter, weighed_by_angle

TRUTH = Pose(exp_so3([0.0, 0.5, 0.3]), np.array([0.2, -0.1, 1.5]))
NORMALS_WORLD = unit(np.array([[0.05, 0.0, 1.0], [-0.7, 0.7, 0.0], [-0.7, -0.7, 0.1]]))
WORLD = np.array([[2.0, -1.0, 0.5], [2.1, 0.9, 0.6], [1.6, 0.1, 0.8], [2.8, -0.4, 0.5], [2.7, 0.8, 0.9]])
SIGMA_M = 0.008


def beams(per_face: int, rng: np.random.Generator) -> dict[tuple[int, int], FloatArray]:
    """Directions (N, 3) in the LiDAR frame that meet half-metre faces, by place and face."""
    found = {}
    for i, corner in enumerate(WORLD):
        for j in range(3):
            others = [NORMALS_WORLD[k] for k in range(3) if k != j]
            edges = [unit(np.cross(NORMALS_WORLD[j], o)) for o in others]
            edges = [e if e @ others[1 - k] < 0.0 else -e for k, e in enumerate(edges)]
            on_face = corner + rng.uniform(0.01, 0.5, (per_face, 2)) @ np.stack(edges)
            found[i, j] = unit(TRUTH.inverse() @ on_face)
    return found


def ranges(pose: Pose, normals_lidar: FloatArray, i: int, j: int, directions: FloatArray) -> FloatArray:
    corner = pose.inverse() @ WORLD[i]
    plane = Plane(normals_lidar[j], float(normals_lidar[j] @ corner))
    return np.linalg.norm(plane.intersect_rays(directions), axis=1)


def observe(
    directions: dict[tuple[int, int], FloatArray], rng: np.random.Generator, sigma_m: float = SIGMA_M
) -> list[CornerPlaceFaces]:
    normals = TRUTH.inverse().rotate(NORMALS_WORLD)
    places = []
    for i in range(len(WORLD)):
        faces = {}
        for j in range(3):
            u = directions[i, j]
            r = ranges(TRUTH, normals, i, j, u) + rng.normal(0.0, sigma_m, len(u))
            faces[j] = FaceReturns(u, r, np.sort(np.arange(len(u)) % 4))
        places.append(CornerPlaceFaces(f"p{i}", WORLD[i], faces, 4))
    return places


def start() -> CornerState:
    normals = TRUTH.inverse().rotate(NORMALS_WORLD)
    off = Pose.exp([0.02, -0.03, 0.01, 0.01, 0.02, -0.01])
    tilted = unit(normals + np.array([[0.0, 0.02, 0.0], [0.01, 0.0, 0.0], [0.0, 0.0, -0.02]]))
    return CornerState(off @ TRUTH, tilted, 1.0, np.zeros((len(WORLD), 3)))


def bound(directions: dict[tuple[int, int], FloatArray]) -> FloatArray:
    """Cramer-Rao covariance (6, 6) of the pose, by central differences of the intersections."""
    normals = TRUTH.inverse().rotate(NORMALS_WORLD)
    h = 1e-6

    def expected(theta: FloatArray) -> FloatArray:
        pose = Pose.exp(theta[:6]) @ TRUTH
        turned = []
        for j in range(3):
            u, v = np.linalg.svd(normals[j][None])[2][1:]
            turned.append(unit(normals[j] + theta[6 + 2 * j] * u + theta[7 + 2 * j] * v))
        n = np.stack(turned)
        return np.concatenate([ranges(pose, n, i, j, u) for (i, j), u in directions.items()])

    J = np.column_stack([(expected(h * e) - expected(-h * e)) / (2.0 * h) for e in np.eye(12)])
    return np.linalg.inv(J.T @ J)[:6, :6] * SIGMA_M**2


def test_without_noise_the_estimate_is_exact() -> None:
    rng = np.random.default_rng(0)
    fit = fit_corner_model(observe(beams(30, rng), rng, 1e-7), start(), 0.01)
    metres, radians = fit.state.T_world_lidar.distance(TRUTH)
    assert metres < 1e-6
    assert radians < 1e-6


def test_estimates_reach_the_cramer_rao_bound_and_state_it() -> None:
    rng = np.random.default_rng(1)
    directions = beams(120, rng)
    limit = bound(directions)
    errors, nees = [], []
    for _ in range(150):
        fit = fit_corner_model(observe(directions, rng), start(), SIGMA_M)
        xi = fit.state.T_world_lidar.minus(TRUTH)
        errors.append(xi)
        nees.append(xi @ np.linalg.solve(fit.pose_covariance, xi) / 6.0)
    sample = np.array(errors).T @ np.array(errors) / len(errors)
    ratio = np.sqrt(np.diag(sample) / np.diag(limit))
    assert ratio.max() < 1.15
    assert 0.85 < np.mean(nees) < 1.15
    np.testing.assert_allclose(np.diag(fit.pose_covariance), np.diag(limit), rtol=0.1)


def test_uncertain_world_coordinates_are_found_out_and_covered() -> None:
    rng = np.random.default_rng(2)
    directions = beams(200, rng)
    nees, sigmas = [], []
    for _ in range(30):
        places = observe(directions, rng)
        places = [replace(p, corner_world=p.corner_world + rng.normal(0.0, 0.004, 3)) for p in places]
        exact = fit_corner_model(places, start(), SIGMA_M)
        sigma, gain = estimate_world_sigma(exact)
        sigmas.append(sigma)
        assert gain > 3.0
        fit = fit_corner_model(places, exact.state, SIGMA_M, CornerOptions(0.004))
        xi = fit.state.T_world_lidar.minus(TRUTH)
        nees.append(xi @ np.linalg.solve(fit.pose_covariance, xi) / 6.0)
    assert np.median(sigmas) == pytest.approx(0.004, rel=0.2)
    assert 0.75 < np.mean(nees) < 1.3


def test_exact_world_coordinates_are_taken_for_exact() -> None:
    rng = np.random.default_rng(3)
    directions = beams(120, rng)
    gains = []
    for _ in range(20):
        places = observe(directions, rng)
        gains.append(estimate_world_sigma(fit_corner_model(places, start(), SIGMA_M))[1])
    assert np.mean(np.array(gains) > 9.0) <= 0.05


def test_scale_is_estimated_when_asked_for() -> None:
    rng = np.random.default_rng(4)
    places = observe(beams(200, rng), rng)
    shrunk = [
        replace(p, faces={j: FaceReturns(f.directions, f.range_m / 1.02, f.frame) for j, f in p.faces.items()})
        for p in places
    ]
    fit = fit_corner_model(shrunk, start(), SIGMA_M, CornerOptions(estimate_scale=True))
    sigma = np.sqrt(fit.covariance[6, 6])
    assert abs(np.log(fit.state.scale / 1.02)) < 4.0 * sigma
    assert sigma < 2e-3


def test_a_missing_face_costs_accuracy_only() -> None:
    rng = np.random.default_rng(5)
    places = observe(beams(120, rng), rng)
    places[2] = replace(places[2], faces={j: places[2].faces[j] for j in (0, 1)})
    fit = fit_corner_model(places, start(), SIGMA_M)
    xi = fit.state.T_world_lidar.minus(TRUTH)
    assert xi @ np.linalg.solve(fit.pose_covariance, xi) < 25.0


def test_outliers_do_little() -> None:
    rng = np.random.default_rng(6)
    places = observe(beams(200, rng), rng)
    for p in places:
        for f in p.faces.values():
            noisy = f.range_m.copy()
            noisy[::10] += rng.uniform(0.05, 0.5, len(noisy[::10]))
            object.__setattr__(f, "range_m", noisy)
    fit = fit_corner_model(places, start(), SIGMA_M)
    xi = fit.state.T_world_lidar.minus(TRUTH)
    assert xi @ np.linalg.solve(fit.pose_covariance, xi) < 25.0


def test_a_turned_target_is_seen_at_its_place() -> None:
    rng = np.random.default_rng(7)
    places = observe(beams(300, rng), rng)
    global_normals = TRUTH.inverse().rotate(NORMALS_WORLD)
    turned = (exp_so3([0.0, 0.0, 0.03]) @ global_normals.T).T
    faces = {}
    for j in range(3):
        f = places[1].faces[j]
        r = ranges(TRUTH, turned, 1, j, f.directions) + rng.normal(0.0, SIGMA_M, len(f))
        faces[j] = FaceReturns(f.directions, r, f.frame)
    places[1] = replace(places[1], faces=faces)
    fit = fit_corner_model(places, start(), SIGMA_M)
    moves, statistic, known = place_discrepancies(fit)
    assert known.all()
    assert int(np.argmax(statistic)) == 1
    assert statistic[1] > 30.0
    assert np.linalg.norm(moves[1, 3:]) == pytest.approx(0.03, rel=0.5)


def test_places_on_one_line_leave_a_turn_undetermined() -> None:
    rng = np.random.default_rng(8)
    places = observe(beams(60, rng), rng, 1e-6)
    corner = TRUTH.inverse() @ WORLD[0]
    # The same place thrice, with world coordinates to match: nothing tells the orientation.
    same = [replace(places[0], position=f"q{k}") for k in range(3)]
    state = replace(start(), world_errors=np.zeros((3, 3)))
    assert np.isfinite(corner).all()
    with pytest.raises(UndeterminedError, match="pose"):
        fit_corner_model(same, state, SIGMA_M)


def test_one_places_corner_and_its_frames() -> None:
    rng = np.random.default_rng(9)
    places = observe(beams(400, rng), rng)
    normals, true = TRUTH.inverse().rotate(NORMALS_WORLD), TRUTH.inverse() @ WORLD[0]
    alone = fit_corner(places[0].faces, start().normals, true + 0.02, SIGMA_M)
    corner, found, sigma = alone.corner, alone.normals, alone.sigma_m
    worst, statistic = alone.turn_statistic(normals)
    assert worst < 0.01
    assert statistic < 25.0
    assert alone.turn_statistic((exp_so3([0.0, 0.0, 0.03]) @ normals.T).T)[1] > 60.0
    assert np.linalg.norm(corner - true) < 0.005
    assert np.abs(found - normals).max() < 0.01
    assert sigma == pytest.approx(SIGMA_M, rel=0.1)
    by_frame = PlaceFrames.of(places[0].faces, found, corner, 5, sigma).corners()
    assert np.isnan(by_frame[4]).all()
    assert np.abs(by_frame[:4] - true).max() < 0.02
    # A frame by itself: three free planes through its returns alone.
    frame = {
        j: FaceReturns(f.directions[f.frame == 2], f.range_m[f.frame == 2], f.frame[f.frame == 2])
        for j, f in places[0].faces.items()
    }
    np.testing.assert_allclose(by_frame[2], fit_corner(frame, found, corner, sigma).corner, atol=3e-4)


def test_fit_result_names_its_parameters() -> None:
    rng = np.random.default_rng(10)
    fit: CornerFit = fit_corner_model(observe(beams(60, rng), rng), start(), SIGMA_M, CornerOptions(0.001, True))
    assert len(fit.names) == len(fit.covariance) == 6 + 1 + 6 + 15
    assert fit.names[6] == "log_scale"


def test_weights_of_faces_change_the_estimate_as_fewer_or_no_returns_would() -> None:
    rng = np.random.default_rng(12)
    places = observe(beams(80, rng), rng)
    fit = fit_corner_model(places, start(), SIGMA_M, settled=1e-6)
    doubled = reweighted(fit, dict.fromkeys(fit.systems, 2.0))
    assert doubled.state.T_world_lidar.distance(fit.state.T_world_lidar)[0] < 1e-7
    np.testing.assert_allclose(doubled.covariance, 2.0 * fit.covariance, rtol=1e-9)
    silenced = reweighted(fit, {(1, 2): 1e9})
    without = [replace(p, faces={j: f for j, f in p.faces.items() if (i, j) != (1, 2)}) for i, p in enumerate(places)]
    expected = fit_corner_model(without, start(), SIGMA_M, settled=1e-6)
    xi = silenced.state.T_world_lidar.minus(expected.state.T_world_lidar)
    assert xi @ np.linalg.solve(expected.pose_covariance, xi) < 0.01
    assert np.abs(xi).max() < 0.2 * np.abs(fit.state.T_world_lidar.minus(expected.state.T_world_lidar)).max()
    np.testing.assert_allclose(np.diag(silenced.covariance), np.diag(expected.covariance), rtol=0.05)


def spread_over_faces(
    directions: dict[tuple[int, int], FloatArray], width_rad: float, frames: int, rng: np.random.Generator
) -> list[CornerPlaceFaces]:
    """Places at which every frame has the same beams, each of them off in direction by a part of its width for good."""
    normals = TRUTH.inverse().rotate(NORMALS_WORLD)
    places = []
    for i in range(len(WORLD)):
        faces = {}
        for j in range(3):
            u = directions[i, j]
            truly = unit(u + rng.normal(0.0, width_rad, u.shape))
            r = np.tile(ranges(TRUTH, normals, i, j, truly), frames) + rng.normal(0.0, SIGMA_M, frames * len(u))
            faces[j] = FaceReturns(np.tile(u, (frames, 1)), r, np.repeat(np.arange(frames), len(u)))
        places.append(CornerPlaceFaces(f"p{i}", WORLD[i], faces, frames))
    return places


def test_wide_beams_at_grazing_angles_are_weighed_by_what_they_err_together() -> None:
    """The error of a direction is an error of the range by the range times the tangent of the angle of incidence."""
    rng = np.random.default_rng(13)
    directions = beams(150, rng)
    before: list[float] = []
    after: list[float] = []
    for _ in range(40):
        places = spread_over_faces(directions, 0.0015, 10, rng)
        fit = fit_corner_model(places, start(), SIGMA_M)
        weighed = weighed_by_angle(fit, places, spot_scatter(fit, places))
        for found, nees in ((fit, before), (weighed, after)):
            xi = found.state.T_world_lidar.minus(TRUTH)
            nees.append(float(xi @ np.linalg.solve(found.pose_covariance, xi)) / 6.0)
    assert np.mean(before) > 1.8
    # The mean of 40 chi-squares of six degrees of freedom: 1 +- 3 standard deviations of 0.09.
    assert 0.73 < np.mean(after) < 1.27


def test_narrow_beams_are_weighed_as_they_are() -> None:
    rng = np.random.default_rng(14)
    weighed = []
    for _ in range(20):
        places = spread_over_faces(beams(60, rng), 0.0, 4, rng)
        fit = fit_corner_model(places, start(), SIGMA_M)
        weighed.append(weighed_by_angle(fit, places, spot_scatter(fit, places)) is not fit)
    # Chance reaches the gain once in twelve times.
    assert sum(weighed) <= 5


def bent(places: list[CornerPlaceFaces], rng: np.random.Generator, off_m: float) -> list[CornerPlaceFaces]:
    """The places with a face that is off its plane by a sum of waves of 15 to 60 cm, alike at all of them."""
    waves = rng.normal(size=(12, 3)) * 2.0 * np.pi / rng.uniform(0.15, 0.6, (12, 1))
    phases, sizes = rng.uniform(0.0, 2.0 * np.pi, 12), rng.normal(0.0, off_m / np.sqrt(6.0), 12)
    normal = TRUTH.inverse().rotate(NORMALS_WORLD)[0]
    found = []
    for place in places:
        f, corner = place.faces[0], TRUTH.inverse() @ place.corner_world
        on_face = f.range_m[:, None] * f.rays.T - corner
        off = np.cos(on_face @ waves.T + phases) @ sizes
        ranges_m = f.range_m + off / (normal @ f.rays)
        found.append(replace(place, faces={**place.faces, 0: FaceReturns(f.rays.T, ranges_m, f.frame)}))
    return found


def test_what_bends_a_face_at_all_places_is_told_and_in_the_covariance() -> None:
    squared, without = [], []
    for seed in range(30):
        rng = np.random.default_rng([seed, 5])
        places = bent(observe(beams(400, rng), rng), rng, 0.003)
        fit = fit_corner_model(places, start(), SIGMA_M)
        shape = face_shape(fit, places)
        assert shape is not None
        assert set(shape.off_m) == {0}
        error = (TRUTH @ fit.state.T_world_lidar.inverse()).log()
        squared.append(error @ np.linalg.solve((fit.covariance + shape.covariance)[:6, :6], error))
        without.append(error @ np.linalg.solve(fit.pose_covariance, error))
    assert np.mean(without) > 20.0
    assert 3.0 < np.mean(squared) < 9.0


def test_flat_faces_are_bent_by_nothing() -> None:
    found = []
    for seed in range(30):
        rng = np.random.default_rng([seed, 6])
        places = observe(beams(400, rng), rng)
        found.append(face_shape(fit_corner_model(places, start(), SIGMA_M), places))
    assert sum(shape is not None for shape in found) <= 1
