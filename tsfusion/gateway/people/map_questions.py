# SPDX-License-Identifier: MIT
"""Questions of clients to the open maps: each is checked, passed on to a fuser, and answered in bounded time.

The fuser answers between two pieces of its work, so a question waits for milliseconds. A client has limits:
questions under way, questions a second, bytes of unread answers. After its deadline a question is refused,
whatever the fuser does.
"""

import time
from collections import Counter, OrderedDict
from collections.abc import Sequence
from itertools import count

import zmq
from msgspec import Struct

from tsfusion.core.limits import Bucket
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.keyframe_outcomes import QuestionCounts
from tsfusion.gateway.ports.connection_limits import PendingReplies
from tsfusion.gateway.ports.ports import Ports
from tsfusion.wire.messages import messages, questions

MOST_WAITING = 32  # questions of all clients to one map: the gateway checks the size of each answer
MOST_OF_A_CLIENT = 4  # open questions
# Unread answers of a client: on a busy machine, ZeroMQ may report late that an answer has left
MOST_UNREAD = 64
_UNREAD_SHARE = 1 / 4  # of the memory of all unread answers; four of any size can wait
_MOST_CLIENTS = 4096


class WaitingQuestion(Struct, frozen=True):
    """A question that a fuser has not answered yet."""

    identity: bytes  # the connection that asked
    owner: bytes  # the client, or without keys the connection
    command: messages.Command
    asked_ns: int  # `time.monotonic_ns()`
    deadline_ns: int
    counts: QuestionCounts  # of its map

    @property
    def most_bytes(self) -> int:
        return self.command.question.most_bytes if self.command.question else 0


class MapQuestions:
    """The questions under way. Call `step` again and again.

    Args:
        max_bytes: limit for unread replies and answers still to come; a single one can be larger.
    """

    def __init__(
        self,
        ports: Ports,
        metrics: Metrics,
        refused: Counter[str],
        *,
        unread: PendingReplies,
        max_bytes: int,
        rate: float,
    ) -> None:
        self._ports, self._metrics, self._refused, self._unread = ports, metrics, refused, unread
        self._max_bytes, self._rate = max_bytes, rate
        self._waiting: dict[int, WaitingQuestion] = {}
        self._numbers = count(1)
        self._rates: OrderedDict[bytes, Bucket] = OrderedDict()

    def ask(
        self,
        identity: bytes,
        command: messages.Command,
        frames: Sequence[zmq.Frame],
        hosted: HostedMap | None,
        client: str = "",
    ) -> None:
        """Pass a question on to the map's fuser, or reply why not."""
        now_ns, timeout = time.monotonic_ns(), command.timeout_s
        waiting = WaitingQuestion(
            identity,
            client.encode() or identity,
            command,
            now_ns,
            now_ns + (int(1e9 * timeout) if 0 < timeout <= questions.LONGEST_S else 0),
            QuestionCounts() if hosted is None else hosted.questions,
        )
        if hosted is None:
            self._refuse(waiting, f"no map {command.map} is open")
        elif problem := self._why_none(command, [frame.buffer for frame in frames]):
            self._refuse(waiting, problem)
        elif hosted.fuser.failed and not hosted.fuser.ready:
            self._refuse(waiting, hosted.fuser.failed)
        elif problem := self._pass_on(waiting, frames, hosted):
            self._refuse(waiting, problem, retry=True)

    @staticmethod
    def _why_none(command: messages.Command, frames: list[memoryview]) -> str:
        """Return the reason why a question is invalid, or ""."""
        if command.question is None:
            return "nothing was asked"
        if not 0 < command.timeout_s <= questions.LONGEST_S:
            return f"a question may wait up to {questions.LONGEST_S:g} s, got {command.timeout_s:g}"
        return command.question.problem(frames)

    def _pass_on(self, waiting: WaitingQuestion, frames: Sequence[zmq.Frame], hosted: HostedMap) -> str:
        """Ask the fuser. Return the reason why it cannot be asked now, or ""."""
        command = waiting.command
        if not hosted.fuser.ready:
            return "the map is being opened, or its fuser restarts"
        if self._rate_of(waiting.owner).wait(1.0, time.monotonic()):
            return f"a client may ask {self._rate:g} questions a second (quota_questions)"
        of_map = [one for one in self._waiting.values() if one.command.map == command.map]
        if sum(one.owner == waiting.owner for one in self._waiting.values()) >= MOST_OF_A_CLIENT:
            return f"{MOST_OF_A_CLIENT} questions of this client are under way"
        unread, nbytes = self._unread.of(waiting.owner + b"\0")
        is_much = unread >= MOST_OF_A_CLIENT and nbytes > _UNREAD_SHARE * self._max_bytes
        if is_much or unread >= MOST_UNREAD:
            return f"{unread} answers of this client are not read yet"
        if len(of_map) >= MOST_WAITING:
            return "too many questions at once"
        assert command.question is not None
        held = self._unread.nbytes + sum(one.most_bytes for one in self._waiting.values())
        if held and held + command.question.most_bytes > self._max_bytes:
            return "answers that others asked for and do not read fill the memory"
        number = next(self._numbers)
        message = fuser_messages.FuserQuestion(
            number, command.question, waiting.asked_ns, waiting.deadline_ns, command.compress
        )
        if not hosted.fuser.send(message, frames):
            return "too many questions at once"
        self._rate_of(waiting.owner).spend(1.0)
        self._waiting[number] = waiting
        return ""

    def _rate_of(self, owner: bytes) -> Bucket:
        bucket = self._rates.pop(owner, None) or Bucket(self._rate, time.monotonic())
        self._rates[owner] = bucket
        if len(self._rates) > _MOST_CLIENTS:
            self._rates.popitem(last=False)
        return bucket

    def on_answer(self, answer: fuser_messages.FuserAnswer, frames: Sequence[zmq.Frame]) -> None:
        """Send a fuser's answer to the connection that asked, unless the question was refused before."""
        waiting = self._waiting.pop(answer.number, None)
        if waiting is None:
            return
        if answer.answer is None:
            waiting.counts.add("late" if answer.late else "failed")
            self._reply_error(waiting, answer.error, late=answer.late)
            return
        seconds = (time.monotonic_ns() - waiting.asked_ns) / 1e9
        waiting.counts.add("answered", seconds)
        self._metrics.observe_question(waiting.command.map, seconds)
        reply = messages.Reply(name="ask", number=waiting.command.number, answer=answer.answer)
        reader = waiting.owner + b"\0" + answer.number.to_bytes(8, "big")
        self._ports.reply(waiting.identity, reply, self._unread.wrap(reader, frames) if frames else ())

    def step(self) -> None:
        """Refuse the questions whose deadline is over."""
        now_ns = time.monotonic_ns()
        for number, waiting in list(self._waiting.items()):
            if now_ns > waiting.deadline_ns:
                del self._waiting[number]
                waiting.counts.add("late")
                self._reply_error(waiting, questions.LATE, late=True)

    def give_up(self, map_name: str) -> None:
        """Refuse the open questions to a map's fuser: it has ended."""
        for number, waiting in list(self._waiting.items()):
            if waiting.command.map == map_name:
                del self._waiting[number]
                waiting.counts.add("failed")
                self._reply_error(waiting, "the fuser restarts; ask again", retry=True)

    def _refuse(self, waiting: WaitingQuestion, problem: str, *, retry: bool = False) -> None:
        self._refused["question"] += 1
        waiting.counts.add("refused")
        self._reply_error(waiting, f"{problem}; ask again" if retry else problem, retry=retry)

    def _reply_error(
        self, waiting: WaitingQuestion, error: str, *, retry: bool = False, late: bool = False
    ) -> None:
        number = waiting.command.number
        reply = messages.Reply(name="ask", number=number, error=error, retry=retry, late=late)
        self._ports.reply(waiting.identity, reply)
