"""``lidarpose demo``: both jobs from end to end on simulated data, each step as the command that a user would type."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter, validators

from lidarpose.cli.options import WholeNumber
from lidarpose.errors import InputError


def demo(
    out: Path = Path("lidarpose-demo"),
    /,
    *,
    places: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=3, lte=200))] = 24,
    seed: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=0))] = 0,
) -> None:
    """Simulate, calibrate, scan and measure, in about a minute.

    Parameters
    ----------
    out
        Folder for everything that the demonstration writes.
    places
        Stops of the simulated turntable.
    seed
        The same seed gives the same data.
    """
    from lidarpose.cli.main import call

    if out.exists() and (not out.is_dir() or (any(out.iterdir()) and not (out / ".lidarpose-demo").exists())):
        raise InputError(out, "is there already and holds something else", expected="a new or empty folder")
    out.mkdir(parents=True, exist_ok=True)
    (out / ".lidarpose-demo").touch()
    for text, command in _steps(out, places, seed):
        _show(text, command)
        call(command)
    _say(f"Look at {out / 'turntable-result' / 'report.html'} and {out / 'world-result' / 'report.html'}.")


def _steps(out: Path, places: int, seed: int) -> list[tuple[str, list[str]]]:
    session, result = str(out / "turntable"), str(out / "turntable-result")
    calibration = str(out / "turntable-result" / "calibration.json")
    disk, corners, world = str(out / "disk"), str(out / "corners"), str(out / "world-result")
    true_calibration = str(out / "disk.calibration.json")
    count = ["--places", str(places), "--seed", str(seed)]
    return [
        ("A 2D LiDAR on a turntable, before a camera and a V board", ["simulate", "turntable", session, *count]),
        ("What is there, and how well will it determine the pose?", ["inspect", session]),
        ("The LiDAR's pose as a function of the turntable's angle", ["calibrate", session, "-o", result]),
        ("The same by the turntable paper", ["calibrate", session, "-o", result + "-paper", "--method", "paper"]),
        ("The pose half a turn away", ["pose", calibration, "--angle-deg", "190"]),
        ("The rig for a robot", ["export", calibration, "--to", "urdf", "-o", str(out / "rig.urdf")]),
        ("A disk of 140 mm, scanned by a turning LiDAR", ["simulate", "disk", disk, "--seed", str(seed)]),
        ("Its cloud", ["scan", disk, true_calibration, "-o", str(out / "disk.ply")]),
        ("Its diameter", ["measure", "disk", disk, true_calibration]),
        (
            "A 3D LiDAR before a carton that is moved from place to place",
            ["simulate", "corners", corners, "--frames", "5", "--seed", str(seed)],
        ),
        ("The LiDAR's pose in the world", ["calibrate", corners, "-o", world]),
    ]


def _show(text: str, command: list[str]) -> None:
    _say("")
    _say(f"{text}:", style="bold")
    _say("  $ lidarpose " + shlex.join(command), style="cyan")


def _say(text: str, style: str | None = None) -> None:
    from lidarpose.cli.console import out as console

    console().print(text, style=style, markup=False, soft_wrap=True)
