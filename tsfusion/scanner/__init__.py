# SPDX-License-Identifier: MIT
"""The robot's side: source → localizer → keyframe selection → client. It runs without Taichi.

Rooms:
    sources: RealSense cameras, stereo video, watched folders, and recordings that are played.
    localization: the sensor's pose for each frame.
    localization/rgbd: poses of RGB-D cameras, from corners and planes together.
    localization/stereo: poses of stereo cameras, and a check of their rectification.
    localization/loop_closure: recognition of places seen before, and correction of poses by them.
    localization/pose_feed: poses that another process publishes over ZeroMQ.
"""
