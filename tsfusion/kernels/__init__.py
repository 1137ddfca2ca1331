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
from importlib import import_module
from typing import Any

from tsfusion.core.errors import MissingDependency
from tsfusion.core.process import installed_engine

ENGINE = installed_engine()
# Variable with the folder of compiled kernels
CACHE_VARIABLE = {"taichi": "TI_OFFLINE_CACHE_FILE_PATH", "quadrants": "QD_OFFLINE_CACHE_FILE_PATH"}[ENGINE]

os.environ.setdefault("HOME", os.path.expanduser("~"))  # without it (a daemon's environment) taichi aborts
os.environ.setdefault(f"ENABLE_{ENGINE.upper()}_HEADER_PRINT", "0")  # the banner goes to stdout
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")  # the check would tell Taichi's makers where we run
# At each decorator Taichi asks `inspect` for the file of the importing module. `inspect` knows no such file
# and searches all modules each time. This entry is the answer.
getattr(inspect, "modulesbyfile", {})["<frozen importlib._bootstrap>"] = "importlib._bootstrap"
try:
    ti: Any = import_module(ENGINE)
except ImportError as error:  # a missing system library, as in small containers
    raise MissingDependency(
        f"{ENGINE} does not load ({error}); where there is no desktop, install libx11-6 (Debian, Ubuntu) or "
        "libX11 (Fedora)"
    ) from error
tm = ti.math

# Types of arrays of one dimension, or of as many as their name ends with
_array = ti.types.ndarray
I32, I32x2, I32x3 = (_array(dtype=ti.i32, ndim=n) for n in (1, 2, 3))
I64, I64x2 = (_array(dtype=ti.i64, ndim=n) for n in (1, 2))
F32, F32x2, F32x3 = (_array(dtype=ti.f32, ndim=n) for n in (1, 2, 3))
F64, F64x2 = (_array(dtype=ti.f64, ndim=n) for n in (1, 2))
U8, U8x2, U8x3 = (_array(dtype=ti.u8, ndim=n) for n in (1, 2, 3))
U64x2 = _array(dtype=ti.u64, ndim=2)
ANY, ANYx2 = (_array(ndim=n) for n in (1, 2))
