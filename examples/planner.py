# SPDX-License-Identifier: MIT
"""Ask a live map whether a path is free: `python examples/planner.py [ADDRESS]`."""

import sys

import numpy as np

from tsfusion import AnswerLate, MapClient

RADIUS = 0.15  # metres: half the robot's width
address = sys.argv[1] if sys.argv[1:] else "tcp://127.0.0.1:5555"
path = np.linspace([-1.5, 0.4, 0.85], [1.5, 0.4, 0.85], 61)  # (61, 3) metres of the map: 5 cm a step

with MapClient(address, timeout=0.5) as live:
    try:
        found = live.sample(path)
    except AnswerLate:
        sys.exit("the map did not answer in time: stop")
    distance = found.result.distance  # (61,) metres to the surface; NaN = beyond what the map knows there
    near = np.flatnonzero(distance < RADIUS)
    if len(near):
        print(
            f"{distance[near[0]]:.2f} m from a surface at {path[near[0]].round(2).tolist()}: stop before it"
        )
    else:
        print("the path touches nothing that the map has seen")
    print(f"answered in {1000 * found.delay_s:.0f} ms, of a map of {found.state.keyframes} keyframes")
