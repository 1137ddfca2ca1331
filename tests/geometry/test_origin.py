# SPDX-License-Identifier: MIT
"""Origins are found near far positions alone, and go through the name of a world."""

import numpy as np
import pytest

from tsfusion import Keyframe
from tsfusion.core.errors import InvalidConfig, InvalidKeyframe
from tsfusion.geometry import origin
from tsfusion.geometry.origin import Origin
from tsfusion.wire.records.record_header import WORLD_NAME

UTM = np.array([447_812.3, 5_411_377.9, 312.0])


@pytest.mark.parametrize(
    "one", [Origin((447_800, 5_411_400, 300)), Origin((-12, 0, -99_999_999), "EPSG:25832"), Origin((0, 0, 0))]
)
def test_the_name_of_a_world_has_the_origin(one: Origin) -> None:
    import re

    assert re.fullmatch(WORLD_NAME, one.world)
    assert Origin.of_world(one.world) == one


@pytest.mark.parametrize("world", ["", "f" * 32, "origin_1_2", "origin_1_2_3_4", "EPSG_1_2_3", "yard"])
def test_other_worlds_have_none(world: str) -> None:
    assert Origin.of_world(world) is None


def test_only_far_positions_get_one() -> None:
    assert origin.found([UTM]) == Origin((448_000, 5_411_000, 0))
    assert origin.found([UTM + 100, UTM]) == origin.found([UTM])  # two drives of a place
    assert origin.found([UTM, UTM * 0]) == origin.found([UTM], "auto")
    assert origin.found([np.array([9000.0, -9000.0, 0.0]), UTM]) is None
    assert origin.found([]) is None
    assert origin.found([UTM], crs="EPSG:25832") == Origin((448_000, 5_411_000, 0), "EPSG:25832")
    assert origin.found([UTM * 0], crs="EPSG:25832") == Origin((0, 0, 0), "EPSG:25832")
    for text in (
        "447000,5411000,0",
        "447000 5411000 0",
        (447_000, 5_411_000, 0),
        np.array([447_000, 5_411_000, 0]),
    ):
        assert origin.found([UTM * 0], text) == Origin((447_000, 5_411_000, 0))


@pytest.mark.parametrize("text", ["here", "1,2", "1,2,3,4", "1.5,2,3", "nan,0,0", "1e9,0,0", 7, [None, 1, 2]])
def test_what_is_no_origin_is_refused(text: object) -> None:
    with pytest.raises(InvalidConfig, match="origin must be auto or X,Y,Z in whole metres"):
        origin.found([UTM], text)


@pytest.mark.parametrize("crs", ["25832", "epsg:x", "EPSG:", "5", "['EPSG:25832']"])
def test_what_is_no_reference_system_is_refused(crs: str) -> None:
    with pytest.raises(InvalidConfig, match="crs must be EPSG: and a number"):
        origin.system(crs)


@pytest.mark.parametrize(
    ("crs", "metres"),
    [
        ("EPSG:25832", (1.0, 1.0, 1.0)),
        ("EPSG:2994", (0.3048, 0.3048, 0.3048)),
        ("EPSG:6880", (1200 / 3937,) * 3),
        ("EPSG:5555", (1.0, 1.0, 1.0)),  # UTM and a height
        ("EPSG:8720", (1200 / 3937,) * 3),  # both in US survey feet
    ],
)
def test_units_of_a_reference_system(crs: str, metres: tuple[float, ...]) -> None:
    pytest.importorskip("pyproj")
    found = origin.system(crs)
    assert found.crs == crs
    assert found.metres == pytest.approx(metres, rel=1e-12)


def test_a_reference_system_that_cannot_be() -> None:
    pytest.importorskip("pyproj")
    with pytest.raises(InvalidConfig, match="degrees: project points and poses first, such as to UTM"):
        origin.system("EPSG:4326")
    with pytest.raises(InvalidConfig, match="pyproj knows no coordinate reference system EPSG:999999"):
        origin.system("EPSG:999999")


def test_a_cloud_in_a_grid_is_no_scan() -> None:
    near = np.random.default_rng(0).uniform(-20, 20, (100, 3))
    with pytest.raises(InvalidKeyframe, match="all points are more than 10 km from the sensor"):
        Keyframe(points=(near + UTM).astype(np.float32), T_world_camera=np.eye(4), sensor="lidar")
    near[:50] = 1e5  # echoes of nothing
    assert Keyframe(points=near.astype(np.float32), T_world_camera=np.eye(4), sensor="lidar").shape == (100,)
    near[:99] = np.inf
    assert Keyframe(points=near.astype(np.float32), T_world_camera=np.eye(4), sensor="lidar").shape == (100,)


def test_a_keyframe_in_a_grid_names_the_cure() -> None:
    T = np.eye(4)
    T[:3, 3] = UTM
    with pytest.raises(InvalidKeyframe, match=r"at most 1e\+06 m.*--origin X,Y,Z"):
        Keyframe(points=np.ones((5, 3), np.float32), T_world_camera=T, sensor="lidar")
