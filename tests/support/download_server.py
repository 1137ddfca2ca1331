# SPDX-License-Identifier: MIT
"""A web server that cuts, changes and refuses a file, and recordings that it serves."""

import hashlib
import http.server
import io
import re
import tarfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from tsfusion.datasets.download.catalogue import File, PublicRecording

CONTENT = np.random.default_rng(0).bytes(3_000_000)


class Server(http.server.ThreadingHTTPServer):
    """Serves `files` in the way that its settings say, and writes down what was asked for."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files: dict[str, bytes] = {"file.bin": CONTENT}
        self.ranges = True
        self.tag: str | None = '"one"'
        self.cuts: list[int] = []  # bytes after which the next answers end
        self.stall: int | None = None  # bytes after which one waits
        self.status: list[int] = []
        self.kind = "application/octet-stream"
        self.redirect: str | None = None
        self.with_length = True
        self.wrong_place = False  # ranges begin a byte late
        self.asked: list[str | None] = []
        self.stalled, self.go_on = threading.Event(), threading.Event()

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no matter."""

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Server
    protocol_version = "HTTP/1.1"

    def log_message(self, format: str, *args: Any) -> None:
        pass

    def do_GET(self) -> None:
        server, asked = self.server, self.headers.get("Range")
        server.asked.append(asked)
        content = server.files.get(self.path.lstrip("/"))
        status = server.status.pop(0) if server.status else 200
        if server.redirect or content is None or status >= 400:
            self.send_response(302 if server.redirect else 404 if content is None else status)
            self.send_header("Location", server.redirect or "")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        start, end = 0, len(content)
        if asked and server.ranges and self.headers.get("If-Range") == server.tag:
            start = int(re.fullmatch(r"bytes=(\d+)-", asked)[1])  # type: ignore[index]
        start += server.wrong_place and start > 0
        if start >= end:
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{end}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{end - 1}/{end}")
        if server.tag is not None:
            self.send_header("ETag", server.tag)
        self.send_header("Content-Type", server.kind)
        if server.with_length:
            self.send_header("Content-Length", str(end - start))
        self.send_header("Connection", "close")
        self.end_headers()
        self.close_connection = True
        cut = server.cuts.pop(0) if server.cuts else None
        body = content[start:] if cut is None else content[start : start + cut]
        if server.stall is not None:
            self.wfile.write(body[: server.stall])
            self.wfile.flush()
            server.stalled.set()
            server.go_on.wait(60)
            return
        self.wfile.write(body)


@contextmanager
def serving() -> Iterator[Server]:
    server = Server()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.go_on.set()
        server.shutdown()
        server.server_close()
        thread.join()


def silent(_done: int, _all: int) -> None:
    pass


def one(url: str, name: str = "file.bin", checksum: str | None = None) -> PublicRecording:
    return PublicRecording(
        "one", "One", "https://example.org", "none", (File(f"{url}/{name}", name, checksum),)
    )


def sha256(content: bytes = CONTENT) -> str:
    return hashlib.sha256(content).hexdigest()


def tarred(*members: tuple[str, bytes], kind: bytes = tarfile.REGTYPE) -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as archive:
        for name, data in members:
            member = tarfile.TarInfo(name)
            member.type, member.size, member.linkname = kind, len(data), "/etc/passwd"
            archive.addfile(member, io.BytesIO(data))
    return content.getvalue()
