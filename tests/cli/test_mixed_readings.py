"""A part of a session recorded against other readings than the rest: never a confident answer."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import pytest

from lidarpose.cli.main import run


def test_two_parts_that_contradict_each_other_are_doubted(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = tmp_path / "session"
    shutil.copytree(simulated_session, session)
    file = session / "positions.csv"
    with file.open(newline="") as text:
        rows = list(csv.DictReader(text))
    for row in rows[: len(rows) // 3]:
        row["turntable_angle_deg"] = str(float(row["turntable_angle_deg"]) - 3.0)
    with file.open("w", newline="") as text:
        writer = csv.DictWriter(text, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    status = run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--json", "--any-order"])
    printed = capsys.readouterr()
    if status == 0:
        document = json.loads(printed.out)
        assert document["verdict"] == "doubtful"
        assert any("fit the motion of the other places" in reason for reason in document["reasons"])
        assert "could not be used" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    else:
        assert status == 1
