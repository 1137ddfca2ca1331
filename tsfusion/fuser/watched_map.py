# SPDX-License-Identifier: MIT
"""Answer viewers of a map: cells that changed, and the poses of its keyframes."""

import time
from collections import OrderedDict
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.fuser.fuser_messages import FuserQuestion
from tsfusion.fuser.live_mesh import LiveMesh, TouchedBy
from tsfusion.geometry.map_questions import AnswerArrays, crc_of
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.questions import (
    ANSWER_BYTES,
    CELLS_AT_ONCE,
    ArrayLayout,
    Cells,
    Keyframes,
)

if TYPE_CHECKING:
    from tsfusion.tsdf.surface.changed_cells import CellChanges
    from tsfusion.tsdf.volume import Volume

_SESSION = 16  # bytes
_KEPT = 4  # answers: viewers that hold the same cells get the same one
_TOGETHER_S = 0.2  # between two answers to viewers that wait, while keyframes come
_REST_FACTOR = 3  # no such answer for three times as long as the last took: a quarter of a busy fuser's time


class _WaitingViewer(NamedTuple):
    asked: FuserQuestion
    cells: Cells
    ends_s: float  # time.monotonic()


class PackedCells(NamedTuple):
    """Encoded answer about cells, and the newest change of the map when it was made."""

    layouts: tuple[ArrayLayout, ...]
    frames: list[Any]
    crc: int
    nbytes: int  # of the triangles
    newest: int
    more: bool


class WatchedMap:
    """A map, together with the poses, sessions and changes that its voxels do not contain.

    Args:
        epoch: names this process: changes of another one mean nothing here.
    """

    def __init__(
        self, volume: "Volume", ledger: Ledger, touched_by: TouchedBy, live_mesh: LiveMesh, epoch: str
    ) -> None:
        self._volume, self._ledger, self._epoch = volume, ledger, epoch
        self._touched_by, self._live_mesh = touched_by, live_mesh
        self._waiting: list[_WaitingViewer] = []
        self._next = 0.0  # time.monotonic() of the next answer to viewers that wait
        self._kept: OrderedDict[tuple[int, int, bool], PackedCells] = OrderedDict()

    # --- viewers that wait ---

    def keep_waiting(self, asked: FuserQuestion) -> bool:
        """Keep a question that has no answer yet, for `take_due`. Return False if it is to be answered now.

        A viewer that holds nearly all waits for the next answer to others: from then on all hold the same.
        """
        question = asked.command.question
        if not isinstance(question, Cells):
            return False
        if not question.wait_s or self._begins(question):
            return False
        lag = self._live_mesh.changes.newest - question.since
        if lag > CELLS_AT_ONCE or (lag and time.monotonic() >= self._ready_s):
            return False
        ends_s = min(asked.asked_ns / 1e9 + question.wait_s, asked.deadline_ns / 1e9)
        self._waiting.append(_WaitingViewer(asked, question, ends_s))
        self._live_mesh.is_held = True
        return True

    def _begins(self, cells: Cells) -> bool:
        """True if the viewer holds nothing that an answer can go on from."""
        changes = self._live_mesh.changes
        changes.follow()
        return cells.epoch != self._epoch or not changes.first <= cells.since <= changes.newest

    def _has_newer(self, cells: Cells) -> bool:
        return self._live_mesh.changes.newest > cells.since

    def wait(self) -> float:
        """Return the seconds until `take_due` has something, while a viewer waits (`LiveMesh.is_held`)."""
        ends = min(one.ends_s for one in self._waiting)
        is_new = any(self._has_newer(one.cells) for one in self._waiting)
        return max((min(ends, self._ready_s) if is_new else ends) - time.monotonic(), 0.0)

    @property
    def _ready_s(self) -> float:
        """Time from which viewers that wait get an answer: at once while no keyframe is expected soon."""
        return self._next if self._live_mesh.quiet_wait else 0.0

    def take_due(self) -> list[FuserQuestion]:
        """Return the questions that have an answer now, or whose wait is over."""
        now = time.monotonic()
        is_ready = now >= self._ready_s
        is_due = [one.ends_s <= now or (is_ready and self._has_newer(one.cells)) for one in self._waiting]
        due = [one.asked for one, its in zip(self._waiting, is_due, strict=True) if its]
        self._waiting = [one for one, its in zip(self._waiting, is_due, strict=True) if not its]
        self._live_mesh.is_held = bool(self._waiting)
        return due

    def rest(self, took: float, left: Iterable[FuserQuestion] = ()) -> None:
        """Pause after answers that took so many seconds; the questions `left` are the first after it."""
        self._next = time.monotonic() + max(_TOGETHER_S, _REST_FACTOR * took)
        asked = [(one, one.command.question) for one in left]
        self._waiting[:0] = [_WaitingViewer(a, q, self._next) for a, q in asked if isinstance(q, Cells)]
        self._live_mesh.is_held = bool(self._waiting)

    # --- answers ---

    def cells(self, asked: Cells, *, compress: bool) -> PackedCells:
        """Return the cells that changed after those which the viewer holds. Raises MemoryError."""
        begins, changes = self._begins(asked), self._live_mesh.changes
        since = 0 if begins else asked.since
        key = changes.first, since, compress
        kept = self._kept.get(key)
        if kept is None or kept.nbytes > asked.most_bytes or not (kept.more or kept.newest == changes.newest):
            with self._live_mesh.sparing():
                found = self._changes(since, min(asked.most_bytes, ANSWER_BYTES))
                kept = self._packed(found, begins=begins, compress=compress)
            self._kept[key] = kept
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return kept

    def _changes(self, since: int, most_bytes: int) -> "CellChanges":
        most = max(CELLS_AT_ONCE * most_bytes // ANSWER_BYTES, 1)
        while True:
            found = self._live_mesh.changes.since(since, most, refine=not self._live_mesh.quiet_wait)
            if found.mesh.nbytes <= most_bytes or most == 1:
                return found
            most = max(min(most, len(found.cells)) // 2, 1)

    def _packed(self, found: "CellChanges", *, begins: bool, compress: bool) -> PackedCells:
        sessions, client = self._touched_by.of(self._volume.surface.cell_versions(found.cells))
        mesh = found.mesh
        arrays = {
            "cells": found.cells,
            "first_face": found.first_face,
            "is_refined": found.is_refined,
            "client": client,
            "sessions": _bytes_of(sessions),
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "normals": mesh.normals,
            **({} if mesh.colors is None else {"colors": mesh.colors}),
            "voxel_size": np.float64(self._volume.config.voxel_size),
            "until": np.int64(found.until),
            "more": np.bool_(found.more),
            "begins": np.bool_(begins),
        }
        layouts, frames = questions.pack(
            {name: np.asarray(array) for name, array in arrays.items()}, compress=compress
        )
        newest = self._live_mesh.changes.newest
        return PackedCells(layouts, frames, crc_of(frames), found.mesh.nbytes, newest, found.more)

    def keyframes(self, asked: Keyframes) -> AnswerArrays:
        """Return the arrays of `Ledger.fused_after`."""
        found, T_map_odometry, last = self._ledger.fused_after(asked.session, asked.after, asked.count)
        session, number = last or (b"", 0)
        return {
            "sessions": _bytes_of(found.sessions),
            "session": found.session,
            "seqs": found.seqs,
            "poses": found.poses,
            "T_map_odometry": T_map_odometry,
            "last_session": np.array(list(session), np.uint8),
            "last": np.asarray(number, np.int64),
            "held": np.array(self._volume.held.numbers),
        }


def _bytes_of(sessions: Any) -> NDArray[np.uint8]:
    return np.array([list(one) for one in sessions], np.uint8).reshape(-1, _SESSION)
