# SPDX-License-Identifier: MIT
"""Saved maps added file to file are the maps that `Volume.merge` makes, to the last bit."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from keyframes_and_servers import wall

from tsfusion import Keyframe, Volume
from tsfusion.core.errors import DamagedCheckpoint, MapError, MapFull, WeightOverflow
from tsfusion.kernels.integration.integrate import WEIGHT_LIMIT
from tsfusion.tsdf.files import checkpoint, saved_map_addition
from tsfusion.tsdf.files.saved_map_addition import add_files


def volume(*keyframes: Keyframe, **settings: object) -> Volume:
    made = Volume(**{"voxel_size": 0.02, "threads": 1, **settings})
    for keyframe in keyframes:
        made.integrate(keyframe)
    return made


def far(i: int, metres: float) -> Keyframe:
    T = wall(i).T_world_camera.copy()
    T[0, 3] += metres
    return wall(i, T_world_camera=T)


KEYFRAMES = [
    wall(0),
    wall(1),
    far(2, 0.5),
    far(3, 1.0),
    far(4, 9.0),
    wall(5, depth_scale=0.002),
    far(6, -3.0),
]


@pytest.mark.parametrize("chunk", [1024, 7])
def test_the_sum_of_files_is_the_map_of_all(
    tmp_path: Path, chunk: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Chunks between those of others go as they are, others are added: with 7 blocks each there are both."""
    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "CHUNK", chunk)
        files = [volume(*KEYFRAMES[i::3]).save(tmp_path / f"{i}.tsf", meta={"part": i}) for i in range(3)]
    files.append(volume().save(tmp_path / "empty.tsf"))
    passed = []
    pass_on = saved_map_addition._BlockStream.pass_on

    def counted(self: Any, digest: Any) -> Any:
        passed.append(self)
        return pass_on(self, digest)

    monkeypatch.setattr(saved_map_addition._BlockStream, "pass_on", counted)
    header = add_files(files, tmp_path / "sum.tsf")
    made, whole = Volume.load(tmp_path / "sum.tsf", threads=1), volume(*KEYFRAMES)
    assert whole.stats().blocks > 1024  # the hash is taken in more than one run
    assert header.map_hash == made.map_hash() == whole.map_hash()
    assert made.color_hash() == whole.color_hash()
    assert (made.keyframes, made.held.numbers) == (7, whole.held.numbers)
    assert (len(passed) > 20) is (chunk == 7)
    again = add_files([tmp_path / "sum.tsf"], tmp_path / "again.tsf")  # all chunks as they are
    assert again.map_hash == header.map_hash
    assert Volume.load(tmp_path / "again.tsf").color_hash() == whole.color_hash()


def test_settled_colours_are_added_as_volumes_do(tmp_path: Path) -> None:
    one, other = (volume(wall(i)) for i in range(2))
    for each in (one, other):
        rgn = each._store.color_rgn
        rgn[: each._store.count] += np.where(rgn[: each._store.count] != 0, 30_000, 0)
    files = [each.save(tmp_path / f"{i}.tsf") for i, each in enumerate((one, other))]
    add_files(files, tmp_path / "sum.tsf")
    one.merge(other)
    assert Volume.load(tmp_path / "sum.tsf").color_hash() == one.color_hash()


def test_files_that_cannot_be_added(tmp_path: Path) -> None:
    fine, other = volume(wall(0)).save(tmp_path / "a.tsf"), tmp_path / "b.tsf"
    volume(wall(1), voxel_size=0.04).save(other)
    with pytest.raises(MapError, match="different voxel sizes or layers"):
        add_files([fine, other], tmp_path / "sum.tsf")
    volume(wall(1), color=False).save(other)
    with pytest.raises(MapError, match="different voxel sizes or layers"):
        add_files([fine, other], tmp_path / "sum.tsf")
    small = volume(wall(0), max_blocks=400)
    small.save(fine)
    volume(far(1, 9.0)).save(other)
    with pytest.raises(MapFull, match="at most max_blocks = 400"):
        add_files([fine, other], tmp_path / "sum.tsf")
    content = bytearray(other.read_bytes())
    content[len(content) // 2] ^= 1
    other.write_bytes(content)
    with pytest.raises(DamagedCheckpoint):
        add_files([other], tmp_path / "sum.tsf")
    assert not list(tmp_path.glob("*sum*"))


def test_votes_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    files = []
    for i in range(2):
        one = volume(wall(0))
        sums = one._store.sums[: one._store.count]
        sums[sums != 0] += WEIGHT_LIMIT // 2
        files.append(one.save(tmp_path / f"{i}.tsf"))
    with pytest.raises(WeightOverflow, match=r"\d+ blocks hold voxels that would have more votes"):
        add_files(files, tmp_path / "sum.tsf")
