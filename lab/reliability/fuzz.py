# SPDX-License-Identifier: MIT
"""Feed mutated messages, journal segments, saved maps and recordings to what reads them; a line of JSON each.

    python lab/reliability/fuzz.py                            10⁶ cases over messages, segments and maps
    python lab/reliability/fuzz.py --only journal --cases 5000000 --seed 7
    python lab/reliability/fuzz.py --only folder-tum --cases 1000
    python lab/reliability/fuzz.py --corpus FOLDER            go on with what was found there, and add to it

With `atheris` (`pip install '.[fuzz]'`) guided by coverage; without it, and for control messages, by the
outcomes: what leads to a new one is mutated further. Only the named errors may come out, no case may take a
second of processor time (a recording ten), and the memory stays under --memory. The exit status is 1 when
something broke; the case is kept in --crashes.
"""

import argparse
import json
import os
import re
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
SHARES = {"message": 0.35, "control": 0.25, "corrections": 0.1, "journal": 0.25, "checkpoint": 0.05}
LAYOUTS = (
    *("euroc", "flat", "hololens", "kitti", "kitti-raw", "lidar-keyframes", "nerfstudio", "plain", "redwood"),
    *(
        "replica",
        "scannet",
        "scans",
        "scans-las",
        "scans-laz",
        "scans-pcd",
        "scans-ply",
        "seven-scenes",
        "stereo",
    ),
    *("tum", "bag-mcap", "bag-mcap-zstd", "bag-ros1", "bag-ros1-lz4", "bag-sqlite3"),
)
FOLDERS = {f"folder-{layout}": 0.001 for layout in LAYOUTS}  # of a recording's files
SHARES |= FOLDERS
INSTRUMENTED = ["tsfusion.wire", "tsfusion.journal", "tsfusion.tsdf.files.checkpoint",

                "tsfusion.geometry.keyframe", "tsfusion.gateway.intake.keyframe_intake"]  # fmt: skip
UNGUIDED = {"control", *FOLDERS}  # decided in C, whose coverage is not seen
_STATUS = re.compile(r"^#(\d+)\s+(\w+)\s+cov: (\d+) ft: (\d+) corp: (\d+)", re.MULTILINE)
_FINAL = re.compile(r"^stat::(\w+):\s+(\d+)", re.MULTILINE)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=list(SHARES), default=list(SHARES))
    parser.add_argument("--cases", type=int, default=1_000_000, help="in all")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--memory", type=int, default=512, help="MB that a target's process may hold")
    parser.add_argument("--corpus", type=Path, help="where cases that led somewhere new are kept")
    parser.add_argument(
        "--crashes", type=Path, default=Path("out/fuzz"), help="where a case that broke is kept"
    )
    parser.add_argument(
        "--engine", choices=("atheris", "own"), default="atheris" if find_spec("atheris") else "own"
    )
    parser.add_argument("--worker", choices=list(SHARES), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        return _work(options)
    whole = sum(SHARES[name] for name in options.only)
    good = True
    for name in options.only:
        result = _run(name, round(options.cases * SHARES[name] / whole), options)
        good &= not result["broken"]
        print(json.dumps(result), flush=True)
    return 0 if good else 1


def _run(name: str, cases: int, options: argparse.Namespace) -> dict[str, Any]:
    """One target in a process of its own."""
    engine = "own" if name in UNGUIDED else options.engine
    command = [
        *(sys.executable, __file__, "--worker", name, "--cases", str(cases), "--seed", str(options.seed)),
        *("--memory", str(options.memory), "--crashes", str(options.crashes), "--engine", engine),
        *(("--corpus", str(options.corpus)) if options.corpus else ()),
    ]
    started = time.monotonic()
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with (
        tempfile.TemporaryFile() as said,  # libjpeg and libpng have a lot to say
        tempfile.TemporaryDirectory(prefix="tsfusion-fuzz-", dir=memory) as scratch,
    ):
        environment = {**os.environ, "OPENCV_LOG_LEVEL": "SILENT", "TMPDIR": scratch}
        done = subprocess.run(command, stdout=subprocess.PIPE, stderr=said, check=False, env=environment)
        said.seek(0)
        words = said.read().decode(errors="replace")
    found = _atheris_figures(words) if engine == "atheris" else json.loads(done.stdout or b"{}")
    return {
        "target": name,
        "engine": engine,
        "seed": options.seed,
        "broken": words[-3000:] if done.returncode else "",
        **found,
        "seconds": round(time.monotonic() - started, 1),
    }


def _atheris_figures(words: str) -> dict[str, Any]:
    """From libFuzzer's status lines: branches reached after the seeds, and in the end."""
    lines = _STATUS.findall(words)
    final = {key: int(value) for key, value in _FINAL.findall(words)}
    started = next((line for line in lines if line[1] == "INITED"), ("0", "", "0", "0", "0"))
    last = lines[-1] if lines else started
    return {
        "cases": final.get("number_of_executed_units", int(last[0])),
        "coverage_of_seeds": int(started[2]),
        "coverage": int(last[2]),
        "features": int(last[3]),
        "corpus": int(last[4]),
        "slowest_s": final.get("slowest_unit_time_sec", 0),
        "peak_rss_mb": final.get("peak_rss_mb", 0),
    }


# --- in the target's process ---


def _work(options: argparse.Namespace) -> int:
    import logging
    import warnings

    logging.disable(logging.CRITICAL)  # damage is logged; here it is the rule
    warnings.simplefilter("error", RuntimeWarning)  # of NumPy, about numbers that nobody expected
    sys.path.insert(0, str(ROOT / "tests" / "support"))
    sys.path.append(str(ROOT))  # lab is not installed
    options.crashes.mkdir(parents=True, exist_ok=True)
    if options.engine == "atheris":
        _with_atheris(options)
        return 0  # never: libFuzzer ends the process
    from lab.reliability.fuzz_engine import fuzz

    found = fuzz(options.worker, options.cases, options.seed, crashes=options.crashes)
    if found.peak_rss_mb > options.memory:
        raise MemoryError(f"{found.peak_rss_mb:.0f} MB were held, {options.memory} allowed")
    figures = {
        "cases": found.cases,
        "outcomes": len(found.outcomes),
        "corpus": found.corpus,
        "slowest_s": found.slowest_ms / 1000,
        "peak_rss_mb": round(found.peak_rss_mb),
    }
    print(json.dumps(figures))
    return 0


def _with_atheris(options: argparse.Namespace) -> None:
    import random

    import atheris

    with atheris.instrument_imports(include=INSTRUMENTED):
        from lab.reliability import fuzz_targets
    from lab.reliability.fuzz_engine import timed

    target = fuzz_targets.TARGETS[options.worker]
    seeds = target.seeds()

    def mutate(content: bytes, most: int, seed: int) -> bytes:
        rng = random.Random(seed)
        if rng.random() < 0.3:
            return bytes(atheris.Mutate(content, most))
        return target.mutate(content, rng, seeds)[:most]

    def run(content: bytes) -> None:
        timed(target, content)

    folder = Path(tempfile.mkdtemp())
    first = folder / "seeds"
    first.mkdir()
    for number, content in enumerate(seeds):
        (first / str(number)).write_bytes(content)
    kept = (options.corpus or folder) / f"{options.worker}"
    kept.mkdir(parents=True, exist_ok=True)
    flags = {
        "runs": options.cases,
        "seed": options.seed,
        "max_len": fuzz_targets.MAX_BYTES,
        "rss_limit_mb": options.memory,
        "timeout": 20,
        "print_final_stats": 1,
        "artifact_prefix": f"{options.crashes}/{options.worker}-",
    }
    arguments = [sys.argv[0], *(f"-{key}={value}" for key, value in flags.items()), str(kept), str(first)]
    atheris.Setup(arguments, run, custom_mutator=mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    sys.exit(main())
