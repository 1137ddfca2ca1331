# SPDX-License-Identifier: MIT
"""Reports: one whole page that says what the run's files say, and asks nothing of the network."""

import base64
import dataclasses
import json
import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from command_processes import Here
from headless_browser import browser

from tsfusion.core.errors import OutputError
from tsfusion.datasets.trajectory_files import read_poses, write_tum
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import parse
from tsfusion.pipelines.report import latency_ledger, map_report, pictures, run_report, run_sections
from tsfusion.pipelines.report.run_record import RunFindings
from tsfusion.wire.messages.messages import KeyframeTimes

_EMPTY = frozenset(("meta", "img", "br", "input", "image", "path"))  # elements without an end
HOSTILE = '<script>alert("1")</script>&\'"'


class Structure(HTMLParser):
    """Checks that elements are closed in order, and gathers what a page refers to and says."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self._open: list[str] = []
        self.links: list[str] = []
        self.words: list[str] = []
        self.titles: list[str] = []
        self.scripts = 0
        self.feed(text)
        self.close()
        assert not self._open, f"never closed: {self._open}"

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.scripts += tag == "script"
        self.links += [value or "" for name, value in attrs if name in ("src", "href", "action", "srcset")]
        assert not [name for name, _ in attrs if name.startswith("on")], "an inline handler"
        if tag not in _EMPTY:
            self._open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in _EMPTY:
            assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self._open and self._open[-1] not in ("script", "style"):
            self.words.append(data)
            self.titles += [data] if self._open[-1] == "h2" else []

    @property
    def text(self) -> str:
        return " ".join(self.words)


def ball() -> Mesh:
    shape = trimesh.creation.icosphere(3, 1.0)
    colors = np.round(127 + 127 * shape.vertices).astype(np.uint8)
    return Mesh(
        np.float32(shape.vertices), np.int32(shape.faces), np.float32(shape.vertex_normals), colors,
        known_up=parse("z"),
    )  # fmt: skip


def a_run(folder: Path, **changed: Any) -> Path:
    """The folder of a replay with everything in it."""
    folder.mkdir()
    mesh = ball()
    mesh.save(folder / "mesh.ply")
    error = np.linspace(-0.002, 0.004, len(mesh.vertices)).astype(np.float32)
    np.save(folder / "error.npy", error)
    stamps = [name for name in KeyframeTimes.__struct_fields__ if name.endswith("_ns")]
    times = [
        KeyframeTimes(seq=i, **{name: 10**6 * (100 * i + 5 * k) for k, name in enumerate(stamps)})
        for i in range(1, 41)
    ]
    latency_ledger.write_csv(times, folder / "delay.csv")
    poses = [np.eye(4) for _ in range(5)]
    for step, T in enumerate(poses):
        T[0, 3] = 0.3 * step
    write_tum(folder / "keyframes.txt", [10**9 * (k + 1) for k in range(5)], poses)
    (folder / "growth.csv").write_text("seconds,blocks,map_bytes\n0,1,1000\n1,70,90000\n")
    summary = latency_ledger.summarise(times)
    record = {
        "dataset": "ball", "folder": str(folder), "keyframes_sent": 41, "keyframes_fused": 40, "seconds": 8.0,
        "keyframes_rejected": {"late": 1}, "missed": "", "map_hash": "ab12", "blocks": 1234,
        "delay_ms": _struct(summary.delay_ms),
        "stages_ms": {name: _struct(one) for name, one in summary.stages_ms.items()}, "clock_bound_ms": 0.25,
        "mesh": {**mesh.figures, "up": {"direction": [0.0, 0.0, 1.0], "found_by": "given"}},
        "accuracy": {"vertices": 642, "mean_mm": 1.67,
                      "p50_mm": 1.5, "p95_mm": 3.7, "rmse_mm": 2.0, "max_mm": 4.0},
        "peak_rss_bytes": {"server": 123456789, "client": 23456789},
        "config": {"volume": {"voxel_size": 0.02}},
        "versions": {"tsfusion": "9.8.7"},
        **changed,
    }  # fmt: skip
    (folder / "run.json").write_text(json.dumps(record))
    return folder


def _struct(spread: Any) -> dict[str, float]:
    return {name: getattr(spread, name) for name in spread.__struct_fields__}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = a_run(tmp_path_factory.mktemp("report") / "run")
    run_report.write(folder, folder / "report.html")
    return folder


def page_of(folder: Path) -> tuple[Structure, str]:
    run_report.write(folder, folder / "page.html")
    text = (folder / "page.html").read_text(encoding="utf-8")
    return Structure(text), text


def test_the_page_is_whole_and_refers_to_nothing_outside(folder: Path) -> None:
    text = (folder / "report.html").read_text(encoding="utf-8")
    page = Structure(text)
    assert page.links
    assert all(link.startswith("data:image/") for link in page.links)
    assert not re.search(r"https?://|@import|url\(|//cdn", text)
    assert "default-src 'none'" in text
    images = [link for link in page.links if link.startswith("data:image/jpeg")]
    assert len(images) == 6  # four sides, and two with the error
    for link in images:
        content = np.frombuffer(base64.b64decode(link.partition(",")[2]), np.uint8)
        assert cv2.imdecode(content, cv2.IMREAD_COLOR).std() > 5
    names = {path.name for path in folder.glob("report*.png")}
    assert names == {*(f"report-side{k}.png" for k in (1, 2, 3, 4)), "report-error1.png", "report-error2.png"}
    assert all(cv2.imread(str(folder / name)) is not None for name in names)


def test_numbers_are_those_of_the_run(folder: Path) -> None:
    page = Structure((folder / "report.html").read_text(encoding="utf-8"))
    record = json.loads((folder / "run.json").read_text())
    delay = record["delay_ms"]
    for wanted in (
        "ab12", "1\u202f234", "123 MB", "of 41 sent", "1.67 mm", "3.70 mm", "late", "9.8.7",
        f"{delay['p95']:.1f}",
        f"{record['stages_ms']['fuse']['mean']:.1f}", "642 vertices, 1\u202f280 triangles", "5 keyframes/s",
        "± 0.25 ms", '"voxel_size": 0.02',
    ):  # fmt: skip
        assert wanted in page.text, wanted
    assert {"Delay", "Accuracy", "Trajectory", "Map and memory over time"} <= set(page.titles)


def test_what_is_missing_is_left_out_with_a_word(tmp_path: Path) -> None:
    bare = a_run(tmp_path / "run", accuracy=None, stages_ms={}, delay_ms={"count": 0}, made=None)
    for name in ("error.npy", "delay.csv", "growth.csv", "keyframes.txt"):
        (bare / name).unlink()
    page, text = page_of(bare)
    assert "true surface is not known" in page.text
    assert "no keyframe was fused" in page.text
    assert "too short, or is of a version" in page.text
    assert "Trajectory" not in page.titles
    assert text.count("data:image/jpeg") == 4
    (bare / "mesh.ply").unlink()
    assert "The mesh of this run is no longer in its folder" in page_of(bare)[0].text
    at_server = a_run(tmp_path / "scan", mesh={})
    (at_server / "mesh.ply").unlink()
    assert "The map is on its server" in page_of(at_server)[0].text


def test_a_run_of_an_old_version_still_has_a_report(tmp_path: Path) -> None:
    old = tmp_path / "2025-01-02_03-04-05"
    old.mkdir()
    (old / "run.json").write_text(json.dumps({"source": "old camera", "keyframes_sent": 3, "maps": []}))
    page, _ = page_of(old)
    assert "2025-01-02 03:04" in page.text
    assert "old camera" in page.text


def test_names_are_text_whatever_they_hold(folder: Path, tmp_path: Path) -> None:
    plain = Structure((folder / "report.html").read_text(encoding="utf-8"))
    page, text = page_of(
        a_run(tmp_path / "run", dataset=HOSTILE, missed=HOSTILE, camera=HOSTILE, map_hash=HOSTILE,
              keyframes_rejected={HOSTILE: 2}, versions={HOSTILE: HOSTILE}, config={HOSTILE: HOSTILE},
              made={"command": HOSTILE, "finished": HOSTILE, "cpu": HOSTILE})
    )  # fmt: skip
    assert "<script>alert" not in text
    assert page.scripts == plain.scripts
    assert HOSTILE in page.text


def test_a_map_without_colour_is_not_coloured_by_it(tmp_path: Path) -> None:
    run, mesh = a_run(tmp_path / "run"), ball()
    grey = np.full(mesh.vertices.shape, 128, np.uint8)  # of a LiDAR
    dataclasses.replace(mesh, colors=grey).save(run / "mesh.ply")
    run_report.write(run, run / "report.html")
    text = (run / "report.html").read_text(encoding="utf-8")
    assert '<option value="0">' not in text
    assert '<option value="1">height' in text
    assert '"colors": false' in text


@pytest.mark.parametrize(
    ("name", "content", "why"),
    [
        ("run.json", b"{", "cannot read"),
        ("run.json", b'{"a": 1}', "is not the record of a run"),
        ("run.json", b'{"dataset": "a"}', "missing required field `keyframes_sent`"),
        ("mesh.ply", b"ply\nnonsense", "cannot read"),
        ("delay.csv", b"seq,captured_ns\n1,x\n", "holds a malformed row"),
    ],
)
def test_damaged_results_are_one_line(tmp_path: Path, name: str, content: bytes, why: str) -> None:
    run = a_run(tmp_path / "run")
    (run / name).write_bytes(content)
    with pytest.raises(OutputError, match=why):
        run_report.write(run, run / "report.html")
    assert not (run / "report.html").exists()


def test_a_scene_unpacks_to_its_mesh() -> None:
    mesh = ball()
    level = np.arange(len(mesh.vertices)).astype(np.uint8)
    made = pictures.make_scene(mesh, level)
    head, packed = made.header(np.array((0.0, 0, 1))), base64.b64decode(made.packed())
    content = pictures.zlib.decompress(packed)
    n, m = len(mesh.vertices), 3 * len(mesh.faces)
    places = np.cumsum(np.frombuffer(content, "<u2", 3 * n).reshape(3, n), axis=1, dtype=np.uint16).T
    assert np.abs(places / 65535 * head["size"] + head["low"] - mesh.vertices).max() < 1e-4
    planes = np.frombuffer(content, np.uint8, 4 * m, 6 * n).reshape(4, m)
    corners = np.ascontiguousarray(planes.T).view("<u4").ravel()
    assert (np.cumsum(corners, dtype=np.uint32).reshape(-1, 3) == mesh.faces).all()
    colors = np.frombuffer(content, np.uint8, 3 * n, 9 * n + 4 * m).reshape(3, n).T
    assert (colors == mesh.colors).all()
    assert content[12 * n + 4 * m :] == level.tobytes()


def test_a_large_mesh_becomes_a_small_one_of_the_same_shape() -> None:
    shape = trimesh.creation.icosphere(6, 1.0)
    whole = Mesh(np.float32(shape.vertices), np.int32(shape.faces), np.float32(shape.vertex_normals))
    small = pictures.make_scene(whole, most=9000).mesh
    assert 2000 < len(small.faces) <= 9000
    radius = np.linalg.norm(small.vertices, axis=1)
    assert np.abs(radius - 1).max() < 0.02
    facing = np.cross(
        *(small.vertices[small.faces[:, k]] - small.vertices[small.faces[:, 0]] for k in (1, 2))
    )
    assert (np.einsum("ij,ij->i", facing, small.vertices[small.faces[:, 0]]) > 0).mean() > 0.99


def test_the_command_writes_a_page_of_a_run_and_of_a_map(folder: Path, here: Here, tmp_path: Path) -> None:
    done = here("report", folder, "--out", tmp_path / "page.html")
    assert done.returncode == 0, done.stderr
    assert "page.html" in done.stdout
    assert (tmp_path / "page-side4.png").exists()
    wrong = here("report", folder, "--out", tmp_path / "page.pdf")
    assert (wrong.returncode, "expected a name ending in .html" in wrong.stderr) == (1, True)
    nothing = here("report", tmp_path / "nothing", "--out", tmp_path / "nothing.html")
    assert nothing.returncode == 1
    assert "does not exist" in nothing.stderr


def test_ctrl_c_leaves_no_part_of_a_page(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("tsfusion.core.durable_files.os.replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_report.write(folder, tmp_path / "page.html")
    assert list(tmp_path.iterdir()) == []


def test_the_page_in_a_browser(folder: Path) -> None:
    """The 3-D view has the mesh's pixels, also in the other colours; nothing else is asked for; it prints."""
    with browser() as chromium:
        chromium.open(folder / "report.html", width=900, height=700)
        chromium.evaluate(
            "document.addEventListener('drawn', (event) => { window.shot = event.target.toDataURL() })"
        )
        pictures = []
        for mode in ("0", "3", "4"):
            chromium.evaluate(
                "window.shot = null; (() => { const s = document.querySelector('.viewer select');"
                f"s.value = '{mode}'; s.dispatchEvent(new Event('change')); }})()"
            )
            chromium.wait("window.shot")
            content = base64.b64decode(chromium.evaluate("window.shot").partition(",")[2])
            pictures.append(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR).astype(int))
        paper = pictures[0][0, 0]
        seen = np.abs(pictures[0] - paper).sum(axis=2) > 30
        assert 0.15 < seen.mean() < 0.7  # a ball that fills the height of a wide picture
        assert np.abs(pictures[0] - pictures[1])[seen].mean() > 10
        assert np.abs(pictures[0] - pictures[2])[seen].mean() > 10
        chromium.open(folder / "report.html", width=360, height=700, dark=True)
        assert chromium.evaluate("document.documentElement.scrollWidth") <= 360
        assert chromium.pdf().startswith(b"%PDF")
        assert chromium.errors == []
        assert {url.partition(":")[0] for url in chromium.requests} <= {"file", "data"}
        assert len({url for url in chromium.requests if url.startswith("file:")}) == 1


@pytest.mark.usefixtures("quick_servers")  # which draw little
def test_a_state_folder_and_a_file_have_a_report(room_run: Path, here: Here, tmp_path: Path) -> None:
    """With the keyframes of its journal, whose they are, and the hash of the map that they make."""
    run = json.loads((room_run / "stdout.json").read_text())
    about = map_report.read(room_run / "state", None)
    assert about.poses is not None
    assert np.allclose(about.poses, read_poses(room_run / "out" / "keyframes.txt")[1], atol=1e-8)
    for source, words in (("state", ("000001.mcap", "closed")), ("out/map.tsf", ("no journal",))):
        done = here("report", room_run / source, "--out", "page.html", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)["files"][-1].endswith("page.html")
        found = Structure((tmp_path / "page.html").read_text(encoding="utf-8"))
        assert run["map_hash"] in found.text
        assert all(word in found.text for word in words)


@pytest.mark.parametrize(("server", "is_drawn"), [(0, False), (2e8, True)])
def test_memory_that_is_not_known_is_not_drawn_as_none(server: float, is_drawn: bool) -> None:
    """A server that somebody else started does not tell how much memory it takes."""
    columns = {"seconds": [0, 1], "map_bytes": [1e6, 2e6], "server_bytes": [server, server]}
    growth = {name: np.array(values, float) for name, values in columns.items()}
    drawn = run_sections.growth(RunFindings({}, [], [], growth, {}))
    assert ("server, both processes" in drawn) == is_drawn
    assert "Memory" in drawn
