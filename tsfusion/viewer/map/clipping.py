# SPDX-License-Identifier: MIT
"""Parts of a map's tiles that a plane and a box leave."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import mesh_cropping
from tsfusion.geometry.mesh import Mesh

ClipSide = Literal["whole", "part", "hidden"]


@dataclass(frozen=True, eq=False)
class Clipping:
    """A plane, a box, both or none.

    Attributes:
        normal: (3,) what lies where `normal · p > offset` is not shown; None = no plane.
        offset: metres.
        box: (2, 3) lowest and highest coordinates of what is shown, metres; None = no box.
    """

    normal: NDArray[np.float64] | None = None
    offset: float = 0.0
    box: NDArray[np.float64] | None = None

    def side(self, bounds: NDArray[np.float32]) -> ClipSide:
        """How much is shown of what lies within (2, 3) bounds."""
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
        """Shown part of a mesh; triangles across the border are cut there."""
        if self.normal is not None:
            mesh = mesh_cropping.cut(mesh, self.normal, self.offset)
        if self.box is not None and len(mesh.faces):
            mesh = mesh_cropping.cropped(mesh, self.box.ravel().tolist())
        return mesh

    def shows(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(n,) whether each of (n, 3) points is where something is shown."""
        shown = np.ones(len(points), bool)
        if self.normal is not None:
            shown &= points @ self.normal <= self.offset
        if self.box is not None:
            shown &= ((points >= self.box[0]) & (points <= self.box[1])).all(axis=1)
        return shown
