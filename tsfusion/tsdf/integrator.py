# SPDX-License-Identifier: MIT
"""Adds the rays of one keyframe to the map, all or none of them, or takes them away again.

Rays go straight into the map's sums. Whether a keyframe is acceptable (there is room for its blocks, no
lane overflows) shows during or after that; if it is not, the same rays are added with the opposite sign,
which restores every byte, because the sums are integers.
"""

from collections.abc import Iterator

import numpy as np

from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import MapError, MapFull, WeightOverflow
from tsfusion.kernels import integrate, ray_smoothing
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

PART_WEIGHT = WEIGHT_LIMIT  # what a lane has in reserve: no part can make one overflow unnoticed

Part = tuple[int, int]  # bands first … last - 1


class Integrator:
    """The one writer of a map's sums."""

    def __init__(self, store: BlockStore, buffers: RayBuffers, config: VolumeConfig) -> None:
        self._store = store
        self._buffers = buffers
        self._config = config
        self._model = config.model()
        self._stamp = 0
        self._admitted = 0  # blocks of the map that deferred rays have been added to

    def apply(self, sign: int) -> int:
        """Add (+1) or take away (-1) the rays in the buffers; returns the number of voxel updates.

        Raises:
            MapFull, WeightOverflow: when adding; MapError: when taking away what is not there. The map is as
                it was.
        """
        before = self._admitted = self._store.count
        self._begin()
        added: list[Part] = []
        updates = 0
        try:
            for part in self._parts():
                self._add(part, sign)  # Σ w·m and Σ w: paper eq. 2
                added.append(part)
                self._admit(part, sign)
                self._check(part, sign)
                updates += int(self._buffers.bands[part[0] : part[1], UPDATES].sum())
            if self._model.regularizer != "off":
                self._smooth(sign)  # paper eq. 3
        except BaseException:
            self._take_back(added, sign, before)
            raise
        return updates

    def _take_back(self, added: list[Part], sign: int, before: int) -> None:
        """Bring back the map of `before` blocks, whatever failed."""
        if self._store.count > self._admitted:  # blocks that nothing was added to yet
            self._store.drop(self._admitted)
        for part in added:
            self._launch(part, -sign)
        self._buffers.forget_missing()
        if self._store.count > before:
            self._store.drop(before)

    def _begin(self) -> None:
        """Empty the list of touched blocks."""
        self._stamp += 1
        self._buffers.touched[:TOUCHED_HEADER] = 0
        self._buffers.reserve_touched(self._store.count)

    def _parts(self) -> Iterator[Part]:
        """Bands in runs of limited weight; nearly always all of them."""
        weights = self._buffers.bands[:, WEIGHT].astype(np.int64)
        first = 0
        for band in range(1, BANDS):
            if weights[first : band + 1].sum() >= PART_WEIGHT:
                yield first, band
                first = band
        yield first, BANDS

    def _add(self, part: Part, sign: int) -> None:
        """Add a part to the blocks the map has, and list the missing ones."""
        buffers = self._buffers
        self._launch(part, sign)
        while buffers.touched[TOUCHED_OVERFLOW]:
            self._launch(part, -sign)
            buffers.grow_missing()
            self._limit(len(buffers.missing) // 8)
            self._launch(part, sign)

    def _admit(self, part: Part, sign: int) -> None:
        """Insert the missing blocks into the map, and add the deferred rays to them."""
        store, buffers = self._store, self._buffers
        if not buffers.bands[part[0] : part[1], DEFERRED].any():
            self._limit(int(buffers.touched[TOUCHED_COUNT]))
            return
        keys = buffers.take_missing()
        if sign < 0:
            raise MapError(
                f"cannot retract a keyframe the map does not hold ({len(keys)} blocks are missing)"
            )
        self._limit(int(buffers.touched[TOUCHED_COUNT]) + len(keys))
        if store.count + len(keys) > self._config.max_blocks:
            raise MapFull(
                f"the map may hold at most max_blocks = {self._config.max_blocks} blocks; "
                f"it has {store.count} and this keyframe needs {len(keys)} more"
            )
        oldest = store.count
        buffers.reserve_touched(oldest + len(keys))
        store.insert(keys)
        self._launch(part, +1, only_deferred=True, oldest=oldest)
        self._admitted = store.count

    def _limit(self, blocks: int) -> None:
        """Refuse a keyframe that touches too many blocks."""
        if blocks > self._config.max_blocks_per_keyframe:
            raise MapFull(
                f"a keyframe may touch at most max_blocks_per_keyframe = "
                f"{self._config.max_blocks_per_keyframe} blocks, this one touches {blocks} or more; "
                "check its depth scale, or raise voxel_size"
            )

    def _check(self, part: Part, sign: int) -> None:
        """Refuse a part after which a lane has left its range.

        The blocks' bounds grow by all that the part could add; only where they reach the limit are the voxels
        themselves read.
        """
        store, slots = self._store, self._buffers.touched_slots
        if sign > 0:
            most = int(self._buffers.bands[part[0] : part[1], WEIGHT].sum())
            bounds = store.bounds[slots].astype(np.int64) + most
            if not len(slots) or int(bounds.max()) < WEIGHT_LIMIT:
                store.bounds[slots] = bounds
                return
        integrate.largest_weights(store.sums, self._buffers.touched, store.bounds)
        bad = int(np.count_nonzero(store.bounds[slots] >= WEIGHT_LIMIT))
        if sign < 0 and (bad or self._buffers.touched[TOUCHED_MISMATCH]):
            what = f"{bad} blocks disagree" if bad else "its colours are not there"
            raise MapError(f"cannot retract a keyframe the map does not hold ({what})")
        if bad:
            raise WeightOverflow(
                f"{bad} blocks hold voxels that have taken all the votes their integers hold "
                f"({WEIGHT_LIMIT / WEIGHT_ONE:.0f} full samples); use bundle=True or a smaller voxel_size"
            )

    def _smooth(self, sign: int) -> None:
        """Bring the regularised layer up to date in the blocks just touched: paper eq. 3 along each ray."""
        s, store, model = self._buffers, self._store, self._model
        if sign < 0:
            store.correction[s.touched_slots] = 0
            return
        s.reserve_votes()
        weighted = model.regularizer == "ray"
        ray_smoothing.smooth_rays(
            s.rays, s.bands, store.hash_keys, store.hash_slots, store.places, model.smoothness, int(weighted),
            int(model.feedback or not weighted), store.sums, store.correction, s.signal, s.crossed, s.votes,
        )  # fmt: skip
        ray_smoothing.commit_votes(s.touched, store.sums, s.votes, store.correction)

    def _launch(self, part: Part, sign: int, *, only_deferred: bool = False, oldest: int = 0) -> None:
        """Add a part's rays to the blocks of slot ≥ `oldest`."""
        store, buffers = self._store, self._buffers
        integrate.add_rays(
            buffers.rays, buffers.bands, buffers.deferred, int(only_deferred), *part, sign, oldest,
            store.hash_keys, store.hash_slots, buffers.missing, self._stamp, store.stamps, store.places,
            store.dirty, buffers.touched, store.sums, int(buffers.colored), store.color_rgn, store.color_b,
        )  # fmt: skip
