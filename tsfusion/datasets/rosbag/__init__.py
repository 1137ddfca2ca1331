# SPDX-License-Identifier: MIT
"""ROS 1 and ROS 2 bags and MCAP files as datasets, without ROS."""
