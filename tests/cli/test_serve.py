# SPDX-License-Identifier: MIT
"""`tsfusion serve` and `tsfusion mesh` as users run them: processes, sockets and files."""

import json
import re
import shutil
import signal
import sys
from pathlib import Path

import cv2
import pytest
import trimesh
from clients_and_spools import deliver
from command_processes import COMMAND, Here, descendants, end, read_until, server, started
from quick_fusers import SUMS, server_command
from small_recordings import first_views

from tsfusion import Client, FlushTimeout, Volume, VolumeConfig, journal
from tsfusion.core import durable_files
from tsfusion.fuser.fuser_messages import SessionProgress
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.tsdf.surface import field_regularizer
from tsfusion.wire.records.codec import decode_keyframe

VOXEL = 0.08


@pytest.mark.usefixtures("quick_servers")
def test_serve_answers_and_ends_well(here: Here, tmp_path: Path) -> None:
    (tmp_path / "cache").mkdir()
    may_wait = sys.platform == "linux" and not durable_files.is_in_memory(tmp_path)
    flags = ("--memory", "0.3GB", "--cache", tmp_path / "cache") if may_wait else ()
    with server(tmp_path / "state", "--voxel-size", VOXEL, *flags, command=COMMAND) as (address, process):
        if may_wait:
            maps = [Path(f"/proc/{pid}/maps").read_text() for pid in descendants(process.pid)]
            assert any(f"{tmp_path}/cache/" in mappings for mappings in maps)
        first, second = first_views(2)
        with Client("tcp://127.0.0.1:1", spool=tmp_path / "spool") as client:
            client.send(first)
        with Client(address, spool=tmp_path / "spool") as client:  # goes on with numbers far above
            deliver(client, [second])
            client.correct({client.records[-1].seq: second.T_world_camera})
            client.flush()
        came, left = read_until(process, "is connected"), read_until(process, "a client left")
        assert re.match(
            r"tsfusion: INFO: a client is connected from 127.0.0.1 \(map default, session \w{8}\)", came
        )
        assert re.match(
            r"tsfusion: INFO: a client left: 2 keyframes received, 2 of them in the map \(map", left
        )
        answer = json.loads(here("status", "--connect", address, "--json").stdout)
        status, (scanner,) = answer["maps"]["default"], answer["health"]["clients"]
        assert (scanner["keyframes_durable"], scanner["keyframes_fused"], scanner["state"]) == (2, 2, "gone")
        assert (status["keyframes_durable"], status["keyframes_fused"]) == (2, 2)
        assert status["blocks"] > 10
        assert len(status["map_hash"]) == 32
        assert " 2/2 " in here("status", address).stdout
        done = here("mesh", address, tmp_path / "live.obj", "--min-weight", 0.5)
        assert done.returncode == 0, done.stderr
        assert "up +z (floor: " in done.stdout
        done = here(
            "replay", "synthetic:room", "--start", 2, "--max-frames", 1, "--connect", address,
            "--out", tmp_path / "more", "--json",
        )  # fmt: skip
        assert json.loads(done.stdout)["keyframes_fused"] == 1, done.stderr
        assert end(process) == 0
    assert Volume.load(tmp_path / "state/maps/default/map.tsf").keyframes == 3


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--memory", "much"), "expected a number of bytes such as 2GB, 512MiB or 2000000000, got 'much'"),
        (("--memory", "1MB"), "--memory: fuser_memory_bytes must be >= 268435456, got 1000000"),
        (("--disk", "0"), "--disk: fuser_disk_bytes must be "),
        (("--cache", "."), "--cache has no effect without --memory: all blocks stay in memory"),
    ],
)
def test_what_bounds_no_memory_is_named(here: Here, flags: tuple[str, ...], message: str) -> None:
    done = here("serve", "--state", "state", *flags)
    assert (done.returncode, message in done.stderr) == (1, True), done.stderr


def test_a_server_that_fell_silent_is_not_called_slow(tmp_path: Path) -> None:
    with (
        server(tmp_path / "state", command=server_command(SUMS)) as (address, process),
        Client(address, spool=tmp_path / "spool") as client,
    ):
        client.connect()
        process.send_signal(signal.SIGSTOP)
        try:
            client.send(first_views(1)[0])
            heard = r"nothing was heard from the server at tcp://\S+ for \d+\.\d s"
            with pytest.raises(FlushTimeout, match=heard):
                client.flush(timeout=1.5)
        finally:
            process.send_signal(signal.SIGCONT)
        client.flush(timeout=30)


@pytest.mark.slow
def test_ready_line_is_for_people_too(tmp_path: Path) -> None:
    words = ("serve", "--listen", "tcp://127.0.0.1:0", "--state", tmp_path / "state")
    process = started(*words, command=server_command(SUMS))
    try:
        line = read_until(process, "ready")
        assert "ready in" in line
        assert line.count("tcp://127.0.0.1:") == 2
    finally:
        status = end(process, signal.SIGINT)
    assert status == 0


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state folder of a server that fused six keyframes and ended well."""
    folder = tmp_path_factory.mktemp("server") / "state"
    with server(folder, "--voxel-size", VOXEL) as (address, process):
        with Client(address) as client:
            deliver(client, first_views(6))
        assert end(process) == 0
    return folder


@pytest.mark.slow
def test_mesh_of_map_state_and_journal_agree(state: Path, here: Here, tmp_path: Path) -> None:
    vertices = set()
    for index, source in enumerate(
        ([state / "maps/default/map.tsf"], [state], [state / "maps/default/journal", "--voxel-size", VOXEL])
    ):
        done = here("mesh", source[0], tmp_path / f"{index}.ply", *source[1:], "--json")
        assert done.returncode == 0, done.stderr
        figures = json.loads(done.stdout)
        vertices.add(figures["vertices"])
        assert figures["up"]["found_by"] == "floor"
        assert figures["up"]["direction"] == pytest.approx((0, 0, 1), abs=0.01)
        vertices.add(len(trimesh.load(tmp_path / f"{index}.ply", process=False).vertices))
    assert len(vertices) == 1
    assert vertices.pop() > 100


def test_mesh_of_a_map_alone_says_that_up_is_not_known(state: Path, here: Here, tmp_path: Path) -> None:
    """Walls look like a floor where nothing says how the sensor was held."""
    volume = Volume.load(state / "maps/default/map.tsf")
    volume.held = SensorPosture()  # as of points whose sensor is not known
    volume.save(tmp_path / "alone.tsf", meta={})
    done = here("mesh", "alone.tsf", "a.glb", "--preview", "a.png")
    assert done.returncode == 0, done.stderr
    assert "up unknown" in done.stdout
    assert "up is not known: GLB and pictures keep the map's axes (--up z" in done.stdout
    lying = trimesh.load("a.glb", force="mesh").extents
    done = here("mesh", "alone.tsf", "a.glb", "--up", "-x")
    assert "up -x (given: -1.0000 0.0000 0.0000)" in done.stdout
    assert "up is not known" not in done.stdout
    assert trimesh.load("a.glb", force="mesh").extents == pytest.approx(lying[[1, 0, 2]], abs=0.1)


@pytest.mark.skipif(sys.platform != "linux", reason="--memory needs Linux")
def test_the_mesh_of_a_map_larger_than_its_memory_is_written_in_tiles(
    here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if durable_files.is_in_memory(tmp_path):
        pytest.skip("the folder for temporary files is a RAM disk")
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(field_regularizer, "BATCH", 40)
    volume = Volume(VOXEL, threads=2)
    for keyframe in first_views(2):
        volume.integrate(keyframe)
    volume.save("map.tsf")
    assert here("mesh", "map.tsf", "whole.ply").returncode == 0
    done = here("mesh", "map.tsf", "tiles.ply", "--memory", "100kB")
    assert "tiles.ply: " in done.stdout
    assert "islands not looked for" in done.stdout
    assert Path("tiles.ply").read_bytes() == Path("whole.ply").read_bytes()
    found = json.loads(here("mesh", "map.tsf", "map.glb", "--memory", "100kB", "--json").stdout)
    assert found["files"][:2] == ["map-0001.glb", "map-0002.glb"]
    assert not Path("map.glb").exists()
    for flags, message in (
        (("c.obj",), "is saved as .ply or .glb, got 'c.obj'"),
        (("c.ply", "--preview", "c.png"), "--preview needs all of the mesh, which is too large for memory"),
        (("c.ply", "--drop-islands"), "--drop-islands needs all of the mesh, which is too large for memory"),
    ):
        done = here("mesh", "map.tsf", *flags, "--memory", "100kB")
        assert (done.returncode, message in done.stderr) == (1, True), done.stderr


@pytest.mark.slow
def test_mesh_fuses_what_the_checkpoint_missed(state: Path, here: Here, tmp_path: Path) -> None:
    """A state folder whose map is older than its journal, as a killed server leaves it."""
    folder = tmp_path / "state/maps/default"
    shutil.copytree(state / "maps/default/journal", folder / "journal")
    saved = MapCheckpoints(folder, VolumeConfig(voxel_size=VOXEL), keep_previous=False)
    first = next(journal.records(folder / "journal/000001.mcap"))
    keyframe = decode_keyframe(first.frames)
    saved.volume.integrate(keyframe)
    saved.ledger.add(first.session, first.seq, first.position, keyframe)
    saved.done[first.session] = SessionProgress(first.seq, "")
    assert saved.save()
    done = here(
        "mesh", tmp_path / "state", tmp_path / "a.glb", "--preview", tmp_path / "a.png", "--keep-islands"
    )
    assert done.returncode == 0, done.stderr
    volume = Volume(voxel_size=VOXEL)
    for keyframe in first_views(6):
        volume.integrate(keyframe)
    assert f"{len(volume.extract_mesh().vertices):,}".replace(",", "\u202f") in done.stdout
    assert cv2.imread(str(tmp_path / "a.png")).std() > 5
