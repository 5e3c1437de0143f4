"""The numbers of a turntable session's estimate, and where each stands in its vectors.

First the ten of the motion (see `lidarpose.refine.turntable_state`), then the extra parameters, then six a panel.
"""

from __future__ import annotations

EXTRAS = (
    "encoder_scale",
    "range_offset_m",
    "range_scale",
    "beam_angle_scale",
    "black_bias_m",
    "focal_scale",
    "centre_x_px",
    "centre_y_px",
)
"""Further parameters, each zero where it is not estimated (scales are the excess over 1):
true angle = (1 + encoder_scale) * reading; measured range = (1 + range_scale) * distance + range_offset_m, and
black_bias_m more on black; true beam angle = (1 + beam_angle_scale) * stated one; true focal length =
(1 + focal_scale) * stated one, true principal point = stated one + (centre_x_px, centre_y_px)."""

N_MOTION = 10
N_GLOBAL = N_MOTION + len(EXTRAS)
ENCODER, OFFSET, RANGE_SCALE, BEAM, BLACK, FOCAL, CENTRE_X, CENTRE_Y = range(N_MOTION, N_GLOBAL)
CAMERA_EXTRAS = [FOCAL, CENTRE_X, CENTRE_Y]
RANGE_EXTRAS = [OFFSET, RANGE_SCALE, BEAM, BLACK]
