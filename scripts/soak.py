# SPDX-License-Identifier: MIT
"""Send keyframes of one small room for a long time, as fast as they are fused, and watch what grows.

    python scripts/soak.py --keyframes 10000      a table, then one JSON line

The exit status is 1 when the memory of gateway, fuser or scanner rises by more than --tolerance MB from the
time the map is complete, when files or threads become more, or a keyframe is missing.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import msgspec

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from soak_run import TOLERANCE_MB, run, table


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--tolerance", type=float, default=TOLERANCE_MB, help="MB")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tsfusion-soak-") as folder:
        outcome = run(Path(folder), options.keyframes, tolerance_mb=options.tolerance)
    print(table(outcome), file=sys.stderr)
    few = outcome.samples[:: max(len(outcome.samples) // 100, 1)]
    print(msgspec.json.encode(msgspec.structs.replace(outcome, samples=few)).decode())
    for problem in outcome.problems:
        print(problem, file=sys.stderr)
    return 1 if outcome.problems else 0


if __name__ == "__main__":
    sys.exit(main())
