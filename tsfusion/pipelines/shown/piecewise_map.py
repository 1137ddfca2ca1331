# SPDX-License-Identifier: MIT
"""Send a saved map as events, piece by piece: first all of its raw surface, then its chosen surface."""

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DecodeError, JournalError
from tsfusion.core.number_ranges import distinct
from tsfusion.core.readable_numbers import count_of, counted
from tsfusion.pipelines.shown.map_rewinding import RewoundMap
from tsfusion.tsdf.files import map_history
from tsfusion.tsdf.store.block_store import cells_of, pack_keys, unpack_keys
from tsfusion.tsdf.surface.mesh_extraction import CellMeshes
from tsfusion.tsdf.surface.mesh_tiles import WholeMapValues
from tsfusion.tsdf.volume import Volume
from tsfusion.wire.asking.map_events import (
    Cleared,
    LinkSeen,
    MapEvent,
    PathsFound,
    ScannerSeen,
    SurfaceUpdate,
)
from tsfusion.wire.records.record_header import KeyframeHeader, unpack_keyframe

CELLS = 512  # meshed at a time
_MOVING_S = 0.2  # seconds for adding and removing keyframes, then as long for meshing
_MEASURED = ("depth", "disparity")
_NONE = np.zeros(0, np.int64)


class PiecewiseMap:
    """A map shown on a page.

    Args:
        name: name of the map.
        note: text that the page always shows; may be empty.
        send: takes events.
        attend: called between the steps of a piece. It returns True if the user wants something else now.
    """

    def __init__(
        self,
        name: str,
        rewound: RewoundMap,
        *,
        note: str = "",
        send: Callable[[list[MapEvent]], None],
        attend: Callable[[], bool] = lambda: False,
    ) -> None:
        self._name, self._map, self._note, self._send, self._attend = name, rewound, note, send, attend
        self._volume: Volume | None = None
        self._values: WholeMapValues | None = None  # for the refined surface of the present map
        self._is_refining = False
        self._shown = set[int]()  # keys of cells with triangles
        self._stale = self._unrefined = _NONE  # sorted keys of cells
        self._told: str | None = None
        self._is_behind = not rewound.is_there
        self._place = -1  # number of keyframes when paths and scanner were sent
        histories = map_history.of_clients(map_history.sessions(rewound.header.meta))
        saved = [bytes.fromhex(one.session) for one in histories]
        self._sessions = tuple(dict.fromkeys([*saved, *rewound.sessions]))

    def begin(self) -> None:
        """Send the name and voxel size of the map, and its notes."""
        self._send([Cleared(self._name, self._map.header.config.voxel_size)])
        self._tell()

    def seek(self, keyframes: int) -> None:
        """Show the map after this many keyframes; later pieces do it. Do not call this in `attend`."""
        self._map.seek(keyframes)

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return (n,) weights at (n, 3) points, or None if the map is not read yet."""
        if self._volume is None:
            return None
        weights: NDArray[np.float32] = self._volume.sample(points, surface="raw").weight
        return weights

    def work(self) -> bool:
        """Do the next piece of work. Return False if there was none.

        Raises:
            CheckpointError: when the map cannot be read.
        """
        if self._volume is None:
            self._take(self._map.volume)
        elif not self._map.is_there:
            self._move()
        elif len(self._stale):
            self._show_raw()
        elif self._place != self._map.place:
            self._send_place()
        elif len(self._unrefined):
            self._show_refined()
        elif not self._map.knows_clients:
            self._find_clients()
        else:
            self._values = None
            return False
        return True

    @property
    def _is_raw(self) -> bool:
        return self._map.header.config.checked_model().surface == "raw"

    def _take(self, volume: Volume) -> None:
        """Begin to show another volume: all its cells are to be sent."""
        self._volume, self._values = volume, None
        volume.set_pause(self._pause)
        volume.take_dirty()
        keys = np.sort(pack_keys(volume.blocks().coordinates))
        self._stale = distinct(np.append(keys, np.array(sorted(self._shown), np.int64)))
        self._unrefined = _NONE if self._is_raw else keys

    def _pause(self) -> None:
        if self._attend() and self._is_refining:
            raise _Interrupted

    def _move(self) -> None:
        """Add and remove keyframes for a while, then mesh some of what changed."""
        self._values = None
        self._tell()
        until = time.monotonic() + _MOVING_S
        while not self._map.is_there and time.monotonic() < until:
            if self._map.step():
                self._take(self._map.volume)
            if self._attend():
                break
        self._note_changes()
        until = time.monotonic() + _MOVING_S
        while len(self._stale) and time.monotonic() < until:
            self._show_raw()
        self._send_scanner(self._map.place - 1)
        self._tell()

    def _find_clients(self) -> None:
        """Find out which client touched each block. Then send all cells again; the map does not change."""
        assert self._volume is not None
        until = time.monotonic() + _MOVING_S
        while not self._map.knows_clients and time.monotonic() < until and not self._attend():
            self._map.find_clients()
        self._volume.take_dirty()
        if self._map.knows_clients:
            self._stale = np.array(sorted(self._shown), np.int64)
            self._unrefined = _NONE if self._is_raw else self._stale
        self._tell()

    def _note_changes(self) -> None:
        volume = self._volume
        assert volume is not None
        blocks = volume.take_dirty()
        self._stale = distinct(np.append(self._stale, pack_keys(cells_of(blocks))))
        if not self._is_raw:
            self._unrefined = distinct(np.append(self._unrefined, pack_keys(volume.cells_to_mesh(blocks))))

    def _show_raw(self) -> None:
        assert self._volume is not None
        found = self._volume.surface.mesh_cells(unpack_keys(self._stale[:CELLS]), "raw")
        self._show(found, is_refined=self._is_raw)
        self._stale = self._stale[CELLS:]

    def _show_refined(self) -> None:
        volume, keys = self._volume, self._unrefined[:CELLS]
        assert volume is not None
        self._values = self._values or volume.surface.whole_values()
        self._is_refining = True
        try:
            found = volume.surface.mesh_cells(unpack_keys(keys), values=self._values)
        except _Interrupted:
            return
        finally:
            self._is_refining = False
        self._values.forget_before(int(keys[-1]))
        self._show(found, is_refined=True)
        self._unrefined = self._unrefined[CELLS:]

    def _show(self, found: CellMeshes, *, is_refined: bool) -> None:
        """Send the triangles of some cells. Cells that have none and had none are left out."""
        keys, first = pack_keys(found.cells), found.first_face
        has_faces = np.diff(first) > 0
        was_shown = np.fromiter((key in self._shown for key in keys.tolist()), bool, len(keys))
        told = has_faces | was_shown
        self._shown.difference_update(keys[~has_faces].tolist())
        self._shown.update(keys[has_faces].tolist())
        if told.any():
            first = np.append(first[:-1][told], first[-1])
            sessions, client = self._sessions, np.zeros(int(told.sum()), np.int32)
            if len(sessions) != 1:
                sessions, client = self._map.clients_of(found.cells[told])
            update = SurfaceUpdate(found.cells[told], first, found.mesh, is_refined, sessions, client)
            self._send([update])

    def _send_place(self) -> None:
        """Send the poses of the keyframes in the map."""
        self._place, self._is_behind = self._map.place, False
        for index in self._map.last_of_sessions():
            self._send_scanner(index)
        self._send([PathsFound(self._map.keyframes_in(), self._map.volume.held)])
        self._tell()

    def _send_scanner(self, index: int) -> None:
        """Send a keyframe's pose and picture."""
        if 0 <= index < self._map.count:
            rows = self._map.rows[[index]]
            session, seq = next(iter(rows))
            try:
                record = self._map.record(index)
                header = unpack_keyframe(record.frames[0])
            except (JournalError, DecodeError, IndexError):
                return
            seen = ScannerSeen(
                session, seq, rows.matrices[0], header.intrinsics, _shape(header),
                _picture(header, record.frames), record.client,
            )  # fmt: skip
            self._send([seen])

    def _tell(self) -> None:
        """Send a line about problems, if it has changed."""
        lines = [self._note] if self._note else []
        if self._is_behind:
            behind = count_of(self._map.behind, "keyframe")
            lines.append(f"the saved map is {behind} behind its journal: the page catches up")
        if self._map.left_out:
            lines.append(f"could not be moved in time: {counted(self._map.left_out)}")
        if (line := "; ".join(lines)) != self._told:
            self._told = line
            self._send([LinkSeen(line)])


class _Interrupted(Exception):
    """Stops the refining of the surface, because the user wants something else now."""


def _shape(header: KeyframeHeader) -> tuple[int, int] | None:
    """Return height and width of a keyframe's image, or None without an image."""
    for buffer in header.buffers:
        if buffer.name in _MEASURED:
            return buffer.shape[0], buffer.shape[1]
    return None


def _picture(header: KeyframeHeader, frames: list[memoryview]) -> bytes | None:
    """Return the JPEG of a keyframe, or None without one."""
    for number, buffer in enumerate(header.buffers, 1):
        if buffer.name == "color" and buffer.codec == "jpeg":
            return bytes(frames[number])
    return None
