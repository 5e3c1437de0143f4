"""Whole world runs on simulated corner sessions."""

from __future__ import annotations

from dataclasses import replace

from lidarpose.model.world_run import WorldRun
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.workflows.world import WorldMethod, world_run


def simulated_world_run(
    spec: CornerSceneSpec, method: WorldMethod = "joint", *, moved_place: int | None = None, moved_m: float = 0.2
) -> WorldRun:
    """A calibrated session. `moved_place` has wrong world coordinates."""
    session, _ = simulate_corner_session(spec)
    if moved_place is not None:
        places = list(session.places)
        wrong = places[moved_place].corner_world + [moved_m, 0.0, 0.0]
        places[moved_place] = replace(places[moved_place], corner_world=wrong)
        session = replace(session, places=tuple(places))
    return world_run(session, method)
