"""What the page's 3D viewer draws, as plain data: lines, polygons, dots and labels in metres.

Colours are names of the style sheet's variables. Items with ``moves`` hold points in the turntable's frame at reading
0; the viewer turns them by its slider.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.report.markup import Markup, el


@dataclass
class Scene:
    """Collects what is to be seen. `up` (3,) is drawn upwards."""

    up: Sequence[float]
    items: list[dict[str, Any]] = field(default_factory=list)
    _extent: list[FloatArray] = field(default_factory=list)

    def add(
        self,
        kind: Literal["line", "polygon", "points"],
        points: ArrayLike,
        colour: str,
        *,
        counts: bool = True,
        **style: object,
    ) -> None:
        """A line, polygon or cloud of points (N, 3). `counts`: whether it has to be in view at first."""
        p = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        p = p[np.all(np.isfinite(p), axis=1)]
        if not len(p):
            return
        self.items.append({"type": kind, "points": _rounded(p), "colour": colour, **style})
        if counts and not style.get("moves"):
            self._extent.append(p)

    def label(self, at: ArrayLike, text: str, colour: str = "--ink", **style: object) -> None:
        self.items.append(
            {"type": "label", "points": _rounded(np.reshape(at, (1, 3))), "text": text, "colour": colour, **style}
        )

    def axes(self, pose: Pose, length: float, *, counts: bool = False, **style: object) -> None:
        """The three axes of a frame: x red, y green, z blue, as viewers have them."""
        for k, colour in enumerate(("#e0483e", "#35a853", "#3f7fe0")):
            ends = np.stack([pose.translation, pose.translation + length * pose.rotation[:, k]])
            self.add("line", ends, colour, width=2, counts=counts, **style)

    def data(
        self,
        front: Sequence[float],
        view: tuple[float, float] | None = None,
        motion: Mapping[str, Any] | None = None,
    ) -> dict[str, Any]:
        """What goes into the page.

        Parameters
        ----------
        front : (3,)
            The direction of a look with turn 0 and tilt 0.
        view
            Turn (to the right about `up`) and tilt (from above) of the first look, rad; the one that spreads the
            scene most if not given.
        """
        seen = np.concatenate(self._extent) if self._extent else np.zeros((1, 3))
        low, high = seen.min(axis=0), seen.max(axis=0)
        radius = max(float(np.linalg.norm(high - low)) / 2.0, 1e-3)
        frame = _upright(self.up, front)
        rim = np.concatenate([p[:: max(1, len(p) // 40)] for p in self._extent] or [np.zeros((1, 3))])
        return {
            "items": self.items,
            "frame": frame.tolist(),
            "centre": _rounded((low + high) / 2.0),
            "radius": radius,
            "rim": _rounded(rim),
            "view": list(view if view is not None else _best_view(frame, [np.asarray(p) for p in self._outlines()])),
            "motion": dict(motion) if motion is not None else None,
        }

    def _outlines(self) -> list[FloatArray]:
        return [np.asarray(i["points"]) for i in self.items if i["type"] == "polygon" and not i.get("moves")]


def _upright(up: Sequence[float], front: Sequence[float]) -> FloatArray:
    """Rows right, front, up (3, 3) of a right-handed frame."""
    u = np.asarray(up) / np.linalg.norm(up)
    f = np.asarray(front) - (np.asarray(front) @ u) * u
    f = f / np.linalg.norm(f)
    return np.stack([np.cross(f, u), f, u])


def _best_view(frame: FloatArray, outlines: Sequence[FloatArray]) -> tuple[float, float]:
    """Turn and tilt (rad), not far from the front, under which no surface is seen edge-on."""
    tilt = 0.42
    normals = [np.linalg.svd(p - p.mean(axis=0))[2][2] for p in outlines if len(p) >= 3]
    if not normals:
        return 0.5, tilt
    turns = np.deg2rad([25.0, -25.0, 40.0, -40.0, 55.0, -55.0])
    away = (
        np.cos(tilt) * (np.sin(turns)[:, None] * frame[0] + np.cos(turns)[:, None] * frame[1]) - np.sin(tilt) * frame[2]
    )
    faced = np.abs(away @ np.stack(normals).T).min(axis=1)
    # A wide turn shows depth better: the first turns lose unless they show the surfaces much better.
    return float(turns[int(np.argmax(np.minimum(faced, 0.5) + 0.1 * np.abs(turns)))]), tilt


def scene_block(
    title: str, caption: str, legend: Sequence[Markup], *, slider: tuple[float, str] | None = None
) -> Markup:
    """Where the scene is drawn, with its controls. `slider`: first value in degrees and its label."""
    controls: list[Markup] = []
    if slider is not None:
        value, label = slider
        shown = el("output", id="scene-angle-text", for_="scene-angle")
        knob = el("input", type="range", id="scene-angle", min=-180, max=180, step=0.5, value=round(value * 2) / 2)
        controls.append(el("label", el("span", label), knob, shown))
    controls += [
        el("button", text, type="button", data_scene=name)
        for name, text in (("nearer", "Nearer"), ("farther", "Farther"), ("reset", "Reset view"))
    ]
    canvas = el("canvas", id="scene", tabindex=0, role="img", aria_label=f"{title}, a scene in 3D. {caption}")
    return el(
        "figure",
        el("h3", title),
        el("ul", *legend, class_="legend"),
        el("div", canvas, class_="scene"),
        el("div", *controls, class_="controls"),
        el("figcaption", caption),
        class_="wide",
    )


def _rounded(values: ArrayLike) -> Any:
    """Lists with tenths of millimetres, which is more than a screen shows."""
    return np.round(np.asarray(values, dtype=np.float64), 4).tolist()
