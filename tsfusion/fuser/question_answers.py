# SPDX-License-Identifier: MIT
"""Answer questions about the map between two pieces of the fuser's work.

A question waits only for the current piece: a step of a keyframe before it changes the map, the update of its
sums, or a step of a long read (`BlockStore.pause`). So it reads the map between two keyframes. While
keyframes wait, questions get a limited share of the time.
"""

import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import zmq

from tsfusion.core.errors import MapError, TsfusionError
from tsfusion.core.limits import Bucket
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser_messages import CurrentKeyframe, FuserAnswer, FuserQuestion, ToFuser
from tsfusion.fuser.kept_answers import KeptSlices, KeptViews
from tsfusion.fuser.map_rewinding import MapRewinding
from tsfusion.fuser.watched_map import WatchedMap
from tsfusion.geometry.map_questions import (
    AnswerArrays,
    DistanceFieldSettings,
    Field,
    Raycast,
    Sample,
    Slice,
    crc_of,
    points_of,
)
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.questions import Answer, Cells, Keyframes, MapVersion, Question, Rewind
from tsfusion.wire.sockets import sockets

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume


class Inbox:
    """Messages of the gateway that are not handled yet; questions come first, in a queue of their own.

    Args:
        link: the socket; None = no messages come.
    """

    def __init__(self, link: sockets.AnySocket | None = None) -> None:
        self.orders: deque[ToFuser] = deque()  # in the order of arrival
        self.questions: deque[tuple[FuserQuestion, Sequence[zmq.Frame]]] = deque()
        self._link = link

    def read(self) -> None:
        """Receive all messages that have arrived; never waits."""
        while self._link is not None and int(self._link.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            head, *frames = self._link.recv_multipart(copy=False)
            message = fuser_messages.to_fuser.decode(head.buffer)
            if isinstance(message, FuserQuestion) and message.command.name == "ask":
                self.questions.append((message, frames))
            else:
                self.orders.append(message)


_SHARE = 0.25  # of a busy fuser's time
_BURST_S = 0.2  # seconds of the share that can be used at once
# Most seconds of processor time of an answer while keyframes wait; and once the share is used up
_LONGEST_S, _SHORTEST_S = 0.4, 0.1
_LOOK_S = 0.001  # seconds between two checks for questions in a long pass


class AnswerGivenUp(TsfusionError):
    """Error that stops an answer that takes too long, or preparations when a question arrives."""


class QuestionAnswers:
    """Answers to the questions about one map that an inbox receives.

    Args:
        at_work: the current keyframe; cleared during an answer, so that no keyframe is blamed for a crash.
    """

    def __init__(
        self,
        volume: "Volume",
        inbox: Inbox,
        watched: WatchedMap,
        rewinding: MapRewinding | None = None,
        *,
        state: Callable[[], MapVersion],
        at_work: CurrentKeyframe,
        send: Callable[[Any, list[Any]], None],
    ) -> None:
        self._volume, self._inbox, self._state, self._send = volume, inbox, state, send
        self.watched, self._rewinding, self._at_work = watched, rewinding, at_work
        self.slices, self.views = KeptSlices(volume), KeptViews(volume, state)
        self._share = Bucket(_SHARE, time.monotonic(), burst=_BURST_S)
        self._is_answering = self._is_preparing = False
        self._until_s = 0.0  # deadline of the current answer, time.monotonic()
        self._began_s = 0.0  # start of the current answer, time.process_time()
        self._is_aside = False  # the current answer interrupts a keyframe
        self._next_look = 0.0  # time.monotonic()

    def give(self) -> None:
        """Answer the questions that wait; while keyframes wait, too, only for a share of the time."""
        if self._is_answering:
            return
        self._is_answering = True
        try:
            self._inbox.read()
            while self._inbox.questions and self._may():
                began = time.monotonic()
                self._share.wait(0.0, began)  # it is full again after a rest
                question, frames = self._inbox.questions.popleft()
                if self.watched.keep_waiting(question):
                    continue
                self._is_aside = self._at_work.is_set
                with self._at_work.aside():
                    self.answer(question, partial(self._find, question, [one.buffer for one in frames]))
                self._inbox.read()
                if self._keyframes_wait:
                    self._share.spend(time.monotonic() - began)
        finally:
            self._is_answering = False
            self._next_look = time.monotonic() + _LOOK_S

    def give_news(self) -> None:
        """Answer the viewers that wait, if there is something new or their wait is over."""
        self._is_answering, self._is_aside = True, False
        began, due = time.monotonic(), deque(self.watched.take_due())
        try:
            while due and not (self._keyframes_wait and time.monotonic() - began > _BURST_S):
                question = due.popleft()
                self.answer(question, partial(self._find, question, []))
                self._inbox.read()
        finally:
            self._is_answering = False
            self.watched.rest(time.monotonic() - began, due)

    def give_between(self) -> None:
        """Answer waiting questions between two steps of long work, which calls this.

        Raises:
            AnswerGivenUp: the pass itself is an answer, and has taken too long.
        """
        if (now := time.monotonic()) < self._next_look:
            return
        if self._is_answering:
            self._next_look = now + _LOOK_S
            self._check_time(now)
        else:
            self.give()

    def prepare(self) -> None:
        """Prepare a likely next camera view (`KeptViews`) until a message arrives."""
        self._is_answering = self._is_preparing = True
        try:
            self.views.prepare()
        except (AnswerGivenUp, MemoryError):  # finished pieces stay; the question reports errors
            pass
        finally:
            self._is_answering = self._is_preparing = False

    def _check_time(self, now: float) -> None:
        if self._is_preparing:
            self._inbox.read()
            if self._inbox.questions or self._inbox.orders:
                raise AnswerGivenUp("something else has come")
            return
        if now > self._until_s:
            raise AnswerGivenUp(questions.LATE)
        took = time.process_time() - self._began_s
        if took < _SHORTEST_S:
            return
        self._inbox.read()
        is_over = took > _LONGEST_S or self._share.wait(1e-6, now) > 0
        if is_over and (self._is_aside or self._inbox.orders):
            raise AnswerGivenUp(
                f"keyframes wait, and the answer takes over {took:.1f} s: ask for less, or later"
            )

    @property
    def _keyframes_wait(self) -> bool:
        """True if a keyframe is being fused, or a message waits."""
        return bool(self._inbox.orders) or self._at_work.is_set

    def _may(self) -> bool:
        """Return True if a question may be answered now: no keyframe waits, or time is left in the share."""
        return not self._keyframes_wait or not self._share.wait(1e-6, time.monotonic())

    def answer(self, asked: FuserQuestion, find: Callable[[], tuple[FuserAnswer, list[Any]]]) -> None:
        """Send the result of `find` (an answer and its frames), or the reason why it fails."""
        frames: list[Any] = []
        try:
            answer, frames = find()
        except AnswerGivenUp as error:
            answer = FuserAnswer(asked.number, error=str(error), late=True)
        except MemoryError as error:
            why = f"not enough memory for that: {error}; raise fuser_memory_bytes"
            answer = FuserAnswer(asked.number, error=why)
        except (TsfusionError, ArithmeticError, ValueError) as error:
            # The process continues after any question: a crash would be blamed on the next keyframe.
            answer = FuserAnswer(asked.number, error=str(error) or type(error).__name__)
        self._send(answer, frames)

    def _find(self, asked: FuserQuestion, points: list[memoryview]) -> tuple[FuserAnswer, list[Any]]:
        began_ns, question = time.monotonic_ns(), asked.command.question
        if began_ns > asked.deadline_ns:
            raise AnswerGivenUp(questions.LATE)
        self._began_s, self._until_s = time.process_time(), asked.deadline_ns / 1e9
        state: MapVersion | None = None
        if isinstance(question, Cells):
            layouts, packed, crc = self.watched.cells(question, compress=asked.command.compress)[:3]
        else:
            arrays, state = self._arrays(question, points)
            layouts, packed = questions.pack(arrays, compress=asked.command.compress)
            crc = crc_of(packed)
        now_ns = time.monotonic_ns()
        answer = Answer(
            arrays=layouts,
            state=state or self._state(),
            crc=crc,
            waited_s=(began_ns - asked.asked_ns) / 1e9,
            took_s=(now_ns - began_ns) / 1e9,
            reach=self._volume.reach if isinstance(question, Sample) else 0.0,
        )
        return FuserAnswer(asked.number, answer), packed

    def _arrays(
        self, question: Question | None, points: list[memoryview]
    ) -> tuple[AnswerArrays, MapVersion | None]:
        """Return the arrays of an answer, and its state of the map; None = the newest."""
        if isinstance(question, Raycast):
            view, state = self.views.get(question)
            return {name: array for name, array in vars(view).items() if array is not None}, state
        if isinstance(question, Rewind):
            if self._rewinding is None:
                raise MapError("only a saved map has a past: view its file or folder")
            return self._rewinding.answer(question), None
        if isinstance(question, Keyframes):
            return self.watched.keyframes(question), None
        assert isinstance(question, Sample | Slice | Field)  # the gateway has checked it
        return answer_of(self._volume, self.slices, question, points), None


def answer_of(
    volume: "Volume",
    slices: KeptSlices,
    question: Sample | Slice | Field,
    frames: list[memoryview],
) -> AnswerArrays:
    """Return the arrays of an answer: fields of `geometry.map_answers` and `geometry.map_grids`."""
    found: dict[str, Any]
    if isinstance(question, Slice):
        current = slices.get(question)
        if question.kind == "distance":
            found = current.distances(unseen_is_free=True).arrays()  # the client decides about unseen space
        else:
            costmap = current.occupancy()
            known = {"cells": costmap.cells, "knows_free_space": costmap.knows_free_space}
            found = {**known, **costmap.grid.figures}
    elif isinstance(question, Field):
        question.check_voxels(volume.config.voxel_size)
        how = question.settings(DistanceFieldSettings)
        found = vars(volume.distance_field(question.box, unseen_is_free=True, **how))
    else:
        points, how = points_of(frames), {"min_weight": question.min_weight, "surface": question.surface}
        samples = volume.sample(points, **how)
        found = {name: getattr(samples, name) for name in ("distance", "weight", "gradient")}
    return {name: np.asarray(array) for name, array in found.items()}
