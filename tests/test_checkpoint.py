# SPDX-License-Identifier: MIT
"""A saved map comes back to the byte, or says why not."""

from pathlib import Path

import numpy as np
import pytest
import scenes

from tsfusion import Volume
from tsfusion.errors import CheckpointError, InvalidConfig, WeightOverflow

VIEWS = scenes.sphere_views(0.4, 4)


def small(**settings: object) -> Volume:
    volume = Volume(**{"voxel_size": 0.03, **settings})
    for keyframe in VIEWS[:3]:
        volume.integrate(keyframe)
    return volume


@pytest.mark.parametrize("settings", [{}, {"regularizer": "ray"}, {"color": False}])
def test_a_map_comes_back_and_goes_on_as_if_never_saved(tmp_path: Path, settings: dict) -> None:
    volume = small(**settings)
    path = volume.save(tmp_path / "map.tsf", meta={"journal": 17})
    loaded = Volume.load(path)
    assert loaded.map_hash() == volume.map_hash()
    assert loaded.color_hash() == volume.color_hash()
    assert loaded.meta == {"journal": 17}
    assert loaded.stats().keyframes == 3
    assert loaded.config.voxel_size == 0.03
    for either in (volume, loaded):
        either.integrate(VIEWS[3])
        either.retract(VIEWS[0])
    assert loaded.map_hash() == volume.map_hash()
    assert (loaded.extract_mesh().vertices == volume.extract_mesh().vertices).all()


def test_blocks_emptied_by_retraction_are_not_saved(tmp_path: Path) -> None:
    volume = small()
    for keyframe in VIEWS[:3]:
        volume.retract(keyframe)
    path = volume.save(tmp_path / "map.tsf")
    assert Volume.load(path).stats().blocks == 0


def test_the_same_map_gives_the_same_file(tmp_path: Path) -> None:
    a = small().save(tmp_path / "a.tsf").read_bytes()
    assert a == small().save(tmp_path / "b.tsf").read_bytes()


def test_a_file_cut_or_altered_anywhere_is_refused(tmp_path: Path) -> None:
    path = small().save(tmp_path / "map.tsf")
    whole = path.read_bytes()
    for cut in [0, 4, 8, 10, 100, len(whole) // 2, len(whole) - 1]:
        path.write_bytes(whole[:cut])
        with pytest.raises(CheckpointError):
            Volume.load(path)
    for at in range(0, len(whole), max(1, len(whole) // 40)):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x10]) + whole[at + 1 :])
        with pytest.raises(CheckpointError):
            Volume.load(path)


def test_a_missing_file_and_an_unwritable_place_are_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"none\.tsf"):
        Volume.load(tmp_path / "none.tsf")
    with pytest.raises(CheckpointError, match="cannot write"):
        small().save(tmp_path / "missing" / "map.tsf")
    assert not list(tmp_path.iterdir())


def test_a_failed_save_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    volume = small()
    path = volume.save(tmp_path / "map.tsf")
    before = path.read_bytes()

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", fail)
    with pytest.raises(CheckpointError, match="No space left"):
        volume.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_loaded_map_knows_how_full_its_voxels_are(tmp_path: Path) -> None:
    volume = Volume(voxel_size=0.02)
    view = scenes.sphere_views(0.4, 1)[0]
    volume.integrate(view)
    slot, voxel = np.argwhere(volume._store.sums != 0)[0]
    volume._store.sums[slot, voxel] |= (1 << 26) - 1
    loaded = Volume.load(volume.save(tmp_path / "full.tsf"))
    with pytest.raises(WeightOverflow):
        loaded.integrate(view)


def test_a_saved_map_can_be_read_with_another_surface_but_not_with_another_voxel_size(tmp_path: Path) -> None:
    volume = Volume(voxel_size=0.02, surface="raw")
    volume.integrate(scenes.sphere_views(0.4, 1)[0])
    path = volume.save(tmp_path / "map.tsf")
    again, other = Volume.load(path), Volume.load(path, surface="field", min_weight=None)
    assert (again.config.surface, other.config.surface) == ("raw", "field")
    assert again.map_hash() == other.map_hash()
    assert not np.array_equal(again.extract_mesh().vertices, other.extract_mesh().vertices)
    with pytest.raises(InvalidConfig, match="voxel_size"):
        Volume.load(path, voxel_size=0.01)
