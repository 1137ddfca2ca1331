# SPDX-License-Identifier: MIT
"""Taichi kernels: free functions over NumPy arrays; the state they work on lives in their callers.

Rooms:
    device: rays and additions on a GPU.
    worlds: synthetic scenes, cast and painted.
    answers: samples, slices, distances, views and textures.
    surface: field smoothing, marching cubes, holes.
    integration: rays of images and points, and their votes.
    base: Taichi's start, fast launches, block keys, noise models.
"""

import inspect
import os

from tsfusion.core.errors import MissingDependency

os.environ.setdefault("HOME", os.path.expanduser("~"))  # without it (a daemon's environment) taichi aborts
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # the banner goes to stdout
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # it would tell its makers that and where we run
# At each decorator Taichi asks `inspect` who imports the module: a class? `inspect` knows no such file and
# looks through all modules for it, each time. Here is its answer.
getattr(inspect, "modulesbyfile", {})["<frozen importlib._bootstrap>"] = "importlib._bootstrap"
try:
    import taichi as taichi
except ModuleNotFoundError as error:
    raise MissingDependency(
        "fusing needs taichi, which is not installed here or has no build for this platform; "
        "run `tsfusion serve` on an x86-64 machine and send keyframes to it from here"
    ) from error
except ImportError as error:  # a library of the system, which small containers do not have
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
