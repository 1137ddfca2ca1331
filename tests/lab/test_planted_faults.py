# SPDX-License-Identifier: MIT
"""The faults of lab/reliability/plant_faults.py still fit the sources; the script itself takes long."""

from repository import ROOT

from lab.reliability.planted_faults import FAULTS


def test_each_guard_stands_once_and_its_test_is_there() -> None:
    assert len(FAULTS) >= 40
    for one in FAULTS:
        path = ROOT / "tsfusion" / one.file
        whole = path.read_text(encoding="utf-8")
        assert whole.count(one.old) == 1, (one.file, one.old)
        assert one.new != one.old
        compile(whole.replace(one.old, one.new), one.file, "exec")  # else each test would notice
        file, name = one.test.split("::")
        assert f"\ndef {name}(" in (ROOT / "tests" / file).read_text(encoding="utf-8"), one.test


def test_no_fault_is_planted_twice() -> None:
    assert len({(one.file, one.old) for one in FAULTS}) == len(FAULTS)
