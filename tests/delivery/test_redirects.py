# SPDX-License-Identifier: MIT
"""A client that is sent to another server goes there, with all that is not acknowledged, and not astray."""

import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from keyframes_and_servers import until, wall
from served_gateway import Served, serving_here

from tsfusion import Client
from tsfusion.core.config import ClientConfig
from tsfusion.delivery import sender
from tsfusion.gateway.maps import moved_maps
from tsfusion.gateway.maps.moved_maps import Departed
from tsfusion.wire.sockets.connection import MOST_HOPS


@pytest.fixture
def two(tmp_path: Path) -> Iterator[list[Served]]:
    """Two gateways, of which nobody has anything."""
    with ExitStack() as stack:
        yield [stack.enter_context(serving_here(tmp_path / name)) for name in ("one", "two")]


@pytest.fixture
def client(two: list[Served], tmp_path: Path) -> Iterator[Client]:
    """A client of the first one."""
    with Client(
        two[0].addresses.data, spool=tmp_path / "spool", config=ClientConfig(stall_timeout=0.5)
    ) as made:
        yield made


def send_away(state: Path, data: str, control: str = "") -> None:
    """Write down that the default map is elsewhere."""
    moved_maps.write_departed(state, "default", Departed("00", "", data, control))


def step_until(two: list[Served], reached: object) -> None:
    def all_of_them() -> bool:
        for one in two:
            one.step()
        return bool(reached())  # type: ignore[operator]

    until(all_of_them)


def test_a_client_follows_and_sends_everything(two: list[Served], client: Client, tmp_path: Path) -> None:
    first, second = two
    send_away(tmp_path / "one", second.addresses.data, second.addresses.control)
    for i in range(3):
        client.send(wall(i))
    step_until(two, lambda: client.stats.durable == 3)
    assert (first.durable, second.durable) == (0, 3)
    assert client.connected


def test_servers_that_send_it_to_each_other_are_not_asked_without_end(
    two: list[Served], client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "_HOP_INTERVAL", 1000.0)
    hops: list[object] = []
    follow = sender.Sender._follow
    monkeypatch.setattr(sender.Sender, "_follow", lambda *given: (hops.append(given), follow(*given)))
    send_away(tmp_path / "one", two[1].addresses.data)
    send_away(tmp_path / "two", two[0].addresses.data)
    client.send(wall(0))
    step_until(two, lambda: len(hops) > MOST_HOPS)
    until_then = time.monotonic() + 0.5
    step_until(two, lambda: time.monotonic() > until_then)
    assert len(hops) == MOST_HOPS + 1
    assert client.stats.durable == 0
    assert client.link_state.kind == "moved"


def test_without_keys_nobody_is_sent_to_another_machine(
    two: list[Served], client: Client, tmp_path: Path
) -> None:
    send_away(tmp_path / "one", "tcp://192.0.2.1:5555")
    client.send(wall(0))
    step_until(two, lambda: client.link_state.is_refused)
    assert "sends this client elsewhere" in client.problem
    (tmp_path / "one" / "moved" / "default.json").unlink()
    step_until(two, lambda: client.stats.durable == 1)


def test_a_client_that_is_not_let_in_elsewhere_asks_the_first_server_again(
    two: list[Served], client: Client, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "_HOME_AFTER", 0.3)
    send_away(tmp_path / "one", "tcp://127.0.0.1:1")
    client.send(wall(0))
    step_until(two, lambda: client.link_state.kind == "moved")
    (tmp_path / "one" / "moved" / "default.json").unlink()
    step_until(two, lambda: client.stats.durable == 1)
    assert two[0].durable == 1
