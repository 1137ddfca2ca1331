# SPDX-License-Identifier: MIT
"""Work beside the tracker: in order, bounded, and no error is lost."""

import threading

import pytest

from tsfusion.scanner.localization.loop_closure.loop_closing import OrderedWork

SOON = 20.0  # seconds


def test_calls_are_made_in_order() -> None:
    work, made = OrderedWork("test", 3), list[int]()
    for number in range(50):
        work.add(made.append, number)
    work.wait()
    assert made == list(range(50))


def test_what_waits_has_an_end() -> None:
    work, go, began = OrderedWork("test", 2), threading.Event(), threading.Event()

    def slow() -> None:
        began.set()
        assert go.wait(SOON)

    work.add(slow)
    work.add(lambda: None)
    assert began.wait(SOON)
    added = threading.Event()
    adding = threading.Thread(target=lambda: (work.add(lambda: None), added.set()), daemon=True)
    adding.start()
    assert not added.is_set()  # there is no room
    go.set()
    assert added.wait(SOON)
    adding.join(SOON)
    work.wait()


def test_an_error_is_raised() -> None:
    work = OrderedWork("test", 2)
    work.add(lambda: 1 // 0)  # type: ignore[arg-type,return-value]
    with pytest.raises(ZeroDivisionError):
        work.wait()
    work.wait()
