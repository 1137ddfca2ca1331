# SPDX-License-Identifier: MIT
"""Localizers by name. Without Taichi: they run on the scanner."""

from tsfusion.localizers.base import Corrections, Localizer, Lost, Pose

__all__ = ["Corrections", "Localizer", "Lost", "Pose"]
