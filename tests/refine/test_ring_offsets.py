"""Offsets of single rings beside the joint corner estimate: against dense linear algebra, and by sampling.

Returns are made by intersecting the beams of a 16-line LiDAR with planes here, not by the estimator's formulas.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.beam_crossing import seen_crossing
from lidarpose.refine.corner_model import CornerFit, CornerState, fit_corner_model
from lidarpose.refine.ring_offsets import RingOffsets, find_rings, ring_offsets, some_returns

TRUTH = Pose(exp_so3([0.02, 0.1, 0.3]), np.array([0.2, -0.1, 1.0]))
NORMALS = TRUTH.inverse().rotate(unit(np.array([[-0.3, 0.1, 0.95], [-0.7, 0.7, 0.1], [-0.7, -0.7, 0.1]])))
WORLD = np.array([[1.9, -0.8, 0.9], [2.0, 0.9, 0.7], [1.8, 0.2, 1.2], [2.6, -0.4, 0.8], [2.5, 1.2, 1.1]])
SIGMA_M = 0.008
RINGS_RAD = np.radians(-15.0 + 2.0 * np.arange(16))


def beams() -> dict[tuple[int, int], FloatArray]:
    """Directions (N, 3) of whole rings within half a metre of each corner, by the face that each meets first."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-90.0, 90.0, 0.4)), RINGS_RAD)
    level = np.cos(elevation)
    directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    found = {}
    for i, world in enumerate(WORLD):
        corner = TRUTH.inverse() @ world
        reach = np.stack([(n @ corner) / np.minimum(directions @ n, -1e-3) for n in NORMALS])
        face = np.argmax(reach, axis=0)
        met = directions * reach.max(axis=0)[:, None]
        for j in range(3):
            found[i, j] = directions[(face == j) & (np.linalg.norm(met - corner, axis=1) < 0.5)]
    return found


DIRECTIONS = beams()


def observe(rng: np.random.Generator, offset_m: FloatArray, crossing_m: float = 0.0) -> list[CornerPlaceFaces]:
    """Beams start `crossing_m` times the tangent of their elevation below the origin, which directions and ranges leave
    out."""
    places = []
    for i, world in enumerate(WORLD):
        corner = TRUTH.inverse() @ world
        faces = {}
        for j in range(3):
            u = DIRECTIONS[i, j]
            ring = np.round((np.degrees(np.arcsin(u[:, 2])) + 15.0) / 2.0).astype(int)
            start = np.zeros_like(u)
            start[:, 2] = -crossing_m * u[:, 2] / np.sqrt(1.0 - u[:, 2] ** 2)
            r = (NORMALS[j] @ corner - start @ NORMALS[j]) / (u @ NORMALS[j])
            r = r + offset_m[ring] + rng.normal(0.0, SIGMA_M, len(u))
            faces[j] = FaceReturns(u, r, np.zeros(len(u), dtype=np.int64))
        places.append(CornerPlaceFaces(f"p{i}", world, faces, 1))
    return places


def plain(places: list[CornerPlaceFaces]) -> CornerFit:
    start = CornerState(Pose.exp([0.01, -0.02, 0.01, 0.01, 0.0, -0.01]) @ TRUTH, NORMALS, 1.0, np.zeros((5, 3)))
    return fit_corner_model(places, start, SIGMA_M)


def beside_offsets(places: list[CornerPlaceFaces]) -> tuple[CornerFit, RingOffsets | None]:
    fit = plain(places)
    rings = find_rings(places)
    assert rings is not None
    offsets = ring_offsets(fit, places, rings)
    for _ in range(2):
        if offsets is None:
            return fit, None
        clean = offsets.corrected(places)
        fit = fit_corner_model(clean, fit.state, fit.range_sigma_m)
        offsets = ring_offsets(fit, clean, rings, offsets.offset_m)
    return fit, offsets


def test_offsets_are_found_and_the_pose_with_them() -> None:
    rng = np.random.default_rng(0)
    chi_square, errors, plain_errors, sigmas, off = [], [], [], [], []
    for _ in range(24):
        truth = rng.normal(0.0, 0.007, 16)
        places = observe(rng, truth)
        fit, offsets = beside_offsets(places)
        assert offsets is not None
        xi = fit.state.T_world_lidar.minus(TRUTH)
        chi_square.append(xi @ np.linalg.solve(offsets.covariance[:6, :6], xi))
        errors.append(xi)
        plain_errors.append(plain(places).state.T_world_lidar.minus(TRUTH))
        sigmas.append(offsets.sigma_m)
        seen = np.unique(np.round((np.degrees(offsets.rings.elevation_rad) + 15.0) / 2.0).astype(int))
        off.append(np.std(offsets.offset_m - truth[seen]))
    # Six degrees of freedom, 24 runs: a standard deviation of 0.7.
    assert 4.3 < np.mean(chi_square) < 7.7
    assert np.mean(np.sum(np.square(errors), axis=0) < 0.25 * np.sum(np.square(plain_errors), axis=0)) > 0.8
    assert np.median(sigmas) == pytest.approx(0.007, rel=0.2)
    assert np.median(off) < 0.002


def test_without_offsets_nothing_is_found() -> None:
    rng = np.random.default_rng(1)
    for _ in range(24):
        places = observe(rng, np.zeros(16))
        assert beside_offsets(places)[1] is None
        few = some_returns(places)
        rings = find_rings(few)
        assert rings is not None
        assert ring_offsets(plain(places), few, rings) is None


def test_the_covariance_is_that_of_generalised_least_squares() -> None:
    """Against the dense covariance of all ranges, noise and offsets together, with numerical derivatives."""
    rng = np.random.default_rng(2)
    places = observe(rng, rng.normal(0.0, 0.007, 16))
    fit, offsets = beside_offsets(places)
    assert offsets is not None

    def expected(theta: FloatArray) -> FloatArray:
        pose = Pose.exp(theta[:6]) @ fit.state.T_world_lidar
        parts = []
        for j in range(3):
            u, v = np.linalg.svd(fit.state.normals[j][None])[2][1:]
            normal = unit(fit.state.normals[j] + theta[6 + 2 * j] * u + theta[7 + 2 * j] * v)
            for i, world in enumerate(WORLD):
                plane = Plane(normal, float(normal @ (pose.inverse() @ world)))
                parts.append(np.linalg.norm(plane.intersect_rays(DIRECTIONS[i, j]), axis=1))
        return np.concatenate(parts)

    step = 1e-6
    J = np.column_stack([(expected(step * e) - expected(-step * e)) / (2.0 * step) for e in np.eye(12)])
    elevation = np.concatenate([DIRECTIONS[i, j][:, 2] for j in range(3) for i in range(len(WORLD))])
    same = np.abs(elevation[:, None] - elevation) < 1e-9
    whole = fit.range_sigma_m**2 * np.eye(len(J)) + offsets.sigma_m**2 * same
    dense = np.linalg.inv(J.T @ np.linalg.solve(whole, J))[:6, :6]
    np.testing.assert_allclose(np.sqrt(np.diag(offsets.covariance)[:6]), np.sqrt(np.diag(dense)), rtol=0.05)


def test_directions_that_come_in_no_rings_have_no_offsets() -> None:
    rng = np.random.default_rng(3)
    places = observe(rng, rng.normal(0.0, 0.01, 16))
    shaken = [
        replace(
            p,
            faces={
                j: replace(f, directions=unit(f.directions + rng.normal(0.0, 0.01, f.directions.shape)))
                for j, f in p.faces.items()
            },
        )
        for p in places
    ]
    assert find_rings(shaken) is None


def test_faces_of_few_returns_tell_neither_offsets_nor_a_crossing() -> None:
    """The joint estimate stands on a face of which no place has enough returns to be in rings."""
    rng = np.random.default_rng(8)
    all_returns = observe(rng, rng.normal(0.0, 0.005, 16))
    fit = plain(all_returns)
    places = [
        replace(p, faces={**p.faces, 0: p.faces[0].subset(np.arange(3) * (len(p.faces[0]) // 3))}) for p in all_returns
    ]
    rings = find_rings(places)
    assert rings is not None
    rings = replace(rings, numbers={key: ring for key, ring in rings.numbers.items() if key[1] != 0})
    assert ring_offsets(fit, places, rings) is None
    assert seen_crossing(fit, places, rings, 0.005, 1.0) is None


def test_a_crossing_of_the_beams_is_told_beside_offsets() -> None:
    rng = np.random.default_rng(6)
    for crossing_m in (0.0, 0.04):
        scores, seen_m, before, after = [], [], [], []
        for _ in range(16):
            places = observe(rng, rng.normal(0.0, 0.005, 16), crossing_m)
            fit, offsets = beside_offsets(places)
            rings = find_rings(places)
            assert offsets is not None
            assert rings is not None
            seen = seen_crossing(fit, places, rings, offsets.sigma_m, 1.0)
            assert seen is not None
            seen_m.append(seen.crossing_m)
            scores.append((seen.crossing_m - crossing_m) / seen.sigma_m)
            assert seen.told == (crossing_m > 0.0)
            before.append(fit.state.T_world_lidar.minus(TRUTH)[:3])
            after.append((Pose.exp(seen.move[:6]) @ fit.state.T_world_lidar).minus(TRUTH)[:3])
        if crossing_m == 0.0:
            assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.4)
        else:
            # One linear step, and faces that have given way a little.
            assert np.mean(seen_m) == pytest.approx(crossing_m, rel=0.15)
            assert np.sum(np.square(after)) < 0.25 * np.sum(np.square(before))
