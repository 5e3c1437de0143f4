"""Scans whose beams run the other way round than those of the other places.

Assignment leaves such a place out: its lines do not fit the motion of the others. Whether they would with the beams
turned round tells that the scan is written in reverse, and not merely bad.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Quality
from lidarpose.model.observation import ScanLine
from lidarpose.model.scan import Scan
from lidarpose.model.session import TurntablePlace, TurntableSession
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion

Solved = tuple[TurntableMotion, Mapping[str, Sequence[Pose]]]

_NEAR_M = 0.01
"""A line within this of a panel's plane, and on it, lies on the panel."""
_MARGIN_SQUARES = 2.0


def reversed_scans(
    session: TurntableSession,
    motion: TurntableMotion,
    panel_poses: Mapping[str, Sequence[Pose]],
    suspects: Sequence[str],
) -> tuple[str, ...]:
    """Of the positions in `suspects` those whose scans meet both panels only with their beams turned round.

    Parameters
    ----------
    motion, panel_poses
        The solution of the other places; T_camera_panel by placement.
    """
    wanted = set(suspects)
    found = []
    for place in session.places:
        poses = panel_poses.get(place.placement)
        if place.position in wanted and poses and _is_reversed(session, place, motion, poses):
            found.append(place.position)
    return tuple(found)


def reversed_part(
    session: TurntableSession, positions: Sequence[str], solve_part: Callable[[Sequence[str]], Solved]
) -> tuple[str, ...]:
    """Positions of scans that run the other way round, where so many do that the whole session has no solution.

    Parts of the session are solved by themselves (halves; every other place, as a scanner that sweeps to and fro would
    have it), and the rest is looked at with its beams turned round. Empty where that explains less than half of a rest.

    Parameters
    ----------
    solve_part
        Motion and T_camera_panel by placement from some positions; raises UndeterminedError where there is none.
    """
    half = len(positions) // 2
    for part in (positions[:half], positions[half:], positions[::2], positions[1::2]):
        try:
            motion, panel_poses = solve_part(part)
        except UndeterminedError:
            continue
        rest = [position for position in positions if position not in part]
        found = reversed_scans(session, motion, panel_poses, rest)
        if found and len(found) >= 0.5 * len(rest):
            return found
    return ()


def describe_reversed(positions: Sequence[str]) -> str:
    """In words, which scans are written in reverse and what to do."""
    many = len(positions) > 1
    names = ", ".join(positions[:8]) + (f" and {len(positions) - 8} more" if len(positions) > 8 else "")
    return (
        f"the scan{'s' if many else ''} of position{'s' if many else ''} {names} run{'' if many else 's'} the other "
        "way round than the others (reversed beams): turned round, the ranges fit"
    )


def doubt_reversed(quality: Quality | None, positions: Sequence[str]) -> Quality | None:
    """The verdict, no better than doubtful where scans are written in reverse; they are named."""
    if quality is None or not positions:
        return quality
    reason = f"{describe_reversed(positions)}; mend these files and calibrate again"
    verdict = "doubtful" if quality.verdict == "good" else quality.verdict
    return replace(quality, verdict=verdict, reasons=(*quality.reasons, reason))


def _is_reversed(
    session: TurntableSession, place: TurntablePlace, motion: TurntableMotion, poses: Sequence[Pose]
) -> bool:
    from lidarpose.detect.scan_lines import find_lines

    scan = place.scan.load()
    if not scan.has_return.any():
        return False
    lines = find_lines(scan, session.lidar)
    T = motion.pose(place.turntable_angle_rad)
    if _panels_met(lines, T, session.panels, poses) == len(poses):
        return False
    return any(_panels_met(other, T, session.panels, poses) == len(poses) for other in _turned_round(scan, lines))


def _turned_round(scan: Scan, lines: Sequence[ScanLine]) -> list[list[ScanLine]]:
    """The lines with their beam angles negated, and counted from the other end of the scan."""
    both = float(scan.angle_rad.min() + scan.angle_rad.max())
    return [[replace(line, angle_rad=centre - line.angle_rad) for line in lines] for centre in (0.0, both)]


def _panels_met(lines: Sequence[ScanLine], T: Pose, panels: Sequence[Panel], poses: Sequence[Pose]) -> int:
    """How many panels have a line on them."""
    return sum(
        any(_lies_on(line, pose.inverse() @ T, panel) for line in lines)
        for panel, pose in zip(panels, poses, strict=False)
    )


def _lies_on(line: ScanLine, T_panel_lidar: Pose, panel: Panel) -> bool:
    """Whether a scan line is within 1 cm (or five of its standard deviations) of a panel, for most of its length."""
    flat = line.points_lidar()
    points: FloatArray = T_panel_lidar @ np.column_stack([flat, np.zeros(len(flat))])
    margin = _MARGIN_SQUARES * panel.square_m
    high = np.array([panel.columns, panel.rows]) * panel.square_m + margin
    on = (points[:, :2] > -margin).all(axis=1) & (points[:, :2] < high).all(axis=1)
    near = np.abs(points[:, 2]) < np.maximum(_NEAR_M, 5.0 * line.sigma_m)
    return bool(on.mean() > 0.8 and (on & near).mean() > 0.7)
