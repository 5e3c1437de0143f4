"""Corner sessions made by a ray caster that shares nothing with the package's simulator, read from files."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.calibration import WorldCalibration
from lidarpose.storage.corner_session import read_corner_session
from lidarpose.workflows.world import calibrate_world

Surface = tuple[FloatArray, FloatArray, FloatArray]
GRID = np.array([431_276.5, 5_284_117.25, 312.0])
# Where the carton's corner stands before the LiDAR.
SPOTS = ((1.8, -0.5), (2.5, -0.3), (2.0, 0.5), (2.6, 0.4), (1.9, 0.0))


def rotation(vector: Sequence[float] | FloatArray) -> FloatArray:
    """By Rodrigues' formula."""
    angle = np.linalg.norm(vector)
    x, y, z = np.asarray(vector) / angle
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K)


def box(corner: FloatArray, edges: FloatArray) -> Iterator[Surface]:
    """Six parallelograms (corner, edge, edge) of a box by a corner and three edges (rows)."""
    for k in range(3):
        a, b = edges[(k + 1) % 3], edges[(k + 2) % 3]
        yield corner, a, b
        yield corner + edges[k], a, b


def cast(surfaces: Sequence[Surface], origin: FloatArray, rays: FloatArray) -> FloatArray:
    """Distance (N,) to the first parallelogram; infinite where there is none."""
    nearest = np.full(len(rays), np.inf)
    for corner, a, b in surfaces:
        with np.errstate(divide="ignore", invalid="ignore"):
            solved = np.linalg.solve(
                np.stack([rays, np.broadcast_to(-a, rays.shape), np.broadcast_to(-b, rays.shape)], axis=2)
                + 1e-12 * np.eye(3),
                np.broadcast_to((corner - origin)[:, None], (len(rays), 3, 1)),
            )[..., 0]
        hit = (solved[:, 0] > 0.1) & np.all((solved[:, 1:] >= 0) & (solved[:, 1:] <= 1), axis=1)
        nearest = np.where(hit & (solved[:, 0] < nearest), solved[:, 0], nearest)
    return nearest


def ring_rays(rings: int, steps: int) -> FloatArray:
    elevation, azimuth = np.meshgrid(np.radians(np.linspace(-42, 4, rings)), np.linspace(-0.7, 0.7, steps))
    up, round_ = elevation.ravel(), azimuth.ravel()
    return np.column_stack([np.cos(up) * np.cos(round_), np.cos(up) * np.sin(round_), np.sin(up)])


def write_pcd(path: Path, points: FloatArray) -> None:
    head = f"VERSION 0.7\nFIELDS z x y\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
    head += f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA binary\n"
    path.write_bytes(head.encode() + points[:, [2, 0, 1]].astype("<f4").tobytes())


def make_session(
    folder: Path, seed: int, places: int, frames: int, sigma_m: float, world_sigma_m: float
) -> tuple[FloatArray, FloatArray]:
    """A carton on the floor of a room with another carton, moved about; the truth as rotation and translation."""
    rng = np.random.default_rng([seed, 2718])
    R_world, R_lidar = rotation([0, 0, rng.uniform(-3, 3)]), rotation(rng.normal(0, 0.08, 3))
    origin = np.array([0.0, 0.0, 1.3])
    size = rng.uniform(0.4, 0.6, 3)
    yaw = rng.uniform(0.7, 0.87)
    edges = np.diag(size) @ np.array([[np.cos(yaw), -np.sin(yaw), 0], [np.sin(yaw), np.cos(yaw), 0], [0, 0, -1.0]])
    room = [(np.array([-9.0, -9, 0]), np.array([18.0, 0, 0]), np.array([0, 18.0, 0]))]
    room += [(np.array([4.5, -9.0, 0]), np.array([0, 18.0, 0]), np.array([0, 0, 3.0]))]
    room += list(box(np.array([3.4, 1.3, 0]), np.diag([0.5, 0.4, 0.8])))
    rows = ["position,world_x_m,world_y_m,world_z_m,clouds"]
    for k in range(places):
        corner = np.array([*SPOTS[k], size[2]]) + np.append(rng.uniform(-0.1, 0.1, 2), 0.0)
        (folder / f"clouds/p{k}").mkdir(parents=True)
        for frame in range(frames):
            rays = ring_rays(64, 320)
            ranges = cast([*room, *box(corner, edges)], origin, rays @ R_lidar.T)
            seen = np.isfinite(ranges) & (rng.random(len(ranges)) > 0.02)
            noisy = ranges[seen] + rng.normal(0, sigma_m, np.count_nonzero(seen))
            write_pcd(folder / f"clouds/p{k}/{frame}.pcd", rays[seen] * noisy[:, None])
        x, y, z = R_world @ corner + GRID + rng.normal(0, world_sigma_m, 3)
        rows.append(f"p{k},{x:.5f},{y:.5f},{z:.5f},clouds/p{k}/*.pcd")
    (folder / "positions.csv").write_text("\n".join(rows) + "\n")
    text = f'format = "lidarpose/corner-session@1"\npositions = {json.dumps("positions.csv")}\n'
    (folder / "session.toml").write_text(text)
    return R_world @ R_lidar, R_world @ origin + GRID


def squared_error(calibration: WorldCalibration, truth: tuple[FloatArray, FloatArray]) -> float:
    """Over the covariance, about the LiDAR's own centre."""
    R, t = truth
    assert calibration.covariance is not None
    pose = calibration.T_world_source
    D = R @ pose.rotation.T
    turn = 0.5 * np.array([D[2, 1] - D[1, 2], D[0, 2] - D[2, 0], D[1, 0] - D[0, 1]])
    x, y, z = pose.translation
    about = np.eye(6)
    about[:3, 3:] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    covariance = about @ calibration.covariance @ about.T
    error = np.concatenate([t - pose.translation, turn])
    scale = 1 / np.sqrt(np.diag(covariance))
    return float(scale * error @ np.linalg.solve(covariance * np.outer(scale, scale), scale * error))


def errors(tmp_path: Path, seeds: range, frames: int) -> list[float]:
    found = []
    for seed in seeds:
        folder = tmp_path / str(seed)
        truth = make_session(folder, seed, 3 + seed % 3, frames, 0.006, (0.0, 0.0005, 0.001)[seed % 3])
        calibration = calibrate_world(read_corner_session(folder))
        assert calibration.quality is not None
        assert calibration.quality.verdict != "rejected", seed
        assert np.linalg.norm(calibration.T_world_source.translation - truth[1]) < 0.03, seed
        found.append(squared_error(calibration, truth))
    return found


def test_cartons_in_a_national_grid(tmp_path: Path) -> None:
    # 24 is hardly ever exceeded by a chi-square of six degrees of freedom.
    assert max(errors(tmp_path, range(3), 1)) < 24.0


@pytest.mark.slow
def test_many_cartons_in_a_national_grid(tmp_path: Path) -> None:
    found = errors(tmp_path, range(10, 34), 2)
    assert np.mean(found) < 9.0
    assert max(found) < 40.0
