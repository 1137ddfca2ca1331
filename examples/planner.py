# SPDX-License-Identifier: MIT
"""Ask a live map whether a path is free: `python examples/planner.py [ADDRESS [X Y Z X Y Z]]`."""

import sys

import numpy as np

from tsfusion import AnswerLate, MapClient

RADIUS = 0.15  # metres: half the robot's width
address = sys.argv[1] if sys.argv[1:] else "tcp://127.0.0.1:5555"
begin, end = np.reshape(sys.argv[2:8] or [-1.5, 0.4, 0.85, 1.5, 0.4, 0.85], (2, 3)).astype(float)
path = np.linspace(begin, end, 61)  # (61, 3) metres of the map: of 3 m 5 cm a step
box = [*(path.min(axis=0) - RADIUS), *(path.max(axis=0) + RADIUS)]

with MapClient(address, timeout=0.5) as live:
    try:
        found = live.distance_field(box, max_distance=2 * RADIUS)
    except AnswerLate:
        sys.exit("the map did not answer in time: stop")
    distance = found.result.at(path)  # (61,) metres to the nearest surface; 0 where nothing was seen
    blocked = np.flatnonzero(distance < RADIUS)
    if len(blocked):
        first = blocked[0]
        print(
            f"{distance[first]:.2f} m from a surface, or 0 as unseen, at {path[first].round(2).tolist()}: "
            "stop before it"
        )
    else:
        print(f"the path keeps {distance.min():.2f} m or more from all surfaces, and all of it was seen")
    print(f"answered in {1000 * found.delay_s:.0f} ms, of a map of {found.state.keyframes} keyframes")
