# SPDX-License-Identifier: MIT
"""Build the sections of a report that show a map: pictures, 3-D view, error, plan with trajectory."""

import dataclasses
import json
from html import escape

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.readable_numbers import grouped
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines.maps import mesh_preview
from tsfusion.pipelines.report import charts, page, pictures
from tsfusion.pipelines.report.charts import Axis, Chart
from tsfusion.pipelines.report.pictures import ErrorScale, Sides
from tsfusion.pipelines.report.run_record import MapFindings, Paths

_MOST_PATH = 2000  # points of the trajectory in the 3-D view
_BINS = 60  # of a histogram
_LEAST_SHOWN = 0.01  # share of a picture that shows the mesh, or it is left out
PATH_STYLES = {  # of a trajectory: style, text
    "reference": ("k7 wide", "reference"),
    "trajectory": ("k5", "as tracked"),
    "trajectory-corrected": ("k6", "after loop closure"),
}


class ShownMap:
    """A map as pictures and charts of a report.

    Attributes:
        mesh: without its islands.
        scale: colours of its error by vertex; None if no error is known.
        pictures: name and RGB of each picture that was drawn, to be written beside the page.
    """

    def __init__(self, found: MapFindings, name: str) -> None:
        assert found.mesh is not None
        whole = found.mesh
        self.mesh, self.scale = whole.without_islands(), None
        if not mesh_preview.has_colors(self.mesh):
            self.mesh = dataclasses.replace(self.mesh, colors=None)
        self.whole_error_mm: NDArray[np.float64] | None = None
        if found.error_m is not None:
            self.whole_error_mm = 1000 * np.abs(found.error_m.astype(np.float64))
            scale = pictures.error_scale(self.whole_error_mm)
            carried = np.repeat(scale.level[:, None], 3, axis=1)  # islands take their levels with them
            kept = dataclasses.replace(whole, colors=carried).without_islands().colors
            self.scale = ErrorScale(scale.end_mm, kept[:, 0] if kept is not None else scale.level)
        self.pictures: dict[str, NDArray[np.uint8]] = {}
        self._name, self._found = name, found
        self._sides = Sides(self.mesh)

    def sides(self) -> str:
        """Return the HTML of pictures of the mesh from up to four sides; empty sides are left out."""
        shown = []
        for side in range(pictures.SIDES):
            rgb = self._sides.picture(side)
            if side and (rgb != rgb[0, 0]).any(axis=2).mean() < _LEAST_SHOWN:
                continue  # walls are open from behind
            self.pictures[f"{self._name}side{side + 1}"] = rgb
            words = "from the side that shows most" if side == 0 else f"turned by {side * 90}°"
            shown.append(page.picture(pictures.jpeg_url(rgb), f"The mesh {words}"))
        return f'<div class="sides">{"".join(shown)}</div>'

    def view(self) -> str:
        """Return the HTML of the 3-D view, which the reader can turn."""
        made = pictures.make_scene(self.mesh, None if self.scale is None else self.scale.level)
        up = mesh_preview.up_of(self.mesh)
        low, high = np.percentile(self.mesh.vertices @ up, (1, 98))
        azimuth, elevation = self._sides.angles
        head = {
            **made.header(up), "heights": [float(low), float(max(high, low + 1e-3))],
            "azimuth": azimuth, "elevation": elevation, "path": _shown_path(self._found.paths),
        }  # fmt: skip
        modes = [("0", "colour")] if self.mesh.colors is not None else []
        modes += [("1", "height"), ("2", "direction (normals)"), ("3", "shape alone")]
        if self.scale is not None:
            modes.append(("4", f"error, 0 to {self.scale.end_mm:g} mm"))
        options = "".join(f'<option value="{value}">{escape(text)}</option>' for value, text in modes)
        less = (
            f"{grouped(len(made.mesh.faces))} of {grouped(made.full)} triangles: simplified here. "
            if len(made.mesh.faces) < made.full
            else ""
        )
        return (
            '<div class="viewer"><div class="controls"><label>colour by '
            f'<select>{options}</select></label><label><input type="checkbox"> walls from behind, too</label>'
            '<button type="button">reset the view</button></div><canvas tabindex="0" '
            'aria-label="3-D view of the mesh"></canvas><p class="trouble" role="status"></p>'
            f'<p class="note">Drag to turn, Shift-drag or right button to move, wheel or pinch to zoom. '
            f"{less}"
            "The orange line is the sensor's way.</p>"
            f'<script type="application/json" class="head">{json.dumps(head)}</script>'
            f'<script type="text/plain" class="packed">{made.packed()}</script></div>'
        )

    def error(self) -> str:
        """Return the HTML of pictures coloured by error, and of a histogram; empty if no error is known."""
        if self.scale is None or self.whole_error_mm is None:
            return ""
        colors = self.scale.colors()
        both = []
        for number, side in enumerate((0, 2), 1):
            rgb = self._sides.picture(side, colors)
            self.pictures[f"{self._name}error{number}"] = rgb
            both.append(
                page.picture(pictures.jpeg_url(rgb), f"Distance from the true surface, side {side + 1}")
            )
        end = self.scale.end_mm
        bar = f'<div class="scale">0 mm <i></i> {end:g} mm or more</div>'
        return page.pair(*both) + bar + _histogram(self.whole_error_mm, end)

    def plan(self) -> str:
        """Return the HTML of a chart of the map from above, with the sensor's path."""
        return plan(self.mesh, self._found.paths)


def plan(mesh: Mesh | None, paths: Paths) -> str:
    """Return the HTML of a chart of trajectories over the mesh from above; empty without a trajectory."""
    shown = {name: paths[name][1] for name in PATH_STYLES if name in paths and len(paths[name][1])}
    keyframes = paths["keyframes"][1] if "keyframes" in paths else None
    if not shown and keyframes is None:
        return ""
    up = np.array((0.0, 0.0, 1.0)) if mesh is None else mesh_preview.up_of(mesh)
    axes = _level_axes(up)
    flat = {name: poses[:, :3, 3] @ axes for name, poses in shown.items()}
    dots = None if keyframes is None else keyframes[:, :3, 3] @ axes
    all_places = [*flat.values(), *([] if dots is None else [dots])]
    background = None if mesh is None else pictures.plan(mesh.vertices.astype(np.float64) @ axes)
    if background is not None:
        all_places.append(background[1])
    (x0, y0), (x1, y1) = np.min([p.min(0) for p in all_places], 0), np.max([p.max(0) for p in all_places], 0)
    chart = Chart(
        Axis(x0, x1, "m", 8),
        Axis(y0, y1, "m", 6),
        "Trajectory from above",
        width=760,
        height=520,
        square=True,
    )
    if background is not None:
        url, ((left, low), (right, high)) = background
        chart.image(url, left, low, right, high)
    for name, places in flat.items():
        chart.line(places[:, 0], places[:, 1], PATH_STYLES[name][0])
    if dots is not None:
        chart.points(dots[:, 0], dots[:, 1], "k0", 2.2)
    legend = [(PATH_STYLES[name][0], PATH_STYLES[name][1]) for name in flat]
    legend += [("k0", "keyframes")] if dots is not None else []
    return page.chart(chart.svg(), "From above", legend=charts.legend(legend), is_wide=True)


def _histogram(error_mm: NDArray[np.float64], end: float) -> str:
    counts, edges = np.histogram(np.minimum(error_mm, end), bins=_BINS, range=(0, end))
    share = 100 * counts / max(len(error_mm), 1)
    chart = Chart(
        Axis(0, end, "distance from the true surface, mm (the last bar: that, or more)", 8),
        Axis(0, float(share.max()) * 1.3, "% of the vertices"), "Histogram of the error",
        width=1060, height=240,
    )  # fmt: skip
    chart.bars(edges, np.zeros(_BINS), share, "k5 apart")
    p50, p95 = np.percentile(error_mm, (50, 95))
    chart.mark(min(float(p50), end), f"median {p50:.2f} mm")
    chart.mark(min(float(p95), end), f"95 % are below {p95:.2f} mm", 1)
    return page.chart(chart.svg(), "How often", is_wide=True)


def _level_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (3, 2) axes, right and up, of a plan seen from above; they are x and y if up is z."""
    forward = np.array((0.0, 1, 0) if abs(up[1]) < 0.9 else (0.0, 0, 1))
    north = forward - (forward @ up) * up
    north /= np.linalg.norm(north)
    return np.stack((np.cross(north, up), north), axis=1)


def _shown_path(paths: Paths) -> list[list[float]]:
    name = next((n for n in ("trajectory-corrected", "trajectory", "keyframes") if n in paths), None)
    if name is None:
        return []
    places = paths[name][1][:, :3, 3]
    chosen = places[:: max(1, len(places) // _MOST_PATH)]
    rounded: list[list[float]] = np.round(chosen, 4).tolist()
    return rounded
