# SPDX-License-Identifier: MIT
"""Measure the quality of a map: errors of surfaces and trajectories, and agreement of poses and depth."""
