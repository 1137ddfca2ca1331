# SPDX-License-Identifier: MIT
"""What people ask a map's fuser: passed on, answered when it answers, given up when it dies.

A mesh takes the fuser's time and our memory, and costs the asker nothing: there is one at a time, with
pauses while keyframes come, and only so much of what was made may wait to be read.
"""

import time
from collections.abc import Sequence
from typing import Protocol

import msgspec
import zmq
from msgspec import Struct

from tsfusion.core import process
from tsfusion.core.config import ServerConfig
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.hosted_map import HostedMap
from tsfusion.gateway.memory_guard import PendingReplies
from tsfusion.wire import health, messages
from tsfusion.wire.health import Health, Status

_MAX_QUESTIONS = 32
_KEYFRAMES_SHARE = 3  # a mesh, then three times as long none: a quarter of a busy fuser's time
_RESTARTS = f"the fuser restarts; {messages.ASK_AGAIN}"


class SendReply(Protocol):
    """How an answer leaves."""

    def __call__(self, identity: bytes, message: messages.ToClient, frames: Sequence[zmq.Frame] = ()) -> None:
        """To this connection."""


class Asked(Protocol):
    """A map that is open."""

    @property
    def fuser(self) -> FuserSupervisor:
        """What answers."""

    def calm(self, since: float) -> bool:
        """Whether no keyframe waits, nor came since then (`time.monotonic()`)."""


class Question(Struct, frozen=True):
    """Who asked what of which map, and when. `owner`: the client, or without keys the connection."""

    identity: bytes
    owner: bytes
    command: messages.Command
    asked: float


class Made(Struct, frozen=True):
    """The last mesh of a map that was made on request. `rest_until`: no other, if keyframes come."""

    nbytes: int
    asked: float
    rest_until: float


class FuserQueries:
    """Those that are not answered yet, a few.

    Args:
        most_bytes: of meshes that wait to be read; a single one may be larger.
    """

    def __init__(self, answer: SendReply, most_bytes: int) -> None:
        self._answer = answer
        self._most_bytes = most_bytes
        self._open: dict[int, Question] = {}
        self._count = 0
        self._meshes = PendingReplies()
        self._made: dict[str, Made] = {}

    @property
    def nbytes(self) -> int:
        """What waits to be read by those who asked for it, as far as it may."""
        return min(self._meshes.nbytes, max(self._most_bytes, self._meshes.largest))

    def ask(self, identity: bytes, command: messages.Command, asked: Asked | None, client: str = "") -> None:
        """Pass a question on; or say why not.

        Args:
            asked: the map; None = it is not open.
            client: the name that the asker's key is allowed under; empty without keys.
        """
        question = Question(identity, client.encode() or identity, command, time.monotonic())
        if problem := self._pass_on(question, asked):
            self._answer(identity, messages.Reply(name=command.name, error=problem))

    def _pass_on(self, question: Question, asked: Asked | None) -> str:
        if asked is None:
            return f"no map {question.command.map} is open"
        if not asked.fuser.ready:
            return asked.fuser.failed or _RESTARTS
        if question.command.name == "mesh" and (problem := self._no_mesh(question, asked)):
            return problem
        self._count += 1
        if len(self._open) >= _MAX_QUESTIONS or not asked.fuser.send(
            fuser_messages.FuserQuery(self._count, question.command)
        ):
            return f"too many questions at once; {messages.ASK_AGAIN}"
        self._open[self._count] = question
        return ""

    def _no_mesh(self, question: Question, asked: Asked) -> str:
        """Why this mesh is not to be made now; empty = it may."""
        under_way = [one for one in self._open.values() if one.command.name == "mesh"]
        if any(one.owner == question.owner for one in under_way) or self._meshes.pending(question.owner):
            return f"the mesh that was asked for before is still on its way; {messages.ASK_AGAIN}"
        name = question.command.map
        if any(one.command.map == name for one in under_way):
            return f"another mesh is being made; {messages.ASK_AGAIN}"
        if not self._room([name, *(one.command.map for one in under_way)]):
            return f"meshes that others asked for and do not read fill the memory; {messages.ASK_AGAIN}"
        made = self._made.get(name)
        if made is not None and question.asked < made.rest_until and not asked.calm(made.asked):
            return f"a mesh was just made, now it is the keyframes' turn; {messages.ASK_AGAIN}"
        return ""

    def _room(self, wanted: list[str]) -> bool:
        """Whether meshes of these maps, as large as their last, may come to those that wait to be read."""
        waiting = self._meshes.nbytes
        if not waiting and len(wanted) == 1:
            return True
        coming = sum(self._made[name].nbytes for name in wanted if name in self._made)
        return waiting + coming <= self._most_bytes

    def answered(
        self, answer: fuser_messages.FuserReply, status: health.Status | None, frames: Sequence[zmq.Frame]
    ) -> None:
        """What the fuser says."""
        question = self._open.pop(answer.number, None)
        if question is None:
            return
        name, identity = question.command.name, question.identity
        reply = messages.Reply(name=name, error=answer.error, status=status, mesh=answer.layout)
        if name == "mesh":
            now = time.monotonic()
            nbytes = sum(frame.buffer.nbytes for frame in frames)
            rest_until = now + _KEYFRAMES_SHARE * (now - question.asked)
            self._made[question.command.map] = Made(nbytes, question.asked, rest_until)
        self._answer(identity, reply, self._meshes.wrap(question.owner, frames) if frames else ())

    def give_up(self, map_name: str) -> None:
        """The map's fuser is gone."""
        self._made.pop(map_name, None)
        for number, question in list(self._open.items()):
            if question.command.map == map_name:
                del self._open[number]
                reply = messages.Reply(name=question.command.name, error=_RESTARTS)
                self._answer(question.identity, reply)


def status(
    hosted: HostedMap, fuser: fuser_messages.FuserStatus, health: Health, server: ServerConfig
) -> Status:
    """The answer to a person who asks how a map is doing."""
    own = health.maps[hosted.name]
    return Status(
        epoch=health.epoch,
        map=hosted.name,
        state=str(hosted.folder),
        fuser="idle" if hosted.drained else "busy",
        uptime_s=health.uptime_s,
        keyframes_durable=own.keyframes_durable,
        keyframes_fused=fuser.keyframes_fused,
        keyframes_rejected=fuser.keyframes_rejected,
        messages_refused=health.refused,
        duplicates=health.duplicates,
        sessions=own.sessions,
        blocks=fuser.blocks,
        voxels=fuser.voxels,
        map_bytes=fuser.map_bytes,
        map_hash=fuser.map_hash,
        color_hash=fuser.color_hash,
        journal_bytes=own.journal_bytes,
        journal_damaged=own.journal_damaged,
        fuser_restarts=own.fuser_restarts,
        peak_rss_bytes={"server": process.peak_rss_bytes(), "fuser": fuser.peak_rss_bytes},
        delay_ms=own.delay_ms,
        delay_bound_ms=own.delay_bound_ms,
        config={"server": msgspec.to_builtins(server), "volume": fuser.config},
        versions=fuser.versions,
    )
