# SPDX-License-Identifier: MIT
"""Calls beside this thread: in order, few at a time, and their errors are heard."""

import threading
from functools import partial

import pytest

from tsfusion.tsdf.files.checkpoint import SideThread


def test_calls_are_done_in_order_in_another_thread() -> None:
    done: list[int] = []
    threads = set[int]()
    with SideThread() as side:
        for number in range(100):
            side.do(partial(done.append, number))
            side.do(lambda: threads.add(threading.get_ident()))
        side.wait()
        assert done == list(range(100))
    assert len(threads) == 1
    assert threads != {threading.get_ident()}


def test_no_more_than_a_few_wait() -> None:
    gate, begun, done = threading.Event(), threading.Event(), list[int]()
    with SideThread() as side:
        side.do(lambda: (begun.set(), gate.wait(60)))
        side.do(partial(done.append, 1))
        threading.Timer(0.05, gate.set).start()
        side.do(partial(done.append, 2))  # waits for the first
        assert gate.is_set()
        side.wait()
    assert done == [1, 2]


def failing() -> None:
    raise ValueError("heard")


def test_an_error_is_raised_where_the_calls_come_from() -> None:
    with SideThread() as side:
        side.do(failing)
        with pytest.raises(ValueError, match="heard"):
            side.wait()
        for _ in range(2):
            side.do(failing)
        with pytest.raises(ValueError, match="heard"):
            side.do(failing)


def test_without_a_thread_the_calls_are_done_here(monkeypatch: pytest.MonkeyPatch) -> None:
    def start(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    done: list[int] = []
    with monkeypatch.context() as patched, SideThread() as side:
        patched.setattr(threading.Thread, "start", start)
        for number in range(5):
            side.do(partial(done.append, number))
        side.wait()
    assert done == list(range(5))
