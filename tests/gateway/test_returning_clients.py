# SPDX-License-Identifier: MIT
"""Clients that were silent for a while, or come over another connection than before; in this process."""

from served_gateway import LINK, Served, record

from tsfusion.wire.messages import messages

SESSION = bytes(16)
PING = messages.Ping(SESSION, 1, None, 0, 0, {})


def test_a_client_that_was_silent_is_told_what_was_rejected_at_its_next_ping(served: Served) -> None:
    """A client may not know that it was silent: a server that stands still hears nobody."""
    served.greet()
    (route,), hosted = served.gateway._routes, served.gateway.maps.get("default")
    assert hosted is not None
    route.last_message -= 10.0
    hosted.outcomes._tell(messages.Nack(SESSION, 1, "map", "MapFull", ""))
    served.say(PING)
    assert served.heard(messages.Nack).seq == 1


def test_what_was_rejected_meanwhile_is_told_before_how_far_the_map_is(served: Served) -> None:
    """A client counts as fused what a Welcome covers, unless it was told otherwise."""
    hosted = served.gateway.maps.get("default")
    assert hosted is not None
    hosted.outcomes._tell(messages.Nack(SESSION, 1, "map", "MapFull", ""))
    served.say(messages.Hello(SESSION, messages.PROTOCOL_VERSION))
    kinds = (messages.Nack, messages.Welcome)
    assert [type(served.heard(*kinds)) for _ in kinds] == [*kinds]


def test_a_client_is_asked_for_what_was_lost_on_the_way(served: Served) -> None:
    served.greet()
    for number, answer in ((2, (0, True)), (1, (1, False))):
        served.take(record(number))
        ack = served.heard(messages.Ack)
        assert (ack.durable, ack.resend) == answer


def test_answers_go_over_the_connection_that_was_heard_last(served: Served) -> None:
    """Greetings of ended connections may be read behind those of the one that stands."""
    for link in (LINK, b"ended"):
        served.greet(link=link)
    served.say(PING)
    served.heard(messages.Pong)
    served.take(record(1))
    assert served.heard(messages.Ack).durable == 1


def test_a_client_goes_on_after_a_flood_of_greetings(served: Served) -> None:
    served.greet()
    served.take(record(1))
    served.step()
    for number in range(1, 1100):
        served.greet(session=number.to_bytes(16, "big"), link=b"stranger")
    served.gateway.out.clear()
    served.take(record(2))
    assert served.heard(messages.Ack).durable == 2
