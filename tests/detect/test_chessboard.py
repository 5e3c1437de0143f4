"""Chessboards in rendered images: where they are, which is which, and whether the stated error is true."""

import cv2
import numpy as np
import pytest

from lidarpose.detect.chessboard import BoardNotFoundError, find_panels
from lidarpose.model.targets import Panel


def true_pixels(scene, board):
    """The board's corners in the order that detection states: seen from the front, first corner upper left."""
    pixels = scene.project(board.corners_camera())
    return pixels if pixels[0].sum() < pixels[-1].sum() else pixels[::-1]


def test_both_panels_are_found_in_order_and_as_well_as_stated(two_panels) -> None:
    rng = np.random.default_rng(1)
    bright = two_panels.bright()
    shots = [two_panels.noisy(bright, rng) for _ in range(3)]
    found = find_panels(shots, [board.panel for board in two_panels.boards])
    assert found.shots_used.all()
    assert found.notes == ()
    assert found.corners[0].pixels[:, 0].max() < found.corners[1].pixels[:, 0].min()
    for board, corners in zip(two_panels.boards, found.corners, strict=True):
        error = corners.pixels - true_pixels(two_panels, board)
        assert np.sqrt((error**2).mean()) < 0.04
        assert 0.7 < np.sqrt(((error / corners.sigma_px[:, None]) ** 2).mean()) < 1.3
        columns = board.panel.columns
        column, row = corners.pixels[[0, 1, columns, columns + 1]].mean(axis=0).round().astype(int)
        assert corners.first_dark == (bright[row, column] < bright[bright > 0].mean())


def test_a_board_that_moved_between_shots_is_named_with_its_shift(two_panels) -> None:
    rng = np.random.default_rng(2)
    bright = two_panels.bright()
    shots = [two_panels.noisy(np.roll(bright, 3 * (k == 1), axis=1), rng) for k in range(3)]
    found = find_panels(shots, [board.panel for board in two_panels.boards])
    assert list(found.shots_used) == [True, False, True]
    assert found.shot_shift_px[1] == pytest.approx([3.0, 3.0], abs=0.05)
    assert "bright image 2" in found.notes[0]
    assert "3.0" in found.notes[0]


@pytest.mark.parametrize("low_high", [(90, 110), (0, 255), (0, 1), (255, 256)], ids=["grey", "noise", "black", "white"])
def test_an_image_without_boards_names_the_missing_panel(low_high: tuple[int, int]) -> None:
    empty = np.random.default_rng(3).integers(low_high[0], low_high[1], (480, 640)).astype(np.uint8)
    with pytest.raises(BoardNotFoundError, match="7 x 5 inner corners; no chessboard was found at all") as caught:
        find_panels([empty], [Panel(7, 5, 0.02), Panel(7, 5, 0.02)])
    assert caught.value.panel == 0


@pytest.mark.parametrize("change", ["blur", "contrast", "over-exposure", "16 bit", "turn", "tilt"])
def test_boards_are_found_in_poor_images_and_the_error_is_stated(two_panels, change) -> None:
    rng = np.random.default_rng(5)
    clean = two_panels.bright()
    height, width = clean.shape
    warp = np.eye(3)
    if change == "blur":
        clean = cv2.GaussianBlur(clean, (0, 0), 3.0)
    elif change == "contrast":
        clean = 90.0 + 0.15 * clean
    elif change == "over-exposure":
        clean = 1.6 * clean + 10.0
    elif change == "turn":
        warp[:2] = cv2.getRotationMatrix2D((width / 2, height / 2), 67.0, 0.7)
    elif change == "tilt":
        warp = np.array([[0.5, 0.0, 0.25 * width], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    image = two_panels.noisy(cv2.warpPerspective(clean, warp, (width, height), flags=cv2.INTER_CUBIC), rng)
    if change == "16 bit":
        image = image.astype(np.uint16) * 16
    found = find_panels([image], [board.panel for board in two_panels.boards])
    true = [cv2.perspectiveTransform(two_panels.project(b.corners_camera())[None], warp)[0] for b in two_panels.boards]
    for corners in found.corners:
        # A turn may exchange the panels: they are equal, and named by their places in the image.
        truth = min(true, key=lambda pixels: np.linalg.norm((pixels - corners.pixels).mean(axis=0)))
        distance = np.linalg.norm(corners.pixels[:, None] - truth[None], axis=-1).min(axis=1)
        assert 0.6 < np.sqrt((distance**2).mean() / 2.0) / np.median(corners.sigma_px) < 1.5


def test_a_board_of_another_size_is_named_not_taken(two_panels) -> None:
    image = two_panels.noisy(two_panels.bright(), np.random.default_rng(3))
    panel = two_panels.boards[0].panel
    for columns, rows in ((7, 5), (panel.columns - 1, panel.rows), (panel.columns, panel.rows + 1)):
        with pytest.raises(BoardNotFoundError, match="12 x 9") as caught:
            find_panels([image], [panel, Panel(columns, rows, 0.02)])
        assert caught.value.panel == 1
        assert f"expected {columns} x {rows}" in str(caught.value)
