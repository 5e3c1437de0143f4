"""Whole folders to damage: small sessions, and readers that load everything in them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from lidarpose.model.camera import Camera
from lidarpose.model.cloud import Cloud
from lidarpose.storage.camera_info import write_camera_info
from lidarpose.storage.clouds import write_cloud
from lidarpose.storage.corner_session import read_corner_session, truth_beside
from lidarpose.storage.session import read_turntable_session
from lidarpose.storage.truth import read_turntable_truth

CAMERA = Camera(64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), "plumb_bob", np.array([0.1, 0, 0, 0, 0]))

_TURNTABLE = """format = "lidarpose/turntable-session@1"
camera = "camera.yaml"
positions = "positions.csv"
[board]
images = "board/*.png"
[[board.panels]]
columns = 5
rows = 4
square_m = 0.020
[[board.panels]]
columns = 5
rows = 4
square_m = 2e-2
[lidar]
model = "SICK"
range_sigma_m = 1e-3
"""
_CORNERS = """format = "lidarpose/corner-session@1"
positions = "positions.csv"
world_sigma_m = 1e-3
estimate_scale = false
cloud_frame = "lidar"
[lidar]
range_sigma_m = 0.008
"""
SCENE = """format = "lidarpose/scene@1"
[[disks]]
centre_m = [0, 0, 1.5]
rotation_vector_deg = [10, 0, 0]
diameter_m = 0.14
[[boxes]]
centre_m = [0.5, 0, 2e0]
size_m = [0.3, 0.2, 0.15]
[[planes]]
centre_m = [0, 0, 2.5]
size_m = [3, 3]
holes = [{ centre_m = [0.1, 0.1], diameter_m = 0.2 }]
"""


def make_turntable(folder: Path) -> Path:
    """A turntable session of four places without a board in sight, with a truth beside it."""
    session = folder / "session"
    for name in ("board", "stripes", "scans"):
        (session / name).mkdir(parents=True, exist_ok=True)
    (session / "session.toml").write_text(_TURNTABLE)
    write_camera_info(session / "camera.yaml", CAMERA)
    rng = np.random.default_rng(0)
    cv2.imwrite(str(session / "board" / "00.png"), rng.integers(0, 255, (48, 64)).astype(np.uint8))
    rows = ["position,turntable_angle_deg,stripe_image,scan,placement"]
    for k in range(4):
        cv2.imwrite(str(session / "stripes" / f"{k}.png"), rng.integers(0, 9, (48, 64)).astype(np.uint8))
        beams = "\n".join(f"{a},{1.0 + 0.01 * a},{a}" if a % 7 else f"{a},," for a in range(40))
        (session / "scans" / f"{k}.csv").write_text(f"angle_deg,range_m,intensity\n{beams}\n")
        rows.append(f"{k},{5 * k},stripes/{k}.png,scans/{k}.csv,here")
    (session / "board" / "here").mkdir(exist_ok=True)
    (session / "board" / "00.png").rename(session / "board" / "here" / "00.png")
    (session / "positions.csv").write_text("\n".join(rows) + "\n")
    identity = np.eye(4).tolist()
    transforms = [
        {"parent": "camera", "child": "turntable", "matrix": identity},
        {"parent": "turntable", "child": "lidar", "translation_m": [0.1, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]},
    ]
    (folder / "session.truth.json").write_text(json.dumps({"transforms": transforms}))
    return session


def load_turntable(folder: Path) -> object:
    """Everything that a turntable session holds."""
    session = read_turntable_session(folder)
    images = [image.load() for shots in session.board_images.values() for image in shots]
    images += [place.stripe_image.load() for place in session.places if place.stripe_image is not None]
    return images, [place.scan.load() for place in session.places], read_turntable_truth(folder)


def make_corners(folder: Path) -> Path:
    """A corner session of three places."""
    session = folder / "corners"
    rows = ["position,world_x_m,world_y_m,world_z_m,clouds,near_x_m,near_y_m,near_z_m"]
    points = np.random.default_rng(0).normal(size=(40, 3)).astype(np.float32)
    for k, suffix in enumerate((".pcd", ".ply", ".npy")):
        write_cloud(session / "clouds" / f"p{k}" / f"0{suffix}", Cloud(points))
        rows.append(f"p{k},{k},1.5,0,clouds/p{k}/*{suffix},{k},1,0")
    (session / "session.toml").write_text(_CORNERS)
    (session / "positions.csv").write_text("\n".join(rows) + "\n")
    return session


def load_corners(folder: Path) -> object:
    """Everything that a corner session holds."""
    session = read_corner_session(folder)
    return [cloud.load() for place in session.places for cloud in place.clouds], truth_beside(folder)
