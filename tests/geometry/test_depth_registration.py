# SPDX-License-Identifier: MIT
"""Depth and colour brought together: exactly on a scene with a formula, visibly on 7-Scenes."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from geometry_checks import edge_fit
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, InvalidKeyframe
from tsfusion.datasets import SevenScenes
from tsfusion.geometry import se3
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.keyframe import Intrinsics

Data = Callable[[str], Path]
DEPTH = Intrinsics(290, 292, 158, 121)
COLOR = Intrinsics(310, 305, 165, 118)
SIZE = (240, 320)
T_COLOR_DEPTH = se3.exp(np.array([0.05, -0.01, 0.02, 0.03, -0.04, 0.02]))
BALL, RADIUS = np.array([0.05, 0.02, 1.5]), 0.35  # in the depth camera's axes, before a slanted wall
WALL, FAR = np.array([0.2, -0.1, 1.0]), 2.5  # normal · p = FAR


def render(
    K: Intrinsics, T_camera_depth: NDArray[np.float64], size: tuple[int, int] = SIZE
) -> NDArray[np.float32]:
    """Depth of a ball before a slanted wall, by formula."""
    v, u = np.mgrid[: size[0], : size[1]]
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(size)], axis=-1)
    back = se3.inverse(T_camera_depth)
    ray, start = rays @ back[:3, :3].T, back[:3, 3]
    wall = (FAR - start @ WALL) / (ray @ WALL)
    a, b, c = (ray**2).sum(-1), ray @ (start - BALL), ((start - BALL) ** 2).sum() - RADIUS**2
    inside = b**2 - a * c
    ball = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, np.inf)
    return np.asarray(np.minimum(wall, ball), np.float32)  # z of a ray is 1: its length is the depth


def paint(
    K: Intrinsics, T_camera_depth: NDArray[np.float64], size: tuple[int, int] = SIZE
) -> NDArray[np.uint8]:
    """The same with a smooth colour that belongs to the place; the ball is darker."""
    z = render(K, T_camera_depth, size)
    v, u = np.mgrid[: size[0], : size[1]]
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=-1)
    world = se3.apply(se3.inverse(T_camera_depth), points.reshape(-1, 3)).reshape(points.shape)
    picture = 170 + 40 * np.sin(5 * world) - 100 * (z < 1.6)[..., None]
    return np.asarray(np.rint(picture), np.uint8)


@pytest.fixture(scope="module")
def registration() -> Registration:
    """Of two cameras 5 cm and 3° apart."""
    return Registration(DEPTH, COLOR, T_COLOR_DEPTH, SIZE)


def test_colour_of_depth_is_the_scenes(registration: Registration) -> None:
    depth = render(DEPTH, np.eye(4))
    got = registration.color_of_depth(paint(COLOR, T_COLOR_DEPTH), depth)
    expected = paint(DEPTH, np.eye(4))
    wrong = np.abs(got.astype(int) - expected).max(axis=-1) > 6
    assert 0.01 < wrong[30:-30, 30:-30].mean() < 0.03  # what the ball hides has its colour


def test_a_larger_colour_image_gives_the_same_colours() -> None:
    size, twice = (480, 640), COLOR.scaled(2)
    double = Registration(DEPTH, twice, T_COLOR_DEPTH, SIZE, color_size=size)
    got = double.color_of_depth(paint(twice, T_COLOR_DEPTH, size), render(DEPTH, np.eye(4)))
    wrong = np.abs(got.astype(int) - paint(DEPTH, np.eye(4))).max(axis=-1) > 6
    assert got.shape == (*SIZE, 3)
    assert 0.01 < wrong[30:-30, 30:-30].mean() < 0.03


def test_pixels_without_depth_stay_without(registration: Registration) -> None:
    nothing = np.zeros(SIZE, np.float32)
    assert registration.color_of_depth(paint(COLOR, T_COLOR_DEPTH), nothing).shape == (*SIZE, 3)


def test_wrong_sizes_and_poses_are_named(registration: Registration) -> None:
    with pytest.raises(InvalidConfig, match=r"depth must be of size \(240, 320\), got \(10, 10\)"):
        registration.color_of_depth(paint(COLOR, T_COLOR_DEPTH), np.zeros((10, 10), np.float32))
    with pytest.raises(InvalidConfig, match=r"color must be \(240, 320, 3\) uint8, got"):
        registration.color_of_depth(np.zeros((10, 10, 3), np.uint8), np.zeros(SIZE, np.float32))
    for wrong in (np.zeros(SIZE, np.uint8), np.zeros((*SIZE, 4), np.uint8), np.zeros((*SIZE, 3), np.uint16)):
        with pytest.raises(InvalidConfig, match=r"color must be \(240, 320, 3\) uint8, got"):
            registration.color_of_depth(wrong, np.zeros(SIZE, np.float32))
    with pytest.raises(InvalidKeyframe):
        Registration(DEPTH, COLOR, 2 * np.eye(4), SIZE)


def test_seven_scenes_colour_fits_depth_twice_as_well(data: Data) -> None:
    place = data("7scenes/redkitchen")
    raw, ours = SevenScenes(place, register=False), SevenScenes(place)
    fits = np.array([[_fit(raw, index), _fit(ours, index)] for index in range(0, 125, 16)])
    assert fits[:, 0].mean() < 1.4
    assert fits[:, 1].mean() > 2.2
    assert (fits[:, 1] > fits[:, 0]).all()


def _fit(dataset: SevenScenes, index: int) -> float:
    frame = dataset.frame(index)
    return edge_fit(frame.color, frame.depth_m)
