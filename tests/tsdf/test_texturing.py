# SPDX-License-Identifier: MIT
"""Textures of a synthetic room, of which every view is known."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from gltf_validation import problems

from lab.evaluation import view_colors
from tsfusion import Keyframe, Volume
from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.datasets.worlds.synthetic import Synthetic
from tsfusion.geometry import se3
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.textured_mesh import TexturedMesh
from tsfusion.tsdf.texture import texture_fitting, texturing
from tsfusion.tsdf.texture.texturing import TextureSettings

pytest.importorskip("xatlas")

VOXEL = 0.05
COUNT = 12  # views of a circle; every fourth is held out


@pytest.fixture(scope="module")
def views() -> list[Keyframe]:
    room = Synthetic("room", count=COUNT, noise=False)
    return [room[index] for index in range(COUNT)]


@pytest.fixture(scope="module")
def taken(views: list[Keyframe]) -> list[Keyframe]:
    return [view for index, view in enumerate(views) if index % 4 != 2]


@pytest.fixture(scope="module")
def volume(taken: list[Keyframe]) -> Volume:
    made = Volume(VOXEL, sensor="kinect")
    for keyframe in taken:
        made.integrate(keyframe)
    return made


@pytest.fixture(scope="module")
def textured(volume: Volume, taken: list[Keyframe]) -> TexturedMesh:
    made = volume.extract_mesh(texture=taken)
    assert isinstance(made, TexturedMesh)
    return made


def error(mesh: Mesh, view: Keyframe, *, fitted: bool = False) -> view_colors.ColorError:
    assert view.intrinsics is not None
    assert view.color is not None
    shown = view_colors.shown(mesh, view.T_world_camera, view.intrinsics, (view.shape[0], view.shape[1]))
    where = view_colors.compared(mesh, view, shown)
    assert where.mean() > 0.3
    if fitted:
        image, shown = view_colors.registered(view, shown, where)
        return view_colors.color_error(image, shown, where)
    return view_colors.color_error(view.color[..., ::-1].astype(np.float32), shown, where)


def mean_psnr(mesh: Mesh, views: list[Keyframe], **how: Any) -> float:
    return float(np.mean([error(mesh, view, **how).psnr for view in views[2::4]]))


def test_held_out_views_are_much_nearer_than_with_voxel_colour(
    volume: Volume, textured: TexturedMesh, views: list[Keyframe]
) -> None:
    plain = volume.extract_mesh()
    np.testing.assert_array_equal(textured.vertices, plain.vertices)
    np.testing.assert_array_equal(textured.faces, plain.faces)
    voxel = mean_psnr(plain, views)
    assert mean_psnr(textured, views) > voxel + 4
    at_vertices = Mesh(plain.vertices, plain.faces, plain.normals, textured.colors)
    assert mean_psnr(at_vertices, views) > voxel
    assert textured.seen > 0.8


def test_the_same_images_give_the_same_bytes(
    volume: Volume, taken: list[Keyframe], textured: TexturedMesh
) -> None:
    again = volume.extract_mesh(texture=taken)
    assert isinstance(again, TexturedMesh)
    assert [page.tobytes() for page in again.texture.pages] == [
        page.tobytes() for page in textured.texture.pages
    ]
    assert again.texture.corners.tobytes() == textured.texture.corners.tobytes()
    assert again.encode(".glb") == textured.encode(".glb")


def test_khronos_calls_the_glb_valid(textured: TexturedMesh, tmp_path: Path) -> None:
    assert problems(textured.save(tmp_path / "room.glb")) == []


def test_what_stands_in_front_is_not_painted_on_what_it_hides(
    volume: Volume, taken: list[Keyframe], views: list[Keyframe]
) -> None:
    """A green board half a metre before every other camera hides most of what that sees."""
    board = []
    for index, view in enumerate(taken):
        assert view.depth is not None
        assert view.color is not None
        depth, color = view.depth.copy(), view.color.copy()
        if index % 2:
            depth[40:, 40:-40] = round(0.5 / view.depth_scale)
            color[40:, 40:-40] = (0, 255, 0)
        board.append(replace(view, depth=depth, color=color))
    made = volume.extract_mesh(texture=board)
    assert isinstance(made, TexturedMesh)
    painted = np.concatenate([page.reshape(-1, 3) for page in made.texture.pages]).astype(int)
    assert (painted[:, 1] - painted[:, [0, 2]].max(axis=1) > 150).mean() < 1e-4
    assert mean_psnr(made, views) > mean_psnr(volume.extract_mesh(), views) + 3


def fit_of(mesh: Mesh, images: list[Keyframe], *, align: bool) -> texture_fitting.Fit:
    points, normals = texturing.spread(mesh.vertices, mesh.faces, mesh.normals, VOXEL**-2)
    return texture_fitting.fit(points, normals, images, texture_fitting.Visibility(2 * VOXEL), align=align)


def dimmed_by(factors: list[float], taken: list[Keyframe]) -> list[Keyframe]:
    return [
        replace(view, color=np.rint(view.color * factor).astype(np.uint8))  # type: ignore[operator]
        for view, factor in zip(taken, factors, strict=True)
    ]


FACTORS = [0.6 + 0.1 * (index % 4) for index in range(COUNT - COUNT // 4)]


def test_exposures_are_evened(volume: Volume, taken: list[Keyframe]) -> None:
    fit = fit_of(volume.extract_mesh(), dimmed_by(FACTORS, taken), align=False)
    left = [fit.images[index].gain * factor for index, factor in enumerate(FACTORS)]
    assert np.std(np.log(left)) < 0.02  # of factors that differ by 0.2


@pytest.mark.nightly
def test_even_exposures_are_nearer_to_held_out_views(
    volume: Volume, taken: list[Keyframe], views: list[Keyframe]
) -> None:
    mesh, dimmed = volume.extract_mesh(), dimmed_by(FACTORS, taken)
    even = texturing.textured(mesh, dimmed, VOXEL)
    uneven = texturing.textured(mesh, dimmed, VOXEL, TextureSettings(even=False))
    assert mean_psnr(even, views, fitted=True) > mean_psnr(uneven, views, fitted=True) + 1


@pytest.fixture(scope="module")
def turns() -> list[np.ndarray]:
    """How much each camera was turned, half a degree or so, when its depth was taken."""
    random = np.random.default_rng(3)
    return [se3.exp(np.concatenate([np.zeros(3), random.normal(0, 0.008, 3)])) for _ in FACTORS]


@pytest.fixture(scope="module")
def off(taken: list[Keyframe], turns: list[np.ndarray]) -> list[Keyframe]:
    return [replace(view, color=_turned(view, T)) for view, T in zip(taken, turns, strict=True)]


def test_images_that_are_a_little_off_are_moved_onto_the_others(
    volume: Volume, taken: list[Keyframe], off: list[Keyframe], turns: list[np.ndarray]
) -> None:
    fit = fit_of(volume.extract_mesh(), off, align=True)
    true = [T @ se3.inverse(view.T_world_camera) for view, T in zip(taken, turns, strict=True)]
    found = [fit.images[index].T_camera_world for index in range(len(taken))]
    start = [se3.inverse(view.T_world_camera) for view in taken]
    assert apart(found, true) < 0.3 * apart(start, true)


@pytest.mark.nightly
def test_moved_images_are_nearer_to_held_out_views(
    volume: Volume, off: list[Keyframe], views: list[Keyframe]
) -> None:
    mesh = volume.extract_mesh()
    aligned, left = (
        texturing.textured(mesh, off, VOXEL, TextureSettings(align=align)) for align in (True, False)
    )
    assert mean_psnr(aligned, views, fitted=True) > mean_psnr(left, views, fitted=True) + 2


def apart(poses: list[np.ndarray], true: list[np.ndarray]) -> float:
    """Usual angle between cameras and where they are, but for what all have in common."""
    moves = se3.log(se3.inverse(np.stack(poses)) @ np.stack(true))[:, 3:]
    return float(np.median(np.linalg.norm(moves - np.median(moves, axis=0), axis=1)))


def _turned(view: Keyframe, T: np.ndarray) -> np.ndarray:
    """What a camera sees that is turned: p_turned = T · p."""
    assert view.intrinsics is not None
    assert view.color is not None
    K = view.intrinsics.matrix
    found: np.ndarray = cv2.warpPerspective(
        view.color, K @ T[:3, :3] @ np.linalg.inv(K), view.shape[::-1], borderMode=cv2.BORDER_REPLICATE
    )
    return found


def test_pages_are_no_larger_than_asked_for(volume: Volume, taken: list[Keyframe]) -> None:
    made = texturing.textured(volume.extract_mesh(), taken, VOXEL, TextureSettings(size=512))
    assert len(made.texture.pages) > 1
    assert max(max(page.shape) for page in made.texture.pages) <= 512
    assert set(np.unique(made.texture.page)) == set(range(len(made.texture.pages)))
    assert (made.texture.corners >= 0).all()
    assert (made.texture.corners <= 1).all()


def test_islands_leave_their_texture(textured: TexturedMesh) -> None:
    tidy = textured.without_islands()
    assert len(tidy.texture.corners) == len(tidy.texture.page) == len(tidy.faces)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda view: replace(view, color=None), "no keyframe has a colour image"),
        (lambda _view: None, "no keyframe has a colour image"),
        (lambda view: replace(view, T_world_camera=se3.transform(np.eye(3), (50, 0, 0))), "no image shows"),
    ],
)
def test_without_images_it_says_so(
    volume: Volume, taken: list[Keyframe], change: Callable[[Keyframe], Keyframe | None], message: str
) -> None:
    changed: Any = [change(view) for view in taken[:3]]
    with pytest.raises(MapError, match=message):
        texturing.textured(volume.extract_mesh(), changed, VOXEL)


def test_wrong_settings_and_empty_maps(volume: Volume, taken: list[Keyframe]) -> None:
    for settings in (TextureSettings(size=10), TextureSettings(texel=0.0), TextureSettings(sharpness=-1)):
        with pytest.raises(InvalidConfig, match="must be"):
            texturing.textured(volume.extract_mesh(), taken, VOXEL, settings)
    with pytest.raises(MapError, match="no triangles"):
        Volume(VOXEL).extract_mesh(texture=taken)
