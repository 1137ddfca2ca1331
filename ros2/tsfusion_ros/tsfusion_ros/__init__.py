# SPDX-License-Identifier: MIT
"""Run tsfusion as a node of ROS 2."""
