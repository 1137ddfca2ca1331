# SPDX-License-Identifier: MIT
"""Views of a map by a camera."""

import numpy as np
import pytest

from tsfusion import Intrinsics, InvalidConfig, Keyframe, Volume
from tsfusion.core.config import Surface
from tsfusion.tsdf.answers import camera_views

CAMERA = Intrinsics(100.0, 100.0, 79.5, 59.5)
SHAPE = (120, 160)
RED = np.array([20, 40, 200], np.uint8)  # BGR


def wall_map(*, color: bool = True) -> Volume:
    """A wall at z = 1 that was seen from the origin, red where x > 0."""
    volume = Volume(0.02, sensor="scanner", threads=2, color=color)
    depth = np.full(SHAPE, 1.0, np.float32)
    image = np.where(np.arange(160)[:, None] > 80, RED, np.uint8(100)) * np.ones((120, 1, 1), np.uint8)
    volume.integrate(
        Keyframe(depth=depth, color=image if color else None, intrinsics=CAMERA, T_world_camera=np.eye(4))
    )
    return volume


@pytest.fixture(scope="module")
def volume() -> Volume:
    return wall_map()


@pytest.mark.parametrize("surface", ["raw", "field"])
@pytest.mark.parametrize(("normals", "colors"), [(False, False), (True, False), (False, True)])
def test_what_is_not_wanted_is_left_out(
    volume: Volume, monkeypatch: pytest.MonkeyPatch, surface: Surface, normals: bool, colors: bool
) -> None:
    T = np.eye(4)
    T[:3, 3] = (-0.2, 0.1, 0.2)
    whole = volume.raycast(CAMERA, T, SHAPE, surface=surface)
    for triangles in (camera_views.MOST_TRIANGLES, 1):  # in one part; in many
        monkeypatch.setattr(camera_views, "MOST_TRIANGLES", triangles)
        view = volume.raycast(CAMERA, T, SHAPE, surface=surface, normals=normals, colors=colors)
        assert np.array_equal(view.depth, whole.depth)
        for name, wanted in (("normals", normals), ("colors", colors)):
            assert (getattr(view, name) is not None) == wanted
            assert not wanted or np.array_equal(getattr(view, name), getattr(whole, name))
    away = volume.raycast(CAMERA, np.diag([-1.0, 1, -1, 1]), SHAPE, normals=normals, colors=colors)
    assert not away.depth.any()
    assert (away.normals is not None, away.colors is not None) == (normals, colors)


@pytest.mark.parametrize(
    "camera", [CAMERA, CAMERA.matrix, (90.0, 80.0, 70.0, 55.0), Intrinsics(100.0, -100.0, 79.5, 59.5)]
)
@pytest.mark.parametrize("surface", ["raw", "field"])
def test_a_wall_from_the_side(volume: Volume, camera: object, surface: str) -> None:
    turn = np.radians(20)
    T = np.eye(4)
    T[:3, :3] = [[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]
    T[:3, 3] = (-0.2, 0.1, 0.2)
    view = volume.raycast(camera, T, SHAPE, surface=surface)  # type: ignore[arg-type]
    fx, fy, cx, cy = (
        (camera.fx, camera.fy, camera.cx, camera.cy) if isinstance(camera, Intrinsics)
        else np.ravel(camera)[[0, 4, 2, 5] if np.size(camera) == 9 else [0, 1, 2, 3]]
    )  # fmt: skip
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(SHAPE)], axis=-1) @ T[:3, :3].T
    depth = (1 - T[2, 3]) / rays[..., 2]
    met = T[:3, 3] + depth[..., None] * rays
    inner = (np.abs(met[..., 0]) < 0.7) & (np.abs(met[..., 1]) < 0.5)
    assert inner.mean() > 0.4
    np.testing.assert_allclose(view.depth[inner], depth[inner], atol=1e-3)
    np.testing.assert_allclose(view.normals[inner], np.tile([0, 0, -1], (inner.sum(), 1)), atol=0.02)
    red = inner & (met[..., 0] > 0.1)
    assert view.colors is not None
    assert (view.colors[red] == RED[::-1]).all()
    missed = (np.abs(met[..., 0]) > 0.9) | (depth < 0)
    assert (view.depth[missed] == 0).all()
    assert (view.normals[missed] == 0).all()
    assert (view.colors[missed] == 0).all()


def test_a_wall_from_behind_or_behind_the_camera_is_not_seen(volume: Volume) -> None:
    away = np.diag([-1.0, 1, -1, 1])
    behind = away.copy()
    behind[2, 3] = 2.0
    for T in (behind, away):
        assert not volume.raycast(CAMERA, T, SHAPE).depth.any()


@pytest.mark.parametrize(
    "camera",
    [(1e-30, 1.0, 0.0, 0.0), (1e30, 1e30, 0.0, 0.0), (1.0, 1e-30, 1e30, 0.0), (100.0, 100.0, -1e30, 1e30)],
)
def test_an_absurd_camera_sees_something_or_nothing(volume: Volume, camera: tuple[float, ...]) -> None:
    for near in (0.0, 0.94, 0.96, 1.0):  # also with the wall in the near plane
        T = np.eye(4)
        T[2, 3] = near
        view = volume.raycast(camera, T, SHAPE)
        assert (view.depth >= 0).all()
        assert not np.isnan(view.normals).any()


def test_a_map_without_colour_shows_none() -> None:
    view = wall_map(color=False).raycast(CAMERA, np.eye(4), SHAPE)
    assert view.colors is None
    assert np.median(view.depth) == pytest.approx(1, abs=1e-3)


def test_an_empty_map_shows_nothing() -> None:
    view = Volume(0.02, threads=2).raycast(CAMERA, np.eye(4), (3, 5))
    assert view.depth.shape == (3, 5)
    assert not view.depth.any()
    assert (view.depth.dtype, view.normals.dtype) == (np.float32, np.float32)


@pytest.mark.parametrize(
    ("camera", "T", "shape", "problem"),
    [
        ("f", np.eye(4), SHAPE, "intrinsics must be"),
        ((0.0, 1.0, 0.0, 0.0), np.eye(4), SHAPE, "fx > 0"),
        (CAMERA, np.eye(3), SHAPE, r"T_world_camera must have shape \(4, 4\)"),
        (CAMERA, np.full((4, 4), np.nan), SHAPE, "T_world_camera must be finite"),
        (CAMERA, np.eye(4), (0, 5), "shape must be"),
        (CAMERA, np.eye(4), (5,), "shape must be"),
        (CAMERA, np.eye(4), (2.5, 5), "shape must be"),
        (CAMERA, np.eye(4), (10**6, 5), "shape must be"),
        (CAMERA, np.eye(4), None, "shape must be"),
    ],
)  # fmt: skip
def test_a_camera_that_is_none(
    volume: Volume, camera: object, T: object, shape: object, problem: str
) -> None:
    with pytest.raises(InvalidConfig, match=problem):
        volume.raycast(camera, T, shape)  # type: ignore[arg-type]
