# SPDX-License-Identifier: MIT
"""Two robots fill one map at the same time: `python examples/two_robots.py [ADDRESS]`.

Their poses are in one frame. The map is the sum of what both send, whoever comes first: its hash is that of a
map that one process makes of all keyframes in another order.
"""

import sys
import threading

import tsfusion
from tsfusion.wire.asking.queries import fetch_status

address = sys.argv[1] if sys.argv[1:] else "tcp://127.0.0.1:5555"
room = list(tsfusion.open_dataset("synthetic:room", count=8))


def robot(name, keyframes):
    """One robot: a client with a spool of its own."""
    with tsfusion.Client(address, spool=f"{name}-spool", map="house") as client:
        for keyframe in keyframes:
            client.send(keyframe)
        client.wait_fused()


robots = [
    threading.Thread(target=robot, args=("left", room[::2])),
    threading.Thread(target=robot, args=("right", room[1::2])),
]
for one in robots:
    one.start()
for one in robots:
    one.join()

alone = tsfusion.Volume(voxel_size=0.02)
for keyframe in reversed(room):
    alone.integrate(keyframe)
both = fetch_status(address, map_name="house")
print(f"{both.keyframes_fused} keyframes of two robots, hash {both.map_hash}")
print(f"the same ones fused here, backwards:   {alone.map_hash()}")
sys.exit(both.map_hash != alone.map_hash())
