# SPDX-License-Identifier: MIT
"""Answers of a server to another that asks for a map: only files of the map, and never its only copy."""

import queue
import threading
import zlib
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import pytest
from served_gateway import LINK, Served, hosting, record

from tsfusion.core.errors import DecodeError, JournalError, TransportError
from tsfusion.gateway.migration import map_arrivals, map_departures
from tsfusion.wire.asking.queries import CommandRefused
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command, Reply
from tsfusion.wire.messages.migration_messages import HandOver, MapFile, Parcel

MOVE, SESSION = bytes(range(16)), bytes(16)


class Asking:
    """A gateway with three records, and the other server, which asks it."""

    def __init__(self, served: Served, state: Path) -> None:
        self.served, self.state = served, state
        served.greet("default")
        for seq in (1, 2, 3):
            served.take(record(seq))
        served.until(lambda: served.durable == 3)

    def ask(self, step: str, **fields: Any) -> Reply:
        question = HandOver(move=fields.pop("move", MOVE), step=step, **fields)  # type: ignore[arg-type]
        self.served.step()  # time passes
        reply: Reply = self.served.ask(Command(name="hand_over", hand_over=question))
        return reply

    def parcel(self, step: str, **fields: Any) -> Parcel:
        reply = self.ask(step, **fields)
        assert reply.error is None
        assert reply.parcel is not None
        return reply.parcel


@pytest.fixture
def asking(tmp_path: Path) -> Iterator[Asking]:
    with hosting(tmp_path) as served:
        yield Asking(served, tmp_path)


def test_a_map_is_listed_read_frozen_and_given_away(asking: Asking) -> None:
    (file,) = (one for one in asking.parcel("list").files if one.name.startswith("journal/"))
    parcel = asking.parcel("read", file=file.name)
    (piece,) = asking.served.frames
    assert (len(piece), zlib.crc32(piece)) == (file.nbytes, parcel.crc32)
    assert piece == (asking.state / "maps/default" / file.name).read_bytes()
    frozen = asking.parcel("freeze")
    assert [(one.key, one.durable) for one in frozen.sessions] == [(SESSION, 3)]
    asking.served.take(record(4))
    asking.served.until(lambda: asking.served.refused.get("map") == 1)
    for _ in range(2):  # an answer that was lost is asked for again
        asking.parcel("commit", address="tcp://127.0.0.1:9", control="tcp://127.0.0.1:10")
    assert asking.ask("list").error == "no map default is open here, or its move was given up"
    denied = asking.served.greet()
    assert (denied.reason, denied.address, denied.control) == (
        "moved", "tcp://127.0.0.1:9", "tcp://127.0.0.1:10",
    )  # fmt: skip
    assert (asking.state / "moved/default" / file.name).stat().st_size == file.nbytes


def test_nothing_is_given_away_that_was_not_frozen_for_this_move(asking: Asking) -> None:
    assert "its move was given up" in str(asking.ask("commit", address="tcp://127.0.0.1:9").error)
    asking.parcel("list")
    assert "its move was given up" in str(asking.ask("commit", address="tcp://127.0.0.1:9").error)
    assert "moving to another server already" in str(asking.ask("list", move=bytes(16)).error)
    asking.parcel("freeze")
    assert "its move was given up" in str(asking.ask("commit", move=bytes(16)).error)
    asking.parcel("cancel")
    asking.served.take(record(4))
    asking.served.until(lambda: asking.served.durable == 4)


def test_a_server_that_falls_silent_loses_its_claim(asking: Asking, monkeypatch: pytest.MonkeyPatch) -> None:
    asking.parcel("list")
    asking.parcel("freeze")
    monkeypatch.setattr(map_departures, "_FROZEN_S", 0.05)
    while not (ack := asking.served.heard(messages.Ack)).resend:
        pass
    assert ack.durable == 3
    asking.served.take(record(4))
    asking.served.until(lambda: asking.served.durable == 4)
    assert "its move was given up" in str(asking.ask("commit", address="tcp://127.0.0.1:9").error)


@pytest.mark.parametrize("steps", [("list",), ("list", "freeze")])
def test_another_server_takes_the_place_of_a_silent_one(
    asking: Asking, monkeypatch: pytest.MonkeyPatch, steps: tuple[str, ...]
) -> None:
    other, address = bytes(16), {"address": "tcp://127.0.0.1:9", "control": "tcp://127.0.0.1:10"}
    for step in steps:
        asking.parcel(step)
    monkeypatch.setattr(map_departures, "_DOUBTED_S", 0.0)  # it may have been killed: ask again
    refused = asking.ask("list", move=other)
    assert (refused.retry, "moving to another server already" in str(refused.error)) == (True, True)
    asking.parcel(steps[-1])  # it lives
    monkeypatch.setattr(map_departures, "_REPLACED_S", 0.0)
    assert "its move was given up" in str(asking.ask("freeze", move=other).error)  # that is no beginning
    asking.parcel("list", move=other)
    monkeypatch.undo()
    assert "moving to another server already" in str(asking.ask(steps[-1]).error)
    assert "its move was given up" in str(asking.ask("commit", **address).error)
    asking.served.take(record(4))
    asking.served.until(lambda: asking.served.durable == 4)  # until it is frozen for the other
    asking.parcel("freeze", move=other)
    asking.parcel("commit", move=other, **address)


def test_a_move_that_cannot_begin_leaves_the_map_as_it_was(
    asking: Asking, monkeypatch: pytest.MonkeyPatch
) -> None:
    hosted = asking.served.gateway.maps.get("default")
    assert hosted is not None

    def fails() -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as full:
        full.setattr(hosted.records.journal, "rotate", fails)
        assert "cannot close a file" in str(asking.ask("list").error)
    assert not hosted.is_leaving
    assert asking.parcel("list").files
    assert hosted.is_leaving


def test_a_map_that_forgets_keyframes_does_not_leave(asking: Asking, monkeypatch: pytest.MonkeyPatch) -> None:
    hosted = asking.served.gateway.maps.get("default")
    assert hosted is not None
    with monkeypatch.context() as forgetting:
        forgetting.setattr(type(hosted.forgetting), "is_idle", False)
        refused = asking.ask("list")
        assert (refused.retry, "forgets keyframes: ask again" in str(refused.error)) == (True, True)
    assert not hosted.is_leaving
    assert asking.parcel("list").files


class Arriving(map_arrivals.MapArrival):
    """A map that comes, of a server that answers as it is told to; no thread asks."""

    def __init__(self, folder: Path, answers: list[tuple[Parcel, list[memoryview]]]) -> None:
        self.folder, self._answers, self._stopping = folder, answers, threading.Event()
        self._have, self._copied = {}, 0
        self.asked: list[tuple[str, int]] = []

    def _ask(self, link: Any, step: str, *, file: str = "", offset: int = 0, **_: Any) -> Any:
        assert step == "read"
        self.asked.append((file, offset))
        return self._answers.pop(0)


def piece_of(content: bytes) -> tuple[Parcel, list[memoryview]]:
    return Parcel(crc32=zlib.crc32(content)), [memoryview(content)]


def test_a_piece_that_was_damaged_on_its_way_ends_the_move(tmp_path: Path) -> None:
    parcel, _ = piece_of(b"piece")
    arriving = Arriving(tmp_path, [(parcel, [memoryview(b"peace")])])
    with pytest.raises(JournalError, match=r"a piece of map\.tsf was damaged on its way"):
        arriving._take_files(None, (MapFile("map.tsf", 5, "1"),))  # type: ignore[arg-type]
    assert (tmp_path / "map.tsf").read_bytes() == b""


def test_a_checkpoint_of_another_version_is_copied_from_its_start(tmp_path: Path) -> None:
    """It is another file, and may be longer; a segment grows and goes on where it was."""
    arriving = Arriving(
        tmp_path, [piece_of(b"older"), piece_of(b"rec"), piece_of(b"the newer"), piece_of(b"ord")]
    )
    first = (MapFile("map.tsf", 5, "1"), MapFile("journal/000001.mcap", 3, ""))
    arriving._take_files(None, first)  # type: ignore[arg-type]
    arriving._take_files(None, first)  # type: ignore[arg-type]
    then = (MapFile("map.tsf", 9, "2"), MapFile("journal/000001.mcap", 6, ""))
    arriving._take_files(None, then)  # type: ignore[arg-type]
    assert arriving.asked[2:] == [("map.tsf", 0), ("journal/000001.mcap", 3)]
    assert (tmp_path / "map.tsf").read_bytes() == b"the newer"
    assert (tmp_path / "journal/000001.mcap").read_bytes() == b"record"


@pytest.mark.parametrize(
    "file", ["../../lock", "journal/../map.tsf", "/etc/passwd", "quarantine/../../x.mcap", "fuser.lock"]
)
def test_other_files_cannot_even_be_asked_for(file: str) -> None:
    question = {"move": MOVE, "step": "read", "file": file}
    content = msgspec.msgpack.encode({"type": "command", "name": "hand_over", "hand_over": question})
    with pytest.raises(DecodeError):
        messages.decode_to_server(content)


def test_who_reads_no_answer_gets_no_more(asking: Asking, monkeypatch: pytest.MonkeyPatch) -> None:
    asking.parcel("list")
    monkeypatch.setattr(asking.served.gateway.moves._unread, "max_bytes", -1)
    assert "wait to be read" in str(asking.ask("list").error)


@pytest.mark.parametrize(
    ("source", "error"),
    [
        ("tcp://192.0.2.1:5555", "without keys"),
        ("nonsense", "an address looks like"),
        ("", "an address looks like"),
    ],
)
def test_a_map_is_not_fetched_from_anywhere(asking: Asking, source: str, error: str) -> None:
    reply = asking.served.ask(Command(name="move", map="yard", source=source))
    assert error in reply.error


class Link:
    """As much of an `Exchange` as an arrival uses: what it asks waits for `answered`."""

    asked: queue.Queue[tuple[Command, queue.Queue[Reply | None], "Link"]] = queue.Queue()

    def __init__(self, *_: object) -> None:
        self.frames: list[memoryview] = []

    def ask(self, command: Command, **_: Any) -> tuple[Reply, list[memoryview]]:
        replies: queue.Queue[Reply | None] = queue.Queue()
        self.asked.put((command, replies, self))
        reply = replies.get(timeout=60.0)
        if reply is None:
            raise TransportError("no server answered")
        if reply.error is not None:
            raise CommandRefused("giver", reply.error, retry=reply.retry)
        return reply, self.frames

    def close(self) -> None:
        pass


@pytest.fixture
def taker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Served]:
    """A server that takes maps, with an empty one."""
    monkeypatch.setattr(map_arrivals, "Exchange", Link)
    with hosting(tmp_path / "other") as made:
        yield made


def moved(giver: Served, taker: Served, link: bytes = LINK) -> Reply:
    """The reply to a command to move a map, once the giver has answered all that the taker asked."""
    while not any(one.identity == link for one in taker.gateway.out):
        taker.step()
        giver.step()
        with suppress(queue.Empty):
            command, replies, asker = Link.asked.get(timeout=0.005)
            reply = giver.ask(command, b"taker")
            asker.frames = [*map(memoryview, giver.frames)]
            replies.put(reply)
    reply = taker.heard(Reply, link=link)
    assert reply.error is None
    assert reply.moved is not None
    return reply


def fetch(name: str = "default") -> Command:
    """A command to fetch a map from a server."""
    return Command(name="move", map=name, source="tcp://127.0.0.1:3", source_control="tcp://127.0.0.1:4")


def test_a_source_that_does_not_answer_is_an_error_and_blocks_nothing(taker: Served) -> None:
    taker.say(fetch("yard"))
    taker.until(lambda: taker.gateway.moves._arrivals)
    assert taker.greet("yard").reason == "map"
    for _ in ("list", "cancel"):
        Link.asked.get(timeout=60.0)[1].put(None)
    taker.gateway.moves._arrivals[0]._thread.join(60.0)
    assert "no server answered" in str(taker.heard(Reply).error)
    assert not taker.gateway.maps.arriving
    assert isinstance(taker.greet("yard"), messages.Welcome)


def test_a_map_comes_and_goes_on_where_it_was(asking: Asking, taker: Served) -> None:
    taker.say(fetch())
    reply = moved(asking.served, taker)
    assert reply.moved is not None
    assert (reply.moved.address, taker.durable) == ("tcp://127.0.0.1:1", 3)
    welcome = taker.greet()
    assert isinstance(welcome, messages.Welcome)
    assert welcome.durable == 3
    for seq in (3, 4):  # one that it has, and the next
        taker.take(record(seq))
    taker.until(lambda: taker.durable == 4 and taker.gateway.health().duplicates == 1)
    assert asking.served.greet().address == "tcp://127.0.0.1:1"


@pytest.mark.parametrize("name", ["default", "yard"])
def test_a_map_that_comes_is_read_by_an_empty_ones_process(asking: Asking, taker: Served, name: str) -> None:
    """A start takes seconds; the empty map gets another process, when it is not the one that comes."""
    first = asking.served
    first.greet(name)
    first.take(record(1, name))
    first.until(lambda: name in first.gateway.health().maps)
    hosted = taker.gateway.maps.get("default")
    assert hosted is not None
    process = hosted.fuser.pid
    taker.say(fetch(name))
    moved(first, taker)
    come = taker.gateway.maps.get(name)
    assert come is not None
    assert come.fuser.pid == process
    taker.until(lambda: all(each.fuser.ready for each in taker.gateway.maps))
    assert taker.gateway.health().problems == ()
    assert hosted.fuser.pid != process
    assert bool(hosted.fuser.pid) is (name != "default"), "no other one begins for a map that gives way"


def test_a_map_in_use_keeps_its_process(served: Served, tmp_path: Path) -> None:
    hosted = served.gateway.maps.get("default")
    assert hosted is not None
    process = hosted.fuser.pid
    served.greet()  # a scanner is about to send
    fuser = served.gateway.maps.open_ahead("yard", tmp_path, hosted.fuser.volume)
    pids = hosted.fuser.pid, fuser.pid
    fuser.close()
    assert pids[0] == process != pids[1]


def test_a_second_asker_hears_of_the_same_move(asking: Asking, taker: Served) -> None:
    """The first has given up waiting, and began again."""
    taker.say(fetch())
    taker.until(lambda: taker.gateway.moves._arrivals)
    taker.say(fetch(), b"again")
    for link in (LINK, b"again"):
        assert moved(asking.served, taker, link).moved
