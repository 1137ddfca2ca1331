# SPDX-License-Identifier: MIT
"""The robot's side: source → localizer → keyframe selection → client. It runs without Taichi.

Rooms:
    sources: RealSense, stereo video, a watched folder, a recording played as a source.
    localization: where the sensor is, frame by frame.
    localization/rgbd: RGB-D cameras: corners and planes together.
    localization/stereo: stereo pairs, with a check of their rectification.
    localization/loop_closure: places seen again, and the poses corrected by them.
    localization/pose_feed: poses that another process publishes over ZeroMQ.
"""
