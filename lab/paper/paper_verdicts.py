# SPDX-License-Identifier: MIT
"""Verdicts over all runs: what was measured, what was wanted, whether it is met, and what that says."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from msgspec import Struct

from lab.paper.paper_outcome import Outcome
from lab.paper.paper_runs import AGAIN, MODES
from lab.paper.paper_worlds import PaperWorld

DELAY_MS, TARGET_MS, TARGET_P99_MS = 500.0, 100.0, 500.0
BOUNDED_P99_MS = 2000.0
DRIFT_MS = 100.0  # that the delay may grow over a whole run
FLAT_MIB = 16.0  # that memory without map and queue may grow in half a run
CORES, SCANNER_MB = 1.2, 250.0
DRIFT_PERCENT = 1.0
LATE_SHARE = 0.02  # of the frames
WORSE = 1.1  # times the error that is still as good
F_GAIN = 10.0  # points
F_TELLS, ERROR_TELLS = 0.5, 0.05  # points, share: less than that tells nothing
_MIB = 1 << 20


class Verdict(Struct, frozen=True, kw_only=True):
    """One claim, checked.

    Attributes:
        met: None = it could not be measured.
    """

    met: bool | None
    measured: Any
    wanted: str
    words: str


class Findings(Struct, kw_only=True):
    """All that was measured.

    Attributes:
        cuts: ATE RMSE up to the baseline's end, by run; as the full one where it never ended.
        sweep: rows of `paper_surface.sweep`.
    """

    worlds: list[PaperWorld]
    outcomes: list[Outcome]
    cuts: dict[str, float] = {}
    sweep: list[dict[str, Any]] = []


def verdicts(found: Findings) -> dict[str, Verdict]:
    """Every verdict, by name."""
    made: dict[str, Verdict] = {}
    rules: tuple[tuple[str, Callable[[Findings, PaperWorld], Verdict | None]], ...] = (
        ("delay", _delay), ("delay target", _delay_target), ("fused", _fused), ("memory", _memory),
        ("baseline", _baseline), ("localisation", _localisation), ("scanner", _scanner), ("drift", _drift),
        ("loops", _loops), ("slow server", _slow_server), ("slow link", _slow_link),
        ("explanation", _explanation),
    )  # fmt: skip
    for world in found.worlds:
        for name, rule in rules:
            if (verdict := rule(found, world)) is not None:
                made[f"{name}, {world.name}"] = verdict
    made["versatility"] = _versatility(found)
    made["surface, stereo"] = _surface(found)
    for mode in AGAIN:
        if same := _of(found, mode):
            made[MODES[mode]] = _same_map(same)
    return made


def _of(found: Findings, mode: str, world: str = "", *, map_: str = "", machine: str = "") -> list[Outcome]:
    return [
        one
        for one in found.outcomes
        if one.mode == mode
        and world in ("", one.world)
        and map_ in ("", one.map)
        and one.machine.startswith(machine)
    ]


def _live(found: Findings, world: PaperWorld, mode: str = "decentralised") -> list[Outcome]:
    return _of(found, mode, world.name, map_="regularised")


def _delay(found: Findings, world: PaperWorld) -> Verdict | None:
    wanted = f"mean ≤ {DELAY_MS:.0f} ms, p99 ≤ {BOUNDED_P99_MS:.0f} ms, growing by ≤ {DRIFT_MS:.0f} ms a run"
    return _of_delay(_live(found, world), wanted, DELAY_MS, BOUNDED_P99_MS)


def _delay_target(found: Findings, world: PaperWorld) -> Verdict | None:
    if not world.name.startswith("kitti06"):
        return None
    wanted = f"mean ≤ {TARGET_MS:.0f} ms, p99 ≤ {TARGET_P99_MS:.0f} ms"
    return _of_delay(_live(found, world), wanted, TARGET_MS, TARGET_P99_MS)


def _of_delay(runs: Sequence[Outcome], wanted: str, mean_ms: float, p99_ms: float) -> Verdict | None:
    if not runs:
        return None
    known = [run for run in runs if run.delay_ms.count]
    if not known:
        return Verdict(met=None, measured=None, wanted=wanted, words="No keyframe came into the map.")
    mean = float(np.mean([run.delay_ms.mean for run in known]))
    p99 = max(run.delay_ms.p99 for run in known)
    grown = max(run.slope_ms_per_keyframe * run.delay_ms.count for run in known)
    met = len(known) == len(runs) and mean <= mean_ms and p99 <= p99_ms and grown <= DRIFT_MS
    return Verdict(
        met=met,
        measured={"mean_ms": round(mean, 1), "p99_ms": round(p99, 1), "growth_ms": round(grown, 1)},
        wanted=wanted,
        words=f"A keyframe is in the map {mean:.0f} ms after the sensor gave it, 99 % within {p99:.0f} ms; "
        f"over the whole run the delay {'grows' if grown > 0 else 'falls'} by {abs(grown):.0f} ms.",
    )


def _fused(found: Findings, world: PaperWorld) -> Verdict | None:
    runs = _of(found, "decentralised", world.name)
    if not runs:
        return None
    worst = min(runs, key=lambda run: run.fused - run.planned)
    met = all(run.fused == run.planned for run in runs)
    skipped = "" if met else f" The front end dropped {worst.late} frames and lost its way in {worst.lost}."
    return Verdict(
        met=met, measured={"fused": worst.fused, "planned": worst.planned},
        wanted=f"{worst.planned} of {worst.planned} keyframes fused",
        words=f"{worst.fused} of {worst.planned} keyframes are in the map.{skipped}",
    )  # fmt: skip


def _memory(found: Findings, world: PaperWorld) -> Verdict | None:
    runs = _live(found, world)
    if not runs:
        return None
    grown = max(run.growth_mib for run in runs)
    return Verdict(
        met=grown <= FLAT_MIB, measured={"growth_mib": grown},
        wanted=f"memory without map and queue grows by ≤ {FLAT_MIB:.0f} MiB in the second half of the run",
        words=f"Without map and queue, the memory of both processes changes by {grown:+.1f} MiB.",
    )  # fmt: skip


def _baseline(found: Findings, world: PaperWorld) -> Verdict | None:
    runs = _live(found, world, "traditional-unbounded")
    if not runs:
        return None
    dead = [run for run in runs if run.death]
    wanted = "it dies" + (f"; the paper's died at keyframe {world.died_at}" if world.died_at else "")
    measured = {
        run.name: {"died_at": run.died_at, "of": run.died_of, "queue": run.queue_peak} for run in runs
    }
    if dead:
        words = " ".join(
            f"On {_the(run.machine)} it ended at keyframe {run.died_at}: {run.death}; "
            f"{run.queue_peak} keyframes ({run.queue_peak_bytes / _MIB:.0f} MiB) waited at most, "
            f"the map had {run.map_bytes / _MIB:.0f} MiB."
            for run in dead
        )
    else:
        most = max(runs, key=lambda run: run.queue_peak)
        words = (
            f"It did not die here: at most {most.queue_peak} keyframes waited "
            f"({most.queue_peak_bytes / _MIB:.0f} MiB), and the delay was {most.delay_ms.mean:.0f} ms."
        )
    return Verdict(met=bool(dead), measured=measured, wanted=wanted, words=words)


def _the(machine: str) -> str:
    return machine if machine.startswith("all") else f"the {machine}"


def _localisation(found: Findings, world: PaperWorld) -> Verdict | None:
    ours, theirs = _live(found, world), _live(found, world, "traditional-unbounded")
    theirs = [run for run in theirs if run.machine.startswith("simulated")] or theirs
    if not ours or not theirs:
        return None
    errors = {run.name: found.cuts.get(run.name) for run in (*ours, *theirs)}
    wanted = f"≤ {100 * LATE_SHARE:.0f} % of the frames dropped, and no larger error than in one process"
    if any(value is None for value in errors.values()):
        return Verdict(met=None, measured=errors, wanted=wanted, words="There are too few poses to compare.")
    mine = float(np.mean([errors[run.name] for run in ours]))
    other = float(np.mean([errors[run.name] for run in theirs]))
    late = max(run.late / max(run.late + run.frames, 1) for run in ours)
    there = max(run.late / max(run.late + run.frames, 1) for run in theirs)
    return Verdict(
        met=late <= LATE_SHARE and mine <= WORSE * other,
        measured={"rmse_m": mine, "traditional_rmse_m": other, "late": round(late, 4)}, wanted=wanted,
        words=f"Up to the baseline's end the RMSE of the live trajectory is {mine:.3g} m as two processes "
        f"({100 * late:.1f} % of the frames dropped), {other:.3g} m as one ({100 * there:.1f} % dropped).",
    )  # fmt: skip


def _scanner(found: Findings, world: PaperWorld) -> Verdict | None:
    runs = _live(found, world)
    if not runs:
        return None
    used, memory = max(run.cores for run in runs), max(run.robot_peak_bytes for run in runs) / 1e6
    return Verdict(
        met=used <= CORES and memory <= SCANNER_MB,
        measured={"cores": used, "rss_mb": round(memory, 1)},
        wanted=f"≤ {CORES:g} cores, ≤ {SCANNER_MB:.0f} MB",
        words=f"The scanner takes {used:.2f} cores and {memory:.0f} MB.",
    )


def _drift(found: Findings, world: PaperWorld) -> Verdict | None:
    runs = [run for run in _live(found, world) if run.ate is not None]
    if not runs or world.sensor != "stereo":
        return None
    drift = max(run.ate.drift_percent for run in runs if run.ate)
    lost = max(run.lost for run in runs)
    return Verdict(
        met=drift <= DRIFT_PERCENT and not lost, measured={"drift_percent": round(drift, 3), "lost": lost},
        wanted=f"drift ≤ {DRIFT_PERCENT:g} %, never lost",
        words=f"At its end the live trajectory is off by {drift:.2f} % of the way"
        + (f", and the sensor was lost in {lost} frames." if lost else "; the sensor was never lost."),
    )  # fmt: skip


def _loops(found: Findings, world: PaperWorld) -> Verdict | None:
    runs = _live(found, world, "loops")
    if not runs:
        return None
    run, published = runs[0], world.published_rmse
    measured = {
        "loops": run.loops, "rmse_m": run.ate and run.ate.rmse,
        "corrected_rmse_m": run.corrected and run.corrected.rmse,
        "hash_equal": run.map_hash == run.expected_hash,
    }  # fmt: skip
    wanted = "loops are closed, and the map is the one of its corrected keyframes" + (
        f", RMSE ≤ {published:g} m (ORB-SLAM2 on the real sequence)" if published else ""
    )
    error = run.corrected or run.ate
    if error is None or not run.expected_hash:
        return Verdict(met=None, measured=measured, wanted=wanted, words="The run did not come to its end.")
    same = run.map_hash == run.expected_hash
    met = same and run.loops > 0 and (published is None or error.rmse <= published)
    before = f"{run.ate.rmse:.2f} m before, " if run.ate else ""
    return Verdict(
        met=met, measured=measured, wanted=wanted,
        words=f"{run.loops} loops were closed; RMSE {before}{error.rmse:.2f} m after. The settled map is "
        f"{'to the bit' if same else 'NOT'} the one that its keyframes make at their corrected poses.",
    )  # fmt: skip


def _slow_server(found: Findings, world: PaperWorld) -> Verdict | None:
    return _slow(_live(found, world, "slow-server"), "slow server")


def _slow_link(found: Findings, world: PaperWorld) -> Verdict | None:
    return _slow(_live(found, world, "slow-link"), "slow link")


def _slow(runs: Sequence[Outcome], what: str) -> Verdict | None:
    if not runs:
        return None
    run = min(runs, key=lambda run: run.fused - run.sent)
    late = 100 * run.late / max(run.late + run.frames, 1)
    return Verdict(
        met=run.drained and run.fused == run.sent and not run.death,
        measured={
            "fused": run.fused,
            "sent": run.sent,
            "delay_ms": run.delay_ms.mean,
            "queue": run.queue_peak,
        },
        wanted="every keyframe that was sent is in the map soon after the end",
        words=f"With a {what}, {run.fused} of {run.sent} keyframes are in the map; the delay is "
        f"{run.delay_ms.mean:.0f} ms on average, {run.queue_peak} keyframes waited at most (on the scanner's "
        f"disk), and the front end dropped {late:.1f} % of its frames.",
    )


def _explanation(found: Findings, world: PaperWorld) -> Verdict | None:
    """Verdict on the gain: explained by splitting the work in two, or merely by bounding the queue."""
    ours, bounded = _live(found, world), _live(found, world, "traditional-bounded")
    unbounded, beside = _live(found, world, "traditional-unbounded"), _live(found, world, "one-machine")
    if not ours or not bounded or not unbounded:
        return None
    parts, measured = [], {}
    for run in (*unbounded, *bounded, *beside, *ours):
        late = 100 * run.late / max(run.late + run.frames, 1)
        end = (
            f", then it died of {run.died_of} (map {run.map_bytes / _MIB:.0f} MiB, "
            f"queue {run.queue_peak_bytes / _MIB:.0f} MiB)"
            if run.death
            else ""
        )
        parts.append(
            f"{MODES[run.mode]} ({run.machine}): delay {run.delay_ms.mean:.0f} ms "
            f"(p99 {run.delay_ms.p99:.0f}), {run.fused} of {run.planned} keyframes, "
            f"{late:.1f} % of the frames dropped{end}"
        )
        measured[run.name] = {
            "delay_ms": run.delay_ms.mean, "p99_ms": run.delay_ms.p99, "fused": run.fused,
            "planned": run.planned, "late_percent": round(late, 2), "died_of": run.died_of,
        }  # fmt: skip
    fine = [run for run in unbounded if _is_good(run)]
    enough = [run for run in bounded if _is_good(run)]
    split = [run for run in beside if _is_good(run)]
    same = [run for run in (*unbounded, *bounded) if run.machine == ours[0].machine]
    is_needed = bool(same) and not fine and not enough and not split and all(_is_good(run) for run in ours)
    if fine:
        says = f"Neither is needed: on {fine[0].machine} the unbounded baseline does as well."
    elif enough:
        says = f"Bounding the queue is enough on {enough[0].machine}: it explains the gain there."
    elif split:
        says = (
            "Bounding the queue is not enough, and two processes are: a second machine is not needed beside "
            f"{_the(split[0].machine)}."
        )
    elif is_needed:
        says = "Bounding the queue is not enough: without the split keyframes, frames or time are lost."
    elif not same and all(_is_good(run) for run in ours):
        says = "Not shown: one process was run on a smaller machine only, which is not enough for it."
    else:
        says = "Neither reaches all of it here."
    return Verdict(
        met=is_needed, measured=measured,
        wanted="decentralisation, and not merely a bounded queue, explains the gain",
        words=f"{says} {'; '.join(parts)}.",
    )  # fmt: skip


def _is_good(run: Outcome) -> bool:
    """True if a run did all that the paper wants: alive, in time, every keyframe, few frames dropped."""
    late = run.late / max(run.late + run.frames, 1)
    in_time = run.delay_ms.count > 0 and run.delay_ms.mean <= DELAY_MS and run.delay_ms.p99 <= BOUNDED_P99_MS
    return not run.death and in_time and run.fused == run.planned and late <= LATE_SHARE


def _versatility(found: Findings) -> Verdict:
    wanted = (
        f"for each sensor λ and support alone raise the F-score by ≥ {F_TELLS:g} points, or lower the mean "
        f"error by ≥ {100 * ERROR_TELLS:.0f} % at the same F-score"
    )
    gains: dict[str, dict[str, Any]] = {}
    for sensor in dict.fromkeys(row["sensor"] for row in found.sweep):
        rows = [row for row in found.sweep if row["sensor"] == sensor and row["method"] == "ray"]
        rows = [row for row in rows if row["f_score"] is not None]
        plain = max((row for row in rows if not row["smoothness"]), key=_f_score, default=None)
        smooth = [row for row in rows if row["smoothness"]]
        if plain is not None and smooth:
            gains[sensor] = _gain(plain, smooth)
    if not gains:
        return Verdict(met=None, measured={}, wanted=wanted, words="No surface was measured.")
    words = "; ".join(
        f"{sensor}: F {row['off']:.1f} and {row['off_mm']:.1f} mm without, {row['best']:.1f} and "
        f"{row['best_mm']:.1f} mm with λ = {row['smoothness']:g} over {row['support']:g} voxels"
        for sensor, row in gains.items()
    )
    met = all(row["gains"] for row in gains.values())
    return Verdict(met=met, measured=gains, wanted=wanted, words=f"{words}.")


def _f_score(row: dict[str, Any]) -> float:
    return float(row["f_score"])


def _gain(plain: dict[str, Any], smooth: list[dict[str, Any]]) -> dict[str, Any]:
    """The best setting beside none: of those with about the best F-score, the one with the least error."""
    top = max(map(_f_score, smooth))
    best = min((row for row in smooth if _f_score(row) > top - F_TELLS), key=lambda row: row["mean_mm"])
    gained = top - _f_score(plain)
    error = best["mean_mm"] <= (1 - ERROR_TELLS) * plain["mean_mm"]
    return {
        "off": plain["f_score"], "off_mm": plain["mean_mm"], "best": best["f_score"],
        "best_mm": best["mean_mm"], "smoothness": best["smoothness"], "support": best["support"],
        "gains": gained >= F_TELLS or (gained > -F_TELLS and error),
    }  # fmt: skip


def _surface(found: Findings) -> Verdict:
    wanted = f"regularised F-score ≥ {F_GAIN:.0f} points over `off` in stereo, at equal completeness"
    rows = [row for row in found.sweep if row["sensor"] == "stereo" and row["method"] != "ray"]
    rows = [row for row in rows if row["f_score"] is not None]
    usual = {row["method"]: row for row in rows if row.get("min_weight") is None}
    plain, smooth = usual.get("off"), usual.get("regularised")
    if not plain or not smooth:
        return Verdict(met=None, measured=None, wanted=wanted, words="No stereo surface was measured.")
    at = smooth["completeness"]
    curve = sorted((row["completeness"], row["f_score"]) for row in rows if row["method"] == "off")
    equal = float(np.interp(at, *np.array(curve).T))
    gain = smooth["f_score"] - equal
    others = "".join(
        f", {name} {row['f_score']:.1f}" for name, row in usual.items() if name not in ("off", "regularised")
    )
    return Verdict(
        met=gain >= F_GAIN,
        measured={"gain": round(gain, 2), "usual_gain": round(smooth["f_score"] - plain["f_score"], 2)},
        wanted=wanted,
        words=f"F {smooth['f_score']:.1f} regularised, {plain['f_score']:.1f} off{others}, each at its own "
        f"weight; completeness {at:.1f} and {plain['completeness']:.1f} %. Where `off` leaves out as much "
        f"(completeness {at:.1f} %), its F is {equal:.1f}.",
    )


def _same_map(runs: Sequence[Outcome]) -> Verdict:
    wanted = "the same map, to the bit, as that of the live run"
    measured = {run.name: {"hash": run.map_hash, "expected": run.expected_hash} for run in runs}
    if not all(run.expected_hash for run in runs):
        words = "The live run left keyframes behind, so there is nothing to compare with."
        return Verdict(met=None, measured=measured, wanted=wanted, words=words)
    same = all(run.map_hash == run.expected_hash for run in runs)
    notes = "".join(f" ({', '.join(run.notes)})" for run in runs if run.notes)
    words = f"{runs[0].fused} keyframes make {'the same map' if same else 'ANOTHER map'}{notes}."
    return Verdict(met=same, measured=measured, wanted=wanted, words=words)
