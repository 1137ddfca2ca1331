# SPDX-License-Identifier: MIT
"""Read a saved map for a page, in a process of its own: `python -m tsfusion.pipelines.shown.view_process`.

A kernel holds Python's global lock for its whole run, but the page has to answer meanwhile. `viewed_maps`
starts this process and holds the other end of its connection. The process ends when that end closes.
"""

import signal
import sys
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import NamedTuple

from tsfusion.core import process
from tsfusion.core.config import DEFAULT_MAP
from tsfusion.core.errors import CheckpointError, TsfusionError
from tsfusion.core.folder_lock import owner_of
from tsfusion.core.output_folder import RECORD
from tsfusion.geometry.mesh import Mesh
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.pipelines.maps import saved_maps
from tsfusion.pipelines.runs import run_files
from tsfusion.pipelines.shown.map_rewinding import RewoundMap
from tsfusion.pipelines.shown.piecewise_map import PiecewiseMap
from tsfusion.pipelines.shown.viewed_maps import Open, Opened, Seek, Told, Took, ViewFailed, Weigh, Weighed
from tsfusion.tsdf.files import checkpoint
from tsfusion.viewer.map_feed import TimeLine
from tsfusion.wire.asking.map_events import MapEvent, SurfaceUpdate

_MOST_BYTES = 16 << 20  # of triangles sent and not yet taken by the page


class ViewedSource(NamedTuple):
    """A map that can be shown. `note`: text for the user; `journaled`: None without a journal."""

    name: str
    file: Path
    journaled: JournaledKeyframes | None
    note: str


def find(path: Path, name: str | None) -> ViewedSource:
    """Return the map at a path: a file, a run's folder, a state folder (with `name`), or a map's folder.

    Raises:
        CheckpointError, JournalError: when there is no map, or it cannot be read.
    """
    if (path / RECORD).is_file():
        file = path / run_files.MAP
        if not file.is_file():
            raise CheckpointError(
                f"{path} has no {file.name}: the run sent its keyframes to a server; view that one, or its "
                "state folder"
            )
        return ViewedSource(path.absolute().name, file, None, "")
    if name is None and state_folder.is_state_folder(path):
        name = _usual_map(path)
    saved = saved_maps.find(path, name)
    if saved.folder is None:
        return ViewedSource(saved.path.stem, saved.path, None, "")
    name = saved.folder.absolute().name
    if not (saved.folder / state_folder.JOURNAL_FOLDER).is_dir():
        return ViewedSource(name, saved.path, None, _running(saved.folder))
    with checkpoint.reading(saved.path) as (header, _):
        saved_maps.check_checkpoint(saved, header)
        knows_journal = "done" in header.meta
    if not knows_journal:
        note = "the map does not say which keyframes of its journal it has: there is no way back in time"
        return ViewedSource(name, saved.path, None, note)
    journaled = JournaledKeyframes(state_folder.find_journal(saved.folder))
    return ViewedSource(name, saved.path, journaled, _running(saved.folder))


def _usual_map(state: Path) -> str | None:
    """Return the name of the saved map `default`, or of the first saved map; None if none was saved."""
    names = sorted(state_folder.map_names(state), key=lambda name: (name != DEFAULT_MAP, name))
    saved = (state_folder.map_folder(state, name) for name in names)
    return next((one.name for one in saved if (one / state_folder.MAP_FILE).is_file()), None)


def _running(folder: Path) -> str:
    """Return a note if a server uses the map, else an empty text."""
    if owner_of(folder, name=state_folder.LOCK_FILE) is None:
        return ""
    return "a server is at work on this map, and what it does from now on is not shown: view its address"


class _Viewing:
    """Main loop of the process: shows one map after the other, and answers the page."""

    def __init__(self, link: "Connection[object, object]") -> None:
        self._link = link
        self._ended = False
        self._number = 0
        self._open: Open | None = None
        self._seek: int | None = None
        self._map: PiecewiseMap | None = None
        self._outstanding = 0  # bytes

    def run(self) -> None:
        """Work until the page closes the connection."""
        is_idle = True
        while not self._ended:
            self._read(wait=is_idle)
            if self._open is not None:
                is_idle = not self._do(self._begin)
            elif self._map is not None:
                is_idle = not self._do(self._go_on)

    def _do(self, piece: Callable[[], bool]) -> bool:
        try:
            return piece()
        except (TsfusionError, MemoryError) as error:
            if isinstance(error, MemoryError):
                error = CheckpointError(f"there is no memory for the map: {error}")
            self._map = None
            self._link.send(ViewFailed(self._number, error))
            return False

    def _begin(self) -> bool:
        assert self._open is not None
        wanted, self._open, self._seek, self._map = self._open, None, None, None
        self._number = wanted.number
        source = find(wanted.path, wanted.name)
        rewound = RewoundMap(source.file, source.journaled, memory_bytes=saved_maps.memory_for(source.file))
        count = rewound.count
        time_line = TimeLine(count, rewound.seconds) if count else None
        self._link.send(Opened(self._number, source.name, time_line))
        self._map = PiecewiseMap(source.name, rewound, note=source.note, send=self._send, attend=self._attend)
        self._map.begin()
        return True

    def _go_on(self) -> bool:
        assert self._map is not None
        if self._seek is not None:
            self._map.seek(self._seek)
            self._seek = None
        return self._map.work()

    def _attend(self) -> bool:
        self._read(wait=False)
        return self._ended or self._open is not None or self._seek is not None

    def _send(self, events: list[MapEvent]) -> None:
        """Send events. First wait until the page took most earlier ones, or the user wants something else."""
        while self._outstanding > _MOST_BYTES and not self._attend():
            self._read(wait=True)
        nbytes = sum(_size(one.mesh) for one in events if isinstance(one, SurfaceUpdate))
        self._outstanding += nbytes
        self._link.send(Told(self._number, events, nbytes))

    def _read(self, *, wait: bool) -> None:
        try:
            while not self._ended and self._link.poll(None if wait else 0.0):
                self._handle(self._link.recv())
                wait = False
        except (EOFError, OSError):
            self._ended = True

    def _handle(self, message: object) -> None:
        if isinstance(message, Open):
            self._open, self._seek = message, None
        elif isinstance(message, Seek):
            self._seek = message.keyframes
        elif isinstance(message, Took):
            self._outstanding -= message.nbytes
        elif isinstance(message, Weigh):
            weights = None if self._map is None else self._map.weights(message.points)
            self._link.send(Weighed(message.number, weights))


def _size(mesh: Mesh) -> int:
    arrays = (mesh.vertices, mesh.faces, mesh.normals, mesh.colors)
    return sum(array.nbytes for array in arrays if array is not None)


def main() -> None:
    """Serve the connection whose file descriptor is the first argument."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the page decides when this process ends
    process.end_first()
    process.lift_memory_limit()  # which is that of the page
    _Viewing(Connection(int(sys.argv[1]))).run()


if __name__ == "__main__":
    main()
