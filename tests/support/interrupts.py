# SPDX-License-Identifier: MIT
"""Interrupts at any place, as Ctrl-C is one, again and again."""

import signal
import threading
from collections.abc import Callable
from contextlib import suppress

from keyframes_and_servers import DEADLINE

_TRIES = 200


class _Interrupt(BaseException):
    """Raised by a signal."""


def is_free_after_interrupts(use: Callable[[], object]) -> bool:
    """Interrupt this thread again and again while it uses something; whether another can use it then."""
    over = threading.Event()
    armed: set[str] = set()  # no event: an interrupt within its lock would wait for that lock without end

    def interrupt(*_: object) -> None:
        if armed:
            armed.clear()
            raise _Interrupt

    def bother(main: int) -> None:
        while not over.wait(2e-4):
            if armed:  # else handlers on a busy machine would interrupt each other without end
                signal.pthread_kill(main, signal.SIGUSR1)

    before = signal.signal(signal.SIGUSR1, interrupt)
    bothering = threading.Thread(target=bother, args=[threading.get_ident()])
    bothering.start()
    try:
        for _ in range(_TRIES):
            with suppress(_Interrupt):
                armed.add("once")
                while True:
                    use()
    finally:
        over.set()
        bothering.join()
        signal.signal(signal.SIGUSR1, before)
    other = threading.Thread(target=use, daemon=True)
    other.start()
    other.join(DEADLINE / 6)
    return not other.is_alive()
