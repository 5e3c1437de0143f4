"""Boards and stripes in images of real cameras: what is found, and how flat the light planes come out."""

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from lidarpose.detect.chessboard import BoardNotFoundError, find_panels
from lidarpose.detect.laser_stripe import StripeFinder
from lidarpose.geometry.planes import fit_plane
from lidarpose.model.camera import Camera
from lidarpose.model.targets import Panel
from lidarpose.solve.light_plane import fit_light_plane, stripe_on_panel
from lidarpose.solve.panel_pose import panel_pose
from tests_support.real import recording as folder


def grey(path: Path):
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None, path
    return image


def calibrate(boards, panel: Panel, size: tuple[int, int]) -> Camera:
    """Intrinsics from the boards themselves, where the recording has none."""
    object_points = [panel.corners_panel().astype(np.float32)] * len(boards)
    image_points = [board.corners[0].pixels.astype(np.float32)[:, None] for board in boards]
    start, none = np.eye(3), np.zeros(5)
    _, K, distortion, _, _ = cv2.calibrateCamera(object_points, image_points, size, start, none, flags=cv2.CALIB_FIX_K3)
    return Camera(*size, np.asarray(K, dtype=float), "plumb_bob", np.asarray(distortion, dtype=float).ravel()[:5])


def stripe_in_space(camera: Camera, board, bright, image):
    """The stripe's points in the camera frame, or None where detection gave up."""
    found = StripeFinder(board, [bright]).find(image)
    if 0 not in found.stripes:
        return None
    return stripe_on_panel(camera, panel_pose(camera, board.corners[0]).T_camera_panel, found.stripes[0])


BOARDS = {
    "linelight_julliffbistu": ("*[02468].bmp", Panel(19, 15, 0.005), 9),
    "linelight_mozhi": ("*_board.png", Panel(11, 7, 0.01), 10),
    "turntable_srv": ("*_board/*.jpg", Panel(8, 6, 0.04), 34),
    "lcct_cmu": ("sample_data/*.jpg", Panel(7, 5, 0.03), 9),
    "sweep_suijingfeng": ("*.png", Panel(8, 6, 0.0775), 6),
    "box_jimin": ("check_pattern/*.jpg", Panel(8, 6, 0.026), 6),
    "acfr_planes": ("*.png", Panel(7, 5, 0.105), 2),
    "trihedron_ygchoi11": ("realworld/camera_calibration/*.png", Panel(24, 12, 0.01), 12),
}


@pytest.mark.parametrize("name", BOARDS)
def test_every_board_is_found(name: str) -> None:
    pattern, panel, count = BOARDS[name]
    paths = sorted(p for p in folder(name).glob(pattern) if p.stem not in {"14", "15"})
    found = [find_panels([grey(path)], [panel]) for path in paths]
    assert len(found) >= count
    for board in found:
        pixels = board.corners[0].pixels.reshape(panel.rows, panel.columns, 2)
        along, down = pixels[0, -1] - pixels[0, 0], pixels[-1, 0] - pixels[0, 0]
        assert along[0] * down[1] - along[1] * down[0] > 0.0
        assert np.median(board.corners[0].sigma_px) < 0.6


def test_published_light_plane_is_met() -> None:
    here = folder("linelight_julliffbistu")
    text = (here / "Calib_Results.m").read_text(encoding="latin-1")

    def numbers(key: str):
        found = re.search(rf"^{key} = \[(.*?)\]", text, re.M)
        assert found is not None, key
        return [float(x) for x in found.group(1).split(";")]

    (fx, fy), (cx, cy) = numbers("fc"), numbers("cc")
    camera = Camera(782, 582, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), "plumb_bob", np.array(numbers("kc")))
    pairs = [(here / f"{k}.bmp", here / f"{k + 1}.bmp") for k in range(0, 14, 2)]
    pairs.append((here / "zhang_14.bmp", here / "15.bmp"))
    stripes = []
    for bright_path, stripe_path in pairs:
        bright = grey(bright_path)
        board = find_panels([bright], [Panel(19, 15, 0.005)])
        stripe = stripe_in_space(camera, board, bright, grey(stripe_path))
        assert stripe is not None, stripe_path
        stripes.append(stripe)
    light = fit_light_plane(stripes)
    published = np.array([0.04997026845, -2.110676658, -1.0])
    offset = -0.3022713638 / np.linalg.norm(published)
    published /= np.linalg.norm(published)
    sign = np.sign(published @ light.plane.normal)
    assert np.degrees(np.arccos(abs(published @ light.plane.normal))) < 0.1
    assert abs(sign * light.plane.offset - offset) < 1e-3
    assert light.rms_m < 0.04e-3


def test_pairs_with_a_paper_board() -> None:
    here = folder("linelight_mozhi")
    panel = Panel(11, 7, 0.01)
    bright = [grey(path) for path in sorted(here.glob("*_board.png"))]
    lit = [grey(path) for path in sorted(here.glob("*_laser.png"))]
    boards = [find_panels([image], [panel]) for image in bright]
    camera = calibrate(boards, panel, (1292, 964))
    stripes = []
    for board, image, stripe_image in zip(boards, bright, lit, strict=True):
        stripe = stripe_in_space(camera, board, image, stripe_image)
        if stripe is None:
            # The board was moved between the two images of a pair; the second one shows board and stripe.
            stripe = stripe_in_space(camera, find_panels([stripe_image], [panel]), stripe_image, stripe_image)
        if stripe is not None:
            stripes.append(stripe)
    assert len(stripes) >= 9
    points = np.vstack([s.points_camera for s in stripes])
    distance = fit_plane(points).distance(points)
    assert np.sqrt((distance**2).mean()) < 1e-3


def test_board_and_stripe_in_one_image() -> None:
    paths = sorted(folder("blaser").glob("*/*.png"), key=lambda p: int(p.stem[2:]))
    panel = Panel(9, 6, 0.005)
    images, boards = [], []
    for path in paths:
        image = grey(path)
        try:
            boards.append(find_panels([image], [panel]))
            images.append(image)
        except BoardNotFoundError:
            # Too dark, or not in view: the laser alone lights what is seen.
            assert np.percentile(image, 75) < 20
    assert len(boards) >= 14
    camera = calibrate(boards, panel, (640, 480))
    found = [stripe_in_space(camera, b, image, image) for b, image in zip(boards, images, strict=True)]
    stripes = [stripe for stripe in found if stripe is not None]
    assert len(stripes) >= 3
    assert fit_light_plane(stripes).rms_m < 0.1e-3
