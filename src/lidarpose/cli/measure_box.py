"""`lidarpose measure box`: a box's edge lengths."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from lidarpose.cli.options import Json


def measure_box(
    source: Path,
    calibration: Path | None = None,
    /,
    *,
    never_stops: Annotated[bool, Parameter(negative="", show_default=False)] = False,
    json: Json = False,
) -> None:
    """Measure a box: its three edge lengths, longest first.

    The box is found unaided: flat faces that meet at right angles and point outward. Where no second face or floor ends
    an edge, the face's own border does, estimated as a disk's edge is.

    Parameters
    ----------
    source
        Folder of a sweep recording, or a cloud seen from its origin.
    calibration
        The turntable's calibration file, for a recording.
    never_stops
        The turntable turned on during the sweeps: interpolate its readings by time_s.npy.
    """
    from lidarpose.cli.console import out, print_json
    from lidarpose.cli.measure_input import measurement_view
    from lidarpose.workflows.measuring import measure_box as measure

    view = measurement_view(source, calibration, never_stops)
    box = measure(view)
    remarks = [*view.remarks]
    if json:
        print_json(
            {
                "edges_mm": [1e3 * e.length_m for e in box.edges],
                "sigma_mm": [1e3 * e.sigma_m for e in box.edges],
                "calibration_sigma_mm": [
                    None if e.calibration_sigma_m is None else 1e3 * e.calibration_sigma_m for e in box.edges
                ],
                "directions": [e.direction.tolist() for e in box.edges],
                "ends": [list(e.by) for e in box.edges],
                "face_normals": box.face_normals.tolist(),
                "face_points": list(box.face_points),
                "face_angles_deg": list(box.angles_deg),
                "frame": view.frame,
                "remarks": remarks,
            }
        )
        return
    for edge in box.edges:
        out().print(f"{1e3 * edge.length_m:9.3f} mm ± {1e3 * edge.sigma_m:.3f}   from {edge.by[0]} to {edge.by[1]}")
    angles = ", ".join(f"{a:.3f}" for a in box.angles_deg)
    out().print(f"faces seen: {len(box.face_points)}, angles between them: {angles} degrees")
    for remark in remarks:
        out().print(f"Note: {remark}.")
