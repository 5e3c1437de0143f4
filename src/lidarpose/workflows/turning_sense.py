"""In which sense beams and table turn: in words that a person can check by looking at the rig, and against his word.

A scan whose beams are written the other way round is, to every estimate, a LiDAR mounted upside down; readings of the
other sign are an axis that points the other way. The answer holds for the files as they are written; nothing in them
tells how the rig really turns. So it is said, and where the user states how his rig turns, it is compared.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.calibration import Quality
from lidarpose.model.sense import StatedSense
from lidarpose.model.turntable import TurntableMotion

# Of each view the direction towards the viewer in the camera frame (x right, y down, z away), and its words.
_TOWARDS = {
    "above": np.array([0.0, -1.0, 0.0]),
    "camera": np.array([0.0, 0.0, -1.0]),
    "right": np.array([1.0, 0.0, 0.0]),
}
_WORDS = {"above": "from above the image", "camera": "from the camera", "right": "from the right of the image"}
_NEARLY_EDGE_ON = 0.5
"""Below this cosine (an axis within 30 degrees of edge-on) a sense is not judged: nobody holds a camera that level."""


@dataclass(frozen=True)
class SenseCheck:
    """Contradictions to what was stated, and what could not be judged; in words."""

    contradictions: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def turning_sense(motion: TurntableMotion, turntable_angle_rad: float, stated: StatedSense | None = None) -> str:
    """How growing beam angles and growing readings turn, each seen from where it is plainest.

    And whether that was compared with a statement, or how to have it compared.
    """
    beams = _plainest(_beam_axis(motion, turntable_angle_rad))
    table = _plainest(motion.axis_direction_camera)
    found = f"By the files growing beam angles turn {_said(beams)}, and growing readings turn {_said(table)}."
    known = stated or StatedSense()
    options = [] if known.beams else [f"--beams-turn {beams}"]
    options += [] if known.table else [f"--table-turns {table}"]
    if not options:
        return f"{found} Both were compared with what was stated"
    return (
        f"{found} Compare with the rig: no residual shows scans in reverse or negated readings. To have it checked, "
        f"state what you see; this would be {' '.join(options)} (or [turning] in session.toml)"
    )


def check_sense(motion: TurntableMotion, readings_rad: Sequence[float], stated: StatedSense) -> SenseCheck:
    """Compare a motion with what the user sees on his rig, at the middle of the recorded readings."""
    contradictions, notes = [], []
    middle = 0.5 * (min(readings_rad) + max(readings_rad))
    for option, sense, axis, what, mend in (
        ("--beams-turn", stated.beams, _beam_axis(motion, middle), "growing beam angles", _MEND_BEAMS),
        ("--table-turns", stated.table, motion.axis_direction_camera, "growing readings", _MEND_READINGS),
    ):
        if sense is None:
            continue
        turn, view = sense.split("-from-")
        cosine = float(_TOWARDS[view] @ axis)
        if abs(cosine) < _NEARLY_EDGE_ON:
            plain = _plainest(axis)
            off = np.rad2deg(np.arcsin(abs(cosine)))
            notes.append(
                f"{option} {sense} could not be judged: seen {_WORDS[view]} the axis is within {off:.0f} degrees of "
                f"edge-on; state it as seen {_said(plain).split(' seen ')[1]} ({option} {plain} is what the files say)"
            )
        elif (cosine > 0.0) != (turn == "anticlockwise"):
            found = "anticlockwise" if cosine > 0.0 else "clockwise"
            contradictions.append(
                f"by the files {what} turn {found} seen {_WORDS[view]}, but {turn} was stated ({option}): {mend}"
            )
    return SenseCheck(tuple(contradictions), tuple(notes))


_MEND_BEAMS = (
    "the scans are written in reverse, or the LiDAR is mounted the other way up. Negate the beam angles in the scans "
    "(if only the order of the ranges is reversed, reverse that), or correct the statement"
)
_MEND_READINGS = (
    "the turntable's readings are negated. Change their sign in positions.csv, here and in what is recorded later, "
    "or correct the statement"
)


def compared(quality: Quality | None, check: SenseCheck) -> Quality | None:
    """The verdict, rejected where the result contradicts what the user sees on his rig."""
    if quality is None or not (check.contradictions or check.notes):
        return quality
    notes = tuple(f"note: {text}" for text in check.notes)
    if not check.contradictions:
        return replace(quality, reasons=(*quality.reasons, *notes))
    return replace(quality, verdict="rejected", reasons=(*check.contradictions, *quality.reasons, *notes))


def _beam_axis(motion: TurntableMotion, turntable_angle_rad: float) -> FloatArray:
    """The direction in the camera frame about which growing beam angles turn right-handed: the LiDAR's z."""
    return np.asarray(motion.pose(turntable_angle_rad).rotation[:, 2])


def _plainest(axis_camera: FloatArray) -> str:
    """The sense of a right-handed turn about an axis, seen along the camera axis that it is nearest to."""
    view = max(_TOWARDS, key=lambda name: abs(float(_TOWARDS[name] @ axis_camera)))
    return f"{'anticlockwise' if float(_TOWARDS[view] @ axis_camera) > 0.0 else 'clockwise'}-from-{view}"


def _said(sense: str) -> str:
    turn, view = sense.split("-from-")
    return f"{turn} seen {_WORDS[view]}"
