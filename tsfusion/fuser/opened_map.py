# SPDX-License-Identifier: MIT
"""A map that is open and that nothing is done with yet: its checkpoint is read, its kernels are compiled."""

from collections.abc import Iterator
from pathlib import Path

from tsfusion.core import process
from tsfusion.core.config import VolumeConfig
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.fuser.messages import Begin

_WORKING_MEMORY = 768 << 20  # bytes for keyframes and meshes, beyond those of the map


class OpenedMap:
    """The map in the folder of a `Begin`.

    Attributes:
        checkpoints: the map, and where it is saved.
        memory_limit: of the process, bytes.
        warming: the kernels that no keyframe needs, which are not compiled yet.

    Raises:
        TsfusionError, MemoryError: as `MapCheckpoints`.
    """

    def __init__(self, begin: Begin) -> None:
        from tsfusion.kernels import runtime

        runtime.start(begin.volume.threads)  # it reserves a GB, and more for each thread, and hardly uses it
        self.memory_limit = process.data_bytes() + _WORKING_MEMORY + begin.memory_bytes
        process.limit_memory(self.memory_limit)
        # A map of any size opens, as long as there is memory; from then on it may not outgrow its own.
        self.checkpoints = MapCheckpoints(
            Path(begin.folder),
            begin.volume,
            keep_previous=begin.keep_previous,
            kept={"memory_bytes": begin.memory_bytes, "cache": begin.cache} if begin.cache else {},
        )
        volume = self.checkpoints.volume
        self.warming: Iterator[None] = volume.warming_up()
        next(self.warming, None)
        volume.limit_memory(begin.memory_bytes)


def warm(config: VolumeConfig) -> None:
    """Compile all kernels of maps with these settings: such a map opens at once then."""
    from tsfusion.kernels import runtime
    from tsfusion.tsdf.volume import Volume

    runtime.start(config.threads)
    Volume(config).warm_up()
