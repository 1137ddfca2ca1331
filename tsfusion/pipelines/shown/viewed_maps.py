# SPDX-License-Identifier: MIT
"""Feed a page with a saved map: a file, a run's folder, or a state folder at any time of its journal."""

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.config import DEFAULT_MAP
from tsfusion.core.errors import CheckpointError, DecodeError, JournalError, TransportError, TsfusionError
from tsfusion.core.folder_lock import owner_of
from tsfusion.core.output_folder import RECORD
from tsfusion.core.readable_numbers import count_of
from tsfusion.geometry.keyframe_rows import square
from tsfusion.journal import Position, state_folder
from tsfusion.pipelines.maps import saved_maps
from tsfusion.pipelines.maps.private_server import PrivateMap, PrivateServer, ServedMaps
from tsfusion.tsdf.files import checkpoint
from tsfusion.viewer.map_feed import TimeLine
from tsfusion.wire.asking.followed_map import Cleared, HealthSeen, LinkSeen, MapEvent, ScannerSeen
from tsfusion.wire.asking.map_watcher import MapWatcher
from tsfusion.wire.asking.queries import Exchange
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.health import MapHealth
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Rewind
from tsfusion.wire.records.record_header import KeyframeHeader, unpack_keyframe

_GONE = "the process that reads the map has ended: was there memory enough? Start the page again"
_OFTEN_S = 0.3  # between two questions where a map is on its way to another time
_FIRST_S = 1.0  # until the first such question: triangles come first
_ANSWER_S = 2.0
_MEASURED = ("depth", "disparity")


class ViewedSource(NamedTuple):
    """A map that can be shown. `note`: text for the user; `journal`: folder, None without a way back."""

    name: str
    file: Path
    journal: Path | None
    note: str


def find(path: Path, name: str | None) -> ViewedSource:
    """Return the map at a path: a file, a run's folder, a state folder (with `name`), or a map's folder.

    Raises:
        CheckpointError, JournalError: when there is no map, or it cannot be read.
    """
    if (path / RECORD).is_file():
        file = path / state_folder.MAP_FILE
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
    return ViewedSource(name, saved.path, saved.folder / state_folder.JOURNAL_FOLDER, _running(saved.folder))


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


def open_feed(path: Path, *, map_name: str | None = None) -> "SavedMapFeed":
    """Return the feed of a saved map.

    Args:
        path: `MAP.tsf`, the folder of a run, a state folder, or the folder of one of its maps.
        map_name: name of the map, where the state folder has several. None = `default`, or the first map if
            `default` was not saved.

    Raises:
        CheckpointError, JournalError: when there is no such map, or it cannot be read.
    """
    return SavedMapFeed(Path(path), map_name)


class SavedMapFeed:
    """A `MapFeed` of a saved map, which a private server has open."""

    def __init__(self, path: Path, map_name: str | None) -> None:
        self._path, self._opened = path, ExitStack()
        self._open(find(path, map_name))

    def _open(self, source: ViewedSource) -> None:
        """Show a map. Raise TsfusionError if it cannot be opened: then nothing is shown."""
        self._source, self._problem = source, source.note
        self._watcher: MapWatcher | None = None
        self._said: str | None = None  # the problem that the last `LinkSeen` told
        self.time_line: TimeLine | None = None
        self._is_settled = False
        self._wish: int | None = None  # number of keyframes that `seek` asked for
        self._next_look = np.inf  # time.monotonic()
        self._shown: dict[bytes, int] = {}  # number of the keyframe that was shown last, by session
        with ExitStack() as stack:
            with checkpoint.reading(source.file) as (header, _):
                folder = None if source.journal is None else str(source.journal.resolve())
                shown = PrivateMap(DEFAULT_MAP, str(source.file.resolve()), header.config, folder)
            memory_bytes = saved_maps.memory_for(source.file)
            served = PrivateServer(ServedMaps([shown], memory_bytes=memory_bytes))
            self._server = stack.enter_context(closing(served))
            at, keys = self._server.addresses, self._server.keys
            self._asking = stack.enter_context(closing(Exchange(at.data, at.control, keys)))
            watcher = MapWatcher(at.data, DEFAULT_MAP, control=at.control, keys=keys)
            self._watcher = stack.enter_context(closing(watcher))
            self._opened = stack.pop_all()

    @property
    def title(self) -> str:
        """See `MapFeed`."""
        of_state = f", map {self._source.name}" if state_folder.is_state_folder(self._path) else ""
        return self._path.absolute().name + of_state

    def maps(self) -> list[str]:
        """See `MapFeed`."""
        if state_folder.is_state_folder(self._path):
            return state_folder.map_names(self._path)
        return [self._path.absolute().stem]

    def choose(self, map_name: str) -> None:
        """See `MapFeed`. Raise JournalError if the state folder has no such map."""
        if not state_folder.is_state_folder(self._path):
            return
        state_folder.resolve_map(self._path, map_name)
        self.close()
        try:
            self._open(find(self._path, map_name))
        except TsfusionError as error:
            self._watcher, self._problem = None, str(error)

    def seek(self, keyframes: int) -> None:
        """See `MapFeed`."""
        self._wish, self._next_look = keyframes, 0.0

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """See `MapFeed`. Wait at most some seconds."""
        watcher = self._watcher
        return None if watcher is None else watcher.weights(points)

    def close(self) -> None:
        """See `MapFeed`."""
        self._opened.close()

    def events(self, timeout: float) -> list[MapEvent]:
        """See `MapFeed`."""
        found: list[MapEvent] = []
        if self._watcher is None:
            time.sleep(timeout)
        elif self._server.has_ended:
            self._watcher, self._problem = None, _GONE
        else:
            found += self._watched(self._watcher.events(timeout))
            if self._source.journal and self._is_settled and time.monotonic() >= self._next_look:
                with suppress(TransportError, DecodeError):  # it is asked again
                    found += self._look(self._source.journal)
        if self._problem != self._said:
            self._said = self._problem
            found.append(LinkSeen(self._problem))
        return found

    def _watched(self, events: list[MapEvent]) -> Iterator[MapEvent]:
        """Yield the events of the surface and of paths, which concern the page, and note the others."""
        for event in events:
            if isinstance(event, HealthSeen):
                self._note(event.health.maps[DEFAULT_MAP])
            elif isinstance(event, Cleared):
                self._shown, self._next_look = {}, time.monotonic() + _FIRST_S
                yield replace(event, map=self._source.name)
            elif not isinstance(event, LinkSeen):
                yield event

    def _note(self, health: MapHealth) -> None:
        notes = [self._source.note, health.problem]
        self._is_settled |= health.state == "idle"
        if not self._is_settled and (behind := health.waiting + health.corrections_waiting):
            notes.append(
                f"the saved map is {count_of(behind, 'keyframe')} behind its journal: the page catches up"
            )
        if lost := health.journal_damaged:
            notes.append(f"damage of its journal has cost {count_of(lost, 'keyframe')}: `journal verify`")
        if health.corrections_unavailable:
            stuck = count_of(health.corrections_unavailable, "keyframe")
            notes.append(f"could not be moved in time: {stuck}")
        self._problem = "; ".join(filter(None, notes))

    # --- time ---

    def _look(self, folder: Path) -> Iterator[MapEvent]:
        """Ask the map to go where `seek` wants it, and where it is. Yield its newest keyframes."""
        command = Command(name="ask", map=DEFAULT_MAP, question=Rewind(self._wish), timeout_s=_ANSWER_S)
        reply, frames = self._asking.ask(command, timeout=2 * _ANSWER_S)
        assert reply.answer is not None
        found = questions.unpack(reply.answer, frames)
        is_there = bool(found["is_there"]) and self._wish is None
        self._wish, self._next_look = None, time.monotonic() + _OFTEN_S if not is_there else np.inf
        if self.time_line is None and (count := int(found["keyframes"])):
            self.time_line = TimeLine(count, _seconds(folder, found["ends"]))
        for row, seq in enumerate(found["seqs"].tolist()):
            session = found["sessions"][row].tobytes()
            if self._shown.get(session) != seq:
                self._shown[session] = seq
                place = Position(int(found["segments"][row]), int(found["offsets"][row]))
                with suppress(JournalError, DecodeError, IndexError):
                    yield _seen(folder, session, seq, place, square(found["poses"][[row]])[0])


def _seconds(folder: Path, ends: NDArray[np.int64]) -> float | None:
    """Return the seconds between two records; None if they cannot be read."""
    with suppress(JournalError):
        first, last = (journal.read(folder, Position(*place)).logged_ns for place in ends.tolist())
        return (last - first) / 1e9
    return None


def _seen(folder: Path, session: bytes, seq: int, place: Position, pose: NDArray[np.float64]) -> ScannerSeen:
    """Return the event of a keyframe, with its picture."""
    record = journal.read(folder, place)
    header = unpack_keyframe(record.frames[0])
    return ScannerSeen(
        session, seq, pose, header.intrinsics, _shape(header), _picture(header, record.frames), record.client
    )


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
