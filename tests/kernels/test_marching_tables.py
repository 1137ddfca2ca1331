# SPDX-License-Identifier: MIT
"""The tables of marching cubes."""

from tsfusion.kernels import marching_tables


def test_marching_cubes_cases_are_closed_and_complementary() -> None:
    for case in range(256):
        edges = marching_tables.TRIANGLE_EDGES[case, : 3 * marching_tables.TRIANGLE_COUNT[case]]
        crossing = {e for e, (a, b) in enumerate(marching_tables.EDGES) if (case >> a & 1) != (case >> b & 1)}
        assert set(edges.tolist()) == crossing
