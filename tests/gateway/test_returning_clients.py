# SPDX-License-Identifier: MIT
"""Clients that were silent for a while, or come over another connection than before; in this process."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from keyframes_and_servers import connected
from served_gateway import Served, record, serving_here

from tsfusion.wire.messages import messages
from tsfusion.wire.sockets import sockets

SESSION = bytes(16)
PING = messages.encode(messages.Ping(SESSION, 1, None, 0, 0, {}))


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with serving_here(tmp_path) as made:
        yield made


def test_a_client_that_was_silent_is_told_what_was_rejected_at_its_next_ping(served: Served) -> None:
    """A client may not know that it was silent: a server that stands still hears nobody."""
    with connected(sockets.dealer, served.addresses.control) as link:
        served.greet(link, "default")
        (route,), hosted = served.gateway._routes, served.gateway.maps.get("default")
        assert hosted is not None
        route.last_message -= 10.0
        hosted.outcomes._tell(messages.Nack(SESSION, 1, "map", "MapFull", ""))
        link.send(PING)
        assert served.heard(link, messages.Nack).seq == 1


def test_what_was_rejected_meanwhile_is_told_before_how_far_the_map_is(served: Served) -> None:
    """A client counts as fused what a Welcome covers, unless it was told otherwise."""
    hosted = served.gateway.maps.get("default")
    assert hosted is not None
    hosted.outcomes._tell(messages.Nack(SESSION, 1, "map", "MapFull", ""))
    with connected(sockets.dealer, served.addresses.control) as link:
        link.send(messages.encode(messages.Hello(SESSION, messages.PROTOCOL_VERSION)))
        kinds = (messages.Nack, messages.Welcome)
        assert [type(served.heard(link, *kinds)) for _ in kinds] == [*kinds]


def test_a_client_is_asked_for_what_was_lost_on_the_way(served: Served) -> None:
    with (
        connected(sockets.dealer, served.addresses.control) as link,
        connected(sockets.push, served.addresses.data) as push,
    ):
        served.greet(link, "default")
        for number, answer in ((2, (0, True)), (1, (1, False))):
            push.send_multipart(record(number))
            ack = served.heard(link, messages.Ack)
            assert (ack.durable, ack.resend) == answer


def test_answers_go_over_the_connection_that_was_heard_last(served: Served) -> None:
    """Greetings of ended connections may be read behind those of the one that stands."""
    with (
        connected(sockets.dealer, served.addresses.control) as link,
        connected(sockets.dealer, served.addresses.control) as ended,
        connected(sockets.push, served.addresses.data) as push,
    ):
        for each in (link, ended):
            served.greet(each, "default")
        link.send(PING)
        served.heard(link, messages.Pong)
        push.send_multipart(record(1))
        assert served.heard(link, messages.Ack).durable == 1
