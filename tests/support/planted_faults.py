# SPDX-License-Identifier: MIT
"""Faults to plant into a copy of the sources, a guarding line each, and the tests that are to notice."""

# ruff: noqa: E501  the lines that are taken away stand as they are

from msgspec import Struct


class Fault(Struct, frozen=True):
    """One guard taken away.

    Attributes:
        file: below `tsfusion/`.
        old: text that stands there once.
        new: what it becomes.
        tests: files below `tests/`, the likeliest first.
    """

    file: str
    old: str
    new: str
    tests: tuple[str, ...]


_JOURNAL = (
    "journal/test_journal.py", "journal/test_bad_disks.py", "journal/test_storage_faults.py",
    "journal/test_files_taken_away.py", "journal/test_torn_and_flipped.py",
)  # fmt: skip
_DOOR = (
    "gateway/test_gateway.py", "gateway/test_returning_clients.py", "gateway/test_client_routes.py",
    "gateway/test_hostile_peers.py", "end_to_end/test_security.py",
)  # fmt: skip
_SPOOL = (
    "delivery/test_outbox.py", "delivery/test_delivery_model.py", "delivery/test_spool_full_disk.py",
    "delivery/test_spool_taken_away.py", "delivery/test_refusals.py", "delivery/test_control_session.py",
)  # fmt: skip
_MAP = ("tsdf/test_checkpoint.py", "fuser/test_fuser.py", "journal/test_storage_faults.py")
_ASKED = ("gateway/test_question_limits.py", "wire/test_questions.py", "fuser/test_question_answers.py")
_SUMS = ("kernels/test_integrate.py", "tsdf/test_volume.py")

_WRITER, _SEGMENT, _SCAN = "journal/writer.py", "journal/open_segment.py", "journal/record_scan.py"
_DURABLE, _CHECKPOINT = "core/durable_files.py", "tsdf/checkpoint.py"
_INTAKE, _SESSIONS, _HOSTED = "gateway/keyframe_intake.py", "gateway/sessions.py", "gateway/hosted_map.py"
_SPOOL_FILE, _OUTBOX = "delivery/spool.py", "delivery/outbox.py"

FAULTS = (
    # journal: what is acknowledged is on the disk, and found again
    Fault(_SEGMENT, "            os.fdatasync(self._descriptor)\n", "            pass\n", _JOURNAL),
    Fault(
        _SEGMENT, "            durable_files.sync_folder(self.path.parent)\n", "            pass\n", _JOURNAL
    ),
    Fault(_SEGMENT, "os.ftruncate(self._descriptor, cut)", "pass", _JOURNAL),
    Fault(_SEGMENT, "os.ftruncate(self._descriptor, at)", "pass", _JOURNAL),
    Fault(_SEGMENT, "        self.is_over = True\n", "", _JOURNAL),
    Fault(_SEGMENT, "os.O_RDWR | os.O_CREAT | os.O_EXCL", "os.O_RDWR | os.O_CREAT", _JOURNAL),
    Fault(_SEGMENT, "copy.truncate(os.fstat(self._descriptor).st_size)", "pass", _JOURNAL),
    Fault(_SEGMENT, "return os.fstat(self._descriptor).st_nlink == 0", "return False", _JOURNAL),
    Fault(
        _WRITER, "            self._keep_place()  # nothing is", "            pass  # nothing is", _JOURNAL
    ),
    Fault(_WRITER, "            segment.take_back(offsets[0])  # they come again\n", "", _JOURNAL),
    Fault(
        _WRITER,
        "            self._abandon(offsets[0])\n            raise journal_error",
        "            raise journal_error",
        _JOURNAL,
    ),
    Fault(
        _WRITER, "            if end is not None and end <= segment.first:", "            if False:", _JOURNAL
    ),
    Fault(_WRITER, "        if missing and self.is_away:", "        if False:", _JOURNAL),
    Fault(
        _WRITER, "            if not segment.is_deleted and self.is_away:", "            if False:", _JOURNAL
    ),
    Fault(
        _WRITER,
        "            if number >= below or self.nbytes <= limit:",
        "            if self.nbytes <= limit:",
        ("journal/test_journal.py", "gateway/test_journal_retention.py"),
    ),
    Fault("journal/free_space.py", "            if nbytes > spare:", "            if False:", _JOURNAL),
    Fault(
        _SCAN,
        "        if self._identity is not None and head.segment != self._identity:",
        "        if False:",
        _JOURNAL,
    ),
    Fault(
        _SCAN,
        "            raise OSError(errno.EIO, os.strerror(errno.EIO))  # the disk is away",
        "            pass  #",
        _JOURNAL,
    ),
    Fault("journal/mcap_layout.py", "or zlib.crc32(raw[inner:end]) != crc32:", "or False:", _JOURNAL),
    # files that are replaced: checkpoints, quarantine, keys
    Fault(_DURABLE, "            os.fsync(file.fileno())\n", "", _MAP),
    Fault(
        _DURABLE,
        "        os.replace(partial, path)\n        sync_folder(path.parent)\n    except",
        "        os.replace(partial, path)\n    except",
        _MAP,
    ),
    Fault(_DURABLE, "    for made in reversed(missing):\n        sync_folder(made.parent)\n", "", _JOURNAL),
    Fault(
        "journal/quarantine.py",
        "                durable_files.sync_folder(self.folder.parent)\n",
        "",
        ("journal/test_files_taken_away.py",),
    ),
    # checkpoint: whole or not at all, never believed when damaged
    Fault(
        _CHECKPOINT,
        "            _check_digest(file, path)\n            header = _read_header(file, path)\n            yield",
        "            header = _read_header(file, path)\n            yield",
        _MAP,
    ),
    Fault(_CHECKPOINT, "    if map_hash != header.map_hash:", "    if False:", _MAP),
    Fault(
        _CHECKPOINT,
        "            if size % each or not 0 < size <= each * min(CHUNK, blocks - first):",
        "            if False:",
        _MAP,
    ),
    Fault(_CHECKPOINT, "    if read != rows.nbytes:", "    if False:", _MAP),
    Fault(_CHECKPOINT, "    if not 0 <= header.blocks <= header.config.max_blocks:", "    if False:", _MAP),
    Fault(
        _CHECKPOINT,
        "    kind = CheckpointError if is_of_another_version else DamagedCheckpoint",
        "    kind = DamagedCheckpoint",
        _MAP,
    ),
    # sessions and admission
    Fault(_SESSIONS, '        if seq <= durable:\n            return "duplicate"\n', "", _DOOR),
    Fault(_SESSIONS, 'return "next" if previous <= durable else "gap"', 'return "next"', _DOOR),
    Fault(_SESSIONS, "return not self.client or not client or self.client == client", "return True", _DOOR),
    Fault(
        _SESSIONS,
        "return key in self._by_key or len(self) < _MAX_SESSIONS",
        "return True",
        ("gateway/test_keyframe_index.py",),
    ),
    Fault(
        _INTAKE,
        "            codec.check(buffers, self._server.max_frame_bytes)\n            self._quotas.check(header, buffers)\n        except Refused as error:\n            self.finish()",
        "            pass\n        except Refused as error:\n            self.finish()",
        ("gateway/test_map_registry.py",),
    ),
    Fault(
        _INTAKE,
        "            if corrections.is_servers_own(header):",
        "            if False:",
        ("gateway/test_forget_requests.py", "end_to_end/test_forgetting.py", "wire/test_corrections.py"),
    ),
    Fault(
        _INTAKE,
        "        return route.damaged[1] < _MOST_DAMAGED",
        "        return True",
        ("end_to_end/test_damaged_links.py", "gateway/test_gateway.py"),
    ),
    Fault(
        _INTAKE,
        "            if isinstance(error, Damaged) and self._comes_again(header):",
        "            if False:",
        ("end_to_end/test_damaged_links.py", "gateway/test_gateway.py"),
    ),
    Fault(
        _HOSTED,
        "            self.disk.begin(error)\n            raise\n",
        "            raise\n",
        ("gateway/test_journaled_together.py",),
    ),
    Fault(
        "gateway/journal_retention.py",
        "            below = self._in_previous\n",
        "            below = self._in_last\n",
        ("gateway/test_journal_retention.py", "journal/test_journal.py"),
    ),
    Fault(
        "gateway/access_control.py",
        "        self._revoked |= self._allowed.refresh()  # the file may have changed since the last step\n",
        "",
        ("gateway/test_ports.py", "end_to_end/test_security.py"),
    ),
    Fault(
        "gateway/ports.py",
        "while frames[-1].more and len(frames) <= MAX_FRAMES:",
        "while frames[-1].more:",
        ("gateway/test_ports.py", "gateway/test_hostile_peers.py"),
    ),
    Fault(
        "gateway/memory_guard.py",
        "        exceeded = held > self._bound\n",
        "        exceeded = False\n",
        ("end_to_end/test_hostile_load.py",),
    ),
    # spool and outbox: nothing goes that is not acknowledged, no number comes twice
    Fault(
        _SPOOL_FILE, "while self.waiting and self.waiting[0].seq <= durable:", "while self.waiting:", _SPOOL
    ),
    Fault(
        _SPOOL_FILE,
        "            self._tombstones.add(seq)\n            raise\n",
        "            raise\n",
        _SPOOL,
    ),
    Fault(_SPOOL_FILE, "        self._tombstones.add(entry.seq)\n", "", _SPOOL),
    Fault(
        _SPOOL_FILE,
        "last + _RESTART_GAP + secrets.randbelow(_RESTART_SPREAD) if last else 1",
        "last + 1",
        _SPOOL,
    ),
    Fault(
        _SPOOL_FILE,
        '                    log.warning("%s", error)\n                    return False\n',
        "",
        _SPOOL,
    ),
    Fault(_SPOOL_FILE, "(newest if below is None else below)", "1 << 60", _SPOOL),
    Fault(
        _OUTBOX,
        "                if entry.seq > sent and not entry.is_correction:",
        "                if not entry.is_correction:",
        _SPOOL,
    ),
    Fault(_OUTBOX, "            self._outstanding = min(self._outstanding, place)\n", "", _SPOOL),
    Fault(_OUTBOX, "            self._outstanding = max(self._outstanding - len(dropped), 0)\n", "", _SPOOL),
    # questions
    Fault("gateway/map_questions.py", ">= MOST_OF_A_CLIENT:", ">= 1 << 30:", _ASKED),
    Fault(
        "gateway/map_questions.py",
        "        if held and held + command.question.most_bytes > self._max_bytes:",
        "        if False:",
        _ASKED,
    ),
    Fault(
        "gateway/connection_limits.py",
        "        if deaf := self._ports.connections.cut_deaf_viewers():",
        "        if deaf := 0:",
        ("gateway/test_connection_limits.py",),
    ),
    Fault("fuser/question_answers.py", "        if now > self._until_s:", "        if False:", _ASKED),
    # the map's sums
    Fault(
        "kernels/integrate.py",
        "        if ti.atomic_max(stamps[slot], stamp) != stamp:",
        "        if True:",
        _SUMS,
    ),
    Fault(
        "kernels/integrate.py",
        "first = ti.select(owners[slot] == mark, LEFT_OUT, slot * CUBE)",
        "first = slot * CUBE",
        _SUMS,
    ),
    Fault("kernels/integrate.py", "    elif slot < oldest:", "    elif slot < 0:", _SUMS),
    Fault("tsdf/integrator.py", "            self._take_back(added, sign, before)\n", "", _SUMS),
    Fault(
        "tsdf/kept_values.py",
        "        if self._drops != self._store.drops:",
        "        if False:",
        ("tsdf/test_kept_values.py",),
    ),
)
