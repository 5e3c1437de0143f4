"""Sweeps of a turned 2D LiDAR as frames of a corner session: recordings, scanned into clouds, give world <- camera."""

import json
from pathlib import Path

import numpy as np

from lidarpose.cli.main import run
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.storage.calibration import read_world_calibration

# The carton stands on its tip, towards the camera; it is moved, never turned.
SIZE_M = 0.4
TIP = np.degrees(np.arccos(1.0 / np.sqrt(3.0))) * np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
CORNERS = np.array([[-0.45, -0.2, 1.6], [0.4, -0.15, 1.8], [0.1, 0.25, 1.5], [-0.15, 0.1, 2.1]])
T_WORLD_CAMERA = Pose.exp(np.array([1.0, -0.5, 1.4, -1.9, 0.3, 0.2]))


def scene(corner: FloatArray) -> str:
    centre = corner + exp_so3(np.radians(TIP)) @ np.full(3, SIZE_M / 2.0)
    return f"""\
format = "lidarpose/scene@1"
[[boxes]]
centre_m = {centre.tolist()}
rotation_vector_deg = {TIP.tolist()}
size_m = [{SIZE_M}, {SIZE_M}, {SIZE_M}]
[[planes]]
centre_m = [0.0, 0.0, 3.5]
"""


def test_recordings_and_their_calibration_give_the_cameras_pose(tmp_path: Path) -> None:
    session = tmp_path / "session"
    rows = ["position,world_x_m,world_y_m,world_z_m,clouds"]
    for k, (corner, world) in enumerate(zip(CORNERS, T_WORLD_CAMERA @ CORNERS, strict=True)):
        (tmp_path / "scene.toml").write_text(scene(corner))
        recording, cloud = str(tmp_path / f"recording{k}"), session / f"clouds/p{k}/000.ply"
        cloud.parent.mkdir(parents=True)
        steps = ["--turntable-deg", "-22", "22", "--sweep-step-deg", "0.4", "--beam-step-deg", "0.3", "--seed", str(k)]
        steps += ["--range-sigma-m", "0.003"]
        assert run(["simulate", "scene", str(tmp_path / "scene.toml"), recording, *steps]) == 0
        assert run(["scan", recording, recording + ".calibration.json", "-o", str(cloud)]) == 0
        rows.append(f"p{k}," + ",".join(f"{x:.6f}" for x in world) + f",clouds/p{k}/*.ply")
    (session / "positions.csv").write_text("\n".join(rows) + "\n")
    header = ['format = "lidarpose/corner-session@1"', 'positions = "positions.csv"', 'cloud_frame = "camera"']
    (session / "session.toml").write_text("\n".join(header) + "\n")
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 0
    found = read_world_calibration(tmp_path / "out" / "calibration.json")
    metres, radians = found.T_world_source.distance(T_WORLD_CAMERA)
    assert metres < 0.002
    assert np.degrees(radians) < 0.06
    document = json.loads((tmp_path / "out" / "calibration.json").read_text())
    assert [(t["parent"], t["child"]) for t in document["transforms"]] == [("world", "camera")]
    assert document["quality"]["verdict"] == "good"
