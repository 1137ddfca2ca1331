# SPDX-License-Identifier: MIT
"""The gateway: everything that must answer while a kernel runs.

A Taichi kernel holds its process for as long as it takes, so this is another one. Each message is checked,
journaled and acknowledged in one step; the fuser is told only where it lies in the journal.
"""

import logging
import secrets
import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import zmq

from tsfusion import codec, process
from tsfusion.config import DEFAULT_MAP, ServerConfig
from tsfusion.errors import DecodeError, JournalError
from tsfusion.fuser_link import FuserLink
from tsfusion.journal import Journal
from tsfusion.ports import Departures, Ports, each, send_now
from tsfusion.sessions import Delays, KeyframeIndex, Sessions
from tsfusion.transport import messages, sockets, work
from tsfusion.transport.sockets import MESH_TOPIC

log = logging.getLogger(__name__)

_TICK_MS = 100  # how long a signal or a fuser's death may go unnoticed
_MAX_QUESTIONS = 32


class Gateway:
    """One server's state between clients, journal and fuser. Call `step` for ever."""

    def __init__(self, server: ServerConfig, ports: Ports, journal: Journal, fuser: FuserLink) -> None:
        self.ports = ports
        self.fuser = fuser
        self.epoch = secrets.token_hex(8)
        self.warm = False  # the fuser has been ready once
        self._server = server
        self._journal = journal
        self._sessions = Sessions()
        self._index = KeyframeIndex()
        self._index.recover(journal.found, self._sessions)
        journal.found = []
        self._delays = Delays()
        self._meshed = -1
        self._refused: Counter[str] = Counter()
        self._duplicates = 0
        self._questions: dict[int, tuple[bytes, str]] = {}
        self._question_count = 0
        self._meshes = Departures()
        self._topics: set[bytes] = set()  # that somebody subscribed to
        self._watched: bool | None = None  # what the fuser knows of it
        self._accepting = True
        self._started = time.monotonic()

    @property
    def drained(self) -> bool:
        """Whether the map has every keyframe of the journal."""
        return self.fuser.idle and self.fuser.next_index == len(self._index)

    def stop_accepting(self) -> None:
        """Take no more keyframes; clients keep what is not acknowledged."""
        self._accepting = False
        self.ports.keyframes.close()

    def step(self) -> None:
        """Wait for something to happen (a moment at most) and deal with it.

        Raises:
            TsfusionError: when the fuser cannot be kept alive.
        """
        handlers: dict[sockets.AnySocket, Callable[[list[zmq.Frame]], None]] = {
            self.ports.control: self._on_control,
            self.ports.publish: self._on_subscription,
        }
        if self._accepting:
            handlers[self.ports.keyframes] = self._on_keyframe
        polled = [(socket, zmq.POLLIN) for socket in (self.fuser.socket, *handlers)]
        events = dict(zmq.zmq_poll(polled, _TICK_MS))
        for socket, handle in handlers.items():
            if socket in events:
                each(socket, handle)
        self._hear_fuser()
        watched = bool(self._topics)
        if self.fuser.ready and watched != self._watched and self.fuser.send(work.Publish(watched)):
            self._watched = watched
        while self.fuser.wants_work and self.fuser.next_index < len(self._index):
            if not self.fuser.fuse(self._index[self.fuser.next_index].position):
                break

    # --- keyframes ---

    def _on_keyframe(self, frames: list[zmq.Frame]) -> None:
        received_ns = time.monotonic_ns()
        buffers = [frame.buffer for frame in frames]
        try:
            header = codec.check(buffers, self._server.max_frame_bytes)
        except codec.Refused as error:
            self._refuse(buffers, error)
            return
        verdict = self._sessions.admit(header.session, header.seq, header.previous)
        if verdict != "next":
            self._duplicates += verdict == "duplicate"
            self._refused["gap"] += verdict == "gap"
            self._ack(header.session, resend=verdict == "gap")
            return
        try:
            position = self._journal.append(buffers, session=header.session, seq=header.seq)
        except JournalError as error:
            log.error("keyframe %d is not accepted: %s", header.seq, error)
            self._refused["journal"] += 1
            return
        session = self._sessions.open(header.session)
        session.durable = header.seq
        durable_ns = time.monotonic_ns()
        self._index.add(
            position,
            session,
            header.seq,
            captured_ns=header.captured_ns,
            received_ns=received_ns,
            durable_ns=durable_ns,
        )
        self._ack(header.session, [messages.Stamps(header.seq, received_ns, durable_ns)])

    def _refuse(self, frames: Sequence[Any], error: codec.Refused) -> None:
        """Count a bad message; answer it when it says whose it is, so that it is not sent for ever."""
        self._refused[error.reason] += 1
        log.warning("a message is refused (%s): %s", error.reason, error)
        try:
            header = codec.unpack(frames[0])
        except (codec.Refused, IndexError):
            return
        session = self._sessions.get(header.session)
        if session is not None and session.admit(header.seq, header.previous) == "next":
            session.durable = header.seq
        self._send(
            header.session,
            messages.Nack(header.session, header.seq, "door", error.reason, str(error)),
        )

    # --- control ---

    def _on_control(self, frames: list[zmq.Frame]) -> None:
        identity, *rest = (frame.bytes for frame in frames)
        try:
            message = messages.decode_to_server(b"".join(rest))
        except DecodeError as error:
            self._refused["control"] += 1
            log.debug("%s", error)
            return
        if isinstance(message, messages.Command):
            self._on_command(identity, message)
        elif isinstance(message, messages.Hello):
            self._sessions.connect(message.session, identity)
            self._answer(identity, self._welcome(message.session))
        else:
            self._on_ping(identity, message)

    def _welcome(self, key: bytes) -> messages.Welcome:
        session = self._sessions.get(key)
        return messages.Welcome(
            epoch=self.epoch,
            version=codec.VERSION,
            durable=session.durable if session else 0,
            fused=session.fused if session else 0,
            window_keyframes=self._server.window_keyframes,
            window_bytes=self._server.window_bytes,
            max_frame_bytes=self._server.max_frame_bytes,
        )

    def _on_ping(self, identity: bytes, ping: messages.Ping) -> None:
        received_ns = time.monotonic_ns()
        route = self._sessions.heard(ping.session) or self._sessions.connect(ping.session, identity)
        route.offset_ns = ping.offset_ns
        session = self._sessions.get(ping.session)
        durable, fused = (session.durable, session.fused) if session else (0, 0)
        pong = messages.Pong(self.epoch, ping.sent_ns, received_ns, time.monotonic_ns(), durable, fused)
        self._answer(identity, pong)

    def _on_command(self, identity: bytes, command: messages.Command) -> None:
        if command.name == "ping":
            self._answer(identity, messages.Reply(name="ping"))
        elif busy := self._ask(identity, command):
            self._answer(identity, messages.Reply(name=command.name, error=busy))

    def _ask(self, identity: bytes, command: messages.Command) -> str:
        """Pass a question to the fuser; or say why not."""
        question = (identity, command.name)
        if not self.fuser.ready:
            return "the fuser restarts; ask again"
        if command.name == "mesh" and (
            question in self._questions.values() or self._meshes.pending(identity)
        ):
            return "the mesh that was asked for before is still on its way"
        self._question_count += 1
        if len(self._questions) >= _MAX_QUESTIONS or not self.fuser.send(
            work.Ask(self._question_count, command)
        ):
            return "too many questions at once"
        self._questions[self._question_count] = question
        return ""

    def _on_subscription(self, frames: list[zmq.Frame]) -> None:
        change, topic = frames[0].bytes[:1], frames[0].bytes[1:]
        if change == b"\x01" and MESH_TOPIC.startswith(topic):
            self._topics.add(topic)
        elif change == b"\x00":
            self._topics.discard(topic)
        elif change != b"\x01":
            self._refused["subscription"] += 1

    # --- fuser ---

    def _hear_fuser(self) -> None:
        ended = self.fuser.ended()  # before its last words are read
        while (heard := self.fuser.receive()) is not None:
            message, frames = heard
            if isinstance(message, work.Done):
                self._on_done(message)
            elif isinstance(message, work.Meshed):
                self._on_meshed(message, frames)
            elif isinstance(message, work.Answer):
                self._on_answer(message, frames)
            elif isinstance(message, work.Ready):
                self._on_ready(message)
        if ended and not self.fuser.finishing:
            for identity, name in self._questions.values():
                self._answer(identity, messages.Reply(name=name, error="the fuser restarts; ask again"))
            self._questions.clear()
            self.fuser.restart()

    def _on_ready(self, ready: work.Ready) -> None:
        self.fuser.next_index = self._index.after(ready.position)
        if not self.warm:
            self.warm = True
            self._journal.begin_after(ready.position.segment)
            self._meshed = self.fuser.next_index - 1
            for index in range(self.fuser.next_index):
                entry = self._index[index]
                self._sessions.numbered(entry.session).fused = entry.stamps.seq
        self._watched = None

    def _on_done(self, done: work.Done) -> None:
        again = self._index[done.index].stamps.fused_ns  # by a fuser that died before its checkpoint
        if again:
            return
        self._index.fused(done.index, done.fuse_start_ns, done.fused_ns)
        entry = self._index[done.index]
        session = self._sessions.numbered(entry.session)
        session.fused = entry.stamps.seq
        if done.reason is not None:
            log.warning("keyframe %d is not in the map (%s): %s", done.index, done.reason, done.message)
            self._send(
                session.key, messages.Nack(session.key, session.fused, "map", done.reason, done.message)
            )
        else:
            route = self._sessions.route(session.key)
            self._delays.add(entry.captured_ns, done.fused_ns, route.offset_ns if route else None)
        self._ack(session.key, [entry.stamps])

    def _on_meshed(self, meshed: work.Meshed, frames: Sequence[zmq.Frame]) -> None:
        for index in range(self._meshed + 1, meshed.index + 1):
            entry = self._index[index]
            stamps = msgspec.structs.replace(entry.stamps, meshed_ns=meshed.meshed_ns)
            self._ack(self._sessions.numbered(entry.session).key, [stamps])
        self._meshed = max(self._meshed, meshed.index)
        if frames:
            self._publish([MESH_TOPIC, work.encode(meshed), *frames])

    def _on_answer(self, answer: work.Answer, frames: Sequence[zmq.Frame]) -> None:
        identity, name = self._questions.pop(answer.number, (b"", ""))
        status = self._status(answer.status) if answer.status is not None else None
        reply = messages.Reply(name=name, error=answer.error, status=status, mesh=answer.layout)
        self._answer(identity, reply, self._meshes.wrap(identity, frames) if frames else ())

    def _status(self, fuser: work.FuserStatus) -> messages.Status:
        return messages.Status(
            epoch=self.epoch,
            map=DEFAULT_MAP,
            state=self._server.state,
            fuser="idle" if self.drained else "busy",
            uptime_s=time.monotonic() - self._started,
            keyframes_durable=len(self._index),
            keyframes_fused=fuser.keyframes_fused,
            keyframes_rejected=fuser.keyframes_rejected,
            messages_refused=dict(self._refused),
            duplicates=self._duplicates,
            sessions=len(self._sessions),
            blocks=fuser.blocks,
            voxels=fuser.voxels,
            map_bytes=fuser.map_bytes,
            map_hash=fuser.map_hash,
            color_hash=fuser.color_hash,
            journal_bytes=self._journal.nbytes,
            journal_damaged=self._journal.damaged,
            fuser_restarts=self.fuser.restarts,
            peak_rss_bytes={"server": process.peak_rss_bytes(), "fuser": fuser.peak_rss_bytes},
            delay_ms=self._delays.summary(),
            config={"server": msgspec.to_builtins(self._server), "volume": fuser.config},
            versions=fuser.versions,
        )

    # --- sending: an answer that cannot leave at once is dropped, the asker will ask again ---

    def _ack(self, key: bytes, stamps: Sequence[messages.Stamps] = (), *, resend: bool = False) -> None:
        session = self._sessions.get(key)
        durable, fused = (session.durable, session.fused) if session else (0, 0)
        self._send(key, messages.Ack(key, durable, fused, tuple(stamps), resend))

    def _send(self, key: bytes, message: messages.ToClient) -> None:
        route = self._sessions.route(key)
        if route is not None:
            self._answer(route.identity, message)

    def _answer(self, identity: bytes, message: messages.ToClient, frames: Sequence[zmq.Frame] = ()) -> None:
        send_now(self.ports.control, [identity, messages.encode(message), *frames])

    def _publish(self, frames: list[Any]) -> None:
        send_now(self.ports.publish, frames)
