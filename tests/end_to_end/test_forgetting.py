# SPDX-License-Identifier: MIT
"""Keyframes that a server is told to forget: gone from the map, and if wanted from the disk."""

import json
import os
import signal
from contextlib import suppress
from pathlib import Path

import pytest
import sum_map
from command_processes import Here
from keyframes_and_servers import (
    DEADLINE,
    Secured,
    Server,
    connected,
    map_hash,
    pose,
    secured,
    serving,
    until,
    wall,
)
from quick_fusers import SUMS
from saved_maps import ANNA, BOB, make_map

from tsfusion import Client, Volume, journal
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import JournalError
from tsfusion.journal import state_folder
from tsfusion.journal.inspection import verify
from tsfusion.pipelines.maps.private_server import open_state
from tsfusion.wire.asking.queries import CommandRefused, fetch_health, fetch_status, forget
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import messages, questions
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.health import MapHealth
from tsfusion.wire.messages.messages import PROTOCOL_VERSION, Denied, Hello
from tsfusion.wire.messages.questions import Scans, ScansFound
from tsfusion.wire.records import corrections
from tsfusion.wire.sockets import sockets

COUNT = 4
FUSER = SUMS  # of the server that some tests share


def scan(server: Server, first: int, keys: Secured | None = None) -> str:
    """Keyframes that are in the map; their session."""
    with Client(server.address, **(keys.client if keys else {})) as client:  # type: ignore[arg-type]
        for i in range(first, first + COUNT):
            client.send(wall(i))
        client.wait_settled(DEADLINE)
        return client._outbox.spool.session.hex()


def hash_of(*firsts: int) -> str:
    """Hash of the map of these scans alone."""
    return sum_map.hash_of(wall(i) for first in firsts for i in range(first, first + COUNT))


def health_of(server: Server) -> MapHealth:
    return fetch_health(server.address).maps["default"]


def wait_settled(server: Server) -> None:
    until(lambda: health_of(server).state == "idle" and not health_of(server).corrections_waiting)


def pieces(state: Path, session: str) -> list[bytes]:
    """A part of the depth of each keyframe of a session in the journal, and of its colours."""
    paths = state_folder.find_journal(state).files()
    found = [record for path in paths for record in journal.records(path)]
    mine = [record.frames for record in found if record.session.hex() == session]
    return [bytes(frame[-60:-20]) for frames in mine for frame in frames[1:]]


def on_disk(state: Path, parts: list[bytes]) -> list[bytes]:
    """The payloads that any file of the state folder has."""
    content = b"".join(path.read_bytes() for path in state.rglob("*") if path.is_file())
    return [part for part in parts if part in content]


def test_one_session_leaves_the_map_and_the_disk(tmp_path: Path, here: Here) -> None:
    with serving(tmp_path, fuser=SUMS) as server:
        mine, other = scan(server, 0), scan(server, 10)
        parts, others = pieces(tmp_path, mine), pieces(tmp_path, other)
        assert len(parts) == len(on_disk(tmp_path, parts)) == 2 * COUNT
        refused = here("map", "forget", server.address, "--session", mine[:8])
        assert refused.returncode == 1
        assert "4 keyframes of 1 session would be forgotten, for good: say --yes" in refused.stderr
        done = here("map", "forget", server.address, "--session", mine[:8], "--yes", "--json")
        assert json.loads(done.stdout)["sessions"][0]["selected"] == [[1, COUNT]]
        wait_settled(server)
        assert fetch_status(server.address).map_hash == hash_of(10)
        own = health_of(server)
        assert (own.keyframes_fused, own.keyframes_durable, own.keyframes_forgotten) == (4, 8, 4)
        assert own.sessions == 2
        server.kill()
    assert on_disk(tmp_path, parts) == parts
    with serving(tmp_path, fuser=SUMS) as server:
        wait_settled(server)
        assert fetch_status(server.address).map_hash == hash_of(10)
        told = here("map", "forget", server.address, "--session", mine, "--yes", "--erase").stdout
        assert "erased 4 records of the journal" in told
        assert on_disk(tmp_path, parts) == []
        assert len(on_disk(tmp_path, others)) == 2 * COUNT
        os.kill(server.fuser_pid(), signal.SIGKILL)
        late = scan(server, 20)
        assert fetch_status(server.address).map_hash == hash_of(10, 20)
        assert server.terminate() == 0
    assert late != mine
    assert verify(state_folder.find_journal(tmp_path), lambda *_: None).intact
    assert sum_map.SumMap.load(tmp_path / "maps/default/map.tsf").map_hash() == hash_of(10, 20)
    (tmp_path / "maps/default/map.tsf").unlink()
    with serving(tmp_path, fuser=SUMS) as server:  # from the journal alone
        wait_settled(server)
        assert fetch_status(server.address).map_hash == hash_of(10, 20)


def test_viewers_get_no_picture_of_it_any_more(shared: Server) -> None:
    with connected(sockets.dealer, shared.control) as link, Client(shared.address) as client:
        client.send(wall(0))
        client.wait_settled(DEADLINE)
        first = scans_after(link, Scans(wait_s=0.0))
        client.send(wall(1))
        client.wait_settled(DEADLINE)
        asked = Scans(since=first.until, epoch=first.epoch, wait_s=0.0)
        assert [bool(one.picture) for one in scans_after(link, asked).scans] == [True]
        session = client._outbox.spool.session.hex()
        forget(shared.address, Selection(session=session), dry_run=True)
        assert len(scans_after(link, asked).scans) == 1
        forget(shared.address, Selection(session=session))
        found = scans_after(link, asked)
    assert (found.scans, found.missed) == ((), True)


def scans_after(link: sockets.AnySocket, question: Scans) -> ScansFound:
    """The keyframes that a viewer is told of."""
    link.send(messages.encode(messages.Command(name="ask", question=question, timeout_s=20.0)))
    head, *frames = link.recv_multipart()
    reply = messages.decode_to_client(head)
    assert isinstance(reply, messages.Reply)
    assert reply.answer is not None
    return questions.scans_of(questions.unpack(reply.answer, frames))


def test_nothing_but_the_server_writes_what_is_forgotten(shared: Server) -> None:
    session = bytes.fromhex(scan(shared, 0))
    before, forgotten = fetch_health(shared.address).refused.get("forgetting", 0), health_of(shared)
    forged = corrections.forgetting(session, corrections.checked({}, removed=[1]).removed)
    with connected(sockets.push, shared.address) as link:
        link.send_multipart(corrections.encode(forged, session=session, seq=COUNT + 1))
        plain = corrections.checked({}, removed=[1])
        link.send_multipart(corrections.encode(plain, session=SERVER_SESSION, seq=1, previous=0))
        until(lambda: fetch_health(shared.address).refused.get("forgetting", 0) == before + 2)
    assert health_of(shared).keyframes_forgotten == forgotten.keyframes_forgotten
    with connected(sockets.dealer, shared.control) as link:
        link.send(messages.encode_sealed(Hello(SERVER_SESSION, PROTOCOL_VERSION)))
        answer = messages.decode_to_client(link.recv())
    assert isinstance(answer, Denied)
    assert "the server's own" in answer.message


def test_a_key_forgets_its_own_keyframes_unless_it_may_forget_all(tmp_path: Path) -> None:
    robot = secured(tmp_path)
    key_folder.allow(tmp_path / "server", "cart", key_folder.create_pair(tmp_path / "cart", "cart").public)
    cart = Secured({}, {**robot.client, "key": str(tmp_path / "cart" / "cart.key_secret")})
    with serving(tmp_path / "state", fuser=SUMS, **robot.server) as server:  # type: ignore[arg-type]
        mine, other = scan(server, 0, robot), scan(server, 10, cart)
        with pytest.raises(CommandRefused, match="may forget keyframes of client cart only"):
            forget(server.address, Selection(client="robot"), keys=cart.keys)
        assert forget(server.address, Selection(session=mine), keys=cart.keys).selected == 0
        done = forget(server.address, Selection(until_ns=2**62, since_ns=0), keys=cart.keys)
        assert [(one.session, one.client) for one in done.sessions] == [(other, "cart")]
        key_folder.allow(tmp_path / "server", "cart", forget=True)
        assert key_folder.read_allow_list(tmp_path / "server").clients["cart"].forget
        until(lambda: _forgets(server, Selection(client="robot"), cart))
        until(lambda: fetch_status(server.address, keys=robot.keys).keyframes_fused == 0)
        assert fetch_status(server.address, keys=robot.keys).map_hash == sum_map.hash_of([])


def _forgets(server: Server, selection: Selection, keys: Secured) -> bool:
    with suppress(CommandRefused):
        return forget(server.address, selection, keys=keys.keys).keyframes == COUNT
    return False


def test_a_folder_that_a_server_uses(shared: Server, here: Here) -> None:
    in_use = here("map", "forget", str(shared.state), "--session", "ff", "--yes")
    assert "is in use by another server" in in_use.stderr
    assert "or give the address of that server" in in_use.stderr


def stamps_in(folder: Path) -> dict[Path, int]:
    return {path: path.stat().st_mtime_ns for path in folder.rglob("*")}


def test_a_folder_that_no_server_uses(tmp_path: Path, here: Here) -> None:
    make_map(tmp_path / "maps/default", range(COUNT))
    make_map(tmp_path / "maps/default", range(10, 10 + COUNT), session=BOB)
    mine, other = ANNA.hex(), BOB.hex()
    parts = pieces(tmp_path, other)
    files = stamps_in(tmp_path)
    seen = here("map", "forget", str(tmp_path), "--session", other, "--dry-run")
    assert (seen.returncode, f"{COUNT} keyframes" in seen.stdout) == (0, True), seen.stderr
    assert stamps_in(tmp_path) == files
    with open_state(tmp_path) as opened:
        box = (-5.0, -5.0, -5.0, 5.0, 5.0, 5.0)
        found = opened.forget(Selection(session=mine, numbers=((2, 9),), box=box), dry_run=True)
        assert [str(one.numbers) for one in found.sessions] == ["2-4"]
        assert opened.forget(Selection(session=mine)).keyframes == COUNT
    with open_state(tmp_path / "maps" / "default") as opened:
        done = opened.forget(Selection(session=other, numbers=((1, 2),)), erase=True)
        assert (done.keyframes, done.erased, done.remains) == (2, 2, ())
    assert on_disk(tmp_path, parts) == parts[4:]
    assert Volume.load(tmp_path / "maps/default/map.tsf").map_hash() == map_hash([wall(12), wall(13)])
    (tmp_path / "maps/default/map.tsf").unlink()
    nothing = here("map", "forget", str(tmp_path), "--session", mine, "--yes")
    assert (nothing.returncode, "start its server and give the address" in nothing.stderr) == (1, True)
    with pytest.raises(JournalError, match="is no state folder"), open_state(tmp_path / "maps"):
        pass


def test_what_cannot_be_meant(shared: Server, here: Here) -> None:
    for words, problem in (
        ((), "name what is to be forgotten"),
        (("--session", "ffffffff"), "no keyframe fits, so nothing is forgotten"),
        (("--session", "wall"), "session must be"),
        (("--since", "yesterday"), "a time must be"),
        (("--keyframes", "3-1"), "keyframes must be numbers"),
        (("--session", "ff", "--map", "none"), "no map none is open"),
    ):
        refused = here("map", "forget", shared.address, "--yes", *words)
        assert refused.returncode == 1
        assert problem in refused.stderr


@pytest.mark.nightly
@pytest.mark.parametrize("most", [50, 2000])
def test_a_window_in_a_journal_with_a_limit(tmp_path: Path, most: int) -> None:
    limits = {"journal_bytes": 1 << 20, "segment_bytes": 1 << 16, "checkpoint_every": 20}
    with serving(tmp_path, keep_keyframes=most, **limits) as server:
        with Client(server.address) as client:
            for i in range(1500):
                client.send(wall(i))
            client.wait_settled(DEADLINE)
        told = fetch_status(server.address)
        assert told.keyframes_fused <= most
        assert told.journal_bytes < 1.2 * (1 << 20)
        assert told.corrections_unavailable == 0
        assert told.map_hash == map_hash(wall(i) for i in range(1500 - told.keyframes_fused, 1500))


def test_a_server_that_keeps_a_window(tmp_path: Path) -> None:
    with serving(tmp_path, fuser=SUMS, keep_keyframes=5) as server:
        scan(server, 0)
        with Client(server.address) as client:
            sent = [client.send(wall(i)) for i in range(10, 18)]
            client.wait_settled(DEADLINE)
            client.correct({seq: pose(0.01 * seq) for seq in sent if seq is not None})
            client.wait_settled(DEADLINE)
        told = fetch_status(server.address)
        assert (told.keyframes_fused, told.keyframes_forgotten) == (5, 7)
        stay = [wall(9 + seq, T_world_camera=pose(0.01 * seq)) for seq in range(4, 9)]
        assert told.map_hash == sum_map.hash_of(stay)
        server.kill()
    with serving(tmp_path, fuser=SUMS, keep_keyframes=2) as server:
        until(lambda: fetch_status(server.address).keyframes_fused == 2)
        wait_settled(server)
        assert fetch_status(server.address).map_hash == sum_map.hash_of(stay[-2:])
