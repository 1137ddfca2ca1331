# SPDX-License-Identifier: MIT
"""The localizer of stereo pairs, with a check of their rectification."""
