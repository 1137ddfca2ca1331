# SPDX-License-Identifier: MIT
"""A map on a device is the map on the CPU, to the last bit, whatever is done with it."""

import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from formula_scenes import sphere_views

from tsfusion import Keyframe, Volume
from tsfusion.core.config import Arch, VolumeConfig, make_settings
from tsfusion.core.errors import InvalidConfig, MapError, MapFull
from tsfusion.tsdf.device import device_link
from tsfusion.tsdf.device.device_link import DeviceLost

VIEWS = sphere_views(0.4, 4)
COLOR = np.random.default_rng(1).integers(0, 256, (*VIEWS[0].shape, 3), np.uint8)
COLORED = [replace(view, color=COLOR) for view in VIEWS]
POINTS = [
    Keyframe(points=random.normal(size=(500, 3)).astype(np.float32), T_world_camera=np.eye(4))
    for random in map(np.random.default_rng, range(3))
]
FEW_POINTS = [
    replace(one, points=np.ascontiguousarray(one.points[:5])) for one in POINTS if one.points is not None
]
MILLIMETRES = [
    replace(view, depth=(view.depth * 1000).astype(np.uint16), depth_scale=0.001) for view in VIEWS
]
HOW = {
    "vulkan": "Debian and Ubuntu: apt-get install mesa-vulkan-drivers, a software device",
    "cuda": "a GPU of NVIDIA's and its driver",
}


@pytest.fixture(scope="module", params=HOW)
def arch(request: pytest.FixtureRequest) -> Iterator[Arch]:
    arch: Arch = request.param
    if Volume(arch=arch).arch != arch:
        pytest.skip(f"no {arch} device that can fuse ({HOW[arch]})")
    yield arch
    link = device_link.link_to(arch)
    assert link is not None
    link.close()


def both(arch: Arch, keyframes: list[Keyframe], **settings: Any) -> tuple[Volume, Volume]:
    """The maps on the CPU and on the device."""
    maps = Volume(0.05, **settings), Volume(0.05, arch=arch, **settings)
    assert [one.arch for one in maps] == ["cpu", arch]
    for keyframe in keyframes:
        here, there = (one.integrate(keyframe) for one in maps)
        assert here == there
    return maps


def assert_equal(here: Volume, there: Volume) -> None:
    assert (here.map_hash(), here.color_hash()) == (there.map_hash(), there.color_hash())
    assert here.map_hash() != Volume(0.05).map_hash()
    for one, other in zip(here._store.clear.counts(), there._store.clear.counts(), strict=True):
        assert (one == other).all()
    if here.config.counts_hits:
        for one, other in zip(here._store.in_order("hits"), there._store.in_order("hits"), strict=True):
            assert (one[0] == other[0]).all()
            assert (one[1] == other[1]).all()


@pytest.mark.parametrize(
    ("keyframes", "settings"),
    [
        (COLORED, {}),
        (VIEWS, {"bundle": False, "color": False}),
        (VIEWS, {"space_carving": True}),
        (POINTS, {"sensor": "tof"}),
        (FEW_POINTS, {}),
        (POINTS, {"sensor": "lidar", "color": False}),
        (MILLIMETRES, {}),
    ],
    ids=["colour", "exact", "carving", "points", "few points", "hits", "millimetres"],
)
def test_the_map_is_that_of_the_cpu(arch: Arch, keyframes: list[Keyframe], settings: dict[str, Any]) -> None:
    here, there = both(arch, keyframes, **settings)
    assert_equal(here, there)
    for one in (here, there):
        one.retract(keyframes[0])
    assert_equal(here, there)
    assert sorted(there.take_dirty().tolist()) == sorted(here.take_dirty().tolist())


def test_what_is_read_follows_what_is_added(arch: Arch, tmp_path: Path) -> None:
    here, there = both(arch, COLORED[:2])
    meshes = [one.extract_mesh(surface="raw") for one in (here, there)]
    assert (meshes[0].vertices == meshes[1].vertices).all()
    for one in (here, there):
        one.integrate(COLORED[2])
    meshes = [one.extract_mesh(surface="raw") for one in (here, there)]
    assert (meshes[0].vertices == meshes[1].vertices).all()
    saved = there.save(tmp_path / "map.tsf")
    assert Volume.load(saved).config.arch == "cpu"
    again = Volume.load(saved, arch=arch)
    assert again.arch == arch
    for one in (here, again):
        one.integrate(COLORED[3])
    assert_equal(here, again)


def test_what_is_written_reaches_the_device(arch: Arch) -> None:
    here, there = both(arch, COLORED[:1])
    more_here, more_there = both(arch, COLORED[1:3])
    here.merge(more_here)
    there.merge(more_there)
    for one in (here, there):
        one.integrate(COLORED[3])
        one.retract(COLORED[0])
    assert_equal(here, there)
    assert here.release_empty() == there.release_empty()
    for one in (here, there):
        one.integrate(COLORED[0])
    assert_equal(here, there)
    boxes = [one.crop((-1, -1, -1, 0.1, 1, 1)) for one in (here, there)]
    for one in boxes:
        one.integrate(COLORED[1])
    assert_equal(*boxes)


def test_a_refused_keyframe_changes_nothing(arch: Arch) -> None:
    room = both(arch, VIEWS[:1])[0].stats().blocks
    here, there = both(arch, VIEWS[:1], max_blocks=room)
    before = there.map_hash()
    for one in (here, there):
        with pytest.raises(MapFull):
            one.integrate(VIEWS[2])
    assert there.map_hash() == before == here.map_hash()
    with pytest.raises(MapError):
        there.retract(VIEWS[2])
    assert there.map_hash() == before
    assert here.integrate(VIEWS[0]) == there.integrate(VIEWS[0])
    assert_equal(here, there)


def test_smoothing_along_rays_needs_the_cpu(arch: Arch, caplog: pytest.LogCaptureFixture) -> None:
    assert Volume(0.05, regularizer="ray", arch=arch).arch == "cpu"
    assert "smoothing along rays (regularizer) needs the CPU" in caplog.text


def test_a_map_grows_beyond_its_first_room(arch: Arch) -> None:
    maps = Volume(0.004, color=False), Volume(0.004, color=False, arch=arch)
    for one in maps:
        one.integrate(VIEWS[0])
        one.integrate(VIEWS[2])
    assert maps[1].stats().blocks > 1024
    assert maps[0].map_hash() == maps[1].map_hash()


def test_a_device_that_ends_is_noticed_and_another_map_finds_a_new_one(arch: Arch) -> None:
    _, there = both(arch, VIEWS[:1])
    link = device_link.link_to(arch)
    assert link is not None
    link._process.kill()
    link._process.wait(10)
    with pytest.raises(DeviceLost, match=arch):
        there.integrate(VIEWS[1])
    here, there = both(arch, VIEWS[1:2])
    assert_equal(here, there)


def test_a_missing_device_is_said_once_and_the_map_is_on_the_cpu() -> None:
    code = (
        "import logging, tsfusion; logging.basicConfig();"
        "maps = [tsfusion.Volume(0.1, arch='cuda') for _ in range(2)]; print([one.arch for one in maps])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        check=False,
        capture_output=True,
        text=True,
        timeout=100,
        env={**os.environ, "CUDA_VISIBLE_DEVICES": "-1"},
    )
    assert done.stdout == "['cpu', 'cpu']\n"
    warnings = [line for line in done.stderr.splitlines() if "keyframes are fused on the CPU" in line]
    assert len(warnings) == 1, done.stderr
    assert "cuda" in warnings[0]


def test_only_known_devices_are_settings() -> None:
    with pytest.raises(InvalidConfig, match="arch must be one of cpu, cuda, vulkan, metal"):
        make_settings(VolumeConfig, {"arch": "tpu"})
