# SPDX-License-Identifier: MIT
"""Archives: unpacked beside themselves, and never out of their folder."""

import io
import shutil
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from download_server import Server, one, silent, tarred
from small_recordings import corbs, one_line, seven_scenes

from tsfusion.core import durable_files
from tsfusion.core.errors import DatasetError, OutputError
from tsfusion.datasets import describe, find, open_dataset
from tsfusion.datasets.download.catalogue import File, PublicRecording
from tsfusion.datasets.download.download import fetch

pytest.importorskip("pooch")


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


def _named(value: object) -> str | None:
    """Name of a parameter: not an archive's bytes, which hold the time at which this worker made it."""
    return "archive" if isinstance(value, bytes) else None


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.zip", zipped(("fine", b"1"), ("../outside", b"2")), r"cannot unpack .*a\.zip: .*leads out"),
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
    ids=_named,
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
    ids=_named,
)
def test_archives_that_unfold_to_more_than_the_disk_holds_are_refused(
    server: Server,
    small_disk: Callable[[int], Path],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    content: bytes,
) -> None:
    monkeypatch.setattr(durable_files, "_RESERVE_BYTES", 1 << 20)
    disk = small_disk(4)
    (disk / name).write_bytes(content)
    with pytest.raises(OutputError, match=r"8 MB are needed, \d MB are free on that disk"):
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


def corbs_zip(root: Path) -> Path:
    """The archive as its authors' Windows packs it: backslashes inside, the trajectory in one of its own."""
    place = corbs(root / "unpacked")
    archive = root / "D1_pre_registereddata.zip"
    with zipfile.ZipFile(archive, "w") as packed:
        for path in sorted(place.rglob("*")):
            if path.is_file():
                packed.write(
                    path, "D1_pre_registereddata\\" + str(path.relative_to(place)).replace("/", "\\")
                )
    shutil.move(root / "unpacked" / "D1_Trajectory", root / "D1_Trajectory")
    shutil.rmtree(root / "unpacked")
    return archive


def test_a_corbs_archive_is_unpacked_when_asked_to(tmp_path):
    archive = corbs_zip(tmp_path)
    with pytest.raises(
        DatasetError, match=r"\.zip is an archive; unpack it with: unzip -q '.*\.zip' -d '.*'"
    ):
        open_dataset(archive)
    dataset = open_dataset(archive, unpack=True)
    assert dataset.name == "CoRBS D1_pre_registereddata"
    assert (len(dataset), dataset.skipped, dataset.uncolored) == (4, {"without a pose in time": 1}, 1)
    assert describe(dataset).endswith("published for CoRBS")
    assert float(dataset[1].depth[0, 0] * dataset[1].depth_scale) == pytest.approx(2)
    assert dataset[1].T_world_camera[0, 3] == pytest.approx(1.8)
    assert len(open_dataset(archive)) == 4  # its folder is there now
    assert not list(tmp_path.glob(".unpacking-*"))


@pytest.mark.parametrize("suffix", [".tar.gz", ".tgz", ".tar"])
def test_other_archives_are_unpacked_too(tmp_path, suffix):
    seven_scenes(tmp_path / "in" / "chess")
    kind = {".tar.gz": "gztar", ".tgz": "gztar", ".tar": "tar"}[suffix]
    made = Path(shutil.make_archive(str(tmp_path / "chess-made"), kind, tmp_path / "in"))
    archive = made.rename(tmp_path / f"chess{suffix}")
    with pytest.raises(
        DatasetError, match=r"unpack it with: mkdir '.*chess' && tar -xf '.*' -C '.*chess', then"
    ):
        find(archive)
    assert find(archive, unpack=True).path == tmp_path / "chess" / "chess"


def test_a_broken_archive_leaves_nothing_behind(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"PK\x03\x04 and no more")
    (tmp_path / "b.tgz").write_bytes(b"nothing")
    for name in ("a.zip", "b.tgz"):
        one_line(lambda name=name: open_dataset(tmp_path / name, unpack=True), rf"cannot unpack .*{name}: ")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.zip", "b.tgz"]
