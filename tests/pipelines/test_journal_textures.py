# SPDX-License-Identifier: MIT
"""Textures of maps in a state folder: images at their newest poses, and none that was forgotten."""

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_processes import Here
from formula_scenes import volume_of

from tsfusion import Keyframe
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import JournalError
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.textured_mesh import TexturedMesh
from tsfusion.journal import Journal, state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.pipelines.maps import journal_fusion
from tsfusion.wire.records import codec, corrections

pytest.importorskip("xatlas")

SESSION = b"\x07" * 16
CAMERA = Intrinsics(80.0, 80.0, 47.5, 35.5)
VOXEL = 0.04


def square_at(T: np.ndarray, color: tuple[int, int, int] = (40, 40, 220)) -> Keyframe:
    """A grey wall a metre and a half away with a square (BGR, by itself red) where the camera looks."""
    depth = np.full((72, 96), 1500, np.uint16)
    image = np.full((72, 96, 3), 150, np.uint8)
    image[26:46, 38:58] = color
    return Keyframe(depth=depth, color=image, intrinsics=CAMERA, T_world_camera=T)


def at(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Path]:
    """Make a map's folder with a journal of these keyframes, a correction of poses and numbers forgotten."""

    def record(keyframes: list[Keyframe], poses: dict[int, np.ndarray], forgotten: list[int]) -> Path:
        folder = tmp_path / "map"
        journal = Journal(folder / state_folder.JOURNAL_FOLDER, 1 << 24)
        seq = 0
        for seq, keyframe in enumerate(keyframes, 1):
            encode = partial(codec.encode, keyframe, jpeg_quality=95)
            journal.append(encode(session=SESSION, seq=seq), session=SESSION, seq=seq)
        if poses:
            content = corrections.encode(corrections.checked(poses), session=SESSION, seq=seq + 1)
            journal.append(content, session=SESSION, seq=seq + 1)
        if forgotten:
            gone = replace(corrections.checked({}, removed=forgotten), target=SESSION)
            journal.append(
                corrections.encode(gone, session=SERVER_SESSION, seq=1), session=SERVER_SESSION, seq=1
            )
        journal.close()
        return folder

    return record


def textured(folder: Path) -> TexturedMesh:
    keyframes = JournaledKeyframes(state_folder.find_journal(folder))
    volume = volume_of([keyframes[i].keyframe for i in range(len(keyframes))], voxel_size=VOXEL)
    return journal_fusion.textured(volume.extract_mesh(), folder, VOXEL)


def centre_of(mesh: TexturedMesh, is_painted: Callable[[np.ndarray], np.ndarray]) -> np.ndarray | None:
    """The middle of the faces whose texture has a colour."""
    page, corners = mesh.texture.pages[0], mesh.texture.corners.mean(axis=1)
    row, column = (corners * page.shape[1::-1]).astype(int).T[::-1]
    painted = is_painted(page[row, column].astype(int))
    return mesh.vertices[mesh.faces[painted]].mean(axis=(0, 1)) if painted.any() else None


def red(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(rgb[:, 0] - rgb[:, 1:].max(axis=1) > 60)


def green(rgb: np.ndarray) -> np.ndarray:
    return np.asarray(rgb[:, 1] - rgb[:, [0, 2]].max(axis=1) > 60)


def test_a_corrected_map_has_its_texture_where_the_keyframes_are_now(recorded: Callable[..., Path]) -> None:
    folder = recorded([square_at(at(0.0))] * 2, {1: at(0.3), 2: at(0.3)}, [])
    centre = centre_of(textured(folder), red)
    assert centre is not None
    np.testing.assert_allclose(centre, (0.3, 0, 1.5), atol=VOXEL / 2)


def test_a_forgotten_keyframe_paints_nothing(recorded: Callable[..., Path]) -> None:
    views = [square_at(at(0.0)), square_at(at(0.0)), square_at(at(0.5), (40, 220, 40))]
    mesh = textured(recorded(views, {}, [3]))
    assert centre_of(mesh, green) is None
    assert centre_of(mesh, red) is not None


def test_a_journal_without_keyframes_says_so(recorded: Callable[..., Path]) -> None:
    mesh = volume_of([square_at(at(0.0))] * 2, voxel_size=VOXEL).extract_mesh()
    with pytest.raises(JournalError, match="no keyframes"):
        journal_fusion.textured(mesh, recorded([], {}, []), VOXEL)


def test_the_command_writes_a_textured_file(
    recorded: Callable[..., Path], here: Here, tmp_path: Path
) -> None:
    folder = recorded([square_at(at(0.0)), square_at(at(0.1))], {}, [])
    view = ("--voxel-size", str(VOXEL), "--min-weight", "0")
    done = here("mesh", str(folder), "wall.glb", "--texture", "--texture-size", "1024", *view, "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["texture"]["pages"]) == 1
    assert found["texture"]["seen"] > 0.5
    (read,) = trimesh.load(tmp_path / "wall.glb", force="scene").geometry.values()
    rgb = np.asarray(read.visual.material.baseColorTexture)[..., :3].reshape(-1, 3).astype(int)
    assert red(rgb).sum() > 100
    plain = journal_fusion.map_of(folder, volume_of([], voxel_size=VOXEL).config).volume.extract_mesh(0)
    assert found["triangles"] == len(plain.without_islands().faces)


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (("saved.tsf", "a.glb", "--texture"), "--texture has no effect on a saved map"),
        (("tcp://127.0.0.1:10", "a.glb", "--texture"), "--texture needs a journal"),
        (("map", "a.glb", "--texture", "--color-by", "client"), "give one of them"),
        (("map", "a.glb", "--texture-size", "512"), "--texture-size goes with --texture"),
    ],
)
def test_without_a_journal_the_command_says_what_it_needs(
    command: tuple[str, ...], message: str, here: Here
) -> None:
    done = here("mesh", *command)
    assert done.returncode == 1
    assert message in " ".join(done.stderr.split())
