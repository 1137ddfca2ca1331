# SPDX-License-Identifier: MIT
"""Pass clients' requests (a question, the mesh, the status) on to a map's fuser, and send its answers.

The fuser answers a question between two pieces of its work, so a question waits for milliseconds. After its
deadline a question is refused, whatever the fuser does. The fuser makes a mesh or a status between two
keyframes, and these have no deadline.

A client has limits: requests under way, questions a second, bytes of unread answers. A mesh costs the fuser's
time and the gateway's memory, and costs the client nothing. So one mesh of a map is made at a time, with
pauses while keyframes come.
"""

import time
from collections import Counter, OrderedDict
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zmq
from msgspec import Struct

from tsfusion.core import process
from tsfusion.core.config import ServerConfig
from tsfusion.core.limits import Bucket
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.map_records import QuestionCounts
from tsfusion.gateway.people.scan_updates import ScanUpdates
from tsfusion.gateway.ports.connections import PendingReplies
from tsfusion.gateway.ports.ports import OutgoingAnswer
from tsfusion.geometry import map_questions
from tsfusion.geometry.map_questions import crc_of
from tsfusion.wire.messages import messages, questions
from tsfusion.wire.messages.health import Health, MapCounts, Status
from tsfusion.wire.messages.questions import Answer, Following, MapVersion, Scans

MOST_WAITING = 32  # requests of one kind to one map: the gateway checks the size of each answer
MOST_OF_A_CLIENT = 4  # open questions
MOST_VIEWERS = 64  # of one map
# Unread answers of a client: on a busy machine, ZeroMQ may report late that an answer has left
MOST_UNREAD = 64
_UNREAD_SHARE = 1 / 4  # of the memory of all unread answers; four of any size can wait
_MOST_CLIENTS = 4096
_MOST_DEFERRED = 256  # commands that wait for their map to open: those of all its viewers
_MOST_LARGE = 32  # of them: with points, or keyframes to forget
_WAIT_SHARE = 0.9  # share of a command's time that it waits for its map
_REST_FACTOR = 3  # a pause of three times the last mesh's time: meshes get a quarter of a busy fuser
_NEVER_NS = (1 << 63) - 1
_FULL = "answers that others asked for and do not read fill the memory"


class WaitingRequest(Struct, frozen=True):
    """Client's request that was passed on to a fuser and is not answered yet."""

    identity: bytes  # the connection that asked
    reader: bytes  # the client; without keys the connection
    owner: bytes  # the reader, or one connection of it for a viewer, which has limits of its own
    kind: str  # requests of one kind count together
    command: messages.Command
    asked_ns: int  # `time.monotonic_ns()`
    deadline_ns: int
    counts: QuestionCounts  # of its map; only questions count
    most_bytes: int  # of the answer; of a mesh, those of the map's last mesh

    def message(self, number: int) -> fuser_messages.FuserQuestion:
        return fuser_messages.FuserQuestion(number, self.command, self.asked_ns, self.deadline_ns)


class _LastMesh(NamedTuple):
    asked_s: float  # `time.monotonic()`
    rest_until_s: float  # until this time a map that gets keyframes makes no other mesh
    nbytes: int


class Requests:
    """Requests that fusers have not answered yet, and their limits. Call `step` again and again."""

    def __init__(
        self,
        out: list[OutgoingAnswer],
        metrics: Metrics,
        refused: Counter[str],
        unread: PendingReplies,
        *,
        rate: float,
        scans: ScanUpdates,
    ) -> None:
        self.scans = scans
        self._out, self._metrics, self._refused, self._unread = out, metrics, refused, unread
        self._rate = rate
        self._waiting: dict[int, WaitingRequest] = {}
        self._numbers = count(1)
        self._rates: OrderedDict[bytes, Bucket] = OrderedDict()
        self._last_meshes: dict[str, _LastMesh] = {}

    @property
    def nbytes(self) -> int:
        """Bytes of replies that clients have not read, up to the limit for them."""
        return min(self._unread.nbytes, max(self._unread.max_bytes, self._unread.largest))

    def submit(
        self,
        identity: bytes,
        command: messages.Command,
        frames: list[memoryview],
        hosted: HostedMap | None,
        client: str = "",
    ) -> None:
        """Pass a request on to the map's fuser, or reply why not."""
        waiting = self._waiting_for(identity, command, hosted, client)
        if hosted is None:
            self._refuse(waiting, f"no map {command.map} is open")
        elif command.name == "ask" and (problem := _why_invalid(command, frames)):
            self._refuse(waiting, problem)
        elif hosted.fuser.failed and not hosted.fuser.ready:
            self._refuse(waiting, hosted.fuser.failed)
        elif problem := self._pass_on(waiting, frames, hosted):
            self._refuse(waiting, problem, retry=True)

    def _waiting_for(
        self, identity: bytes, command: messages.Command, hosted: HostedMap | None, client: str
    ) -> WaitingRequest:
        now_ns, deadline_ns, most_bytes, counts = time.monotonic_ns(), _NEVER_NS, 0, QuestionCounts()
        owner = reader = client.encode() or identity
        kind = str(command.name)
        if command.name == "ask":
            deadline_ns = now_ns + int(1e9 * max(0.0, min(map_questions.LONGEST_S, command.timeout_s)))
            if isinstance(command.question, Following):  # `on_answer` looks at the size
                owner, kind = reader + b"\0" + identity, type(command.question).__name__
            elif hosted is not None:
                most_bytes, counts = getattr(command.question, "most_bytes", 0), hosted.questions
        elif command.name == "mesh" and command.map in self._last_meshes:
            most_bytes = self._last_meshes[command.map].nbytes
        who = identity, reader, owner
        return WaitingRequest(*who, kind, command, now_ns, deadline_ns, counts, most_bytes)

    def _pass_on(self, waiting: WaitingRequest, frames: list[memoryview], hosted: HostedMap) -> str:
        """Send a request to the fuser. Return the reason why that is not possible now, or ""."""
        name = waiting.command.name
        if not hosted.fuser.ready:
            return "the map is being opened, or its fuser restarts"
        question = waiting.command.question
        alike = [one for one in self._waiting.values() if one.kind == waiting.kind]
        of_client = sum(one.owner == waiting.owner for one in alike)
        of_map = sum(one.command.map == waiting.command.map for one in alike)
        if name == "ask" and (problem := self._why_no_question(waiting, of_client)):
            return problem
        if name == "mesh" and (problem := self._why_no_mesh(waiting, hosted, of_client, of_map)):
            return problem
        if name != "status" and self._is_full(sum(one.most_bytes for one in alike), waiting.most_bytes):
            return _FULL
        is_viewer = isinstance(question, Following)
        if of_map >= (MOST_VIEWERS if is_viewer else MOST_WAITING) and not (
            is_viewer and self._make_room_for(waiting)
        ):
            return "too many questions at once"
        number = next(self._numbers)
        if isinstance(question, Scans):
            self.scans.ask(number, waiting.command.map, question, waiting.deadline_ns / 1e9)
        elif not hosted.fuser.send(waiting.message(number), frames):
            return "too many questions at once"
        if name == "ask":
            self._rate_of(waiting.owner).spend(1.0)
        self._waiting[number] = waiting
        return ""

    def _make_room_for(self, waiting: WaitingRequest) -> bool:
        """Let another key's viewer of the map yield. Return False if none has more viewers than this one."""
        kind, name = waiting.kind, waiting.command.map
        numbers = [n for n, one in self._waiting.items() if one.kind == kind and one.command.map == name]
        place = place_to_yield([self._waiting[number].reader for number in numbers], waiting.reader)
        if place is not None:
            self._refuse(self._waiting.pop(numbers[place]), "too many questions at once", retry=True)
        return place is not None

    def _is_full(self, expected: int, more: int) -> bool:
        """True if unread and expected answers leave no memory for `more` bytes."""
        held = self._unread.nbytes + expected
        return held > 0 and held + more > self._unread.max_bytes

    def _why_no_question(self, waiting: WaitingRequest, under_way: int) -> str:
        """Return the reason why this client cannot ask a question now, or ""."""
        if self._rate_of(waiting.owner).wait(1.0, time.monotonic()):
            return f"a client may ask {self._rate:g} questions a second (quota_questions)"
        if under_way >= MOST_OF_A_CLIENT:
            return f"{MOST_OF_A_CLIENT} questions of this client are under way"
        unread, nbytes = self._unread.of(waiting.reader + b"\0")
        is_much = unread >= MOST_OF_A_CLIENT and nbytes > _UNREAD_SHARE * self._unread.max_bytes
        if is_much or self._unread.of(waiting.owner + b"\0")[0] >= MOST_UNREAD:
            return f"{unread} answers of this client are not read yet"
        return ""

    def _why_no_mesh(self, waiting: WaitingRequest, hosted: HostedMap, of_client: int, of_map: int) -> str:
        """Return the reason why this mesh cannot be made now, or ""."""
        if of_client or self._unread.of(waiting.owner + b"\1")[0]:
            return "the mesh that was asked for before is still on its way"
        if of_map:
            return "another mesh is being made"
        last = self._last_meshes.get(waiting.command.map)
        if last and time.monotonic() < last.rest_until_s and not hosted.idle_since(last.asked_s):
            return "a mesh was just made, now it is the keyframes' turn"
        return ""

    def _rate_of(self, owner: bytes) -> Bucket:
        bucket = self._rates.pop(owner, None) or Bucket(self._rate, time.monotonic())
        self._rates[owner] = bucket
        if len(self._rates) > _MOST_CLIENTS:
            self._rates.popitem(last=False)
        return bucket

    def on_answer(
        self, answer: fuser_messages.FuserAnswer, frames: Sequence[zmq.Frame], status: Status | None = None
    ) -> None:
        """Send a fuser's answer to the connection that asked, unless the request was refused before."""
        waiting = self._waiting.pop(answer.number, None)
        if waiting is None:
            return
        command, reader, now_s = waiting.command, waiting.owner, time.monotonic()
        took_s = now_s - waiting.asked_ns / 1e9
        if command.name == "mesh":
            nbytes = sum(frame.buffer.nbytes for frame in frames)
            rest_until_s = now_s + _REST_FACTOR * took_s
            self._last_meshes[command.map] = _LastMesh(waiting.asked_ns / 1e9, rest_until_s, nbytes)
        if answer.error:
            waiting.counts.add("late" if answer.late else "failed")
            self._reply_error(waiting, answer.error, late=answer.late)
            return
        is_viewer = isinstance(command.question, Following)
        if is_viewer and self._is_full(0, sum(len(one) for one in frames)):
            self._refuse(waiting, _FULL, retry=True)
            return
        if command.name == "ask":
            waiting.counts.add("answered", took_s)
            if not is_viewer:  # which may wait for news
                self._metrics.observe_question(command.map, took_s)
            reader += b"\0" + answer.number.to_bytes(8, "big")
        else:
            reader += b"\1"
        reply = messages.Reply(
            name=command.name, number=command.number, answer=answer.answer, mesh=answer.mesh, status=status
        )
        kept = self._unread.wrap(reader, frames) if frames else ()
        self._out.append(OutgoingAnswer(waiting.identity, reply, kept))

    def step(self) -> None:
        """Answer viewers which keyframes came. Refuse the questions whose deadline is over."""
        for number, found in self.scans.step():
            arrays = {"scans": np.frombuffer(msgspec.msgpack.encode(found), np.uint8)}
            layouts, frames = questions.pack(arrays, compress=False)
            state = MapVersion(keyframes=0, epoch=found.epoch)
            answer = Answer(arrays=layouts, state=state, crc=crc_of(frames))
            self.on_answer(fuser_messages.FuserAnswer(number, answer), [zmq.Frame(one) for one in frames])
        now_ns = time.monotonic_ns()
        for number, waiting in list(self._waiting.items()):
            if now_ns > waiting.deadline_ns:
                del self._waiting[number]
                waiting.counts.add("late")
                self._reply_error(waiting, questions.LATE, late=True)

    def give_up(self, map_name: str) -> None:
        """Refuse the unanswered requests to a map, because its fuser has ended."""
        self._last_meshes.pop(map_name, None)
        for number, waiting in list(self._waiting.items()):
            if waiting.command.map == map_name:
                del self._waiting[number]
                waiting.counts.add("failed")
                self._reply_error(waiting, "the fuser restarts; ask again", retry=True)

    def _refuse(self, waiting: WaitingRequest, problem: str, *, retry: bool = False) -> None:
        if waiting.command.name == "ask":
            self._refused["question"] += 1
        waiting.counts.add("refused")
        self._reply_error(waiting, f"{problem}; ask again" if retry else problem, retry=retry)

    def _reply_error(
        self, waiting: WaitingRequest, error: str, *, retry: bool = False, late: bool = False
    ) -> None:
        name, number = waiting.command.name, waiting.command.number
        reply = messages.Reply(name=name, number=number, error=error, retry=retry, late=late)
        self._out.append(OutgoingAnswer(waiting.identity, reply))


class _Deferred(NamedTuple):
    map: str
    until_s: float  # `time.monotonic()`
    reader: bytes
    is_large: bool
    run: Callable[[], None]


class DeferredCommands:
    """Commands that wait for their map to open, the longest-waiting first. Call `step` again and again."""

    def __init__(self) -> None:
        self._waiting: list[_Deferred] = []

    def add(
        self, command: messages.Command, reader: bytes, run: Callable[[], None], *, has_points: bool
    ) -> bool:
        """Keep a command, to `run` it later. Return False if too many wait, and no other reader yields."""
        is_large = has_points or command.selection is not None
        alike = [one for one in self._waiting if one.is_large] if is_large else self._waiting
        if len(alike) >= (_MOST_LARGE if is_large else _MOST_DEFERRED):
            if (place := place_to_yield([one.reader for one in alike], reader)) is None:
                return False
            self._run(alike[place])
        until_s = time.monotonic() + _WAIT_SHARE * min(map_questions.LONGEST_S, command.timeout_s)
        self._waiting.append(_Deferred(command.map, until_s, reader, is_large, run))
        return True

    def _run(self, one: _Deferred) -> None:
        self._waiting.remove(one)
        one.run()

    def step(self, opens: Callable[[str], bool]) -> None:
        """Run the commands whose time is over, or whose map does not open any more: it is open, or failed."""
        now = time.monotonic()
        for one in [one for one in self._waiting if now > one.until_s or not opens(one.map)]:
            self._run(one)


def place_to_yield(readers: Sequence[bytes], asker: bytes) -> int | None:
    """Return the first place of the reader that has most places, or None if the asker would have as many.

    Args:
        readers: reader of each place, the longest-waiting first.
    """
    counts = Counter(readers)
    reader, most = counts.most_common(1)[0]
    return readers.index(reader) if most > counts[asker] + 1 else None


def _why_invalid(command: messages.Command, frames: list[memoryview]) -> str:
    """Return the reason why a question is invalid, or ""."""
    if command.question is None:
        return "nothing was asked"
    if not 0 < command.timeout_s <= map_questions.LONGEST_S:
        return f"a question may wait up to {map_questions.LONGEST_S:g} s, got {command.timeout_s:g}"
    return command.question.problem(frames)


def status_of(hosted: HostedMap, figures: dict[str, Any], own: Health, server: ServerConfig) -> Status:
    """Return a map's status, from the fuser's answer (`FuserAnswer.figures`) and the gateway's health."""
    counts = {name: getattr(own.maps[hosted.name], name) for name in MapCounts.__struct_fields__}
    found = counts | figures  # the fuser's counts are newer
    found |= {
        "peak_rss_bytes": {"server": process.peak_rss_bytes(), "fuser": figures["peak_rss_bytes"]},
        "config": {"server": msgspec.to_builtins(server), "volume": figures["config"]},
    }
    return Status(
        epoch=own.epoch,
        map=hosted.name,
        state=str(hosted.records.folder),
        fuser="idle" if hosted.drained else "busy",
        uptime_s=own.uptime_s,
        messages_refused=own.refused,
        duplicates=own.duplicates,
        **found,
    )
