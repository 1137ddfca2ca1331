#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Publish poses for `tsfusion scan --localizer feed --feed tcp://127.0.0.1:5570`; needs pyzmq alone.

    your_slam | python3 pose_sender.py tcp://127.0.0.1:5570

Reads lines `seconds tx ty tz qx qy qz qw` (TUM's format: T_world_camera, OpenCV axes), or `seconds lost` when
your SLAM is lost. Blank lines and those that begin with # are skipped, bad ones are reported on stderr. For a
file use `tsfusion scan --trajectory FILE`: here its poses would be sent before anybody listens.
`pose_sender.py ADDRESS connect` is for `--feed @ADDRESS`.
"""

import json
import sys
from decimal import Decimal

import zmq

socket = zmq.Context().socket(zmq.PUB)
(socket.connect if sys.argv[2:] == ["connect"] else socket.bind)(sys.argv[1])
for number, line in enumerate(sys.stdin, 1):
    if not line.strip() or line.lstrip().startswith("#"):
        continue
    try:
        seconds, *rest = line.split()
        stamp_ns = int(Decimal(seconds) * 10**9)
        pose = None if rest == ["lost"] else [float(word) for word in rest]
        if pose is not None and len(pose) != 7:
            raise ValueError
    except (ArithmeticError, ValueError):
        sys.stderr.write(f"line {number} is no `seconds tx ty tz qx qy qz qw`: {line.strip()[:80]}\n")
        continue
    message = {"lost": True} if pose is None else {"pose": pose}
    socket.send(json.dumps({"stamp_ns": stamp_ns, **message}).encode())
