# SPDX-License-Identifier: MIT
"""Keep a server busy with three scanners, kill processes, fill its disk, and watch what grows.

    python lab/reliability/soak.py                             10 000 keyframes: a table, then one JSON line
    python lab/reliability/soak.py --keyframes 50000 --kills 24 --plot docs/images/soak.png

Each scanner is a process that sends small keyframes of one room as fast as they are fused; another client
views the mesh. In the first half server, fuser and a scanner are killed in turn, and the server's disk is
full to its last byte for a while (where this user may mount a small file system). The second half is calm.

The exit status is 1 when a keyframe is not in the map exactly once (the map's hash is compared with that of
the same keyframes, fused alone), when in the calm part the memory of gateway, fuser or a scanner, or the
server's files on the disk, grow by more than --tolerance MB (by least squares), when files or threads become
more, or when a process ended by itself.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from lab.reliability.soak_plot import plot
from lab.reliability.soak_run import TOLERANCE_MB, run, table


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=12)
    parser.add_argument("--tolerance", type=float, default=TOLERANCE_MB, help="MB")
    parser.add_argument("--plot", type=Path, help="draw memory, files and events into this file")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tsfusion-soak-") as folder:
        outcome = run(Path(folder), options.keyframes, kills=options.kills, tolerance_mb=options.tolerance)
    print(table(outcome), file=sys.stderr)
    if options.plot:
        plot(outcome, options.plot)
    few = outcome.samples[:: max(len(outcome.samples) // 100, 1)]
    print(msgspec.json.encode(msgspec.structs.replace(outcome, samples=few)).decode())
    for problem in outcome.problems:
        print(problem, file=sys.stderr)
    return 1 if outcome.problems else 0


if __name__ == "__main__":
    sys.exit(main())
