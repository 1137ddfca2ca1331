# SPDX-License-Identifier: MIT
"""A bad network between scanner and server: a TCP proxy that cuts, refuses, delays, forgets, flips, swallows.

It runs in a thread of its own; every method may be called from any other.
"""

import asyncio
import contextlib
import random
import socket
import struct
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

_CHUNK = 16 << 10  # bytes taken at once: what a throttled link holds beyond the kernel's buffers
_BUFFER = 64 << 10  # of each socket, so that a slow link is felt at its other end
_PACKET = 1460  # bytes, over Ethernet
_PATIENCE = 10.0
_PORT_TRIES = 32

T = TypeVar("T")


class Proxy:
    """Two neighbouring ports in front of a server's data and control port.

    The server may come back on other ports: `target` says where it is.

    Attributes:
        address: connect a client here; its control socket is the next port, as with a server.
        carried: bytes passed on, both ways.
        flipped: bytes that were changed on the way.
        lost: packets that were lost, and came later.
    """

    def __init__(self) -> None:
        self.carried = self.flipped = 0
        self._flips_every = 0
        self._rng = random.Random(0)
        self._upstream: dict[int, int | None] = {}
        self._listeners: list[asyncio.Server] = []
        self._connections: set[tuple[asyncio.StreamWriter, asyncio.StreamWriter]] = set()
        self._streams: set[asyncio.Event] = set()  # whether a data connection's content comes
        self._forgotten: set[asyncio.StreamWriter] = set()  # ends of connections over which nothing comes
        self._forgets_new = False
        self._tasks: set[asyncio.Task[None]] = set()
        self._rate: float | None = None
        self._delay = 0.0
        self._lost_share, self._again_s = 0.0, 0.0
        self.lost = 0
        self._swallows = False
        self._free_at = 0.0  # when the throttled link has carried what it was given
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="proxy", daemon=True)
        self._thread.start()
        self._ports = _neighbours()
        self._ways = {(port, way): asyncio.Event() for port in self._ports for way in ("forth", "back")}
        self._shut(False, *self._ways)
        self.address = f"tcp://127.0.0.1:{self._ports[0]}"
        self._run(self._listen())

    def target(self, data: str | None, control: str | None = None) -> None:
        """Lead to this server from now on; None: close connections at once."""
        ports = [None if one is None else int(one.rpartition(":")[2]) for one in (data, control)]
        self._upstream = dict(zip(self._ports, ports, strict=True))

    def cut(self) -> None:
        """Reset every connection; new ones are let in."""
        self._run(self._cut())

    def refuse(self, refused: bool) -> None:
        """Stop (or begin again) to listen. What is connected stays."""
        self._run(self._deafen() if refused else self._listen())

    def throttle(self, bytes_per_second: float | None) -> None:
        """Carry so much and no more, all connections and both ways together; None = all there is."""
        self._rate = bytes_per_second

    def delay(self, seconds: float) -> None:
        """Each way takes so long, and no connection carries more than 16 kB in that time."""
        self._delay = seconds

    def lose(self, share: float, *, again_s: float = 0.05) -> None:
        """Lose a share of the packets: TCP sends them again, so that they and all behind them come later.

        Args:
            again_s: seconds until a lost packet comes after all.
        """
        self._lost_share, self._again_s = share, again_s

    def freeze(self, frozen: bool) -> None:
        """Carry nothing, lose nothing: as when packets are lost and sent again later."""
        self._shut(frozen, *self._ways)

    def mute(self, muted: bool) -> None:
        """Carry nothing back, lose nothing: what the server answers comes late."""
        self._shut(muted, *((port, "back") for port in self._ports))

    def jam(self, jammed: bool) -> None:
        """Let data that are under way come late, after what is sent over new connections meanwhile."""
        self._loop.call_soon_threadsafe(self._jam, jammed)

    def _jam(self, jammed: bool) -> None:
        for stream in self._streams:
            if jammed:
                stream.clear()
            else:
                stream.set()

    def _shut(self, shut: bool, *ways: tuple[int, str]) -> None:
        for way in ways:
            event = self._ways[way]
            self._loop.call_soon_threadsafe(event.clear if shut else event.set)

    def swallow(self, swallows: bool) -> None:
        """Accept connections and bytes, and let all of it vanish. Those connections end with it."""
        self._swallows = swallows
        if not swallows:
            self.cut()

    def forget(self) -> None:
        """Let all that is sent over the present connections vanish, both ways, and say nothing: as a NAT that
        forgot them, or after a scanner roamed to another address. New connections are carried."""
        self._run(self._forget())

    def black_hole(self, begun: bool) -> None:
        """As `forget`, for as long as it lasts also for new connections; none of them ever works again."""
        self._forgets_new = begun
        if begun:
            self.forget()

    def flip(self, every: int) -> None:
        """Flip a bit of one byte in so many, at random places of both ways; 0 = none."""
        self._flips_every = every

    def half_close(self) -> None:
        """Tell every client that the server has said its last, and go on carrying what the client says."""
        self._run(self._half_close())

    def heal(self) -> None:
        """A good network again."""
        self.throttle(None)
        self.delay(0.0)
        self.lose(0.0)
        self.freeze(False)
        self.jam(False)
        self.black_hole(False)
        self.flip(0)
        if self._swallows:
            self.swallow(False)
        if not self._listeners:
            self.refuse(False)

    def close(self) -> None:
        """End everything."""
        self._run(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(_PATIENCE)
        self._loop.close()

    def __enter__(self) -> "Proxy":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # --- in the loop's thread ---

    def _run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(_PATIENCE)

    async def _listen(self) -> None:
        for port in self._ports:
            listening = _socket()
            listening.bind(("127.0.0.1", port))
            server = await asyncio.start_server(self._accept, sock=listening, limit=_CHUNK)
            self._listeners.append(server)

    async def _deafen(self) -> None:
        for listener in self._listeners:
            listener.close()
        self._listeners.clear()

    async def _cut(self) -> None:
        for pair in list(self._connections):
            for writer in pair:
                _reset(writer)

    async def _forget(self) -> None:
        for pair in self._connections:
            self._forgotten.update(pair)

    async def _half_close(self) -> None:
        for client, _ in list(self._connections):
            with contextlib.suppress(OSError, RuntimeError):
                client.write_eof()

    async def _end(self) -> None:
        await self._deafen()
        await self._cut()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        self._tasks.add(task)
        try:
            await self._join(reader, writer)
        except (OSError, asyncio.CancelledError):  # either end went away, or all is over
            pass
        finally:
            writer.transport.abort()
            self._tasks.discard(task)

    async def _join(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        entered = writer.get_extra_info("sockname")[1]
        port = self._upstream.get(entered)
        if port is None:
            return
        away = _socket()
        away.setblocking(False)
        await self._loop.sock_connect(away, ("127.0.0.1", port))
        far_reader, far_writer = await asyncio.open_connection(sock=away, limit=_CHUNK)
        pair = (writer, far_writer)
        stream = asyncio.Event()
        stream.set()
        self._connections.add(pair)
        if self._forgets_new:
            self._forgotten.update(pair)
        if entered == self._ports[0]:
            self._streams.add(stream)
        try:
            await asyncio.gather(
                self._pump(reader, far_writer, self._ways[entered, "forth"], stream),
                self._pump(far_reader, writer, self._ways[entered, "back"]),
            )
        finally:
            self._connections.discard(pair)
            self._forgotten.difference_update(pair)
            self._streams.discard(stream)
            far_writer.transport.abort()

    async def _pump(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, *ways: asyncio.Event
    ) -> None:
        """Carry one direction of a connection until it ends."""
        while chunk := await self._read(reader, writer):
            await asyncio.sleep(self._wait(len(chunk)) + self._loss(len(chunk)))
            for way in ways:
                await way.wait()
            if not self._swallows and writer not in self._forgotten:
                with contextlib.suppress(RuntimeError):  # half closed: nothing goes that way any more
                    self.carried += len(chunk)
                    writer.write(self._worn(chunk))
                await writer.drain()
        if writer not in self._forgotten:
            with contextlib.suppress(OSError, RuntimeError):
                writer.write_eof()

    def _worn(self, chunk: bytes) -> bytes:
        """The bytes as they come out at the other end."""
        worn = bytearray(chunk)
        for place in range(len(worn)) if self._flips_every else ():
            if self._rng.random() * self._flips_every < 1:
                worn[place] ^= 1 << self._rng.randrange(8)
                self.flipped += 1
        return bytes(worn)

    async def _read(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> bytes:
        try:
            return await reader.read(_CHUNK)
        except OSError:
            if writer not in self._forgotten:  # else nobody tells the other end
                raise
            return b""

    def _loss(self, size: int) -> float:
        """Seconds until the last packet of so many bytes is there; those lost together come together."""
        lost = sum(self._rng.random() < self._lost_share for _ in range(-(-size // _PACKET)))
        self.lost += lost
        return self._again_s if lost else 0.0

    def _wait(self, size: int) -> float:
        now = self._loop.time()
        if self._rate is None:
            return self._delay
        self._free_at = max(self._free_at, now) + size / self._rate
        return self._delay + self._free_at - now


def _reset(writer: asyncio.StreamWriter) -> None:
    """End a connection without a farewell (RST): as when a router forgets it."""
    made = writer.get_extra_info("socket")
    if made is not None and made.fileno() >= 0:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    writer.transport.abort()


def _socket() -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    for option in (socket.SO_RCVBUF, socket.SO_SNDBUF):  # an accepted one inherits them
        made.setsockopt(socket.SOL_SOCKET, option, _BUFFER)
    return made


def _neighbours() -> tuple[int, int]:
    """Two free ports, one after the other."""
    for _ in range(_PORT_TRIES):
        with _socket() as first, _socket() as second:
            first.bind(("127.0.0.1", 0))
            port = first.getsockname()[1]
            with contextlib.suppress(OSError, OverflowError):
                second.bind(("127.0.0.1", port + 1))
                return port, port + 1
    raise OSError("no two neighbouring ports are free")
