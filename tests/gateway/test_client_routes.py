# SPDX-License-Identifier: MIT
"""Routes to the clients that are connected: bounded, and shared fairly."""

import pytest

from tsfusion.gateway.clients.client_routes import ClientRoutes, Sessions
from tsfusion.wire.messages.messages import Ping

SESSION = bytes(range(16))


def key_of(number: int) -> bytes:
    return number.to_bytes(16, "big")


def flood(routes: ClientRoutes, count: int, client: str = "", **more: bool) -> None:
    """Greetings of so many sessions; `{}` in the client's name stands for one of forty."""
    for number in range(count):
        routes.connect(key_of(number), "default", b"2", client.format(number % 40), **more)


def test_strangers_do_not_grow_the_sessions() -> None:
    sessions, routes = Sessions(), ClientRoutes([])
    for i in range(3000):
        routes.connect(key_of(i), "default", b"id")
        assert sessions.admit(key_of(i), 1, 0) == "next"
    assert len(sessions) == 0
    assert routes.get(key_of(0)) is None
    assert routes.get(key_of(2999)) is not None


def test_a_live_session_is_not_taken_over() -> None:
    routes = ClientRoutes([])
    route = routes.connect(SESSION, "default", b"1", "robot")
    assert not route.open_to("thief")
    assert routes.connect(SESSION, "default", b"3", "robot") is route
    assert route.identity == b"3"
    route.last_message -= 3600
    assert route.open_to("heir")
    assert routes.connect(SESSION, "default", b"4", "heir") is not route
    assert len(list(routes)) == 1


def test_a_session_is_its_clients_in_the_journal_and_before() -> None:
    routes, sessions = ClientRoutes([]), Sessions()
    sessions.open(key_of(1), "anna")  # its records are journaled; she has left
    routes.connect(key_of(2), "default", b"1", "anna")  # she has just said hello
    for key in (key_of(1), key_of(2)):
        assert [routes.may_continue(key, client, sessions) for client in ("anna", "bob")] == [True, False]


def test_a_flood_of_greetings_pushes_out_those_of_its_own_name_only() -> None:
    routes = ClientRoutes([])
    routes.connect(SESSION, "default", b"1", "cart")
    flood(routes, 3000, "robot")
    assert routes.get(SESSION) is not None
    assert sum(route.client == "robot" for route in routes) == 64


def test_many_names_share_the_routes_fairly() -> None:
    routes = ClientRoutes([])
    routes.connect(SESSION, "default", b"1", "cart")
    flood(routes, 6000, "robot{}")
    assert routes.get(SESSION) is not None
    assert len(list(routes)) == 1024


def test_who_scans_is_not_pushed_out_by_who_only_greets() -> None:
    routes = ClientRoutes([])
    routes.connect(SESSION, "default", b"1")
    routes.mark_alive(SESSION, "", scans=True)
    routes.connect(b"known".ljust(16), "default", b"1", scans=True)
    flood(routes, 3000)
    assert routes.get(SESSION) is not None
    assert routes.get(b"known".ljust(16)) is not None


def test_strangers_do_not_push_out_a_client_that_is_heard() -> None:
    routes = ClientRoutes([])
    client = routes.connect(b"client", "default", b"1")
    for number in range(3000):
        routes.connect(key_of(number), "default", b"2")
        if number % 500 == 0:
            routes.mark_alive(b"client", "")
    assert routes.get(b"client") is client


def test_who_scanned_once_shuts_nobody_out() -> None:
    routes = ClientRoutes([])
    flood(routes, 2000, scans=True)
    route = routes.connect(SESSION, "default", b"1")
    assert routes.get(SESSION) is route
    assert len(list(routes)) == 1024


@pytest.mark.parametrize("clock", [(1 << 62, 0), (-(1 << 62), 0), (5, -1), (5, 1 << 62), (5, 3601 * 10**9)])
def test_a_clock_that_cannot_be_is_not_believed(clock: tuple[int, int]) -> None:
    route = ClientRoutes([]).connect(SESSION, "default", b"1")
    route.update(Ping(SESSION, 1, 7, 3, waiting=2))
    assert (route.offset_ns, route.bound_ns, route.waiting) == (7, 3, 2)
    route.update(Ping(SESSION, 1, *clock, waiting=4))
    assert (route.offset_ns, route.bound_ns, route.waiting) == (None, 0, 4)


def test_who_left_is_gone_until_it_says_hello_again() -> None:
    routes = ClientRoutes([])
    route = routes.connect(SESSION, "default", b"1")
    now = route.last_message
    assert [route.state(now + seconds) for seconds in (0, 6, 31)] == ["connected", "silent", "gone"]
    route.update(Ping(SESSION, 1, skipped={"thinned": 3}, leaving=True))
    assert (route.state(now), route.skipped) == ("gone", {"thinned": 3})
    routes.mark_alive(SESSION, "", scans=True)  # a keyframe that was still on its way
    assert route.state(now) == "gone"
    assert routes.connect(SESSION, "default", b"1").state(now) == "connected"
