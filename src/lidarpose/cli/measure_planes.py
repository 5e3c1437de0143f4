"""`lidarpose measure planes`: planes and their angles."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter, validators

from lidarpose.cli.options import Json

if TYPE_CHECKING:
    from lidarpose.geometry.arrays import FloatArray
    from lidarpose.measure.planes import MeasuredPlane

# So many fit a narrow terminal.
_ANGLES_SHOWN = 6


def measure_planes(
    source: Path,
    calibration: Path | None = None,
    /,
    *,
    least_share: Annotated[float, Parameter(validator=validators.Number(gt=0.0, lt=1.0))] = 0.002,
    never_stops: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    json: Json = False,
) -> None:
    """Find planes, and measure their angles to each other and to the frame's axes.

    Parameters
    ----------
    source
        Folder of a sweep recording, or a cloud.
    calibration
        The turntable's calibration file, for a recording.
    least_share
        Leave out planes with less than this share of the points.
    never_stops
        The turntable turned on during the sweeps: interpolate its readings by time_s.npy.
    """
    from lidarpose.cli.console import out, print_json
    from lidarpose.cli.measure_input import measurement_view
    from lidarpose.measure.planes import axis_angles_deg, plane_angles_deg
    from lidarpose.workflows.measuring import measure_planes as measure
    from lidarpose.workflows.measuring import plane_angle_sigmas

    view = measurement_view(source, calibration, never_stops)
    planes = measure(view, least_share=least_share)
    angles, sigmas = plane_angles_deg(planes), plane_angle_sigmas(view, planes)
    if not json:
        _print(planes, angles, sigmas, view.frame)
        for remark in view.remarks:
            out().print(f"Note: {remark}", markup=False, soft_wrap=True)
        return
    entries = [
        {
            "normal": p.plane.normal.tolist(),
            "offset_m": p.plane.offset,
            "points": p.points,
            "rms_mm": 1e3 * p.rms_m,
            "normal_sigma_deg": p.normal_sigma_rad * 57.29577951308232,
            "axis_angles_deg": axis_angles_deg(p.plane).tolist(),
        }
        for p in planes
    ]
    print_json(
        {
            "planes": entries,
            "angles_deg": angles.tolist(),
            "angles_sigma_deg": sigmas.tolist(),
            "frame": view.frame,
            "remarks": list(view.remarks),
        }
    )


def _print(planes: list[MeasuredPlane], angles: FloatArray, sigmas: FloatArray, frame: str) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from lidarpose.cli.console import out
    from lidarpose.measure.planes import axis_angles_deg

    table = Table(box=SIMPLE_HEAD, title=f"Planes, normal . x = offset in the {frame} frame", title_justify="left")
    for column in ("", "normal", "offset m", "points", "rms mm", "to x, y, z deg"):
        table.add_column(column, justify="right", no_wrap=True)
    for k, p in enumerate(planes):
        normal = " ".join(f"{x:+.4f}" for x in p.plane.normal)
        axes = " ".join(f"{a:.1f}" for a in axis_angles_deg(p.plane))
        table.add_row(str(k), normal, f"{p.plane.offset:.4f}", str(p.points), f"{1e3 * p.rms_m:.2f}", axes)
    out().print(table)
    count = min(len(planes), _ANGLES_SHOWN)
    if count < 2:
        return
    more = "" if count == len(planes) else f" of the {count} largest; --json has all"
    out().print(f"Angles and their standard deviations, deg{more}")
    between = Table(box=SIMPLE_HEAD)
    for column in ("", *map(str, range(count - 1))):
        between.add_column(column, justify="right", no_wrap=True)
    for k in range(1, count):
        between.add_row(str(k), *(f"{angles[k, j]:.2f} ± {sigmas[k, j]:.2f}" for j in range(k)))
    out().print(between)
