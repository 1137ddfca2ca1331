# SPDX-License-Identifier: MIT
"""A fuser whose map is one number: the sum of its keyframes' digests. It starts without Taichi, in a moment.

All that reaches disk and gateway is the real fuser's; like the real map this one is exact, does not depend on
the order, and tells a keyframe that is missing or there twice.
"""

import hashlib
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import msgspec
import numpy as np

from tsfusion import Keyframe
from tsfusion.core import durable_files
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, MapFull
from tsfusion.geometry.mesh import Mesh

_NOTHING = np.zeros((0, 3), np.int32)
TOO_MUCH = 10**15  # `captured_ns` of a keyframe that this map rejects


def digest(keyframe: Keyframe) -> int:
    """A number for what travels losslessly of a keyframe."""
    assert keyframe.depth is not None
    parts = (keyframe.depth.tobytes(), np.float64(keyframe.T_world_camera).tobytes(), keyframe.timestamp_ns)
    return int.from_bytes(hashlib.blake2b(repr(parts).encode(), digest_size=16).digest())


def hash_of(keyframes: Iterable[Keyframe]) -> str:
    """The hash of a map of these keyframes."""
    return _hex(sum(map(digest, keyframes)))


def _hex(total: int) -> str:
    return f"{total % (1 << 128):032x}"


class Saved(msgspec.Struct):
    config: VolumeConfig
    keyframes: int
    total: str
    meta: dict[str, Any]


class SumMap:
    """As much of `Volume` as the fuser uses."""

    model = SimpleNamespace(surface="raw")
    most_blocks = 1
    quota = None  # nothing of it is used up
    version = 0  # it has no blocks that change

    def __init__(self, config: VolumeConfig, **_: object) -> None:
        self.config = config
        self.meta: dict[str, Any] = {}
        self.keyframes = 0
        self._total = 0

    def warming_up(self) -> Iterator[None]:
        """Compile nothing: there are no kernels."""
        return iter(())

    def warm_up(self) -> None:
        """Compile nothing, either."""

    @property
    def surface(self) -> Any:
        """A surface without cells, of which nothing is kept: there is no field."""
        nothing = SimpleNamespace(cells=_NOTHING, first_face=np.zeros(1, np.int32), mesh=self.extract_mesh())
        return SimpleNamespace(mesh_cells=lambda *_: nothing)

    def limit_memory(self, nbytes: int) -> None:
        """Ignore the limit: sums take next to nothing."""

    def set_pause(self, pause: Callable[[], None]) -> None:
        """Nothing takes long."""

    def release_empty(self) -> int:
        """Release nothing: this map has no blocks."""
        return 0

    def integrate(self, keyframe: Keyframe) -> Any:
        if keyframe.captured_ns == TOO_MUCH:
            raise MapFull("the keyframe asks to be rejected")
        self._total += digest(keyframe)
        self.keyframes += 1
        return SimpleNamespace(samples=1, new_blocks=0)

    def retract(self, keyframe: Keyframe) -> None:
        self._total -= digest(keyframe)
        self.keyframes -= 1

    def take_dirty(self) -> Any:
        return _NOTHING

    def extract_mesh(self, *_: object, **__: object) -> Mesh:
        return Mesh(np.zeros((0, 3), np.float32), _NOTHING, np.zeros((0, 3), np.float32))

    def map_hash(self) -> str:
        return _hex(self._total)

    color_hash = map_hash
    size = (0, 0)

    def stats(self) -> Any:
        return SimpleNamespace(blocks=0, bytes=0, voxels=0)

    def save(self, path: Path, meta: dict[str, Any] | None = None) -> Path:
        saved = Saved(self.config, self.keyframes, self.map_hash(), self.meta if meta is None else meta)
        content = msgspec.msgpack.encode(saved)
        try:
            with durable_files.replacing(path) as file:
                file.write(content + hashlib.blake2b(content).digest())
        except OSError as error:
            raise CheckpointError(f"cannot write the map {path}: {error.strerror}") from error
        return path

    @classmethod
    def load(cls, path: Path, threads: int | None = None, **_: object) -> "SumMap":
        try:
            content = path.read_bytes()
        except OSError as error:
            missing = isinstance(error, FileNotFoundError)
            raise CheckpointError(f"cannot read the map {path}: {error.strerror}", missing=missing) from error
        if hashlib.blake2b(content[:-64]).digest() != content[-64:]:
            raise DamagedCheckpoint(f"{path} is cut short or altered")
        saved = msgspec.msgpack.decode(content[:-64], type=Saved)
        made = cls(saved.config)
        made.keyframes, made._total, made.meta = saved.keyframes, int(saved.total, 16), saved.meta
        return made


def take_the_place_of_volume() -> None:
    """Have this process's fuser make such maps."""
    for name, its in (
        ("tsdf.volume", {"Volume": SumMap}),
        ("tsdf.integration.integrator", {"KeyframeQuota": lambda *limits: limits}),
        ("kernels.base.runtime", {"start": lambda _: None}),
    ):
        module = ModuleType(name)
        vars(module).update(its)
        sys.modules[f"tsfusion.{name}"] = module
