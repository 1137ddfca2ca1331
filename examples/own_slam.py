# SPDX-License-Identifier: MIT
"""Send what your own SLAM sees to a server: `python examples/own_slam.py [ADDRESS]`."""

import sys

import tsfusion


def my_slam():
    """Your SLAM stands here: depth (H, W) uint16, colour (H, W, 3) uint8 BGR, camera pose (4, 4)."""
    for frame in tsfusion.open_dataset("synthetic:room", count=8):
        yield frame.depth, frame.color, frame.T_world_camera


camera = tsfusion.Intrinsics(fx=292.5, fy=292.5, cx=159.5, cy=119.5)
with tsfusion.Client(*sys.argv[1:], spool="own-slam-spool") as client:
    for depth, color, pose in my_slam():
        client.send(
            tsfusion.Keyframe(
                depth=depth, depth_scale=0.0001, color=color, intrinsics=camera, T_world_camera=pose
            )
        )
    client.flush(timeout=60)  # every keyframe is on the server's disk, or this raises
    client.wait_fused()
    print(f"{client.stats.fused} keyframes are in the map")
