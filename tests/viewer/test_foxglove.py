# SPDX-License-Identifier: MIT
"""A map in Foxglove: what a client of its protocol is sent, who may connect, and what slow clients cost."""

import json
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_processes import eventually, read_until, tsfusion
from growing_maps import SESSION, GrowingMap, surface_update
from keyframes_and_servers import VOLUME, serving, wall
from live_pages import ended, viewing
from numpy.typing import NDArray
from repository import ROOT
from watched_surfaces import ordered

from tsfusion import Client, Volume
from tsfusion.core.config import ClientConfig, override
from tsfusion.core.errors import InvalidConfig, MissingDependency, TransportError
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import Up
from tsfusion.viewer.page import page_guard
from tsfusion.viewer.page.page_guard import PageGuard
from tsfusion.wire.asking.followed_map import (
    Cleared,
    HealthSeen,
    LinkSeen,
    PathsFound,
    ScannerSeen,
    SurfaceUpdate,
)

pytest.importorskip("foxglove", reason="it is foxglove-sdk (pip install 'tsfusion[foxglove]')")
pytest.importorskip("google.protobuf", reason="it decodes what Foxglove is sent")

import foxglove
from foxglove import messages
from foxglove.channels import SceneUpdateChannel
from foxglove_client import DEADLINE, FoxgloveClient
from websockets.exceptions import ConnectionClosed, InvalidStatus

from tsfusion.viewer.foxglove import foxglove_view
from tsfusion.viewer.foxglove.foxglove_server import APPS, FoxgloveServer, FoxgloveTopic
from tsfusion.viewer.foxglove.foxglove_view import FoxgloveView

NORMAL = override(VOLUME, surface="normal")  # whose cells depend on the map alone, to the last bit
TOKEN = "open-sesame"


@contextmanager
def shown(feed: Any, **options: Any) -> Iterator[FoxgloveServer]:
    """A view of a feed, in a thread."""
    with closing(FoxgloveServer(**options)) as server:
        view, stop = FoxgloveView(server, feed), threading.Event()
        thread = threading.Thread(target=view.run, args=(stop,))
        thread.start()
        try:
            yield server
        finally:
            stop.set()
            thread.join()


@pytest.fixture
def feed() -> GrowingMap:
    return GrowingMap(Volume(NORMAL), map(wall, range(0, 60, 20)))


def grown(feed: GrowingMap) -> NDArray[np.float32]:
    """Let a map grow to its end; the corners of its triangles."""
    while not feed.is_whole:
        feed.grow()
    volume = feed.volume
    return ordered(volume.surface.mesh_cells(volume.blocks().coordinates).mesh).reshape(-1, 9)


def test_the_client_of_these_tests_reads_foxglove_s_own_server() -> None:
    """So what it reads of ours is what Foxglove reads."""
    context = foxglove.Context()
    channel = SceneUpdateChannel("/map", context=context)
    served = foxglove.start_server(port=0, context=context)
    try:
        with FoxgloveClient(f"ws://127.0.0.1:{served.port}") as client:
            client.until(lambda: client.offered)
            assert eventually(channel.has_sinks, DEADLINE)
            entity = messages.SceneEntity(
                id="one",
                triangles=[
                    messages.TriangleListPrimitive(
                        points=[messages.Point3(x=float(i), y=0.0, z=1.0) for i in range(3)],
                        indices=[0, 1, 2],
                    )
                ],
            )
            channel.log(messages.SceneUpdate(entities=[entity]))
            client.until(lambda: client.scenes)
            assert client.corners().tolist() == [[0, 0, 1, 1, 0, 1, 2, 0, 1]]
            theirs = client.offered["/map"]
            gone = messages.SceneEntityDeletion(type=messages.SceneEntityDeletionType.All)
            channel.log(messages.SceneUpdate(deletions=[gone]))
            client.until(lambda: not client.scenes["/map"])
    finally:
        served.stop()
    with closing(FoxgloveServer()) as server:
        server.open(FoxgloveTopic("/map", messages.SceneUpdate.get_schema()))
        with FoxgloveClient(server.url) as client:
            client.until(lambda: client.offered)
            assert client.offered["/map"] == theirs | {"id": client.offered["/map"]["id"]}


@pytest.mark.parametrize("protocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_clients_have_the_whole_map_however_late(feed: GrowingMap, protocol: str) -> None:
    with shown(feed) as server, FoxgloveClient(server.url, protocol=protocol) as early:
        early.until(lambda: len(early.offered) == 5)
        assert early.info["capabilities"] == []
        expected = grown(feed)
        early.until(lambda: np.array_equal(early.corners(), expected))
        with FoxgloveClient(server.url, protocol=protocol) as late:
            late.until(lambda: np.array_equal(late.corners(), expected))
            (first, *rest) = late.all["/map"]
            assert len(first.deletions) == 1  # of what a client had before
            assert not any(one.deletions for one in rest)
            late.until(
                lambda: "scanner_1" in late.frames() and "/state" in late.last and late.scenes["/paths"]
            )
        entity = next(iter(early.scenes["/map"].values()))
        assert (entity.frame_id, entity.frame_locked) == ("map", True)
        (part,) = entity.triangles
        assert part.pose.orientation.w == 1
        assert len(part.colors) == len(part.points) > 0
        assert {one.a for one in part.colors} == {1.0}


def test_colours_are_those_of_the_mesh(feed: GrowingMap) -> None:
    mesh = Mesh(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32),
        np.array([[0, 1, 2]], np.int32),
        np.array([[0, 0, 1]] * 3, np.float32),
        np.array([[0, 1, 2], [100, 150, 200], [253, 254, 255]], np.uint8),
    )
    feed.tell(SurfaceUpdate(np.zeros((1, 3), np.int32), np.array([0, 1], np.int32), mesh, np.array([True])))
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: client.scenes.get("/map"))
        (part,) = client.scenes["/map"]["0_0_0"].triangles
    assert [
        [round(255 * c.r), round(255 * c.g), round(255 * c.b)] for c in part.colors
    ] == mesh.colors.tolist()


def test_a_tile_that_empties_is_deleted_and_another_map_begins_anew(feed: GrowingMap) -> None:
    grown(feed)
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: client.scenes.get("/map") and "/scanner_1/image" in client.offered)
        name = next(iter(client.scenes["/map"]))
        corner = 8 * np.array([int(one) for one in name.split("_")])
        cells = (corner + np.indices((8, 8, 8)).reshape(3, -1).T).astype(np.int32)
        nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
        feed.tell(
            SurfaceUpdate(cells, np.zeros(len(cells) + 1, np.int32), nothing, np.full(len(cells), True))
        )
        client.until(lambda: name not in client.scenes["/map"])
        feed.tell(Cleared("cellar", 0.02), LinkSeen(""))
        client.until(lambda: not any(client.scenes.values()) and "/scanner_1/image" not in client.offered)
        feed.tell(surface_update(feed.volume, feed.volume.blocks().coordinates, None))
        client.until(lambda: name in client.scenes["/map"])


def test_a_scanner_has_a_frame_a_frustum_a_path_and_a_picture(feed: GrowingMap) -> None:
    keyframe = wall(0)
    grown(feed)
    last = feed.poses[-1]
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: "scanner_1" in client.frames() and "/scanner_1/image" in client.last)
        client.until(lambda: client.scenes.get("/paths"))
        frame = client.frames()["scanner_1"]
        assert (frame.parent_frame_id, frame.translation.x) == ("map", pytest.approx(last[0, 3]))
        (outline,) = client.scenes["/scanners"].values()
        assert outline.frame_id == "scanner_1"
        assert outline.texts[0].text == SESSION.hex()[:8]
        corner = outline.lines[0].points[0]  # of the picture, on its ray
        camera = keyframe.intrinsics
        assert corner.x / corner.z == pytest.approx((0 - camera.cx) / camera.fx)
        path = client.scenes["/paths"]["scanner_1 paths"].lines[0]
        assert (path.type, len(path.points)) == (path.LINE_LIST, 2 * (len(feed.poses) - 1))
        picture = client.last["/scanner_1/image"]
        assert (picture.format, picture.frame_id) == ("jpeg", "scanner_1")
        assert picture.data.startswith(b"\xff\xd8")
        feed.tell(PathsFound({}))  # all its keyframes are forgotten
        client.until(lambda: not client.scenes["/scanners"] and not client.scenes["/paths"])


def test_a_scanner_whose_path_is_known_first_gets_its_frustum_later(feed: GrowingMap) -> None:
    feed.tell(PathsFound({SESSION: (np.array([1]), np.eye(4)[None])}))
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: client.scenes.get("/scanners"))
        assert len(client.scenes["/scanners"]["scanner_1"].lines[0].points) == 6  # axes
        feed.grow()
        client.until(lambda: len(client.scenes["/scanners"]["scanner_1"].lines[0].points) == 16)


def test_the_state_has_figures_to_plot_and_what_is_wrong(feed: GrowingMap) -> None:
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: "/state" in client.last)
        assert client.last["/state"] == {"state": "not known yet", "problems": []}
        feed.grow()
        client.until(lambda: "keyframes_fused" in client.last["/state"])
        state = client.last["/state"]
        schema = json.loads(client.offered["/state"]["schema"])
        assert set(schema["properties"]) == set(state)
        assert (state["keyframes_fused"], state["waiting_in_server"], state["waiting_at_scanners"]) == (
            1,
            2,
            1,
        )
        assert state["delay_p95_ms"] == pytest.approx(120 + 9 * np.cos(1))
        feed.tell(HealthSeen(feed.health(("the disk is full",))))
        client.until(lambda: client.last["/state"]["problems"] == ["the disk is full"])
        feed.tell(LinkSeen("no answer"))
        client.until(lambda: client.last["/state"]["state"] == "no answer")


def test_the_frame_world_has_up_along_z(feed: GrowingMap) -> None:
    def turned(client: FoxgloveClient) -> NDArray[np.float64]:
        """Up of the map, in `world`."""
        q = client.frames()["map"].rotation
        v, w = np.array((q.x, q.y, q.z)), q.w
        up = np.array((0.0, -1, 0))
        found: NDArray[np.float64] = up + 2 * np.cross(v, np.cross(v, up) + w * up)
        return found

    mesh = Mesh(
        np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32), np.eye(3, dtype=np.float32),
        known_up=Up((0.0, -1.0, 0.0), "given"),
    )  # fmt: skip
    feed.tell(SurfaceUpdate(np.zeros((1, 3), np.int32), np.array([0, 1], np.int32), mesh, np.array([True])))
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: "map" in client.frames() and np.allclose(turned(client), (0, 0, 1), atol=1e-6))
        assert client.frames()["map"].parent_frame_id == "world"


def test_a_slow_client_gets_the_newest_and_holds_up_nobody(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(FoxgloveServer()) as server:
        server.open(FoxgloveTopic("/map", messages.SceneUpdate.get_schema(), lambda name, ns: b""))
        made = []

        def version(number: int) -> Callable[[], bytes]:
            def make() -> bytes:
                made.append(number)
                deletion = messages.SceneEntityDeletion(id=f"{number} " + "x" * (4 << 20))
                return messages.SceneUpdate(deletions=[deletion]).encode()

            return make

        with FoxgloveClient(server.url) as slow, FoxgloveClient(server.url) as quick:
            slow.until(lambda: slow.offered)
            quick.until(lambda: quick.offered)
            last = 40
            for number in range(1, last + 1):
                server.put("/map", "tile", version(number))
                seen = quick.seen.get("/map", 0)
                quick.until(lambda seen=seen: quick.seen.get("/map", 0) > seen)
            assert quick.all["/map"][-1].deletions[0].id.startswith(f"{last} ")
            assert len(made) < 2 * last - 10  # of the slow client most versions were never made
            slow.until(lambda: slow.all.get("/map") and newest(slow) == last)
            assert slow.seen["/map"] < last


def newest(client: FoxgloveClient) -> int:
    found = [one.deletions[0].id for one in client.all["/map"] if one.deletions]
    return int(found[-1].split()[0]) if found else 0


def test_a_tile_is_sent_again_after_a_pause_only(feed: GrowingMap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foxglove_view, "_PAUSE", 3600.0)
    feed.grow()
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: client.scenes.get("/map"))
        grown(feed)
        client.until(lambda: client.last.get("/state", {}).get("keyframes_fused") == 3)
        ids = [one.entities[0].id for one in client.all["/map"] if one.entities]
        assert len(ids) == len(set(ids))


def test_only_the_cameras_of_the_newest_pictures_have_topics(
    feed: GrowingMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(foxglove_view, "_MOST_CAMERAS", 2)
    feed.grow()
    (seen,) = (one for one in feed.grow() if isinstance(one, ScannerSeen))
    others = [bytes([i]) * 16 for i in range(3)]
    feed.tell(
        *(
            ScannerSeen(one, 1, seen.T_world_camera, seen.intrinsics, seen.shape, seen.picture)
            for one in others
        )
    )
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        images = {"/scanner_3/image", "/scanner_4/image"}
        client.until(lambda: {one for one in client.offered if one.endswith("/image")} == images)
        client.until(lambda: len(client.scenes.get("/scanners", ())) == 4)


@pytest.mark.parametrize(
    ("origin", "is_let_in"),
    [
        (None, True),
        (APPS[0], True),
        ("file://", True),
        ("http://localhost:8080", True),
        ("http://[::1]:8080", True),
        ("https://evil.example", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://app.foxglove.dev", False),
        ("http://127.0.0.1.evil.example", False),
        ("null", False),
        ("", False),
    ],
)
def test_foxglove_and_this_machine_are_let_in(origin: str | None, is_let_in: bool) -> None:
    with closing(FoxgloveServer()) as server:
        assert server.url == f"ws://127.0.0.1:{server.port}"
        headers = [] if origin is None else [("Origin", origin)]
        if is_let_in:
            with FoxgloveClient(server.url, additional_headers=headers) as one:
                one.until(lambda: one.info)
        else:
            with pytest.raises(InvalidStatus) as refused:
                FoxgloveClient(server.url, additional_headers=headers)
            assert refused.value.response.status_code == 403


def test_other_machines_need_the_token_in_the_address() -> None:
    guard = PageGuard("0.0.0.0", 8765, scheme="ws", apps=APPS)
    assert guard.url.startswith("ws://")
    assert guard.token is not None
    with closing(FoxgloveServer(token=TOKEN)) as server:
        assert server.url.endswith(f"/?token={TOKEN}")
        with FoxgloveClient(server.url, origin="https://lichtblick.example") as one:
            one.until(lambda: one.info)
        for wrong in (server.url.partition("?")[0], server.url + "x"):
            with pytest.raises(InvalidStatus) as refused:
                FoxgloveClient(wrong, origin=APPS[0])
            assert refused.value.response.status_code == 403
    with pytest.raises(InvalidConfig, match="a token is 8 to 128"):
        FoxgloveServer(token="short")


MANY = "more subscriptions than anybody needs"


@pytest.mark.parametrize(
    "wrong",
    ["{", "[]", '{"op": 5}', '{"op": "subscribe", "subscriptions": [{"id": "x"}]}', "[" * 100_000, b"\x01abc",
     MANY],
)  # fmt: skip
def test_a_client_that_talks_nonsense_is_sent_away_and_others_stay(
    wrong: str | bytes, caplog: pytest.LogCaptureFixture
) -> None:
    with closing(FoxgloveServer()) as server:
        topic = FoxgloveTopic("/map", messages.SceneUpdate.get_schema())
        server.open(topic)
        if wrong is MANY:
            each = [{"id": i, "channelId": topic.number} for i in range(1001)]
            wrong = json.dumps({"op": "subscribe", "subscriptions": each})
        with FoxgloveClient(server.url) as other, FoxgloveClient(server.url) as one:
            one.link.send(wrong)
            with pytest.raises(ConnectionClosed):
                one.until(lambda: False)
            other.send(
                op="subscribe",
                subscriptions=[{"id": 2**32, "channelId": topic.number}, {"id": 1, "channelId": 0}],
            )
            other.send(op="unsubscribe", subscriptionIds=[7])
            other.send(op="something new", more=1)
            server.put("/map", "a", lambda: b"")
            other.until(lambda: other.seen.get("/map"))
    (line,) = (one.getMessage() for one in caplog.records)
    assert "is turned away (message)" in line


def test_a_topic_that_cannot_be_made_costs_its_client_alone(caplog: pytest.LogCaptureFixture) -> None:
    with closing(FoxgloveServer()) as server:
        server.open(FoxgloveTopic("/map", messages.SceneUpdate.get_schema()))
        server.open(FoxgloveTopic("/bad", messages.SceneUpdate.get_schema()))
        server.put("/bad", "a", lambda: bytes(1 // 0))
        server.put("/map", "a", lambda: b"")
        with FoxgloveClient(server.url) as one, pytest.raises(ConnectionClosed):
            one.until(lambda: False)
        with FoxgloveClient(server.url, ["/map"]) as one:
            one.until(lambda: one.seen.get("/map"))
    assert "ZeroDivisionError" in caplog.text


def test_a_port_in_use_and_a_missing_library_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        closing(FoxgloveServer()) as server,
        pytest.raises(TransportError, match=rf"cannot show a map at 127\.0\.0\.1:{server.port}: Address al"),
    ):
        FoxgloveServer(port=server.port)
    monkeypatch.setattr(page_guard, "find_spec", lambda name: None)
    with pytest.raises(MissingDependency, match=r"install it with: pip install '\.\[foxglove\]'"):
        FoxgloveServer()


def test_a_server_s_map_is_watched_by_the_command(tmp_path: Path) -> None:
    """Real processes: a scanner sends, a server fuses, the command serves Foxglove, two clients are deaf."""
    with ExitStack() as stack:
        server = stack.enter_context(serving(tmp_path, NORMAL))
        process = stack.enter_context(viewing(server.address, "--foxglove", "127.0.0.1:0", "--json"))
        url = json.loads(read_until(process, "url", DEADLINE))["url"]
        early = stack.enter_context(FoxgloveClient(url))
        early.until(lambda: "/state" in early.last)
        stack.enter_context(socket.create_connection(("127.0.0.1", int(url.rpartition(":")[2]))))
        stack.enter_context(FoxgloveClient(url))
        volume = Volume(NORMAL)
        with Client(server.address, config=ClientConfig(policy="spool_all")) as client:
            for i in (0, 20, 40):
                client.send(wall(i))
                volume.integrate(wall(i))
            client.wait_settled(DEADLINE)
        expected = ordered(volume.surface.mesh_cells(volume.blocks().coordinates).mesh).reshape(-1, 9)
        early.until(lambda: np.array_equal(early.corners(), expected))
        late = stack.enter_context(FoxgloveClient(url, ["/map"]))
        late.until(lambda: np.array_equal(late.corners(), expected))
        status, _, said, errors = ended(process, signal.SIGINT)
        assert (status, said, errors) == (0, "", "")
        with pytest.raises(ConnectionClosed):
            early.until(lambda: False)
        assert early.last["/state"]["state"] == "this page has ended"


def test_the_layout_names_what_is_there(feed: GrowingMap) -> None:
    text = (ROOT / "contrib/foxglove/live.json").read_text(encoding="utf-8")
    named = set(re.findall(r'"(/[\w/]+)(?:\.(\w+))?"', text))
    feed.grow()
    with shown(feed) as server, FoxgloveClient(server.url) as client:
        client.until(lambda: "/scanner_1/image" in client.offered and "lost" in client.last.get("/state", {}))
        assert {topic for topic, _ in named} == client.offered.keys() - {"/tf"}
        assert {field for _, field in named if field} <= client.last["/state"].keys()


def test_flags_of_the_page_have_no_effect_on_foxglove() -> None:
    done = tsfusion("view", "tcp://127.0.0.1:9", "--foxglove", "--truth", "synthetic:room")
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "tsfusion: --truth has no effect with --foxglove, which shows no page\n"


def test_without_the_flag_nothing_of_it_is_loaded() -> None:
    program = "import sys, tsfusion.cli.view, tsfusion.cli.serve, tsfusion.pipelines.runs.viewer_child as _\n"
    program += "sys.exit('foxglove' in sys.modules or 'websockets' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], check=False, timeout=DEADLINE).returncode == 0
