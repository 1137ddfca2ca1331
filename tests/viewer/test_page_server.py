# SPDX-License-Identifier: MIT
"""The door of a page: who may open it, and what it withstands."""

import http.client
import logging
import socket
import struct
import time
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit

import msgspec
import pytest
import viser
from command_processes import eventually
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.viewer.page import page_door, page_server
from tsfusion.viewer.page.page_guard import PageGuard
from tsfusion.viewer.page.page_server import PageServer

TOKEN = "open-sesame"
DEADLINE = 30.0
PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def page() -> Iterator[PageServer]:
    made = PageServer()
    yield made
    made.close()


@pytest.fixture(scope="module")
def locked() -> Iterator[PageServer]:
    made = PageServer(token=TOKEN)
    yield made
    made.close()


def place(page: PageServer) -> tuple[str, int]:
    found = urlsplit(page.url)
    assert found.hostname is not None
    assert found.port is not None
    return found.hostname, found.port


def get(page: PageServer, path: str = "/", **headers: str) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of an answer."""
    link = http.client.HTTPConnection(*place(page), timeout=DEADLINE)
    try:
        link.putrequest("GET", path, skip_host="Host" in headers)
        for name, value in headers.items():
            link.putheader(name, value)
        link.endheaders()
        answer = link.getresponse()
        return answer.status, dict(answer.headers), answer.read()
    finally:
        link.close()


def visit(page: PageServer, **how: Any) -> ClientConnection:
    """A WebSocket as a browser opens it."""
    at = urlsplit(page.url).netloc
    how = {"origin": f"http://{at}", **how}
    return connect(f"ws://{at}", subprotocols=[PROTOCOL], compression=None, max_queue=None, **how)


def visit_status(page: PageServer, **how: Any) -> int:
    """101, or the status with which a WebSocket is refused."""
    try:
        with visit(page, **how):
            return 101
    except InvalidStatus as refused:
        return refused.response.status_code


def test_the_page_is_served_and_loads_nothing_from_elsewhere(page: PageServer) -> None:
    status, headers, body = get(page)
    assert status == HTTPStatus.OK
    assert b"<html" in body
    assert "default-src 'self'" in headers["Content-Security-Policy"]
    assert headers["Referrer-Policy"] == "no-referrer"
    assert "Set-Cookie" not in headers
    assert visit_status(page) == 101
    assert get(page, "/../../secret")[0] == HTTPStatus.NOT_FOUND


def test_a_foreign_host_is_refused(page: PageServer) -> None:
    host, port = place(page)
    before = page.refused["host"]
    foreign = (
        "evil.example",
        f"evil.example:{port}",
        "192.0.2.7",
        "localhost.evil.example",
        "a b",
        "",
        "[::",
    )
    for name in foreign:
        status, _, body = get(page, Host=name)
        assert (name, status, body.count(b"\n")) == (name, HTTPStatus.FORBIDDEN, 1)
    with socket.create_connection((host, port), DEADLINE) as link:
        link.sendall(f"GET / HTTP/1.1\r\nHost: {host}\r\nHost: evil.example\r\n\r\n".encode())
        assert link.recv(100).startswith(b"HTTP/1.1 403")
    with socket.create_connection((host, port), DEADLINE) as link:
        link.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert link.recv(100).startswith(b"HTTP/1.1 403")
    assert page.refused["host"] - before == len(foreign) + 2
    for name in ("localhost", "LOCALHOST:9000", f"127.0.0.1:{port}", "[::1]:9000"):  # as through `ssh -L`
        assert get(page, Host=name)[0] == HTTPStatus.OK


def test_a_foreign_origin_is_refused(page: PageServer) -> None:
    host, port = place(page)
    before = page.refused["origin"]
    foreign = (
        "http://evil.example",
        f"http://localhost:{port}",
        f"http://{host}:1",
        "null",
        f"ftp://{host}:{port}",
        f"http://{host}:{port}0",
        f"http://{host}:{port}.evil.example",
        f"http://evil.example/{host}:{port}",
    )
    for origin in (*foreign, None):
        assert (origin, visit_status(page, origin=origin)) == (origin, HTTPStatus.FORBIDDEN)
    assert get(page, Origin="http://evil.example")[0] == HTTPStatus.FORBIDDEN
    assert page.refused["origin"] - before == len(foreign) + 2
    with socket.create_connection((host, port), DEADLINE) as link:  # a name that leads here by a foreign DNS
        with pytest.raises(InvalidStatus) as refused:
            connect("ws://evil.example:80", sock=link, origin="http://evil.example", subprotocols=[PROTOCOL])
        assert refused.value.response.status_code == HTTPStatus.FORBIDDEN


def test_a_token_opens_the_page_once_and_a_cookie_from_then_on(
    locked: PageServer, caplog: pytest.LogCaptureFixture
) -> None:
    assert locked.url.endswith(f"/?token={TOKEN}")
    before = locked.refused["token"]
    for path in ("/", "/?token=", "/?token=open-sesam", f"/?token={TOKEN}x", "/?token=%ff%fe", "/index.html"):
        status, headers, body = get(locked, path)
        assert (path, status) == (path, HTTPStatus.FORBIDDEN)
        assert "Set-Cookie" not in headers
        assert b"needs its token" in body
    assert visit_status(locked) == HTTPStatus.FORBIDDEN
    assert locked.refused["token"] - before == 7

    status, headers, _ = get(locked, f"/?token={TOKEN}")
    assert status == HTTPStatus.OK
    cookie, _, attributes = headers["Set-Cookie"].partition(";")
    assert {"HttpOnly", "SameSite=Strict", "Path=/"} <= {word.strip() for word in attributes.split(";")}
    assert TOKEN not in cookie
    assert get(locked, Cookie=f"other=1; {cookie}")[0] == HTTPStatus.OK
    assert visit_status(locked, additional_headers={"Cookie": cookie}) == 101
    for wrong in (cookie[:-1], f"{cookie}0", cookie.partition("=")[0], "=;;", "\u00e9=1"):
        assert get(locked, Cookie=wrong)[0] == HTTPStatus.FORBIDDEN
    assert visit_status(locked, additional_headers={"Cookie": cookie}, origin="http://evil.example") == 403
    assert TOKEN not in caplog.text


@pytest.mark.parametrize("path", [b"/?token=\xff\xfe", b"//[x", b"http://[::1/", b"//[x?token=open-sesame"])
def test_an_address_that_is_none_is_judged_like_any_other(locked: PageServer, path: bytes) -> None:
    """It is no error of the server."""
    host, port = place(locked)
    with socket.create_connection((host, port), timeout=DEADLINE) as link:
        link.sendall(b"GET " + path + f" HTTP/1.1\r\nHost: {host}:{port}\r\n\r\n".encode())
        status = int(link.makefile("rb").readline().split()[1])
    assert status == (HTTPStatus.NOT_FOUND if TOKEN.encode() in path else HTTPStatus.FORBIDDEN)


def test_others_than_this_machine_need_a_token() -> None:
    inside = [PageGuard(host, 80).url for host in ("127.0.0.1", "localhost", "::1", "127.3.2.1")]
    assert not any("token" in url for url in inside)
    assert inside[2] == "http://[::1]:80"
    outside = [PageGuard(host, 80).url for host in ("0.0.0.0", "::", "10.0.0.7", "myhost")]
    tokens = {urlsplit(url).query for url in outside}
    assert len(tokens) == len(outside)
    assert all(token.startswith("token=") and len(token) > 24 for token in tokens)
    assert "0.0.0.0" not in outside[0]
    for bad in ("", "short", "with space", "quote'quote", "x" * 129, "ünicode-token"):
        with pytest.raises(InvalidConfig, match="8 to 128"):
            PageGuard("127.0.0.1", 80, bad)


def test_a_port_in_use_is_an_error_and_no_other_port(page: PageServer) -> None:
    host, port = place(page)
    with pytest.raises(TransportError, match=f"cannot show a map at {host}:{port}: Address already in use"):
        PageServer(host, port)
    with pytest.raises(TransportError, match=r"cannot show a map at 192\.0\.2\.7"):
        PageServer("192.0.2.7", 0)


def test_ipv6(page: PageServer) -> None:
    try:
        made = PageServer("::1", 0)
    except TransportError:
        pytest.skip("no IPv6 here")
    try:
        assert made.url.startswith("http://[::1]:")
        assert get(made)[0] == HTTPStatus.OK
        assert visit_status(made) == 101
    finally:
        made.close()


def sent(page: PageServer, *messages: dict[str, Any]) -> None:
    """Send messages as a browser, the last of which ends the connection."""
    with visit(page) as link, pytest.raises(ConnectionClosed):  # noqa: PT012
        for message in messages:
            link.send(msgspec.msgpack.encode(message))
        while True:
            link.recv(DEADLINE)


def test_nobody_gets_a_tunnel(page: PageServer, monkeypatch: pytest.MonkeyPatch) -> None:
    def tunnel(*_: object) -> None:
        raise AssertionError("a tunnel was asked for")

    monkeypatch.setattr("viser._viser.ViserTunnel", tunnel)
    before = page.refused["message"]
    for name in ("ShareUrlDisconnect", "ShareUrlRequest"):
        sent(page, {"type": name})
    assert page.refused["message"] - before == 2
    assert page.server._share_tunnel is None


def test_a_browser_changes_values_and_nothing_else(page: PageServer) -> None:
    gui = page.server.gui
    slider = gui.add_slider("At", 0.0, 1.0, 0.1, 0.5)
    ends = gui.add_multi_slider("From to", 0.0, 1.0, 0.1, (0.2, 0.8))
    kept = len(page.server._websock_server.get_message_buffer().message_from_id)
    before = slider.min, slider.max, slider.label, ends.value
    uuid, other = slider._impl.uuid, ends._impl.uuid
    wrong = (
        {"type": "GuiFormDirtyMessage", "uuid": "x" * 1000},
        {"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"props": "x"}},
        {"type": "GuiUpdateMessage", "uuid": other, "updates": {"value": "x", "min": 3}},
    )
    start = {
        "type": "FileTransferStartUpload", "source_component_uuid": uuid, "transfer_uuid": "t",
        "filename": "f", "mime_type": "x/y", "part_count": 10**6, "size_bytes": 10**12,
    }  # fmt: skip
    for message in (*wrong, start):
        sent(page, message)
    values = [(other, []), (other, [0.1]), (uuid, []), (uuid, float("nan")), (uuid, 0.75)]
    news = [{"type": "GuiUpdateMessage", "uuid": one, "updates": {"value": value}} for one, value in values]
    sent(page, *news, wrong[0])
    assert slider.value == 0.75
    assert (slider.min, slider.max, slider.label, ends.value) == before
    assert not gui._current_file_upload_states
    assert len(page.server._websock_server.get_message_buffer().message_from_id) <= kept + 1  # the new value


def test_a_message_that_is_none_ends_its_connection_alone(page: PageServer) -> None:
    with visit(page) as other:
        for message in (b"\xc1", b"", msgspec.msgpack.encode({"type": "NoSuch"}), "text", bytes(17 << 20)):
            with visit(page) as link, pytest.raises(ConnectionClosed):  # noqa: PT012
                link.send(message)
                while True:
                    link.recv(DEADLINE)
        other.ping().wait(DEADLINE)


def test_aborted_handshakes_leave_no_output(
    page: PageServer, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    begun = (
        b"", b"GET", b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n", b"\x16\x03\x01\x02\x00\x01",
        b"POST / HTTP/1.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    )  # fmt: skip
    with caplog.at_level(logging.INFO):
        for i in range(100):
            with socket.create_connection(place(page), DEADLINE) as link:
                if i % 2:  # reset instead of an orderly end
                    link.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
                link.sendall(begun[i % len(begun)])
        assert get(page)[0] == HTTPStatus.OK
        assert eventually(lambda: not page._running.handlers)  # type: ignore[union-attr]
    assert capfd.readouterr() == ("", "")
    assert [one.getMessage() for one in caplog.records] == []


def test_connections_are_bounded(page: PageServer, monkeypatch: pytest.MonkeyPatch) -> None:
    assert eventually(lambda: not page._running.handlers)  # type: ignore[union-attr]
    monkeypatch.setattr(page_door, "BROWSERS", 3)
    monkeypatch.setattr(page_door, "KNOCKING", 4)
    browsers = [visit(page) for _ in range(3)]
    assert visit_status(page) == HTTPStatus.SERVICE_UNAVAILABLE
    idle = [socket.create_connection(place(page), DEADLINE) for _ in range(20)]
    assert get(page)[0] == HTTPStatus.OK
    for link in idle[:16]:  # the oldest made room
        assert _ended(link)
    for link in idle[-3:]:
        link.setblocking(False)
        with pytest.raises(BlockingIOError):
            link.recv(1)
    for browser in browsers:
        browser.ping().wait(DEADLINE)
        browser.close()
    assert eventually(lambda: visit_status(page) == 101)
    for link in idle:
        link.close()


def _ended(link: socket.socket) -> bool:
    try:
        return not link.recv(1)
    except ConnectionResetError:
        return True


def test_it_ends_soon_whatever_is_connected(capfd: pytest.CaptureFixture[str]) -> None:
    page = PageServer()
    silent = socket.create_connection(place(page), DEADLINE)
    browser = visit(page)
    started = time.monotonic()
    page.close()
    page.close()
    assert time.monotonic() - started < 5
    assert _ended(silent)
    with pytest.raises(ConnectionClosed):  # noqa: PT012
        while True:
            browser.recv(DEADLINE)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(place(page), DEADLINE)
    silent.close()
    assert capfd.readouterr() == ("", "")
    again = PageServer(*place(page))  # the port is free at once
    again.close()


def test_a_viser_that_goes_another_way_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    import websockets.asyncio.server as module

    real = module.serve
    monkeypatch.setattr(page_server, "partial", lambda *_: real)
    with pytest.raises(TransportError, match="cannot be guarded"):
        PageServer()
    monkeypatch.undo()
    monkeypatch.setattr(page_door, "_MAX_MESSAGE", "much")
    monkeypatch.setattr(PageServer, "_guarded", lambda *_: {"no_such_option": 1})
    with pytest.raises(TransportError, match=r"cannot be guarded.*no_such_option"):
        PageServer()
    assert module.serve is real
