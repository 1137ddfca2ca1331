# SPDX-License-Identifier: MIT
"""Figures that an attacked server shows all the time: memory, health, and how long it takes to answer."""

import contextlib
import threading
import time
from pathlib import Path

import zmq
from keyframes_and_servers import Secured, Server, connected
from msgspec import Struct

from tsfusion.wire.messages import messages
from tsfusion.wire.messages.health import Health
from tsfusion.wire.sockets import sockets

_LOOK_S, _ASK_S, _HEALTH_S = 0.02, 0.05, 0.25  # between two looks, questions, questions for the health
_AGAIN_MS = 250  # without an answer for so long: the connection may be another one now
_LAG = 2  # keyframes under way
_ANSWERED_S = 0.25  # the wait for an answer of a server that is well


class Answer(Struct, frozen=True):
    """An answer to a question, and when it was asked (`time.monotonic()`)."""

    asked: float
    waited: float  # seconds
    health: Health | None = None  # None = it was asked for a sign of life alone


class Seen(Struct, frozen=True):
    """Findings of some seconds."""

    gateway_mb: float  # highest RSS
    fuser_mb: float
    control_s: float  # the longest wait for an answer
    restarts: int  # of fusers
    problems: list[str]  # in the server's health


class Watch:
    """Looks at the memory of a server's processes, and asks it for signs of life and its health."""

    def __init__(self, server: Server, keys: Secured) -> None:
        self._server, self._keys = server, keys
        self._over = threading.Event()
        self._memory: list[tuple[float, int, int]] = []  # seconds, bytes of the gateway and the largest fuser
        self._answers: list[Answer] = []
        self._asked = 0.0  # since when a question waits; 0 = none does
        self._threads = [threading.Thread(target=work) for work in (self._look, self._ask)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        self._over.set()
        for thread in self._threads:
            thread.join()

    def begin(self) -> float:
        """Forget the peaks of memory so far; the time."""
        for pid in self._pids():
            with contextlib.suppress(OSError):
                Path(f"/proc/{pid}/clear_refs").write_text("5", encoding="ascii")
        return time.monotonic()

    def seen(self, started: float, ended: float) -> Seen:
        """Findings between two times."""
        memory = [held for at, *held in self._memory if started < at <= ended] or [[0, 0]]
        answers = [one for one in self._answers if started <= one.asked + one.waited and one.asked <= ended]
        waits = [one.waited for one in answers]
        if self._asked:
            waits.append(time.monotonic() - self._asked)
        health = [one.health for one in answers if one.health]
        restarts = [sum(each.fuser_restarts for each in one.maps.values()) for one in health] or [0]
        gateway, fuser = (round(max(each) / 1e6, 1) for each in zip(*memory, strict=True))
        problems = {problem for one in health for problem in one.problems}
        return Seen(
            gateway, fuser, round(max(waits, default=0.0), 3), restarts[-1] - restarts[0], sorted(problems)
        )

    def well(self, since: float) -> bool:
        """True if the server answers at once, is ready, and has fused what the first client sent."""
        healths = [(one.waited, one.health) for one in self._answers if one.asked >= since and one.health]
        if not healths or (self._asked and time.monotonic() - self._asked > _ANSWERED_S):
            return False
        waited, health = healths[-1]
        first = next(
            (client.session for one in self._answers if one.health for client in one.health.clients), ""
        )
        own = [one for one in health.clients if one.session == first]
        lag = [one.durable - one.fused + one.waiting for one in own]
        return waited <= _ANSWERED_S and health.ready and bool(lag) and lag[0] <= _LAG

    def _pids(self) -> list[int]:
        with contextlib.suppress(OSError):
            return [self._server.process.pid, *self._server.children()]
        return []

    def _look(self) -> None:
        while not self._over.wait(_LOOK_S):
            gateway, *fusers = map(peak_rss_bytes, self._pids() or [0])
            self._memory.append((time.monotonic(), gateway, max(fusers, default=0)))

    def _ask(self) -> None:
        questions = {"ping": messages.Command(name="ping"), "health": messages.Command(name="health")}
        health_due = 0.0
        while not self._over.is_set():
            with connected(sockets.dealer, self._server.control, self._keys.keys) as link:
                again = False  # then answers to the same question may come later: they need another link
                while not again and not self._over.wait(_ASK_S):
                    health_due, name = (
                        (time.monotonic() + _HEALTH_S, "health")
                        if time.monotonic() >= health_due
                        else (health_due, "ping")
                    )
                    again = self._wait_for_answer(link, messages.encode(questions[name]))

    def _wait_for_answer(self, link: sockets.AnySocket, question: bytes) -> bool:
        """Send a question until there is an answer; whether it was sent more than once."""
        self._asked, sent = time.monotonic(), 0
        while not self._over.is_set():
            if link.poll(_AGAIN_MS, zmq.POLLOUT):
                with contextlib.suppress(zmq.Again):
                    link.send(question, zmq.NOBLOCK)
                    sent += 1
            if link.poll(_AGAIN_MS):
                reply = messages.decode_to_client(link.recv_multipart()[0])
                waited = time.monotonic() - self._asked
                self._answers.append(Answer(self._asked, waited, getattr(reply, "health", None)))
                break
        self._asked = 0.0
        return sent > 1


def peak_rss_bytes(pid: int) -> int:
    """Highest RSS of a process since `Watch.begin`; 0 when it has ended."""
    return _status_bytes(pid, "VmHWM:")


def rss_bytes(pid: int) -> int:
    """RSS of a process; 0 when it has ended."""
    return _status_bytes(pid, "VmRSS:")


def _status_bytes(pid: int, name: str) -> int:
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text(encoding="ascii").splitlines():
            if line.startswith(name):
                return int(line.split()[1]) * 1024
    return 0
