# SPDX-License-Identifier: MIT
"""How good a map is: the error of surfaces and trajectories, and whether poses and depth agree."""
