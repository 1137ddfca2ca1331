# SPDX-License-Identifier: MIT
"""Kill scanner, gateway and fuser at seeded moments over a bad network, and see that no keyframe is lost.

    python lab/reliability/chaos.py --seeds 20           20 runs of 300 keyframes and 12 kills, in JSON lines
    python lab/reliability/chaos.py --first 7 --seeds 1  one of them again; --keep FOLDER keeps its files

Meanwhile the server is told to forget keyframes, and to erase some of them. A run is good when the journal
has every keyframe exactly once and in order, less those that were erased, and the map's hash is that of a
fresh one of those that were not forgotten, at their final poses. The exit status is 1 unless all are.
The seed fixes the plan; what the machine makes of it differs from run to run.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from lab.reliability.chaos_run import run


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=20, help="how many runs")
    parser.add_argument("--first", type=int, default=1, help="the first seed")
    parser.add_argument("--keyframes", type=int, default=300)
    parser.add_argument("--kills", type=int, default=12)
    parser.add_argument("--forgets", type=int, default=5, help="requests to forget keyframes")
    parser.add_argument("--keep", type=Path, help="leave the files of each run here")
    options = parser.parse_args()
    good = 0
    for seed in range(options.first, options.first + options.seeds):
        with tempfile.TemporaryDirectory(prefix="tsfusion-chaos-") as scratch:
            folder = Path(scratch) if options.keep is None else options.keep / f"seed-{seed}"
            folder.mkdir(parents=True, exist_ok=True)
            counts = {"keyframes": options.keyframes, "kills": options.kills, "forgets": options.forgets}
            result = run(seed, folder, **counts)
        good += not result.problems
        print(msgspec.json.encode(result).decode(), flush=True)
    print(f"{good} of {options.seeds} good", file=sys.stderr)
    return 0 if good == options.seeds else 1


if __name__ == "__main__":
    sys.exit(main())
