# SPDX-License-Identifier: MIT
"""State of a viewer that follows a map: how much of it the viewer holds, and the next question. No sockets.

Each answer is complete up to its version, so nothing can be missed, and no answer overtakes another.
"""

import math

import numpy as np

from tsfusion.core.errors import DecodeError
from tsfusion.geometry.map_questions import AnswerArrays
from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.asking.map_events import Cleared, MapEvent, SurfaceUpdate
from tsfusion.wire.messages.questions import ANSWER_BYTES, LONGEST_WAIT_S, Cells


class FollowedMap:
    """The part of a map that its viewer holds, and the next question about the map.

    Attributes:
        epoch: name of the fuser's process; empty while nothing is known.
        voxel_size: metres; 0 while not known.
    """

    def __init__(self, name: str) -> None:
        self.name, self.epoch, self.voxel_size = name, "", 0.0
        self._until = 0  # version of the map up to which all changes came

    def forget(self) -> list[MapEvent]:
        """Drop all cells: the server has no such map."""
        was_known, self.voxel_size = self.voxel_size, 0.0
        self.epoch, self._until = "", 0
        return [Cleared(self.name, was_known)] if was_known else []

    def question(self, most_bytes: int = ANSWER_BYTES) -> Cells:
        """Return the next question."""
        return Cells(self._until, self.epoch, LONGEST_WAIT_S, most_bytes)

    def on_cells(self, epoch: str, arrays: AnswerArrays) -> list[MapEvent]:
        """Take the answer to the last question. Return the events that follow from it.

        Raises:
            DecodeError: for a malformed answer; ask again.
        """
        try:
            update, until = _update_of(arrays), int(arrays["until"])
            begins, voxel_size = bool(arrays["begins"]), float(arrays["voxel_size"])
        except (KeyError, IndexError, TypeError, ValueError, OverflowError) as error:
            raise DecodeError(f"an answer about cells is malformed: {error!r}") from error
        if until < 0 or not 0 < voxel_size < math.inf:
            raise DecodeError(f"an answer about cells is up to {until}, of voxels of {voxel_size} m")
        if epoch != self.epoch and not begins:
            raise DecodeError("an answer about cells is of another process of the server")
        self.epoch, self._until, self.voxel_size = epoch, until, voxel_size
        events: list[MapEvent] = [Cleared(self.name, voxel_size)] if begins else []
        return [*events, update] if len(update.cells) else events


def _update_of(arrays: AnswerArrays) -> SurfaceUpdate:
    """Return the triangles of an answer. Raise DecodeError unless its arrays fit together."""
    mesh = Mesh(arrays["vertices"], arrays["faces"], arrays["normals"], arrays.get("colors"))
    cells, first_face, client = arrays["cells"], arrays["first_face"], arrays["client"]
    clients = tuple(one.tobytes() for one in arrays["sessions"])
    rows = len(cells)
    fits = cells.shape == (rows, 3) and first_face.shape == (rows + 1,)
    fits = fits and client.shape == arrays["is_refined"].shape == (rows,)
    fits = fits and bool((np.diff(first_face, prepend=0, append=len(mesh.faces)) >= 0).all())
    fits = fits and first_face[0] == 0 and first_face[-1] == len(mesh.faces)
    if not fits:
        raise DecodeError(f"what came for {rows} cells does not fit together")
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise DecodeError("triangles have corners that did not come")
    if rows and not -1 <= client.min() <= client.max() < len(clients):
        raise DecodeError("cells were seen by sessions that did not come")
    return SurfaceUpdate(cells, first_face, mesh, arrays["is_refined"], clients, client)
