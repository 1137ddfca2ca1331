# SPDX-License-Identifier: MIT
"""Take guarding lines away, one at a time, in a copy of the sources, and see that a test notices each.

    python lab/reliability/plant_faults.py                  all of them: a JSON line each
    python lab/reliability/plant_faults.py --only spool     those whose file or line matches
    python lab/reliability/plant_faults.py --first 10 --limit 5

The guards are those of journal, checkpoints, sessions, admission, spool, questions, pages, moves, jobs, the
map's sums, recordings, verdicts and files for others (lab/reliability/planted_faults.py). The tests that they
name have to pass with all guards there; then each runs with its guard away. The exit status is 1 when one
passes all the same: it needs a test.
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.reliability.planted_faults import FAULTS, Fault

_ROOT = Path(__file__).parents[2]
_COPIED = ("tsfusion", "lab", "tests", "scripts", "docs", "contrib", "pyproject.toml", "README.md")
_LONGEST_S = 300.0  # that a test may take; a fault may make one hang, which is noticed, too


def is_noticed(root: Path, fault: Fault) -> bool:
    """True if the test of a fault fails with the fault in the sources below `root`."""
    path = root / "tsfusion" / fault.file
    whole = path.read_text(encoding="utf-8")
    if whole.count(fault.old) != 1:
        raise SystemExit(f"{fault.file} does not have {fault.old!r} once: say anew what the fault is")
    path.write_text(whole.replace(fault.old, fault.new), encoding="utf-8")
    try:
        return fails(root, [fault.test])
    finally:
        path.write_text(whole, encoding="utf-8")


def fails(root: Path, tests: list[str]) -> bool:
    """True if one of some tests fails, or does not end."""
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-n0", "-p", "no:cacheprovider"]
    command += [f"tests/{test}" for test in tests]
    environment = {**os.environ, "PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            command,
            cwd=root,
            env=environment,
            capture_output=True,
            text=True,
            timeout=_LONGEST_S * len(tests),
            check=False,
        )
    except subprocess.TimeoutExpired:
        return True
    if done.returncode not in (0, 1):
        raise SystemExit(f"{tests} cannot be run: {done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode == 1


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="a regular expression")
    parser.add_argument("--first", type=int, default=1, help="number of the first fault")
    parser.add_argument("--limit", type=int, help="how many faults")
    options = parser.parse_args()
    chosen = [
        (number, one)
        for number, one in enumerate(FAULTS, 1)
        if re.search(options.only, f"{one.file} {one.old}")
    ][options.first - 1 :][: options.limit]
    missed = 0
    with tempfile.TemporaryDirectory(prefix="tsfusion-planted-") as folder:
        root = Path(folder)
        for name in _COPIED:
            source, skip = _ROOT / name, shutil.ignore_patterns("__pycache__")
            if source.is_dir():
                shutil.copytree(source, root / name, ignore=skip)
            else:
                shutil.copy(source, root / name)
        if fails(root, sorted({one.test for _, one in chosen})):
            raise SystemExit("one of the tests fails with all guards there")
        for number, fault in chosen:
            began = time.monotonic()
            noticed = is_noticed(root, fault)
            missed += not noticed
            line = {"number": number, "file": fault.file, "fault": fault.old.strip(), "test": fault.test}
            line["noticed"] = noticed
            print(json.dumps({**line, "seconds": round(time.monotonic() - began, 1)}), flush=True)
    print(f"{len(chosen) - missed} of {len(chosen)} faults are noticed", file=sys.stderr)
    return int(missed > 0)


if __name__ == "__main__":
    sys.exit(main())
