# SPDX-License-Identifier: MIT
"""`tsfusion map`: what it says of saved maps, what it makes of them, and what it refuses."""

import json
from pathlib import Path

import pytest
from command_processes import Here
from saved_maps import ANNA, BOB, make_map

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


def test_hash_is_a_line_and_says_what_the_map_is_without(here: Here, state: Path) -> None:
    whole = here("map", "hash", file_of(state, "yard"))
    assert (whole.stdout, whole.stderr) == (Volume.load(file_of(state, "yard")).map_hash() + "\n", "")
    behind = here("map", "hash", state, "--map", "house")
    assert behind.returncode == 0
    assert behind.stdout == Volume.load(file_of(state, "house")).map_hash() + "\n"
    assert "without 1 keyframe of the journal" in behind.stderr
