# SPDX-License-Identifier: MIT
"""The bunny's scans: their poses meet the reference, and their rays are the scanner's."""

from pathlib import Path

import numpy as np
import pytest
from geometry_checks import move
from numpy.typing import NDArray

from lab.evaluation import stanford_bunny

pytestmark = pytest.mark.nightly

scipy_spatial = pytest.importorskip("scipy.spatial")


def read_rows(path: Path) -> NDArray[np.int64]:
    """(N,) the range grid's row of every vertex."""
    head, body = path.read_bytes().replace(b"\r\n", b"\n").split(b"end_header\n", 1)
    stated = (line for line in head.splitlines() if line.startswith((b"element", b"obj_info num")))
    sizes = dict(line.split()[1:3] for line in stated)
    cells = body.splitlines()[int(sizes[b"vertex"]) :]
    rows = np.full(int(sizes[b"vertex"]), -1)
    for index, cell in enumerate(cells):
        if cell[:1] == b"1":
            rows[int(cell.split()[1])] = index // int(sizes[b"num_cols"])
    return rows


def test_scans_lie_on_the_reference(data):
    place = data("stanford_bunny")
    tree = scipy_spatial.cKDTree(stanford_bunny.reference(place)[0])
    scans = list(stanford_bunny.scans(place))
    assert len(scans) == 6
    for keyframe in scans[::2]:
        world = move(keyframe.T_world_camera, keyframe.points[::9].astype(np.float64))
        assert np.median(tree.query(world)[0]) < 0.0006
        assert keyframe.sensor == "scanner"


def test_one_row_is_seen_through_one_plane(data):
    """The rays fitted: a scan line's points and the lens lie in one plane, though the lines bend."""
    path = data("stanford_bunny") / "data" / "bun000.ply"
    points = stanford_bunny.read_points(path).astype(np.float64)
    slope = (points[:, 1] - stanford_bunny.LENS_Y) / (stanford_bunny.LENS_Z - points[:, 2])
    row = read_rows(path)
    spread = [slope[row == r].std() for r in range(40, 200, 20)]
    sideways = [points[row == r, 1].std() / stanford_bunny.LENS_Z for r in range(40, 200, 20)]
    assert np.median(spread) < 0.1 * np.median(sideways)
