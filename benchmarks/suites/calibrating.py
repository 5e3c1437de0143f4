"""`calibrate` for 87 places, with and without its report, in this process and as a command, against decoding."""

from __future__ import annotations

import tempfile
from pathlib import Path

import cv2

from benchmarks.calibrate import COMMAND, DECODING, PLACES, PLAIN, PLAIN_COMMAND, REPORT, measure, simulate
from benchmarks.report import Cell, Effort, Report, Table


def run(effort: Effort) -> Report:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        simulate(session, effort.pick(PLACES, 12))
        found = measure(session, effort.pick(5, 1))
    figures = {
        "calibrate.report": found.over[REPORT],
        "calibrate.plain": found.over[PLAIN],
        "calibrate.report_command": found.over[COMMAND],
        "calibrate.plain_command": found.over[PLAIN_COMMAND],
    }
    rows: list[list[Cell]] = [[DECODING, found.reference_s, 1.0]]
    rows += [[name, value, found.over[name]] for name, value in found.seconds.items()]
    text = (
        "A simulated session of the turntable paper's set-up, 1624 x 1234 pixels, PNG. Decoding is OpenCV's, a thread "
        "a core. The last two lines are whole processes, start and imports included."
    )
    return Report(figures, [Table("Calibrating a turntable", ["work", "s", "over decoding"], rows, text)])
