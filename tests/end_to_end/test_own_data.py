# SPDX-License-Identifier: MIT
"""Own recordings made from real frames: the path alone gives the keyframes that were recorded."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import own_recordings
import pytest

from tsfusion import Keyframe, open_dataset

COUNT = 6
Data = Callable[[str], Path]
Write = Callable[[Path, Sequence[Keyframe]], Path]

FORMS: dict[str, Write] = {
    "tum": own_recordings.tum,
    "images": own_recordings.images,
    "nerfstudio": own_recordings.nerfstudio,
    "ros1": lambda root, views: own_recordings.bag(root, views, "ros1"),
    "sqlite3": lambda root, views: own_recordings.bag(root, views, "sqlite3"),
    "mcap": lambda root, views: own_recordings.bag(root, views, "mcap"),
}


@pytest.fixture(scope="module")
def kitchen(data: Data) -> list[Keyframe]:
    return own_recordings.views(data("7scenes/redkitchen"), COUNT, every=1)


@pytest.mark.parametrize("form", FORMS)
def test_an_own_recording_gives_what_was_recorded(kitchen: list[Keyframe], tmp_path: Path, form: str) -> None:
    found = open_dataset(FORMS[form](tmp_path / "mine", kitchen))
    assert len(found) == COUNT
    for keyframe, expected in zip(found, kitchen, strict=True):
        metres = np.asarray(keyframe.measurement) * keyframe.depth_scale
        np.testing.assert_allclose(metres, np.asarray(expected.measurement) * 0.001, atol=1e-6)
        assert np.array_equal(keyframe.color, expected.color)
        np.testing.assert_allclose(keyframe.intrinsics.matrix, expected.intrinsics.matrix, rtol=1e-12)
        np.testing.assert_allclose(keyframe.T_world_camera, expected.T_world_camera, atol=1e-6)
