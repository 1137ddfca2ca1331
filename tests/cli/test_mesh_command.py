# SPDX-License-Identifier: MIT
"""`tsfusion mesh` as users run it: processes, sockets and files."""

import json
import shutil
from pathlib import Path

import cv2
import pytest
import trimesh
from command_processes import end, server, tsfusion

from tsfusion import Client, Keyframe, Volume
from tsfusion.datasets import Synthetic

VOXEL = 0.08


def room(count: int) -> list[Keyframe]:
    """The first keyframes of the synthetic room of 40."""
    return [Synthetic("room", count=40)[index] for index in range(count)]


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The state folder of a server that fused six keyframes and ended well."""
    folder = tmp_path_factory.mktemp("server") / "state"
    with server(folder, "--voxel-size", VOXEL) as (address, process):
        with Client(address) as client:
            for keyframe in room(6):
                client.send(keyframe)
            client.flush(timeout=30)
            client.wait_fused(timeout=30)
        assert end(process) == 0
    return folder


@pytest.mark.slow
def test_mesh_of_map_state_and_journal_agree(state: Path, tmp_path: Path) -> None:
    vertices = set()
    for index, source in enumerate(
        ([state / "maps/default/map.tsf"], [state], [state / "maps/default/journal", "--voxel-size", VOXEL])
    ):
        done = tsfusion("mesh", source[0], tmp_path / f"{index}.ply", *source[1:], "--json")
        assert done.returncode == 0, done.stderr
        vertices.add(json.loads(done.stdout)["vertices"])
        vertices.add(len(trimesh.load(tmp_path / f"{index}.ply", process=False).vertices))
    assert len(vertices) == 1
    assert vertices.pop() > 100


@pytest.mark.slow
def test_mesh_fuses_what_the_checkpoint_missed(state: Path, tmp_path: Path) -> None:
    """A state folder whose map is older than its journal, as a killed server leaves it."""
    shutil.copytree(state / "maps/default/journal", tmp_path / "state/maps/default/journal")
    volume = Volume(voxel_size=VOXEL)
    volume.integrate(room(1)[0])
    volume.save(tmp_path / "state/maps/default/map.tsf")
    done = tsfusion("mesh", tmp_path / "state", tmp_path / "a.glb", "--preview", tmp_path / "a.png")
    assert done.returncode == 0, done.stderr
    for keyframe in room(6)[1:]:
        volume.integrate(keyframe)
    assert f"{len(volume.extract_mesh().vertices):,}".replace(",", "\u202f") in done.stdout
    assert cv2.imread(str(tmp_path / "a.png")).std() > 5
