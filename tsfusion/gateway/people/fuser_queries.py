# SPDX-License-Identifier: MIT
"""Queries (status, mesh) to a map's fuser: passed on, answered, or refused when the fuser dies.

A mesh costs the fuser's time and the gateway's memory, and costs the client nothing. So one mesh is made at a
time, with pauses while keyframes come, and the bytes of unread meshes have a limit.
"""

import time
from collections.abc import Sequence

import msgspec
import zmq
from msgspec import Struct, structs

from tsfusion.core import process
from tsfusion.core.config import ServerConfig
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.ports.connection_limits import PendingReplies
from tsfusion.gateway.ports.ports import Ports
from tsfusion.wire.messages import health, messages
from tsfusion.wire.messages.health import Health, MapCounts, Status

_MAX_PENDING = 32
_REST_FACTOR = 3  # a pause of three times the last mesh's time: meshes get a quarter of a busy fuser
_RESTARTS = "the fuser restarts"


class PendingQuery(Struct, frozen=True):
    """A query that a fuser has not answered yet."""

    identity: bytes  # the connection that sent it
    owner: bytes  # the client, or without keys the connection: each can have one mesh under way
    command: messages.Command
    asked_at: float  # `time.monotonic()`


class LastMesh(Struct, frozen=True):
    """The last mesh of a map made on request."""

    nbytes: int
    asked_at: float  # `time.monotonic()`
    rest_until: float  # until this time a map that gets keyframes makes no other mesh


class FuserQueries:
    """The queries that wait for a fuser's answer.

    Args:
        max_bytes: limit for unread replies; a single one can be larger.
    """

    def __init__(self, ports: Ports, unread: PendingReplies, max_bytes: int) -> None:
        self._ports, self._unread = ports, unread
        self._max_bytes = max_bytes
        self._pending: dict[int, PendingQuery] = {}
        self._count = 0
        self._last_meshes: dict[str, LastMesh] = {}

    @property
    def nbytes(self) -> int:
        """Bytes of the unread replies, up to the limit for them."""
        return min(self._unread.nbytes, max(self._max_bytes, self._unread.largest))

    def submit(
        self, identity: bytes, command: messages.Command, hosted: HostedMap | None, client: str = ""
    ) -> None:
        """Pass a command on to the map's fuser, or reply why not."""
        query = PendingQuery(identity, client.encode() or identity, command, time.monotonic())
        if hosted is None:
            self._refuse(query, f"no map {command.map} is open")
        elif hosted.fuser.failed and not hosted.fuser.ready:
            self._refuse(query, hosted.fuser.failed)
        elif problem := self._pass_on(query, hosted):
            self._refuse(query, problem, retry=True)

    def _refuse(self, query: PendingQuery, problem: str, *, retry: bool = False) -> None:
        error = f"{problem}; ask again" if retry else problem
        self._ports.reply(query.identity, messages.Reply(name=query.command.name, error=error, retry=retry))

    def _pass_on(self, query: PendingQuery, hosted: HostedMap) -> str:
        """Ask the fuser. Return the reason why it cannot be asked now, or ""."""
        if not hosted.fuser.ready:
            return "the map is being opened, or its fuser restarts"
        if query.command.name == "mesh" and (problem := self._why_no_mesh(query, hosted)):
            return problem
        self._count += 1
        if len(self._pending) >= _MAX_PENDING or not hosted.fuser.send(
            fuser_messages.FuserQuery(self._count, query.command)
        ):
            return "too many questions at once"
        self._pending[self._count] = query
        return ""

    def _why_no_mesh(self, query: PendingQuery, hosted: HostedMap) -> str:
        """Return the reason why this mesh cannot be made now, or ""."""
        under_way = [one for one in self._pending.values() if one.command.name == "mesh"]
        if any(one.owner == query.owner for one in under_way) or self._unread.pending(query.owner):
            return "the mesh that was asked for before is still on its way"
        name = query.command.map
        if any(one.command.map == name for one in under_way):
            return "another mesh is being made"
        if not self._has_memory_for([name, *(one.command.map for one in under_way)]):
            return "meshes that others asked for and do not read fill the memory"
        last = self._last_meshes.get(name)
        if last is not None and query.asked_at < last.rest_until and not hosted.idle_since(last.asked_at):
            return "a mesh was just made, now it is the keyframes' turn"
        return ""

    def _has_memory_for(self, maps: list[str]) -> bool:
        """True if new meshes of these maps, as large as their last ones, fit beside the unread replies."""
        waiting = self._unread.nbytes
        if not waiting and len(maps) == 1:
            return True
        coming = sum(self._last_meshes[name].nbytes for name in maps if name in self._last_meshes)
        return waiting + coming <= self._max_bytes

    def on_reply(
        self, answer: fuser_messages.FuserReply, status: health.Status | None, frames: Sequence[zmq.Frame]
    ) -> None:
        """Send a fuser's answer to the connection that asked."""
        query = self._pending.pop(answer.number, None)
        if query is None:
            return
        name = query.command.name
        reply = messages.Reply(name=name, error=answer.error, status=status, mesh=answer.layout)
        if name == "mesh":
            now = time.monotonic()
            nbytes = sum(frame.buffer.nbytes for frame in frames)
            rest_until = now + _REST_FACTOR * (now - query.asked_at)
            self._last_meshes[query.command.map] = LastMesh(nbytes, query.asked_at, rest_until)
        self._ports.reply(query.identity, reply, self._unread.wrap(query.owner, frames) if frames else ())

    def give_up(self, map_name: str) -> None:
        """Refuse the open queries to a map's fuser: it has ended."""
        self._last_meshes.pop(map_name, None)
        for number, query in list(self._pending.items()):
            if query.command.map == map_name:
                del self._pending[number]
                self._refuse(query, _RESTARTS, retry=True)


def status(
    hosted: HostedMap, fuser: fuser_messages.FuserStatus, health: Health, server: ServerConfig
) -> Status:
    """Return a map's status, from the figures of its fuser and of the gateway."""
    own = health.maps[hosted.name]
    counts = {name: getattr(own, name) for name in MapCounts.__struct_fields__}
    found = counts | structs.asdict(fuser)  # the fuser's counts are newer
    found |= {
        "peak_rss_bytes": {"server": process.peak_rss_bytes(), "fuser": fuser.peak_rss_bytes},
        "config": {"server": msgspec.to_builtins(server), "volume": fuser.config},
    }
    return Status(
        epoch=health.epoch,
        map=hosted.name,
        state=str(hosted.records.folder),
        fuser="idle" if hosted.drained else "busy",
        uptime_s=health.uptime_s,
        messages_refused=health.refused,
        duplicates=health.duplicates,
        **found,
    )
