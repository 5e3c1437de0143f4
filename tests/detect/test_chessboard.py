"""Chessboards in rendered images: where they are, which is which, and whether the stated error is true."""

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


def test_a_board_that_moved_between_shots_is_named_with_its_shift(two_panels) -> None:
    rng = np.random.default_rng(2)
    bright = two_panels.bright()
    shots = [two_panels.noisy(np.roll(bright, 3 * (k == 1), axis=1), rng) for k in range(3)]
    found = find_panels(shots, [board.panel for board in two_panels.boards])
    assert list(found.shots_used) == [True, False, True]
    assert found.shot_shift_px[1] == pytest.approx([3.0, 3.0], abs=0.05)
    assert "bright image 2" in found.notes[0]
    assert "3.0" in found.notes[0]


def test_an_image_without_boards_names_the_missing_panel() -> None:
    noise = np.random.default_rng(3).integers(90, 110, (480, 640), dtype=np.uint8)
    with pytest.raises(BoardNotFoundError, match="7 x 5 inner corners") as caught:
        find_panels([noise], [Panel(7, 5, 0.02), Panel(7, 5, 0.02)])
    assert caught.value.panel == 0


def test_a_board_of_another_size_is_named_not_taken(two_panels) -> None:
    image = two_panels.noisy(two_panels.bright(), np.random.default_rng(3))
    panel = two_panels.boards[0].panel
    for columns, rows in ((7, 5), (panel.columns - 1, panel.rows), (panel.columns, panel.rows + 1)):
        with pytest.raises(BoardNotFoundError, match="12 x 9") as caught:
            find_panels([image], [panel, Panel(columns, rows, 0.02)])
        assert caught.value.panel == 1
        assert f"expected {columns} x {rows}" in str(caught.value)
