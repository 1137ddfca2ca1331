# SPDX-License-Identifier: MIT
"""The robot's side: source → localizer → keyframe selection → client. It runs without Taichi."""
