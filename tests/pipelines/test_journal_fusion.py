# SPDX-License-Identifier: MIT
"""Maps made of a journal: all, up to a time, of one scanner, elsewhere, and in the colours of clients."""

import datetime
import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from command_processes import Here
from corrected_maps import fresh_map
from keyframes_and_servers import VOLUME, map_hash, pose, wall

from tsfusion import Keyframe, Volume, VolumeConfig
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import InvalidConfig, JournalError
from tsfusion.journal import Journal, journaled_keyframes
from tsfusion.pipelines.maps import journal_fusion
from tsfusion.wire.records import codec, corrections

LEFT, RIGHT = b"\xab" * 16, b"\xac" + b"\xab" * 15
START_NS = 1_700_000_000 * 10**9


def stamp(second: int) -> str:
    return datetime.datetime.fromtimestamp(START_NS / 1e9 + second, datetime.timezone.utc).isoformat()


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A map's folder. Seconds 0 to 3: four keyframes of two clients by turns; 4: the first corrects its own.

    5 and 6: one more of each; 7: the second takes one of its own away.
    """
    clock = iter(range(START_NS, START_NS + 10**11, 10**9))
    seqs = {LEFT: 0, RIGHT: 0}
    writer = Journal(tmp_path / "map/journal", 1 << 16)

    def append(session: bytes, encode: Any) -> None:
        seqs[session] = seq = seqs[session] + 1
        client = "left" if session == LEFT else ""
        frames = encode(session=session, seq=seq)
        writer.append(frames, session=session, seq=seq, client=client, logged_ns=next(clock))

    def send(session: bytes, keyframe: Keyframe) -> None:
        append(session, partial(codec.encode, keyframe, jpeg_quality=90))

    def correct(session: bytes, *args: Any, **fields: Any) -> None:
        append(session, partial(corrections.encode, corrections.checked(*args, **fields)))

    for i in range(4):
        send((LEFT, RIGHT)[i % 2], wall(i))
    correct(LEFT, {1: pose(0.5)}, T_map_odometry=pose(0, 0.2))
    send(LEFT, wall(4))
    send(RIGHT, wall(5))
    correct(RIGHT, {}, removed=[1])
    writer.close()
    return tmp_path / "map"


def moved(i: int, T: np.ndarray) -> Keyframe:
    return wall(i, T_world_camera=T @ wall(i).T_world_camera)


def hash_of(state: Path, **chosen: Any) -> str:
    return journal_fusion.map_of(state, VOLUME, **chosen).volume.map_hash()


def test_the_whole_journal_is_the_settled_map(state: Path) -> None:
    found = journal_fusion.map_of(state, VOLUME)
    assert found.volume.keyframes == 5
    assert found.volume.map_hash() == fresh_map(state / "journal", VOLUME.voxel_size).map_hash()
    assert found.volume.color_hash() == fresh_map(state / "journal", VOLUME.voxel_size).color_hash()
    assert (found.left_out, found.missing, found.legend) == ({}, 0, [])


def test_until_a_time_with_the_corrections_of_then(state: Path) -> None:
    first = [wall(i) for i in range(4)]
    assert hash_of(state, until=stamp(3)) == map_hash(first)
    assert hash_of(state, until="4") == map_hash(first)
    corrected = [wall(0, T_world_camera=pose(0.5)), *first[1:]]
    assert hash_of(state, until=stamp(4)) == map_hash(corrected)
    assert hash_of(state, until="1") == map_hash([*corrected, moved(4, pose(0, 0.2)), wall(5)])
    assert hash_of(state, until="0") == hash_of(state)


def test_only_one_scanner_at_final_poses(state: Path) -> None:
    left = [wall(0, T_world_camera=pose(0.5)), wall(2), moved(4, pose(0, 0.2))]
    assert hash_of(state, only=["left"]) == map_hash(left)
    assert hash_of(state, only=["ACAB"]) == map_hash([wall(3), wall(5)])
    assert hash_of(state, only=["left", RIGHT.hex()]) == hash_of(state)
    assert hash_of(state, only=["left"], until=stamp(2)) == map_hash([wall(0), wall(2)])


def test_wrong_values_list_what_there_is(state: Path) -> None:
    with pytest.raises(JournalError, match=r"is named 'right'; the journal has abababab \(left\), acababab"):
        hash_of(state, only=["right"])
    with pytest.raises(JournalError, match="several sessions begin with 'abab'"):
        journaled_keyframes.sessions_named("abab", {LEFT: "", LEFT[:-1] + b"\0": ""})
    with pytest.raises(JournalError, match=r"records from 2023-11-14 22:13:20Z to 2023-11-14 22:13:27Z"):
        hash_of(state, until="2001-01-01")
    for text in ("yesterday", "nan", ""):
        with pytest.raises(
            InvalidConfig, match=r"such as 90, or ISO such as 2023-11-14 22:13:27Z \(the time of"
        ):
            hash_of(state, until=text)


def test_keyframes_that_a_map_cannot_take_are_counted(state: Path) -> None:
    small = VolumeConfig(voxel_size=0.04, threads=1, max_blocks_per_keyframe=1)
    found = journal_fusion.map_of(state, small)
    assert (found.volume.keyframes, sum(found.left_out.values())) == (0, 5)


def test_the_command_takes_the_settings_of_the_saved_map(state: Path, here: Here) -> None:
    Volume(VOLUME).save(state / "map.tsf", meta={"done": {}})
    done = here("mesh", state, "then.ply", "--until", stamp(3), "--only", "left", "--json")
    assert done.returncode == 0, done.stderr
    volume = Volume(VOLUME)
    for i in (0, 2):
        volume.integrate(wall(i))
    assert json.loads(done.stdout)["vertices"] == len(volume.extract_mesh().vertices)
    refused = here("mesh", state / "map.tsf", "a.ply", "--until", "1")
    assert "--until has no effect on a saved map: give the state folder" in refused.stderr
    refused = here("mesh", "tcp://127.0.0.1:10", "a.ply", "--color-by", "client")
    assert "--color-by needs a journal" in refused.stderr


def test_other_settings_keep_the_corrections(state: Path, here: Here) -> None:
    """Without: map flags fused the keyframes where they were sent."""
    done = here("mesh", state, "a.ply", "--voxel-size", VOLUME.voxel_size, "--json")
    volume = fresh_map(state / "journal", VOLUME.voxel_size)
    assert json.loads(done.stdout)["vertices"] == len(volume.extract_mesh().vertices)


def test_what_a_cut_journal_lacks_is_told(state: Path, here: Here) -> None:
    volume = Volume(VOLUME)
    for i in range(9):
        volume.integrate(wall(i))
    volume.save(state / "map.tsf", meta={"done": {}})
    for moment in ("0", stamp(2)):
        assert journal_fusion.map_of(state, VOLUME, until=moment).missing == 3  # of 9 the journal has 6
    done = here("mesh", state, "then.ply", "--until", "0")
    assert "warning: the journal lacks 3 keyframes of the saved map: not in this mesh" in done.stderr
    done = here("mesh", state, "then.ply", "--voxel-size", "0.05")
    assert "cannot be fused anew: of its 9 keyframes the journal has 6" in done.stderr


def test_what_was_forgotten_stays_away(state: Path, here: Here) -> None:
    writer = Journal(state / "journal", 1 << 16)
    session = SERVER_SESSION
    frames = corrections.encode(corrections.forgetting(LEFT, np.array([1, 2])), session=session, seq=1)
    writer.append(frames, session=session, seq=1, logged_ns=START_NS + 10**10)
    writer.close()
    left = [moved(4, pose(0, 0.2))]
    assert hash_of(state, only=["left"]) == map_hash(left)
    assert hash_of(state, until=stamp(3)) == map_hash([wall(1), wall(3)])  # nor does it come back
    assert hash_of(state, until="4") == hash_of(state, until=stamp(3)), "4 s before a scanner's last record"
    Volume(VOLUME).save(state / "map.tsf", meta={"done": {}, "poses": {"removed": 6}})
    done = here("mesh", state, "a.ply", "--voxel-size", VOLUME.voxel_size)
    assert done.returncode == 0, done.stderr  # the keyframes that are gone are accounted for


def test_colors_by_client(state: Path, here: Here) -> None:
    done = here("mesh", state, "who.ply", "--voxel-size", VOLUME.voxel_size, "--color-by", "client", "--json")
    assert done.returncode == 0, done.stderr
    shown = json.loads(done.stdout)
    assert shown["legend"] == [
        {"name": "left", "color": "#0072b2", "keyframes": 3},
        {"name": "acababab", "color": "#e69f00", "keyframes": 2},
    ]
    seen = trimesh.load("who.ply", process=False).visual.vertex_colors[:, :3]
    pure = {tuple(color) for color in np.unique(seen, axis=0).tolist()}
    assert (0x00, 0x72, 0xB2) in pure
    assert hash_of(state, color_by="session") == hash_of(state)  # a view: the sums are the map's
    done = here("mesh", state, "who.ply", "--voxel-size", VOLUME.voxel_size, "--color-by", "session")
    assert "  #0072b2  abababab, 3 keyframes\n  #e69f00  acababab, 2 keyframes" in done.stdout


def test_points_are_painted_too() -> None:
    points = np.zeros((3, 3), np.float32)
    keyframe = Keyframe(points=points, T_world_camera=pose())
    painted = journal_fusion.Painter("client")(
        journal_fusion.FinalKeyframe(keyframe, journal_fusion.JournaledSession(LEFT, "", 0))
    )
    assert painted.color is not None
    assert painted.color.tolist() == [[0xB2, 0x72, 0x00]] * 3
