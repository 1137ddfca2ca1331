# SPDX-License-Identifier: MIT
"""Routes to the clients that are connected: bounded, and shared fairly."""

from typing import cast

import pytest

from tsfusion.gateway.client_routes import ClientRoutes
from tsfusion.gateway.ports import Ports
from tsfusion.gateway.sessions import Sessions
from tsfusion.wire.messages import Ping

SESSION = bytes(range(16))


def test_strangers_do_not_grow_the_sessions() -> None:
    sessions, routes = Sessions(), ClientRoutes(cast(Ports, None))
    for i in range(3000):
        routes.connect(i.to_bytes(16, "big"), "default", b"id")
        assert sessions.admit(i.to_bytes(16, "big"), 1, 0) == "next"
    assert len(sessions) == 0
    assert routes.get((0).to_bytes(16, "big")) is None
    assert routes.get((2999).to_bytes(16, "big")) is not None


def test_a_live_session_is_not_taken_over() -> None:
    routes = ClientRoutes(cast(Ports, None))
    route = routes.connect(SESSION, "default", b"1", "robot")
    assert not route.open_to("thief")
    assert routes.connect(SESSION, "default", b"3", "robot") is route
    assert route.identity == b"3"
    route.last_message -= 3600
    assert route.open_to("heir")
    assert routes.connect(SESSION, "default", b"4", "heir") is not route
    assert len(list(routes)) == 1


def key_of(number: int) -> bytes:
    return number.to_bytes(16, "big")


def test_a_flood_of_greetings_pushes_out_those_of_its_own_name_only() -> None:
    routes = ClientRoutes(cast(Ports, None))
    routes.connect(SESSION, "default", b"1", "cart")
    for number in range(3000):
        routes.connect(key_of(number), "default", b"2", "robot")
    assert routes.get(SESSION) is not None
    assert sum(route.client == "robot" for route in routes) == 64


def test_many_names_share_the_routes_fairly() -> None:
    routes = ClientRoutes(cast(Ports, None))
    routes.connect(SESSION, "default", b"1", "cart")
    for number in range(6000):
        routes.connect(key_of(number), "default", b"2", f"robot{number % 40}")
    assert routes.get(SESSION) is not None
    assert len(list(routes)) == 1024


def test_who_scans_is_not_pushed_out_by_who_only_greets() -> None:
    routes = ClientRoutes(cast(Ports, None))
    routes.connect(SESSION, "default", b"1")
    routes.mark_alive(SESSION, "", scans=True)
    routes.connect(b"known".ljust(16), "default", b"1", scans=True)
    for number in range(3000):
        routes.connect(key_of(number), "default", b"2")
    assert routes.get(SESSION) is not None
    assert routes.get(b"known".ljust(16)) is not None


def test_who_scanned_once_shuts_nobody_out() -> None:
    routes = ClientRoutes(cast(Ports, None))
    for number in range(2000):
        routes.connect(key_of(number), "default", b"2", scans=True)
    route = routes.connect(SESSION, "default", b"1")
    assert routes.get(SESSION) is route
    assert len(list(routes)) == 1024


@pytest.mark.parametrize("clock", [(1 << 62, 0), (-(1 << 62), 0), (5, -1), (5, 1 << 62), (5, 3601 * 10**9)])
def test_a_clock_that_cannot_be_is_not_believed(clock: tuple[int, int]) -> None:
    route = ClientRoutes(cast(Ports, None)).connect(SESSION, "default", b"1")
    route.update(Ping(SESSION, 1, 7, 3, waiting=2))
    assert (route.offset_ns, route.bound_ns, route.waiting) == (7, 3, 2)
    route.update(Ping(SESSION, 1, *clock, waiting=4))
    assert (route.offset_ns, route.bound_ns, route.waiting) == (None, 0, 4)
