# SPDX-License-Identifier: MIT
"""`tsfusion map`: what it says of saved maps, what it makes of them, and what it refuses."""

import json
from pathlib import Path

import pytest
from command_processes import Here
from corrected_maps import fresh_map
from formula_scenes import volume_of
from keyframes_and_servers import pose, wall
from saved_maps import ANNA, BOB, correct, decoded, make_map

from tsfusion import Volume
from tsfusion.journal import state_folder


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
    assert (found["keyframes_after"], found["corrections_after"]) == (0, 0)
    assert found["settings"]["voxel_size"] == 0.04
    vertices = volume.extract_mesh().vertices
    assert (vertices >= found["box"][:3]).all()
    assert (vertices <= found["box"][3:]).all()
    alone = json.loads(here("map", "info", file_of(state, "yard"), "--json").stdout)
    assert {**found, "keyframes_after": None, "corrections_after": None} == alone
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


def test_hash_moves_what_was_corrected(here: Here, tmp_path: Path) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(4), behind=2)
    correct(folder, ANNA, 5, {1: pose(0.5), 4: pose(0.7)}, removed=(2,))
    found = here("map", "hash", tmp_path / "state")
    assert found.stdout == fresh_map(folder / "journal", 0.04).map_hash() + "\n"
