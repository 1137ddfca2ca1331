# SPDX-License-Identifier: MIT
"""A saved map comes back to the byte, or says why not."""

import errno
import hashlib
import os
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from command_processes import python
from failures import memory_limited
from formula_scenes import sphere_views, volume_of

from tsfusion import Volume, VolumeConfig
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, InvalidConfig, MapFull, WeightOverflow
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.files.saved_map import begin_hash
from tsfusion.tsdf.store.block_store import pack_keys

VIEWS = sphere_views(0.4, 4)


def small(**settings: object) -> Volume:
    return volume_of(VIEWS[:3], voxel_size=0.03, **settings)


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


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
def test_a_map_is_read_and_written_in_little_more_memory_than_it_takes(tmp_path: Path) -> None:
    volume = Volume(VolumeConfig(regularizer="ray"))
    numbers = np.arange(1, 12_001, dtype=np.int32)
    volume._store.insert(pack_keys(np.stack([numbers % 100, numbers // 100, 0 * numbers], axis=1)))
    for layer in volume._store.layers().values():
        layer[: len(numbers)] = numbers[:, None]
    with memory_limited(32 << 20):
        path = volume.save(tmp_path / "map.tsf")
    size, map_hash = volume.stats().bytes, volume.map_hash()
    assert size > 140 << 20
    del volume
    with memory_limited(size + (32 << 20)):
        loaded = Volume.load(path)
        assert loaded.map_hash() == map_hash
    assert loaded.stats().bytes == size
    with memory_limited(size // 2), pytest.raises(CheckpointError, match="does not fit"):
        Volume.load(path)


def test_a_map_takes_no_more_than_it_may_however_it_has_grown(tmp_path: Path) -> None:
    """Room does not depend on when the map was saved and read; what finds none leaves the map as it was."""
    once, again = volume_of([]), volume_of([])
    fitted: list[list[int]] = [[], []]
    most = volume_of(VIEWS[:2]).stats().bytes
    for number in (0, 2, 1, 3, 0, 2):
        again = Volume.load(again.save(tmp_path / "map.tsf"))
        for volume, numbers in zip((once, again), fitted, strict=True):
            volume.limit_memory(most)
            with suppress(MemoryError):
                volume.integrate(VIEWS[number])
                numbers.append(number)
    assert fitted[0] == fitted[1]
    assert 0 < len(fitted[0]) < 6
    assert once.map_hash() == again.map_hash() == volume_of(VIEWS[i] for i in fitted[0]).map_hash()
    assert again.stats().bytes == once.stats().bytes <= most


def test_a_saved_map_goes_on_with_other_limits(tmp_path: Path) -> None:
    blocks = small().stats().blocks
    path = small(max_blocks=blocks).save(tmp_path / "map.tsf")
    with pytest.raises(MapFull):
        Volume.load(path).integrate(VIEWS[3])
    Volume.load(path, max_blocks=2 * blocks).integrate(VIEWS[3])
    lowered = Volume.load(path, max_blocks=1)
    lowered.integrate(VIEWS[0])
    with pytest.raises(MapFull, match=f"it has {blocks}"):
        lowered.integrate(VIEWS[3])
    assert Volume.load(lowered.save(path)).map_hash() == lowered.map_hash()


def test_blocks_emptied_by_retraction_are_not_saved(tmp_path: Path) -> None:
    volume = small()
    for keyframe in VIEWS[:3]:
        volume.retract(keyframe)
    path = volume.save(tmp_path / "map.tsf")
    assert Volume.load(path).stats().blocks == 0


def test_the_same_map_gives_the_same_file(tmp_path: Path) -> None:
    a = small().save(tmp_path / "a.tsf").read_bytes()
    assert a == small().save(tmp_path / "b.tsf").read_bytes()


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small().save(tmp_path_factory.mktemp("saved") / "map.tsf")


def test_a_file_cut_anywhere_is_refused(saved: Path, tmp_path: Path) -> None:
    whole, path = saved.read_bytes(), tmp_path / "map.tsf"
    for cut in [*range(40), *(len(whole) * i // 200 for i in range(200)), len(whole) - 1]:
        path.write_bytes(whole[:cut])
        with pytest.raises(DamagedCheckpoint):
            Volume.load(path)


def test_a_file_with_a_flipped_bit_is_refused(saved: Path, tmp_path: Path) -> None:
    whole, path = saved.read_bytes(), tmp_path / "map.tsf"
    head = 12 + int.from_bytes(whole[8:12], "little") + 12  # magic, header, start of the first chunk
    some = range(head, len(whole), max(1, len(whole) // 200))
    for at in [*range(head), *some, *range(len(whole) - 16, len(whole))]:
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 1 << at % 8]) + whole[at + 1 :])
        with pytest.raises(CheckpointError):
            Volume.load(path)


def test_a_file_that_goes_on_behind_its_end_is_refused(saved: Path, tmp_path: Path) -> None:
    path = tmp_path / "map.tsf"
    for more in (b"\0", bytes(4096), saved.read_bytes()):
        path.write_bytes(saved.read_bytes() + more)
        with pytest.raises(DamagedCheckpoint):
            Volume.load(path)


def forge(path: Path, content: bytes) -> None:
    """A file whose digest agrees, as only somebody who means it writes."""
    path.write_bytes(content + hashlib.blake2b(content, digest_size=16).digest())


def test_a_forged_file_is_refused_before_it_asks_for_memory(saved: Path, tmp_path: Path) -> None:
    whole, path = saved.read_bytes()[:-16], tmp_path / "map.tsf"
    size = int.from_bytes(whole[8:12], "little")
    header = msgspec.msgpack.decode(whole[12 : 12 + size], type=checkpoint.CheckpointHeader)
    for change in ({"blocks": 3_000_000}, {"blocks": -1}, {"layers": ["sums", "sums2"]}, {"layers": []}):
        altered = msgspec.msgpack.encode(msgspec.structs.replace(header, **change))
        forge(path, whole[:8] + struct.pack("<I", len(altered)) + altered + whole[12 + size :])
        with pytest.raises(CheckpointError):
            Volume.load(path)
    for length in (0, 1 << 20, 2**32 - 1):
        forge(path, whole[:8] + struct.pack("<I", length) + whole[12:])
        with pytest.raises(CheckpointError):
            Volume.load(path)
        forge(path, whole[: 12 + size] + struct.pack("<I", length) + whole[16 + size :])
        with pytest.raises(CheckpointError):
            Volume.load(path)
    forge(path, whole[: 16 + size] + bytes(len(whole) - 16 - size))
    with pytest.raises(CheckpointError):
        Volume.load(path)


def without_reach_behind(path: Path) -> None:
    """Let a saved map be one of a version that knew no `min_behind`: its rays reached as far as before."""
    whole = path.read_bytes()[:-16]
    size = int.from_bytes(whole[8:12], "little")
    header = msgspec.msgpack.decode(whole[12 : 12 + size])
    del header["config"]["min_behind"]
    altered = msgspec.msgpack.encode(header)
    forge(path, whole[:8] + struct.pack("<I", len(altered)) + altered + whole[12 + size :])


def test_a_map_of_rays_that_reached_as_far_behind_goes_on_so(tmp_path: Path) -> None:
    symmetric, usual = small(min_behind=16), small()
    assert symmetric.map_hash() != usual.map_hash()
    path = symmetric.save(tmp_path / "map.tsf")
    without_reach_behind(path)
    loaded = Volume.load(path)
    assert loaded.config.min_behind == 16
    for either in (symmetric, loaded):
        either.integrate(VIEWS[3])
        either.retract(VIEWS[0])
    assert loaded.map_hash() == symmetric.map_hash()
    again = Volume.load(loaded.save(tmp_path / "again.tsf"))
    assert (again.config.min_behind, again.map_hash()) == (16, symmetric.map_hash())
    assert Volume.load(usual.save(tmp_path / "usual.tsf")).config.min_behind is None


def test_blocks_that_are_empty_or_out_of_order_are_refused(tmp_path: Path) -> None:
    volume = small()
    store = volume._store
    keys, layers = store.keys, {name: layer[: store.count] for name, layer in store.layers().items()}
    header = checkpoint.CheckpointHeader(
        config=volume.config, keyframes=3, map_hash="", layers=list(layers), meta={}
    )
    order = np.argsort(keys)
    for slots in (order[::-1], np.append(order[:3], order[2])):
        digest = begin_hash(volume.config.voxel_size)
        path = checkpoint.write(tmp_path / "a.tsf", header, keys[slots], slots, layers, map_digest=digest)
        with pytest.raises(DamagedCheckpoint, match="out of order"):
            Volume.load(path)
    layers["sums"] = np.zeros_like(layers["sums"])
    path = checkpoint.write(tmp_path / "a.tsf", header, keys[order], order, layers)
    with pytest.raises(DamagedCheckpoint, match="empty"):
        Volume.load(path)


@pytest.mark.skipif(sys.platform != "linux", reason="other systems do not limit memory")
@pytest.mark.parametrize(
    ("part", "message"),
    [
        ("blocks", "it claims .* blocks"),
        ("layers", "is of another version: it has layers"),
        ("fewer blocks", "a chunk has another size than expected"),
        ("cut chunk", "a chunk ends .* bytes early"),
        ("length", "is cut short"),
        ("window", "is damaged: .*memory"),
        ("hash", "says its map hash is 0+, its content has"),
    ],
)
def test_each_part_of_a_forged_file_is_checked(saved: Path, tmp_path: Path, part: str, message: str) -> None:
    whole, path = saved.read_bytes()[:-16], tmp_path / "map.tsf"
    size = int.from_bytes(whole[8:12], "little")
    header = msgspec.msgpack.decode(whole[12 : 12 + size], type=checkpoint.CheckpointHeader)
    frame = bytearray(whole[16 + size :])
    length = len(frame)
    assert not frame[4] & 0x20  # else it has no window of its own
    if part == "blocks":
        header.blocks = header.config.max_blocks + 1
    elif part == "layers":
        header.layers = ["sums", "sums2"]
    elif part == "fewer blocks":
        header.blocks -= 1
    elif part == "cut chunk":
        del frame[-1000:]
        length = len(frame)
    elif part == "length":
        length = 2**32 - 1
    elif part == "hash":
        header.map_hash = "0" * len(header.map_hash)
    else:
        frame[5] = 27 - 10 << 3  # 128 MB
    altered = msgspec.msgpack.encode(header)
    forge(path, b"".join([whole[:8], _lengthy(altered), struct.pack("<I", length), frame]))
    with memory_limited(256 << 20), pytest.raises(CheckpointError, match=message):
        Volume.load(path)
    if part in ("blocks", "layers"):  # of the header: before anything is made of it
        with pytest.raises(CheckpointError, match=message), checkpoint.reading(path):
            pass


def _lengthy(content: bytes) -> bytes:
    return struct.pack("<I", len(content)) + content


def test_a_map_of_another_version_or_that_cannot_be_read_now_is_not_damaged(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, path = saved.read_bytes()[:-16], tmp_path / "map.tsf"
    forge(path, b"TSFMAP2\n" + whole[8:])
    with pytest.raises(CheckpointError, match="not a tsfusion map of version 1") as raised:
        Volume.load(path)
    assert raised.type is CheckpointError
    altered = msgspec.msgpack.encode({"blocks": 3})
    forge(path, whole[:8] + struct.pack("<I", len(altered)) + altered)
    with pytest.raises(CheckpointError, match="of another version") as raised:
        Volume.load(path)
    assert raised.type is CheckpointError
    for error in (OSError(errno.EMFILE, "Too many open files"), OSError(errno.EIO, "bad"), MemoryError()):
        monkeypatch.setattr(checkpoint, "_check_digest", failing(error))
        with pytest.raises(CheckpointError) as raised:
            Volume.load(saved)
        assert raised.type is CheckpointError


def failing(error: Exception) -> Callable[..., Any]:
    def fail(*_: object) -> None:
        raise error

    return fail


def test_a_missing_file_and_an_unwritable_place_are_named(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"none\.tsf"):
        Volume.load(tmp_path / "none.tsf")
    with pytest.raises(CheckpointError, match="cannot write"):
        small().save(tmp_path / "missing" / "map.tsf")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("call", ["fsync", "replace"])
@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EROFS])
def test_a_failed_save_keeps_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, code: int
) -> None:
    volume = small()
    path = volume.save(tmp_path / "map.tsf")
    before = path.read_bytes()
    volume.integrate(VIEWS[3])

    with monkeypatch.context() as patched:
        patched.setattr(os, call, failing(OSError(code, os.strerror(code))))
        with pytest.raises(CheckpointError, match=os.strerror(code)):
            volume.save(path)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]
    volume.save(path)
    assert Volume.load(path).map_hash() == volume.map_hash()


SAVES = """
import hashlib, os, signal, struct, sys
from pathlib import Path
import numpy as np
from tsfusion import VolumeConfig
from tsfusion.tsdf.files import checkpoint

path, numbers = Path(sys.argv[1]), np.arange(3000, dtype=np.int64)

def save(number):
    known = {"config": VolumeConfig(), "map_hash": "", "layers": ["sums"], "meta": {}}
    header = checkpoint.CheckpointHeader(keyframes=number, **known)
    sums = np.full((3000, 512), number, np.int64)
    checkpoint.write(path, header, numbers, numbers, {"sums": sums}, map_digest=hashlib.blake2b())

def saved():
    with checkpoint.reading(path) as (header, chunks):
        sums = np.empty((checkpoint.CHUNK, 512), np.int64)
        for chunk in chunks:
            chunk.fill(np.empty(chunk.blocks, np.int64))
            chunk.fill(sums[: chunk.blocks])
            assert (sums[: chunk.blocks] == header.keyframes).all()
        return header.keyframes

def counting(real):
    def called(*arguments, **options):
        global left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*arguments, **options)
    return called

save(1)
for left in range(1, 100):
    pid = os.fork()
    if not pid:
        struct.pack = counting(struct.pack)  # before each part of the file
        for name in ("open", "fsync", "replace", "unlink"):
            setattr(os, name, counting(getattr(os, name)))
        save(2)
        os._exit(0)
    if not os.WIFSIGNALED(os.waitpid(pid, 0)[1]):
        break
    print(saved())
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_save_that_is_killed_anywhere_leaves_the_file_before_or_the_new_one(tmp_path: Path) -> None:
    path = tmp_path / "map.tsf"
    done = python(SAVES, path)
    assert done.returncode == 0, done.stderr
    found = done.stdout.split()
    assert found == sorted(found)
    assert len(found) > 8
    assert set(found) == {"1", "2"}
    assert [path] == list(tmp_path.iterdir())  # no part is left by the save that went well


def test_a_disk_that_really_fills_up_keeps_the_old_file(small_disk: Callable[[int], Path]) -> None:
    path = small_disk(2) / "map.tsf"

    def save(blocks: int) -> None:
        keys = np.arange(blocks, dtype=np.int64)
        sums = np.random.default_rng(0).integers(0, 1 << 40, (blocks, 512))
        known = {"config": VolumeConfig(), "map_hash": "", "layers": ["sums"], "meta": {}}
        header = checkpoint.CheckpointHeader(keyframes=blocks, **known)
        checkpoint.write(path, header, keys, keys, {"sums": sums})

    save(100)
    before = path.read_bytes()
    with pytest.raises(CheckpointError, match="No space left on device"):
        save(2000)
    assert path.read_bytes() == before
    assert [path] == list(path.parent.iterdir())
    save(120)
    with checkpoint.reading(path) as (header, _):
        assert header.keyframes == 120


def test_a_loaded_map_knows_how_full_its_voxels_are(tmp_path: Path) -> None:
    (view,) = sphere_views(0.4, 1)
    volume = volume_of([view])
    slot, voxel = np.argwhere(volume._store.sums != 0)[0]
    volume._store.sums[slot, voxel] |= (1 << 26) - 1
    loaded = Volume.load(volume.save(tmp_path / "full.tsf"))
    with pytest.raises(WeightOverflow):
        loaded.integrate(view)


def test_a_saved_map_can_be_read_with_another_surface_but_not_with_another_voxel_size(tmp_path: Path) -> None:
    path = volume_of(sphere_views(0.4, 1), surface="raw").save(tmp_path / "map.tsf")
    again, other = Volume.load(path), Volume.load(path, surface="field", min_weight=None)
    assert (again.config.surface, other.config.surface) == ("raw", "field")
    assert again.map_hash() == other.map_hash()
    assert not np.array_equal(again.extract_mesh().vertices, other.extract_mesh().vertices)
    with pytest.raises(InvalidConfig, match="voxel_size"):
        Volume.load(path, voxel_size=0.01)
