"""`lidarpose measure disk`: disks and round holes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from lidarpose.cli.options import Json

if TYPE_CHECKING:
    from lidarpose.measure.disk import RoundMeasurement


def measure_disk(
    source: Path,
    calibration: Path | None = None,
    /,
    *,
    hole: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    never_stops: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    report: Path | None = None,
    json: Json = False,
) -> None:
    """Measure a disk, or round holes in a plane: diameter without bias, and how sure it is.

    The disk is found unaided. Its edge is estimated from which beams hit it, with a model of the beam's spot at the
    edge. Centre and normal are in the camera frame; the normal points towards the LiDAR.

    Parameters
    ----------
    source
        Folder of a sweep recording, or a cloud seen from its origin.
    calibration
        The turntable's calibration file, for a recording.
    hole
        Look for round holes in a plane instead of disks.
    never_stops
        The turntable turned on during the sweeps: interpolate its readings by time_s.npy.
    report
        Write a page with the edge, the circle and what the standard deviation is made of to this file (.html).
    """
    from lidarpose.cli.console import print_json
    from lidarpose.cli.measure_input import measurement_view
    from lidarpose.errors import InputError
    from lidarpose.report.disk_page import disk_page
    from lidarpose.storage.atomic import require_apart, write_text
    from lidarpose.workflows.measured_views import round_view
    from lidarpose.workflows.measuring import measure_disk as measure

    if report is not None:
        if report.suffix.lower() not in (".html", ".htm"):
            raise InputError(report, "is no name of a page", expected="a name that ends in .html")
        require_apart(report, source)
    view = measurement_view(source, calibration, never_stops)
    found = measure(view, "hole" if hole else "disk")
    remarks = [*view.remarks, *_remarks(found[0])]
    if report is not None:
        write_text(report, disk_page(round_view(view, found[0], str(source), remarks)))
    if json:
        others = [_document(m) for m in found[1:]]
        print_json({**_document(found[0]), "frame": view.frame, "others": others, "remarks": remarks})
    else:
        _print(found, view.frame, remarks)


def _document(m: RoundMeasurement) -> dict[str, Any]:
    calibration_mm = None if m.calibration_sigma_m is None else 1e3 * m.calibration_sigma_m
    return {
        "kind": m.kind,
        "diameter_mm": 1e3 * m.diameter_m,
        "sigma_mm": 1e3 * m.sigma_m,
        "sigma_parts_mm": {
            "edge": 1e3 * m.edge_sigma_m,
            "plane": 1e3 * m.plane_sigma_m,
            "calibration": calibration_mm,
        },
        "centre_m": m.centre.tolist(),
        "normal": m.normal.tolist(),
        "outermost_diameter_mm": 1e3 * m.outermost_diameter_m,
        "spot_mm": 4e3 * m.edge.spot_m,
        "plane_rms_mm": 1e3 * m.plane_rms_m,
        "plane_beams": m.plane_beams,
        "edge_beams": m.edge_beams,
        "edge_covered": m.covered,
        "threshold_known": m.threshold_known,
    }


def _remarks(best: RoundMeasurement) -> list[str]:
    remarks = []
    if not best.threshold_known:
        remarks.append(
            "nothing tells of mixed returns or fading light at the edge: a beam is taken to be seen if half of "
            "its spot is on the material; sigma_mm holds what another threshold would change for the spots that LiDARs "
            "have at this distance, and every size of this recording may be off by the same"
        )
    if best.covered < 0.5:
        remarks.append(f"only {100 * best.covered:.0f} % of the edge is free")
    return remarks


def _print(found: list[RoundMeasurement], frame: str, remarks: list[str]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from lidarpose.cli.console import out

    table = Table(box=SIMPLE_HEAD)
    columns = ("", "diameter mm", "± mm", f"centre m ({frame} frame)", "normal", "outermost points mm")
    for column in columns:
        table.add_column(column, justify="right")
    for m in found:
        centre = " ".join(f"{x:+.4f}" for x in m.centre)
        normal = " ".join(f"{x:+.4f}" for x in m.normal)
        outermost = f"{1e3 * m.outermost_diameter_m:.2f}"
        table.add_row(m.kind, f"{1e3 * m.diameter_m:.3f}", f"{1e3 * m.sigma_m:.3f}", centre, normal, outermost)
    out().print(table)
    for remark in remarks:
        out().print(f"Note: {remark}.")
