# SPDX-License-Identifier: MIT
"""A journal as ROS 2 messages in one MCAP file, for Foxglove, RViz and `ros2 bag play`."""

from tsfusion.ros.export import Export, export

__all__ = ["Export", "export"]
