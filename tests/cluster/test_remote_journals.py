# SPDX-License-Identifier: MIT
"""Journals are fused where they lie: ranges of them are read, and what cannot be read is an error."""

import importlib.util
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_processes import Here
from keyframes_and_servers import VOLUME, map_hash, wall

from tsfusion.cluster import keyframe_sources
from tsfusion.core.errors import JournalError, MissingDependency
from tsfusion.journal import Journal, locations
from tsfusion.wire.records import codec

upath = pytest.importorskip("upath", reason="universal-pathlib is not installed: pip install '.[s3]'")

SESSION, COUNT, SEGMENTS = b"\xcd" * 16, 12, "scans/monday/maps/yard/journal"
NEEDED = ("boto3", "flask", "moto", "s3fs")
OUT = ("--out", "out")


def segments(folder: Path) -> list[Path]:
    """The files of a journal of walls."""
    journal = Journal(folder, 1 << 14)
    for seq in range(1, COUNT + 1):
        frames = codec.encode(wall(seq), jpeg_quality=90, session=SESSION, seq=seq)
        journal.append(frames, session=SESSION, seq=seq)
    journal.close()
    found = sorted(folder.glob("*.mcap"))
    assert len(found) > 1
    return found


@pytest.fixture
def stored(tmp_path: Path) -> Iterator[Any]:
    """A journal in fsspec's store in memory, at `memory://scans/monday`; the store."""
    import fsspec

    store = fsspec.filesystem("memory")
    for path in segments(tmp_path / "journal"):
        store.pipe_file(f"{SEGMENTS}/{path.name}", path.read_bytes())
    yield store
    store.rm("scans", recursive=True)


def fused(url: str) -> str:
    found = keyframe_sources.listed([url])
    return map_hash(keyframe() for keyframe in keyframe_sources.reading(found.keyframes))


@pytest.mark.parametrize("place", ["memory://scans/monday", "memory://scans/monday/maps/yard/journal"])
def test_a_journal_of_a_url_gives_the_same_map(stored: Any, place: str) -> None:
    assert fused(place) == map_hash(wall(seq) for seq in range(1, COUNT + 1))
    one = f"memory://{SEGMENTS}/000001.mcap"
    assert 0 < keyframe_sources.listed([one]).count < COUNT


def test_no_more_is_read_than_a_workers_share(stored: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    found = keyframe_sources.listed(["memory://scans/monday"])
    first, last = found.shares(COUNT)[0], found.shares(COUNT)[-1]
    read: list[tuple[int, int]] = []
    read_at = locations.RemoteFile.read_at

    def counted(self: locations.RemoteFile, at: int, count: int) -> bytes:
        read.append((at, count))
        return read_at(self, at, count)

    monkeypatch.setattr(locations.RemoteFile, "read_at", counted)
    (keyframe,) = keyframe_sources.reading(last)
    assert keyframe().timestamp_ns == wall(COUNT).timestamp_ns
    sizes = [info["size"] for info in stored.ls(SEGMENTS, detail=True)]
    assert sum(count for _, count in read) < min(max(sizes), sum(sizes) / 4)
    (keyframe,) = keyframe_sources.reading(first)
    assert keyframe().timestamp_ns == wall(1).timestamp_ns


def test_a_url_that_nothing_here_reads_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gcsfs", None)  # as where it is not installed
    with pytest.raises(MissingDependency, match=r"reading gs://b/c needs another package .*gcsfs"):
        keyframe_sources.listed(["gs://b/c"])
    with pytest.raises(JournalError, match="foo://b/c cannot be read"):
        keyframe_sources.listed(["foo://b/c"])


def test_what_is_away_is_an_error(stored: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(JournalError, match="does not exist"):
        keyframe_sources.listed(["memory://scans/tuesday/journal.mcap"])
    found = keyframe_sources.listed(["memory://scans/monday"])

    def broken(self: object, at: int, count: int) -> bytes:
        with locations._Translated():
            raise TimeoutError("the store does not answer")
        return b""

    monkeypatch.setattr(locations.RemoteFile, "read_at", broken)
    with pytest.raises(JournalError, match="the store does not answer"):
        next(keyframe_sources.reading(found.keyframes))()
    with pytest.raises(JournalError, match=r"cannot read .*\.mcap: TimeoutError: the store does not answer"):
        keyframe_sources.listed(["memory://scans/monday"])


def test_a_url_without_what_reads_it_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "upath", None)
    with pytest.raises(MissingDependency, match=r"pip install '\.\[s3\]'"):
        locations.location("s3://scans/monday")
    assert locations.location("C/x.mcap") == Path("C/x.mcap")


@pytest.mark.skipif(
    not all(importlib.util.find_spec(name) for name in NEEDED),
    reason="a local S3 server needs: pip install '.[s3]' 'moto[server]' boto3",
)
@pytest.mark.filterwarnings("ignore")  # of the libraries around the server
def test_the_command_reads_an_object_store(
    tmp_path: Path, here: Here, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Workers are processes of their own, which know the store by their environment."""
    import boto3
    from moto.server import ThreadedMotoServer

    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    try:
        host, port = server.get_host_and_port()
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://{host}:{port}",
            "AWS_ACCESS_KEY_ID": "anybody",
            "AWS_SECRET_ACCESS_KEY": "anything",
            "AWS_DEFAULT_REGION": "us-east-1",
        }.items():
            monkeypatch.setenv(name, value)
        store = boto3.client("s3")
        store.create_bucket(Bucket="robots")
        for path in segments(tmp_path / "journal"):
            store.upload_file(str(path), "robots", f"{SEGMENTS}/{path.name}")
        done = here(
            "fuse",
            "s3://robots/scans/monday",
            "--voxel-size",
            VOLUME.voxel_size,
            "--workers",
            2,
            "--out",
            "out",
        )
        assert done.returncode == 0, done.stderr
        assert f"hash {map_hash(wall(seq) for seq in range(1, COUNT + 1))}" in done.stdout
        absent = here("fuse", "s3://robots/scans/tuesday", "--out", "none")
        assert (absent.returncode, "does not exist" in absent.stderr) == (1, True)
    finally:
        server.stop()
    assert "AWS_ENDPOINT_URL" in os.environ
