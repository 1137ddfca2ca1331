# SPDX-License-Identifier: MIT
"""Mutated messages, segments, saved maps and folders of recordings. Long: lab/reliability/fuzz.py."""

import contextlib
import random
import tracemalloc

import pytest

from lab.reliability import fuzz_mutate
from lab.reliability.fuzz_engine import fuzz
from lab.reliability.fuzz_folders import FOLDERS
from lab.reliability.fuzz_targets import TARGETS
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import Refused

CASES = {"message": 1000, "control": 3000, "corrections": 500, "journal": 300, "checkpoint": 150}
NIGHTLY = 60  # times as many
_CHECK_BYTES = 1 << 20  # besides the message itself


@pytest.mark.parametrize("times", [1, pytest.param(NIGHTLY, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", TARGETS)
def test_only_named_errors_come_out(name: str, times: int) -> None:
    found = fuzz(name, CASES[name] * times, seed=times)
    assert found.cases == CASES[name] * times
    assert len(found.outcomes) > 10, found


@pytest.mark.parametrize("cases", [10, pytest.param(1000, marks=pytest.mark.nightly)])
@pytest.mark.parametrize(
    "name",
    [pytest.param(one, marks=pytest.mark.slow if one == "folder-euroc" else ()) for one in FOLDERS],
)
def test_a_harmed_folder_gives_its_good_frames_or_is_refused(name: str, cases: int) -> None:
    assert fuzz(name, cases, seed=cases).cases == cases


def test_the_door_allocates_next_to_nothing() -> None:
    """Whatever a message announces; decoding is for the fuser, which has a memory limit."""
    target, rng = TARGETS["message"], random.Random(1)
    corpus = target.seeds()
    tracemalloc.start()
    try:
        for _ in range(1000):
            frames = fuzz_mutate.split(target.mutate(rng.choice(corpus), rng, corpus))
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            with contextlib.suppress(Refused):
                codec.check(frames)
            assert tracemalloc.get_traced_memory()[1] - before < _CHECK_BYTES, frames
    finally:
        tracemalloc.stop()
