# SPDX-License-Identifier: MIT
"""Render a synthetic world into files, once: a drive along a KITTI path, or a desk filmed by hand.

    python lab/worlds/render_world.py kitti07 --kitti ~/kitti --out ~/drives/kitti07
    tsfusion scan ~/drives/kitti07
    python lab/worlds/render_world.py desk --out ~/drives/desk

A drive is written in the layout of KITTI's odometry benchmark, the desk in CoRBS'. The folder appears when
it is whole; a run that was interrupted goes on where it stopped. 1101 pairs take ten minutes on one core.
"""

import argparse
import os
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.worlds.desk_world import STEPS, Desk
from lab.worlds.rendered_recordings import record
from lab.worlds.street_drive import DRIVES, StreetDrive
from tsfusion.core.errors import TsfusionError


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("world", choices=[*DRIVES, "desk"])
    parser.add_argument("--kitti", metavar="PATH", help="folder with poses/NN.txt, or that file")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="the folder to make")
    parser.add_argument("--count", type=int, metavar="N", help="the first N frames")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the noise")
    parser.add_argument("--color", action="store_true", help="write the left camera's colour images too")
    options = parser.parse_args()
    try:
        record(_opened(options), options.out, color=options.color, progress=_Progress())
    except TsfusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from here", file=sys.stderr)
        return 130
    print(options.out)
    return 0


def _opened(options: argparse.Namespace) -> StreetDrive | Desk:
    if options.world in DRIVES:
        return StreetDrive(options.world, kitti=options.kitti, count=options.count, seed=options.seed)
    return Desk(count=options.count or STEPS, seed=options.seed)


class _Progress:
    """A line on stderr every two seconds."""

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self, done: int, total: int) -> None:
        if time.monotonic() >= self._next or done == total:
            self._next = time.monotonic() + 2
            end = "\r" if os.isatty(2) and done < total else "\n"
            print(f"frame {done} of {total}", end=end, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
