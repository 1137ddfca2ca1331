# SPDX-License-Identifier: MIT
"""Answers to questions about the map, between two pieces of the fuser's work.

A question waits for the piece that is under way: a step of a keyframe before it touches the map, its sums,
or a step of a long pass that only reads the map (`BlockStore.pause`). It reads the map as it is then, between
two keyframes. While keyframes wait, questions get a share of the time and no more.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from tsfusion.core.errors import TsfusionError
from tsfusion.core.token_bucket import Bucket
from tsfusion.fuser.inbox import Inbox
from tsfusion.fuser.messages import FuserAnswer, FuserQuestion
from tsfusion.wire import questions
from tsfusion.wire.questions import Answer, MapState, Raycast

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

_SHARE = 0.25  # of a busy fuser's time
_BURST_S = 0.2  # seconds of time whose share may come at once
_LOOK_S = 0.001  # seconds of a long pass until questions are looked for again
_Arrays = dict[str, NDArray[Any]]


class QuestionAnswers:
    """Answers the questions of an inbox.

    Args:
        state: of the map, now.
        aside: entered while a question is answered in the middle of other work.
        send: takes a message and its frames.
    """

    def __init__(
        self,
        volume: "Volume",
        inbox: Inbox,
        *,
        state: Callable[[], MapState],
        aside: Callable[[], AbstractContextManager[None]] = nullcontext,
        send: Callable[[Any, list[Any]], None],
    ) -> None:
        self._volume, self._inbox, self._state, self._send = volume, inbox, state, send
        self._aside = aside
        self._share = Bucket(_SHARE, time.monotonic(), burst=_BURST_S)
        self._is_answering = False
        self._next_look = 0.0  # time.monotonic()

    def give(self) -> None:
        """Answer what waits; with keyframes waiting, too, for a share of the time."""
        if self._is_answering:
            return
        self._is_answering = True
        try:
            self._inbox.read()
            while self._inbox.questions and self._may():
                began = time.monotonic()
                question, frames = self._inbox.questions.popleft()
                with self._aside():
                    self._answer(question, [frame.buffer for frame in frames])
                if self._inbox.orders:
                    self._share.spend(time.monotonic() - began)
                self._inbox.read()
        finally:
            self._is_answering = False
            self._next_look = time.monotonic() + _LOOK_S

    def give_between(self) -> None:
        """Answer what waits, from the middle of a long pass, which calls this after each little step."""
        if time.monotonic() >= self._next_look:
            self.give()

    def _may(self) -> bool:
        """Whether the time of a question has come: keyframes that wait have had theirs."""
        return not self._inbox.orders or not self._share.wait(1e-6, time.monotonic())

    def _answer(self, asked: FuserQuestion, frames: list[memoryview]) -> None:
        began_ns = time.monotonic_ns()
        if began_ns > asked.deadline_ns:
            self._send(FuserAnswer(asked.number, error=questions.LATE, late=True), [])
            return
        try:
            arrays = answer_of(self._volume, asked.question, frames)
            layouts, packed = questions.pack(arrays, compress=asked.compress)
        except MemoryError as error:
            why = f"not enough memory for that: {error}; raise fuser_memory_bytes"
            self._send(FuserAnswer(asked.number, error=why), [])
        except (TsfusionError, ArithmeticError, ValueError) as error:
            # The process goes on whatever was asked: a crash would be blamed on the next keyframe.
            self._send(FuserAnswer(asked.number, error=str(error) or type(error).__name__), [])
        else:
            now_ns = time.monotonic_ns()
            answer = Answer(
                arrays=layouts,
                state=self._state(),
                crc=questions.crc_of(packed),
                waited_s=(began_ns - asked.asked_ns) / 1e9,
                took_s=(now_ns - began_ns) / 1e9,
            )
            self._send(FuserAnswer(asked.number, answer), packed)


def answer_of(volume: "Volume", question: questions.Question, frames: list[memoryview]) -> _Arrays:
    """What a map answers, by name: the fields of `geometry.map_answers`."""
    how: dict[str, Any] = {"min_weight": question.min_weight, "surface": question.surface}
    if isinstance(question, Raycast):
        view = volume.raycast(question.intrinsics, question.matrix, question.shape, **how)
        found = {"depth": view.depth, "normals": view.normals, "colors": view.colors}
        return {name: array for name, array in found.items() if array is not None}
    samples = volume.sample(questions.points_of(frames), **how)
    return {"distance": samples.distance, "weight": samples.weight, "gradient": samples.gradient}
