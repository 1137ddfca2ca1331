# SPDX-License-Identifier: MIT
"""No stranger fills the log: what anybody can bring about goes through its limiter, errors too."""

import http.client
from collections.abc import Iterator
from pathlib import Path

import pytest
from served_gateway import Listening, hosting, record, serving_here

from lab.reliability.attacks import raw
from tsfusion.core import logs
from tsfusion.gateway.health.metrics import HttpAnswer
from tsfusion.gateway.ports.metrics_page import MetricsPage
from tsfusion.gateway.ports.ports import OutgoingAnswer
from tsfusion.wire.messages import messages

MANY = 3 * logs.MOST


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Listening]:
    with serving_here(tmp_path) as made:
        yield made


def test_messages_that_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure("text", "info")
    with hosting(tmp_path) as served:
        served.greet()
        head, *rest = record(1)
        for _ in range(MANY):
            served.take([b"rubbish"])
            served.take([head, *rest[:-1], b"x"])
        assert sum(served.refused.values()) == 2 * MANY
    kinds = 3  # refused at once, asked for again, given up
    assert len(capsys.readouterr().err.splitlines()) <= kinds * logs.MOST + 2


def test_connections_that_are_cut_off(served: Listening, capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure("text", "info")
    for number in range(MANY):
        with raw(served.addresses.data, b"PUSH") as stranger:
            stranger.sendall(b"\x01\x00" * 2000 + b"\x00\x00")
            served.until(lambda: served.gateway.health().refused.get("frames") == number + 1)  # noqa: B023
    assert len(capsys.readouterr().err.splitlines()) <= logs.MOST + 2


def test_memory_that_is_filled_again_and_again(
    served: Listening, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    logs.configure("text", "info")
    monkeypatch.setattr(served.loop.limits._memory, "excess", lambda _: 1 << 30)
    served.until(lambda: served.gateway.health().refused.get("memory", 0) >= logs.MOST + 10)
    assert len(capsys.readouterr().err.splitlines()) <= logs.MOST + 2


def test_answers_that_nobody_reads(served: Listening, capsys: pytest.CaptureFixture[str]) -> None:
    logs.configure("text", "info")
    ports = served.ports
    ports.control.close()
    for _ in range(MANY):
        ports.send(OutgoingAnswer(b"nobody", messages.Reply(name="ping")))
    assert len(capsys.readouterr().err.splitlines()) <= logs.MOST + 2


def test_pages_that_fail(capsys: pytest.CaptureFixture[str]) -> None:
    def fail() -> HttpAnswer:
        raise ValueError("broken")

    logs.configure("text", "info")
    page = MetricsPage("127.0.0.1:0", {"/": fail})
    try:
        for _ in range(MANY):
            link = http.client.HTTPConnection(page.address, timeout=10)
            link.request("GET", "/")
            assert link.getresponse().status == 500
            link.close()
    finally:
        page.close()
    assert capsys.readouterr().err.count("cannot be shown") <= logs.MOST + 1
