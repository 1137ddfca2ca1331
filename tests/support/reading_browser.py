# SPDX-License-Identifier: MIT
"""A browser that reads all that a live page sends and draws nothing, so that the page can be measured."""

from contextlib import suppress
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any
from urllib.parse import urlsplit

_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (3.0, 3.0, 3.0),
    "fov": 0.9,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 540,
    "image_width": 960,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


class ReadingBrowser:
    """A process that has a page open until it is closed."""

    def __init__(self, url: str) -> None:
        context = get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_read, args=(other, url), daemon=True)
        self._process.start()
        other.close()
        self._pipe.recv()

    def close(self) -> int:
        """End it; the bytes that it has read."""
        self._pipe.send(None)
        read: int = self._pipe.recv()
        self._process.join()
        return read


def _read(pipe: "Connection[Any, Any]", url: str) -> None:
    import msgspec
    import viser
    from websockets.sync.client import connect

    place = urlsplit(url).netloc
    with connect(
        f"ws://{place}", origin=f"http://{place}", subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[arg-type, list-item]
        max_size=None, compression=None,
    ) as link:  # fmt: skip
        link.send(msgspec.msgpack.encode(_CAMERA))
        pipe.send(None)
        read = 0
        while not pipe.poll():
            with suppress(TimeoutError):
                read += len(link.recv(timeout=0.2))
    pipe.send(read)
