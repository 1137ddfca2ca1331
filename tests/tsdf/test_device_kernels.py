# SPDX-License-Identifier: MIT
"""The kernels of a device make the CPU's map; here they run on the CPU, in this process.

So they are tested where there is no device, and in ways that a device of another process cannot be brought
into. `test_device_map` has the processes, and devices.
"""

import ctypes
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from formula_scenes import sphere_views

from tsfusion import Keyframe, Volume
from tsfusion.core.errors import KeyframeTooLarge, MapFull, MapQuota
from tsfusion.kernels.base import runtime
from tsfusion.kernels.device import device_copies
from tsfusion.kernels.device.device_copies import APART, NEW, Copies, CudaCopies
from tsfusion.tsdf.device import device_blocks, device_integrator, device_map
from tsfusion.tsdf.integration.integrator import KeyframeQuota
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES

VIEWS = sphere_views(0.4, 4)
COLOR = np.random.default_rng(1).integers(0, 256, (*VIEWS[0].shape, 3), np.uint8)
CONFIDENCE = np.random.default_rng(2).integers(0, 256, VIEWS[0].shape, np.uint8)
IN_MILLIMETRES = [replace(v, depth=(v.depth * 1000).astype(np.uint16), depth_scale=0.001) for v in VIEWS]
KINDS = {
    "depth": VIEWS,
    "colour and confidence": [replace(v, color=COLOR, confidence=CONFIDENCE) for v in VIEWS],
    "millimetres": IN_MILLIMETRES,
    "disparity": [
        replace(v, depth=None, disparity=(900 / np.where(v.depth > 0, v.depth, 1e9)).astype(np.uint16),
                disparity_scale=1 / 16, baseline_fx=900 / 16)
        for v in VIEWS
    ],
    "points": [
        Keyframe(points=np.cumsum(random.normal(size=(500, 3)) / 50, axis=0).astype(np.float32) + 1,
                 T_world_camera=np.eye(4), color=random.integers(0, 256, (500, 3), np.uint8),
                 confidence=random.integers(0, 256, 500, np.uint8))
        for random in map(np.random.default_rng, range(3))
    ],
    "few points": [
        Keyframe(points=np.float32([[1, 0, 2], [1, 0, 2.01], [0, 1, 3]])[:count], T_world_camera=np.eye(4))
        for count in (3, 1)
    ],
    "points with starts": [
        Keyframe(points=random.normal(size=(200, 3)).astype(np.float32), T_world_camera=np.eye(4),
                 origins=random.normal(size=(200, 3)).astype(np.float32))
        for random in map(np.random.default_rng, range(3))
    ],
}  # fmt: skip


class FakeDriver:
    """Stands for libcuda where the device is this machine's memory; it counts what is copied to there."""

    def __init__(self) -> None:
        self.copied = 0
        self.pinned: list[int] = []
        self.fails = ""
        self._kept: list[Any] = []
        self._does = {
            "cuMemcpyHtoDAsync_v2": self._copy_there,
            "cuMemcpyDtoHAsync_v2": self._copy,
            "cuStreamSynchronize": lambda _: None,
            "cuMemAllocHost_v2": self._allocate,
            "cuMemHostRegister_v2": lambda address, _nbytes, _flags: self.pinned.append(address.value),
            "cuMemHostUnregister": lambda address: self.pinned.remove(address.value),
        }

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any) -> int:
            return 999 if name == self.fails else self._does[name](*arguments) or 0

        return call

    def _copy(self, to: Any, from_: Any, nbytes: Any, _stream: None) -> None:
        ctypes.memmove(to.value, from_.value, nbytes.value)

    def _copy_there(self, *arguments: Any) -> None:
        self._copy(*arguments)
        self.copied += arguments[2].value

    def _allocate(self, address: Any, nbytes: Any) -> None:
        self._kept.append((ctypes.c_uint8 * nbytes.value)())
        address._obj.value = ctypes.addressof(self._kept[-1])


class HereLink:
    """A `DeviceLink` whose device is this process."""

    arch = "vulkan"
    is_trusted = True

    def __init__(self, copies: Copies) -> None:
        self.copies = copies
        self.maps: list[device_map.DeviceMap] = []
        self.calls: list[str] = []

    def new_map(self, layers: tuple[str, ...]) -> int:
        self.maps.append(device_map.DeviceMap(layers, self.copies))
        return len(self.maps) - 1

    def forget_later(self, number: int) -> None:
        pass

    def call(self, number: int, verb: str, *arguments: Any, first: Any = ()) -> Any:
        for step, given in [*first, (verb, arguments)]:
            self.calls.append(step)
            if step == "read":
                found: Any = [self._rows(number, name, given[1]) for name in given[0]]
            else:
                found = getattr(self.maps[number], step)(*given)
        return [found] if isinstance(found, np.ndarray) else found

    def _rows(self, number: int, name: str, slots: Any) -> Any:
        rows = np.empty((len(slots), 512), LAYER_DTYPES[name])
        self.maps[number].read(name, slots, rows)
        return rows


@pytest.fixture(params=["Taichi", "CUDA"])
def link(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> HereLink:
    runtime.start(2)
    copies = Copies()
    if request.param == "CUDA":
        monkeypatch.setattr(ctypes, "CDLL", lambda _: FakeDriver())
        copies = CudaCopies()
    here = HereLink(copies)
    monkeypatch.setattr(device_integrator, "link_to", lambda arch: None if arch == "cpu" else here)
    return here


def both(**settings: Any) -> tuple[Volume, Volume]:
    maps = (
        Volume(**{"voxel_size": 0.05, **settings}),
        Volume(arch="vulkan", **{"voxel_size": 0.05, **settings}),
    )
    assert [one.arch for one in maps] == ["cpu", "vulkan"]
    return maps


def assert_equal(here: Volume, there: Volume) -> None:
    assert (here.map_hash(), here.color_hash()) == (there.map_hash(), there.color_hash())
    assert here.keyframes == 0 or here.map_hash() != Volume(0.05).map_hash()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    "settings", [{}, {"bundle": False, "outlier_filter": False}, {"space_carving": True}]
)
def test_maps_and_counts_are_those_of_the_cpu(link: HereLink, kind: str, settings: dict[str, Any]) -> None:
    here, there = both(**settings)
    for keyframe in KINDS[kind]:
        assert here.integrate(keyframe) == there.integrate(keyframe)
    assert_equal(here, there)
    assert sorted(here.take_dirty().tolist()) == sorted(there.take_dirty().tolist())
    for keyframe in KINDS[kind]:
        assert here.retract(keyframe) == there.retract(keyframe)
    assert_equal(here, there)


def test_a_keyframe_without_points_changes_nothing(link: HereLink) -> None:
    here, there = both()
    nothing = Keyframe(points=np.zeros((0, 3), np.float32), T_world_camera=np.eye(4))
    for keyframe in (VIEWS[0], nothing, VIEWS[1]):
        assert here.integrate(keyframe) == there.integrate(keyframe)
    assert here.keyframes == there.keyframes == 2
    assert_equal(here, there)


def test_a_keyframe_is_one_call(link: HereLink) -> None:
    _, there = both()
    there.integrate(VIEWS[0])
    link.calls.clear()
    assert there.integrate(VIEWS[1]).new_blocks > 0
    assert link.calls == ["fuse"]
    assert there.integrate(VIEWS[1]).new_blocks == 0
    assert link.calls == ["fuse", "fuse"]


def assert_hash_is_the_map_s(there: Volume, link: HereLink) -> None:
    """The device enters many blocks into its hash at once; each is where the host's, one by one, has it."""
    of_device, store = link.maps[-1], there._store
    assert (of_device._hash_keys.to_numpy() == store.hash_keys).all()
    used = store.hash_keys != 0
    assert (of_device._hash_slots.to_numpy()[used] == store.hash_slots[used]).all()


def test_many_new_blocks_are_one_call_and_have_the_places_of_the_map(link: HereLink) -> None:
    here, there = both(voxel_size=0.005)
    for keyframe in VIEWS:
        assert here.integrate(keyframe) == there.integrate(keyframe)
    assert link.calls == ["fuse"] * len(VIEWS)
    told = link.maps[-1]._told.to_numpy()
    assert 0 < told[APART] < told[NEW], "no two of them share a place"
    assert_hash_is_the_map_s(there, link)
    assert_equal(here, there)


@pytest.mark.parametrize("first", [16, 256])
def test_a_map_without_room_grows_by_more_calls(
    link: HereLink, monkeypatch: pytest.MonkeyPatch, first: int
) -> None:
    monkeypatch.setattr(device_blocks.DeviceBlocks, "first_blocks", first)
    for module in (device_map, device_blocks):
        monkeypatch.setattr(module, "FIRST_BLOCKS", first)
        monkeypatch.setattr(module, "FIRST_HASH", 4 * first)
    here, there = both(voxel_size=0.01)
    for keyframe in VIEWS:
        assert here.integrate(keyframe) == there.integrate(keyframe)
    assert link.calls.count("insert") > 0
    assert_hash_is_the_map_s(there, link)
    assert_equal(here, there)
    there.retract(VIEWS[1])
    here.retract(VIEWS[1])
    assert here.release_empty() == there.release_empty()
    assert here.integrate(VIEWS[2]) == there.integrate(VIEWS[2])
    assert_hash_is_the_map_s(there, link)
    assert_equal(here, there)


def test_a_missing_block_that_is_listed_twice_is_added_once(
    link: HereLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, there = both()
    of_device = link.maps[-1]
    read, doubled = of_device._read_results, []

    def read_doubled() -> Any:
        told, missing = read()
        if len(missing) and not doubled:
            doubled.append(len(missing))
            missing = np.concatenate([missing, missing[:3]])
        return told, missing

    monkeypatch.setattr(of_device, "_read_results", read_doubled)
    there.limit_memory(1 << 30)
    there.quota = KeyframeQuota(cost=1 << 29)
    monkeypatch.setattr(type(there._store), "spare", 0)  # so that blocks are told of, not admitted
    for keyframe in VIEWS:
        assert here.integrate(keyframe) == there.integrate(keyframe)
    assert doubled
    assert_equal(here, there)


@pytest.mark.parametrize("settings", [{}, {"space_carving": True}])
def test_updates_that_do_not_fit_into_the_list_are_made_in_runs(
    link: HereLink, settings: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_map, "_LISTED", 1000)
    monkeypatch.setattr(device_map, "_FEW_TOUCHED", 3)
    here, there = both(**settings)
    keyframes = KINDS["colour and confidence"]
    for keyframe in keyframes:
        assert here.integrate(keyframe) == there.integrate(keyframe)
    assert_equal(here, there)
    assert here.retract(keyframes[0]) == there.retract(keyframes[0])
    assert_equal(here, there)


def test_blocks_that_runs_find_missing_count_together(
    link: HereLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    needed = Volume(0.05).integrate(VIEWS[0]).blocks
    monkeypatch.setattr(device_map, "_LISTED", 500)
    here, there = both(max_blocks=needed - 1)
    for one in (here, there):
        with pytest.raises(MapFull):
            one.integrate(VIEWS[0])
        assert one.stats().blocks == 0


def test_parts_of_limited_weight_are_added_one_after_the_other(
    link: HereLink, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in ("integration.integrator", "device.device_integrator"):
        monkeypatch.setattr(f"tsfusion.tsdf.{module}.PART_WEIGHT", 5000)
    here, there = both()
    for keyframe in VIEWS:
        assert here.integrate(keyframe) == there.integrate(keyframe)
    assert link.calls.count("add") > len(VIEWS)
    assert_equal(here, there)


@pytest.mark.parametrize("settings", [{}, {"space_carving": True}])
def test_what_a_quota_refuses_is_taken_back(link: HereLink, settings: dict[str, Any]) -> None:
    _, there = both(**settings)
    there.integrate(VIEWS[0])
    before, blocks = there.map_hash(), there.stats().blocks
    refused = [
        (KeyframeQuota(cost=100), KeyframeTooLarge),  # its rays
        (KeyframeQuota(cost=5000), KeyframeTooLarge),  # and its new blocks
        (KeyframeQuota(cost=1 << 29, blocks=1), MapQuota),
    ]
    for quota, error in refused:
        there.quota = quota
        with pytest.raises(error):
            there.integrate(VIEWS[1])
        assert (there.map_hash(), there.stats().blocks) == (before, blocks)
    there.quota = KeyframeQuota(cost=1 << 29)
    assert there.integrate(VIEWS[1]).new_blocks > 1
    there.retract(VIEWS[1])
    assert there.map_hash() == before


@pytest.mark.parametrize("settings", [{}, {"space_carving": True}])
def test_a_full_map_stays_as_it_was(link: HereLink, settings: dict[str, Any]) -> None:
    room = Volume(0.05, **settings).integrate(VIEWS[0]).blocks
    here, there = both(max_blocks=room, **settings)
    for one in (here, there):
        one.integrate(VIEWS[0])
        with pytest.raises(MapFull):
            one.integrate(VIEWS[1])
    assert_equal(here, there)


def test_the_driver_copies_images_as_they_come_and_its_errors_are_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runtime.start(2)
    driver = FakeDriver()
    monkeypatch.setattr(ctypes, "CDLL", lambda _: driver)
    copies = CudaCopies()
    monkeypatch.setattr(device_integrator, "link_to", lambda _: HereLink(copies))
    there = Volume(0.05, arch="vulkan", color=False)
    there.integrate(IN_MILLIMETRES[0])
    driver.copied = 0
    there.integrate(IN_MILLIMETRES[0])
    image = VIEWS[0].shape[0] * VIEWS[0].shape[1] * 2
    assert image <= driver.copied < image + 4096
    large = np.zeros(3 << 20, np.uint8)
    assert [one.array.nbytes for one in copies.given(large, large[:3])] == [3 << 20, 3]
    for memory in (large, large[1:]):
        copies.pin(memory)
        assert driver.pinned == [memory.ctypes.data]
    driver.fails = "cuMemcpyHtoDAsync_v2"
    with pytest.raises(RuntimeError, match="cuMemcpyHtoDAsync_v2 of CUDA's driver failed with error 999"):
        there.integrate(VIEWS[0])


def test_without_a_driver_taichi_copies() -> None:
    runtime.start(2)
    assert type(device_copies.copies()) is Copies
