# SPDX-License-Identifier: MIT
"""Attack a server in many ways and show what a well-behaved scanner notices of it.

    python lab/reliability/hostile.py                     each attack for 5 s at a server of its own; a table
    python lab/reliability/hostile.py --seconds 20 --form json
                                                          a JSON line an attack, longer attacks
    python lab/reliability/hostile.py --only unfinished tiny

Each line is one attack and the time until everything is as before: the delay of the scanner's keyframes from
capture to map, the longest wait for an answer of the control port, the highest memory of gateway and fuser,
restarts of fusers, seconds from the attack's end until everything is as before, and the problems that the
server told in its health.

The exit status is 1 when a keyframe of the well-behaved scanner is not in the map exactly once, its delay or
an answer takes longer than the bounds, the gateway held more memory than its own bound, or a process died.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from lab.reliability.attack_target import ACCESS
from lab.reliability.attacks import ATTACKS, ATTACKS_OF
from lab.reliability.hostile_run import HEADING, MEMORY_BYTES, Bounds, Outcome, markdown_row, row, run

_MB = 1 << 20


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=5.0, help="of each attack")
    parser.add_argument("--only", nargs="+", choices=list(ATTACKS), metavar="ATTACK")
    parser.add_argument(
        "--access", choices=ACCESS, default="open",
        help="open: there are no keys; stranger: the server asks for keys, attackers have none; allowed: "
        "attackers have a key that the server allows",
    )  # fmt: skip
    parser.add_argument("--delay", type=float, default=1.0, help="bound on the 99th percentile, s")
    parser.add_argument("--control", type=float, default=1.0, help="bound on the longest answer, s")
    parser.add_argument("--slack", type=float, default=0.0, help="MB of the gateway above its own bound")
    parser.add_argument(
        "--form", choices=("table", "json", "markdown"), default="table", help="markdown: docs/delivery.md's"
    )
    return parser.parse_args()


def _show(outcome: Outcome, form: str) -> None:
    attacks = [one for one in outcome.phases if one.attack != "none"]
    if form == "json":
        print(msgspec.json.encode(outcome).decode(), flush=True)
    else:
        print("\n".join(map(markdown_row if form == "markdown" else row, attacks)), flush=True)
    for problem in outcome.problems:
        print(f"  {problem}", file=sys.stderr, flush=True)


def main() -> int:
    options = _options()
    bounds = Bounds(delay_s=options.delay, control_s=options.control, slack_bytes=int(options.slack * _MB))
    if options.form == "table":
        print(f"the gateway's bound is {MEMORY_BYTES / 1e6:.0f} MB\n{HEADING}", flush=True)
    harmed = 0
    attacks = options.only or ATTACKS_OF[options.access]
    for attack in attacks:
        with tempfile.TemporaryDirectory(prefix="tsfusion-hostile-") as folder:
            outcome = run(Path(folder), options.seconds, (attack,), access=options.access, bounds=bounds)
        _show(outcome, options.form)
        harmed += bool(outcome.problems)
    print(f"{len(attacks) - harmed} of {len(attacks)} attacks harmed nobody", file=sys.stderr)
    return 1 if harmed else 0


if __name__ == "__main__":
    sys.exit(main())
