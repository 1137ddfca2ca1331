# SPDX-License-Identifier: MIT
"""Downloads from servers that do all that servers do, over real sockets."""

import builtins
import hashlib
import http.server
import io
import json
import os
import re
import shutil
import signal
import tarfile
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_processes import end, eventually, started, tsfusion

from tsfusion.core.errors import DatasetError, MissingDependency, OutputError
from tsfusion.datasets import open_dataset
from tsfusion.datasets.download import archives
from tsfusion.datasets.download import http as download_http
from tsfusion.datasets.download.catalogue import CATALOGUE, File, PublicRecording, entry
from tsfusion.datasets.download.download import FetchedRecording, check, fetch

pytest.importorskip("pooch")

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


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(download_http, "_PAUSE_S", 0.0)
    with serving() as running:
        yield running


def silent(_done: int, _all: int) -> None:
    pass


def one(url: str, name: str = "file.bin", checksum: str | None = None) -> PublicRecording:
    return PublicRecording(
        "one", "One", "https://example.org", "none", (File(f"{url}/{name}", name, checksum),)
    )


def sha256(content: bytes = CONTENT) -> str:
    return hashlib.sha256(content).hexdigest()


# --- one file ---


def test_a_file_comes_whole_with_its_progress(server: Server, tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    done = fetch(one(server.url, checksum=f"sha256:{sha256()}"), tmp_path, lambda *both: seen.append(both))
    (file,) = done.files
    assert (file.sha256, file.known, file.fetched) == (sha256(), True, True)
    assert file.path.read_bytes() == (done.path / "file.bin").read_bytes() == CONTENT
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert seen == sorted(seen)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file.bin", "file.bin.sha256", "one"]
    assert (tmp_path / "file.bin.sha256").read_text() == f"{sha256()}  file.bin\n"


def test_what_is_there_is_not_fetched_again(server: Server, tmp_path: Path) -> None:
    recording = one(server.url)
    (first,) = fetch(recording, tmp_path, silent).files
    assert not first.known
    (second,) = fetch(recording, tmp_path, silent).files
    assert (second.known, second.fetched, second.sha256) == (True, False, sha256())
    (tmp_path / "file.bin").unlink()  # the unpacked one is enough
    assert fetch(recording, tmp_path, silent) == FetchedRecording(tmp_path / "one", [])
    assert len(server.asked) == 1


@pytest.mark.parametrize("ranges", [True, False])
@pytest.mark.parametrize("tag", ['"one"', None])
def test_a_connection_that_is_cut_is_taken_up_again(
    server: Server, tmp_path: Path, ranges: bool, tag: str | None
) -> None:
    server.ranges, server.tag, server.cuts = ranges, tag, [1_000_000, 500_000]
    (file,) = fetch(one(server.url, checksum=f"sha256:{sha256()}"), tmp_path, silent).files
    assert file.path.read_bytes() == CONTENT
    if tag is None:  # nothing tells whether it is the same file: from its start
        assert server.asked == [None, None, None]
    elif ranges:
        assert server.asked == [None, "bytes=1000000-", "bytes=1500000-"]
    else:
        assert server.asked == [None, "bytes=1000000-", "bytes=500000-"]
    assert not list(tmp_path.glob("*.part*"))


def test_a_file_that_has_changed_is_begun_again(server: Server, tmp_path: Path) -> None:
    server.cuts, server.status = [1_000_000], [200, 503, 503, 503, 503]
    with pytest.raises(DatasetError, match=r"503.*1000000 bytes stay in .*file\.bin\.part"):
        fetch(one(server.url), tmp_path, silent)
    assert (tmp_path / "file.bin.part").read_bytes() == CONTENT[:1_000_000]
    server.tag, server.files["file.bin"] = '"two"', CONTENT[::-1]
    (file,) = fetch(one(server.url), tmp_path, silent).files
    assert file.path.read_bytes() == CONTENT[::-1]
    assert server.asked[-1] == "bytes=1000000-"  # the server did not agree


def test_a_part_that_is_whole_already_is_taken(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file.bin.part").write_bytes(CONTENT)
    (tmp_path / "file.bin.part.version").write_text('"one"')
    fetch(one(server.url), tmp_path, silent)
    assert server.asked == [f"bytes={len(CONTENT)}-"]
    (tmp_path / "longer").mkdir()
    (tmp_path / "longer" / "file.bin.part").write_bytes(CONTENT + b"more")
    (tmp_path / "longer" / "file.bin.part.version").write_text('"one"')
    (file,) = fetch(one(server.url), tmp_path / "longer", silent).files
    assert file.path.read_bytes() == CONTENT


def test_a_server_that_names_no_length_is_believed(server: Server, tmp_path: Path) -> None:
    server.with_length = False
    (file,) = fetch(one(server.url), tmp_path, silent).files
    assert file.path.read_bytes() == CONTENT


def test_a_wrong_checksum_leaves_nothing(server: Server, tmp_path: Path) -> None:
    with pytest.raises(
        DatasetError, match=f"not what it should be, and was not kept: expected sha256:{'0' * 64}"
    ):
        fetch(one(server.url, checksum=f"sha256:{'0' * 64}"), tmp_path, silent)
    assert list(tmp_path.iterdir()) == []
    md5 = hashlib.md5(CONTENT).hexdigest()
    assert fetch(one(server.url, checksum=f"md5:{md5}"), tmp_path, silent).files[0].sha256 == sha256()


def test_a_file_that_rots_on_the_disk_is_found(server: Server, tmp_path: Path) -> None:
    recording = one(server.url)
    assert check(recording, tmp_path) == []
    fetch(recording, tmp_path, silent)
    assert [file.known for file in check(recording, tmp_path)] == [True]
    with (tmp_path / "file.bin").open("r+b") as file:
        file.seek(1000)
        file.write(b"rot")
    for verb in (lambda: check(recording, tmp_path), lambda: fetch(recording, tmp_path, silent)):
        with pytest.raises(DatasetError, match=rf"expected {sha256()}; remove it"):
            verb()


def test_a_server_that_takes_back_what_it_sent_is_left(server: Server, tmp_path: Path) -> None:
    """Each answer is cut, and the next is of another place than was asked for."""
    server.cuts, server.wrong_place = [1_000_000] * 100, True
    with pytest.raises(DatasetError, match="the connection was cut"):
        fetch(one(server.url), tmp_path, silent)
    assert len(server.asked) < 10


def test_a_server_that_never_ends_does_not_fill_the_disk(
    server: Server, small_disk: Callable[[int], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = small_disk(4)
    server.with_length, server.files["file.bin"] = False, bytes(32 << 20)
    monkeypatch.setattr(download_http, "_RESERVE_BYTES", 1 << 20)
    with pytest.raises(OutputError, match=r"1 MB are to come, \d MB are free on that disk"):
        fetch(one(server.url), disk, silent)
    assert shutil.disk_usage(disk).free >= 1 << 20


def test_a_host_that_cannot_be_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"cannot download http://a\.\.b/file\.bin: no host can have"):
        fetch(one("http://a..b"), tmp_path, silent)


@pytest.mark.parametrize(
    ("setting", "value", "message"),
    [
        ("status", [404], "HTTP 404"),
        ("status", [403], "HTTP 403"),
        ("kind", "text/html; charset=utf-8", "answers with a web page"),
        ("redirect", "ftp://127.0.0.1/file", "redirects to ftp"),
        ("redirect", "file:///etc/passwd", "file:///etc/passwd.* is not allowed"),
        ("files", {}, "HTTP 404"),
        ("cuts", [0] * 4, "the connection was cut"),
    ],
)
def test_servers_that_refuse_are_one_clear_error(
    server: Server, tmp_path: Path, setting: str, value: Any, message: str
) -> None:
    setattr(server, setting, value)
    with pytest.raises(DatasetError, match=message):
        fetch(one(server.url), tmp_path, silent)
    assert not (tmp_path / "one").exists()


def test_busy_servers_are_asked_again(server: Server, tmp_path: Path) -> None:
    server.status = [503, 429, 500]
    fetch(one(server.url), tmp_path, silent)
    assert len(server.asked) == 4


def test_nobody_there_is_one_clear_error(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(download_http, "_PAUSE_S", 0.0)
    with serving() as gone:
        url = gone.url
    with pytest.raises(DatasetError, match="Connection refused"):
        fetch(one(url), tmp_path, silent)
    for bad in ("ftp://127.0.0.1", "file:///etc"):
        with pytest.raises(DatasetError, match="only https and http"):
            fetch(one(bad), tmp_path, silent)


def test_a_disk_without_room_is_said_before(
    server: Server, small_disk: Callable[[int], Path], tmp_path: Path
) -> None:
    disk = small_disk(4)
    with pytest.raises(OutputError, match=r"3 MB are to come, 4 MB are free"):
        fetch(one(server.url), disk, silent)


def test_a_disk_that_fills_keeps_the_part(
    server: Server, small_disk: Callable[[int], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = small_disk(2)
    monkeypatch.setattr(download_http, "_RESERVE_BYTES", -(1 << 40))
    with pytest.raises(OutputError, match="No space left on device; what has come stays"):
        fetch(one(server.url), disk, silent)
    part = disk / "file.bin.part"
    assert part.read_bytes() == CONTENT[: part.stat().st_size]
    assert part.stat().st_size > 1_000_000


def test_two_downloads_of_one_file_do_not_mix(server: Server, tmp_path: Path) -> None:
    server.stall = 1_100_000
    failed: list[Exception] = []

    def first() -> None:
        try:
            fetch(one(server.url), tmp_path, silent)
        except DatasetError as error:
            failed.append(error)

    thread = threading.Thread(target=first)
    thread.start()
    try:
        assert server.stalled.wait(30)
        part = tmp_path / "file.bin.part"
        assert eventually(lambda: part.exists() and part.stat().st_size >= 1_000_000)
        with pytest.raises(OutputError, match="another download of it is under way"):
            fetch(one(server.url), tmp_path, silent)
    finally:
        server.stall = None
        server.go_on.set()
        thread.join(60)
    assert failed == []
    assert (tmp_path / "file.bin").read_bytes() == CONTENT


# --- archives ---


def zipped(*members: tuple[str, bytes], links: tuple[str, ...] = ()) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members:
            archive.writestr(name, data)
        for name in links:
            link = zipfile.ZipInfo(name)
            link.external_attr = 0o120777 << 16
            archive.writestr(link, "/etc/passwd")
    return content.getvalue()


def tarred(*members: tuple[str, bytes], kind: bytes = tarfile.REGTYPE) -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as archive:
        for name, data in members:
            member = tarfile.TarInfo(name)
            member.type, member.size, member.linkname = kind, len(data), "/etc/passwd"
            archive.addfile(member, io.BytesIO(data))
    return content.getvalue()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.zip", zipped(("fine", b"1"), ("../outside", b"2")), "leads out"),
        ("a.zip", zipped(("/abs", b"1")), "leads out"),
        ("a.zip", zipped(("x\\..\\..\\outside", b"1")), "leads out"),
        ("a.zip", zipped(("C:\\outside", b"1")), "leads out"),
        ("a.zip", zipped(links=("link",)), "is no plain file"),
        ("a.zip", zipped(("inner.zip", zipped(("../../outside", b"1")))), "leads out"),
        ("a.tgz", tarred(("fine", b"1"), ("../outside", b"2")), "leads out"),
        ("a.tgz", tarred(("/abs", b"1")), "leads out"),
        ("a.tgz", tarred(("link", b""), kind=tarfile.SYMTYPE), "is no plain file"),
        ("a.tgz", tarred(("link", b""), kind=tarfile.LNKTYPE), "is no plain file"),
        ("a.tgz", tarred(("pipe", b""), kind=tarfile.FIFOTYPE), "is no plain file"),
        ("a.tgz", tarred(("file", bytes(100_000)))[:-40], "cannot unpack"),
        ("a.zip", b"no zip", "cannot unpack"),
    ],
)
def test_archives_that_lead_out_are_refused_whole(
    server: Server, tmp_path: Path, name: str, content: bytes, message: str
) -> None:
    server.files[name] = content
    with pytest.raises(DatasetError, match=message):
        fetch(one(server.url, name), tmp_path / "deep" / "er", silent)
    left = [path for path in tmp_path.rglob("*") if path.is_file()]
    assert sorted(path.name for path in left) == [name, f"{name}.sha256"]


@pytest.mark.parametrize(
    ("name", "content"),
    [("a.zip", zipped(("big", bytes(8 << 20)))), ("a.tgz", tarred(("fine", b"1"), ("big", bytes(8 << 20))))],
)
def test_archives_that_unfold_to_more_than_the_disk_holds_are_refused(
    server: Server,
    small_disk: Callable[[int], Path],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    content: bytes,
) -> None:
    monkeypatch.setattr(archives, "_RESERVE_BYTES", 1 << 20)
    disk = small_disk(4)
    (disk / name).write_bytes(content)
    with pytest.raises(OutputError, match=r"it unpacks to 8 MB, \d MB are free on that disk"):
        fetch(one(server.url, name), disk, silent)
    assert sorted(path.name for path in disk.iterdir()) == [name, f"{name}.sha256"]


def test_an_archive_that_cannot_be_unpacked_can_be_fetched_again(server: Server, tmp_path: Path) -> None:
    server.files["a.zip"] = b"no zip"
    for _ in range(2):
        with pytest.raises(DatasetError, match=r"cannot unpack .*a\.zip: .*; remove .* to fetch it again"):
            fetch(one(server.url, "a.zip"), tmp_path, silent)


def test_archives_within_archives_and_several_files_make_one_folder(server: Server, tmp_path: Path) -> None:
    server.files |= {
        "scene.zip": zipped(("scene/seq-01.zip", zipped(("seq-01/frame", b"1"))), ("scene/note", b"2")),
        "depth.tgz": tarred(("00.png", b"3")),
        "traj.txt": b"4",
    }
    files = (File("", "scene.zip"), File("", "depth.tgz", into="depth"), File("", "traj.txt"))
    recording = PublicRecording("all", "All", "", "", files, opens="scene")
    done = fetch(recording, tmp_path, silent, base=f"{server.url}/")
    assert done.path == tmp_path / "all" / "scene"
    found = {str(path.relative_to(tmp_path / "all")): path.read_text()
             for path in (tmp_path / "all").rglob("*") if path.is_file()}  # fmt: skip
    assert found == {"scene/seq-01/frame": "1", "scene/note": "2", "depth/00.png": "3", "traj.txt": "4"}


# --- the catalogue and the command ---


def test_every_entry_can_be_asked_for() -> None:
    assert len({one.name for one in CATALOGUE}) == len(CATALOGUE)
    names = [file.name for one in CATALOGUE for file in one.files]
    assert len(set(names)) == len(names)
    for one_ in CATALOGUE:
        assert one_.title
        assert one_.licence
        assert one_.page.startswith("http")
        assert one_.files or one_.note
        for file in one_.files:
            assert re.fullmatch(r"https?://\S+", file.url)
            assert file.checksum is None or re.fullmatch(
                r"sha256:[0-9a-f]{64}|md5:[0-9a-f]{32}", file.checksum
            )
    with pytest.raises(DatasetError, match="known are tum-fr1-xyz"):
        entry("nothing")


def archive_of(folder: Path) -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.add(path, str(path.relative_to(folder)))
    return content.getvalue()


def test_the_command_fetches_what_replay_opens(data: Callable[[str], Path], tmp_path: Path) -> None:
    name, archive = "icl-nuim-living-room-2", "living_room_traj2_frei_png.tar.gz"
    with serving() as mirror:
        mirror.files[archive] = archive_of(data("icl_nuim_tum"))
        done = tsfusion("download", name, "--from", mirror.url, "--to", tmp_path)
        assert done.returncode == 0, done.stderr
        assert "CC BY 3.0" in done.stderr
        assert "unverified: no checksum is published" in done.stderr
        assert done.stdout.splitlines() == [str(tmp_path / name), f"next: tsfusion replay {tmp_path / name}"]
        found, expected = open_dataset(tmp_path / name), open_dataset(data("icl_nuim_tum"))
        assert np.array_equal(found[0].measurement, expected[0].measurement)
        assert found[0].intrinsics == expected[0].intrinsics
        again = tsfusion("download", name, "--from", mirror.url, "--to", tmp_path, "--json")
        assert json.loads(again.stdout)["files"][0]["known"]
        assert len(mirror.asked) == 1
        wrong = tsfusion("download", "tum-fr1-desk", "--from", mirror.url, "--to", tmp_path)
        assert wrong.returncode == 1
        assert wrong.stderr.splitlines()[-1].endswith("rgbd_dataset_freiburg1_desk.tgz: HTTP 404 Not Found")
    good = tsfusion("download", "--check", "--to", tmp_path)
    assert (good.returncode, "as expected" in good.stderr) == (0, True)
    (tmp_path / archive).write_bytes(b"rotten")
    assert tsfusion("download", "--check", "--to", tmp_path).returncode == 1


def test_the_command_lists_what_there_is() -> None:
    listed = tsfusion("download")
    assert listed.returncode == 0
    assert all(one_.name in listed.stdout and one_.page in listed.stdout for one_ in CATALOGUE)
    rows = json.loads(tsfusion("download", "--json").stdout)
    assert [row["name"] for row in rows] == [one_.name for one_ in CATALOGUE]
    by_hand = tsfusion("download", "kitti-odometry")
    assert by_hand.returncode == 1
    assert "registration" in by_hand.stderr
    assert "https://www.cvlibs.net/datasets/kitti/eval_odometry.php" in by_hand.stderr


def test_ctrl_c_keeps_the_part_and_the_next_call_goes_on(tmp_path: Path) -> None:
    name, archive = "icl-nuim-living-room-1", "living_room_traj1_frei_png.tar.gz"
    content = tarred(("depth.txt", CONTENT))
    with serving() as mirror:
        mirror.files[archive], mirror.stall = content, 1_500_000
        process = started("download", name, "--from", mirror.url, "--to", tmp_path)
        part = tmp_path / f"{archive}.part"
        try:
            assert mirror.stalled.wait(60)
            assert eventually(lambda: part.exists() and part.stat().st_size > 1_000_000)
        finally:
            code = end(process, signal.SIGINT)
        assert code == 130
        there = part.stat().st_size
        assert sorted(path.name for path in tmp_path.iterdir()) == [part.name, f"{part.name}.version"]
        mirror.stall = None
        assert tsfusion("download", name, "--from", mirror.url, "--to", tmp_path).returncode == 0
        assert mirror.asked == [None, f"bytes={there}-"]
    assert (tmp_path / name / "depth.txt").read_bytes() == CONTENT


def test_without_pooch_the_error_names_the_command(
    server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = builtins.__import__

    def without(name: str, *arguments: Any, **more: Any) -> Any:
        if name == "pooch":
            raise ImportError(name)
        return real(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependency, match=r"pip install 'tsfusion\[download\]'"):
        fetch(one(server.url), tmp_path, silent)


def test_a_folder_that_cannot_be_written_is_named(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="cannot write"):
        fetch(one(server.url), tmp_path / "file", silent)
    if os.geteuid():
        (tmp_path / "closed").mkdir(mode=0o500)
        with pytest.raises(OutputError, match="cannot write"):
            fetch(one(server.url), tmp_path / "closed", silent)
