# SPDX-License-Identifier: MIT
"""Render a drive along a KITTI path through a street into files, once.

    python scripts/record_drive.py kitti07 --kitti ~/kitti --out ~/drives/kitti07
    tsfusion scan ~/drives/kitti07

The folder is in the layout of KITTI's odometry benchmark. It appears when it is whole; a run that was
interrupted goes on where it stopped. 1101 pairs take ten minutes on one core.
"""

import argparse
import os
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from tsfusion.core.errors import TsfusionError
from tsfusion.datasets.synthetic.recorded_drive import record
from tsfusion.datasets.synthetic.street_drive import DRIVES, StreetDrive


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("drive", choices=list(DRIVES))
    parser.add_argument("--kitti", metavar="PATH", help="folder with poses/NN.txt, or that file")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="the folder to make")
    parser.add_argument("--count", type=int, metavar="N", help="the first N frames")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="of the noise")
    parser.add_argument("--color", action="store_true", help="write the left camera's colour images too")
    options = parser.parse_args()
    try:
        drive = StreetDrive(options.drive, kitti=options.kitti, count=options.count, seed=options.seed)
        record(drive, options.out, color=options.color, progress=_Progress())
    except TsfusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\ninterrupted; the same command goes on from here", file=sys.stderr)
        return 130
    print(options.out)
    return 0


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
