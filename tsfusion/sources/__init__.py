# SPDX-License-Identifier: MIT
"""Live sources of frames behind one small protocol. Without Taichi: they run on the scanner."""

from tsfusion.sources.base import Source
from tsfusion.sources.named import is_live, open_source

__all__ = ["Source", "is_live", "open_source"]
