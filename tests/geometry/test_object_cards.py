# SPDX-License-Identifier: MIT
"""What a prompt and a notebook show of maps, meshes, keyframes and recordings."""

import base64
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of
from numpy.typing import NDArray

import tsfusion
from tsfusion import Keyframe, Mesh, Volume, open_dataset
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import Frames
from tsfusion.geometry import object_cards

VIEWS = sphere_views(0.4, 4)
POINTS = Keyframe(points=np.random.default_rng(3).random((500, 3), np.float32), T_world_camera=np.eye(4))


def pictures(html: str) -> list[NDArray[np.uint8]]:
    found = re.findall(r"data:image/png;base64,([^']+)'", html)
    return [np.asarray(cv2.imdecode(np.frombuffer(base64.b64decode(one), np.uint8), 1)) for one in found]


@pytest.mark.parametrize(
    ("make", "line", "count"),
    [
        (lambda: volume_of(VIEWS), r"<Volume: 4 keyframes, \d+ blocks of 8³ voxels of \d+ mm, .* m>", 1),
        (lambda: Volume(0.1), r"<Volume: 0 keyframes, 0 blocks .*, empty>", 0),
        (lambda: volume_of(VIEWS).extract_mesh(), r"<Mesh: \d+ triangles, \d+ vertices, \w+, .* m>", 1),
        (lambda: VIEWS[0], r"<Keyframe: depth \d+ × \d+ \w+ with colour, .*, at \(.*\) m>", 2),
        (lambda: POINTS, r"<Keyframe: points 500 float32, sensor as of the map, at .*>", 1),
        (lambda: open_dataset("synthetic:room", count=3), r"<Synthetic: .*, 3 frames in .* s, .*>", 2),
    ],
)  # fmt: skip
def test_each_says_what_it_is(make: Callable[[], Any], line: str, count: int) -> None:
    one = make()
    assert re.fullmatch(line, repr(one))
    html = one._repr_html_()
    assert f"<b>{type(one).__name__}</b>" in html
    assert len(pictures(html)) == count
    assert all(max(picture.shape[:2]) <= 320 for picture in pictures(html))


def test_names_of_files_are_no_html() -> None:
    room = open_dataset("synthetic:room", count=1)
    room.name = "<script>"
    assert "<script>" not in room._repr_html_()


def test_the_picture_is_from_above_and_shows_what_faces_up() -> None:
    """A square of floor under a ceiling: the ceiling, which faces down, hides nothing."""
    x, y = (one.ravel() for one in np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40)))
    floor, ceiling = (np.stack([x, y, np.full(1600, z)], axis=1) for z in (0.0, 2.0))
    normals = np.repeat([[0.0, 0, 1], [0, 0, -1]], 1600, axis=0)
    colors = np.repeat(np.array([[200, 0, 0], [0, 0, 200]], np.uint8), 1600, axis=0)
    picture = object_cards.surface(np.concatenate([floor, ceiling]), normals, colors)
    assert picture is not None
    assert picture[picture[..., 0] < 255].tolist()
    assert (picture[..., 2] < 255).any()
    assert not ((picture[..., 2] > picture[..., 0]) & (picture[..., 0] < 255)).any()
    assert object_cards.surface(ceiling, normals[1600:], None) is None


def test_near_is_bright_and_what_was_not_measured_black() -> None:
    depth = np.array([[0, 1000], [2000, 3000]], np.uint16)
    grey, color = object_cards.measured(replace(VIEWS[0], depth=depth, color=None))
    assert grey is not None
    assert color is None
    assert grey[0, 0].tolist() == [0, 0, 0]
    assert grey[0, 1, 0] > grey[1, 0, 0] > grey[1, 1, 0] > 0


def test_an_empty_mesh_has_no_picture() -> None:
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    assert "empty" in repr(empty)
    assert not pictures(empty._repr_html_())


def test_recordings_are_sliced_as_lists_are() -> None:
    room = open_dataset("synthetic:room", count=6)
    assert isinstance(room, Frames)
    stamps = [keyframe.timestamp_ns for keyframe in room]
    for chosen in (slice(1, 3), slice(None, None, 2), slice(-2, None), slice(None, None, -1), slice(4, 2)):
        some = room[chosen]
        assert [keyframe.timestamp_ns for keyframe in some] == stamps[chosen]
        assert len(some) == len(stamps[chosen])
    assert room[1:5][1:][0].timestamp_ns == stamps[2]
    with pytest.raises(IndexError):
        room[1:3][2]


def test_a_first_frame_that_cannot_be_read_costs_the_picture_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    room = open_dataset("synthetic:room", count=2)

    def broken(_: int) -> None:
        raise DatasetError("frame 0 is cut short")

    monkeypatch.setattr(room, "_frame", broken)
    assert "2 frames" in room._repr_html_()


def test_completion_shows_what_users_call() -> None:
    shown = {name for name in dir(Volume(0.1)) if name[0] != "_"}
    assert {"integrate", "extract_mesh", "sample", "distance_field", "save", "load", "copy"} <= shown
    assert not {"surface", "set_pause", "warming_up", "version"} & shown
    assert set(dir(tsfusion)) == set(tsfusion.__all__)
