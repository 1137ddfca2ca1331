# SPDX-License-Identifier: MIT
"""Condition of a map: in a word, in lines for a person, and in numbers."""

import time

from tsfusion.core.readable_numbers import count_of
from tsfusion.gateway.hosted_map import HostedMap
from tsfusion.wire.health import MapHealth, MapState

_FOR_GONE = "what no checkpoint holds of them is lost, unless they are put back"
_STALLED_AFTER = 10.0  # seconds in which keyframes wait and none is fused


def state_of(hosted: HostedMap) -> MapState:
    """The state in a word."""
    if hosted.fuser.failed:
        return "failed"
    if not hosted.warm or hosted.fuser.waits:
        return "opening"
    if not hosted.fuser.ready:
        return "restarting"
    return "idle" if hosted.drained else "busy"


def problem_of(hosted: HostedMap) -> str:
    """Reason why keyframes are not accepted or not fused, and what to do; empty = they are."""
    if problem := hosted.records.disk.problem or hosted.fuser.problem:
        return problem
    backlog = hosted.backlog
    since = 0.0 if backlog.is_empty else time.monotonic() - backlog.last_progress
    stalled = hosted.warm and since > _STALLED_AFTER
    if stalled and hosted.fuser.ready:
        return "keyframes wait and none is fused: its fuser makes a mesh or a checkpoint, or it hangs"
    return "keyframes wait, and its fuser is still starting again: read the log" if stalled else ""


def notices_of(hosted: HostedMap) -> list[str]:
    """Problems that a person should know of, though keyframes are taken and will be fused."""
    journal = hosted.records.journal
    damaged, put_back = journal.damaged, journal.put_back
    lost = count_of(damaged, "keyframe of its journal is", "keyframes of its journal are")
    notices = [f"{lost} damaged and lost"] if damaged else []
    if absent := journal.absent:
        gone = count_of(absent, "segment of its journal was", "segments of its journal were")
        notices.append(f"{gone} not there at the start: {_FOR_GONE}")
    if missing := journal.missing:
        first = f"{missing[0]:06d}.mcap"
        gone = count_of(len(missing), "segment of its journal is", "segments of its journal are")
        notices.append(f"{gone} gone, first {first}: {_FOR_GONE}")
    if put_back:
        notices.append(
            f"its journal was taken away while it was written to, {count_of(put_back, 'time')}, and was "
            "put back with every keyframe: find out who deletes or moves files there"
        )
    if hosted.checkpoints.problem:
        notices.append(f"no checkpoint can be written: {hosted.checkpoints.problem}")
    if state_of(hosted) == "restarting" and not problem_of(hosted):
        notices.append("its fuser ended, and another one takes over: the log says why")
    notices += filter(None, (hosted.records.quarantine.problem, hosted.records.loss))
    return [*notices, *hosted.outcomes.notices.values()]


def health_of(hosted: HostedMap) -> MapHealth:
    """Health of a map, as far as it is known without asking the fuser."""
    now, outcomes, records = time.monotonic(), hosted.outcomes, hosted.records
    return MapHealth(
        state=state_of(hosted),
        problem=problem_of(hosted),
        keyframes_durable=hosted.keyframes_durable,
        keyframes_fused=outcomes.fused,
        waiting=hosted.backlog.keyframes,
        rejected=dict(outcomes.rejected),
        quarantined=len(records.quarantine),
        sessions=records.sessions.of_clients,
        journal_bytes=records.journal.nbytes,
        journal_damaged=records.journal.damaged,
        fuser_restarts=hosted.fuser.restarts,
        blocks=outcomes.blocks,
        map_bytes=outcomes.map_bytes,
        last_keyframe_s=None if records.last_keyframe is None else max(now - records.last_keyframe, 0.0),
        delay_ms=outcomes.delays.summary(),
        delay_bound_ms=outcomes.delays.bound_ms,
        corrections=records.corrections,
        corrections_waiting=hosted.corrections_waiting,
        corrections_unavailable=outcomes.moves.unavailable,
        keyframes_moved=outcomes.moves.moved,
        moving_s=outcomes.moves.seconds,
        keyframes_forgotten=outcomes.moves.forgotten,
        checkpoints=hosted.checkpoints.written,
        journal_missing=records.journal.absent + len(records.journal.missing),
        journal_put_back=records.journal.put_back,
        fusing_s=hosted.fuser.seconds_at_work,
        questions=dict(hosted.questions.by_outcome),
        question_ms=hosted.questions.delay_ms,
        mesh_epoch=outcomes.newest_mesh.epoch if outcomes.newest_mesh else "",
        mesh_number=outcomes.newest_mesh.number if outcomes.newest_mesh else 0,
    )
