"""Boards and stripes in simulated images of the turntable paper's geometry: time and error, beside OpenCV's."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np

from benchmarks.detection import corner_error, rig_panel, sector_with_accuracy, stripe_error, true_corners
from benchmarks.report import Effort, Report, Table
from benchmarks.timing import Work, beside, pace
from lidarpose.detect.chessboard import find_panels
from lidarpose.detect.laser_stripe import StripeFinder
from lidarpose.geometry.compiled import forced, installed
from lidarpose.simulate.rig import TurntableRig, draw_rig
from lidarpose.simulate.session import simulate_session
from lidarpose.workflows.turntable import IMAGES_AT_ONCE

Image = np.ndarray


def run(effort: Effort) -> Report:
    boards, stripes, errors, paces = [], [], [], []
    pace()
    megapixels = 0.0
    for seed in range(effort.pick(4, 1)):
        rig = draw_rig(seed)
        session = simulate_session(rig).session
        shots = [source.load() for source in session.board_images[""]]
        places = np.linspace(0, len(rig) - 1, IMAGES_AT_ONCE).astype(int)
        sources = {int(k): session.places[k].stripe_image for k in places}
        images = {k: source.load() for k, source in sources.items() if source is not None}
        megapixels = shots[0].size / 1e6
        boards.append(_boards(rig, shots[0], effort.pick(5, 1)))
        stripe, took, error = _stripes(rig, shots, images, effort.pick(5, 1))
        stripes.append(stripe)
        paces.append(took)
        errors.append(error)
    ours_s, theirs_s, theirs_over, ours_px, theirs_px = np.median(np.array(boards), axis=0)
    finding, plain, alone, decoding, over = np.median(np.array(stripes), axis=0)
    stripe_px = float(np.mean(np.abs(np.concatenate(errors))))
    figures = {
        "boards.s": float(ours_s),
        "boards.error": float(ours_px / theirs_px),
        "boards.time": 1.0 / float(theirs_over),
        "stripes.ms": 1e3 * float(finding),
        "stripes.ms_numpy": 1e3 * float(plain),
        "stripes.ms_per_megapixel": 1e3 * float(finding) / megapixels,
        "stripes.decoding": float(over),
    }
    rows = [
        ["lidarpose", 1e3 * float(ours_s), f"{ours_px:.4f}"],
        ["OpenCV SB, ACCURACY", 1e3 * float(theirs_s), f"{theirs_px:.4f}"],
    ]
    about = (
        "Both boards of one image, the first painted over for the second where OpenCV looks; medians over the seeds."
    )
    lines = [
        [
            f"{1e3 * finding:.2f}",
            f"{1e3 * plain:.2f}",
            f"{1e3 * alone:.2f}",
            f"{1e3 * decoding:.2f}",
            f"{stripe_px:.3f}",
        ]
    ]
    together = f"ms an image, {IMAGES_AT_ONCE} at once as `calibrate` does"
    return Report(
        figures,
        [
            Table("Both boards of an image", ["detector", "ms", "RMS error of a coordinate, px"], rows, about),
            Table(
                "Stripes", [together, "by NumPy", "one alone", "decoding the PNG", "mean error, px"], lines, _ONE_THREAD
            ),
        ],
        pace_s=float(np.median(paces)),
    )


_ONE_THREAD = (
    "One thread; `calibrate` gives each core its own images. By kernels, where numba is installed, in a process that "
    "has loaded them; a single command searches by NumPy."
)


def _boards(rig: TurntableRig, image: Image, repeats: int) -> tuple[float, ...]:
    """Seconds, ours and OpenCV's, OpenCV's over ours, and RMS error in pixels, ours and OpenCV's."""
    found = beside(
        lambda: find_panels([image], rig.panels), {"theirs": lambda: sector_with_accuracy(image, rig)}, repeats
    )
    truths = true_corners(rig)
    mine = [corner_error(c.pixels, truths) for c in find_panels([image], rig.panels).corners]
    sector = [corner_error(pixels, truths) for pixels in sector_with_accuracy(image, rig)]
    return found.reference_s, found.seconds["theirs"], found.over["theirs"], _rms(mine), _rms(sector)


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else float("nan")


def _by_numpy(finder: StripeFinder, images: list[Image]) -> None:
    with forced(False):
        finder.find_in(images)


def _stripes(
    rig: TurntableRig, shots: list[Image], images: dict[int, Image], repeats: int
) -> tuple[tuple[float, ...], float, np.ndarray]:
    """Median seconds an image, several at once, these by NumPy, and one alone, and of decoding its PNG, and the first
    over the last; how long the fixed piece of work took meanwhile; and all errors in pixels."""
    board = find_panels(shots, rig.panels)
    finder = StripeFinder(board, shots)
    batch = list(images.values())
    encoded = [cv2.imencode(".png", image)[1] for image in batch]
    with forced(installed()):  # from here on kernels are loaded
        found = finder.find_in(batch)
    ways: dict[str, Work] = {
        "batch": partial(finder.find_in, batch),
        "numpy": partial(_by_numpy, finder, batch),
        "one": lambda: [finder.find(image) for image in batch],
        "pace": pace,
    }
    times = beside(lambda: [cv2.imdecode(code, cv2.IMREAD_GRAYSCALE) for code in encoded], ways, repeats)
    errors = [
        stripe_error(rig, place, rig_panel(rig, board, k), points)
        for place, detection in zip(images, found, strict=True)
        for k, points in detection.stripes.items()
    ]
    n = len(batch)
    own = times.seconds
    figures = (own["batch"] / n, own["numpy"] / n, own["one"] / n, times.reference_s / n, times.over["batch"])
    return figures, own["pace"], np.concatenate(errors)
