# SPDX-License-Identifier: MIT
"""Quality of a map: the error of surfaces and trajectories, and whether poses and depth agree."""
