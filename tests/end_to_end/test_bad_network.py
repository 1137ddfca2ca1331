# SPDX-License-Identifier: MIT
"""The bad network of the chaos tests is as bad as it says, and no worse."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from bad_network import Proxy
from keyframes_and_servers import until

PATIENCE = 10.0


class Echo:
    """Sends back what it gets, on two ports."""

    def __init__(self) -> None:
        self._listening = [socket.create_server(("127.0.0.1", 0)) for _ in range(2)]
        self.addresses = [f"tcp://127.0.0.1:{one.getsockname()[1]}" for one in self._listening]
        self._ended = False
        self._threads = [threading.Thread(target=self._serve, args=(one,)) for one in self._listening]
        for thread in self._threads:
            thread.start()

    def _serve(self, listening: socket.socket) -> None:
        listening.settimeout(0.05)
        connected: list[socket.socket] = []
        while not self._ended:
            try:
                made, _ = listening.accept()
                made.settimeout(0.02)
                connected.append(made)
            except TimeoutError:
                pass
            for one in list(connected):
                try:
                    content = one.recv(1 << 16)
                    one.sendall(content)
                    if not content:
                        raise ConnectionError
                except TimeoutError:
                    pass
                except OSError:
                    connected.remove(one)
                    one.close()
        for one in connected:
            one.close()
        listening.close()

    def close(self) -> None:
        self._ended = True
        for thread in self._threads:
            thread.join(PATIENCE)


@pytest.fixture
def proxy() -> Iterator[Proxy]:
    echo = Echo()
    with Proxy() as made:
        made.target(*echo.addresses)
        yield made
    echo.close()


@contextmanager
def connected(proxy: Proxy, port: int = 0) -> Iterator[socket.socket]:
    address = ("127.0.0.1", int(proxy.address.rpartition(":")[2]) + port)
    with socket.create_connection(address, timeout=PATIENCE) as made:
        yield made


@contextmanager
def talking(proxy: Proxy) -> Iterator[socket.socket]:
    """A connection that something has gone over."""
    with connected(proxy) as made:
        assert echoed(made, b"a") == b"a"
        yield made


def silent(link: socket.socket) -> bool:
    """Nothing comes for a while."""
    link.settimeout(0.2)
    with pytest.raises(TimeoutError):
        link.recv(1)
    link.settimeout(PATIENCE)
    return True


def echoed(link: socket.socket, content: bytes) -> bytes:
    link.sendall(content)
    return received(link, len(content))


def received(link: socket.socket, size: int) -> bytes:
    got = b""
    while len(got) < size and (more := link.recv(1 << 16)):
        got += more
    return got


def test_it_carries_both_ports_both_ways(proxy: Proxy) -> None:
    for port in (0, 1):
        with connected(proxy, port) as link:
            content = bytes(range(256)) * 1000
            assert echoed(link, content) == content
    assert proxy.carried >= 2 * 2 * 256_000


def test_a_cut_ends_what_is_connected_and_nothing_else(proxy: Proxy) -> None:
    with connected(proxy) as link, connected(proxy) as other:
        assert echoed(link, b"a") == echoed(other, b"a") == b"a"
        proxy.cut()
        with pytest.raises(ConnectionError):
            assert link.recv(1) == b"never"
    with connected(proxy) as link:
        assert echoed(link, b"b") == b"b"


def test_it_refuses_until_it_does_not(proxy: Proxy) -> None:
    with talking(proxy) as before:
        proxy.refuse(True)
        with pytest.raises(ConnectionRefusedError), connected(proxy):
            pass
        assert echoed(before, b"still here") == b"still here"
    proxy.heal()
    with talking(proxy):
        pass


def test_nobody_behind_it(proxy: Proxy) -> None:
    proxy.target(None)
    with connected(proxy) as link:
        assert link.recv(1) == b""


def test_it_is_as_slow_as_told(proxy: Proxy) -> None:
    proxy.throttle(100_000)
    with connected(proxy) as link:
        started = time.monotonic()
        assert echoed(link, bytes(20_000)) == bytes(20_000)  # twice 20 kB
        assert time.monotonic() - started > 0.3
        proxy.throttle(None)
        proxy.delay(0.05)
        started = time.monotonic()
        assert echoed(link, b"a") == b"a"
        assert time.monotonic() - started >= 0.1


def test_lost_packets_come_later_and_all_of_them_come(proxy: Proxy) -> None:
    proxy.lose(0.5, again_s=0.1)
    with connected(proxy) as link:
        content = bytes(range(256)) * 200
        started = time.monotonic()
        assert echoed(link, content) == content
    assert time.monotonic() - started >= 0.1
    assert 10 < proxy.lost < 2 * 36 + 40


def test_a_frozen_link_loses_nothing(proxy: Proxy) -> None:
    with talking(proxy) as link:
        proxy.freeze(True)
        link.sendall(b"later")
        assert silent(link)
        proxy.freeze(False)
        assert received(link, 5) == b"later"


def test_a_muted_server_is_heard_later(proxy: Proxy) -> None:
    with talking(proxy) as link:
        proxy.mute(True)
        before = proxy.carried
        link.sendall(b"late")
        until(lambda: proxy.carried >= before + len(b"late"), PATIENCE)
        assert silent(link)
        proxy.heal()
        assert received(link, 4) == b"late"


def test_what_is_jammed_comes_after_what_came_later(proxy: Proxy) -> None:
    with talking(proxy) as link:
        proxy.jam(True)
        link.sendall(b"late")
        with connected(proxy) as other:
            assert echoed(other, b"sooner") == b"sooner"
        proxy.heal()
        assert received(link, 4) == b"late"


def test_what_is_swallowed_never_comes(proxy: Proxy) -> None:
    proxy.swallow(True)
    with connected(proxy) as link:
        link.sendall(b"lost")
        assert silent(link)
        proxy.swallow(False)
        with pytest.raises(ConnectionError):
            assert link.recv(1)
    with talking(proxy):
        pass


def test_half_closed(proxy: Proxy) -> None:
    with talking(proxy) as link:
        before = proxy.carried
        proxy.half_close()
        assert link.recv(1) == b""
        link.sendall(b"still there")
        until(lambda: proxy.carried >= before + len(b"still there"), PATIENCE)


def test_what_is_forgotten_says_nothing_ever_again(proxy: Proxy) -> None:
    with talking(proxy) as before:
        proxy.forget()
        before.sendall(b"lost")
        with connected(proxy) as after:
            assert echoed(after, b"new") == b"new"
        assert silent(before)


def test_a_black_hole_takes_what_is_connected_while_it_lasts(proxy: Proxy) -> None:
    with talking(proxy) as before:
        proxy.black_hole(True)
        with connected(proxy) as during:
            for link in (before, during):
                link.sendall(b"lost")
            assert silent(before)
            proxy.heal()
            with talking(proxy):
                pass
            assert silent(during)
            assert silent(before)
