# SPDX-License-Identifier: MIT
"""Depth of real folders: one view moved by the poses lands on the other."""

import numpy as np
import pytest
from geometry_checks import warp_residual

from tsfusion.datasets import open_dataset


@pytest.mark.parametrize(
    ("name", "i", "j", "bound"),
    [
        ("7scenes/redkitchen", 0, 2, 0.008),
        ("7scenes/redkitchen", 10, 21, 0.018),
        ("3dmatch", 0, 2, 0.025),
        ("hololens", 0, 4, 0.006),
        ("hololens", 20, 24, 0.012),
        ("redwood_livingroom1", 0, 10, 0.0016),
        ("redwood_livingroom1", 2, 52, 0.005),
        ("open3d_rgbd", 0, 4, 0.007),
    ],
)
def test_depth_of_one_view_lands_on_the_other(data, name, i, j, bound):
    dataset = open_dataset(data(name), color=False)
    a, b = dataset[i], dataset[j]
    residual = warp_residual(a, b)
    inverse = warp_residual(a, b, T_b_a=b.T_world_camera @ np.linalg.inv(a.T_world_camera))
    assert residual < bound
    assert inverse > 1.7 * residual
