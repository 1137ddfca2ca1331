#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Replay a recorded dataset through the whole path: the same as `tsfusion replay`.

python scripts/replay_dataset.py PATH --voxel-size 0.02
"""

import sys

from tsfusion.__main__ import main

if __name__ == "__main__":
    main(["replay", *sys.argv[1:]])
