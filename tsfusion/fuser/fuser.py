# SPDX-License-Identifier: MIT
"""Fuse the keyframes of a map: read records from the journal at the gateway's positions and add them.

The process ends with the gateway, at any moment: the last checkpoint and the journal are enough to restart.
While it opens the map or waits, it sees its standard input close, and cleans up. While it works, the system
ends it (Linux).
"""

import errno
import logging
import math
import os
import platform
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from tsfusion import journal
from tsfusion.core import process
from tsfusion.core.errors import JournalError, TsfusionError
from tsfusion.core.process import chosen_engine, version_of
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.departures import Departures
from tsfusion.fuser.fuser_messages import CurrentKeyframe, FuserAnswer, FuserQuestion
from tsfusion.fuser.live_mesh import LiveMesh, TouchedBy, mesh_frames
from tsfusion.fuser.map_checkpoints import OpenedMap
from tsfusion.fuser.map_rewinding import MapRewinding
from tsfusion.fuser.pose_mover import REST_FACTOR, RETRY_S, PoseMover, ReadPatience
from tsfusion.fuser.question_answers import Inbox, QuestionAnswers
from tsfusion.fuser.watched_map import WatchedMap
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.journal import Position, state_folder
from tsfusion.wire.messages.questions import MapVersion
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import Refused
from tsfusion.wire.sockets import sockets

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import IntegrateStats

_JOURNAL = state_folder.JOURNAL_FOLDER
_FOR_KEYFRAMES = 256 << 20  # bytes of working memory that meshes leave free
_FOR_A_CHECKPOINT = 64 << 20  # bytes beyond the memory limit
LOCK = "fuser.lock"  # in the map's folder
_CARVING = 10  # times `quota_cost` where rays also vote for the free space before them
# In a map with a window, each new keyframe makes an old one leave at the same cost: half the time for moves
_WINDOW_REST_FACTOR = 1.0
_MORE_MS = 50  # milliseconds within which the next record comes, if the gateway said that one waits

log = logging.getLogger(__name__)


class Chore(NamedTuple):
    """Work of the fuser that no message asks for, done a piece at a time.

    Attributes:
        wait: gets True if the fuser is idle; returns seconds until a piece is due, 0 = now, None = never.
        do: does one piece.
        when_idle: True if the chore is only done while the fuser is idle.
    """

    wait: Callable[[bool], float | None]
    do: Callable[[], Any]
    when_idle: bool = True


class Fuser:
    """Fuser of one map: it does the work that each message of the gateway orders, and chores.

    Args:
        inbox: receives questions about the map; None = no questions.
        opened: the map, if it was read before its folder had this name.
    """

    def __init__(
        self,
        link: sockets.AnySocket,
        begin: fuser_messages.Begin,
        inbox: Inbox | None = None,
        opened: OpenedMap | None = None,
    ) -> None:
        self._link = link
        self._begin = begin
        self._folder = Path(begin.folder)
        self._since_checkpoint = 0
        self._orders: deque[fuser_messages.Fuse] = deque()  # unanswered; the first is unreadable for now
        self._patience = ReadPatience(self._journal_is_away)  # with the first of them
        self._retry_at = 0.0  # time.monotonic() of the next attempt to read the stuck record
        self._answered = 0  # records that this process answered
        self._more_waits = False  # more records wait at the gateway
        self._epoch = f"{time.monotonic_ns():x}"  # names this process in its answers
        self._newest = Position(0, 0)  # position of the newest answered record
        self._hashes: tuple[int, str, str] | None = None  # changes, map hash, colour hash
        self._current = CurrentKeyframe(begin.working)
        self.exit_status: int | None = None  # exit status of the process; None = it continues
        self._homes: dict[str, os.stat_result] = {"": os.stat(self._folder)}  # at the opening
        with suppress(OSError):
            self._homes[_JOURNAL] = os.stat(self._folder / _JOURNAL)
        opened = opened or OpenedMap(begin)
        self._memory_limit, self._map = opened.memory_limit, opened.checkpoints
        self._map.use_folder(self._folder)
        self._volume = self._map.volume
        self._warming: Iterator[None] | None = opened.warming
        self._touched_by = TouchedBy()
        self._live_mesh = LiveMesh(
            self._volume,
            interval=begin.mesh_interval,
            expects=not begin.is_private,
            sparing=lambda: self._memory_beyond(-_FOR_KEYFRAMES),
            send=self._send,
        )
        self._departures = Departures(begin, self._map.ledger, self._map.done, send=self._send)
        self._mover = PoseMover(
            self._volume,
            self._map.ledger,
            self._folder / _JOURNAL,
            integrate=lambda keyframe, session: self._integrate(keyframe, self._map.done[session].client),
            is_away=self._journal_is_away,
            say=self._send,
            begin=self._note_next,
            moves=begin.moves,
            expects=lambda: int(self._departures.is_behind),
            rest_factor=_WINDOW_REST_FACTOR if begin.keeps_window else REST_FACTOR,
        )
        self._rewinding: MapRewinding | None = None
        if begin.is_private:
            self._rewinding = MapRewinding(
                self._volume,
                self._folder / state_folder.MAP_FILE,
                self._mover,
                self._touched_by,
                memory_bytes=begin.memory_bytes if begin.cache else None,
                note=self._live_mesh.note_move,
            )
        watched = WatchedMap(self._volume, self._map.ledger, self._touched_by, self._live_mesh, self._epoch)
        asked, at_work = inbox or Inbox(), self._current
        self._answers = QuestionAnswers(
            self._volume, asked, watched, self._rewinding, state=self._state, at_work=at_work, send=self._send
        )
        self._volume.set_pause(self._answers.give_between)

    @cached_property
    def chores(self) -> dict[str, Chore]:
        """Chores by name, in the order in which they are checked.

        The process answers questions first, then does a piece of the first due chore, and starts again.
        Without a due chore it handles one message. So chores with `when_idle` False also run while records
        wait; all others need an idle fuser.
        """
        mesh, views, watched = self._live_mesh, self._answers.views, self._answers.watched
        back = self._rewinding
        return {
            "mesh": Chore(
                lambda idle: mesh.wait(idle=idle and not self._mover.waiting), mesh.update, when_idle=False
            ),
            "news": Chore(
                lambda _: watched.wait() if mesh.is_held else None, self._answers.give_news, when_idle=False
            ),
            "search": Chore(self._departures.wait, self._search, when_idle=False),
            **({} if back is None else {"rewind": Chore(lambda _: back.wait(), back.begin)}),
            "move": Chore(self._mover.wait, self._move, when_idle=False),
            "prepare": Chore(lambda _: views.wait(), self._answers.prepare),
            "warm": Chore(lambda _: None if self._warming is None else mesh.quiet_wait, self._warm),
            "refine": Chore(lambda _: mesh.refine_wait(), mesh.refine),
            **({} if back is None else {"clients": Chore(lambda _: back.clients_wait(), back.find_client)}),
            "retry": Chore(
                lambda _: max(self._retry_at - time.monotonic(), 0.0) if self.is_stuck else None, self.go_on
            ),
        }

    def do_chore(self, *, idle: bool) -> float | None:
        """Do a piece of the first due chore and return 0; else return seconds to wait (None = for ever)."""
        waits = []
        for chore in self.chores.values():
            wait = chore.wait(idle) if idle or not chore.when_idle else None
            if wait == 0:
                chore.do()
                return 0.0
            waits.append(math.inf if wait is None else wait)
        return None if min(waits) == math.inf else min(waits)

    def ready(self) -> fuser_messages.Ready:
        """Return the message that the map is open, with the progress of each session in it."""
        return fuser_messages.Ready(
            self._map.done,
            self._volume.keyframes,
            self._map.rejected,
            *self._volume.size,
            self._mover.progress(),
        )

    def _note_next(self, session: bytes) -> None:
        """Note that the next change of the map is by a keyframe of this session."""
        self._touched_by.note(self._volume.version + 1, session)
        self._answers.views.note_change()

    def answer(self) -> None:
        """Answer the questions that wait, before any other work."""
        self._answers.give()

    def handle(self, message: fuser_messages.ToFuser) -> None:
        """Do what a message of the gateway orders."""
        if isinstance(message, fuser_messages.Fuse):
            self._orders.append(message)
            self.go_on()
        elif isinstance(message, FuserQuestion):
            find = self._mesh if message.command.name == "mesh" else self._status
            self._answers.answer(message, partial(find, message))
        elif isinstance(message, fuser_messages.Find | fuser_messages.Expire):
            self._departures.ask(message)
        elif isinstance(message, fuser_messages.Save):
            self._checkpoint(alone=message.alone)
        elif isinstance(message, fuser_messages.Finish):
            self.exit_status = 0 if self._checkpoint() else 1

    @property
    def is_stuck(self) -> bool:
        """True if the next record to fuse cannot be read from the journal for now."""
        return bool(self._orders)

    def go_on(self) -> None:
        """Fuse the records that the gateway ordered, up to one that cannot be read for now."""
        while self._orders and self.exit_status is None and self._fuse(self._orders[0]):
            self._orders.popleft()
            self._patience.since = None

    @property
    def idle_after_ms(self) -> int:
        """Milliseconds after the last message until the fuser counts as idle and does chores."""
        return _MORE_MS if self._more_waits else 0

    def _warm(self) -> None:
        """Compile the next kernel that no keyframe needs; all take a second at the first start."""
        assert self._warming is not None
        if next(self._warming, True):  # the steps yield None
            self._warming = None

    def _move(self) -> None:
        """Take one keyframe out of the map and add it at its corrected pose."""
        self._current.set(fuser_messages.MOVING)
        is_done = self._mover.move()
        self._current.set(fuser_messages.NOT_WORKING)
        if is_done:
            self._live_mesh.note_move()
            self._note_change()

    def _search(self) -> None:
        """Search for a moment for keyframes that must leave the map."""
        if self._departures.look():
            self._mover.say()

    def _fuse(self, order: fuser_messages.Fuse) -> bool:
        """Fuse or reject a record, and report it; return False if it cannot be read for now."""
        start = time.monotonic_ns()
        self._more_waits = order.more
        before = self._map.done.get(order.session)
        if before is not None and order.seq <= before.seq:
            self._note_answer()
            self._send(fuser_messages.Done(order.index, start, start))
            return True
        self._newest = max(self._newest, order.position)
        reason, message, forgotten = order.skip, "", self._map.ledger.forgotten
        if reason is None:
            self._current.set(order.index)
            try:
                reason, message = self._take(order)
            except TsfusionError as error:
                if isinstance(error, JournalError) and self._hold(error):
                    return False
                if not (isinstance(error, JournalError) and error.is_erased):
                    reason, message = _reason(error), str(error)
                else:
                    self._map.ledger.leave_out()
            except MemoryError as error:
                reason, message = "memory", f"no memory to fuse it: {error}; raise fuser_memory_bytes"
            self._current.set(fuser_messages.NOT_WORKING)  # not reached if the keyframe ended the process
        if reason is not None and not order.is_correction:
            self._map.rejected[reason] = self._map.rejected.get(reason, 0) + 1
        self._note_answer()
        self._map.done[order.session] = fuser_messages.SessionProgress(order.seq, order.client, order.world)
        self._send(fuser_messages.Done(order.index, start, time.monotonic_ns(), reason, message))
        if self._map.ledger.forgotten != forgotten:
            self._mover.say()  # after the answer, because `Done` counts the keyframe as fused
        self._note_change()
        return True

    def _take(self, order: fuser_messages.Fuse) -> tuple[str | None, str]:
        """Read and apply one record of the journal; return (None, ""), or reason and message of a rejection.

        Raises:
            TsfusionError: the record cannot be read or fused.
        """
        record = journal.read(self._folder / _JOURNAL, order.position)
        found, ledger = codec.decode(record.frames), self._map.ledger
        self.answer()
        if isinstance(found, Keyframe):
            if order.seq in ledger.forgotten_of(order.session):
                ledger.leave_out()
                return None, ""
            found = ledger.placed(order.session, found)
            self._note_next(order.session)
            if not self._integrate(found, order.client).samples:
                return NO_SAMPLES, self._volume.why_no_samples(found)
            ledger.add(order.session, order.seq, order.position, found)
            if self._begin.keeps_window:
                self._departures.note_keyframe()
                self._mover.say()
            return None, ""
        if found.target is None:
            self._mover.pending.note(order.session, ledger.correct(order.session, found))
            self._departures.note_keyframe()
        else:
            self._mover.pending.note(found.target, ledger.forget(found.target, found.removed))
            self._departures.note_record()
        self._mover.say()
        return None, ""

    def _note_answer(self) -> None:
        self._answered += 1
        self._live_mesh.note_answer()

    def _note_change(self) -> None:
        self._since_checkpoint += 1
        if self._begin.checkpoint_every and self._since_checkpoint >= self._begin.checkpoint_every:
            self._checkpoint()

    def _hold(self, error: JournalError) -> bool:
        """Return True if the fuser should wait for an unreadable record: its folder or disk may come back.

        If the system refuses to read it for long, another process tries again; the gateway gives the record
        up after a few processes. A damaged record is rejected at once. A record whose segment alone is
        missing is rejected after a while.
        """
        if self._patience.waits(error):
            self._retry_at = time.monotonic() + RETRY_S
            self._current.set(fuser_messages.NOT_WORKING)
            self._send(fuser_messages.Stuck(str(error)))
            return True
        if not error.temporary or error.errno == errno.ENOENT:
            return False
        log.error("%s: another process tries again, from the checkpoint", error)
        self.exit_status = 1  # `working` still names this record, so it is blamed
        return True

    def _journal_is_away(self) -> bool:
        return journal.is_away(self._folder / _JOURNAL, self._homes.get(_JOURNAL))

    @contextmanager
    def _memory_beyond(self, nbytes: int) -> Iterator[None]:
        """Raise the map's memory limit by `nbytes` (lower it if < 0) within the `with` block."""
        process.limit_memory(self._memory_limit + nbytes)
        try:
            yield
        finally:
            process.limit_memory(self._memory_limit)

    def _integrate(self, keyframe: Keyframe, client: str) -> "IntegrateStats":
        """Add a keyframe to the map, within its client's quota. Without keys all clients share one."""
        from tsfusion.tsdf.integration.integrator import KeyframeQuota

        taken = self._map.blocks
        cost = self._begin.quota_cost * (_CARVING if self._volume.config.space_carving else 1)
        self._volume.quota = KeyframeQuota(cost)
        if client:
            share = int(self._begin.quota_map * self._volume.most_blocks)
            self._volume.quota = KeyframeQuota(cost, share - taken.get(client, 0))
        stats = self._volume.integrate(keyframe)
        if client and stats.new_blocks:
            taken[client] = taken.get(client, 0) + stats.new_blocks
        return stats

    def _checkpoint(self, *, alone: bool = False) -> bool:
        written, problem = False, ""
        if self._since_checkpoint and not self._is_home:
            problem = f"the folder {self._folder} is not there, or is another one"
            log.error("no checkpoint: %s", problem)
        elif self._since_checkpoint:
            self._mover.drop_deleted()
            with self._memory_beyond(_FOR_A_CHECKPOINT):
                written = self._map.save()
            self._since_checkpoint = 0 if written else 1
            problem = self._map.problem
        if alone and not problem:
            problem = self._map.replace_previous()
        self._send(fuser_messages.Saved(written, problem, alone))
        return not self._since_checkpoint

    @property
    def _is_home(self) -> bool:
        """True if the map's folder is still the one that was opened, not a missing disk's mount point."""
        try:
            return os.path.samestat(os.stat(self._folder), self._homes[""]) or (self._folder / LOCK).exists()
        except OSError:
            return False

    def _mesh(self, asked: FuserQuestion) -> tuple[FuserAnswer, list[Any]]:
        with self._memory_beyond(-_FOR_KEYFRAMES):
            layout, frames = mesh_frames(self._volume.extract_mesh(asked.command.min_weight))
        return FuserAnswer(asked.number, mesh=layout), frames

    def _status(self, asked: FuserQuestion) -> tuple[FuserAnswer, list[Any]]:
        stats = self._volume.stats()
        changes = self._answered + self._mover.moved
        if self._hashes is None or self._hashes[0] != changes:
            self._hashes = (changes, self._volume.map_hash(), self._volume.color_hash())
        figures = {
            "keyframes_fused": self._volume.keyframes,
            "keyframes_rejected": self._map.rejected,
            "blocks": stats.blocks,
            "voxels": stats.voxels,
            "map_bytes": stats.bytes,
            "map_hash": self._hashes[1],
            "color_hash": self._hashes[2],
            "peak_rss_bytes": process.peak_rss_bytes(),
            "versions": _versions(),
            "config": msgspec.to_builtins(self._volume.config),
        }
        return FuserAnswer(asked.number, figures=figures), []

    def _state(self) -> MapVersion:
        """Return the version of the map to which an answer belongs."""
        return MapVersion(
            keyframes=self._volume.keyframes,
            changes=self._answered + self._mover.moved,
            epoch=self._epoch,
            segment=self._newest.segment,
            offset=self._newest.offset,
            waiting=self._mover.waiting,
        )

    def _send(self, message: Any, frames: list[Any] | None = None) -> None:
        self._link.send_multipart([fuser_messages.encode(message), *(frames or [])], copy=False)


@cache
def _versions() -> dict[str, str]:
    """Return the versions of Python and the libraries; cached, because reading their files is slow."""
    libraries = {name: version_of(name) for name in ("tsfusion", chosen_engine(), "numpy", "pyzmq")}
    return {"python": platform.python_version(), **libraries}


def _reason(error: TsfusionError) -> str:
    """Return the word under which a keyframe rejected with this error is counted."""
    return error.reason if isinstance(error, Refused) else type(error).__name__
