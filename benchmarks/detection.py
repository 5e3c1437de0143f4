"""Boards and stripes: error and time beside OpenCV's, on simulated images of the paper's geometry.

Run by hand: ``python -m benchmarks.detection [SEED ...]``. All is timed in one process and interleaved; what counts are
the ratios, to decoding a PNG for stripes and to OpenCV's sector detector with its accuracy flag for boards.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import cv2
import numpy as np

from lidarpose.detect.chessboard import BoardDetection, find_panels
from lidarpose.detect.grid_map import fit_grid_map, grid_points
from lidarpose.detect.laser_stripe import StripeFinder
from lidarpose.model.observation import StripePoints
from lidarpose.simulate.rig import TurntableRig, draw_rig
from lidarpose.simulate.session import simulate_session

REPEATS = 7


def seconds(action: Callable[[], Any]) -> float:
    started = time.perf_counter()
    action()
    return time.perf_counter() - started


def rms(values: np.ndarray) -> float:
    return float(np.sqrt((values**2).mean()))


def sector_with_accuracy(image: np.ndarray, rig: TurntableRig) -> list[np.ndarray]:
    """Both boards by OpenCV: the first one found is painted over for the second."""
    canvas = image.copy()
    found = []
    for panel in rig.panels:
        size = (panel.columns, panel.rows)
        ok, corners = cv2.findChessboardCornersSB(canvas, size, flags=cv2.CALIB_CB_ACCURACY)
        if ok:
            pixels = corners.reshape(-1, 2).astype(float)
            found.append(pixels)
            outline = fit_grid_map(*size, grid_points(*size), pixels).map.outline(0.8)
            cv2.fillPoly(canvas, [np.round(outline).astype(np.int32)], float(canvas.mean()))
    return found


def true_corners(rig: TurntableRig) -> list[np.ndarray]:
    poses = rig.T_camera_panel[""]
    return [rig.camera.project(T @ panel.corners_panel()) for T, panel in zip(poses, rig.panels, strict=True)]


def corner_error(pixels: np.ndarray, truths: list[np.ndarray]) -> float:
    """RMS to the nearest true corners, whatever the order."""
    distances = [np.linalg.norm(pixels[:, None] - truth[None], axis=-1).min(axis=1) for truth in truths]
    return min(rms(d) for d in distances) / float(np.sqrt(2.0))


def stripe_error(rig: TurntableRig, place: int, panel: int, points: StripePoints) -> np.ndarray:
    """Distances along the points' normals from the true line, sampled finely."""
    ends = rig.chord(place, panel)
    assert ends is not None
    share = np.linspace(-0.05, 1.05, 8001)[:, None]
    line = rig.camera.project(rig.T_camera_panel[""][panel] @ (ends[0] + share * (ends[1] - ends[0])))
    nearest = np.argmin(((points.pixels[:, None] - line[None]) ** 2).sum(-1), axis=1)
    return np.asarray(((points.pixels - line[nearest]) * points.normals).sum(-1))


def rig_panel(rig: TurntableRig, board: BoardDetection, k: int) -> int:
    """Which of the rig's panels the detected one is."""
    centre = board.corners[k].pixels.mean(axis=0)
    return int(np.argmin([np.linalg.norm(truth.mean(axis=0) - centre) for truth in true_corners(rig)]))


def boards(rig: TurntableRig, image: np.ndarray) -> None:
    truths = true_corners(rig)
    ours, theirs = [], []
    for _ in range(REPEATS):
        ours.append(seconds(lambda: find_panels([image], rig.panels)))
        theirs.append(seconds(lambda: sector_with_accuracy(image, rig)))
    mine = [corner_error(c.pixels, truths) for c in find_panels([image], rig.panels).corners]
    sector = [corner_error(pixels, truths) for pixels in sector_with_accuracy(image, rig)]
    print(
        f"  boards, one shot: {1e3 * np.median(ours):.0f} ms, error {np.round(mine, 4)} px; "
        f"sector with accuracy: {1e3 * np.median(theirs):.0f} ms, error {np.round(sector, 4)} px"
    )


def stripes(rig: TurntableRig, shots: list[np.ndarray], images: dict[int, np.ndarray]) -> None:
    board = find_panels(shots, rig.panels)
    making = np.median([seconds(lambda: StripeFinder(board, shots)) for _ in range(3)])
    finder = StripeFinder(board, shots)
    errors, standardised, finding, decoding = [], [], [], []
    for place, image in images.items():
        encoded = cv2.imencode(".png", image)[1]
        for _ in range(REPEATS):
            decoding.append(seconds(partial(cv2.imdecode, encoded, cv2.IMREAD_GRAYSCALE)))
            finding.append(seconds(partial(finder.find, image)))
        for k, points in finder.find(image).stripes.items():
            error = stripe_error(rig, place, rig_panel(rig, board, k), points)
            errors.append(error)
            standardised.append(error / points.sigma_px)
    all_errors, all_standardised = np.concatenate(errors), np.concatenate(standardised)
    ratio = np.median(finding) / np.median(decoding)
    print(
        f"  stripes: {1e3 * np.median(finding):.1f} ms an image, {ratio:.2f} of decoding "
        f"({1e3 * np.median(decoding):.1f} ms), finder made in {1e3 * making:.0f} ms; "
        f"mean error {np.abs(all_errors).mean():.3f} px, normalised {rms(all_standardised):.2f}"
    )


def main(seeds: list[int]) -> None:
    for seed in seeds:
        rig = draw_rig(seed)
        session = simulate_session(rig).session
        print(f"seed {seed}")
        shots = [source.load() for source in session.board_images[""]]
        boards(rig, shots[0])
        places = np.linspace(0, len(rig) - 1, 5).astype(int)
        sources = {int(k): session.places[k].stripe_image for k in places}
        stripes(rig, shots, {k: source.load() for k, source in sources.items() if source is not None})


if __name__ == "__main__":
    cv2.setNumThreads(1)
    main([int(argument) for argument in sys.argv[1:]] or [0, 1, 2])
