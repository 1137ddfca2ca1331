# SPDX-License-Identifier: MIT
"""Recordings of the catalogue: fetched, checked, unpacked, on the command line."""

import hashlib
import io
import json
import os
import re
import signal
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_processes import Here, end, eventually, started, tsfusion
from download_server import CONTENT, Server, one, serving, sha256, silent, tarred

from tsfusion.core.errors import DatasetError, MissingDependency, OutputError
from tsfusion.datasets import open_dataset
from tsfusion.datasets.download.catalogue import CATALOGUE, entry
from tsfusion.datasets.download.download import FetchedRecording, check, fetch

pytest.importorskip("pooch")


def test_what_is_there_is_not_fetched_again(server: Server, tmp_path: Path) -> None:
    recording = one(server.url)
    (first,) = fetch(recording, tmp_path, silent).files
    assert not first.known
    (second,) = fetch(recording, tmp_path, silent).files
    assert (second.known, second.fetched, second.sha256) == (True, False, sha256())
    (tmp_path / "file.bin").unlink()  # the unpacked one is enough
    assert fetch(recording, tmp_path, silent) == FetchedRecording(tmp_path / "one", [])
    assert len(server.asked) == 1


def test_a_wrong_checksum_leaves_nothing(server: Server, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=f"has another checksum than sha256:{'0' * 64}, and was not kept"):
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
            assert re.fullmatch(r"sha256:[0-9a-f]{64}|md5:[0-9a-f]{32}|None", str(file.checksum))
    with pytest.raises(DatasetError, match="known are tum-fr1-xyz"):
        entry("nothing")


def archive_of(folder: Path) -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w:gz") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file():
                archive.add(path, str(path.relative_to(folder)))
    return content.getvalue()


def test_the_command_fetches_what_replay_opens(
    here: Here, data: Callable[[str], Path], tmp_path: Path
) -> None:
    name, archive = "icl-nuim-living-room-2", "living_room_traj2_frei_png.tar.gz"
    with serving() as mirror:
        mirror.files[archive] = archive_of(data("icl_nuim_tum"))
        done = here("download", name, "--from", mirror.url, "--to", tmp_path)
        assert done.returncode == 0, done.stderr
        assert "CC BY 3.0" in done.stderr
        assert "unverified: no checksum is published" in done.stderr
        assert done.stdout.splitlines() == [str(tmp_path / name), f"next: tsfusion replay {tmp_path / name}"]
        found, expected = open_dataset(tmp_path / name), open_dataset(data("icl_nuim_tum"))
        assert np.array_equal(found[0].measurement, expected[0].measurement)
        assert found[0].intrinsics == expected[0].intrinsics
        again = here("download", name, "--from", mirror.url, "--to", tmp_path, "--json")
        assert json.loads(again.stdout)["files"][0]["known"]
        assert len(mirror.asked) == 1
        wrong = here("download", "tum-fr1-desk", "--from", mirror.url, "--to", tmp_path)
        assert wrong.returncode == 1
        assert wrong.stderr.splitlines()[-1].endswith("rgbd_dataset_freiburg1_desk.tgz: HTTP 404 Not Found")
    good = here("download", "--check", "--to", tmp_path)
    assert (good.returncode, "as expected" in good.stderr) == (0, True)
    (tmp_path / archive).write_bytes(b"rotten")
    assert here("download", "--check", "--to", tmp_path).returncode == 1


def test_the_command_lists_what_there_is(here: Here) -> None:
    listed = here("download")
    assert listed.returncode == 0
    assert all(one_.name in listed.stdout and one_.page in listed.stdout for one_ in CATALOGUE)
    rows = json.loads(here("download", "--json").stdout)
    assert [row["name"] for row in rows] == [one_.name for one_ in CATALOGUE]
    by_hand = here("download", "kitti-odometry")
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
    monkeypatch.setitem(sys.modules, "pooch", None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[download\]'"):
        fetch(one(server.url), tmp_path, silent)


def test_a_folder_that_cannot_be_written_is_named(server: Server, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(OutputError, match="cannot write"):
        fetch(one(server.url), tmp_path / "file", silent)
    if os.geteuid():
        (tmp_path / "closed").mkdir(mode=0o500)
        with pytest.raises(OutputError, match="cannot write"):
            fetch(one(server.url), tmp_path / "closed", silent)
