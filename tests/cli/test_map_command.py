# SPDX-License-Identifier: MIT
"""`tsfusion map`: what it says of saved maps, what it makes of them, and what it refuses."""

import json
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
import vdb_reader
from command_processes import Here
from corrected_maps import fresh_map
from formula_scenes import volume_of
from keyframes_and_servers import DEADLINE, pose, serving, wall
from saved_maps import ANNA, BOB, correct, decoded, forget, make_map
from small_recordings import first_views

from tsfusion import Client, Intrinsics, Keyframe, Volume, journal
from tsfusion.gateway.maps import moved_maps
from tsfusion.journal import segment_path, state_folder
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.files.checkpoint import CheckpointHeader


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state folder with the maps `yard`, of two sessions, and `house`, whose checkpoint is behind."""
    folder = tmp_path_factory.mktemp("state")
    yard = state_folder.map_folder(folder, "yard")
    make_map(yard, range(3), session=ANNA, client="anna")
    make_map(yard, range(3, 5), session=BOB, world="b" * 32)
    make_map(state_folder.map_folder(folder, "house"), range(10, 14), behind=1)
    return folder


def file_of(state: Path, name: str) -> Path:
    return state_folder.map_folder(state, name) / state_folder.MAP_FILE


def test_info_says_what_a_map_holds(here: Here, state: Path) -> None:
    volume = Volume.load(file_of(state, "yard"))
    found = json.loads(here("map", "info", state, "--map", "yard", "--json").stdout)
    assert (found["map_hash"], found["keyframes"]) == (volume.map_hash(), 5)
    blocks = volume.stats().blocks
    assert (found["blocks"], found["voxel_bytes"]) == (blocks, blocks * 512 * 20)
    assert [(one["client"], one["world"], one["listed"]) for one in found["sessions"]] == [
        ("anna", "", 3), ("", "b" * 32, 2),
    ]  # fmt: skip
    assert (found["keyframes_after"], found["corrections_after"], found["keyframes_lost"]) == (0, 0, 0)
    assert found["settings"]["voxel_size"] == 0.04
    vertices = volume.extract_mesh().vertices
    assert (vertices >= found["box"][:3]).all()
    assert (vertices <= found["box"][3:]).all()
    alone = json.loads(here("map", "info", file_of(state, "yard"), "--json").stdout)
    behind = dict.fromkeys(("keyframes_after", "corrections_after", "keyframes_lost"))
    assert {**found, **behind} == alone
    text = here("map", "info", state_folder.map_folder(state, "yard")).stdout
    assert "voxel_size 0.04, threads 1" in text
    assert "anna" in text
    assert "world bbbbbbbb" in text


def test_hash_is_a_line_and_has_all_that_the_journal_holds(here: Here, state: Path) -> None:
    whole = here("map", "hash", file_of(state, "yard"))
    assert (whole.stdout, whole.stderr) == (Volume.load(file_of(state, "yard")).map_hash() + "\n", "")
    before = {path: path.read_bytes() for path in state.rglob("*") if path.is_file()}
    info = json.loads(here("map", "info", state, "--map", "house", "--json").stdout)
    assert (info["keyframes"], info["keyframes_after"]) == (3, 1)
    behind = json.loads(here("map", "hash", state, "--map", "house", "--json").stdout)
    fused = volume_of((decoded(wall(i)) for i in range(10, 14)), voxel_size=0.04).map_hash()
    assert (behind["map_hash"], behind["keyframes"]) == (fused, 4)
    assert {path: path.read_bytes() for path in state.rglob("*") if path.is_file()} == before


def test_info_counts_what_a_checkpoint_lacks(here: Here, tmp_path: Path) -> None:
    make_map(tmp_path / "maps/default", range(4), behind=2)
    assert "is without 2 keyframes of the journal;" in here("map", "info", tmp_path).stdout


def test_another_maps_checkpoint_is_refused(here: Here, tmp_path: Path) -> None:
    ours, theirs = (
        make_map(tmp_path / name / "maps" / "default", range(2), session=session)
        for name, session in (("ours", ANNA), ("theirs", BOB))
    )
    (ours / "map.tsf").write_bytes((theirs / "map.tsf").read_bytes())
    for verb in ("hash", "info"):
        done = here("map", verb, tmp_path / "ours")
        assert (done.returncode, done.stdout) == (1, "")
        assert "is the checkpoint of another map than that of the journal beside it" in done.stderr
        assert "a server that starts there sets it aside and builds the map from the journal" in done.stderr
    assert here("map", "hash", theirs).returncode == 0


def test_what_damage_has_cost_is_the_last_line_and_status_1(here: Here, tmp_path: Path) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(4), behind=2)
    path = segment_path(folder / "journal", 1)
    last = list(journal.records(path))[-1]
    content = bytearray(path.read_bytes())
    content[last.position.offset + 700] ^= 16
    path.write_bytes(content)
    left = volume_of((decoded(wall(i)) for i in range(3)), voxel_size=0.04).map_hash()
    other = make_map(tmp_path / "other" / "maps" / "default", range(10, 12), session=BOB)
    state, sum_, crop = tmp_path / "state", tmp_path / "sum.tsf", tmp_path / "crop.tsf"
    info, hashed, merged, cropped, asked = (
        here("map", "info", state, "--json"), here("map", "hash", state),
        here("map", "merge", state, other, "--out", sum_, "--same-frame"),
        here("map", "crop", state, "--box", -1, -1, -1, 1, 1, 3, "--out", crop),
        here("ask", state, "--at", 0, 0, 1),
    )  # fmt: skip
    for done in (info, hashed, merged, cropped, asked):
        assert done.returncode == 1
        assert "the map lacks 1 keyframe or more" in done.stderr.splitlines()[-1]
    assert hashed.stdout == left + "\n"
    assert json.loads(info.stdout)["keyframes_lost"] == 1
    assert (Volume.load(sum_).keyframes, Volume.load(crop).keyframes) == (5, 3)
    refused = here("map", "crop", state, "--box", 1, 1, 1, 0, 0, 0, "--out", "none.tsf")
    assert "damage" not in refused.stderr.splitlines()[-1], "what failed comes first"


@pytest.mark.parametrize("verb", ["merge", "crop", "convert", "align"])
def test_what_is_there_already_stays(here: Here, state: Path, tmp_path: Path, verb: str) -> None:
    one, other = file_of(state, "yard"), make_map(tmp_path / "c", range(20, 22), session=b"c" * 16)
    given = {
        "merge": ("map", "merge", one, other, "--out"), "align": ("map", "align", one, one, "--out"),
        "crop": ("map", "crop", one, "--box", -9, -9, -9, 9, 9, 9, "--out"),
        "convert": ("map", "convert", one),
    }[verb]  # fmt: skip
    out = tmp_path / "out.tsf"
    for content, said in (
        (b"another thing", "a file is there that is no .tsf"),
        (b"TSFMAP1\n", "--overwrite"),
    ):
        out.write_bytes(content)
        done = here(*given, out)
        assert (done.returncode, done.stderr.count("\n")) == (1, 1)
        assert said in done.stderr
        assert out.read_bytes() == content
    if verb != "align":  # which needs Open3D
        assert here(*given, out, "--overwrite").returncode == 0
        assert Volume.load(out).keyframes == (7 if verb == "merge" else 5)


@pytest.mark.parametrize("name", ["precious.ply", "precious.glb", "precious.npz", "precious.vdb"])
def test_a_file_of_another_kind_than_its_name_stays(here: Here, state: Path, name: str) -> None:
    Path(name).write_text("the only copy of something else")
    done = here("map", "convert", file_of(state, "yard"), name)
    assert (done.returncode, Path(name).read_text()[:8]) == (1, "the only")
    Path(name).unlink()
    for _ in range(2):  # what it made itself it makes again
        assert here("map", "convert", file_of(state, "yard"), name).returncode == 0


def test_a_folder_that_is_no_zarr_stays(here: Here, state: Path) -> None:
    Path("notes.zarr").mkdir()
    Path("notes.zarr", "mine.txt").write_text("mine")
    assert here("map", "convert", file_of(state, "yard"), "notes.zarr").returncode == 1
    assert Path("notes.zarr", "mine.txt").read_text() == "mine"


@pytest.mark.parametrize("name", ["map_hash", "keyframes", "blocks", "layers", "done", "rejected", "held"])
def test_what_a_header_tells_is_checked(here: Here, state: Path, tmp_path: Path, name: str) -> None:
    def change(header: CheckpointHeader) -> None:
        wrong = {
            "map_hash": "f" * 32, "keyframes": -1, "blocks": header.blocks - 1, "layers": ["color_b"],
            "done": {"x": 7}, "rejected": [1], "held": [1.0, 2.0],
        }[name]  # fmt: skip
        if name in ("done", "rejected", "held"):
            header.meta[name] = wrong
        else:
            setattr(header, name, wrong)

    path = checkpoint.copy(file_of(state, "yard"), tmp_path / "forged.tsf", change)
    for verb in ("hash", "info"):
        done = here("map", verb, path)
        assert (done.returncode, done.stdout, done.stderr.count("\n")) == (1, "", 1)
        assert str(path) in done.stderr


def test_a_checkpoint_that_is_older_than_its_journal_is_told(here: Here, tmp_path: Path) -> None:
    """As in a backup: the checkpoint was copied, then segments were deleted that newer ones have."""
    folder = make_map(tmp_path / "state" / "maps" / "default", range(4))
    older = (folder / "map.tsf").read_bytes()
    make_map(folder, range(4, 8))
    make_map(folder, range(8, 12))
    for number in (1, 2):
        segment_path(folder / "journal", number).unlink()
    assert here("map", "info", tmp_path / "state").returncode == 0, "the newest checkpoint has all of them"
    (folder / "map.tsf").write_bytes(older)
    for verb in ("info", "hash"):
        done = here("map", verb, tmp_path / "state")
        assert (done.returncode, "the map lacks 1 keyframe or more" in done.stderr) == (1, True)
    fused = here("fuse", tmp_path / "state", "--workers", 1, "--out", "fused")
    assert (fused.returncode, "no longer has 4 keyframes of the map" in fused.stderr) == (1, True)


def test_hash_moves_what_was_corrected(here: Here, tmp_path: Path) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(4), behind=2)
    correct(folder, ANNA, 5, {1: pose(0.5), 4: pose(0.7)}, removed=(2,))
    found = here("map", "hash", tmp_path / "state")
    assert found.stdout == fresh_map(folder / "journal", 0.04).map_hash() + "\n"


def test_hash_is_without_what_was_forgotten(here: Here, tmp_path: Path) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(5), behind=2)
    forget(folder, ANNA, (2, 4), 1)
    found = json.loads(here("map", "hash", tmp_path / "state", "--json").stdout)
    assert (found["map_hash"], found["keyframes"]) == (hash_of([0, 2, 4]), 3)
    here("map", "convert", tmp_path / "state", "all.tsf")
    assert here("map", "resume", "all.tsf", "--state", "own").returncode == 0
    assert here("map", "hash", "own").stdout.strip() == hash_of([0, 2, 4])
    listed, *_ = Volume.load("own/maps/default/map.tsf").meta["poses"]["sessions"].values()
    assert listed["forgotten"]


FAR = 50


def hash_of(keyframes: Iterable[int]) -> str:
    return volume_of((decoded(wall(i)) for i in keyframes), voxel_size=0.04).map_hash()


def test_merge_is_the_map_of_all(here: Here, state: Path, tmp_path: Path) -> None:
    third = make_map(tmp_path / "third", range(20, 22), session=b"c" * 16, world="b" * 32)
    done = here("map", "merge", state_folder.map_folder(state, "yard"), third, "--out", "all.tsf", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    found = json.loads(done.stdout)
    assert (found["map_hash"], found["keyframes"]) == (hash_of([*range(5), 20, 21]), 7)
    assert here("map", "hash", "all.tsf").stdout.strip() == found["map_hash"]
    sessions = json.loads(here("map", "info", "all.tsf", "--json").stdout)["sessions"]
    assert [(one["last"], one["listed"], one["unlisted_up_to"]) for one in sessions] == [
        (3, 0, 3), (2, 0, 2), (2, 0, 2),
    ]  # fmt: skip


def test_maps_whose_servers_forgot_something_are_merged_by_the_same_rules(here: Here, tmp_path: Path) -> None:
    folders = [
        make_map(tmp_path / world, range(start, start + 3), session=session, world=world)
        for world, start, session in (("one", 0, ANNA), ("two", 3, BOB))
    ]
    for folder, session in zip(folders, (ANNA, BOB), strict=True):
        forget(folder, session, [2], 1)
    refused = here("map", "merge", *folders, "--out", "all.tsf")
    assert "in a coordinate frame of its own" in refused.stderr
    for path, name in ((folders[0], "one.tsf"), (folders[1], "two.tsf")):
        assert here("map", "crop", path, "--box", *[-FAR] * 3, *[FAR] * 3, "--out", name).returncode == 0
        assert len(json.loads(here("map", "info", name, "--json").stdout)["sessions"]) == 1
    done = here("map", "merge", "one.tsf", "two.tsf", "--same-frame", "--out", "all.tsf")
    assert f"hash {hash_of([0, 2, 3, 5])}" in done.stdout, done.stderr


def test_merge_refuses_what_would_count_twice_or_lie_elsewhere(
    here: Here, state: Path, tmp_path: Path
) -> None:
    yard = file_of(state, "yard")
    for maps, words in (
        ((yard, yard), "both maps hold 3 keyframes of session 61616161 of anna"),
        ((yard,), "two maps or more"),
        ((yard, make_map(tmp_path / "c", [30], session=b"c" * 16, world="elsewhere")), "of its own"),
    ):
        done = here("map", "merge", *maps, "--out", "all.tsf")
        assert (done.returncode, done.stdout) == (1, "")
        assert words in done.stderr
        assert not Path("all.tsf").exists()
    again = make_map(tmp_path / "d", [0, 40], session=b"d" * 16)
    done = here("map", "merge", yard, again, tmp_path / "c", "--same-frame", "--out", "all.tsf")
    assert done.returncode == 0
    assert "1 keyframe has a pose of the other maps" in done.stderr
    assert f"hash {hash_of([*range(5), 0, 40, 30])}" in done.stdout


def test_a_file_with_waiting_corrections_says_that_they_stay(here: Here, tmp_path: Path) -> None:
    volume = Volume.load(make_map(tmp_path / "a", range(3)) / state_folder.MAP_FILE)
    volume.meta["poses"]["waiting"] = [(ANNA.hex(), 2, pose(0.5)[:3].tobytes())]
    volume.save("waiting.tsf")
    assert "without 1 corrected pose; only the state folder" in here("map", "info", "waiting.tsf").stdout
    done = here("map", "crop", "waiting.tsf", "--box", *[-FAR] * 3, *[FAR] * 3, "--out", "all.tsf")
    assert "1 keyframe stays where fused, though corrected" in done.stderr
    (one,) = Volume.load("all.tsf").meta["poses"]["sessions"].values()
    assert one["missed"] == [2]


def room(sides: tuple[float, float], numbers: Iterable[int], offset: float = 0.0) -> Volume:
    """Map of an empty room of vertical walls around the origin, seen by a camera in its middle."""
    u, v = np.meshgrid((np.arange(80) - 39.5) / 40, (np.arange(60) - 29.5) / 40)
    volume = Volume(0.05, sensor="tof")
    for number in numbers:
        turn = np.radians(15 * number)
        T = np.eye(4)
        T[:3, :3] = np.stack(
            [(np.sin(turn), -np.cos(turn), 0), (0, 0, -1), (np.cos(turn), np.sin(turn), 0)], 1
        )
        rays = np.stack([u, v, np.ones_like(u)], -1) @ T[:3, :3].T
        with np.errstate(divide="ignore"):
            walls = [np.abs(side / rays[..., axis]) for axis, side in enumerate(sides)]
            depth = np.minimum.reduce([*walls, np.abs(1.2 / rays[..., 2])])
        T[0, 3] = offset
        camera = Intrinsics(40.0, 40.0, 39.5, 29.5)
        volume.integrate(Keyframe(depth=depth.astype(np.float32), intrinsics=camera, T_world_camera=T))
    return volume


def test_merge_asks_whether_maps_of_given_poses_are_in_one_frame(here: Here) -> None:
    """Floors and ceilings agree in any two places."""
    maps = {
        "a": room((2.0, 1.6), range(16)), "b": room((2.0, 1.6), range(8, 24)),
        "hall": room((1.2, 3.0), range(24)), "far": room((2.0, 1.6), range(24), offset=30.0),
    }  # fmt: skip
    for name, volume in maps.items():
        volume.save(f"{name}.tsf")
    done = here("map", "merge", "a.tsf", "b.tsf", "--out", "ab.tsf")
    assert (done.returncode, done.stderr) == (0, "")
    for other, why in (("hall", "contradict each other"), ("far", "share too little to show")):
        done = here("map", "merge", "a.tsf", f"{other}.tsf", "--out", "no.tsf")
        assert (done.returncode, done.stderr.count("\n"), Path("no.tsf").exists()) == (1, 1, False)
        assert why in done.stderr
        assert "--same-frame" in done.stderr
        assert (
            here(
                "map", "merge", "a.tsf", f"{other}.tsf", "--out", f"{other}-too.tsf", "--same-frame"
            ).returncode
            == 0
        )


def test_crop_and_merge_back(here: Here, state: Path) -> None:
    house = state_folder.map_folder(state, "house")
    for name, low, high in (("left.tsf", -FAR, 0.4), ("right.tsf", 0.4, FAR)):
        done = here("map", "crop", house, "--box", low, -FAR, -FAR, high, FAR, FAR, "--out", name)
        assert done.returncode == 0
    assert Volume.load("left.tsf").map_hash() != hash_of(range(10, 14))
    merged = here("map", "merge", "left.tsf", "right.tsf", "--out", "all.tsf", "--json")
    found = json.loads(merged.stdout)
    assert (found["map_hash"], found["keyframes"]) == (hash_of(range(10, 14)), 4)
    here("map", "crop", house, "--box", 0.3, -FAR, -FAR, FAR, FAR, FAR, "--out", "overlaps.tsf")
    for parts in (("left.tsf", "overlaps.tsf"), ("all.tsf", "right.tsf")):
        refused = here("map", "merge", *parts, "--out", "twice.tsf")
        assert "some could count twice" in refused.stderr
    empty = here("map", "crop", "left.tsf", "--box", 8, 8, 8, 9, 9, 9, "--out", "none.tsf")
    assert (empty.returncode, Path("none.tsf").exists()) == (1, False)
    assert "nothing of the map lies in this box" in empty.stderr
    right = Volume.load("right.tsf")
    right.meta = {}  # as of a map that no server saved
    right.save("plain.tsf")
    twice = here("map", "merge", "plain.tsf", "plain.tsf", "--out", "twice.tsf")
    assert (twice.returncode, Path("twice.tsf").exists()) == (1, False)
    assert "the two maps are the same one" in twice.stderr
    assert "x0 y0 z0" in here("map", "crop", house, "--box", 1, 0, 0, 0, 1, 1, "--out", "no.tsf").stderr


@pytest.mark.skipif(sys.platform != "linux", reason="blocks wait in files there alone")
def test_maps_that_are_large_for_the_machine_wait_in_files(
    here: Here, state: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    third = make_map(tmp_path / "third", range(20, 22), session=b"c" * 16)
    monkeypatch.setattr("tsfusion.core.process.physical_memory_bytes", lambda: 1 << 20)
    monkeypatch.setenv("TMPDIR", "/var/tmp")
    done = here("map", "merge", file_of(state, "yard"), third, "--out", "all.tsf")
    assert f"hash {hash_of([*range(5), 20, 21])}" in done.stdout, done.stderr


def test_diff_counts_and_paints(here: Here, state: Path) -> None:
    yard, house = file_of(state, "yard"), state_folder.map_folder(state, "house")
    same = here("map", "diff", yard, yard)
    assert (same.returncode, "the maps are the same" in same.stdout) == (0, True)
    found = json.loads(here("map", "diff", yard, house, "--out", "changes.ply", "--json").stdout)
    assert found["area_m2"]["new"] > 0.1
    assert found["voxels"]["only_later"] > 100
    assert not found["same"]
    assert len(trimesh.load("changes.ply", process=False).faces) > 100
    text = here("map", "diff", yard, house, "--tolerance", 0.5).stdout
    assert "not seen again" in text
    assert here("map", "diff", yard, house, "--out", "changes.txt").returncode == 1


def test_convert_writes_voxels_meshes_and_maps(here: Here, state: Path) -> None:
    yard, volume = file_of(state, "yard"), Volume.load(file_of(state, "yard"))
    for name in ("voxels.npz", "mesh.ply", "map.tsf"):
        done = json.loads(here("map", "convert", state, name, "--map", "yard", "--json").stdout)
        assert (done["path"], done["map_hash"]) == (name, volume.map_hash())
    assert Volume.load("map.tsf").map_hash() == volume.map_hash()
    assert len(trimesh.load("mesh.ply", process=False).faces) == len(volume.extract_mesh().faces)
    assert np.load("voxels.npz")["blocks"].shape == (volume.stats().blocks, 3)
    assert here("map", "convert", yard, "dense.npz", "--dense").returncode == 0
    assert np.load("dense.npz")["tsdf"].ndim == 3
    assert "--dense has no effect" in here("map", "convert", yard, "mesh.glb", "--dense").stderr
    assert here("map", "convert", state_folder.map_folder(state, "house"), "house.tsf").returncode == 0
    assert Volume.load("house.tsf").map_hash() == hash_of(range(10, 14))


def test_convert_writes_slices_and_fields(here: Here, state: Path) -> None:
    yard, volume = file_of(state, "yard"), Volume.load(file_of(state, "yard"))
    how = ("--heights", 0.5, 1.2, "--up", "z")
    done = here("map", "convert", yard, "room.yaml", *how, "--json")
    assert json.loads(done.stdout)["files"] == ["room.yaml", "room.pgm"]
    assert "near surfaces alone" not in done.stderr
    expected = volume.occupancy_slice(0.5, 1.2, up="z")
    assert Path("room.pgm").read_bytes().endswith(expected.pixels().tobytes())
    assert here("map", "convert", yard, "room.npz", *how, "--field", "distance").returncode == 0
    assert (np.load("room.npz")["distance"] == volume.distance_slice(0.5, 1.2, up="z").distance).all()
    for name in ("field.npz", "field.vdb"):
        done = here("map", "convert", yard, name, "--field", "distance", "--max-distance", 0.2)
        assert (done.returncode, done.stderr) == (0, "")
    assert float(np.load("field.npz")["max_distance"]) == 0.2
    grid = vdb_reader.read(Path("field.vdb"))
    assert len(grid.leaves) == len(np.load("field.npz")["blocks"])
    for flags, message in (
        (("a.vdb", "--up", "z"), "--up goes with --heights"),
        (("a.vdb", "--above-floor"), "--above-floor goes with --heights"),
        (("a.ply", "--field", "distance"), "--field has no effect"),
        (("a.pgm", *how, "--field", "distance"), "write distances to"),
        (("a.npz", "--max-distance", 1), "--max-distance goes with"),
        (("a.vdb", *how), "expected a name ending in .pgm"),
        (("a.png", *how[:3], "--up", "w"), "up must be"),
    ):
        refused = here("map", "convert", yard, *flags)
        assert (refused.returncode, message in refused.stderr) == (1, True), refused.stderr
    assert not list(Path().glob("a.*"))


def test_a_resumed_map_takes_keyframes(here: Here, state: Path, tmp_path: Path) -> None:
    done = here("map", "resume", file_of(state, "yard"), "--state", "own", "--map", "yard")
    assert done.returncode == 0
    assert "tsfusion serve --state own --voxel-size 0.04\n" in done.stdout
    moved_maps.write_departed("own", "shed", moved_maps.Departed("1", "", "tcp://there:5", "tcp://there:6"))
    moved = here("map", "resume", file_of(state, "yard"), "--state", "own", "--map", "shed")
    assert (moved.returncode, "has moved to tcp://there:5: choose another name" in moved.stderr) == (1, True)
    again = here("map", "resume", file_of(state, "yard"), "--state", "own", "--map", "yard")
    assert (again.returncode, "holds a map already" in again.stderr) == (1, True)
    assert here("map", "hash", "own").stdout.strip() == hash_of(range(5))
    folder = Path("own").resolve() / "maps" / "yard"
    moved = [decoded(wall(i)) for i in (*range(5), 50, 51, 52)]
    moved[6] = replace(moved[6], T_world_camera=pose(0.9))
    hash_of_moved = volume_of(moved, voxel_size=0.04).map_hash()
    with serving(Path("own").resolve()) as server, Client(server.address, map="yard") as client:
        for i in range(50, 53):
            client.send(wall(i))
        client.correct({2: pose(0.9)})
        client.wait_settled(DEADLINE)
        refused = here("map", "resume", file_of(state, "house"), "--state", "own", "--map", "house")
        assert "in use by another server" in refused.stderr
        server.terminate()
        client.close()
        assert server.terminate() == 0
    info = json.loads(here("map", "info", folder, "--json").stdout)
    assert (info["map_hash"], info["keyframes"], info["keyframes_after"]) == (hash_of_moved, 8, 0)


def test_an_old_keyframe_of_a_resumed_map_stays_where_it_was(here: Here, state: Path) -> None:
    """A resumed map leaves its keyframes alone: another journal has others at their positions."""
    here("map", "resume", file_of(state, "yard"), "--state", "own")
    folder = Path("own").resolve() / "maps" / "default"
    make_map(folder, range(60, 62), session=ANNA, client="anna", behind=2)
    correct(folder, ANNA, 6, {1: pose(0.5), 4: pose(0.7)})
    found = json.loads(here("map", "hash", "own", "--json").stdout)
    kept = [decoded(wall(i)) for i in (*range(5), 60, 61)]
    kept[5] = replace(kept[5], T_world_camera=pose(0.7))
    assert found["map_hash"] == volume_of(kept, voxel_size=0.04).map_hash()


def test_the_mesh_of_a_resumed_map_has_all_of_it(here: Here, state: Path) -> None:
    here("map", "resume", file_of(state, "yard"), "--state", "own")
    assert here("mesh", "own", "before.ply").returncode == 0
    make_map(Path("own/maps/default"), range(60, 62), session=BOB, behind=1)
    assert here("mesh", "own", "after.ply").returncode == 0
    whole = volume_of((decoded(wall(i)) for i in (*range(5), 60, 61)), voxel_size=0.04).extract_mesh()
    assert len(trimesh.load("after.ply", process=False).faces) == len(whole.faces)
    anew = here("mesh", "own", "anew.ply", "--voxel-size", 0.08)
    assert (anew.returncode, "of its 6 keyframes the journal has 2" in anew.stderr) == (1, True)


def test_a_map_of_no_server_is_resumed_for_given_poses(here: Here, tmp_path: Path) -> None:
    volume_of((wall(i) for i in range(3)), voxel_size=0.04).save(tmp_path / "map.tsf")
    assert here("map", "resume", "map.tsf", "--state", "own").returncode == 0
    (session,) = json.loads(here("map", "info", "own", "--json").stdout)["sessions"]
    assert (session["last"], session["world"]) == (0, "")
    assert "--map" not in here("map", "resume", "map.tsf", "--state", "own", "--map", "No/Name").stdout
    assert not Path("own/maps/No").exists()


def test_heights_above_the_floor(here: Here) -> None:
    volume_of(first_views(6), voxel_size=0.06).save("room.tsf")
    how = ("--heights", 0.2, 1.0, "--above-floor")
    done = here("map", "convert", "room.tsf", "room.npz", *how)
    assert done.returncode == 0, done.stderr
    floor = float(np.load("room.npz")["floor"])
    assert floor == pytest.approx(0, abs=0.02)
    place = f"the floor, which is {abs(floor):.3f} m {'below' if floor < 0 else 'above'} the map's origin"
    assert f"heights count from {place}; the map lies" in done.stderr
    done = here("map", "convert", "room.tsf", "no.npz", "--heights", 100, 101, "--above-floor")
    assert (done.returncode, "between 100 and 101 m above its floor" in done.stderr) == (1, True)
    done = here("map", "convert", "room.tsf", "no.npz", *how, "--up", "-z")
    assert (done.returncode, "no floor is found in this map" in done.stderr) == (1, True), done.stderr
    done = here("ask", "room.tsf", "room.png", "--slice", 0.2, 1.0, "--above-floor")
    assert f"between 0.2 and 1 m above {place}" in done.stdout
    done = here("ask", "tcp://127.0.0.1:9", "no.png", "--slice", 0.2, 1.0, "--above-floor", "--up", "z")
    assert (done.returncode, "--above-floor needs a saved map" in done.stderr) == (1, True)
    assert not list(Path().glob("no.*"))


def test_a_slice_beside_the_map_is_refused(here: Here) -> None:
    volume = Volume(0.08, threads=2)
    volume.integrate(wall())
    volume.save("map.tsf")
    done = here("map", "convert", "map.tsf", "yard.yaml", "--heights", 100, 101, "--up", "-y")
    assert (done.returncode, Path("yard.yaml").exists()) == (1, False)
    assert "nothing of the map lies between 100 and 101 m" in done.stderr


def test_no_map_takes_the_place_of_a_servers(here: Here, state: Path) -> None:
    saved = file_of(state, "yard")
    before = saved.read_bytes()
    box = ("--box", -1, -1, 0, 1, 1, 3)
    done = here("map", "crop", saved, *box, "--out", saved)
    assert done.returncode == 1
    assert "a server keeps its map there, beside the journal; choose another name" in done.stderr
    assert saved.read_bytes() == before


def test_a_mesh_of_a_journal_has_the_saved_maps_settings_and_flags_on_top(here: Here, state: Path) -> None:
    """With one flag of the map all others were the defaults: voxels of 2 cm in place of 8."""
    journal = state_folder.map_folder(state, "yard")
    known = json.loads(here("mesh", journal, "known.ply", "--json").stdout)["vertices"]
    nearer = json.loads(here("mesh", journal, "nearer.ply", "--max-range", 20, "--json").stdout)["vertices"]
    assert nearer == pytest.approx(known, rel=0.1)
