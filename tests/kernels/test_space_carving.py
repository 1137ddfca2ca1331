# SPDX-License-Identifier: MIT
"""The blocks that an image looks through are those that a slow twin finds, voxel by voxel."""

from dataclasses import replace
from typing import Any

import kernel_twins
import numpy as np
import pytest
from formula_scenes import CAMERA, SHAPE, look_at, plane_keyframe
from msgspec import structs
from numpy.typing import NDArray

from tsfusion import Intrinsics, Keyframe
from tsfusion.core.config import SensorModel
from tsfusion.kernels.base import runtime
from tsfusion.kernels.integration import space_carving
from tsfusion.tsdf.integration.carved_blocks import CarvedBlocks
from tsfusion.tsdf.integration.ray_buffers import _depth_scale, _optional, model_parameters
from tsfusion.tsdf.store.block_store import unpack_keys

VOXEL = 0.05
MODEL = SensorModel(sigma_floor=0.01, sigma_slope=0.004, sigma_z0=0.3, max_range=6.0)


def parameters(voxel_size: float = VOXEL, **settings: Any) -> NDArray[np.float64]:
    return model_parameters(MODEL, voxel_size, None, space_carving=True, **settings)


def found(
    keyframe: Keyframe, voxel_size: float = VOXEL, most: int = 1 << 17, **settings: Any
) -> CarvedBlocks:
    carved = CarvedBlocks()
    image = keyframe.measurement.astype(np.float32)
    read = (
        image,
        int(keyframe.kind == "disparity"),
        _depth_scale(keyframe),
        *_optional(keyframe.confidence, 2),
    )
    carved.find(keyframe, read, parameters(voxel_size, **settings), most)
    return carved


def voxels_of(carved: CarvedBlocks) -> dict[tuple[int, ...], int]:
    """(Σ w·m) · 2²⁷ + Σ w of each clear voxel."""
    sums = {}
    for block, amount, words in zip(unpack_keys(carved.keys), carved.amounts, carved.masks, strict=True):
        bits = np.unpackbits(words.view(np.uint8), bitorder="little").reshape(8, 8, 8)
        for inside in np.argwhere(bits):
            sums[tuple((8 * block + inside).tolist())] = int(amount)
    assert len(sums) == carved.voxels, "each once"
    return sums


def steps(seed: int) -> NDArray[np.float32]:
    """An image of steps and holes, and single pixels that stand out."""
    random = np.random.default_rng(seed)
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = 1.2 + 0.3 * (u // 23 % 5) + 0.1 * (v // 17 % 4) + 0.004 * u
    depth[20:40, 50:90] = 0
    depth[np.hypot(u - 120, v - 80) < 20] = 0.6
    lone = random.random(SHAPE) < 0.01
    depth[lone] = random.uniform(0.4, 3.0, lone.sum())
    depth[random.random(SHAPE) < 0.05] = np.nan
    return depth.astype(np.float32)


POSES = [
    np.eye(4),
    look_at(np.array([0.31, -0.2, -1.1]), np.array([0.1, 0.3, 0.4])),
    look_at(np.array([-40.003, 17.7, 3.2]), np.array([-41.0, 18.0, 2.9])),
]
SCENE = plane_keyframe(np.eye(4), np.array([0.0, 0.0, 1.0]), 2.0)


def kinds() -> dict[str, Keyframe]:
    random = np.random.default_rng(5)
    stepped = [replace(SCENE, T_world_camera=T, depth=steps(i)) for i, T in enumerate(POSES)]
    trust = (random.random(SHAPE) < 0.9).astype(np.uint8) * 200
    millimetres = np.nan_to_num(steps(1) * 1000).astype(np.uint16)
    pixels = np.where(steps(0) > 0, CAMERA.fx * 0.1 / np.maximum(steps(0), 0.1), 0)
    disparity = (np.nan_to_num(pixels) * 256).astype(np.uint16)
    return {
        "steps": stepped[0], "turned": stepped[1], "far away": stepped[2],
        "millimetres": replace(stepped[1], depth=millimetres, depth_scale=0.001),
        "confidence": replace(stepped[1], confidence=trust),
        "disparity": Keyframe(
            disparity=disparity, disparity_scale=1 / 256, baseline_fx=CAMERA.fx * 0.1, intrinsics=CAMERA,
            T_world_camera=POSES[1],
        ),
        "upside down": replace(
            stepped[1], intrinsics=Intrinsics(CAMERA.fx, -1.5 * CAMERA.fy, CAMERA.cx, 60.0)
        ),
        "two rows": replace(SCENE, depth=np.full((2, 120), 2.0, np.float32)),
        "rest of a patch": replace(stepped[1], depth=steps(1)[:118, :151].copy()),
        "a patch": replace(SCENE, depth=np.full((3, 3), 5.9, np.float32)),
        "a strip": replace(SCENE, depth=np.full((120, 3), 1.5, np.float32)),
    }  # fmt: skip


@pytest.fixture(autouse=True)
def threads() -> None:
    runtime.start(2)


@pytest.mark.parametrize("filters", [True, False])
@pytest.mark.parametrize("kind", kinds())
def test_every_clear_voxel_is_found_once(kind: str, filters: bool) -> None:
    keyframe = kinds()[kind]
    clear = voxels_of(found(keyframe, outlier_filter=filters))
    certain, possible = kernel_twins.clear_voxels(keyframe, parameters(outlier_filter=filters))
    assert certain <= set(clear) <= possible
    assert len(certain) > 0.8 * len(clear) > 0


@pytest.mark.parametrize("voxel_size", [0.05, 0.02])
def test_votes_are_those_of_the_pixels_that_a_voxel_covers(voxel_size: float) -> None:
    model, edge = parameters(voxel_size), 8 * voxel_size
    for (x, y, z), amount in voxels_of(found(SCENE, voxel_size)).items():
        middle = (z // 8 + 0.5) * edge + voxel_size / 2  # the voxel behind the block's middle
        pixels = (CAMERA.fx * voxel_size / middle) ** 2
        weight, _, half = kernel_twins.sample(model, middle, 255 * pixels)
        assert abs((amount & ((1 << 27) - 1)) - weight) <= 1, (x, y, z)
        assert abs((amount >> 27) / (amount & ((1 << 27) - 1)) - half * 60 / 256) < 1


def test_nothing_to_look_through() -> None:
    nothing = replace(SCENE, depth=np.zeros(SHAPE, np.float32))
    beyond = np.eye(4)
    beyond[:3, 3] = 1e6
    for keyframe in (nothing, replace(SCENE, T_world_camera=beyond)):
        carved = found(keyframe)
        assert (len(carved), carved.voxels) == (0, 0)


def test_a_sample_alone_carves_only_where_lone_ones_count() -> None:
    depth = np.zeros(SHAPE, np.float32)
    depth[1::3, 1::3] = 2.0
    lone = replace(SCENE, depth=depth)
    assert found(lone).voxels == 0
    assert found(lone, outlier_filter=False).voxels > 0.98 * found(SCENE).voxels


@pytest.mark.parametrize("focal", [1e3, 1e5, 1e7, 200.0, 1e-3, 1e-320])
def test_a_camera_of_any_focal_length_finds_what_lies_in_its_view(focal: float) -> None:
    """A very long lens looks between all voxels' centres, and so wide an image as the others have is none."""
    depth = np.full((90, 90), 5.0, np.float32)
    far = Keyframe(depth=depth, intrinsics=Intrinsics(focal, focal, 44.5, 44.5), T_world_camera=np.eye(4))
    clear = np.array(list(voxels_of(found(far))) or np.zeros((0, 3)))
    centres = (clear + 0.5) * VOXEL
    assert (np.abs(centres[:, :2]) <= 45.5 / focal * centres[:, 2:]).all()
    assert (np.linalg.norm(centres, axis=1) <= 2049 * VOXEL).all()
    assert (len(clear) > 0) == (1e-2 < focal < 1e4)


@pytest.mark.parametrize("numbers", [(0.1, 0.1, 1e308, 30.0), (5e-324, 1e308, 1e308, -1e308)])
def test_a_camera_of_impossible_numbers_carves_nothing(numbers: tuple[float, ...]) -> None:
    assert found(replace(SCENE, intrinsics=Intrinsics(*numbers))).voxels == 0


def test_no_cube_is_looked_at_in_vain_where_a_camera_is_too_wide() -> None:
    """However wide, it carves no farther than 2048 voxels: at most 66 cubes a side."""
    carved, cubes = CarvedBlocks(), []
    usual = space_carving.list_free_blocks

    def counted(*given: Any) -> None:
        cubes.append(int(np.prod(given[8][3:], dtype=np.int64)))
        usual(*given)

    for focal in (0.05, 2.0, 10.0, 30.0, 100.0):
        wide = Keyframe(
            depth=np.full((480, 640), 100.0, np.float32), intrinsics=Intrinsics(focal, focal, 319.5, 239.5),
            T_world_camera=np.eye(4),
        )  # fmt: skip
        model = model_parameters(structs.replace(MODEL, max_range=200.0), 0.02, None, space_carving=True)
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(space_carving, "list_free_blocks", counted)
            carved.find(wide, (wide.measurement, 0, 1.0, *_optional(None, 2)), model, 1000)
    assert 0 < max(cubes) < 66**3


def test_without_memory_for_an_image_the_next_one_is_found_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    carved, usual, expected = CarvedBlocks(), np.zeros, voxels_of(found(SCENE))
    read = SCENE.measurement, 0, 1.0, *_optional(None, 2)
    small = replace(SCENE, depth=np.full((9, 9), 1.0, np.float32))
    carved.find(small, (small.measurement, 0, 1.0, *_optional(None, 2)), parameters(), 1 << 17)
    for failing in range(1, 4):
        calls = []

        def zeros(*given: Any, calls: list[Any] = calls, failing: int = failing) -> Any:
            calls.append(given)
            if len(calls) == failing:
                raise MemoryError
            return usual(*given)

        with monkeypatch.context() as patched:
            patched.setattr(np, "zeros", zeros)
            with pytest.raises(MemoryError):
                carved.find(SCENE, read, parameters(), 1 << 17)
    carved.find(SCENE, read, parameters(), 1 << 17)
    assert voxels_of(carved) == expected


def test_the_list_grows_and_ends_one_block_after_the_most() -> None:
    whole = found(SCENE, 0.01)
    assert len(whole) > 4096
    few = found(SCENE, 0.01, most=2000)
    assert len(few) == 2001
    assert set(few.keys) <= set(whole.keys)


def test_a_still_larger_image_takes_the_room_of_a_smaller_one() -> None:
    carved = CarvedBlocks()
    found_first, large = [], replace(SCENE, depth=np.full((480, 640), 1.5, np.float32))
    for keyframe in (SCENE, large, SCENE):
        read = keyframe.measurement, 0, 1.0, *_optional(None, 2)
        carved.find(keyframe, read, parameters(), 1 << 17)
        found_first.append(voxels_of(carved))
    assert found_first[0] == found_first[2] != found_first[1]
