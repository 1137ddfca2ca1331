# SPDX-License-Identifier: MIT
"""Scanner, gateway and fuser killed at seeded moments over a bad network; and what must be true afterwards.

The plan depends on the seed alone. What meets what depends on the machine: that is the point.
"""

import contextlib
import functools
import random
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any

from bad_network import Proxy
from keyframes_and_servers import NUMBERED_NS, UNSECURED, Secured, secured, until, wall
from msgspec import Struct
from quick_fusers import SUMS

from lab.reliability.chaos_plan import KINDS, Attack, Forgetting, Kind, fault, on_map, on_scanners, on_server
from lab.reliability.delivery_verdict import client_problems, server_problems, verify
from lab.reliability.scanner_process import Plan, journals, plan_in
from lab.reliability.supervisors import PATIENCE, Daemon, Scanner
from tsfusion import journal
from tsfusion.core.config import ClientConfig, override
from tsfusion.core.errors import TransportError, TsfusionError
from tsfusion.core.number_ranges import NumberRanges
from tsfusion.journal.ledger import Ledger
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.wire.asking.queries import fetch_health, fetch_status, forget
from tsfusion.wire.messages.forget_messages import Forgotten, Selection
from tsfusion.wire.messages.health import Status
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import unpack_keyframe

_RECORD_OVERHEAD = 300  # bytes of MCAP a keyframe

# Small files and frequent checkpoints: more moments at which a kill can hurt. What piled up comes faster than
# the quota, so clients are held, too.
SERVER = {"checkpoint_every": 20, "segment_bytes": 1 << 18, "quota_keyframes": 60.0}
CORRECT_EVERY = 7  # keyframes
CLIENT = ClientConfig(policy="spool_all", stall_timeout=0.4, segment_bytes=1 << 16)


class Kill(Struct, frozen=True):
    at: float
    kind: Kind
    ready: bool  # the server had been
    journaled: int  # keyframes, about


class Result(Struct, kw_only=True):
    """Result of one seed. `problems` is empty when every promise was kept."""

    seed: int
    forgotten: int  # keyframes
    erasures: int  # of a part of a session each
    keys: bool
    scanners: int
    problems: list[str]
    keyframes: int
    rate: float
    seconds: float
    kills: dict[str, int]
    before_ready: int  # kills of server or fuser while it started
    kill_times: list[Kill]
    link_faults: list[str]
    server_exits: list[str]  # of its own accord; it was started again
    sessions: int
    segments: int
    duplicates: int  # keyframes that came again, and were known
    refused: dict[str, int]  # messages that were not journaled
    carried_per_journaled: float  # bytes over the link / bytes in the journal


class Weather:
    """Faults of the network, one after the other, in a thread."""

    def __init__(self, rng: random.Random, proxy: Proxy) -> None:
        self.faults: list[str] = []
        self._rng, self._proxy = rng, proxy
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._blow)
        self._thread.start()

    def _blow(self) -> None:
        while not self._over.is_set():
            one = fault(self._rng)
            self.faults.append(one.what)
            method = getattr(self._proxy, one.what)
            method(*([] if one.value is None else [one.value]))
            self._over.wait(one.lasts)
            self._proxy.heal()
            self._over.wait(one.pause)

    def end(self) -> None:
        """Stop the faults; the network is good from here on."""
        self._over.set()
        self._thread.join()


class Watch:
    """Asks the server all the time how it is doing, past the bad network: its counts die with it."""

    def __init__(self, daemon: Daemon, keys: Secured) -> None:
        self._daemon, self._keys = daemon, keys
        self._seen: dict[str, tuple[int, dict[str, int]]] = {}  # by server process
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while not self._over.wait(0.1):
            server = self._daemon.server
            with contextlib.suppress(TsfusionError):
                if server.address:
                    health = fetch_health(server.address, keys=self._keys.keys, timeout=0.5)
                    self._seen[server.address] = (health.duplicates, health.refused)

    @property
    def duplicates(self) -> int:
        """Keyframes that all servers so far knew already."""
        return sum(duplicates for duplicates, _ in self._seen.values())

    @property
    def refused(self) -> dict[str, int]:
        """Messages that all servers so far refused, by reason."""
        found = Counter[str]()
        for _, refused in self._seen.values():
            found.update(refused)
        return dict(found)

    def end(self) -> None:
        """Stop asking; the counts stay."""
        self._over.set()
        self._thread.join()


class Killer:
    """Carries out attacks and notes them. Call `work` in any thread."""

    def __init__(self, daemon: Daemon, scanners: list[Scanner], proxy: Proxy, started: float) -> None:
        self.kills: list[Kill] = []
        self._proxy = proxy
        self._daemon = daemon
        self._scanners = scanners
        self._started = started

    def work(self, attacks: list[Attack]) -> None:
        """Carry out the attacks one after the other."""
        for number, attack in enumerate(attacks):
            scanner = self._scanners[number % len(self._scanners)]
            until(functools.partial(self._is_time, attack, scanner), PATIENCE)
            time.sleep(attack.wait)
            if attack.hold:
                self._proxy.freeze(True)
                time.sleep(attack.hold)
            ready, at = self._daemon.ready, round(time.monotonic() - self._started, 2)
            if self._kill(attack.kind, scanner):
                self.kills.append(Kill(at, attack.kind, ready, journaled(self._daemon.state)))
            if attack.hold:
                self._proxy.freeze(False)

    def _is_time(self, attack: Attack, scanner: Scanner) -> bool:
        if attack.kind == "scanner":
            return scanner.finished or scanner.taken * len(self._scanners) >= attack.keyframes
        if all(scanner.finished for scanner in self._scanners):
            return self._daemon.ready or not attack.ready
        return journaled(self._daemon.state) >= attack.keyframes and (self._daemon.ready or not attack.ready)

    def _kill(self, kind: Kind, scanner: Scanner) -> bool:
        """Kill a process; False when it has ended before."""
        if kind == "server":
            self._daemon.kill()
        elif kind == "fuser":
            self._daemon.kill_fuser()
        elif scanner.finished:
            return False
        else:
            scanner.kill()
        return True


class Forgetter:
    """Has the server forget keyframes, in a thread, and keeps what it said of it.

    Args:
        erased: a file for the numbers of walls, before they are erased.
    """

    def __init__(
        self, acts: list[Forgetting], daemon: Daemon, scanners: list[Scanner], keys: Secured, erased: Path
    ) -> None:
        self.told: list[tuple[bytes, NumberRanges, bool]] = []  # session, numbers, whether erased
        self.problems: list[str] = []
        self._daemon, self._scanners, self._keys, self._erased = daemon, scanners, keys, erased
        self._thread = threading.Thread(target=self._work, args=(acts,))
        self._thread.start()

    def end(self) -> None:
        """Wait until the server has said it of all."""
        self._thread.join()

    def _work(self, acts: list[Forgetting]) -> None:
        for act in acts:
            with contextlib.suppress(AssertionError):
                until(functools.partial(self._is_time, act), PATIENCE)
            selection, deadline = None, time.monotonic() + PATIENCE
            while time.monotonic() < deadline:
                with contextlib.suppress(TransportError):
                    selection = selection or self._selection(act)
                    if selection is None or self._ask(selection, act.erase):
                        break
                time.sleep(0.2)
            else:
                self.problems.append(f"the server does not say that it forgot {act}")

    def _is_time(self, act: Forgetting) -> bool:
        over = all(scanner.finished for scanner in self._scanners)
        return journaled(self._daemon.state) >= act.keyframes or over

    def _selection(self, act: Forgetting) -> Selection | None:
        """The keyframes of an act, by what is in the journal now."""
        found = self._walls()
        if not found:
            return None
        session, seq = sorted(found)[int(act.share * len(found))]
        if act.way == "session":
            return Selection(session=session.hex(), numbers=((1, seq),))
        if act.way == "numbers":
            return Selection(session=session.hex(), numbers=((seq, seq + 9), (seq + 15, seq + 16)))
        if act.way == "until":
            return Selection(until_ns=sorted(ns for _, ns in found.values())[int(act.share * len(found))])
        x = float(wall(found[session, seq][0]).T_world_camera[0, 3])
        return Selection(box=(x - 1.0, -9.0, -9.0, x + 1.0, 9.0, 9.0))

    def _ask(self, selection: Selection, erase: bool) -> bool:
        if not erase:
            return self._tell(selection)
        listed = self._forget(selection, dry_run=True)
        walls = self._walls()
        with self._erased.open("a") as file:
            for one in listed.sessions:
                for key, (i, _) in walls.items():
                    if key[0].hex() == one.session and key[1] in one.numbers:
                        file.write(f"{i}\n")
            file.flush()
        for one in listed.sessions:  # no more than was listed: a scanner that comes back looks for the rest
            known = [(n, n) for s, n in walls if s.hex() == one.session and n in one.numbers]
            if known and not self._tell(Selection(session=one.session, numbers=tuple(known)), erase=True):
                return False
        return True

    def _tell(self, selection: Selection, *, erase: bool = False) -> bool:
        done = self._forget(selection, erase=erase)
        self.told += [(bytes.fromhex(one.session), one.numbers, erase) for one in done.sessions]
        return True

    def _forget(self, selection: Selection, **how: Any) -> Forgotten:
        server = self._daemon.server
        if not server.address:
            raise TransportError("it starts")
        return forget(server.address, selection, timeout=20.0, keys=self._keys.keys, **how)

    def _walls(self) -> dict[tuple[bytes, int], tuple[int, int]]:
        """Session and number → number of the wall, and when it was journaled."""
        found = {}
        for folder in journals(self._daemon.state):
            for number in journal.segments(folder):
                for record in journal.records(journal.segment_path(folder, number)):
                    if not record.is_correction:
                        i = unpack_keyframe(record.frames[0]).timestamp_ns - NUMBERED_NS
                        found[record.session, record.seq] = i, record.logged_ns
        return found

    def verdict(self) -> list[str]:
        """Lies of the server: what it said of forgetting that is not so in its journal."""
        (folder,) = journals(self._daemon.state)
        forgotten = _forgotten(folder)
        left = set(self._walls())
        problems = list(self.problems)
        for session, numbers, erased in self.told:
            for seq in (seq for first, last in numbers for seq in range(first, last + 1)):
                if seq not in forgotten.forgotten_of(session):
                    problems.append(f"keyframe {seq} of {session.hex()[:8]} was forgotten, and is not")
                if erased and (session, seq) in left:
                    problems.append(f"keyframe {seq} of {session.hex()[:8]} was erased, and is there")
        return problems

    def count(self) -> int:
        """How many keyframes are forgotten."""
        (folder,) = journals(self._daemon.state)
        forgotten = _forgotten(folder)
        # Also where the answer was lost on its way, and nothing was left to forget when it was asked again
        sessions = {session for session, *_ in self.told} | {session for session, _ in self._walls()}
        return sum(forgotten.forgotten_of(session).count for session in sessions)


def _forgotten(folder: Path) -> Ledger:
    found = Ledger()
    for _, step in JournalPlace(folder).steps():
        if isinstance(step, journal.Record):
            found.take_forgetting(step)
    return found


def run(
    seed: int,
    folder: Path,
    *,
    keyframes: int = 300,
    kills: int = 12,
    forgets: int = 5,
    fuser: tuple[str, ...] | None = None,
) -> Result:
    """One seed in an empty folder; every other one with keys, and every other two with two scanners.

    Args:
        fuser: command of the server's fusers, as of `Server`.
    """
    keys = secured(folder / "keys") if seed % 2 == 0 else UNSECURED
    count = 1 + seed // 2 % 2
    rng = random.Random(seed)
    rate = rng.uniform(20, 40)
    third = kills // 3
    early, late = on_scanners(rng, keyframes, third), on_server(rng, keyframes, kills - third)
    started = time.monotonic()
    state = folder / "state"
    with contextlib.ExitStack() as stack:
        proxy = stack.enter_context(Proxy())
        daemon = Daemon(state, proxy, fuser=fuser, **SERVER, **keys.server)
        stack.callback(daemon.close)
        scanners = [
            Scanner(_plan(folder, proxy.address, range(first, keyframes, count), rate / count, keys))
            for first in range(count)
        ]
        for scanner in scanners:
            stack.callback(scanner.close)
        watch = Watch(daemon, keys)
        stack.callback(watch.end)
        weather = Weather(random.Random(-seed - 1), proxy)
        stack.callback(weather.end)
        acts = on_map(random.Random(-seed - 1000), keyframes, forgets)
        forgetter = Forgetter(acts, daemon, scanners, keys, folder / "erased")
        stack.callback(forgetter.end)
        killer = Killer(daemon, scanners, proxy, started)
        other = threading.Thread(target=killer.work, args=(early,))
        other.start()
        killer.work(late)
        other.join()
        weather.end()
        for scanner in scanners:
            scanner.wait()
        forgetter.end()
        problems = [scanner.problem for scanner in scanners if scanner.problem]
        watch.end()
        status = _status(daemon, keys)
        problems += [] if status else ["the server says nothing of itself"]
        if not problems and (code := daemon.stop()):
            problems.append(f"the server ended with status {code} after SIGTERM")
    seconds = time.monotonic() - started
    if len(killer.kills) < kills - 2:  # a scanner that has finished cannot be killed
        problems.append(f"only {len(killer.kills)} of {kills} were killed")
    if status and not problems:
        problems += server_problems(status, keyframes, forgetter.count())
        problems += forgetter.verdict()
        problems += [problem for scanner in scanners for problem in client_problems(scanner.report())]
        problems += verify(state, keyframes, status.map_hash, CORRECT_EVERY, sums=fuser == SUMS)
    return Result(
        seed=seed,
        forgotten=forgetter.count(),
        erasures=sum(erased for *_, erased in forgetter.told),
        keys=keys is not UNSECURED,
        scanners=count,
        problems=problems,
        keyframes=keyframes,
        rate=round(rate, 1),
        seconds=round(seconds, 1),
        kills={kind: sum(kill.kind == kind for kill in killer.kills) for kind in KINDS},
        before_ready=sum(not kill.ready and kill.kind != "scanner" for kill in killer.kills),
        kill_times=killer.kills,
        link_faults=weather.faults,
        server_exits=daemon.exits,
        sessions=status.sessions if status else 0,
        segments=sum(len(journal.segments(one)) for one in journals(state)),
        duplicates=watch.duplicates,
        refused=watch.refused,
        carried_per_journaled=round(proxy.carried / max(_bytes(state), 1), 2),
    )


@functools.cache
def _keyframe_bytes() -> int:
    sizes = [
        sum(map(len, codec.encode(wall(i), session=bytes(16), seq=1, jpeg_quality=CLIENT.jpeg_quality)))
        for i in range(0, 300, 15)
    ]
    return sum(sizes) // len(sizes) + _RECORD_OVERHEAD


def _bytes(state: Path) -> int:
    return sum(path.stat().st_size for folder in journals(state) for path in folder.glob("*.mcap"))


def journaled(state: Path) -> int:
    """Number of keyframes in the journal, estimated from its size because it is asked often."""
    with contextlib.suppress(OSError):
        return _bytes(state) // _keyframe_bytes()
    return 0


def _plan(folder: Path, address: str, numbers: range, rate: float, keys: Secured) -> Plan:
    first, client = numbers.start, override(CLIENT, **keys.client)
    names = {"spool": f"spool-{first}", "log": f"taken-{first}", "report": f"report-{first}.json"}
    names["erased"] = "erased"
    own = {name: str(folder / file) for name, file in names.items()}
    return plan_in(
        folder, address, count=numbers.stop, first=first, step=numbers.step, rate=rate,
        correct_every=CORRECT_EVERY, patience=PATIENCE, client=client, **own,
    )  # fmt: skip


def _status(daemon: Daemon, keys: Secured) -> Status | None:
    found: list[Status] = []

    def answered() -> bool:
        with contextlib.suppress(TransportError):
            found.append(fetch_status(daemon.server.address, timeout=5.0, keys=keys.keys))
        return bool(found) and found[-1].fuser == "idle"  # the last one may have been killed in the end

    with contextlib.suppress(AssertionError):
        until(lambda: daemon.ready and answered())
    return found[-1] if found else None
