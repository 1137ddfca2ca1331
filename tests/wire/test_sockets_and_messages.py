# SPDX-License-Identifier: MIT
"""Addresses, control messages, clocks, and the gateway's bookkeeping."""

import socket
from typing import Any, cast

import msgspec
import numpy as np
import pytest
import zmq

from tsfusion.core.errors import DecodeError, InvalidConfig, ServerUnreachable, TransportError
from tsfusion.delivery.timing import ClockOffset
from tsfusion.gateway.client_routes import ClientRoutes
from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.keyframe_outcomes import DelayStatistics
from tsfusion.gateway.ports import Ports, Subscriptions
from tsfusion.gateway.sessions import Sessions
from tsfusion.journal import Position, RecordEntry
from tsfusion.wire import messages, sockets
from tsfusion.wire.keyframe_times import Stamps
from tsfusion.wire.messages import Ack, Command, Denied, Hello, Hold, Nack, Ping, Pong, Welcome
from tsfusion.wire.queries import request
from tsfusion.wire.sockets import control_address

SESSION = bytes(range(16))


def test_the_control_socket_is_the_next_port_unless_told() -> None:
    assert control_address("tcp://127.0.0.1:5555") == "tcp://127.0.0.1:5556"
    assert control_address("tcp://127.0.0.1:5555", "tcp://127.0.0.1:9000") == "tcp://127.0.0.1:9000"
    assert control_address("tcp://[::1]:5555") == "tcp://[::1]:5556"


@pytest.mark.parametrize(
    "address",
    [
        *("", "127.0.0.1:5555", "tcp://127.0.0.1", "tcp://:5555", "udp://127.0.0.1:5"),
        *("tcp://127.0.0.1:99999", "tcp://127.0.0.1:5555/x", "tcp://host:port"),
    ],
)
def test_a_malformed_address_is_one_clear_error(address: str) -> None:
    with pytest.raises(InvalidConfig, match="an address looks like"):
        control_address(address)


@pytest.mark.parametrize("address", ["tcp://0.0.0.0:5555", "tcp://*:5555", "tcp://192.168.1.4:5555"])
def test_without_keys_only_this_machine_may_connect(address: str) -> None:
    for word in ("tsfusion keys new server", "tsfusion keys allow", "--keys", "ssh -L"):
        with pytest.raises(InvalidConfig, match=word):
            sockets.check_reachable(address, has_keys=False)
    sockets.check_reachable(address, has_keys=True)
    for own in ("tcp://127.0.0.1:5555", "tcp://localhost:5555", "tcp://[::1]:5555"):
        sockets.check_reachable(own, has_keys=False)


@pytest.mark.parametrize("host", ["*", "0.0.0.0", "127.0.0.1"])
def test_a_server_can_listen_on_every_interface(host: str) -> None:
    context: zmq.Context[Any] = zmq.Context()
    made = sockets.pull(context, 1024), sockets.router(context), sockets.publisher(context)
    try:
        sockets.check_free(f"tcp://{host}:0")
        addresses = sockets.bind(*made, f"tcp://{host}:0", None)
        shown = host.replace("*", "0.0.0.0")
        assert addresses.data.startswith(f"tcp://{shown}:")
        assert sockets.control_address(addresses.data) == addresses.control
    finally:
        for one in made:
            one.close()
        context.term()


def test_a_taken_port_is_one_clear_error() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"cannot listen on {address}: Address already in use"):
            sockets.check_free(address)


def test_a_dead_server_is_one_clear_error() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(ServerUnreachable, match=f"no server answered at {address} within 0.2 s"):
            request(address, Command(name="status"), timeout=0.2)


def test_control_messages_keep_their_bytes() -> None:
    """As others implement them: a change here is a new wire version."""
    key = "000102030405060708090a0b0c0d0e0f"
    golden = (
        (Hello(SESSION, 1), f"83a474797065a568656c6c6fa773657373696f6ec410{key}a776657273696f6e01"),
        (
            Hello(SESSION, 1, map="yard"),
            f"84a474797065a568656c6c6fa773657373696f6ec410{key}a776657273696f6e01a36d6170a479617264",
        ),
        (Ping(b"", 5), "83a474797065a470696e67a773657373696f6ec400a773656e745f6e7305"),
    )
    for message, stored in golden:
        assert messages.encode(message).hex() == stored
        assert messages.decode_to_server(bytes.fromhex(stored)) == message
    for answer in (
        Welcome("e", 1, 3, 2, 8, 1, 1),
        Ack(SESSION, 3, 2, (Stamps(3, 1, 2, 3, 4, 5),), resend=True),
        Denied(SESSION, "map", "no room"),
        Hold(SESSION, 1.5, "disk", "full"),
        Nack(SESSION, 3, "door", "crc", "damaged"),
        Pong("e", 1, 2, 3),
    ):
        assert messages.decode_to_client(messages.encode(answer)) == answer


@pytest.mark.parametrize(
    "frame",
    [
        *(b"", b"\xc1", b"\x80", b"hello", b"\x91" * 500, b"\xa5\xff\xff\xff\xff\xff"),
        msgspec.msgpack.encode({"type": "hello", "session": b"short", "version": 1}),
        msgspec.msgpack.encode({"type": "shutdown"}),
    ],
)
def test_bad_control_messages_raise_one_error(frame: bytes) -> None:
    with pytest.raises(DecodeError):
        messages.decode_to_server(frame)
    with pytest.raises(DecodeError):
        messages.decode_to_client(frame)


@pytest.mark.parametrize("seed", range(5))
def test_the_clock_estimate_stays_within_its_bound(seed: int) -> None:
    """Asymmetric jitter, as on Wi-Fi: the truth lies within half the best round trip."""
    rng = np.random.default_rng(seed)
    true_offset, clock = 3_217_000_000, ClockOffset()
    assert (clock.offset_ns, clock.bound_ns, clock.count) == (None, 0, 0)
    for i in range(40):
        there, work, back = (int(1e6 * value) for value in rng.exponential((2.0, 0.1, 0.5)) + 0.05)
        sent = i * 10**8
        clock.add(
            sent, sent + there + true_offset, sent + there + work + true_offset, sent + there + work + back
        )
        assert clock.offset_ns is not None
        assert abs(clock.offset_ns - true_offset) <= clock.bound_ns
    assert clock.count == 16


# --- sessions ---


def test_each_keyframe_is_admitted_once_and_in_order() -> None:
    sessions = Sessions()
    session = sessions.open(SESSION)
    assert sessions.admit(SESSION, 1, 0) == "next"
    session.durable = 5
    assert [sessions.admit(SESSION, seq, seq - 1) for seq in (5, 6, 7)] == ["duplicate", "next", "gap"]
    assert (
        sessions.admit(SESSION, 9, 5) == sessions.admit(SESSION, 9, 0) == "next"
    )  # the client dropped 6 to 8
    assert sessions.admit(SESSION, 9, 6) == "gap"


def test_sessions_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.gateway.sessions._MAX_SESSIONS", 2)
    sessions = Sessions()
    for key in (SESSION, bytes(16)):
        assert sessions.room_for(key)
        sessions.open(key)
    assert not sessions.room_for(b"s" * 16)
    assert sessions.room_for(SESSION)


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


def index_of(*records: tuple[int, int, bytes, int]) -> tuple[KeyframeIndex, Sessions]:
    index, sessions = KeyframeIndex(), Sessions()
    index.recover([RecordEntry(Position(a, b), key, seq, "", 0) for a, b, key, seq in records], sessions)
    return index, sessions


def test_recovery_counts_a_keyframe_once() -> None:
    other = bytes(16)
    index, sessions = index_of(
        (1, 42, SESSION, 1), (1, 90, other, 1), (1, 140, SESSION, 2), (2, 42, SESSION, 2)
    )
    entries = [index[i] for i in range(len(index))]
    assert [(entry.position.segment, entry.stamps.seq) for entry in entries] == [(1, 1), (1, 1), (1, 2)]
    assert sessions.open(SESSION).durable == 2
    assert [index.after(sessions.open(SESSION), seq) for seq in (0, 1, 2, 9)] == [0, 1, 2, 2]
    assert index.segment(2) == 1


def test_keyframes_whose_segments_are_gone_are_forgotten() -> None:
    other = bytes(16)
    index, sessions = index_of(
        *((1, 1, SESSION, 1), (1, 2, other, 5), (2, 1, SESSION, 2), (2, 2, SESSION, 3), (3, 1, other, 6))
    )
    first, second = sessions.open(SESSION), sessions.open(other)
    first.handed, second.handed = 2, 1
    before = {i: index[i] for i in range(2, 5)}
    index.forget(1, sessions)
    assert len(index) == 5
    index.forget(3, sessions, needed=[4, 1])  # not meshed yet
    assert (len(index), list(first.entries), first.handed) == (4, [2, 3], 1)
    index.forget(3, sessions)
    assert (len(index), list(first.entries), first.handed) == (2, [3], 0)  # 3 is to be handed out
    assert (list(second.entries), second.handed) == ([4], 0)
    assert {i: index[i] for i in (3, 4)} == {i: before[i] for i in (3, 4)}
    assert [index.after(first, seq) for seq in (1, 2, 3)] == [0, 0, 1]
    assert (index.segment(3), index.segment(4)) == (2, 3)
    assert index.add(Position(3, 2), second, 7) == 5
    index.set_fused(5, 8, 9)
    assert (index[5].stamps.seq, index[5].stamps.fused_ns, list(second.entries)) == (7, 9, [4, 5])
    first.handed = second.handed = 1
    index.forget(9, sessions)
    assert (len(index), list(first.entries), list(second.entries), second.handed) == (1, [], [5], 0)


def test_the_index_keeps_stamps() -> None:
    index, sessions = KeyframeIndex(), Sessions()
    index.add(Position(1, 42), sessions.open(SESSION), 1, captured_ns=5, received_ns=6, durable_ns=7)
    index.set_fused(0, 8, 9)
    assert index[0].stamps == Stamps(1, 6, 7, 8, 9, 0)
    assert index[0].captured_ns == 5


def test_delays_are_published_with_their_bound() -> None:
    delays = DelayStatistics()
    assert (delays.summary().count, delays.bound_ms) == (0, 0.0)
    for delay_ns, bound_ns in ((5_000_000, 100_000), (7_000_000, 300_000)):
        delays.add(delay_ns, bound_ns)
    assert (delays.summary().mean, delays.bound_ms) == (6.0, 0.3)


def test_a_delay_that_cannot_be_does_not_count() -> None:
    delays = DelayStatistics()
    day = 86_400 * 10**9
    assert [delays.add(delay, 1000) for delay in (-1000, day, -1001, day + 1, -(1 << 62))] == [
        *(True, True, False, False, False)
    ]
    assert delays.summary().count == 2


@pytest.mark.parametrize("clock", [(1 << 62, 0), (-(1 << 62), 0), (5, -1), (5, 1 << 62), (5, 3601 * 10**9)])
def test_a_clock_that_cannot_be_is_not_believed(clock: tuple[int, int]) -> None:
    route = ClientRoutes(cast(Ports, None)).connect(SESSION, "default", b"1")
    route.update(Ping(SESSION, 1, 7, 3, waiting=2))
    assert (route.offset_ns, route.bound_ns, route.waiting) == (7, 3, 2)
    route.update(Ping(SESSION, 1, *clock, waiting=4))
    assert (route.offset_ns, route.bound_ns, route.waiting) == (None, 0, 4)


# --- subscriptions ---


def test_only_what_can_be_a_maps_topic_is_remembered() -> None:
    topics = Subscriptions()
    for good in (b"", b"me", b"mesh/", b"mesh/y", b"mesh/yard", b"mesh/yard/", b"mesh/attic/"):
        assert topics.add(good, ["yard"])
    for bad in (b"x", b"mesh/Yard", b"mesh/yard/x", b"mesh//", b"mesh/" + b"a" * 33, b"mesh/\n", b"mesh/a\n"):
        assert not topics.add(bad, ["yard"])
    assert len(topics) == 7


def test_topics_are_few_and_those_of_open_maps_have_room() -> None:
    topics = Subscriptions()
    taken = [topics.add(f"mesh/map{i}/".encode(), ["yard"]) for i in range(1000)]
    assert taken.count(True) == len(topics) == 256
    assert not topics.watched("yard")
    assert topics.add(b"mesh/yard/", ["yard"])
    assert topics.watched("yard")
    topics.discard(b"mesh/yard/")
    assert not topics.watched("yard")
    assert topics.watched("map1")
