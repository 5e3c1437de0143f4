"""`calibrate` for 87 places, with and without its report, in this process and as a command, against decoding."""

from __future__ import annotations

import tempfile
from pathlib import Path
from statistics import median

import cv2

from benchmarks.calibrate import (
    BY_NUMPY,
    COMMAND,
    DECODING,
    PLACES,
    PLAIN,
    PLAIN_COMMAND,
    REPORT,
    STAGES,
    least_command_over,
    least_over,
    measure,
    over_process,
    simulate,
    stages,
)
from benchmarks.report import Cell, Effort, Report, Table
from lidarpose.geometry.compiled import forced, installed


def run(effort: Effort) -> Report:
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as folder:
        session = Path(folder) / "session"
        places = effort.pick(PLACES, 12)
        simulate(session, places)
        found = measure(session, effort.pick(5, 1))
        parts = {}
        for name, way in ((PLAIN, installed()), (BY_NUMPY, False)):
            with forced(way):
                parts[name] = [stages(session) for _ in range(effort.pick(5, 1))]
    figures = {
        "calibrate.least": least_over(found, places),
        "calibrate.least_command": least_command_over(found, places),
        "calibrate.report": found.over[REPORT],
        "calibrate.plain": found.over[PLAIN],
        "calibrate.report_command": found.over[COMMAND],
        "calibrate.plain_command": found.over[PLAIN_COMMAND],
        "calibrate.report_process": over_process(found, COMMAND),
        "calibrate.plain_process": over_process(found, PLAIN_COMMAND),
    }
    rows: list[list[Cell]] = [[DECODING, found.reference_s, 1.0]]
    for name, value in found.seconds.items():
        rows.append([name, value, found.over[name]])
        if name in parts:
            medians = {part: median(each[part] for each in parts[name]) for part in STAGES}
            rows += [[part, value, value / found.reference_s] for part, value in medians.items()]
    text = (
        "A simulated session of the turntable paper's set-up, 1624 x 1234 pixels, PNG. Decoding is OpenCV's, a thread "
        "a core. Parts are of runs of their own. Lines of a new process and the last two are whole processes, "
        "start and imports included."
    )
    return Report(figures, [Table("Calibrating a turntable", ["work", "s", "over decoding"], rows, text)])
