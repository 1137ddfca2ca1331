# SPDX-License-Identifier: MIT
"""What people ask a map's fuser: passed on, answered when it answers, given up when it dies."""

from collections.abc import Sequence
from typing import Protocol

import zmq
from msgspec import Struct

from tsfusion.fuser_link import FuserLink
from tsfusion.ports import Departures
from tsfusion.transport import messages, work

_MAX_QUESTIONS = 32
_AGAIN = "the fuser restarts; ask again"


class Answer(Protocol):
    """How an answer leaves."""

    def __call__(self, identity: bytes, message: messages.ToClient, frames: Sequence[zmq.Frame] = ()) -> None:
        """To this connection."""


class Question(Struct, frozen=True):
    """Who asked what of which map."""

    identity: bytes
    command: messages.Command


class Questions:
    """Those that are not answered yet, a few."""

    def __init__(self, answer: Answer) -> None:
        self._answer = answer
        self._open: dict[int, Question] = {}
        self._count = 0
        self._meshes = Departures()

    @property
    def nbytes(self) -> int:
        """What waits to be read by those who asked for it."""
        return self._meshes.nbytes

    def ask(self, identity: bytes, command: messages.Command, fuser: FuserLink | None) -> None:
        """Pass a question on; or say why not. `fuser`: of the map, None = it is not open."""
        problem = self._pass_on(identity, command, fuser)
        if problem:
            self._answer(identity, messages.Reply(name=command.name, error=problem))

    def _pass_on(self, identity: bytes, command: messages.Command, fuser: FuserLink | None) -> str:
        if fuser is None:
            return f"no map {command.map} is open"
        if not fuser.ready:
            return fuser.failed or _AGAIN
        asked = any(one.identity == identity and one.command.name == "mesh" for one in self._open.values())
        if command.name == "mesh" and (asked or self._meshes.pending(identity)):
            return "the mesh that was asked for before is still on its way"
        self._count += 1
        if len(self._open) >= _MAX_QUESTIONS or not fuser.send(work.Ask(self._count, command)):
            return "too many questions at once"
        self._open[self._count] = Question(identity, command)
        return ""

    def answered(
        self, answer: work.Answer, status: messages.Status | None, frames: Sequence[zmq.Frame]
    ) -> None:
        """What the fuser says."""
        question = self._open.pop(answer.number, None)
        if question is not None:
            name, identity = question.command.name, question.identity
            reply = messages.Reply(name=name, error=answer.error, status=status, mesh=answer.layout)
            self._answer(identity, reply, self._meshes.wrap(identity, frames) if frames else ())

    def give_up(self, map_name: str) -> None:
        """The map's fuser is gone."""
        for number, question in list(self._open.items()):
            if question.command.map == map_name:
                del self._open[number]
                reply = messages.Reply(name=question.command.name, error=_AGAIN)
                self._answer(question.identity, reply)
