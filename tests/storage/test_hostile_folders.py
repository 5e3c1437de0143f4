"""Absurd sizes, loops, names that lead out, documents that stand for more than memory: an error, soon and cheaply.

The cases are those of `tests_support.hostile`, each read in a child that may take 512 MB beyond its libraries.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import Any

import pytest

from tests_support.hostile import CASES, SECONDS

# A symbolic link to the folder itself is no loop for a pattern: what matches is read once.
HARMLESS = {"folders_in_a_loop"}


LARGE = {name for name in CASES if name.split("_")[0] in ("scan", "positions", "toml", "yaml", "xml", "json", "png")}


def results(names: set[str]) -> dict[str, dict[str, Any]]:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-W", "ignore", "-m", "tests_support.hostile", *sorted(names)]
    lines = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.splitlines()
    return {result["case"]: result for result in map(json.loads, lines)}


@pytest.mark.parametrize(
    "names", [CASES.keys() - LARGE, pytest.param(LARGE, marks=pytest.mark.slow)], ids=["", "large"]
)
def test_every_case_ends_in_time_with_one_error_that_names_the_file(names: set[str]) -> None:
    found = results(names)
    assert set(found) == names
    wrong = []
    for name, result in found.items():
        message = result["message"]
        named = "/case" in message and "\n" not in message and len(message) < 1000
        ended = result["end"] == ("data" if name in HARMLESS else "InputError") and (named or name in HARMLESS)
        # Seconds of the processor, which a busy machine does not change much.
        if not ended or result["seconds"] > 2.0 * SECONDS:
            wrong.append((name, result["end"], result.get("seconds"), message[:300]))
    assert wrong == []
