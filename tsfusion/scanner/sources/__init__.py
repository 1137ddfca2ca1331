# SPDX-License-Identifier: MIT
"""Sources of frames: RealSense, stereo video, a watched folder, a recording played as a source."""
