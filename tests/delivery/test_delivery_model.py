# SPDX-License-Identifier: MIT
"""The client's real code between a model of the network and one of the server, step by step, by seed.

Anything may be lost or late on either socket, data that was under way may arrive after what was sent later,
both ends may die at any time. Whatever happens: each keyframe is journaled once and in order, or refused, or
counted as skipped. Nothing else. And each correction is journaled once, in order among them.
"""

import math
import random
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zmq
from keyframes_and_servers import pose

from tsfusion import Keyframe
from tsfusion.core.config import ClientConfig
from tsfusion.delivery import backpressure, control_session, sender
from tsfusion.delivery.backpressure import Backpressure
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.sender import Sender
from tsfusion.delivery.spool import Spool
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.record_header import KeyframeHeader, unpack

POLICIES = ("thin", "drop_oldest", "spool_all", "block")
SEEDS = 40
CORRECTION = -1  # in place of a keyframe's number in the journal


class Clock:
    """`time`, as the client sees it."""

    def __init__(self) -> None:
        self.now = 1000.0

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return int(self.now * 1e9)


class Link:
    """One of the client's connections: what it was given to send, and what it may read."""

    def __init__(self, meanwhile: Callable[[], None] = lambda: None) -> None:
        self.meanwhile = meanwhile  # what other threads do while this one sends
        self.socket = self
        self.problem, self.due = "", 0.0
        self.monitor = SimpleNamespace(socket=self, refused=False, connected=True, connected_since=0.0)
        self.finds_nobody = False
        self.there: deque[Any] = deque()
        self.back: deque[Any] = deque()
        self.old: list[deque[Any]] = []  # what earlier connections still have under way
        self.open = True
        self.ended = False

    def send(self, frame: Any, _: int) -> None:
        self.meanwhile()
        if not self.open or len(self.there) > 50:
            raise zmq.Again
        self.there.append(frame)

    def send_multipart(self, frames: Sequence[Any], _: int, *, copy: bool) -> None:
        assert not copy
        self.send([bytes(frame) for frame in frames], 0)

    def recv_multipart(self, _: int) -> list[bytes]:
        if not self.back:
            raise zmq.Again
        return [self.back.popleft()]

    def check(self, _: float) -> tuple[None, bool]:
        ended, self.ended = self.ended, False
        return None, ended

    def reopen(self) -> None:
        self.old.append(self.there)
        self.there = deque()
        self.back.clear()

    def close(self) -> None:
        pass


class ModelServer:
    """Promises of a server, without files and sockets."""

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.epoch = "0"
        self.window = rng.choice((1, 3, 8))
        self.journal: list[tuple[bytes, int, int]] = []  # session, seq, keyframe
        self.fused: dict[bytes, int] = {}
        self.refused: set[int] = set()
        self.hasty = rng.random() < 0.5  # refuses before it looks for gaps
        self.hold = 0.0  # how likely it is that a keyframe is not wanted now
        self.deny = 0.0

    def durable(self, session: bytes) -> int:
        return max((seq for one, seq, _ in self.journal if one == session), default=0)

    def die(self) -> None:
        self.epoch += "'"

    def on_keyframe(self, frames: list[bytes]) -> list[messages.ToClient]:
        header = unpack(frames[0])
        session, durable = header.session, self.durable(header.session)
        number = header.timestamp_ns if isinstance(header, KeyframeHeader) else CORRECTION
        if self.rng.random() < self.hold:
            seconds = self.rng.choice((-1.0, 0.0, 0.1, 1.0, math.nan))
            return [messages.Hold(session, seconds, "quota", "slower")]
        resend = False
        if header.seq > durable:
            resend = header.previous > durable
            if (self.hasty or not resend) and number % 5 == 3:
                self.refused.add(number)
                return [messages.Nack(session, header.seq, "door", "values", "a three")]
            if not resend:
                self.journal.append((session, header.seq, number))
                if number == CORRECTION:
                    assert max(codec.decode(frames).seqs) < header.seq
        return [messages.Ack(session, self.durable(session), self.fused.get(session, 0), (), resend)]

    def on_control(self, frame: bytes, now_ns: int) -> list[messages.ToClient]:
        message = messages.decode_to_server(frame)
        assert not isinstance(message, messages.Command)
        durable, fused = self.durable(message.session), self.fused.get(message.session, 0)
        if isinstance(message, messages.Ping):
            return [messages.Pong(self.epoch, message.sent_ns, now_ns, now_ns, durable, fused)]
        if self.rng.random() < self.deny:
            return [messages.Denied(message.session, self.rng.choice(("opening", "map")), "not yet")]
        terms = (self.window, 1 << 20, 1 << 20)
        return [messages.Welcome(self.epoch, messages.PROTOCOL_VERSION, durable, fused, *terms)]


class World:
    """Client, network and server; `step` is one thing that happens."""

    def __init__(self, rng: random.Random, folder: Path, clock: Clock) -> None:
        self.rng, self.clock, self.folder = rng, clock, folder
        self.server = ModelServer(rng)
        self.config = ClientConfig(
            policy=rng.choice(POLICIES),
            backlog=rng.choice((1, 4, 8)),
            catch_up=rng.choice((0.001, 0.1, 120.0)),
            min_free_bytes=0,
            segment_bytes=rng.choice((1 << 16, 1 << 20)),
        )
        self.loss = rng.choice((0.0, 0.05, 0.3))
        self.numbers: dict[tuple[bytes, int], int] = {}
        self.offered = 0
        self.skipped: set[int] = set()
        self.dropped: set[int] = set()
        self.corrections: list[tuple[bytes, int]] = []  # session, seq
        self.deaths = 0
        self.busy = True
        self.start_client()

    # --- the client ---

    def start_client(self) -> None:
        self.spool = Spool(self.folder, self.config.segment_bytes)
        self.outbox = Outbox(self.spool, clock=self.clock.monotonic)
        self.pressure = Backpressure(self.outbox, self.config)
        self.sender = Sender("tcp://data", "tcp://control", self.outbox, self.config)
        self.control, self.data = Link(), Link(self.meanwhile)
        self.sender._control, self.sender._data = self.control, self.data  # type: ignore[assignment]
        self.sender._wait = lambda now: None  # type: ignore[method-assign]

    def kill_client(self) -> None:
        """Records that it had under way may still arrive."""
        self.deaths += 1
        self.data.reopen()
        old = self.data.old
        self.end_client()
        self.start_client()
        self.data.old = old

    def end_client(self) -> None:
        self.spool._lock.close()
        for segment in self.spool._journal._kept.values():
            segment.close()
        self.sender._waker.close()
        self.sender._woken.close()

    def meanwhile(self) -> None:
        if self.busy and self.rng.random() < 0.2:
            self.offer()

    def offer(self) -> None:
        if self.pressure.must_wait:
            return
        keyframe = Keyframe(
            points=np.zeros((1, 3), np.float32), T_world_camera=np.eye(4), timestamp_ns=self.offered
        )
        before = {entry.seq for entry in self.spool.waiting}
        seq = self.pressure.put(keyframe)
        if seq is None:
            self.skipped.add(self.offered)
        else:
            self.numbers[self.spool.session, seq] = self.offered
        for gone in before - {entry.seq for entry in self.spool.waiting}:
            self.dropped.add(self.numbers[self.spool.session, gone])
        self.offered += 1

    def correct(self) -> None:
        session = self.spool.session
        taken = [seq for one, seq in self.numbers if one == session]
        if taken:
            seqs = self.rng.sample(taken, min(len(taken), self.rng.choice((1, 5))))
            seq = self.pressure.put_correction(corrections.checked({seq: pose(1) for seq in seqs}))
            assert seq is not None
            self.corrections.append((session, seq))

    # --- the network ---

    def deliver_data(self) -> None:
        lines = [line for line in (self.data.there, *self.data.old) if line]
        if lines:
            self.answer(self.server.on_keyframe(self.rng.choice(lines).popleft()))

    def deliver_control(self) -> None:
        if self.control.there:
            frame = self.control.there.popleft()
            if self.rng.random() >= self.loss:
                self.answer(self.server.on_control(frame, self.clock.monotonic_ns()))

    def answer(self, said: list[messages.ToClient]) -> None:
        self.control.back.extend(
            messages.encode(message) for message in said if self.rng.random() >= self.loss
        )

    def cut_data(self) -> None:
        """Records under way arrive later, in part, or never."""
        self.data.reopen()
        kept = self.rng.randrange(len(self.data.old[-1]) + 1)
        self.data.old[-1] = deque(list(self.data.old[-1])[:kept])
        self.data.ended = self.rng.random() < 0.5  # else nobody notices

    def cut_control(self) -> None:
        self.control.reopen()
        self.control.ended = self.rng.random() < 0.5

    def kill_server(self) -> None:
        self.server.die()
        self.data.there.clear()
        self.data.old.clear()
        self.control.there.clear()
        self.control.back.clear()

    def fuse(self) -> None:
        for session, seq, _ in self.server.journal:
            if seq > self.server.fused.get(session, 0) and self.rng.random() < 0.8:
                self.server.fused[session] = seq
                self.answer([messages.Ack(session, self.server.durable(session), seq)])
                return

    def run_client(self) -> None:
        self.clock.now += self.rng.choice((0.0, 0.001, 0.02, 0.3))
        self.sender._step()

    def step(self) -> None:
        happens: dict[Callable[[], None], float] = {
            self.run_client: 10, self.deliver_data: 6, self.deliver_control: 6, self.offer: 3, self.fuse: 2,
            self.correct: 0.4,
            self.cut_data: 0.1, self.cut_control: 0.1, self.kill_server: 0.05, self.kill_client: 0.05,
        }  # fmt: skip
        self.data.open = self.rng.random() < 0.95
        self.server.hold = self.rng.choice((0.0,) * 9 + (0.5,))
        self.server.deny = self.rng.choice((0.0,) * 9 + (0.5,))
        self.rng.choices([*happens], [*happens.values()])[0]()
        self.check_order()

    def settle(self) -> None:
        """From here on nothing is lost."""
        self.loss = self.server.hold = self.server.deny = 0.0
        self.data.open, self.busy = True, False
        for _ in range(20_000):
            for happens in (self.run_client, self.deliver_data, self.deliver_control, self.fuse):
                happens()
            self.check_order()
            if self.outbox.is_fused:
                return
        raise AssertionError(f"it does not come to an end: {self.outbox.stats()}, {self.outbox.link_state}")

    # --- what must hold ---

    def check_order(self) -> None:
        journaled = self.server.journal[-2:]
        if len(journaled) == 2 and journaled[0][0] == journaled[1][0]:
            assert journaled[0][1] < journaled[1][1]

    def check_corrections(self) -> None:
        journaled = [(session, seq) for session, seq, number in self.server.journal if number == CORRECTION]
        assert journaled == self.corrections
        if not self.deaths:
            stats = self.outbox.stats()
            assert stats.corrections_sent == stats.corrections_acknowledged == len(journaled)

    def check_fates(self) -> None:
        keyframes = [entry for entry in self.server.journal if entry[2] != CORRECTION]
        journaled = [number for _, _, number in keyframes]
        assert len(set(journaled)) == len(journaled)
        for session in {session for session, _, _ in keyframes}:
            own = [number for one, _, number in keyframes if one == session]
            assert own == sorted(own)
        for session, seq, number in keyframes:
            assert self.numbers[session, seq] == number
        refused = self.server.refused
        fates = [set(journaled), refused, self.skipped, self.dropped]
        assert sum(map(len, fates)) == self.offered
        assert set().union(*fates) == set(range(self.offered))
        stats = self.outbox.stats()
        if not self.deaths:
            assert stats.durable == len(journaled)
            assert stats.refused.get("values", 0) == len(refused)
            assert sum(stats.skipped.values()) == len(self.skipped) + len(self.dropped)
            assert stats.sent == self.offered - len(self.skipped)


def play(seed: int, folder: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    clock = Clock()
    for module in (backpressure, control_session, sender):
        if hasattr(module, "time"):
            monkeypatch.setattr(module, "time", clock)
    for name in ("os.fdatasync", "os.fsync"):
        monkeypatch.setattr(name, lambda _: None)
    rng = random.Random(seed)
    world = World(rng, folder, clock)
    for _ in range(rng.choice((200, 1000))):
        world.step()
    world.settle()
    world.check_fates()
    world.check_corrections()
    world.end_client()
    return world


@pytest.mark.parametrize("seed", range(SEEDS))
def test_every_keyframe_has_one_fate(seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    play(seed, tmp_path, monkeypatch)


@pytest.mark.nightly
@pytest.mark.parametrize("block", range(20))
def test_it_stays_so(block: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for seed in range(SEEDS + 100 * block, SEEDS + 100 * (block + 1)):
        play(seed, tmp_path / str(seed), monkeypatch)
