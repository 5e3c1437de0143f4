"""`calibrate` for 87 places, with and without its report, in this process and as a command, against decoding."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2

from benchmarks.calibrate import PLACES, measure, simulate
from benchmarks.report import Effort, Report, Table


def run(effort: Effort) -> Report:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        simulate(session, effort.pick(PLACES, 12))
        found = measure(session, effort.pick(5, 1))
    decoding, plain, report, plain_command, command = found.values()
    figures = {
        "calibrate.report": report / decoding,
        "calibrate.plain": plain / decoding,
        "calibrate.report_command": command / decoding,
        "calibrate.plain_command": plain_command / decoding,
    }
    rows = [[name, value, value / decoding] for name, value in found.items()]
    text = (
        "A simulated session of the turntable paper's set-up, 1624 x 1234 pixels, PNG. Decoding is OpenCV's, a thread "
        "a core. The last two lines are whole processes, start and imports included."
    )
    return Report(figures, [Table("Calibrating a turntable", ["work", "s", "over decoding"], rows, text)])
