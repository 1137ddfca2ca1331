# SPDX-License-Identifier: MIT
"""Meshes are saved whole or not at all, and an interrupt is not lost while a library loads."""

import signal
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_processes import python
from formula_scenes import sphere_views, volume_of

from tsfusion.core.errors import OutputError


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".obj"])
def test_a_saved_mesh_reads_back(tmp_path: Path, suffix: str) -> None:
    mesh = volume_of(sphere_views(0.4, 6)).extract_mesh()
    loaded = trimesh.load(mesh.save(tmp_path / f"m{suffix}"), force="mesh", process=False)
    assert loaded.faces.shape == mesh.faces.shape
    assert np.allclose(np.sort(loaded.vertices, axis=0), np.sort(mesh.vertices, axis=0), atol=1e-6)
    assert list(tmp_path.iterdir()) == [tmp_path / f"m{suffix}"]


def test_a_mesh_that_cannot_be_saved_says_why_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="no triangles"):
        volume_of([]).extract_mesh().save(tmp_path / "m.ply")
    mesh = volume_of(sphere_views(0.4, 2)[:1]).extract_mesh()
    with pytest.raises(OutputError, match=r"\.ply, \.glb, \.obj"):
        mesh.save(tmp_path / "m.stl")
    with pytest.raises(OutputError, match="cannot write"):
        mesh.save(tmp_path / "missing" / "m.ply")
    assert not list(tmp_path.iterdir())


_PRESSED_WHILE_IT_LOADS = """
import os, signal, sys
import numpy as np
from tsfusion import Mesh

class Pressing:
    def find_spec(self, name, *_):
        if name == "scipy.spatial":
            sys.meta_path.remove(self)
            os.kill(os.getpid(), int(sys.argv[1]))

sys.meta_path.insert(0, Pressing())
signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))
floats = np.eye(3, dtype=np.float32)
try:
    Mesh(floats, np.array([[0, 1, 2]], dtype=np.int32), floats, None).encode(".ply")
except KeyboardInterrupt:
    sys.exit("interrupted")
"""


@pytest.mark.parametrize(("number", "word"), [(signal.SIGINT, "interrupted"), (signal.SIGTERM, "terminated")])
def test_who_wants_it_to_end_is_heard_while_trimesh_loads(number: signal.Signals, word: str) -> None:
    done = python(_PRESSED_WHILE_IT_LOADS, int(number))
    assert (done.returncode, done.stderr.strip()) == (1, word)
