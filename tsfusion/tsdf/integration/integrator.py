# SPDX-License-Identifier: MIT
"""Add one keyframe's rays to the map, completely or not at all, and remove them.

Rays go directly into the map's sums. Only then can a keyframe prove unacceptable: its blocks find no room, or
a lane overflows. The same rays are then added with the opposite sign. This restores every byte, because the
sums are integers.
"""

from collections.abc import Iterator

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import KeyframeTooLarge, MapError, MapFull, MapQuota, WeightOverflow
from tsfusion.kernels.base import runtime
from tsfusion.kernels.base.sensor_noise import MAX_BUNDLE_WEIGHT, WEIGHT_ONE
from tsfusion.kernels.base.voxel_traversal import COST, DEFERRED, FAR_COST, SHARED, UPDATES, WEIGHT
from tsfusion.kernels.integration import integrate, ray_smoothing, space_carving
from tsfusion.kernels.integration.integrate import (
    ALL,
    ONLY_ADDED,
    ONLY_DEFERRED,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    TOUCHED_MISMATCH,
    TOUCHED_MISSING,
    TOUCHED_OVERFLOW,
    WEIGHT_LIMIT,
)
from tsfusion.tsdf.integration.ray_buffers import STRIPS, RayBuffers
from tsfusion.tsdf.store.block_store import BlockStore

PART_WEIGHT = WEIGHT_LIMIT  # reserve of a lane: no part can overflow it unnoticed

NO_LIMIT = 1 << 30  # blocks
BLOCK_COST = 1000  # cost of a new block: 9 µs, as its memory is touched for the first time
CARVED_COST = 100  # cost of a block that an image looks through: finding and adding take 2 µs

RayShare = tuple[int, int]  # strips first … last - 1


class KeyframeQuota(Struct, frozen=True):
    """Limits that a keyframe must keep to be added to the map.

    Attributes:
        cost: limit of the cost of rays (`voxel_traversal.write_ray`), carved blocks (100), new blocks (1000).
        blocks: limit of new blocks.
    """

    cost: int
    blocks: int = NO_LIMIT


class Integrator:
    """Writer of a map's sums on the CPU: adds and subtracts keyframes. No other code changes these sums."""

    def __init__(self, store: BlockStore, buffers: RayBuffers, config: VolumeConfig) -> None:
        self._store = store
        self._buffers = buffers
        self._config = config
        self._model = config.model()
        self._admitted = 0  # number of blocks to which the rays have been added
        self._room = 0  # new blocks that the sender's quota still allows
        self._affordable = 0  # new blocks that the cost limit still allows
        self._most_cost = NO_LIMIT  # limit of the cost of rays and new blocks
        self._has_carved = False  # True when its votes for free space are in the map
        self._has_cleared = False  # True when it counts in the blocks that it looks through
        self.units = min(runtime.threads(), STRIPS)  # units that add in parallel

    def apply(self, sign: int, quota: KeyframeQuota | None = None) -> int:
        """Add (+1) or subtract (-1) the rays of the current keyframe. Returns the number of voxel updates.

        Args:
            quota: limits of an added keyframe; None = only the map's limits.

        Raises:
            MapFull, WeightOverflow: when adding.
            MapError: when subtracting rays that the map does not hold. After each error the map is unchanged.
        """
        self._room = self._affordable = self._most_cost = NO_LIMIT
        if quota is not None and sign > 0:
            self._room, self._most_cost = quota.blocks, quota.cost
        before = self._admitted = self._store.count
        self._has_carved = self._has_cleared = False
        self._begin(sign)
        if not self._buffers.samples:  # a keyframe without a usable sample changes nothing
            self._buffers.carved.forget()
        added: list[RayShare] = []
        updates = 0
        try:
            if quota is not None and sign > 0:
                self._affordable = (quota.cost - self._check_cost(quota.cost)) // BLOCK_COST
            for part in self._parts():
                self._add(part, sign)  # Σ w·m and Σ w: paper eq. 2
                added.append(part)
                self._admit(part, sign)
                self._check(int(self._buffers.strips[part[0] : part[1], WEIGHT].sum()), sign)
                updates += int(self._buffers.strips[part[0] : part[1], UPDATES].sum())
            if len(self._buffers.carved):
                updates += self._carve(sign)
            if len(self._buffers.carved.clear):
                self._clear(sign)
            if self._model.regularizer != "off":
                self._smooth(sign)  # paper eq. 3
        except BaseException:
            self._take_back(added, sign, before)
            raise
        finally:
            self._store.keep_within_memory()
        return updates

    def _take_back(self, added: list[RayShare], sign: int, before: int) -> None:
        """Undo the parts already added after a failure; the map had `before` blocks."""
        if self._store.count > self._admitted:  # blocks that are still empty
            self._store.drop(self._admitted)
        if self._has_cleared:
            self._clear(-sign)
        if self._has_carved:
            self._add_free(self._store.slots_of(self._buffers.carved.keys), -sign)
        for part in added:
            self._launch(part, -sign, which=ONLY_ADDED)
        self._buffers.forget_missing()
        if self._store.count > before:
            self._store.drop(before)

    @property
    def _vote(self) -> int:
        """Kind of vote that a ray adds to the voxel at its end: colour, hit, or none."""
        if self._buffers.colored:
            return integrate.COLOR_VOTE
        return integrate.HIT_VOTE if self._store.counts_hits else integrate.NO_VOTE

    def _begin(self, sign: int) -> None:
        """Start a keyframe: empty the list of touched blocks. `sign` is +1 for additions, -1 for removals."""
        self._store.version += 1
        self._buffers.touched[:TOUCHED_HEADER] = 0
        self._buffers.reserve_touched(self._store.count)
        self._buffers.share_out(self.units)

    def _parts(self) -> Iterator[RayShare]:
        """Yield runs of strips so light that sums cannot overflow; nearly always one run of all strips."""
        weights = np.cumsum(self._buffers.strips[:, WEIGHT], dtype=np.int64)  # up to each strip
        first = 0
        while first < len(weights):
            before = int(weights[first - 1]) if first else 0
            end = int(np.searchsorted(weights, before + PART_WEIGHT))  # first strip that exceeds the weight
            yield first, max(end, first + 1)
            first = max(end, first + 1)

    def _add(self, part: RayShare, sign: int) -> None:
        """Add a part of the rays to the map's blocks, and collect the missing blocks up to a limit."""
        buffers = self._buffers
        most = self._most_missing()
        self._launch(part, sign, most_missing=min(most, buffers.most_missing))
        if buffers.touched[TOUCHED_OVERFLOW] and buffers.most_missing < most:
            self._launch(part, -sign, which=ONLY_ADDED)
            buffers.grow_missing(most)
            self._launch(part, sign, most_missing=most)

    def _most_missing(self) -> int:
        """Return how many more missing blocks the current keyframe may have."""
        config, touched = self._config, int(self._buffers.touched[TOUCHED_COUNT])
        room = min(config.max_blocks - self._store.count, self._room, self._affordable)
        return max(min(room, config.max_blocks_per_keyframe - touched), 0)

    def _admit(self, part: RayShare, sign: int) -> None:
        """Insert the blocks that the map lacked, and add to them the rays that were deferred."""
        store, buffers = self._store, self._buffers
        if not buffers.strips[part[0] : part[1], DEFERRED].any():
            self._limit(int(buffers.touched[TOUCHED_COUNT]))
            return
        touched, missing = (int(buffers.touched[place]) for place in (TOUCHED_COUNT, TOUCHED_MISSING))
        if sign < 0:
            raise MapError(
                f"cannot retract a keyframe the map does not hold ({missing} blocks are missing, or more)"
            )
        self._limit(touched + missing)
        self._check_room(missing)
        if buffers.touched[TOUCHED_OVERFLOW]:
            raise KeyframeTooLarge("the keys of this keyframe's blocks collide: it is not of a real sensor")
        keys = buffers.take_missing()
        oldest = store.count
        buffers.reserve_touched(oldest + len(keys))
        self._insert(keys)
        self._launch(part, +1, which=ONLY_DEFERRED, oldest=oldest)
        self._note_admitted(len(keys))

    def _note_admitted(self, blocks: int) -> None:
        self._admitted = self._store.count
        self._room -= blocks
        self._affordable -= blocks

    def _insert(self, keys: NDArray[np.int64]) -> None:
        self._store.insert(keys)

    def _check_cost(self, most: int) -> int:
        """Return the cost of the keyframe's rays. Raises KeyframeTooLarge above `most`, its limit."""
        cost = int(self._buffers.strips[:, COST].sum(dtype=np.int64))
        cost += CARVED_COST * len(self._buffers.carved)
        if cost > most:
            raise KeyframeTooLarge(
                f"the rays of a keyframe may cost at most quota_cost = {most}, these cost {cost} (1 for each "
                f"voxel that a ray crosses, or {FAR_COST} far from the ray before; {CARVED_COST} for each "
                "block that an image carves); use bundle=True, raise voxel_size, or send fewer points"
            )
        return cost

    def _check_room(self, missing: int) -> None:
        """Raise for a keyframe that needs more new blocks than the map or its sender's quota allows."""
        count, most = self._store.count, self._config.max_blocks
        if count + missing > most:
            raise MapFull(
                f"the map may hold at most max_blocks = {most} blocks; "
                f"it has {count} and this keyframe needs at least {missing} more"
            )
        if missing > self._affordable:
            raise KeyframeTooLarge(
                f"the keyframe needs {missing} new blocks or more, which is above its quota_cost (a new "
                f"block costs {BLOCK_COST}); raise voxel_size or quota_cost, or send fewer points"
            )
        if missing > self._room:
            raise MapQuota(
                f"the keyframe's sender may add {max(self._room, 0)} more blocks to this map (quota_map), "
                f"and the keyframe needs at least {missing}"
            )

    def _limit(self, blocks: int) -> None:
        if blocks > self._config.max_blocks_per_keyframe:
            raise KeyframeTooLarge(
                f"a keyframe may touch at most max_blocks_per_keyframe = "
                f"{self._config.max_blocks_per_keyframe} blocks, this one touches {blocks} or more; "
                "check its depth scale, or raise voxel_size"
            )

    def _carve(self, sign: int) -> int:
        """Add free-space votes to voxels that the keyframe's image looks through. Returns their number."""
        store, buffers = self._store, self._buffers
        carved, touched = buffers.carved, int(buffers.touched[TOUCHED_COUNT])
        self._limit(max(len(carved), touched))
        slots = store.slots_of(carved.keys)
        missing = np.sort(carved.keys[slots < 0])
        if len(missing) and sign < 0:
            raise MapError(
                f"cannot retract a keyframe the map does not hold ({len(missing)} blocks are missing)"
            )
        there = slots[slots >= 0]
        count = touched + int(np.count_nonzero(store.versions[there] != store.version)) + len(missing)
        self._limit(count)
        if len(missing):
            self._check_room(len(missing))
            self._insert(missing)
            slots = store.slots_of(carved.keys)
        buffers.reserve_touched(store.count)
        self._add_free(slots, sign)
        self._has_carved = True
        self._note_admitted(len(missing))
        self._check(MAX_BUNDLE_WEIGHT, sign)
        return carved.voxels

    def _clear(self, sign: int) -> None:
        """Add `sign` to the counts of the blocks that the keyframe looks through completely."""
        most = min(self._config.max_blocks, max(self._store.most_blocks, 0))
        self._store.clear.add(self._buffers.carved.clear, sign, most, self._store.version)
        self._has_cleared = True

    def _add_free(self, slots: NDArray[np.int32], sign: int) -> None:
        """Add the free-space votes of the carved blocks, which are in these slots."""
        store, buffers = self._store, self._buffers
        space_carving.add_free_blocks(
            slots, buffers.carved.amounts, buffers.carved.masks, sign, store.version, store.versions,
            store.places, buffers.touched, store.sums,
        )  # fmt: skip

    def _check(self, most: int, sign: int) -> None:
        """Raise if a voxel's sum is out of its range, after additions of at most `most` in weight.

        The bounds of blocks grow by the largest possible addition. Voxels are read only in blocks whose bound
        reaches the limit.
        """
        store, slots = self._store, self._buffers.touched_slots
        if sign > 0:
            bounds = store.bounds[slots]
            if int(bounds.max(initial=0)) + most < WEIGHT_LIMIT:
                store.bounds[slots] = bounds + most
                return
        self._measure_touched()
        bad = int(np.count_nonzero(store.bounds[slots] >= WEIGHT_LIMIT))
        if sign < 0 and (bad or self._buffers.touched[TOUCHED_MISMATCH]):
            what = f"{bad} blocks disagree" if bad else "its colours are not there"
            raise MapError(f"cannot retract a keyframe the map does not hold ({what})")
        if bad:
            raise WeightOverflow(
                f"{bad} blocks hold voxels that have taken all the votes their integers hold "
                f"({WEIGHT_LIMIT / WEIGHT_ONE:.0f} full samples), as after standing still: leave out "
                "keyframes of one place (replay --stride, scan --max-rate), or make a map of smaller voxels "
                "(--voxel-size)" + ("" if self._config.bundle else ", or with bundle=True")
            )

    def _measure_touched(self) -> None:
        integrate.largest_weights(self._store.sums, self._buffers.touched, self._store.bounds)

    def _smooth(self, sign: int) -> None:
        """Update the layer `correction` (smoothing along rays) in the blocks that the keyframe touched."""
        if sign < 0:
            self._forget_smoothed()
        else:
            self._smooth_touched()

    def _forget_smoothed(self) -> None:
        self._store.correction[self._buffers.touched_slots] = 0

    def _smooth_touched(self) -> None:
        """Smooth the map along each ray of the keyframe: paper eq. 3."""
        s, store, model = self._buffers, self._store, self._model
        s.reserve_votes()
        weighted = model.regularizer == "ray"
        sums, correction, votes, voted = (
            layer.reshape(-1) for layer in (store.sums, store.correction, s.votes, s.voted)
        )
        voted[0] = 0
        try:
            ray_smoothing.smooth_rays(
                s.rays, s.strips, self.units, store.hash_keys, store.hash_slots, s.scratch, store.places,
                model.smoothness, int(weighted), int(model.feedback or not weighted), sums, correction,
                s.signal, s.crossed, votes, voted,
            )  # fmt: skip
            ray_smoothing.commit_votes(s.touched, sums, votes, voted, correction)
        except BaseException:  # no vote of this keyframe may count for the next keyframe
            listed = voted[1 : 1 + voted[0]]
            votes[listed[listed != ray_smoothing.NO_VOXEL]] = 0
            raise

    def _launch(
        self, part: RayShare, sign: int, *, which: int = ALL, oldest: int = 0, most_missing: int = NO_LIMIT
    ) -> None:
        """Run the kernel that adds a part's rays, `which` of them, to the blocks with slots ≥ `oldest`."""
        store, buffers = self._store, self._buffers
        job = which, *part, self.units, sign, oldest, most_missing, store.version, self._vote
        arguments = (
            buffers.rays, buffers.strips, buffers.again, np.array(job, np.int32), store.hash_keys,
            store.hash_slots, buffers.missing, buffers.scratch, buffers.owners, store.versions, store.places,
            buffers.touched, store.sums.reshape(-1), store.color_rgn.reshape(-1),
            (store.hits if self._vote == integrate.HIT_VOTE else store.color_b).reshape(-1),
        )  # fmt: skip
        integrate.add_rays(*arguments)
        if self.units > 1 and buffers.strips[part[0] : part[1], SHARED].any():
            integrate.add_shared_rays(*arguments)
