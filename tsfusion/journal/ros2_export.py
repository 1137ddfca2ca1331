# SPDX-License-Identifier: MIT
"""Export the keyframes of a journal to one MCAP file of the profile `ros2`."""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from mcap.writer import CompressionType, Writer
from msgspec import Struct

from tsfusion.core import durable_files
from tsfusion.core.errors import DecodeError, InvalidKeyframe, JournalError, OutputError, needing
from tsfusion.core.output_folder import check_writable
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.journal.inspection import JournalFault, problem
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.record_scan import Damage, Erased
from tsfusion.journal.ros2_messages import Converter, Outgoing
from tsfusion.journal.segments import is_segment
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import unpack_keyframe

_INSTALL = "export needs rosbags: pip install '.[ros]' in your clone of tsfusion"
_LAST_SECOND = 2**31 - 1  # of a ROS 2 time stamp


class Export(Struct, kw_only=True):
    """Result of an export. `lost`: keyframes that are not in the file because they are damaged."""

    path: str
    nbytes: int
    keyframes: int
    lost: int
    messages: dict[str, int]  # by topic
    problems: list[JournalFault]


def export(place: JournalPlace, out: Path, watch: OnProgress, *, clouds: bool = False) -> Export:
    """Write every keyframe of a journal as ROS 2 messages; `out` appears when it is complete.

    Args:
        clouds: also write clouds of depth images.

    Raises:
        MissingDependency: rosbags is not installed.
        OutputError: `out` is no .mcap file, belongs to a journal, or cannot be written.
        JournalError: the journal has no keyframe.
    """
    store = _type_store()
    check_writable(out, (".mcap",))
    of_this = {path.resolve() for path in place.files()}
    if out.resolve() in of_this or out.resolve().parent == place.path.resolve() or _is_one(out):
        raise OutputError(f"cannot write {out}: it is in a journal; choose another name")
    with durable_files.written(out) as stream:
        final = JournaledKeyframes(place, tells=False)
        exporter = _Exporter(_BagWriter(stream, store), Converter(store.types, clouds=clouds), final)
        exporter.run(place, watch)
    return exporter.result(out)


def _is_one(path: Path) -> bool:
    """Return True if the output file exists and is a journal's segment, which must not be replaced."""
    return path.is_file() and durable_files.size_of(path) > 0 and is_segment(path)


def _type_store() -> Any:
    with needing(_INSTALL):
        from rosbags.typesys import Stores, get_typestore
    return get_typestore(Stores.ROS2_HUMBLE)


class _BagWriter:
    """Writes an MCAP file; a channel is added with its first message."""

    def __init__(self, stream: IO[bytes], store: Any) -> None:
        self._store = store
        self._writer: Any = Writer(stream, compression=CompressionType.ZSTD)
        self._writer.start(profile="ros2", library="tsfusion")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        self.messages: Counter[str] = Counter()

    def write(self, message: Outgoing, stamp_ns: int) -> None:
        """Add a ROS message with this time stamp."""
        content = bytes(self._store.serialize_cdr(message.content, message.kind))
        self._writer.add_message(
            self._channel(message), stamp_ns, content, stamp_ns, sequence=self.messages[message.topic]
        )
        self.messages[message.topic] += 1

    def _channel(self, message: Outgoing) -> int:
        if message.kind not in self._schemas:
            text = self._store.generate_msgdef(message.kind, ros_version=2)[0]
            self._schemas[message.kind] = self._writer.register_schema(message.kind, "ros2msg", text.encode())
        if message.topic not in self._channels:
            self._channels[message.topic] = self._writer.register_channel(
                message.topic, "cdr", self._schemas[message.kind], {"offered_qos_profiles": ""}
            )
        return self._channels[message.topic]

    def finish(self) -> None:
        """Write the index of the MCAP file."""
        self._writer.finish()


class _Exporter:
    def __init__(self, bag: _BagWriter, converter: Converter, final: JournaledKeyframes) -> None:
        self._bag = bag
        self._converter = converter
        self._final = final
        self._names: dict[bytes, str] = {}
        self._has_clock: dict[bytes, bool] = {}  # by session
        self._first: dict[bytes, tuple[Path, Record]] = {}
        self._seen: set[tuple[bytes, int]] = set()
        self._stamps: set[tuple[bytes, int]] = set()
        self._problems: list[JournalFault] = []
        self._keyframes = 0

    def run(self, place: JournalPlace, watch: OnProgress) -> None:
        """Write every intact keyframe that the final map holds, once, at its final pose."""
        for path, step in place.steps(watch):
            if isinstance(step, Damage):
                if not isinstance(step, Erased):
                    self._problems.append(problem(path, step))
            elif (step.session, step.seq) in self._final.left_out:
                continue
            elif not step.is_correction and (step.session, step.seq) not in self._seen:
                self._seen.add((step.session, step.seq))
                self._add(path, step)
        for path, record in self._first.values():
            self._write(path, record)
        if not self._keyframes:
            raise JournalError(f"no keyframes in {place.path}; `tsfusion journal info` says what it holds")
        self._bag.finish()

    def _add(self, path: Path, record: Record) -> None:
        """Write a keyframe, or keep the first one until the next shows if the session has a sensor's clock.

        Time 0 in a first keyframe is ambiguous: the clock may start with it, or the sensor may have no clock.
        """
        try:
            has_stamp = unpack_keyframe(record.frames[0]).timestamp_ns > 0
        except (DecodeError, IndexError) as error:
            self._refuse(path, record, error)
            return
        first = self._first.pop(record.session, None)
        if record.session not in self._has_clock:
            if not has_stamp and first is None:
                self._first[record.session] = path, record
                return
            self._has_clock[record.session] = has_stamp
        if first is not None:
            self._write(*first)
        self._write(path, record)

    def _write(self, path: Path, record: Record) -> None:
        try:
            keyframe = codec.decode_keyframe(record.frames)
        except (DecodeError, InvalidKeyframe) as error:
            self._refuse(path, record, error)
            return
        T = self._final.pose_of(record.session, record.seq)
        if T is not None:  # unknown if only the pose in its header is damaged
            keyframe = replace(keyframe, T_world_camera=T)
        stamp_ns = keyframe.timestamp_ns if self._has_clock.get(record.session) else record.logged_ns
        if stamp_ns // 10**9 > _LAST_SECOND:
            stamp_ns = min(record.logged_ns, _LAST_SECOND * 10**9)
        while (record.session, stamp_ns) in self._stamps:  # a reader would merge two keyframes of equal time
            stamp_ns += 1
        self._stamps.add((record.session, stamp_ns))
        header = unpack_keyframe(record.frames[0])
        for message in self._converter.convert(keyframe, header, record, self._name(record), stamp_ns):
            self._bag.write(message, stamp_ns)
        self._keyframes += 1

    def _refuse(self, path: Path, record: Record, error: Exception) -> None:
        at = record.position.offset
        self._problems.append(
            JournalFault("damage", path.name, at, record.nbytes, 1, f"no keyframe: {error}")
        )

    def _name(self, record: Record) -> str:
        """Return a session's ROS name: its client's name, with a number from the second session on."""
        if record.session not in self._names:
            base = re.sub(r"[^A-Za-z0-9_]", "_", record.client) or "scanner"
            base = base if base[0].isalpha() else f"scanner_{base}"
            taken, number, name = set(self._names.values()), 1, base
            while name in taken:
                number += 1
                name = f"{base}_{number}"
            self._names[record.session] = name
        return self._names[record.session]

    def result(self, out: Path) -> Export:
        """Return a report of what has been written to `out`."""
        return Export(
            path=str(out),
            nbytes=out.stat().st_size,
            keyframes=self._keyframes,
            lost=sum(one.lost for one in self._problems),
            messages=dict(sorted(self._bag.messages.items())),
            problems=self._problems,
        )
