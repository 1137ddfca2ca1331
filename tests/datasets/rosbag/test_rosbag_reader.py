# SPDX-License-Identifier: MIT
"""Files and folders of recordings: found, read one message at a time, damaged."""

import logging
import random
import sqlite3
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframes_and_servers import pose, wall
from mcap.writer import CompressionType, Writer
from rosbag_scenes import DEPTH, FRAME_NS, T0, infos, journal_of, scan
from rosbag_writing import OPTICAL, WORLD, writing

from tsfusion.cli import replay
from tsfusion.core.errors import DatasetError, MissingDependency
from tsfusion.datasets import open_dataset
from tsfusion.datasets.rosbag.dataset import Bag, recognises
from tsfusion.journal import segment_path
from tsfusion.journal.recording import JournalRecording
from tsfusion.journal.ros2_export import export

pytest.importorskip("rosbags")


def walls(folder: Path, form: str = "mcap", count: int = 3) -> Path:
    with writing(folder, form) as (bag, path):
        scan(bag, [wall(i) for i in range(count)])
    return path


def test_a_journal_and_a_ros_recording_are_told_apart(tmp_path: Path) -> None:
    place = journal_of(tmp_path, [wall(i) for i in range(2)])
    segment = segment_path(place.path, 1)
    export(place, tmp_path / "out.mcap", lambda _done, _all: None)
    bag = walls(tmp_path)
    for journaled in (tmp_path, place.path, segment):
        assert isinstance(replay.open_recording(journaled), JournalRecording)
        assert not recognises(journaled) or journaled == tmp_path
    for recorded in (tmp_path / "out.mcap", bag, bag / "recorded.mcap"):
        assert isinstance(replay.open_recording(recorded), Bag)
    with pytest.raises(DatasetError, match=r"a ROS recording .*reads a journal of tsfusion"):
        Bag(segment)
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(segment.read_bytes()[:20])
    assert not recognises(torn)


# --- files and folders ---


def test_lone_files_and_folders_of_one_are_taken(tmp_path: Path) -> None:
    for form, name in (("sqlite3", "recorded.db3"), ("mcap", "recorded.mcap"), ("ros1", "recorded.bag")):
        path = walls(tmp_path / form, form)
        (path / "metadata.yaml").unlink() if path.is_dir() else None
        for given in (path / name if path.is_dir() else path, path, path.parent):
            assert len(open_dataset(given)) == 3, given
    (tmp_path / "two").mkdir()
    for form, name in (("ros1", "recorded.bag"), ("sqlite3", "recorded/recorded.db3")):
        (tmp_path / "two" / Path(name).name).write_bytes((tmp_path / form / name).read_bytes())
    with pytest.raises(DatasetError, match="holds 2 files"):
        Bag(tmp_path / "two")


def test_a_recording_without_definitions_is_read_by_the_usual_ones(tmp_path: Path) -> None:
    path = walls(tmp_path, "sqlite3")
    with sqlite3.connect(path / "recorded.db3") as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    assert np.array_equal(open_dataset(path)[1].measurement, wall(1).measurement)


def test_an_mcap_file_without_index_is_read_and_said_to_be_slow(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rewritten(walls(tmp_path) / "recorded.mcap", tmp_path / "plain.mcap", use_chunking=False,
              use_summary_offsets=False, use_statistics=False, repeat_channels=False, repeat_schemas=False,
              index_types=0)  # fmt: skip
    with caplog.at_level(logging.WARNING):
        found = open_dataset(tmp_path / "plain.mcap")
    assert "has no index" in caplog.text
    for i in (2, 0, 1):
        assert np.array_equal(found[i].measurement, wall(i).measurement)


def rewritten(
    path: Path, out: Path, *, profile: str = "ros2", encoding: str = "ros2msg", **form: Any
) -> None:
    """Another MCAP file with the same messages."""
    from mcap.reader import make_reader
    from mcap.writer import IndexType

    if "index_types" in form:
        form["index_types"] = IndexType(form["index_types"])
    with path.open("rb") as file, out.open("wb") as copy:
        writer = Writer(copy, compression=CompressionType.NONE, **form)
        writer.start(profile=profile, library="test")
        channels: dict[int, int] = {}
        for schema, channel, message in make_reader(file).iter_messages():
            if channel.id not in channels:
                kind = writer.register_schema(schema.name, encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", kind)
            writer.add_message(channels[channel.id], message.log_time, message.data, message.publish_time)
        writer.finish()


def test_frames_are_read_one_at_a_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = rng.integers(1, 5000, (60, 240, 320), dtype=np.uint16)  # 9 MB that do not shrink
    with writing(tmp_path, "mcap") as (bag, path):
        infos(bag, shape=images.shape[1:])
        for i, image in enumerate(images):
            bag.transform(pose(i), WORLD, OPTICAL, T0 + i * FRAME_NS)
            bag.image(DEPTH, image, "16UC1", T0 + i * FRAME_NS)
    found = open_dataset(path)
    found[0]
    tracemalloc.start()
    try:
        for i in rng.permutation(60):
            assert np.array_equal(found[int(i)].measurement, images[i])
        assert tracemalloc.get_traced_memory()[1] < 6e6
    finally:
        tracemalloc.stop()


# --- when it cannot be read ---


@pytest.mark.parametrize("form", ["ros1", "ros1-lz4", "sqlite3", "mcap"])
def test_damage_is_one_clear_error_or_no_matter(tmp_path: Path, form: str) -> None:
    path = walls(tmp_path, form)
    file = next(path.glob("recorded.*")) if path.is_dir() else path
    whole, rng = file.read_bytes(), random.Random(form)
    errors = []
    for case in range(60):
        content = bytearray(whole[: rng.randrange(1, len(whole))] if case % 2 else whole)
        if not case % 2:
            for _ in range(rng.choice([1, 30])):
                content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
        file.write_bytes(content)
        try:
            found = Bag(path)
            for i in range(len(found)):
                found[i]
            errors.append("")
        except DatasetError as error:
            errors.append(str(error))
    assert any(errors)
    assert not any("\n" in error for error in errors)


def test_empty_and_foreign_files_are_named(tmp_path: Path) -> None:
    bag = walls(tmp_path) / "recorded.mcap"
    rewritten(bag, tmp_path / "ros1.mcap", profile="ros1")
    rewritten(bag, tmp_path / "proto.mcap", encoding="protobuf")
    (tmp_path / "empty.mcap").write_bytes(b"")
    (tmp_path / "cut.mcap").write_bytes(bag.read_bytes()[:-100])
    with writing(tmp_path, "ros1") as (_, nothing):
        pass
    for path, message in (
        (tmp_path / "ros1.mcap", "only MCAP files of the profile ros2"),
        (tmp_path / "proto.mcap", "protobuf"),
        (tmp_path / "empty.mcap", "does not begin as a ROS recording"),
        (tmp_path / "cut.mcap", "mcap recover"),
        (nothing, "it holds no messages"),
        (tmp_path / "missing.bag", "does not exist"),
    ):
        with pytest.raises(DatasetError, match=message):
            Bag(path)


def test_without_rosbags_the_error_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = walls(tmp_path)
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(MissingDependency, match=r"pip install 'tsfusion\[ros\]'"):
        open_dataset(path)
