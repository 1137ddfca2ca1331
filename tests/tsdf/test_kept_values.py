# SPDX-License-Identifier: MIT
"""Values kept while the map grows: solved once, anew where a keyframe reached, and never those of a block
that has gone."""

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of, with_noise
from numpy.typing import NDArray

from tsfusion import Keyframe, Volume
from tsfusion.tsdf.store.block_store import BlockStore
from tsfusion.tsdf.surface import surface_layers
from tsfusion.tsdf.surface.surface_layers import KeptValues

HUNDREDTH = 0.6  # quanta: of a voxel


class Counted:
    """The map's surface, and how many blocks were solved."""

    def __init__(self, volume: Volume) -> None:
        self._view = volume.surface.view(None)
        self.solved = 0

    def __call__(
        self,
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        self.solved += len(keys)
        return self._view(keys, store, min_weight, out)


def noisy_sphere() -> tuple[Volume, list[Keyframe]]:
    random = np.random.default_rng(0)
    views = [with_noise(view, 0.004, random) for view in sphere_views(0.5, 8)]
    return volume_of(views[:-2], sensor="kinect"), views[-2:]


def test_only_what_a_keyframe_reached_is_solved_anew() -> None:
    volume, later = noisy_sphere()
    volume.take_dirty()
    view = Counted(volume)
    kept = KeptValues(view)
    for view_of_now in [None, *later]:
        reached = 0
        if view_of_now is not None:
            volume.integrate(view_of_now)
            keys = volume.surface.values_reached(volume.take_dirty())
            reached = len(keys)
            kept.forget(keys)
        keys = np.sort(volume._store.keys)
        before = view.solved
        found = kept(keys, volume._store, 0.5)
        assert view.solved - before == (reached or len(keys))
        expected = volume.surface.view(None)(keys, volume._store, 0.5)
        assert np.array_equal(np.isnan(found), np.isnan(expected))
        assert np.nanmax(abs(found - expected)) < HUNDREDTH
        some = keys[::3].copy()
        assert np.array_equal(kept(some, volume._store, 0.5), found[::3], equal_nan=True)
        assert view.solved - before == (reached or len(keys))
    assert 0 < reached < len(keys)


def test_no_more_blocks_are_kept_than_there_is_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(surface_layers, "MOST_BLOCKS", 60)
    volume, _ = noisy_sphere()
    keys = np.sort(volume._store.keys)
    assert len(keys) > 200
    expected = volume.surface.view(None)(keys, volume._store, 0.5)
    view = Counted(volume)
    kept = KeptValues(view)
    for first in [*range(0, 200, 40), 0]:
        found = kept(keys[first : first + 40], volume._store, 0.5)
        assert np.nanmax(abs(found - expected[first : first + 40]), initial=0.0) < HUNDREDTH
        assert len(kept._rows) <= 60
        assert kept._values.capacity < 200
    assert view.solved == 240
    kept(keys[:40], volume._store, 0.5)
    assert view.solved == 240  # the last ones are kept
    kept(keys, volume._store, 0.5)  # more than there is room for
    assert view.solved == 240 + len(keys) - 60


def test_blocks_that_have_moved_to_other_slots_keep_their_values() -> None:
    volume, _ = noisy_sphere()
    view = Counted(volume)
    kept = KeptValues(view)
    keys = np.sort(volume._store.keys)
    before = kept(keys, volume._store, 0.5)
    volume._store.release(volume._store.slots_of(keys[::2].copy()).astype(np.int64))
    left = np.sort(volume._store.keys)
    assert np.array_equal(kept(left, volume._store, 0.5), before[1::2], equal_nan=True)
    assert view.solved == len(keys)
    kept.forget(left)
    expected = volume.surface.view(None)(left, volume._store, 0.5)
    assert np.array_equal(kept(left, volume._store, 0.5), expected, equal_nan=True)
