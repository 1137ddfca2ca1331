# SPDX-License-Identifier: MIT
"""Depth and colour brought together: exactly on a scene with a formula, visibly on 7-Scenes."""

from collections.abc import Callable
from pathlib import Path

import cv2
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


def paint(K: Intrinsics, T_camera_depth: NDArray[np.float64]) -> NDArray[np.uint8]:
    """The same with a smooth colour that belongs to the place; the ball is darker."""
    z = render(K, T_camera_depth)
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=-1)
    world = se3.apply(se3.inverse(T_camera_depth), points.reshape(-1, 3)).reshape(points.shape)
    picture = 170 + 40 * np.sin(5 * world) - 100 * (z < 1.6)[..., None]
    return np.asarray(np.rint(picture), np.uint8)


@pytest.fixture(scope="module")
def registration() -> Registration:
    """Of two cameras 5 cm and 3° apart."""
    return Registration(DEPTH, COLOR, T_COLOR_DEPTH, SIZE)


def test_depth_in_the_colour_camera_is_the_scenes(registration: Registration) -> None:
    depth, expected = render(DEPTH, np.eye(4)), render(COLOR, T_COLOR_DEPTH)
    got = registration.depth_of_color(depth)
    seen = got > 0
    assert seen[20:-20, 20:-20].mean() > 0.94  # the rest was hidden from the depth camera
    error = np.abs(got - expected)[seen]
    assert np.median(error) < 0.002
    assert (error < 0.01).mean() > 0.97
    ball = expected < 1.6
    through = (got > expected + 0.1)[cv2.erode(ball.astype(np.uint8), np.ones((3, 3))) > 0]
    assert not through.any()  # the wall behind it does not show through


@pytest.mark.parametrize("slope", [0.0, 0.8, -0.8])
def test_no_holes_in_a_slanted_wall(registration: Registration, slope: float) -> None:
    u = np.arange(SIZE[1]) + np.zeros((SIZE[0], 1))
    wall = (1.5 / (1 + slope * (u - DEPTH.cx) / DEPTH.fx)).astype(np.float32)
    drawn = registration.depth_of_color(wall) > 0
    assert drawn[20:-20, 24:-24].all()


def test_larger_colour_image_is_filled() -> None:
    double = Registration(DEPTH, COLOR.scaled(2), T_COLOR_DEPTH, SIZE, color_size=(480, 640))
    got = double.depth_of_color(render(DEPTH, np.eye(4)))
    expected = render(COLOR.scaled(2), T_COLOR_DEPTH, (480, 640))
    seen = got > 0
    assert got.shape == (480, 640)
    assert seen[40:-40, 40:-40].mean() > 0.94
    assert (np.abs(got - expected)[seen] < 0.015).mean() > 0.95


def test_colour_of_depth_is_the_scenes(registration: Registration) -> None:
    depth = render(DEPTH, np.eye(4))
    got = registration.color_of_depth(paint(COLOR, T_COLOR_DEPTH), depth)
    expected = paint(DEPTH, np.eye(4))
    wrong = np.abs(got.astype(int) - expected).max(axis=-1) > 6
    assert 0.01 < wrong[30:-30, 30:-30].mean() < 0.03  # what the ball hides has its colour


def test_pixels_without_depth_stay_without(registration: Registration) -> None:
    nothing = np.zeros(SIZE, np.float32)
    assert not registration.depth_of_color(nothing).any()
    assert registration.color_of_depth(paint(COLOR, T_COLOR_DEPTH), nothing).shape == (*SIZE, 3)


def test_what_lies_behind_the_colour_camera_is_not_drawn() -> None:
    forward = np.eye(4)
    forward[2, 3] = -2.0  # the colour camera stands two metres further
    registration = Registration(DEPTH, COLOR, forward, SIZE)
    assert not registration.depth_of_color(np.full(SIZE, 1.5, np.float32)).any()


def test_wrong_sizes_and_poses_are_named(registration: Registration) -> None:
    with pytest.raises(InvalidConfig, match=r"depth must be of size \(240, 320\), got \(10, 10\)"):
        registration.depth_of_color(np.zeros((10, 10), np.float32))
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


def test_seven_scenes_depth_fits_colour_twice_as_well(data: Data) -> None:
    from tsfusion.datasets.formats import sevenscenes

    raw = SevenScenes(data("7scenes/redkitchen"), register=False)
    T = np.eye(4)
    T[0, 3] = sevenscenes.KINECT_BASELINE
    registration = Registration(sevenscenes.KINECT, sevenscenes.KINECT_COLOR, T, (480, 640))
    fits = []
    for index in range(0, 125, 16):
        frame = raw.frame(index)
        fits.append(edge_fit(frame.color, registration.depth_of_color(frame.depth_m)))
    assert np.mean(fits) > 2.1


def _fit(dataset: SevenScenes, index: int) -> float:
    frame = dataset.frame(index)
    return edge_fit(frame.color, frame.depth_m)
