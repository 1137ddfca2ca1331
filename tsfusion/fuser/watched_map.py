# SPDX-License-Identifier: MIT
"""Answer viewers of a map: its cells, a batch at a time, and the poses of its keyframes."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.fuser.live_mesh import LiveMesh, TouchedBy
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.asking.surface_parts import Arrays
from tsfusion.wire.messages.questions import (
    CELLS_AT_ONCE,
    KEYFRAMES_AT_ONCE,
    REFINED_AT_ONCE,
    Cells,
    Keyframes,
)

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

_SESSION = 16  # bytes


class WatchedMap:
    """A map, together with the poses, sessions and updates that its voxels do not contain."""

    def __init__(self, volume: "Volume", ledger: Ledger, touched_by: TouchedBy, live_mesh: LiveMesh) -> None:
        self._volume, self._ledger = volume, ledger
        self._touched_by, self._live_mesh = touched_by, live_mesh

    def answer(self, asked: Cells | Keyframes) -> Arrays:
        """Return the arrays of an answer, by name."""
        return self._cells(asked) if isinstance(asked, Cells) else self._keyframes(asked)

    def _cells(self, asked: Cells) -> Arrays:
        """Return arrays as in `mesh_updates.MeshUpdate`, and `next`: the first cell of the next batch.

        `state`: version, drops, and number of the newest mesh update. Later changes come in later updates.
        """
        volume, own = self._volume, self._volume.model.surface
        next_cells = volume.surface.next_cells
        is_refined = own in (asked.surface or own, "raw")
        most = CELLS_AT_ONCE if (asked.surface or own) == "raw" else REFINED_AT_ONCE
        found, following = next_cells(asked.first, since=asked.since, surface=asked.surface, most=most)
        changed, touched = volume.surface.cell_versions(found.cells)
        sessions, client = self._touched_by.of(touched)
        mesh = found.mesh
        arrays = {
            "cells": found.cells,
            "first_face": found.first_face,
            "changed": changed,
            "client": client,
            "sessions": _bytes_of(sessions),
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "normals": mesh.normals,
            **({} if mesh.colors is None else {"colors": mesh.colors}),
            "next": np.zeros(0, np.int32) if following is None else following,
            "is_refined": np.asarray(is_refined),
            "voxel_size": np.float64(volume.config.voxel_size),
            "state": np.array([volume.version, volume.drops, self._live_mesh.number], np.int64),
        }
        return {name: np.asarray(array) for name, array in arrays.items()}

    def _keyframes(self, asked: Keyframes) -> Arrays:
        """Return the arrays of `Ledger.fused_after`."""
        found, T_map_odometry, last = self._ledger.fused_after(asked.session, asked.after, KEYFRAMES_AT_ONCE)
        session, number = last or (b"", 0)
        return {
            "sessions": _bytes_of(found.sessions),
            "session": found.session,
            "seqs": found.seqs,
            "poses": found.poses,
            "T_map_odometry": T_map_odometry,
            "last_session": np.array(list(session), np.uint8),
            "last": np.asarray(number, np.int64),
            "held": np.array(self._volume.held.numbers),
        }


def _bytes_of(sessions: Any) -> NDArray[np.uint8]:
    return np.array([list(one) for one in sessions], np.uint8).reshape(-1, _SESSION)
