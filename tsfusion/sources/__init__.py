# SPDX-License-Identifier: MIT
"""Live sources of frames behind one small protocol. Without Taichi: they run on the scanner."""

from tsfusion.sources.base import Source

__all__ = ["Source"]
