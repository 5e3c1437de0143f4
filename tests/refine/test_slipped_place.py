"""A place whose world coordinates are wrong, told by corners that each place finds for itself."""

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.refine.corner_model import CornerFit, CornerOptions, CornerState, parameter_names
from lidarpose.refine.slipped_place import slipped_place

WORLD = np.array([[2.0, -1.0, 0.5], [2.1, 0.9, 0.6], [1.6, 0.1, 0.8], [2.8, -0.4, 0.5], [2.7, 0.8, 0.9]])
SIGMA_M = 1e-3


def free_fit(corners_world: FloatArray, stated: FloatArray) -> CornerFit:
    """Corners that were seen to a millimetre where they are, though other coordinates were stated."""
    pose = Pose.exp([0.3, -0.2, 1.0, 0.2, 0.4, -0.3])
    options = CornerOptions(world_sigma_m=0.1)
    names = parameter_names([f"p{i}" for i in range(len(stated))], options)
    variance = np.where([name.split(".")[0].startswith("p") for name in names], SIGMA_M**2, 1e-12)
    return CornerFit(
        CornerState(pose, np.eye(3), 1.0, corners_world - stated),
        names,
        np.diag(variance),
        SIGMA_M,
        {},
        stated,
        options.world_sigma_m,
        1,
        1000,
    )


def test_the_place_whose_coordinates_are_off_is_named_with_what_they_lack() -> None:
    stated = WORLD.copy()
    stated[3] += [0.0, 0.05, -0.02]
    slip = slipped_place(free_fit(WORLD, stated))
    assert slip is not None
    assert slip.place == 3
    np.testing.assert_allclose(slip.off, [0.0, -0.05, 0.02], atol=1e-6)


def test_no_place_is_named_where_all_agree_to_their_noise() -> None:
    rng = np.random.default_rng(0)
    for _ in range(50):
        assert slipped_place(free_fit(WORLD + rng.normal(0.0, SIGMA_M, WORLD.shape), WORLD)) is None


def test_four_places_in_a_plane_do_not_tell_which_of_them_is_too_high() -> None:
    square = np.array([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [2.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    raised = square.copy()
    raised[2, 2] += 0.05
    assert slipped_place(free_fit(square, raised)) is None


def test_all_places_but_one_on_a_line_are_no_reason_to_fail() -> None:
    for row in ([[1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [3.0, 0.0, 0.0], [2.0, 1.0, 0.0]], WORLD[[0, 0, 0, 1]]):
        places = np.array(row)
        assert slipped_place(free_fit(places, places)) is None
