# SPDX-License-Identifier: MIT
"""A server under attack lives, keeps to its memory, fuses other scans. Long: lab/reliability/hostile.py."""

from pathlib import Path
from typing import Any

import pytest
import zmq
from keyframes_and_servers import DEADLINE, Server, connected, until, wall

from lab.reliability.attack_target import ACCESS, Access
from lab.reliability.attacks import ATTACKS_OF
from lab.reliability.hostile_run import Bounds, run, table
from tsfusion import Client
from tsfusion.core import process
from tsfusion.gateway.ports.connections import MemoryGuard
from tsfusion.wire.asking.queries import fetch_status, request
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.sockets import sockets


def test_memory_that_does_not_come_back_is_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Reported again, it would drop every connection for ever."""
    held = 0
    monkeypatch.setattr(process, "rss_bytes", lambda: held)
    bound = MemoryGuard(800)
    reported = []
    for held in (700, 800, 850, 900, 950, 960, 980, 1080, 1090, 400, 790, 810):  # noqa: B007
        reported.append(bound.excess(uncounted=0))
    assert reported == [0, 0, 850, 0, 0, 960, 0, 1080, 0, 0, 0, 810]
    assert bound.excess(uncounted=100) == 0


def test_memory_that_was_freed_counts_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    held = [900]
    monkeypatch.setattr(process, "rss_bytes", lambda: held[0])
    monkeypatch.setattr(process, "give_back_memory", lambda: held.__setitem__(0, 500))
    assert MemoryGuard(800).excess(uncounted=0) == 0


LOADED = Bounds(delay_s=10.0, control_s=10.0, slack_bytes=128 << 20)  # a machine that does other things, too


SOME = (  # of each port and each bound one; the bounds of the others have tests of their own
    "bombs", "lies", "rubbish", "corrections", "greetings", "mesh flood", "unfinished", "empty frames",
    "half open", "deaf viewers", "replays", "cameras", "odd questions", "forgetting", "fill",
)  # fmt: skip


@pytest.mark.parametrize(
    ("access", "seconds", "attacks"),
    [
        ("open", 0.1, SOME),
        *(
            pytest.param(access, seconds, ATTACKS_OF[access], marks=pytest.mark.nightly)
            for access in ACCESS
            for seconds in (0.1, 3.0)
        ),
    ],
)
def test_attacks_harm_nobody(
    tmp_path: Path, access: Access, seconds: float, attacks: tuple[str, ...]
) -> None:
    outcome = run(tmp_path, seconds, attacks, access=access, bounds=LOADED)
    assert not outcome.problems, f"{outcome.problems}\n{table(outcome)}"


def test_who_does_not_fetch_a_mesh_gets_no_second_one(shared: Server) -> None:
    """Else each would wait in the server's memory."""

    def one_at_a_time(context: "zmq.Context[Any]") -> sockets.AnySocket:
        made = sockets.dealer(context)
        made.setsockopt(zmq.RCVHWM, 1)
        made.setsockopt(zmq.RCVBUF, 4096)
        return made

    with Client(shared.address) as client:
        client.send(wall(4))
        client.wait_fused(timeout=DEADLINE)
    replies = []
    with connected(one_at_a_time, shared.control) as stranger:
        for _ in range(60):
            stranger.send(messages.encode(Command(name="mesh", min_weight=0.0)))
            request(shared.address, Command(name="status"), timeout=DEADLINE)
        until(lambda: fetch_status(shared.address).fuser != "busy")
        while stranger.poll(1000):
            replies.append(messages.decode_to_client(stranger.recv_multipart()[0]))
    errors = [reply.error for reply in replies if isinstance(reply, messages.Reply) and reply.error]
    assert any("still on its way" in error for error in errors)
