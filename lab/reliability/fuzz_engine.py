# SPDX-License-Identifier: MIT
"""A fuzzer without coverage: what leads to an outcome that was not seen before is mutated further."""

import random
import re
import resource
import time
from collections import Counter
from pathlib import Path

from msgspec import Struct

from lab.reliability.fuzz_folders import FOLDERS
from lab.reliability.fuzz_targets import MAX_BYTES, TARGETS, Broken, Target

_MAX_CORPUS = 4096


class Found(Struct, kw_only=True):
    """Result of a run of our own engine."""

    cases: int
    seconds: float
    outcomes: dict[str, int]
    corpus: int
    slowest_ms: float
    peak_rss_mb: float


def timed(target: Target, content: bytes) -> tuple[str, float]:
    """A case's outcome, and the processor time it took, seconds."""
    started = time.process_time()
    outcome = target.run(content)
    taken = time.process_time() - started
    if taken > target.slow_s:
        raise Broken(f"a case of {len(content)} bytes took {taken:.1f} s: {outcome}")
    return outcome, taken


def fuzz(name: str, cases: int, seed: int, *, crashes: Path | None = None) -> Found:
    """So many cases. What breaks a promise is raised, and the case kept in a folder."""
    target, rng = (TARGETS | FOLDERS)[name], random.Random(seed)
    corpus, seen = target.seeds(), Counter[str]()
    started, slowest, done = time.monotonic(), 0.0, 0
    while done < cases:
        content = target.mutate(rng.choice(corpus), rng, corpus)[:MAX_BYTES]
        try:
            outcome, taken = timed(target, content)
        except Exception as error:
            if crashes is not None:
                (crashes / f"{name}-{seed}-{done}").write_bytes(content)
            raise Broken(f"{name}: case {done} of seed {seed}: {error!r}") from error
        label = _label(outcome)
        if label not in seen and len(corpus) < _MAX_CORPUS:
            corpus.append(content)
        seen[label] += 1
        slowest, done = max(slowest, taken), done + 1
    return Found(
        cases=done,
        seconds=round(time.monotonic() - started, 2),
        outcomes=dict(seen.most_common()),
        corpus=len(corpus),
        slowest_ms=round(1000 * slowest, 2),
        peak_rss_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    )


def _label(outcome: str) -> str:
    return re.sub(r"(?<!^)\d+|'.*?'|b\".*?\"|\[.*\]|\(.*\)|`.*?`", "#", outcome)[:100]
