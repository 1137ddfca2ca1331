# SPDX-License-Identifier: MIT
"""Maps that clients ask for: made by their first record, and no error of the disk ends the gateway."""

import errno
import os
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from failures import refuse
from served_gateway import QuietFuser, Served, hosting, record

from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.gateway.clients.client_routes import ClientRoutes
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps import map_registry
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.map_records import IncomingRecord
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.journal import Journal, quarantine, state_folder
from tsfusion.wire.keys.key_folder import AllowedMaps
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command, Denied, Nack, Welcome
from tsfusion.wire.messages.questions import Cells
from tsfusion.wire.records.record_header import unpack


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    with hosting(tmp_path, max_maps=2) as made:
        yield made


def test_a_greeting_makes_no_map_and_a_record_does(served: Served, tmp_path: Path) -> None:
    for number in range(5):
        session = number.to_bytes(16, "big")
        assert isinstance(served.greet(f"yard{number}", session), Welcome)
    assert list(served.gateway.health().maps) == state_folder.map_names(tmp_path) == ["default"]
    served.take(record(1, "yard0"))
    served.until(lambda: served.gateway.health().maps["yard0"].keyframes_durable == 1)
    second = (1).to_bytes(16, "big")
    served.take(record(1, "yard1", second))
    answer = served.heard(Denied)
    assert (answer.session, answer.reason) == (second, "map")
    assert "2 are open" in answer.message
    assert served.greet("yard2").reason == "map"


def test_maps_of_the_state_folder_begin_when_they_are_asked_for_or_one_by_one(tmp_path: Path) -> None:
    """The server is ready before, and ends without them; one opens at a time."""
    names = ("yard", "house", "shed")
    with hosting(tmp_path, later=names) as served:
        maps = served.gateway.maps

        def begun() -> list[str]:
            return [one.name for one in maps if one.fuser.pid]

        maps.is_ending = True  # so that none begins by itself
        for _ in range(3):
            served.step()
        assert begun() == ["default"]
        assert (maps.warm, maps.drained, maps.ended) == (True, True, True)
        assert served.gateway.health().maps["shed"].state == "opening"
        served.until(lambda: isinstance(served.greet("house"), Welcome))
        assert begun() == ["default", "house"]
        maps.is_ending = False
        served.until(lambda: len(begun()) == 3)
        assert "yard" in begun()
        served.until(lambda: len(begun()) == 4 and maps.warm)
        maps.is_ending = True
    with hosting(tmp_path / "other", later=names) as served:
        served.gateway.stop_accepting()
        served.until(served.gateway.maps.finish)
        assert served.gateway.maps.finished_well
        assert [one.fuser.pid for one in served.gateway.maps if one.name != "default"] == [0, 0, 0]


def test_a_question_waits_for_its_map_to_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Up to its own time; a fuser that cannot be started is a reason to refuse it, and is tried again."""
    with hosting(tmp_path, later=("house", "shed")) as served:
        served.gateway.maps.is_ending = True  # so that none begins by itself

        def asked(name: str, seconds: float) -> messages.Reply:
            reply: messages.Reply = served.ask(Command(name="status", map=name, timeout_s=seconds))
            return reply

        with monkeypatch.context() as full:
            full.setattr(QuietFuser, "is_refused", True)
            assert "cannot be started" in str(asked("shed", 60.0).error)
            assert "shed" in "".join(served.gateway.health().problems)
        assert asked("house", 60.0).error == "it has no map"  # so says the fuser
        served.until(lambda: asked("shed", 60.0).error == "it has no map")


def test_all_viewers_of_a_map_wait_for_it_and_one_key_takes_no_place_of_another(tmp_path: Path) -> None:
    """A viewer has several questions at once."""
    with hosting(tmp_path, later=("house",)) as served:
        served.gateway.maps.is_ending = True  # so that none begins by itself
        watch = Command(name="ask", map="house", question=Cells(wait_s=1.0), timeout_s=60.0)
        for number in range(256):
            served.say(watch, b"a%d" % number, client="robot")
        assert not served.gateway.out
        served.say(Command(name="status", map="house", timeout_s=60.0), b"b", client="cart")
        assert [one.identity for one in served.gateway.out] == [b"a0"]
        assert "ask again" in str(served.heard(messages.Reply, link=b"a0").error)
        assert served.heard(messages.Reply, link=b"b").error == "it has no map"  # so says the fuser


def test_a_record_whose_frames_are_too_large_together_is_refused(tmp_path: Path) -> None:
    """ZeroMQ limits a single frame. Nor does such a record make a map."""
    frames = record(1)
    nbytes = sum(map(len, frames))
    assert max(map(len, frames)) < nbytes - 1
    with hosting(tmp_path, max_frame_bytes=nbytes - 1) as served:
        for count, map_name in enumerate(("default", "yard"), 1):
            session = map_name.encode().ljust(16)
            served.greet(map_name, session)
            served.take(record(1, map_name, session))
            nack = served.heard(Nack)
            assert (nack.session, nack.stage, nack.reason) == (session, "door", "size")
            assert served.refused["size"] == count
        assert list(served.gateway.health().maps) == ["default"]
        assert served.durable == 0


def test_a_record_of_nobody_or_a_bad_one_makes_no_map(served: Served, tmp_path: Path) -> None:
    served.take(record(1, "yard"))
    served.until(lambda: served.refused.get("map") == 1)
    served.greet("garden")
    served.take(record(1, "yard"))  # of a client that was let into another map
    served.until(lambda: served.refused.get("map") == 2)
    served.greet("yard")
    head, *rest = record(1, "yard")
    served.take([head, *rest[:-1], b"x"])
    assert served.heard(messages.Nack)
    assert state_folder.map_names(tmp_path) == ["default"]


def test_a_map_that_is_being_opened_takes_nothing(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """The checkpoint's content is not known yet: a keyframe that it has could count twice."""
    with monkeypatch.context() as patched:
        patched.setattr(HostedMap, "takes_records", property(lambda _: False))
        served.take(record(1))
        served.until(lambda: served.refused.get("map") == 1)
        assert served.greet("default").reason == "opening"
    assert served.durable == 0
    served.take(record(1))
    served.until(lambda: served.durable == 1)


def test_a_map_that_cannot_be_opened_waits_for_no_process(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A killed fuser that waits for a disk ends when the disk answers, and is reaped then."""
    closed: list[bool] = []
    assert served.gateway.maps.open_for_client("yard") is not None
    monkeypatch.setattr(QuietFuser, "close", lambda *_, wait: closed.append(wait))
    served.gateway.maps._give_up("yard", JournalError("no such disk"))
    assert closed == [False]
    monkeypatch.undo()


def test_who_is_held_off_is_turned_away_whatever_it_sends(served: Served) -> None:
    served.greet("default")
    (route,) = served.gateway._routes
    route.held_until = time.monotonic() + 1000.0
    served.take(record(1))
    served.until(lambda: served.refused.get("held") == 1)
    assert served.durable == 0
    held = IncomingRecord(unpack(record(1)[0]), record(1), "", 0)
    for wanted, told in ((1e9, 10.0), (0.0, 0.25)):  # seconds; neither for ever nor in a frenzy
        served.gateway.intake._hold(held, wanted, "disk", "it is full")
        assert served.heard(messages.Hold).seconds == told


def test_a_disk_that_refuses_is_said_at_once_and_then_left_alone(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried = []

    def append_all(*_: object, **__: object) -> None:
        tried.append(1)
        raise JournalError("the disk is full", errno.ENOSPC)

    monkeypatch.setattr(Journal, "append_all", append_all)
    served.greet("default")
    for _ in range(2):
        served.take(record(1))
        hold = served.heard(messages.Hold)
        assert (hold.reason, hold.message) == ("disk", "the disk is full")
        (route,), (hosted,) = served.gateway._routes, served.gateway.maps
        route.held_until = 0.0
        hosted.records.disk._until = hosted.records.disk._look_at = time.monotonic() + 1000.0
    assert len(tried) == 1


@pytest.mark.parametrize("code", [errno.EIO, errno.ENOENT, errno.EMFILE])
def test_an_error_of_the_disk_while_a_map_is_opened_is_a_denial(
    served: Served, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    served.greet("yard")
    with monkeypatch.context() as broken:
        broken.setattr(quarantine, "_by_age", refuse(code))
        served.take(record(1, "yard"))
        answer = served.heard(Denied)
        assert answer.reason == "map"
        assert "map yard cannot be opened: " in answer.message
        assert os.strerror(code) in answer.message
    monkeypatch.setattr(map_registry, "_RETRY_INTERVAL", 0.0)
    served.take(record(1, "yard"))
    served.until(lambda: "yard" in served.gateway.health().maps)
    assert served.heard(messages.Ack).durable == 1


def test_maps_that_cannot_be_listed_are_no_end(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(state_folder.os, "listdir", refuse(errno.EIO))
        assert "cannot list" in (served.ask(Command(name="new_map", map="yard")).error or "")
    monkeypatch.setattr(state_folder.os, "walk", refuse(errno.EIO))
    assert served.greet("shed").reason == "map"


def test_a_free_name_is_one_that_the_client_may_use(tmp_path: Path) -> None:
    for name in ("yard", "yard-2", "house"):
        (state_folder.map_folder(tmp_path, name) / state_folder.JOURNAL_FOLDER).mkdir(parents=True)
    maps: Any = MapRegistry(
        cast("Any", None), ServerConfig(state=str(tmp_path)), cast(ClientRoutes, []), Metrics()
    )
    names = [
        maps.free_name(like, AllowedMaps(patterns))
        for like, patterns in (
            ("yard", None), ("attic", None), ("yard", ("yard-*",)), ("default", ("yard-*",)),
            ("default", ("house", "shed")), ("default", ("house",)), ("default", ()), ("default", ("*",)),
        )
    ]  # fmt: skip
    assert names == ["yard-3", "attic", "yard-3", "yard-3", "shed", None, None, "default"]
    assert maps.keep_free_name("default", AllowedMaps(("house",))) is None
    why = maps.why_none_free("default", AllowedMaps(("house",)))
    assert why == "no name is free of the maps that this key may use: house"


def test_no_free_name_is_guessed_where_the_maps_cannot_be_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = cast("Any", ())
    registry = MapRegistry(nothing, ServerConfig(state=str(tmp_path)), nothing, nothing)
    hosted = SimpleNamespace(
        name="hall",
        keyframes_durable=1,
    )
    (tmp_path / "maps").mkdir()
    monkeypatch.setattr(os, "listdir", refuse(errno.EIO))
    with pytest.raises(JournalError, match=r"cannot list .*maps: Input/output error"):
        registry.keep_free_name("hall")
    # A scanner of another world is turned away all the same
    assert registry.denial_of_world(cast("Any", hosted), b"").free_map == ""
