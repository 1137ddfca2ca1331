# SPDX-License-Identifier: MIT
"""Run the paper's experiments again, with the control that it lacks, and check its claims.

    python lab/paper/reproduce_paper.py --out DIR            all of it, one run a mode (an hour on 2 cores)
    python lab/paper/reproduce_paper.py --out DIR --quick    short recordings (5 minutes)
    python lab/paper/reproduce_paper.py --out DIR --runs 5   for tables with a spread
    python lab/paper/reproduce_paper.py --list               the runs, and about how long each takes

A mode is a way to put localisation and fusion onto machines: in one process with an unbounded queue, as the
paper's baseline, or with a bounded one, which is the control; as scanner and server; with a slow server; over
a slow link. The recording plays in real time, and a front end that is late loses frames. DIR gets run.json
with the verdicts, delay.csv, memory.csv, ate.csv, surface.csv, figures and report.html.

A run that is done is not made again: the same command goes on after Ctrl-C. Rendering is kept in --cache, and
its time is apart. The exit status is 0 when everything could be measured, whether the claims are met or not.
"""

import argparse
import contextlib
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

import msgspec

from lab.bench.peers import unimportable
from lab.paper import paper_again, paper_conduct, paper_docs, paper_outcome, paper_report
from lab.paper.paper_limits import calibrate
from lab.paper.paper_outcome import Outcome
from lab.paper.paper_render import RECORD as RENDERED
from lab.paper.paper_runs import AGAIN, Limits, Machine, Run, plan, source_of
from lab.paper.paper_surface import PEERS, MapJob, SweepJob
from lab.paper.paper_verdicts import Findings, Verdict, verdicts
from lab.paper.paper_worlds import PaperWorld, sweep_worlds, worlds
from tsfusion.core import process
from tsfusion.core.errors import OutputError, TsfusionError

HERE = Path(__file__).parent
_CHILD_S = 1800.0
_RENDERING_S = 6 * 3600.0  # on a slow machine; what is rendered is kept
_RUNNING: "set[subprocess.Popen[bytes]]" = set()  # children under way
Job = MapJob | SweepJob


def main() -> int:
    options = parse()
    limits = limits_of(options)
    found = worlds(quick=options.quick, kitti=options.kitti, corbs=options.corbs, frames=options.frames)
    runs = plan(found, limits, quick=options.quick, runs=options.runs, only=options.only)
    if options.list:
        print("\n".join(f"{run.name}  {run.seconds * limits.pace:.0f} s" for run in runs))
        return 0
    if not runs:
        say(f"no run has such a name: {' '.join(options.only)}; --list shows them")
        return 2
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        return reproduce(options, limits, found, runs)
    except KeyboardInterrupt:
        say("stopped; what is done is kept, and the same command goes on")
        return 130
    except TsfusionError as error:
        say(str(error))
        return 1
    except OSError as error:
        say(f"cannot write {error.filename}: {error.strerror}; choose another --out or --cache")
        return 1


def parse() -> argparse.Namespace:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=Path("out/paper"), metavar="DIR")
    parser.add_argument("--quick", action="store_true", help="short recordings, the regularised map only")
    parser.add_argument("--runs", type=positive(int), default=1, metavar="N", help="of each mode (default 1)")
    parser.add_argument("--only", nargs="+", default=(), metavar="MODE", help="runs whose name holds a word")
    parser.add_argument("--frames", type=positive(int), metavar="N", help="the first N of each recording")
    parser.add_argument("--list", action="store_true", help="print the runs, make none")
    parser.add_argument("--kitti", type=Path, metavar="PATH", help="the real KITTI odometry, 06 and 07")
    parser.add_argument("--corbs", type=Path, metavar="PATH", help="the real CoRBS Desk1")
    parser.add_argument("--cache", type=Path, metavar="PATH", help="rendered frames (default DIR/worlds)")
    parser.add_argument("--pace", type=positive(float), default=1.0, metavar="X",
                        help="play X times slower than real time, on a slow machine")  # fmt: skip
    parser.add_argument("--write-docs", action="store_true", help="put verdicts and figures into docs/")
    small = Limits()
    assert small.robot.memory_bytes is not None
    parser.add_argument("--robot-memory", type=positive(int), default=small.robot.memory_bytes >> 20,
                        metavar="MIB", help="of the simulated small machine")  # fmt: skip
    parser.add_argument("--robot-share", type=share, default=small.robot.share, help="of its one core's time")
    parser.add_argument("--server-share", type=share, default=small.server_share, help="of a slow server")
    options = parser.parse_args()
    for number in ("06", "07") if options.kitti else ():
        if not (options.kitti / "sequences" / number / "image_0").is_dir():
            parser.error(
                f"--kitti: no sequences/{number}/image_0 in {options.kitti}; give the odometry's folder"
            )
    if options.corbs and not options.corbs.is_dir():
        parser.error(f"--corbs: no folder {options.corbs}; give that of Desk1's recording")
    return options


def positive(kind: Callable[[str], Any]) -> Callable[[str], Any]:
    """A number above 0, of an option."""

    def read(text: str) -> Any:
        if not (number := kind(text)) > 0:
            raise argparse.ArgumentTypeError(f"expected more than 0, got {text}")
        return number

    return read


def share(text: str) -> float:
    """A share above 0, at most 1."""
    if not 0 < (number := float(text)) <= 1:
        raise argparse.ArgumentTypeError(f"expected more than 0 and at most 1, got {text}")
    return number


def limits_of(options: argparse.Namespace) -> Limits:
    robot = Machine(name="robot", cores=1, share=options.robot_share, memory_bytes=options.robot_memory << 20)
    return Limits(robot=robot, server_share=options.server_share, pace=options.pace)


def reproduce(options: argparse.Namespace, limits: Limits, found: list[PaperWorld], runs: list[Run]) -> int:
    """Render, run, measure, judge; the exit status."""
    out: Path = options.out
    (out / "runs").mkdir(parents=True, exist_ok=True)
    shares = [each for each in (limits.server_share, limits.robot.share) if each < 1]
    calibration = {f"{each:g}": round(calibrate(each), 3) for each in shares}
    say(f"{limits.robot.described}; share of the time → speed measured: {calibration}")
    names = {run.world.name for run in runs}
    found = [world for world in found if world.name in names]
    cached = {world.name: rendered(world, options.cache or out / "worlds") for world in found}
    found = [cached[world.name] for world in found]
    runs = [msgspec.structs.replace(run, world=cached[run.world.name]) for run in runs]
    failures: dict[str, str] = {}
    outcomes = make_all(runs, out, limits, failures)
    maps, sweep = measure_surfaces(options, found, [run for run in runs if run.name in outcomes], failures)
    findings = Findings(worlds=found, outcomes=list(outcomes.values()), sweep=sweep)
    told = {"failures": failures, "calibration": calibration, "maps": maps}
    made = conclude(out, findings, limits, told, write_docs=options.write_docs)
    for name, verdict in made.items():
        state = {True: "met", False: "NOT MET", None: "not measured"}[verdict.met]
        print(f"{name}: {state}. {verdict.words} (wanted: {verdict.wanted})")
    for name, why in failures.items():
        say(f"not made: {name}: {why}")
    say(f"written: {out / paper_report.REPORT}")
    expected = [verdict for name, verdict in made.items() if not options.only or verdict.met is not None]
    return int(bool(failures) or any(verdict.met is None for verdict in expected))


def rendered(world: PaperWorld, cache: Path) -> PaperWorld:
    """The world with its frames in a folder, rendered now if they are not there yet."""
    if not world.is_rendered:
        return world
    told = msgspec.json.encode(world)
    folder = cache / f"{world.name}-{hashlib.sha256(told).hexdigest()[:12]}"
    if not (folder / RENDERED).exists() and not (folder / "sequences").is_dir():
        cache.mkdir(parents=True, exist_ok=True)
        orders = folder.with_suffix(".json")
        orders.write_bytes(told)
        began = time.monotonic()
        said = folder.with_suffix(".log")
        say(f"rendering {world.title} into {folder} (once; not part of any run)")
        try:
            child([str(HERE / "paper_render.py"), str(orders), str(folder)], said, _RENDERING_S)
        except subprocess.SubprocessError as error:
            why = f"{world.title} cannot be rendered into {folder}: {error}; see {said}"
            raise OutputError(f"{why}; is another run of this command rendering it?") from error
        say(f"rendered in {time.monotonic() - began:.0f} s")
    return msgspec.structs.replace(world, cache=str(folder))


def make_all(runs: list[Run], out: Path, limits: Limits, failures: dict[str, str]) -> dict[str, Outcome]:
    """Make the runs that are not done; the outcomes of all."""
    outcomes: dict[str, Outcome] = {}
    needed = journals_needed(runs, out, limits)
    for number, run in enumerate(runs, 1):
        folder = out / "runs" / run.name
        settings = paper_conduct.fingerprint(run, limits)
        title = f"[{number}/{len(runs)}] {run.name}"
        done = paper_outcome.read(folder, settings)
        if done is not None and (run.name not in needed or (folder / paper_conduct.STATE).is_dir()):
            outcomes[run.name] = done
            continue
        say(f"{title}: {run.seconds * limits.pace:.0f} s or so")
        try:
            outcome = make(run, folder, limits, outcomes, settings)
        except (TsfusionError, OSError, ValueError, subprocess.SubprocessError) as error:
            failures[run.name] = str(error)
            say(f"{title}: failed: {error}")
            continue
        outcomes[run.name] = outcome
        end = f"; died of {outcome.died_of} at keyframe {outcome.died_at}" if outcome.death else ""
        delay = f", delay {outcome.delay_ms.mean:.0f} ms" if outcome.delay_ms.count else ""
        say(f"{title}: {outcome.fused} of {outcome.planned} keyframes{delay}{end}")
    drop_journals(out, outcomes, journals_needed(runs, out, limits))
    return outcomes


def journals_needed(runs: list[Run], out: Path, limits: Limits) -> set[str]:
    """Names of the live runs whose keyframes are still to be sent again."""
    return {
        source_of(run).name
        for run in runs
        if run.mode in AGAIN
        and paper_outcome.read(out / "runs" / run.name, paper_conduct.fingerprint(run, limits)) is None
    }


def make(run: Run, folder: Path, limits: Limits, outcomes: dict[str, Outcome], settings: str) -> Outcome:
    tell = progress()
    if run.mode not in AGAIN:
        return paper_conduct.conduct(run, folder, limits, tell)
    source = source_of(run)
    if source.name not in outcomes:
        raise ValueError(f"{source.name} was not made")
    state = folder.with_name(source.name) / paper_conduct.STATE
    return paper_again.conduct(
        run, outcomes[source.name], folder, state=state, limits=limits, tell=tell, settings=settings
    )


def drop_journals(out: Path, outcomes: dict[str, Outcome], needed: set[str]) -> None:
    """Remove journals and spools that no run that is still to be made needs."""
    for name in outcomes.keys() - needed:
        for part in (paper_conduct.STATE, "spool"):
            shutil.rmtree(out / "runs" / name / part, ignore_errors=True)


def measure_surfaces(
    options: argparse.Namespace, found: list[PaperWorld], runs: list[Run], failures: dict[str, str]
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Figures of the runs' maps by the run's name, and the rows of the sweep."""
    mapped: dict[str, tuple[Job, str]] = {}
    for run in runs:
        folder = options.out / "runs" / run.name
        if run.mode in ("decentralised", "loops") and run.number == 1 and (folder / "map.tsf").is_file():
            job = MapJob(
                world=run.world, map=str(folder / "map.tsf"), poses=str(folder / paper_outcome.POSES),
                pictures=str(folder / "picture"),
            )  # fmt: skip
            mapped[run.name] = job, f"the map of {run.name}"
    swept: list[tuple[Job, str]] = []
    if not options.only:
        swept = [
            (sweep_job(world, quick=options.quick), f"λ and support on {world.title}")
            for world in sweep_worlds(found)
        ]
    made = answers([*swept, *mapped.values()], options.out, failures)
    rows = [row for each in made[: len(swept)] for row in each or []]
    return {name: each or {} for name, each in zip(mapped, made[len(swept) :], strict=True)}, rows


def answers(jobs: list[tuple[Job, str]], out: Path, failures: dict[str, str]) -> list[Any]:
    """Answers of jobs with titles, as many made at a time as there are cores: none of them is timed."""
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        try:
            return list(pool.map(lambda job: answer(job[0], out, job[1], failures), jobs))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for running in list(_RUNNING):
                running.kill()
            raise


def sweep_job(world: PaperWorld, *, quick: bool) -> SweepJob:
    """A few keyframes of a short stretch, so that they see the same surface; each setting sees all."""
    peers = tuple(peer for peer in PEERS if not unimportable(peer) and _can(peer, world))
    return SweepJob(
        world=world, keyframes=8 if quick else 40, stretch=12 if quick else 80, peers=peers,
        smoothness=(1.0, 10.0, 100.0) if quick else (0.1, 1.0, 10.0, 100.0, 1000.0),
        supports=(3.0, 10.0) if quick else (3.0, 6.0, 10.0),
        weights=(1.0, 2.0) if quick else (0.5, 1.0, 2.0, 3.0, 5.0, 8.0),
    )  # fmt: skip


def _can(peer: str, world: PaperWorld) -> bool:
    """True if a system takes what the sensor gives: Open3D takes images only."""
    return peer == "vdbfusion" or world.sensor != "lidar"


def answer(job: Job, out: Path, title: str, failures: dict[str, str]) -> Any:
    """The answer of a job, made in a process of its own or earlier; None = it failed."""
    told = msgspec.json.encode(job)
    changed = ""
    if isinstance(job, MapJob):  # the map of a run that was made again is another one
        changed = str(Path(job.map).stat().st_mtime_ns)
    name = hashlib.sha256(told + changed.encode()).hexdigest()[:16]
    place = out / "surface"
    place.mkdir(exist_ok=True)
    orders, found = place / f"{name}-job.json", place / f"{name}.json"
    if not found.exists():
        say(f"measuring {title}")
        orders.write_bytes(told)
        partial = found.with_suffix(".partial")
        try:
            child([str(HERE / "paper_surface.py"), str(orders), str(partial)], place / f"{name}.log")
        except subprocess.SubprocessError as error:
            failures[title] = f"{error}; see {place / f'{name}.log'}"
            return None
        partial.replace(found)
    return json.loads(found.read_bytes())


def conclude(
    out: Path, findings: Findings, limits: Limits, told: dict[str, Any], *, write_docs: bool
) -> dict[str, Verdict]:
    """Judge, and write everything but what the runs wrote themselves."""
    rows = list(paper_report.ate_rows(findings.outcomes, out / "runs"))
    findings.cuts = paper_report.cut_errors(rows)
    made = verdicts(findings)
    paper_report.write_tables(out, findings, rows, told["maps"])
    drawn = paper_report.draw(out, findings)
    paper_report.write_record(out, findings, made, limits=limits, told=told)
    paper_report.write_page(out, findings, made, rows, limits=limits, told=told, drawn=drawn)
    if write_docs:
        paper_docs.write(HERE.parents[1] / "docs", findings, made, rows, drawn)
    return made


def child(command: list[str], log: Path, most_s: float = _CHILD_S) -> None:
    """Run a script of ours; raise SubprocessError when it fails or takes too long. Ctrl-C ends it."""
    with (
        log.open("wb") as said,
        subprocess.Popen(
            [sys.executable, *command], stdout=said, stderr=said, **process.OWN_GROUP
        ) as running,
    ):
        _RUNNING.add(running)
        try:
            code = running.wait(most_s)
        except BaseException:
            running.kill()
            raise
        finally:
            _RUNNING.discard(running)
    if code:
        raise subprocess.CalledProcessError(code, command[0])


def progress() -> Callable[[str], None]:
    """Shows how far a run is, on one line of a terminal; in a file nothing."""
    if not sys.stderr.isatty():
        return lambda _text: None

    def tell(text: str) -> None:
        with contextlib.suppress(OSError):
            sys.stderr.write(f"\r\x1b[K  {text}\r")
            sys.stderr.flush()

    return tell


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
