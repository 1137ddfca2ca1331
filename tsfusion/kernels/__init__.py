# SPDX-License-Identifier: MIT
"""Taichi kernels: free functions over NumPy arrays; their callers keep all state.

Rooms:
    device: makes and adds rays on a GPU.
    worlds: renders synthetic scenes with colours.
    answers: computes samples, slices, distances, views and textures.
    surface: smooths the field, meshes by marching cubes, and fills holes.
    integration: turns images and points into rays, and adds their votes.
    base: starts Taichi, launches kernels fast, and holds block keys and noise models.
"""

import inspect
import os

from tsfusion.core.errors import MissingDependency

os.environ.setdefault("HOME", os.path.expanduser("~"))  # without it (a daemon's environment) taichi aborts
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # the banner goes to stdout
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # the check would tell Taichi's makers where we run
# At each decorator Taichi asks `inspect` for the file of the importing module. `inspect` knows no such file
# and searches all modules each time. This entry is the answer.
getattr(inspect, "modulesbyfile", {})["<frozen importlib._bootstrap>"] = "importlib._bootstrap"
try:
    import taichi as taichi
except ModuleNotFoundError as error:
    raise MissingDependency(
        "fusing needs taichi, which is not installed here or has no build for this platform; "
        "run `tsfusion serve` on an x86-64 machine and send keyframes to it from here"
    ) from error
except ImportError as error:  # a missing system library, as in small containers
    raise MissingDependency(
        f"taichi does not load ({error}); where there is no desktop, install libx11-6 (Debian, Ubuntu) or "
        "libX11 (Fedora)"
    ) from error

# Types of arrays of one dimension, or of as many as their name ends with
_array = taichi.types.ndarray
I32, I32x2, I32x3 = (_array(dtype=taichi.i32, ndim=n) for n in (1, 2, 3))
I64, I64x2 = (_array(dtype=taichi.i64, ndim=n) for n in (1, 2))
F32, F32x2, F32x3 = (_array(dtype=taichi.f32, ndim=n) for n in (1, 2, 3))
F64, F64x2 = (_array(dtype=taichi.f64, ndim=n) for n in (1, 2))
U8, U8x2, U8x3 = (_array(dtype=taichi.u8, ndim=n) for n in (1, 2, 3))
U64x2 = _array(dtype=taichi.u64, ndim=2)
ANY, ANYx2 = (_array(ndim=n) for n in (1, 2))
