# SPDX-License-Identifier: MIT
"""Read messages of ROS 1 and ROS 2 recordings, in order or by location, without ROS.

A recording is a `.bag`, a ROS 2 folder (`metadata.yaml` beside `.db3` or `.mcap` files), or one such file.
"""

import bz2
import logging
import re
import threading
import weakref
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import cache, partial
from itertools import chain
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol

from tsfusion.core import limits
from tsfusion.core.errors import DatasetError, MissingDependency, needing
from tsfusion.journal import is_segment
from tsfusion.journal.mcap_layout import MAGIC

log = logging.getLogger(__name__)

ENDINGS = (".bag", ".db3", ".mcap")
_SQLITE = b"SQLite format 3"
METADATA = "metadata.yaml"
_INSTALL = "ROS recordings are read by rosbags; install: pip install '.[ros]' in your clone of tsfusion"
_UNCLOSED = "it was not closed when recording ended, or was cut: `{}` repairs it"
_REINDEX, _RECOVER = _UNCLOSED.format("rosbag reindex FILE"), _UNCLOSED.format("mcap recover FILE -o NEW")
_CHUNKS = "`mcap compress FILE -o NEW` or `rosbag compress FILE` writes smaller ones, if it is genuine"
_HINTS = {
    "not indexed": _REINDEX,
    "index looks damaged": _REINDEX,
    "could not be read from file": _REINDEX,
    "Invalid argument": _RECOVER,  # the error for a file too short for a footer
    "File end magic": _RECOVER,
    "malformed": _UNCLOSED.format("sqlite3 FILE .recover | sqlite3 NEW"),
    "Profile is not ros2": "only MCAP files of the profile ros2 are read",
    "larger than": _CHUNKS,
    "unpacks to": _CHUNKS,
}
_PACKETS = re.compile(r"(packet|velodyne|pandar|rslidar)\w*/?\w*(scan|packet|msg)", re.IGNORECASE)  # types
_FILE_ORDER = -1  # key in rosbags' index of a ROS 1 bag, for all wanted connections


class Stream(NamedTuple):
    """Messages of one type in one topic."""

    topic: str
    kind: str  # such as sensor_msgs/msg/Image, for ROS 1 too
    messages: int


class MessageLocation(NamedTuple):
    """Position of a message in a recording: enough to read it again."""

    connection: int
    log_ns: int
    stamp_ns: int  # of the header; 0 = no stamp
    earlier: int = 0  # number of earlier messages in the file with the same connection and times


class Message(NamedTuple):
    """A decoded message of a recording, with its stream and location."""

    stream: Stream
    location: MessageLocation
    content: Any  # the message's fields, with ROS's names


class TopicMessages(Protocol):
    """Messages of topics: of a recording, or those of a running system that came so far."""

    @property
    def path(self) -> Path | str:
        """Name for messages to people."""

    @property
    def streams(self) -> list[Stream]: ...

    def listing(self) -> str:
        """Return text that lists every topic with its type."""

    def messages(self, streams: Collection[Stream]) -> Iterator[Message | Stream]:
        """Yield messages of some streams in order. For a broken message, yield its stream."""


def first_message(recording: TopicMessages, stream: Stream) -> Any:
    """Return the first readable message of a stream, or None."""
    found = (one.content for one in recording.messages([stream]) if isinstance(one, Message))
    return next(found, None)


def recording(path: Path) -> Path | None:
    """Return the path itself if it is a recording, or the only recording in a folder, or None.

    The first bytes decide what a file is. An `.mcap` of tsfusion's own journal does not count.
    """
    if path.is_file():
        return path if _is_bag(path) else None
    if not path.is_dir():
        return None
    if (path / METADATA).is_file():
        return path
    found = sorted(child for child in path.glob("*.*") if child.suffix in ENDINGS and _is_bag(child))
    return found[0] if len(found) == 1 else None


def _is_bag(path: Path) -> bool:
    start = _opening(path)
    if path.suffix == ".bag":
        return start.startswith(b"#ROSBAG")
    if path.suffix == ".db3":
        return start.startswith(_SQLITE)
    return path.suffix == ".mcap" and start.startswith(bytes(MAGIC)) and not is_segment(path)


def _opening(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            return file.read(len(_SQLITE))
    except OSError:
        return b""


class BagRecording:
    """Messages of a recording. The files stay open as long as this object lives.

    Raises:
        MissingDependency: rosbags is not installed.
        DatasetError: the recording cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._lock = threading.Lock()
        with self._errors():
            self._reader = _reader(path)
            self._reader.open()
        weakref.finalize(self, self._reader.close)
        self._is2 = bool(self._reader.is2)
        self._usual = usual_types(self._is2)
        self._connections: list[Any] = [
            one
            for one in self._reader.connections
            if not self._is2 or one.ext.serialization_format in ("cdr", "")
        ]
        counts: dict[tuple[str, str], int] = {}
        for one in self._connections:
            counts[one.topic, one.msgtype] = counts.get((one.topic, one.msgtype), 0) + one.msgcount
        self.streams = [Stream(*key, count) for key, count in sorted(counts.items()) if count]
        self._warn_if_unindexed()

    def listing(self) -> str:
        """Return text that lists every topic with its type and number of messages, for an error message."""
        shown = ", ".join(
            f"{one.topic} ({one.kind.replace('/msg/', '/')}, {one.messages})" for one in self.streams
        )
        packed = any(map(_PACKETS.search, [one.kind for one in self.streams]))
        cure = "; packets of a LiDAR: its driver makes PointCloud2 of them, record that topic" * packed
        return f"its topics: {shown}{cure}" if shown else "it holds no messages"

    def messages(self, streams: Collection[Stream]) -> Iterator[Message | Stream]:
        """Yield messages of some streams in the order of recording. For a broken message, yield its stream.

        Raises:
            DatasetError: the file ends, or is damaged, before the last message.
        """
        wanted = {(one.topic, one.kind): one for one in streams}
        numbers = {
            i: wanted[one.topic, one.msgtype]
            for i, one in enumerate(self._connections)
            if (one.topic, one.msgtype) in wanted
        }
        by_id: dict[int, dict[int, int]] = {id(self._connections[i].owner): {} for i in numbers}
        for i in numbers:
            by_id[id(self._connections[i].owner)][self._connections[i].id] = i
        if not numbers:
            return
        with self._errors():
            for connection, log_ns, raw in self._raw([self._connections[i] for i in numbers]):
                number = by_id[id(connection.owner)][connection.id]
                stream = numbers[number]
                content = self._content(raw, stream.kind)
                if content is None:
                    yield stream
                else:
                    yield Message(stream, MessageLocation(number, log_ns, stamp_ns(content)), content)

    def read(self, location: MessageLocation) -> Any:
        """Return the message at a location.

        Raises:
            DatasetError: the recording has changed, and the message is gone.
        """
        connection, left = self._connections[location.connection], location.earlier
        with self._lock, self._errors():
            for _, _, raw in self._reader.messages([connection], location.log_ns, location.log_ns + 1):
                content = self._content(raw, connection.msgtype)
                if content is not None and stamp_ns(content) == location.stamp_ns:
                    if not left:
                        return content
                    left -= 1
        raise DatasetError(
            f"{self.path}: the message of {connection.topic} at {location.log_ns} ns is no longer there"
        )

    def _raw(self, connections: list[Any]) -> Iterator[tuple[Any, int, bytes]]:
        """Yield (connection, ns, bytes) in file order. Rosbags would sort by a clock that may step back."""
        (reader,) = self._reader.readers
        if not self._is2:
            entries = chain.from_iterable(reader.indexes[one.id] for one in connections)
            reader.indexes[_FILE_ORDER] = sorted(entries, key=lambda entry: (entry.chunk_pos, entry.offset))
            yield from reader.messages([SimpleNamespace(id=_FILE_ORDER)])
            return
        is_packed = reader.storage.metadata.compression_mode == "message"
        unpack = _bound_unpacking() if is_packed else bytes
        for part in _files(reader):
            own = {
                one.id: named
                for one in part.connections
                for named in connections
                if (named.topic, named.msgtype, named.ext) == (one.topic, one.msgtype, one.ext)
            }
            for number, log_ns, raw in _rows(part, own):
                yield own[number], log_ns, unpack(raw)

    def _content(self, raw: bytes, kind: str) -> Any:
        """Decode a message by the recording's definition of its type, or the usual one; None = broken."""
        store = self._reader.typestore
        if kind not in store.fielddefs:
            store = self._usual
        try:
            return store.deserialize_cdr(raw, kind) if self._is2 else store.deserialize_ros1(raw, kind)
        except Exception as error:  # noqa: BLE001  generated code: what it meets in foreign bytes, it raises
            log.debug("%s: a message of %s: %s", self.path, kind, error)
            return None

    def _warn_if_unindexed(self) -> None:
        for one in _files(self._reader.readers[0]) if self._is2 else ():
            if hasattr(one, "chunks") and not one.chunks and self.streams:
                log.warning(
                    "%s has no index: each frame is looked for from its start; "
                    "`mcap recover FILE -o NEW` makes one",
                    one.path,
                )

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Turn errors of rosbags and its libraries (SQLite, YAML, zstd, lz4, struct) into DatasetError."""
        try:
            yield
        except (DatasetError, MissingDependency):
            raise
        except Exception as error:
            cause = " ".join(str(error).split())[:300] or type(error).__name__
            hint = next((hint for words, hint in _HINTS.items() if words in cause), None)
            raise DatasetError(
                f"{self.path} cannot be read as a ROS recording: {cause}" + (f" ({hint})" if hint else "")
            ) from error


def stamp_ns(content: Any) -> int:
    """Return the nanoseconds of a message's header, or 0 without a header or time."""
    stamp = getattr(getattr(content, "header", None), "stamp", None)
    return 0 if stamp is None else max(0, stamp.sec * 10**9 + stamp.nanosec)


def frame_id(content: Any) -> str:
    """Return the frame named in a message's header, without ROS 1's leading slash."""
    return str(content.header.frame_id).strip("/")


def _reader(path: Path) -> Any:
    with needing(_INSTALL):
        from rosbags.highlevel import AnyReader
    _bound_unpacking()
    bounded = limits.BoundedPath(path)
    return AnyReader([bounded], default_typestore=usual_types(path.suffix != ".bag"))


@cache
def _bound_unpacking() -> Callable[[bytes], bytes]:
    """Make rosbags unpack at most what `core.limits` allows; return the bounded unpacker of zstd."""
    import apsw
    import lz4.frame
    from rosbags.rosbag1 import reader as ros1
    from rosbags.rosbag2 import reader as ros2
    from rosbags.rosbag2 import storage_mcap

    openers = {"bz2": bz2.open, "lz4": lz4.frame.open, "zstd": storage_mcap.zstd.open}
    bounded = {name: partial(limits.unpack, opener) for name, opener in openers.items()}
    ros1.decompressors.update((name, bounded[name]) for name in ("bz2", "lz4"))
    storage_mcap.DECOMPRESSORS.update((name, bounded[name]) for name in ("lz4", "zstd"))

    def whole_zstd(file: Any, mode: str) -> limits.BoundedFile:
        return limits.BoundedFile(openers["zstd"](file, mode), Path(file.raw.name).stat().st_size)

    ros2.Path = limits.BoundedPath
    ros2.zstd = SimpleNamespace(decompress=bounded["zstd"], open=whole_zstd)
    hooks: list[Any] = apsw.connection_hooks
    longest = apsw.SQLITE_LIMIT_LENGTH, limits.MAX_PIECE_BYTES
    hooks.append(lambda connection: connection.limit(*longest))
    return bounded["zstd"]


def _files(reader: Any) -> list[Any]:
    """Return the storage readers of a ROS 2 recording's files, in the order of its parts."""
    return list(getattr(reader.storage, "storages", [reader.storage]))


def _rows(storage: Any, connections: Collection[int]) -> Iterator[tuple[int, int, bytes]]:
    """Yield connection, time (ns) and bytes of the messages in one file, in the file's order."""
    if hasattr(storage, "messages_scan"):
        named = [one for one in storage.connections if one.id in connections]
        yield from ((one.id, log_ns, raw) for one, log_ns, raw in storage.messages_scan(named))
    elif connections:
        places = ",".join("?" * len(connections))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({places}) ORDER BY id"
        yield from storage.dbconn.execute(query, tuple(connections))


def usual_types(is2: bool) -> Any:
    """Return rosbags' types of ROS 2 Humble, whose bytes later versions read too, or of ROS 1 Noetic."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE if is2 else Stores.ROS1_NOETIC)
