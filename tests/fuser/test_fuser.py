# SPDX-License-Identifier: MIT
"""The fuser's answer to each message, in this process with a list for a link; its own log lines."""

import errno
import json
import mmap
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Literal, cast

import cv2
import msgspec
import numpy as np
import pytest
from command_processes import alive, python
from failures import raising, refuse
from keyframes_and_servers import VOLUME, pose, serving, until, wall
from quick_fusers import SUMS
from resident_memory import unnamed_files_rss
from saved_maps import ANNA, BOB, make_map

import tsfusion
from tsfusion import VolumeConfig
from tsfusion.core import durable_files, errors, folder_lock, process
from tsfusion.core.config import CacheConfig, override
from tsfusion.fuser import __main__ as fuser_main
from tsfusion.fuser import fuser_messages, map_checkpoints
from tsfusion.fuser.fuser import Chore, Fuser
from tsfusion.fuser.fuser_messages import CurrentKeyframe, FuserQuestion, Meshed
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.journal import Journal, Position, segment_path
from tsfusion.journal.state_folder import MAP_FILE, PREVIOUS_FILE
from tsfusion.tsdf.surface.changed_cells import ChangedCells
from tsfusion.tsdf.surface.map_surface import MapSurface
from tsfusion.wire.asking.queries import fetch_health
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Cells
from tsfusion.wire.records import codec, corrections, record_header


class Link:
    """Takes what the fuser sends."""

    def __init__(self) -> None:
        self.sent: list[tuple[fuser_messages.ToGateway, list[Any]]] = []

    def send_multipart(self, frames: list[Any], copy: bool) -> None:
        assert not copy
        self.sent.append((fuser_messages.to_gateway.decode(frames[0]), frames[1:]))

    def last(self) -> Any:
        return self.sent[-1][0]

    def done(self) -> fuser_messages.Done:
        return [message for message, _ in self.sent if isinstance(message, fuser_messages.Done)][-1]


SESSION = bytes(16)


def order(index: int, position: Position, skip: str | None = None) -> fuser_messages.Fuse:
    return fuser_messages.Fuse(index, position, SESSION, index + 1, "robot", skip=skip)


def fill(state: Path, count: int) -> list[Position]:
    journal = Journal(state / "journal", 1 << 20)
    positions = [
        journal.append(
            codec.encode(wall(i), session=SESSION, seq=i + 1, jpeg_quality=90), session=SESSION, seq=i + 1
        )
        for i in range(count)
    ]
    journal.close()
    return positions


def opened(state: Path, volume: VolumeConfig = VOLUME, **settings: Any) -> tuple[Fuser, Link]:
    link = Link()
    working = state / "working"
    working.write_bytes(bytes(8))
    usual = {
        "mesh_interval": 0.0,
        "checkpoint_every": 0,
        "keep_previous": False,
        "memory_bytes": 1 << 40,
        "quota_cost": 10**8,
        "quota_map": 0.75,
    }
    begin = fuser_messages.Begin(str(state), volume, working=str(working), **{**usual, **settings})
    return Fuser(link, begin), link  # type: ignore[arg-type]


def is_due(fuser: Fuser, chore: str, *, idle: bool = True) -> bool:
    return fuser.chores[chore].wait(idle) == 0


def test_the_first_chore_that_is_due_is_done(tmp_path: Path) -> None:
    fuser, _ = opened(tmp_path)
    assert list(fuser.chores) == ["mesh", "news", "search", "move", "prepare", "warm", "refine", "retry"]
    assert [name for name, chore in fuser.chores.items() if not chore.when_idle] == [
        "mesh",
        "news",
        "search",
        "move",
    ]
    done: list[str] = []
    waits: dict[str, float | None] = {"late": 3.0, "never": None, "idle": 0.0, "always": 0.0, "behind": 0.0}

    def chore(name: str) -> Chore:
        return Chore(lambda _: waits[name], lambda: done.append(name), when_idle=name == "idle")

    fuser.chores = {name: chore(name) for name in waits}
    assert [fuser.do_chore(idle=idle) for idle in (False, True)] == [0.0, 0.0]
    assert done == ["always", "idle"]
    waits.update(idle=2.0, always=None, behind=None)
    assert [fuser.do_chore(idle=idle) for idle in (False, True)] == [3.0, 2.0]
    waits.update(late=None, idle=None)
    assert fuser.do_chore(idle=True) is None


def test_kernels_of_questions_are_compiled_while_there_is_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled = []

    def warming_up(_: object) -> Iterator[None]:
        compiled.append("keyframes")
        yield
        compiled.append("questions")
        yield
        compiled.append("slices")

    monkeypatch.setattr(tsfusion.Volume, "warming_up", warming_up)
    position, fuser, _ = opened_with_one(tmp_path)
    assert fuser.do_chore(idle=True) != 0  # a keyframe may be near
    wait = fuser.chores["warm"].wait(True)
    assert wait is not None
    assert 0 < wait <= 1
    monkeypatch.setattr("tsfusion.fuser.live_mesh._QUIET_S", 0.0)
    fuser.handle(order(0, position))
    fuser.chores["mesh"].do()
    assert fuser.do_chore(idle=False) != 0
    assert compiled == ["keyframes"]
    while is_due(fuser, "warm"):
        assert fuser.do_chore(idle=True) == 0
    assert compiled == ["keyframes", "questions", "slices"]
    assert fuser.do_chore(idle=True) != 0


def opened_with_one(state: Path) -> tuple[Position, Fuser, Link]:
    """A fuser with one journaled keyframe to fuse."""
    (position,) = fill(state, 1)
    return position, *opened(state)


def ask(fuser: Fuser, name: Literal["mesh", "status"], min_weight: float | None = None) -> None:
    fuser.handle(fuser_messages.FuserQuestion(1, Command(name=name, min_weight=min_weight), 0, 1 << 62))


def status(fuser: Fuser, link: Link) -> SimpleNamespace:
    ask(fuser, "status")
    return SimpleNamespace(**link.last().figures | {"peak_rss_bytes": 0})  # of this whole process


def test_keyframes_are_fused_meshed_and_checkpointed(tmp_path: Path) -> None:
    positions = fill(tmp_path, 3)
    fuser, link = opened(tmp_path)
    assert fuser.ready().done == {}
    assert not is_due(fuser, "mesh")
    for index, position in enumerate(positions):
        fuser.handle(order(index, position))
        done = link.last()
        assert (done.index, done.reason, done.fused_ns > done.fuse_start_ns > 0) == (index, None, True)
    assert is_due(fuser, "mesh")
    fuser.chores["mesh"].do()
    assert (link.last().count, link.sent[-1][1]) == (3, [])
    fuser.handle(fuser_messages.Finish())
    assert fuser.exit_status == 0
    again, link_again = opened(tmp_path)
    assert again.ready().done == {SESSION: fuser_messages.SessionProgress(3, "robot")}
    assert status(again, link_again) == status(fuser, link)


@pytest.mark.skipif(sys.platform != "linux", reason="a cache needs Linux")
def test_a_map_whose_blocks_wait_on_the_disk_is_the_same_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process, "limit_memory", lambda _: None)
    if durable_files.is_in_memory(tmp_path):
        pytest.skip("the folder for temporary files is a RAM disk")
    fine, positions = override(VOLUME, voxel_size=0.01), fill(tmp_path, 4)
    limits = {"memory_bytes": 1 << 20, "cache": CacheConfig(folder=str(tmp_path))}
    usual, link = opened(tmp_path, fine)
    for index, position in enumerate(positions):
        usual.handle(order(index, position))
    expected = status(usual, link)
    assert expected.map_bytes > 4 << 20
    fuser, link = opened(tmp_path, fine, **limits)
    for index, position in enumerate(positions[:2]):
        fuser.handle(order(index, position))
    fuser.chores["mesh"].do()
    fuser.handle(fuser_messages.Finish())
    again, link = opened(tmp_path, fine, **limits)
    for index, position in enumerate(positions):
        again.handle(order(index, position))
    assert status(again, link) == expected
    assert unnamed_files_rss(tmp_path) < 3 << 20
    little = CacheConfig(folder=str(tmp_path), disk_bytes=1 << 20)
    full, link = opened(tmp_path, fine, memory_bytes=1 << 20, cache=little)
    full.handle(msgspec.structs.replace(order(2, positions[2]), client=""))  # whose share is all of it
    done = link.last()
    assert (done.reason, "1048576 bytes on the disk" in done.message) == ("MapFull", True)


def test_a_sensor_that_no_map_knows_is_rejected_where_an_older_server_journaled_it(tmp_path: Path) -> None:
    with closing(Journal(tmp_path / "journal", 1 << 20)) as journal:
        frames = codec.encode(wall(0, sensor="sonar"), session=SESSION, seq=1, jpeg_quality=90)
        position = journal.append(frames, session=SESSION, seq=1)
    fuser, link = opened(tmp_path)
    fuser.handle(order(0, position))
    assert (link.last().index, link.last().reason) == (0, "InvalidConfig")
    assert status(fuser, link).keyframes_rejected == {"InvalidConfig": 1}


def watch(fuser: Fuser, link: Link, since: int = 0, wait_s: float = 0.0) -> dict[str, Any] | None:
    """Arrays of the answer to a viewer; None if it waits."""
    before, now = len(link.sent), time.monotonic_ns()
    question = Cells(since=since, epoch=fuser._epoch, wait_s=wait_s)
    asked = FuserQuestion(1, Command(name="ask", question=question), now, now + 60 * 10**9)
    fuser._answers._inbox.questions.append((asked, []))
    fuser.answer()
    return arrays_of(link) if len(link.sent) > before else None


def arrays_of(link: Link) -> dict[str, Any]:
    answered, frames = link.sent[-1]
    assert isinstance(answered, fuser_messages.FuserAnswer)
    assert answered.answer is not None, answered.error
    return questions.unpack(answered.answer, frames)


def test_watchers_get_the_triangles_as_soon_as_they_are_there(tmp_path: Path) -> None:
    position, fuser, link = opened_with_one(tmp_path)
    empty = watch(fuser, link)
    assert empty is not None
    assert (len(empty["cells"]), empty["begins"], empty["more"]) == (0, True, False)
    assert watch(fuser, link, int(empty["until"]), 1.0) is None
    assert not is_due(fuser, "news")
    fuser.handle(order(0, position))
    fuser.chores["mesh"].do()
    assert is_due(fuser, "news")
    fuser.chores["news"].do()
    found = arrays_of(link)
    assert (len(found["faces"]) > 0, found["begins"], found["is_refined"].any()) == (True, False, False)
    assert not is_due(fuser, "news")


def test_nothing_is_meshed_while_nobody_watches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    position, fuser, link = opened_with_one(tmp_path)
    with monkeypatch.context() as patched:
        for where, name in ((MapSurface, "mesh_cells"), (ChangedCells, "__init__")):
            patched.setattr(where, name, raising(AssertionError("meshed for nobody")))
        fuser.handle(order(0, position))
        fuser.chores["mesh"].do()
        assert not is_due(fuser, "refine")
    meshed, frames = link.sent[-1]
    assert isinstance(meshed, Meshed)
    assert (meshed.count, frames) == (1, [])
    ask(fuser, "mesh")
    assert link.last().mesh.faces > 0


def test_what_was_meshed_as_fused_is_refined_bit_by_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tsfusion.fuser.live_mesh._REFINED_AT_ONCE", 10)
    monkeypatch.setattr("tsfusion.fuser.live_mesh._QUIET_S", 1e6)
    position, fuser, link = opened_with_one(tmp_path)
    fuser.handle(order(0, position))
    fuser.chores["mesh"].do()
    assert not is_due(fuser, "refine"), "nobody watches"
    raw = watch(fuser, link)
    assert raw is not None
    assert not raw["is_refined"].any(), "the next keyframe may be near"
    assert not is_due(fuser, "refine"), "nobody waits"
    monkeypatch.setattr(fuser._live_mesh, "_quiet_from", 0.0)
    until, parts = int(raw["until"]), []
    while watch(fuser, link, until, 1.0) is None and is_due(fuser, "refine"):
        fuser.chores["refine"].do()
        fuser.chores["news"].do()
        parts.append(arrays_of(link))
        until = int(parts[-1]["until"])
    assert len(parts) > 1
    assert all(one["is_refined"].all() for one in parts)
    whole = fuser._volume.extract_mesh()
    assert sum(len(one["faces"]) for one in parts) == len(whole.faces) > 0
    cells = np.concatenate([one["cells"] for one in parts])
    assert len(np.unique(cells, axis=0)) == len(cells) == len(raw["cells"])


def test_what_cannot_be_fused_is_counted_also_after_a_restart(tmp_path: Path) -> None:
    positions = fill(tmp_path, 2)
    fuser, link = opened(tmp_path, checkpoint_every=1)
    fuser.handle(order(0, Position(1, 42)))
    assert link.done().reason == "JournalError"
    fuser.handle(order(1, positions[0], skip="crash"))
    assert link.done().reason == "crash"
    rejected = {"JournalError": 1, "crash": 1}
    assert status(fuser, link).keyframes_rejected == rejected
    assert status(*opened(tmp_path)).keyframes_rejected == rejected


def test_corrections_are_answered_before_they_move_the_map(tmp_path: Path) -> None:
    positions = fill(tmp_path, 1)
    log = Journal(tmp_path / "journal", 1 << 20)
    good = corrections.encode(corrections.checked({1: pose(1)}, removed=[2]), session=SESSION, seq=2)
    for seq, frames in ((2, good), (3, [b"TSC\x01nonsense", b""])):
        positions.append(log.append(frames, session=SESSION, seq=seq))
    log.close()
    fuser, link = opened(tmp_path, checkpoint_every=1)
    fuser.handle(order(0, positions[0]))
    before = status(fuser, link)
    for index, reason in ((1, None), (2, "header")):
        fuser.handle(msgspec.structs.replace(order(index, positions[index]), is_correction=True))
        assert link.done().reason == reason
    fuser.chores["mesh"].do()
    assert link.last().count == 3
    assert status(fuser, link) == before
    again, link_again = opened(tmp_path)
    assert again.ready().done[SESSION].seq == 3
    assert status(again, link_again) == before


def saved(state: Path) -> Path:
    volume = tsfusion.Volume(VOLUME)
    volume.integrate(wall())
    return volume.save(state / MAP_FILE, meta={"done": {SESSION.hex(): [1, ""]}, "rejected": {}})


def test_a_map_of_other_settings_is_one_clear_error(tmp_path: Path) -> None:
    saved(tmp_path)
    with pytest.raises(
        errors.InvalidConfig, match=r"was made with voxel_size = 0\.04, got 0\.05: go on with"
    ) as raised:
        opened(tmp_path, VolumeConfig(voxel_size=0.05))
    assert "remove" not in str(raised.value)  # the journal may not go back to the start
    opened(tmp_path, VolumeConfig(voxel_size=0.04, threads=2, max_blocks=10_000))


def test_a_damaged_checkpoint_is_set_aside_and_the_journal_fused_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = saved(tmp_path)
    stored = bytearray(path.read_bytes())
    stored[len(stored) // 2] ^= 1
    for name in ("map.damaged", "map.damaged2"):  # nothing that was set aside is overwritten
        path.write_bytes(stored)
        fuser, _ = opened(tmp_path)
        assert fuser.ready().done == {}
        assert "built again from the journal" in caplog.text
        assert (tmp_path / name).read_bytes() == stored
    assert not path.exists()


def test_another_maps_checkpoint_is_set_aside_and_the_journal_fused_anew(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is whole in itself, as a slip of `cp` or a restored backup leaves it."""
    ours, theirs = make_map(tmp_path / "ours", range(3)), make_map(tmp_path / "theirs", range(5), session=BOB)
    content = (theirs / "map.tsf").read_bytes()
    (ours / "map.tsf").write_bytes(content)
    fuser, _ = opened(ours)
    assert fuser.ready().done == {}
    assert "is the checkpoint of another map than that of the journal beside it" in caplog.text
    assert (ours / "map.damaged").read_bytes() == content


def journaled(folder: Path, *records: tuple[bytes, int], quality: int = 90) -> None:
    """Write a journal of records, a session and a number each."""
    journal = Journal(folder / "journal", 1 << 20, sync=False)
    for view, (session, seq) in enumerate(records):
        frames = codec.encode(wall(view), session=session, seq=seq, jpeg_quality=quality)
        journal.append(frames, session=session, seq=seq)
    journal.close()


def test_a_checkpoint_whose_last_keyframe_alone_is_of_another_map_is_set_aside(tmp_path: Path) -> None:
    ours = tmp_path / "ours"
    journaled(ours, (ANNA, 1), (BOB, 1))
    (ours / "map.tsf").write_bytes((make_map(tmp_path / "theirs", range(2)) / "map.tsf").read_bytes())
    assert opened(ours)[0].ready().done == {}
    assert (ours / "map.damaged").exists()


@pytest.mark.parametrize("quality", [90, 100])  # records as long as before, and longer ones
def test_a_journal_that_begins_anew_beside_an_older_checkpoint_keeps_it(tmp_path: Path, quality: int) -> None:
    folder = make_map(tmp_path, range(3))
    shutil.rmtree(folder / "journal")
    journaled(folder, (BOB, 1), (BOB, 2), quality=quality)
    assert set(opened(folder)[0].ready().done) == {ANNA}


def test_an_older_or_newer_checkpoint_of_the_same_journal_is_taken(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(2))
    older = (folder / "map.tsf").read_bytes()
    make_map(folder, range(2, 4), session=BOB)
    newer = (folder / "map.tsf").read_bytes()
    (folder / "map.tsf").write_bytes(older)
    assert set(opened(folder)[0].ready().done) == {ANNA}
    (folder / "map.tsf").write_bytes(newer)
    segment_path(folder / "journal", 2).unlink()  # as in a backup that has the journal as it was before
    assert set(opened(folder)[0].ready().done) == {ANNA, BOB}


@pytest.mark.parametrize("code", [errno.EMFILE, errno.EIO, errno.EACCES, errno.ENOMEM])
def test_a_checkpoint_that_cannot_be_read_now_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    path = saved(tmp_path)
    real = Path.open

    def refused(self: Path, *arguments: Any, **more: Any) -> Any:
        if self == path:
            raise OSError(code, os.strerror(code))
        return real(self, *arguments, **more)

    with monkeypatch.context() as patched:
        patched.setattr(Path, "open", refused)
        with pytest.raises(errors.CheckpointError, match=os.strerror(code)):
            opened(tmp_path)
    assert opened(tmp_path)[0].ready().done == {SESSION: fuser_messages.SessionProgress(1, "")}


def test_a_checkpoint_without_memory_for_it_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = saved(tmp_path)

    monkeypatch.setattr("tsfusion.tsdf.store.block_store.BlockStore.reserve", raising(MemoryError()))
    with pytest.raises(errors.CheckpointError, match="does not fit"):
        opened(tmp_path)
    assert path.exists()


def test_a_keyframe_that_the_map_has_is_not_fused_again(tmp_path: Path) -> None:
    positions = fill(tmp_path, 2)
    fuser, link = opened(tmp_path)
    for index in (0, 1, 0):
        fuser.handle(order(index, positions[index]))
    assert (link.last().index, link.last().reason) == (0, None)
    assert status(fuser, link).keyframes_fused == 2


def test_a_checkpoint_on_request_keeps_the_one_before(tmp_path: Path) -> None:
    """The journal forgets what both hold, so a damaged one is made good by the other."""
    positions = fill(tmp_path, 3)
    fuser, link = opened(tmp_path, keep_previous=True)
    fuser.handle(fuser_messages.Save())
    assert link.last() == fuser_messages.Saved(written=False)
    for index in (0, 1):
        fuser.handle(order(index, positions[index]))
        fuser.handle(fuser_messages.Save())
        assert link.last() == fuser_messages.Saved(written=True)
    assert (tmp_path / PREVIOUS_FILE).exists()
    (tmp_path / MAP_FILE).write_bytes(b"")
    again, _ = opened(tmp_path, keep_previous=True)
    assert again.ready().done == {SESSION: fuser_messages.SessionProgress(1, "robot")}


@pytest.mark.parametrize("keep_previous", [False, True])
@pytest.mark.parametrize("call", ["fsync", "replace"])
def test_a_checkpoint_that_fails_leaves_the_old_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, keep_previous: bool
) -> None:
    folder = tmp_path / "map"
    folder.mkdir()
    written = MapCheckpoints(folder, VOLUME, keep_previous=keep_previous)
    for seq in (1, 2):
        written.done = {SESSION: fuser_messages.SessionProgress(seq, "robot")}
        assert written.save()
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert sorted(before) == ([PREVIOUS_FILE] if keep_previous else []) + [MAP_FILE]

    with monkeypatch.context() as patched:
        patched.setattr(os, call, refuse(errno.ENOSPC))
        assert not written.save()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    (folder / "map.new.tsf").write_bytes(b"by one that was killed")
    assert MapCheckpoints(folder, VOLUME, keep_previous=keep_previous).done == written.done
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_a_map_of_many_sessions_comes_back(tmp_path: Path) -> None:
    written = MapCheckpoints(tmp_path, VOLUME, keep_previous=False)
    written.done = {
        number.to_bytes(16): fuser_messages.SessionProgress(number, "robot") for number in range(1, 40_001)
    }
    assert written.save()
    assert opened(tmp_path)[0].ready().done == written.done


def test_what_it_works_at_shows_from_outside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    position, fuser, link = opened_with_one(tmp_path)

    monkeypatch.setattr(codec, "decode", raising(RuntimeError("a bug")))
    with pytest.raises(RuntimeError):
        fuser.handle(order(5, position))
    assert (tmp_path / "working").read_bytes() == struct.pack("<q", 5)
    monkeypatch.undo()
    fuser.handle(order(5, position))
    assert link.last().reason is None
    assert (tmp_path / "working").read_bytes() == b"\xff" * 8


def test_no_memory_to_share_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    working = tmp_path / "working"
    working.write_bytes(bytes(4))
    with pytest.raises(errors.MapError, match="cannot share a file with the gateway: mmap length"):
        CurrentKeyframe(str(working))
    working.write_bytes(bytes(8))
    monkeypatch.setattr(mmap, "mmap", refuse(errno.ENOMEM))
    with pytest.raises(errors.MapError, match=r"cannot share a file .*: .*Cannot allocate memory"):
        CurrentKeyframe(str(working))


@pytest.mark.parametrize("code", [errno.EIO, errno.EMFILE, errno.ENOMEM])
def test_a_record_that_cannot_be_read_now_is_left_to_another_process(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    position, fuser, link = opened_with_one(tmp_path)

    monkeypatch.setattr(os, "pread", refuse(code))
    fuser.handle(order(0, position))
    assert held(fuser, link)  # at first: the disk may be itself again
    monkeypatch.setattr("tsfusion.fuser.pose_mover._PATIENCE_S", 0.0)
    fuser.go_on()
    assert (fuser.exit_status, len(link.sent), fuser.ready().done) == (1, 1, {})
    assert (tmp_path / "working").read_bytes() == bytes(8)  # it was at this one
    monkeypatch.undo()
    again, link = opened(tmp_path)
    again.handle(order(0, position))
    assert link.done().reason is None


def test_no_memory_for_a_keyframe_is_no_crash(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    position, fuser, link = opened_with_one(tmp_path)

    monkeypatch.setattr(codec, "decode", raising(MemoryError("no room for 9 GB")))
    fuser.handle(order(0, position))
    assert link.last().reason == "memory"
    assert link.last().message == "no memory to fuse it: no room for 9 GB; raise fuser_memory_bytes"


def test_a_process_and_its_map_keep_to_their_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int] = []
    monkeypatch.setattr(process, "data_bytes", lambda: 1000)
    monkeypatch.setattr(process, "limit_memory", limits.append)
    fill(tmp_path, 1)
    fuser, _ = opened(tmp_path, memory_bytes=1 << 30)
    assert limits == [1000 + map_checkpoints._WORKING_MEMORY + (1 << 30)]
    most = fuser._volume.most_blocks
    assert opened(tmp_path, memory_bytes=1 << 29)[0]._volume.most_blocks < most


def test_a_client_may_fill_its_share_of_the_map_and_no_more(tmp_path: Path) -> None:
    positions = fill(tmp_path, 2)
    probe, link = opened(tmp_path)
    probe.handle(order(0, positions[0]))
    needed = status(probe, link).blocks
    volume = msgspec.structs.replace(VOLUME, max_blocks=2 * needed - 2)
    settings = {"quota_map": 0.5, "checkpoint_every": 1}
    fuser, link = opened(tmp_path, volume, **settings)
    before = status(fuser, link).map_hash
    for again in (fuser, opened(tmp_path, volume, **settings)[0]):  # what was taken outlives the process
        again._link = link  # type: ignore[assignment]
        again.handle(msgspec.structs.replace(order(0, positions[0]), session=os.urandom(16)))
        assert link.done().reason == "MapQuota"
        assert f"the keyframe's sender may add {needed - 1} more blocks" in link.done().message
    assert status(fuser, link).map_hash == before
    nobody = msgspec.structs.replace(order(1, positions[0]), client="", session=b"n" * 16)
    fuser.handle(nobody)
    assert link.done().reason is None  # without keys there is only the whole


def test_what_a_client_took_of_the_map_is_in_the_checkpoint(tmp_path: Path) -> None:
    positions = fill(tmp_path, 40)
    volume = msgspec.structs.replace(VOLUME, max_blocks=1 << 20)
    fuser, link = opened(tmp_path, volume, checkpoint_every=1)
    fuser.handle(order(0, positions[0]))
    blocks = status(fuser, link).blocks
    again, link = opened(tmp_path, volume, quota_map=blocks / (1 << 20))
    assert again._map.blocks == {"robot": blocks}
    again.handle(order(39, positions[39]))  # from elsewhere
    assert link.done().reason == "MapQuota"
    assert "the keyframe's sender may add 0 more blocks" in link.done().message


def test_a_keyframe_that_would_cost_too_much_time_is_rejected(tmp_path: Path) -> None:
    positions = fill(tmp_path, 1)
    fuser, link = opened(tmp_path, quota_cost=1000)
    before = status(fuser, link).map_hash
    fuser.handle(order(0, positions[0]))
    assert link.done().reason == "KeyframeTooLarge"
    assert "at most quota_cost = 1000" in link.done().message
    assert status(fuser, link).map_hash == before


def test_a_png_that_unfolds_to_more_than_its_pixels_is_rejected(tmp_path: Path) -> None:
    """A decoder would unfold 100 MB."""
    image = cv2.imencode(".png", wall().measurement)[1].tobytes()
    at = image.index(b"IDAT") - 4
    length = int.from_bytes(image[at : at + 4], "big")
    rows = zlib.decompress(image[at + 8 : at + 8 + length])
    journal, positions = Journal(tmp_path / "journal", 1 << 20), []
    for seq, surplus in ((1, 0), (2, 100_000_000)):
        body = b"IDAT" + zlib.compress(rows + bytes(surplus))
        chunk = struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
        frames = codec.encode(wall(), session=SESSION, seq=seq, jpeg_quality=90)
        frames[1] = image[:at] + chunk + image[-12:]
        header = record_header.unpack_keyframe(frames[0])
        depth = msgspec.structs.replace(
            header.buffers[0], codec="png", bytes=len(frames[1]), crc32=zlib.crc32(frames[1])
        )
        header = msgspec.structs.replace(header, buffers=(depth, *header.buffers[1:]))
        frames[0] = record_header.pack(header)
        positions.append(journal.append(frames, session=SESSION, seq=seq))
    journal.close()
    fuser, link = opened(tmp_path)
    for index, position in enumerate(positions):
        fuser.handle(order(index, position))
    reasons = [one.reason for one, _ in link.sent if isinstance(one, fuser_messages.Done)]
    assert (reasons, status(fuser, link).keyframes_rejected) == ([None, "limits"], {"limits": 1})


def test_no_mesh_is_made_while_another_keyframe_waits_at_the_gateway(tmp_path: Path) -> None:
    position, fuser, _ = opened_with_one(tmp_path)
    fuser.handle(msgspec.structs.replace(order(0, position), more=True))
    assert fuser.idle_after_ms > 0
    fuser.handle(order(1, position))
    assert fuser.idle_after_ms == 0


@pytest.mark.parametrize("min_weight", [float("nan"), float("inf"), 1e308, 1e20, -1.0])
def test_no_question_ends_the_fuser(tmp_path: Path, min_weight: float) -> None:
    position, fuser, link = opened_with_one(tmp_path)
    fuser.handle(order(0, position))
    ask(fuser, "mesh", min_weight)
    assert "min_weight must be" in link.last().error


@pytest.mark.parametrize("error", [OverflowError("too large"), ValueError("no such shape")])
def test_a_question_that_fails_in_the_arithmetic_is_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    fuser, link = opened(tmp_path)
    monkeypatch.setattr(tsfusion.Volume, "extract_mesh", raising(error))
    ask(fuser, "mesh")
    assert link.last().error == str(error)


def test_a_mesh_that_there_is_no_memory_for_is_an_answer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    position, fuser, link = opened_with_one(tmp_path)
    fuser.handle(order(0, position))
    with monkeypatch.context() as patched:
        patched.setattr(tsfusion.Volume, "extract_mesh", raising(MemoryError("no room for 9 GB")))
        ask(fuser, "mesh")
    assert link.last().error == "not enough memory for that: no room for 9 GB; raise fuser_memory_bytes"
    ask(fuser, "mesh")
    assert link.last().mesh.faces > 0


def test_a_map_opens_with_the_limits_of_now(tmp_path: Path) -> None:
    saved(tmp_path)
    for limit in (10_000, 20_000):
        fuser, link = opened(tmp_path, msgspec.structs.replace(VOLUME, max_blocks=limit))
        assert status(fuser, link).config["max_blocks"] == limit


# --- the fuser and its gateway ---


def started(code: str) -> tuple[subprocess.Popen[str], str]:
    """A process, and its first word."""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, process.stdout.readline()


def test_a_stopped_fuser_does_not_outlive_its_gateway(tmp_path: Path) -> None:
    with serving(tmp_path, fuser=SUMS) as server:
        until(lambda: fetch_health(server.address).ready)
        fuser = server.fuser_pid()
        os.kill(fuser, signal.SIGSTOP)
        server.kill()
        until(lambda: not alive(fuser))


def test_a_process_at_work_ends_with_the_one_that_started_it() -> None:
    child = "from tsfusion.core import process; import signal, time; process.on_parent_end(signal.SIGKILL); "
    child += "print(1, flush=True); time.sleep(600)"
    code = "import subprocess, sys, time; "
    code += f"p = subprocess.Popen([sys.executable, '-c', {child!r}], stdout=subprocess.PIPE); "
    code += "p.stdout.readline(); print(p.pid, flush=True); time.sleep(600)"
    parent, word = started(code)
    with parent:
        parent.kill()
        until(lambda: not alive(int(word)))


def test_a_map_has_one_fuser_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed fuser that waits for a disk may still be there when the next one begins."""
    sent: list[bytes] = []
    monkeypatch.setattr(fuser_main, "_LOCK_WAIT_S", 0.0)
    begin = fuser_messages.Begin(
        str(tmp_path), VOLUME, 1.0, 0, "", False, 1 << 30, quota_cost=1, quota_map=1.0
    )
    with folder_lock.hold(tmp_path, fuser_main.LOCK):
        assert fuser_main._open_map(cast("Any", SimpleNamespace(send=sent.append)), begin) is None
    failed = fuser_messages.to_gateway.decode(sent[0])
    assert isinstance(failed, fuser_messages.Failed)
    assert "fuser" in str(failed.error())


def test_a_system_that_refuses_while_a_map_is_opened_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent: list[bytes] = []
    monkeypatch.setattr(fuser_main, "Fuser", refuse(errno.EIO))
    begin = fuser_messages.Begin(
        str(tmp_path), VOLUME, 1.0, 0, "", False, 1 << 30, quota_cost=1, quota_map=1.0
    )
    assert fuser_main._open_map(cast("Any", SimpleNamespace(send=sent.append)), begin) is None
    failed = fuser_messages.to_gateway.decode(sent[0])
    assert isinstance(failed, fuser_messages.Failed)
    assert str(failed.error()) == "the map cannot be opened: [Errno 5] Input/output error"


@pytest.mark.parametrize(
    ("error", "kind", "raised"),
    [
        (errors.InvalidConfig("of other settings"), "config", errors.InvalidConfig),
        (errors.DamagedCheckpoint("cut short"), "checkpoint", errors.CheckpointError),
        (errors.MapFull("too many blocks"), "map", errors.MapError),
        (errors.JournalError("cannot read"), "other", errors.TsfusionError),
    ],
)
def test_the_kind_of_a_failure_reaches_the_gateway(
    error: errors.TsfusionError, kind: str, raised: type[errors.TsfusionError]
) -> None:
    sent = fuser_messages.to_gateway.decode(fuser_messages.encode(fuser_messages.Failed.of(error)))
    assert isinstance(sent, fuser_messages.Failed)
    again = sent.error()
    assert (sent.kind, type(again), str(again)) == (kind, raised, str(error))


# --- log lines of the process ---

_CODE = """
import logging, sys
from tsfusion.fuser import __main__ as process, fuser, map_checkpoints

def run(endpoint):
    for module in (fuser, map_checkpoints):
        module.log.info("a line")
        module.log.error("an error")
    assert not hasattr(process, "log")  # it would be called __main__, outside tsfusion's own loggers
    return 0

process.run = run
sys.argv = ["", "ipc://nowhere", "json", sys.argv[1], "yard"]
sys.exit(process.main())
"""


@pytest.mark.parametrize(("level", "shown"), [("info", ["a line", "an error"]), ("error", ["an error"])])
def test_a_fusers_own_lines_obey_log_level(level: str, shown: list[str]) -> None:
    done = python(_CODE, level)
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    for name in ("tsfusion.fuser.fuser", "tsfusion.fuser.map_checkpoints"):
        assert [line["message"] for line in lines if line["logger"] == name] == shown
    assert {(line["process"], line["map"]) for line in lines} == {("fuser", "yard")}
    assert len(lines) == 2 * len(shown)


# --- folders that are away ---


def held(fuser: Fuser, link: Link) -> bool:
    return isinstance(link.last(), fuser_messages.Stuck) and fuser.is_stuck


def test_a_journal_that_is_away_is_waited_for_and_the_order_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("tsfusion.fuser.pose_mover._PATIENCE_S", 0.0)
    first, second = fill(tmp_path, 2)
    fuser, link = opened(tmp_path)
    (tmp_path / "journal").rename(tmp_path / "aside")
    for number in range(3):
        fuser.handle(order(0, first)) if not number else fuser.go_on()
        assert held(fuser, link)
        assert "No such file" in link.last().message
    assert (tmp_path / "working").read_bytes() == b"\xff" * 8  # a death now is not the keyframe's fault
    fuser.handle(order(1, second))
    assert status(fuser, link).keyframes_fused == 0  # questions are answered meanwhile
    (tmp_path / "aside").rename(tmp_path / "journal")
    fuser.go_on()
    done = [message for message, _ in link.sent if isinstance(message, fuser_messages.Done)]
    assert [(one.index, one.reason) for one in done] == [(0, None), (1, None)]
    assert (fuser.is_stuck, fuser.exit_status) == (False, None)


def test_a_keyframe_whose_segment_alone_is_gone_is_rejected_after_a_while(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (position,) = fill(tmp_path, 1)
    fill(tmp_path, 1)
    (tmp_path / "journal" / "000001.mcap").unlink()
    fuser, link = opened(tmp_path)
    fuser.handle(order(0, position))
    assert held(fuser, link)
    monkeypatch.setattr("tsfusion.fuser.pose_mover._PATIENCE_S", 0.0)
    fuser.go_on()
    assert (link.last().index, link.last().reason) == (0, "JournalError")


def test_a_checkpoint_that_cannot_be_written_is_said_until_it_can(tmp_path: Path) -> None:
    folder, aside = tmp_path / "map", tmp_path / "aside"
    folder.mkdir()
    position, fuser, link = opened_with_one(folder)
    fuser.handle(order(0, position))
    folder.rename(aside)
    fuser.handle(fuser_messages.Save())
    assert not link.last().written
    assert "is not there" in link.last().problem
    folder.mkdir()  # a checkpoint in there would be hidden again
    fuser.handle(fuser_messages.Save())
    assert not link.last().written
    assert list(folder.iterdir()) == []
    folder.rmdir()
    aside.rename(folder)
    fuser.handle(fuser_messages.Save())
    assert (link.last().written, link.last().problem) == (True, "")
    again, _ = opened(folder)
    assert again.ready().done == {SESSION: fuser_messages.SessionProgress(1, "robot")}


def test_a_disk_that_refuses_a_checkpoint_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    position, fuser, link = opened_with_one(tmp_path)
    fuser.handle(order(0, position))
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", refuse(errno.ENOSPC))
        fuser.handle(fuser_messages.Save())
        assert "No space left" in link.last().problem
        fuser.handle(fuser_messages.Finish())
        assert fuser.exit_status == 1
    fuser.handle(fuser_messages.Finish())
    assert (link.last().written, link.last().problem) == (True, "")
    assert fuser.exit_status == 0


def test_a_checkpoint_is_on_the_disk_before_it_has_its_name_and_then_the_name(
    tmp_path: Path, disk_calls: list[str]
) -> None:
    written = MapCheckpoints(tmp_path, VOLUME, keep_previous=True)
    assert written.save()
    disk_calls.clear()
    assert written.save()
    assert disk_calls == [
        *("sync .map.new.tsf.partial", ".map.new.tsf.partial > map.new.tsf", f"sync {tmp_path.name}"),
        *("map.tsf > map.previous.tsf", "map.new.tsf > map.tsf", f"sync {tmp_path.name}"),
    ]


def test_parts_of_a_killed_checkpoint_are_swept_and_nothing_else(tmp_path: Path) -> None:
    for name in ("map.new.tsf", ".map.new.tsf.partial", "map.damaged", "notes.partial"):
        (tmp_path / name).write_bytes(b"half")
    MapCheckpoints(tmp_path, VOLUME, keep_previous=False)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["map.damaged", "notes.partial"]


def test_a_map_that_was_not_saved_by_a_server_is_one_clear_error(tmp_path: Path) -> None:
    tsfusion.Volume(VOLUME).save(tmp_path / MAP_FILE)
    with pytest.raises(errors.CheckpointError, match="it does not say which keyframes it holds"):
        MapCheckpoints(tmp_path, VOLUME, keep_previous=False)
    assert (tmp_path / MAP_FILE).exists()
