# SPDX-License-Identifier: MIT
"""Clip the shown map with a plane and a box, and build the controls of both."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import mesh_cropping
from tsfusion.geometry.mesh import Mesh
from tsfusion.viewer.map.vertex_colors import rounded_up
from tsfusion.viewer.page.page_server import calm

if TYPE_CHECKING:
    import viser

ClipSide = Literal["whole", "part", "hidden"]
_NONE, _HEIGHT = "none", "height"
_AXES = ("x", "y", "z")
_STEP = 0.01  # metres


@dataclass(frozen=True, eq=False)
class Clipping:
    """Clip of the shown map: a plane, a box, both or none.

    Attributes:
        normal: (3,) points with `normal · p > offset` are hidden; None = no plane.
        offset: metres.
        box: (2, 3) lowest and highest shown coordinates, metres; None = no box.
    """

    normal: NDArray[np.float64] | None = None
    offset: float = 0.0
    box: NDArray[np.float64] | None = None

    def side(self, bounds: NDArray[np.float32]) -> ClipSide:
        """Return how much of a region with (2, 3) bounds is shown."""
        whole = True
        if self.normal is not None:
            middle = bounds.mean(axis=0) @ self.normal
            reach = np.ptp(bounds, axis=0) / 2 @ np.abs(self.normal)
            if middle - reach > self.offset:
                return "hidden"
            whole = bool(middle + reach <= self.offset)
        if self.box is not None:
            if (bounds[0] > self.box[1]).any() or (bounds[1] < self.box[0]).any():
                return "hidden"
            whole &= bool((bounds[0] >= self.box[0]).all() and (bounds[1] <= self.box[1]).all())
        return "whole" if whole else "part"

    def cut(self, mesh: Mesh) -> Mesh:
        """Return the shown part of a mesh; triangles across the border are cut."""
        if self.normal is not None:
            mesh = mesh_cropping.cut(mesh, self.normal, self.offset)
        if self.box is not None and len(mesh.faces):
            mesh = mesh_cropping.cropped(mesh, self.box.ravel().tolist())
        return mesh

    def shows(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return an (n,) mask of the shown (n, 3) points."""
        shown = np.ones(len(points), bool)
        if self.normal is not None:
            shown &= points @ self.normal <= self.offset
        if self.box is not None:
            shown &= ((points >= self.box[0]) & (points <= self.box[1])).all(axis=1)
        return shown


class ClippingControls:
    """Sliders to clip the map. `changed` is called, on any thread, after a person moved one."""

    def __init__(self, gui: "viser.GuiApi", changed: Callable[[], None]) -> None:
        self.up = np.array((0.0, 0.0, 1.0))
        self._low, self._high = np.zeros(3), np.ones(3)
        self._plane: Any = gui.add_dropdown(
            "Cut at", (_NONE, _HEIGHT, *_AXES), initial_value=_NONE, hint="Hide what is beyond a plane"
        )
        self._at: Any = gui.add_slider("Metres", 0.0, 1.0, _STEP, 1.0, disabled=True)
        self._other: Any = gui.add_checkbox("Keep the other side", False, disabled=True)
        self._box: Any = gui.add_checkbox("Only inside a box", False)
        self._ranges: list[Any] = [
            gui.add_multi_slider(axis, 0.0, 1.0, _STEP, (0.0, 1.0), visible=False) for axis in _AXES
        ]

        def update(event: object) -> None:
            self._enable()
            changed()

        self._plane.on_update(calm(lambda event: self._move_to_end()))
        for control in (self._plane, self._at, self._other, self._box, *self._ranges):
            control.on_update(calm(update))

    @property
    def clipping(self) -> Clipping:
        normal, offset = None, 0.0
        if self._plane.value != _NONE:
            sign = -1.0 if self._other.value else 1.0
            normal, offset = sign * self._normal, sign * float(self._at.value)
        if not self._box.value:
            return Clipping(normal, offset)
        ends = np.array([(min(slider.value), max(slider.value)) for slider in self._ranges], np.float64).T
        return Clipping(normal, offset, np.stack((ends[0], np.maximum(ends[1], ends[0] + _STEP))))

    def fit(self, low: NDArray[np.float64], high: NDArray[np.float64], up: NDArray[np.float64]) -> None:
        """Set the sliders' ranges to a map from (3,) `low` to (3,) `high`, metres; `up` is (3,)."""
        grain = rounded_up(float((high - low).max())) / 50
        low, high = grain * np.floor(low / grain), grain * np.ceil(high / grain)
        if (low == self._low).all() and (high == self._high).all() and (up == self.up).all():
            return
        self._low, self._high, self.up = low, high, up
        for axis, slider in enumerate(self._ranges):
            first, last = slider.value
            first = low[axis] if first <= slider.min else max(first, low[axis])
            last = high[axis] if last >= slider.max else min(last, high[axis])
            slider.min, slider.max = float(low[axis]), float(high[axis])
            slider.value = (float(first), float(max(first, last)))
        self._fit_plane()

    @property
    def _normal(self) -> NDArray[np.float64]:
        name = self._plane.value
        return np.eye(3)[_AXES.index(name)] if name in _AXES else self.up

    def _fit_plane(self, *, to_end: bool = False) -> None:
        corners = np.array(np.meshgrid(*zip(self._low, self._high, strict=True))).reshape(3, -1).T
        heights = corners @ self._normal
        low, high = math.floor(heights.min() * 100) / 100, math.ceil(heights.max() * 100) / 100
        value = high if to_end or self._at.value >= self._at.max else min(max(self._at.value, low), high)
        self._at.min, self._at.max, self._at.value = low, high, value

    def _move_to_end(self) -> None:
        """Move the slider of a newly chosen plane to the end where the plane hides nothing."""
        self._other.value = False
        self._fit_plane(to_end=True)

    def _enable(self) -> None:
        self._at.disabled = self._other.disabled = self._plane.value == _NONE
        for slider in self._ranges:
            slider.visible = self._box.value
