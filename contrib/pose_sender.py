#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Publishes poses for `tsfusion scan --localizer feed --feed tcp://127.0.0.1:5570`; needs pyzmq alone.

    your_slam | python3 pose_sender.py tcp://127.0.0.1:5570

Reads lines `seconds tx ty tz qx qy qz qw` (TUM's format: T_world_camera, OpenCV axes), or `seconds lost` when
your SLAM does not know where it is. `pose_sender.py ADDRESS connect` is for `--feed @ADDRESS`.
"""

import json
import sys
from decimal import Decimal

import zmq

socket = zmq.Context().socket(zmq.PUB)
(socket.connect if sys.argv[2:] == ["connect"] else socket.bind)(sys.argv[1])
for line in sys.stdin:
    seconds, *rest = line.split()
    pose = {"lost": True} if rest == ["lost"] else {"pose": [float(number) for number in rest]}
    socket.send(json.dumps({"stamp_ns": int(Decimal(seconds) * 10**9), **pose}).encode())
