# SPDX-License-Identifier: MIT
"""Attack a server in a dozen ways and show what a well-behaved scanner notices of it.

    python scripts/hostile.py                     every attack for 5 s, a table
    python scripts/hostile.py --seconds 20 --json the same as one JSON line
    python scripts/hostile.py --only unfinished tiny

The exit status is 1 when a keyframe of the well-behaved scanner is not in the map, the server or its fuser
died, or the gateway held more memory than its bound.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import msgspec

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))
from attacks import ATTACKS
from hostile_run import run, table


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--seconds", type=float, default=5.0, help="of each attack, and of peace before and after"
    )
    parser.add_argument("--only", nargs="+", choices=list(ATTACKS), default=list(ATTACKS), metavar="ATTACK")
    parser.add_argument("--keys", action="store_true", help="the server asks for them; attackers have none")
    parser.add_argument("--json", action="store_true", help="one line instead of a table")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tsfusion-hostile-") as folder:
        outcome = run(Path(folder), options.seconds, tuple(options.only), keys=options.keys)
    print(msgspec.json.encode(outcome).decode() if options.json else table(outcome))
    for problem in outcome.problems:
        print(problem, file=sys.stderr)
    return 1 if outcome.problems else 0


if __name__ == "__main__":
    sys.exit(main())
