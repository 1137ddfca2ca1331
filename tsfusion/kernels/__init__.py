# SPDX-License-Identifier: MIT
"""Taichi kernels: free functions over NumPy arrays; the state they work on lives in their callers."""

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
