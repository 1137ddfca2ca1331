# SPDX-License-Identifier: MIT
"""Adds the rays of one keyframe to the map, all or none of them, or takes them away again.

Rays go straight into the map's sums. What would make a keyframe unacceptable (no room for its blocks, a
lane that overflows) shows during or after that; the same rays are then added with the opposite sign, which
restores every byte, because the sums are integers.
"""

from collections.abc import Callable, Iterator

import numpy as np

from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import MapError, MapFull, WeightOverflow
from tsfusion.kernels import integrate
from tsfusion.kernels.integrate import (
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    TOUCHED_MISMATCH,
    TOUCHED_OVERFLOW,
    WEIGHT_LIMIT,
)
from tsfusion.kernels.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.voxel_traversal import DEFERRED, UPDATES, WEIGHT
from tsfusion.tsdf.block_store import BlockStore
from tsfusion.tsdf.ray_buffers import BANDS, RayBuffers

PART_WEIGHT = WEIGHT_LIMIT  # a lane's reserve: within a part none can carry unnoticed

Part = tuple[int, int]  # bands first … last - 1


class Integrator:
    """The one writer of a map's sums."""

    def __init__(self, store: BlockStore, scratch: RayBuffers, config: VolumeConfig) -> None:
        self._store = store
        self._scratch = scratch
        self._config = config
        self._stamp = 0
        self._admitted = 0  # blocks of the map that deferred rays have been added to

    def apply(self, sign: int, after: Callable[[], None] = lambda: None) -> int:
        """Add (+1) or take away (-1) the scratch's rays; returns the number of voxel updates.

        Args:
            after: what else belongs to it; when it fails, the rays are taken back as well.

        Raises:
            MapFull, WeightOverflow: when adding; MapError: when taking away what is not there. The map is as
                it was.
        """
        before = self._admitted = self._store.count
        self._begin()
        done: list[Part] = []
        updates = 0
        try:
            for part in self._parts():
                self._add(part, sign)
                done.append(part)
                self._admit(part, sign)
                self._check(part, sign)
                updates += int(self._scratch.bands[part[0] : part[1], UPDATES].sum())
            after()
        except BaseException:
            if self._store.count > self._admitted:  # blocks that nothing was added to yet
                self._store.drop(self._admitted)
            for part in done:
                self._launch(part, -sign)
            self._scratch.take_missing()
            if self._store.count > before:
                self._store.drop(before)
            raise
        return updates

    def _begin(self) -> None:
        self._stamp += 1
        self._scratch.touched[:TOUCHED_HEADER] = 0
        self._scratch.reserve_touched(self._store.count)

    def _parts(self) -> Iterator[Part]:
        """Bands in runs of limited weight; nearly always all of them."""
        weights = self._scratch.bands[:, WEIGHT].astype(np.int64)
        first = 0
        for band in range(1, BANDS):
            if weights[first : band + 1].sum() >= PART_WEIGHT:
                yield first, band
                first = band
        yield first, BANDS

    def _add(self, part: Part, sign: int) -> None:
        """Add a part to the blocks the map has, and note the ones it lacks."""
        scratch = self._scratch
        self._launch(part, sign)
        while scratch.touched[TOUCHED_OVERFLOW]:
            self._launch(part, -sign)
            scratch.grow_missing()
            self._limit(len(scratch.missing) // 8)
            self._launch(part, sign)

    def _admit(self, part: Part, sign: int) -> None:
        """Give the missing blocks a place, and add what was deferred."""
        store, scratch = self._store, self._scratch
        if not scratch.bands[part[0] : part[1], DEFERRED].any():
            self._limit(int(scratch.touched[TOUCHED_COUNT]))
            return
        keys = scratch.take_missing()
        if sign < 0:
            raise MapError(
                f"cannot retract a keyframe the map does not hold ({len(keys)} blocks are missing)"
            )
        self._limit(int(scratch.touched[TOUCHED_COUNT]) + len(keys))
        if store.count + len(keys) > self._config.max_blocks:
            raise MapFull(
                f"the map may hold at most max_blocks = {self._config.max_blocks} blocks; "
                f"it has {store.count} and this keyframe needs {len(keys)} more"
            )
        oldest = store.count
        scratch.reserve_touched(oldest + len(keys))
        store.insert(keys)
        self._launch(part, +1, only_deferred=True, oldest=oldest)
        self._admitted = store.count

    def _limit(self, blocks: int) -> None:
        if blocks > self._config.max_blocks_per_keyframe:
            raise MapFull(
                f"a keyframe may touch at most max_blocks_per_keyframe = "
                f"{self._config.max_blocks_per_keyframe} blocks, this one touches {blocks} or more; "
                "check its depth scale, or raise voxel_size"
            )

    def _check(self, part: Part, sign: int) -> None:
        """No lane may have left its range. Bounds grow by all that the part could add, until they are too
        large to tell; then the blocks are looked at."""
        store, slots = self._store, self._scratch.touched_slots
        if sign > 0:
            most = int(self._scratch.bands[part[0] : part[1], WEIGHT].sum())
            bounds = store.bounds[slots].astype(np.int64) + most
            if not len(slots) or int(bounds.max()) < WEIGHT_LIMIT:
                store.bounds[slots] = bounds
                return
        integrate.largest_weights(store.sums, self._scratch.touched, store.bounds)
        bad = int(np.count_nonzero(store.bounds[slots] >= WEIGHT_LIMIT))
        if sign < 0 and (bad or self._scratch.touched[TOUCHED_MISMATCH]):
            what = f"{bad} blocks disagree" if bad else "its colours are not there"
            raise MapError(f"cannot retract a keyframe the map does not hold ({what})")
        if bad:
            raise WeightOverflow(
                f"{bad} blocks hold voxels that have taken all the votes their integers hold "
                f"({WEIGHT_LIMIT / WEIGHT_ONE:.0f} full samples); use bundle=True or a smaller voxel_size"
            )

    def _launch(self, part: Part, sign: int, *, only_deferred: bool = False, oldest: int = 0) -> None:
        store, scratch = self._store, self._scratch
        integrate.add_rays(
            scratch.rays, scratch.bands, scratch.deferred, int(only_deferred), *part, sign, oldest,
            store.hash_keys, store.hash_slots, scratch.missing, self._stamp, store.stamps, store.places,
            store.dirty, scratch.touched, store.sums, int(scratch.colored), store.color_rgn, store.color_b,
        )  # fmt: skip
