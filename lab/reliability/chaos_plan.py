# SPDX-License-Identifier: MIT
"""The plan of a chaos run, drawn from its seed: which process is killed when, and what the network does."""

import random
from typing import Literal

from msgspec import Struct

Kind = Literal["server", "fuser", "scanner"]
Way = Literal["session", "numbers", "until", "box"]
KINDS: tuple[Kind, ...] = ("server", "fuser", "scanner")


class Attack(Struct, frozen=True):
    """A process to be killed.

    Attributes:
        keyframes: not before so many are in the journal (a scanner: not before it took so many).
        ready: not before the server is ready.
        wait: seconds from then.
        hold: before it dies, the link carries nothing for so many seconds: keyframes are under way then.
    """

    kind: Kind
    keyframes: int
    ready: bool
    wait: float
    hold: float = 0.0


class Forgetting(Struct, frozen=True):
    """Keyframes that the server is told to forget, again and again until it says that it did.

    Attributes:
        keyframes: not before so many are in the journal.
        way: `session` = the first ones of one; `numbers` = a part of them; `until` = all that came before
            some time; `box` = those that were taken in a part of the map.
        share: how much, 0 to 1.
        erase: also delete them from the journal.
    """

    keyframes: int
    way: Way
    share: float
    erase: bool


class Fault(Struct, frozen=True):
    """A method of `Proxy`, what it is called with, and for how long; then comes a `pause`."""

    what: str
    value: float | bool | None
    lasts: float
    pause: float


def on_scanners(rng: random.Random, keyframes: int, kills: int) -> list[Attack]:
    """Attacks on scanners while they send, whatever becomes of the server meanwhile."""
    moments = sorted(rng.randrange(keyframes) for _ in range(kills))
    return [Attack("scanner", at, False, rng.uniform(0.0, 0.3)) for at in moments]


def on_server(rng: random.Random, keyframes: int, kills: int) -> list[Attack]:
    """Attacks on gateway and fuser: mostly in full flow, sometimes while a killed one starts again."""
    kinds: list[Kind] = ["server" if i % 2 else "fuser" for i in range(kills)]
    rng.shuffle(kinds)
    moments = sorted(rng.randrange(keyframes) for _ in kinds)
    planned: list[Attack] = []
    for kind, at in zip(kinds, moments, strict=True):
        if planned and rng.random() < 0.25:
            planned.append(Attack(kind, planned[-1].keyframes, False, rng.uniform(0.05, 2.5)))
        else:
            hold = rng.choice([0.0, rng.uniform(0.1, 0.4)])
            planned.append(Attack(kind, at, True, rng.uniform(0.0, 1.5), hold))
    return planned


def on_map(rng: random.Random, keyframes: int, count: int) -> list[Forgetting]:
    """Requests to forget, most of them of few keyframes."""
    ways: list[Way] = ["numbers", "until", "box", "numbers", "session"]
    moments = sorted(rng.randrange(keyframes // 4, keyframes) for _ in range(count))
    return [
        Forgetting(at, ways[i % len(ways)], rng.uniform(0.05, 0.3), rng.random() < 0.5)
        for i, at in enumerate(moments)
    ]


def fault(rng: random.Random) -> Fault:
    """A fault that networks have."""
    kinds = ["cut", "forget", "half_close", "refuse", "throttle", "delay", "freeze", "swallow", "mute"]
    what = rng.choice([*kinds, *3 * ["jam"]])
    value: float | bool | None = True
    lasts, pause = rng.uniform(0.2, 2.0), rng.uniform(0.3, 2.0)
    if what in ("cut", "forget", "half_close"):
        value, lasts = None, 0.0
    elif what == "throttle":
        value = rng.uniform(20e3, 80e3)
    elif what == "jam":
        lasts += 0.8  # longer than a scanner waits before it sends again
    elif what == "delay":
        value = rng.uniform(0.01, 0.08)
    return Fault(what, value, lasts, pause)
