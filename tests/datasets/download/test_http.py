# SPDX-License-Identifier: MIT
"""One file over HTTP: cut, continued, changed, refused, too large for the disk."""

import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_processes import eventually
from download_server import CONTENT, Server, one, serving, sha256, silent

from tsfusion.core import durable_files
from tsfusion.core.errors import DatasetError, OutputError
from tsfusion.datasets.download import http as download_http
from tsfusion.datasets.download.download import fetch

pytest.importorskip("pooch")

Disk = Callable[[int], Path]


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


def test_a_server_that_takes_back_what_it_sent_is_left(server: Server, tmp_path: Path) -> None:
    """Each answer is cut, and the next is of another place than was asked for."""
    server.cuts, server.wrong_place = [1_000_000] * 100, True
    with pytest.raises(DatasetError, match="the connection was cut"):
        fetch(one(server.url), tmp_path, silent)
    assert len(server.asked) < 10


def test_a_server_that_never_ends_does_not_fill_the_disk(
    server: Server, small_disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = small_disk(4)
    server.with_length, server.files["file.bin"] = False, bytes(32 << 20)
    monkeypatch.setattr(durable_files, "_RESERVE_BYTES", 1 << 20)
    with pytest.raises(OutputError, match=r"1 MB are needed, \d MB are free on that disk"):
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


def test_a_disk_without_room_is_said_before(server: Server, small_disk: Disk, tmp_path: Path) -> None:
    disk = small_disk(4)
    with pytest.raises(OutputError, match=r"3 MB are needed, 4 MB are free"):
        fetch(one(server.url), disk, silent)


def test_a_disk_that_fills_keeps_the_part(
    server: Server, small_disk: Disk, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = small_disk(2)
    monkeypatch.setattr(durable_files, "_RESERVE_BYTES", -(1 << 40))
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
