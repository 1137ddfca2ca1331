# SPDX-License-Identifier: MIT
"""RealSense on a machine that lacks pyrealsense2, or a library it loads."""

import sys

import pytest

from tsfusion.core.errors import MissingDependency
from tsfusion.scanner.sources.realsense import RealSense


def test_without_pyrealsense2_the_command_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(MissingDependency, match=r"install it with: pip install '.\[realsense\]'"):
        RealSense()


def test_without_libusb_its_package_is_named(monkeypatch, tmp_path):
    missing = "libusb-1.0.so.0: cannot open shared object file: No such file or directory"
    (tmp_path / "pyrealsense2.py").write_text(f"raise ImportError({missing!r})")
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(MissingDependency, match=f"{missing}.*apt-get install libusb-1.0-0$"):
        RealSense()
