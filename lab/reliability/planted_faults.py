# SPDX-License-Identifier: MIT
"""Faults to plant into a copy of the sources, a guarding line each, and the test that is to notice."""

# ruff: noqa: E501  the lines that are taken away stand as they are

from msgspec import Struct


class Fault(Struct, frozen=True):
    """One guard taken away.

    Attributes:
        file: below `tsfusion/`.
        old: text that stands there once.
        new: what it becomes.
        test: the one that fails then, `FILE::NAME` below `tests/`.
    """

    file: str
    old: str
    new: str
    test: str


FAULTS = (
    # journal: what is acknowledged is on the disk, and found again
    Fault(
        "journal/segments.py",
        "            os.fdatasync(self._descriptor)\n",
        "            pass\n",
        "journal/test_bad_disks.py::test_everything_is_on_the_disk_in_the_order_that_recovery_needs",
    ),
    Fault(
        "journal/segments.py",
        "            durable_files.sync_folder(self.path.parent)\n",
        "            pass\n",
        "journal/test_bad_disks.py::test_everything_is_on_the_disk_in_the_order_that_recovery_needs",
    ),
    Fault(
        "journal/segments.py",
        "os.ftruncate(self._descriptor, cut)",
        "pass",
        "journal/test_bad_disks.py::test_what_was_refused_is_cut_off_on_the_disk_as_well",
    ),
    Fault(
        "journal/segments.py",
        "os.ftruncate(self._descriptor, at)",
        "pass",
        "journal/test_bad_disks.py::test_what_was_refused_is_cut_off_on_the_disk_as_well",
    ),
    Fault(
        "journal/segments.py",
        "        self.is_over = True\n",
        "",
        "journal/test_files_taken_away.py::test_a_record_of_a_file_whose_place_is_not_known_is_taken_back",
    ),
    Fault(
        "journal/segments.py",
        "os.O_RDWR | os.O_CREAT | os.O_EXCL",
        "os.O_RDWR | os.O_CREAT",
        "journal/test_files_taken_away.py::test_a_file_with_the_next_number_is_stepped_over",
    ),
    Fault(
        "journal/segments.py",
        "copy.truncate(os.fstat(self._descriptor).st_size)",
        "pass",
        "journal/test_files_taken_away.py::test_a_record_that_was_taken_back_is_not_put_back",
    ),
    Fault(
        "journal/segments.py",
        "return os.fstat(self._descriptor).st_nlink == 0",
        "return False",
        "journal/test_files_taken_away.py::test_an_open_segment_that_is_taken_away_is_put_back_with_every_record",
    ),
    Fault(
        "journal/writer.py",
        "            self._keep_place()  # a record in",
        "            pass  # a record in",
        "journal/test_files_taken_away.py::test_a_record_is_not_acknowledged_in_a_file_that_vanished_meanwhile",
    ),
    Fault(
        "journal/writer.py",
        "            segment.take_back(offsets[0])  # the sender sends these messages again\n",
        "",
        "journal/test_files_taken_away.py::test_a_record_of_a_file_whose_place_is_not_known_is_taken_back",
    ),
    Fault(
        "journal/writer.py",
        "            self._abandon(offsets[0])\n            raise journal_error",
        "            raise journal_error",
        "journal/test_bad_disks.py::test_what_was_refused_is_cut_off_on_the_disk_as_well",
    ),
    Fault(
        "journal/writer.py",
        "            if end is not None and end <= segment.first:",
        "            if False:",
        "journal/test_bad_disks.py::test_a_disk_that_refuses_is_an_error_and_not_the_end",
    ),
    Fault(
        "journal/writer.py",
        "        if missing and self.is_away:",
        "        if False:",
        "journal/test_files_taken_away.py::test_nothing_is_written_into_an_empty_folder_in_the_place_of_the_journal",
    ),
    Fault(
        "journal/writer.py",
        "            if not segment.is_deleted and self.is_away:",
        "            if False:",
        "journal/test_files_taken_away.py::test_nothing_is_written_into_an_empty_folder_in_the_place_of_the_journal",
    ),
    Fault(
        "journal/writer.py",
        "            if number >= below or self.nbytes <= limit:",
        "            if self.nbytes <= limit:",
        "journal/test_bad_disks.py::test_the_oldest_segments_go_and_no_other",
    ),
    Fault(
        "journal/writer.py",
        "            if nbytes > spare:",
        "            if False:",
        "journal/test_bad_disks.py::test_append_stops_before_the_disk_is_full",
    ),
    Fault(
        "journal/record_scan.py",
        "        if self._identity is not None and head.segment != self._identity:",
        "        if False:",
        "journal/test_torn_and_flipped.py::test_a_keyframe_cannot_pass_off_its_own_bytes_as_records",
    ),
    Fault(
        "journal/record_scan.py",
        "            raise OSError(errno.EIO, os.strerror(errno.EIO))  # the disk is away",
        "            pass  #",
        "journal/test_bad_disks.py::test_a_segment_that_cannot_be_read_is_not_passed_over",
    ),
    Fault(
        "journal/mcap_layout.py",
        "or zlib.crc32(raw[inner:end]) != crc32:",
        "or False:",
        "journal/test_torn_and_flipped.py::test_a_flipped_bit_at_any_byte_costs_at_most_the_record_it_hit",
    ),
    # files that are replaced: checkpoints, quarantine, keys
    Fault(
        "core/durable_files.py",
        "            os.fsync(file.fileno())\n",
        "",
        "journal/test_files_taken_away.py::test_what_is_put_aside_is_on_the_disk",
    ),
    Fault(
        "core/durable_files.py",
        "        os.replace(partial, path)\n        sync_folder(path.parent)\n    except",
        "        os.replace(partial, path)\n    except",
        "fuser/test_fuser.py::test_a_checkpoint_is_on_the_disk_before_it_has_its_name_and_then_the_name",
    ),
    Fault(
        "core/durable_files.py",
        "    for made in reversed(missing):\n        sync_folder(made.parent)\n",
        "",
        "journal/test_bad_disks.py::test_everything_is_on_the_disk_in_the_order_that_recovery_needs",
    ),
    Fault(
        "journal/quarantine.py",
        "                durable_files.sync_folder(self.folder.parent)\n",
        "",
        "journal/test_files_taken_away.py::test_what_is_put_aside_is_on_the_disk",
    ),
    # checkpoint: whole or not at all, never believed when damaged
    Fault(
        "tsdf/files/checkpoint.py",
        "            _check_digest(file, path)\n            header = _read_header(file, path)\n            yield",
        "            header = _read_header(file, path)\n            yield",
        "tsdf/test_checkpoint.py::test_a_file_with_a_flipped_bit_is_refused",
    ),
    Fault(
        "tsdf/files/checkpoint.py",
        "    if map_hash != header.map_hash:",
        "    if False:",
        "tsdf/test_checkpoint.py::test_each_part_of_a_forged_file_is_checked",
    ),
    Fault(
        "tsdf/files/checkpoint.py",
        "            if size % each or not 0 < size <= each * min(CHUNK, blocks - first):",
        "            if False:",
        "tsdf/test_checkpoint.py::test_each_part_of_a_forged_file_is_checked",
    ),
    Fault(
        "tsdf/files/checkpoint.py",
        "    if read != rows.nbytes:",
        "    if False:",
        "tsdf/test_checkpoint.py::test_each_part_of_a_forged_file_is_checked",
    ),
    Fault(
        "tsdf/files/checkpoint.py",
        "    if not 0 <= header.blocks <= header.config.max_blocks or header.keyframes < 0:",
        "    if False:",
        "tsdf/test_checkpoint.py::test_each_part_of_a_forged_file_is_checked",
    ),
    Fault(
        "tsdf/files/checkpoint.py",
        "    kind = CheckpointError if is_of_another_version else DamagedCheckpoint",
        "    kind = DamagedCheckpoint",
        "tsdf/test_checkpoint.py::test_a_map_of_another_version_or_that_cannot_be_read_now_is_not_damaged",
    ),
    # sessions and admission
    Fault(
        "gateway/clients/client_routes.py",
        '        if seq <= durable:\n            return "duplicate"\n',
        "",
        "gateway/test_keyframe_index.py::test_each_keyframe_is_admitted_once_and_in_order",
    ),
    Fault(
        "gateway/clients/client_routes.py",
        'return "next" if previous <= durable else "gap"',
        'return "next"',
        "gateway/test_keyframe_index.py::test_each_keyframe_is_admitted_once_and_in_order",
    ),
    Fault(
        "gateway/clients/client_routes.py",
        "return not self.client or not client or self.client == client",
        "return True",
        "gateway/test_client_routes.py::test_a_session_is_its_clients_in_the_journal_and_before",
    ),
    Fault(
        "gateway/clients/client_routes.py",
        "return key in self._by_key or len(self) < _MAX_SESSIONS",
        "return True",
        "gateway/test_keyframe_index.py::test_sessions_are_bounded",
    ),
    Fault(
        "gateway/intake/keyframe_intake.py",
        "            self._check(record)\n        except Refused as error:\n            self.finish()",
        "            pass\n        except Refused as error:\n            self.finish()",
        "gateway/test_map_registry.py::test_a_record_whose_frames_are_too_large_together_is_refused",
    ),
    Fault(
        "gateway/intake/keyframe_intake.py",
        "            if is_servers_own(header):",
        "            if False:",
        "end_to_end/test_forgetting.py::test_nothing_but_the_server_writes_what_is_forgotten",
    ),
    Fault(
        "gateway/intake/keyframe_intake.py",
        "    return route.damaged[1] < _MOST_DAMAGED",
        "    return True",
        "end_to_end/test_damaged_links.py::test_a_record_that_always_comes_damaged_is_given_up",
    ),
    Fault(
        "gateway/intake/keyframe_intake.py",
        "            if isinstance(error, Damaged) and _comes_again(record):",
        "            if False:",
        "end_to_end/test_damaged_links.py::test_what_is_damaged_on_the_way_is_sent_again",
    ),
    Fault(
        "gateway/maps/map_records.py",
        "            self.disk.begin(error)\n            raise\n",
        "            raise\n",
        "gateway/test_journaled_together.py::test_a_disk_that_refuses_holds_every_client_and_loses_nothing",
    ),
    Fault(
        "gateway/maps/map_journal.py",
        "            below = self._in_previous\n",
        "            below = self._in_last\n",
        "gateway/test_map_journal.py::test_what_two_checkpoints_hold_may_go",
    ),
    Fault(
        "gateway/ports/access_control.py",
        "        self._revoked |= self._allowed.refresh()  # the file may have changed since the last step\n",
        "",
        "gateway/ports/test_ports.py::test_who_may_not_connect_any_more_is_heard_and_served_no_more",
    ),
    Fault(
        "gateway/ports/ports.py",
        "while frames[-1].more and len(frames) <= MAX_FRAMES:",
        "while frames[-1].more:",
        "gateway/ports/test_ports.py::test_a_message_of_frames_without_end_is_not_read_to_its_end",
    ),
    Fault(
        "gateway/ports/connections.py",
        "        exceeded = held > self._bound\n",
        "        exceeded = False\n",
        "end_to_end/test_hostile_load.py::test_memory_that_does_not_come_back_is_reported_once",
    ),
    # spool and outbox: nothing goes that is not acknowledged, no number comes twice
    Fault(
        "delivery/spool.py",
        "while self.waiting and self.waiting[0].seq <= durable:",
        "while self.waiting:",
        "delivery/test_outbox.py::test_what_is_acknowledged_is_on_its_way_no_more",
    ),
    Fault(
        "delivery/spool.py",
        "            self._tombstones.add(seq)\n            raise\n",
        "            raise\n",
        "delivery/test_spool_full_disk.py::test_a_record_that_cannot_be_taken_back_does_not_pass_for_another",
    ),
    Fault(
        "delivery/spool.py",
        "        self._tombstones.add(entry.seq)\n",
        "",
        "journal/test_journal.py::test_an_entry_in_the_middle_can_be_removed",
    ),
    Fault(
        "delivery/spool.py",
        "last + _RESTART_GAP + secrets.randbelow(_RESTART_SPREAD) if last else 1",
        "last + 1",
        "delivery/test_outbox.py::test_only_what_was_sent_can_be_corrected",
    ),
    Fault(
        "delivery/spool.py",
        '                    log.warning("%s", error)\n                return False\n',
        "                    pass\n",
        "delivery/test_spool_taken_away.py::test_no_newer_file_is_deleted_before_an_older_one",
    ),
    Fault(
        "delivery/spool.py",
        "(newest if below is None else below)",
        "1 << 60",
        "journal/test_journal.py::test_what_was_written_and_is_not_queued_yet_stays",
    ),
    Fault(
        "delivery/outbox.py",
        "                if entry.seq > sent and not entry.is_correction:",
        "                if not entry.is_correction:",
        "delivery/test_outbox.py::test_of_what_a_dead_scanner_left_a_windows_worth_may_be_journaled",
    ),
    Fault(
        "delivery/outbox.py",
        "            self._outstanding = min(self._outstanding, place)\n",
        "",
        "delivery/test_outbox.py::test_what_was_sent_behind_a_refused_record_is_sent_again",
    ),
    Fault(
        "delivery/outbox.py",
        "            self._outstanding = max(self._outstanding - len(dropped), 0)\n",
        "",
        "delivery/test_outbox.py::test_what_is_acknowledged_is_on_its_way_no_more",
    ),
    # questions
    Fault(
        "gateway/people/requests.py",
        ">= MOST_OF_A_CLIENT:",
        ">= 1 << 30:",
        "gateway/test_question_limits.py::test_a_client_has_a_few_under_way_over_all_its_connections",
    ),
    Fault(
        "gateway/people/requests.py",
        "held > 0 and held + more > self._unread.max_bytes",
        "False",
        "gateway/test_question_limits.py::test_answers_that_nobody_reads_fill_no_memory",
    ),
    Fault(
        "fuser/question_answers.py",
        "        if now > self._until_s:",
        "        if False:",
        "fuser/test_question_answers.py::test_an_answer_that_nobody_waits_for_any_more_is_given_up",
    ),
    # the map's sums
    Fault(
        "kernels/integration/integrate.py",
        "        if ti.atomic_max(versions[slot], version) != version:",
        "        if True:",
        "kernels/test_integrate.py::test_the_maps_blocks_are_those_of_the_crossed_voxels",
    ),
    Fault(
        "kernels/integration/integrate.py",
        "first = ti.select(owners[slot] == mark, LEFT_OUT, slot * CUBE)",
        "first = slot * CUBE",
        "kernels/test_integrate.py::test_integration_equals_the_twin_to_the_bit",
    ),
    Fault(
        "kernels/integration/integrate.py",
        "    elif slot < oldest:",
        "    elif slot < 0:",
        "tsdf/test_volume.py::test_any_order_gives_the_same_hash",
    ),
    Fault(
        "tsdf/integration/integrator.py",
        "            self._take_back(added, sign, before)\n",
        "",
        "tsdf/test_volume.py::test_whatever_fails_leaves_the_map_as_it_was",
    ),
    Fault(
        "tsdf/surface/surface_layers.py",
        "lambda changed: _reached(changed, store, reach + 1)",
        "lambda changed: _reached(changed, store, reach)",
        "tsdf/test_surface_layers.py::test_a_change_makes_old_all_that_it_reaches",
    ),
    # pages: who may ask, and what a browser may say
    Fault(
        "viewer/page/page_guard.py",
        "place == host.lower()",
        "place.startswith(host.lower())",
        "viewer/test_page_server.py::test_a_foreign_origin_is_refused",
    ),
    Fault(
        "viewer/page/page_server.py",
        "found = page_messages.checked(message, page._control)",
        "found = message",
        "viewer/test_page_server.py::test_a_browser_changes_values_and_nothing_else",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "if len(message) > _MOST_BYTES and",
        "if False and",
        "viewer/test_page_messages.py::test_a_message_of_no_page_of_ours_is_an_error",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "            if width * height > _MOST_PIXELS:",
        "            if False:",
        "viewer/test_page_messages.py::test_a_picture_that_unpacks_to_too_much_is_passed_over",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "    return msgpack.encode(read)\n",
        "    return bytes(message)\n",
        "viewer/test_page_messages.py::test_a_field_that_stands_twice_has_one_meaning",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "min(max(number, control.min), control.max)",
        "number",
        "viewer/test_page_messages.py::test_a_control_gets_values_of_its_kind_within_its_bounds",
    ),
    Fault(
        "viewer/shown_feed.py",
        "if process.rss_bytes() > memory_bytes:",
        "if False:",
        "cli/test_view_command.py::test_a_page_with_too_much_memory_begins_again_at_its_address",
    ),
    # moves, checkpoints, results
    Fault(
        "gateway/migration/map_arrivals.py",
        "zlib.crc32(piece) != parcel.crc32 or ",
        "",
        "gateway/test_map_moves.py::test_a_piece_that_was_damaged_on_its_way_ends_the_move",
    ),
    Fault(
        "gateway/migration/map_arrivals.py",
        "if version != one.version or have > one.nbytes:",
        "if have > one.nbytes:",
        "gateway/test_map_moves.py::test_a_checkpoint_of_another_version_is_copied_from_its_start",
    ),
    Fault(
        "gateway/migration/map_departures.py",
        "if not hosted.warm or not hosted.forgetting.is_idle:",
        "if not hosted.warm:",
        "gateway/test_map_moves.py::test_a_map_that_forgets_keyframes_does_not_leave",
    ),
    Fault(
        "gateway/maps/forgetting.py",
        "self._records.quarantine.drop(session.session, _numbers(session))\n            for",
        "0 for",
        "gateway/test_forget_requests.py::test_copies_in_quarantine_are_erased_too",
    ),
    Fault(
        "fuser/map_checkpoints.py",
        "        check_journal(path, volume.meta)\n",
        "",
        "fuser/test_fuser.py::test_another_maps_checkpoint_is_set_aside_and_the_journal_fused_anew",
    ),
    Fault(
        "tsdf/sums/map_addition.py",
        "    store.bounds[slots] = (store.sums[slots] & WEIGHT_MASK).max(axis=1)\n",
        "",
        "tsdf/test_map_addition.py::test_a_sum_knows_how_many_votes_its_voxels_have",
    ),
    Fault(
        "tsdf/sums/map_addition.py",
        "    if full:\n",
        "    if False:\n",
        "tsdf/test_map_addition.py::test_a_sum_without_room_leaves_the_map_as_it_was",
    ),
    Fault(
        "cluster/schedulers.py",
        "is_whole = (done.name, done.digests) == (job.name, jobs.digests(self._folder, done.files))",
        "is_whole = True",
        "cluster/test_fusing.py::test_a_part_that_is_not_what_its_job_wrote_is_made_anew",
    ),
    Fault(
        "wire/asking/followed_map.py",
        "self._is_due |= came_alone or ",
        "self._is_due |= ",
        "fuser/test_followed_paths.py::test_keyframes_that_come_from_the_journal_alone_are_asked_for",
    ),
    Fault(
        "kernels/base/runtime.py",
        "        os.environ[CACHE_VARIABLE] = other",
        "        pass",
        "kernels/test_runtime.py::test_a_home_that_cannot_be_written_is_done_without",
    ),
    Fault(
        "kernels/base/runtime.py",
        "if found.st_uid != os.getuid() or found.st_mode != stat.S_IFDIR | 0o700:",
        "if False:",
        "kernels/test_runtime.py::test_a_home_that_cannot_be_written_is_done_without",
    ),
    # recordings: what is taken from files, and what is left out
    Fault(
        "geometry/origin.py",
        "if [x, y, z] != numbers or max(abs(x), abs(y), abs(z)) > FARTHEST:",
        "if False:",
        "geometry/test_origin.py::test_what_is_no_origin_is_refused",
    ),
    Fault(
        "datasets/dataset.py",
        '"usual", "origin", "distance"',
        '"usual", "distance"',
        "datasets/test_open_dataset.py::test_some_of_a_recording_count_from_its_origin",
    ),
    Fault(
        "scanner/sources/source.py",
        '        self.origin = getattr(dataset, "origin", None)\n',
        "        self.origin = None\n",
        "end_to_end/test_georeferenced.py::test_a_map_in_utm",
    ),
    Fault(
        "geometry/sweeps.py",
        "if len(times_s) and max(first - times_s.min(), times_s.max() - last) > (last - first) / 2:",
        "if False:",
        "geometry/test_sweeps.py::test_a_motion_that_is_none_is_refused",
    ),
    Fault(
        "geometry/sweeps.py",
        "    if first <= 0 <= last and np",
        "    if False and np",
        "geometry/test_sweeps.py::test_a_motion_that_is_none_is_refused",
    ),
    Fault(
        "geometry/keyframe.py",
        "        self.measurement[no_return] = np.nan",
        "        pass",
        "geometry/test_sweeps.py::test_nothing_measured_does_not_become_a_point",
    ),
    Fault(
        "geometry/keyframe.py",
        "            if not np.isfinite(times).all():",
        "            if False:",
        "geometry/test_sweeps.py::test_times_of_points_are_finite",
    ),
    Fault(
        "geometry/keyframe.py",
        "        if are_far(points):",
        "        if False:",
        "geometry/test_origin.py::test_a_cloud_in_a_grid_is_no_scan",
    ),
    Fault(
        "datasets/scan_files.py",
        "    if step > _COARSE * span:",
        "    if False:",
        "datasets/test_readers.py::test_times_of_no_use_are_named",
    ),
    Fault(
        "datasets/scan_files.py",
        " & np.isfinite(points).all(axis=1) & points.any(axis=1)",
        "",
        "datasets/test_readers.py::test_points_without_a_return_may_have_any_time",
    ),
    Fault(
        "datasets/trajectory_files.py",
        "    if words := twins(times, table):",
        '    if words := "":',
        "datasets/test_broken_frames.py::test_two_poses_at_one_time_are_refused_where_they_differ",
    ),
    Fault(
        "datasets/trajectory_files.py",
        "    if 2 * len(broken) > len(poses):",
        "    if False:",
        "datasets/test_broken_frames.py::test_a_recording_of_which_most_is_broken_is_an_error_with_the_cause",
    ),
    Fault(
        "datasets/dataset.py",
        "    if texts != sorted(texts):",
        "    if False:",
        "datasets/test_trajectory_files.py::test_a_list_that_was_sorted_as_text_is_put_in_order",
    ),
    Fault(
        "datasets/dataset.py",
        "if 2 * bad <= len(self) and (self._was_read or bad < _FIRST_TRIES):",
        "if True:",
        "datasets/test_broken_frames.py::test_a_recording_of_which_most_is_broken_is_an_error_with_the_cause",
    ),
    Fault(
        "datasets/dataset.py",
        "bad = self.skipped[UNREADABLE] = len(self._unread)",
        "bad = len(self._unread)",
        "datasets/formats/test_every_layout.py::test_what_happens_to_one_frame_leaves_the_others_at_their_poses",
    ),
    Fault(
        "datasets/dataset.py",
        'check_byte_order(frame.depth, f"keyframe {index} of {self.name}")',
        "pass",
        "datasets/test_broken_frames.py::test_a_recording_with_exchanged_bytes_of_depth_is_refused",
    ),
    Fault(
        "datasets/file_names.py",
        "    if not others or _unevenness(ways[others[0]]) > 2 * _unevenness(ways[best]) + 0.05:",
        "    if True:",
        "datasets/test_trajectory_files.py::test_ambiguous_times_are_refused",
    ),
    # files that claim much
    Fault(
        "core/limits.py",
        "    if nbytes > MAX_FILE_BYTES:",
        "    if False:",
        "datasets/test_bombs.py::test_an_exr_that_claims_a_gigapixel",
    ),
    Fault(
        "core/limits.py",
        "    if len(found) > MAX_PIECE_BYTES:",
        "    if False:",
        "datasets/test_bombs.py::test_chunks_and_messages_that_unpack_to_too_much",
    ),
    Fault(
        "core/limits.py",
        "        if nbytes is not None and nbytes > MAX_PIECE_BYTES:",
        "        if False:",
        "datasets/test_bombs.py::test_chunks_and_messages_that_unpack_to_too_much",
    ),
    Fault(
        "core/limits.py",
        "        if self._left < 0:",
        "        if False:",
        "datasets/test_bombs.py::test_a_compressed_database_that_would_fill_the_disk",
    ),
    Fault(
        "datasets/rosbag/reader.py",
        "hooks.append(lambda connection: connection.limit(*longest))",
        "pass",
        "datasets/test_bombs.py::test_a_database_whose_messages_are_computed",
    ),
    Fault(
        "datasets/readers.py",
        'chunk = head + file.read(length + 4) if length <= left else b""',
        "chunk = head + file.read(length + 4)",
        "datasets/test_bombs.py::test_a_png_holds_no_more_than_its_pixels_need",
    ),
    Fault(
        "datasets/readers.py",
        'content = file.read() if nbytes <= limits.MAX_FILE_BYTES else b""',
        "content = file.read()",
        "datasets/test_bombs.py::test_other_images_with_a_hole",
    ),
    # verdicts on poses and runs
    Fault(
        "pipelines/report/shortfall.py",
        "    if bad <= FEW * frames:",
        "    if True:",
        "pipelines/test_shortfall.py::test_many_frames_that_cannot_be_read",
    ),
    Fault(
        "pipelines/report/shortfall.py",
        "frames - tracked <= FEW * frames and maps < 2:",
        "frames - tracked <= FEW * frames:",
        "pipelines/test_shortfall.py::test_frames_lost",
    ),
    Fault(
        "pipelines/report/shortfall.py",
        "if stats.rejected.keys() - {NO_SAMPLES} or 2",
        "if 2",
        "pipelines/test_shortfall.py::test_what_is_not_at_the_server_or_in_its_map",
    ),
    Fault(
        "pipelines/report/run_record.py",
        "    if record.missed:",
        '    if "":',
        "pipelines/test_shortfall.py::test_a_run_is_as_good_as_its_worst_finding",
    ),
    Fault(
        "evaluation/trajectory_check.py",
        "moved if is_timed and force > VIOLENT else 0.0",
        "0.0",
        "evaluation/test_trajectory_check.py::test_a_step_that_no_sensor_makes_is_a_jump_where_frames_show_nothing",
    ),
    Fault(
        "evaluation/trajectory_check.py",
        "        if np.linalg.norm(difference) < SAME_SHIFT * far:",
        "        if True:",
        "evaluation/test_trajectory_check.py::test_poses_that_are_off_each_by_itself_neither_jump_nor_drift",
    ),
    Fault(
        "evaluation/trajectory_check.py",
        "    if not drifted or len(drifted) + strange < MIN_DRIFTED:",
        "    if not drifted:",
        "evaluation/test_trajectory_check.py::test_one_place_alone_shows_no_drift",
    ),
    Fault(
        "evaluation/trajectory_check.py",
        "    unusual &= off > UNUSUAL * min(np.percentile(off, 90), np.sort(off)[-3])  # one wrong pose has two steps\n",
        "",
        "evaluation/test_trajectory_check.py::test_poses_that_are_off_each_by_itself_neither_jump_nor_drift",
    ),
    Fault(
        "evaluation/trajectory_error.py",
        "    if 2 * pairs < shorter:",
        "    if False:",
        "evaluation/test_trajectory_error.py::test_poses_are_paired_by_what_both_files_know",
    ),
    # thin things, the unseen, hits
    Fault(
        "tsdf/sums/map_addition.py",
        "        store.hits[slots] += other.hits[theirs]",
        "        pass",
        "tsdf/test_thin_obstacles.py::test_hits_are_sums_that_go_with_the_map",
    ),
    Fault(
        "tsdf/files/saved_map_addition.py",
        '        sums["hits"][at] += rows["hits"]',
        "        pass",
        "tsdf/test_thin_obstacles.py::test_hits_are_sums_that_go_with_the_map",
    ),
    Fault(
        "kernels/surface/surface_cells.py",
        "ti.select((ended >= SEVERAL) & (value > 0.5), near, value)",
        "value",
        "tsdf/test_thin_obstacles.py::test_poles_that_a_lidar_hits_are_never_free",
    ),
    Fault(
        "tsdf/answers/distance_fields.py",
        "        surface_cells.hold_hits(store.slots_of(keys[i : i + _PART]), *store.ray_ends, part)\n",
        "",
        "tsdf/test_thin_obstacles.py::test_poles_that_a_lidar_hits_are_never_free",
    ),
    Fault(
        "geometry/map_grids.py",
        "return distance if unseen_is_free else np.where(states == UNSEEN, np.float32(0), distance)",
        "return distance",
        "tsdf/test_thin_obstacles.py::test_what_is_beside_a_wall_in_a_post_or_unseen_is_not_free_to_a_planner",
    ),
    # one thread, one process; copies; files of one's own
    Fault(
        "kernels/base/runtime.py",
        "    if get_ident() == _thread or _thread is None:",
        "    if _thread != _FORKED:",
        "tsdf/test_volume_threads.py::test_another_thread_is_refused_and_changes_nothing",
    ),
    Fault(
        "tsdf/volume.py",
        "        runtime.check_thread()\n",
        "",
        "tsdf/test_volume_threads.py::test_another_thread_is_refused_and_changes_nothing",
    ),
    Fault(
        "tsdf/store/block_store.py",
        "        runtime.check_thread()\n",
        "",
        "tsdf/test_volume_threads.py::test_a_slice_that_follows_the_map_is_of_the_same_thread",
    ),
    Fault(
        "tsdf/volume.py",
        "copy.deepcopy(self.meta)",
        "self.meta",
        "tsdf/test_volume.py::test_a_copy_shares_nothing",
    ),
    Fault(
        "tsdf/volume.py",
        "SensorPosture(self.held.numbers), self.quota",
        "self.held, self.quota",
        "tsdf/test_volume.py::test_a_copy_shares_nothing",
    ),
    Fault(
        "tsdf/store/block_store.py",
        "        self._removed, self._knows_from = other._removed, other._knows_from\n",
        "",
        "tsdf/test_volume.py::test_a_copy_knows_which_blocks_have_gone",
    ),
    Fault(
        "tsdf/files/saved_map.py",
        "if suffix in (*MESHES, *voxel_arrays.FORMATS):",
        "if False:",
        "tsdf/test_volume.py::test_a_map_has_not_the_name_of_another_kind",
    ),
    Fault(
        "delivery/spool.py",
        "        if os.getpid() != self._pid:",
        "        if False:",
        "delivery/test_forked_clients.py::test_a_child_removes_no_spool_of_its_parent",
    ),
    Fault(
        "client.py",
        "        if os.getpid() != self._pid:\n            raise TransportError",
        "        if False:\n            raise TransportError",
        "delivery/test_forked_clients.py::test_a_child_neither_sends_nor_removes_anything",
    ),
    Fault(
        "core/output_folder.py",
        "        if os.getpid() == pid:",
        "        if True:",
        "core/test_output_folder.py::test_a_forked_child_that_ends_leaves_the_work_to_its_parent",
    ),
    Fault(
        "core/output_folder.py",
        '        if there and begins == _BEGINNINGS[".tsf"] and not overwrite:',
        "        if False:",
        "core/test_output_folder.py::test_a_map_that_is_there_stays_unless_told",
    ),
    Fault(
        "core/output_folder.py",
        "        if there and begins and there != begins.lower():",
        "        if False:",
        "cli/test_map_command.py::test_what_is_there_already_stays",
    ),
    Fault(
        "cluster/__main__.py",
        "except (msgspec.MsgspecError, RecursionError) as error:",
        "except RecursionError as error:",
        "cli/test_command_line.py::test_what_is_no_job_ends_a_worker_in_one_line",
    ),
    Fault(
        "core/config.py",
        "    except (ValueError, RecursionError) as error:",
        "    except ValueError as error:",
        "cli/test_command_line.py::test_a_bad_setting_is_named_once",
    ),
    # pages: more of what a browser may say, and a look of its own
    Fault(
        "viewer/page/page_messages.py",
        "            if not _are_usual(numbers) or not 0",
        "            if not 0",
        "viewer/test_page_messages.py::test_a_camera_that_is_nowhere_is_passed_over",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "            if not _are_usual((*read.ray_origin, *read.ray_direction, *read.screen_pos[0])):",
        "            if False:",
        "viewer/test_page_messages.py::test_a_click_from_nowhere_is_passed_over",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "value if value in control.options else None",
        "value",
        "viewer/test_page_messages.py::test_a_control_gets_values_of_its_kind_within_its_bounds",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "len(numbers) == len(places) and ",
        "",
        "viewer/test_page_messages.py::test_a_control_gets_values_of_its_kind_within_its_bounds",
    ),
    Fault(
        "viewer/page/page_messages.py",
        "class _Updates(Struct, forbid_unknown_fields=True):",
        "class _Updates(Struct):",
        "viewer/test_page_messages.py::test_a_message_of_no_page_of_ours_is_an_error",
    ),
    Fault(
        "viewer/map/tile_nodes.py",
        "        if len(unread) > MOST_UNREAD:",
        "        if False:",
        "viewer/test_tile_nodes.py::test_a_look_of_ones_own_hides_the_shared_one_when_all_of_it_is_there_for_who_reads",
    ),
    Fault(
        "viewer/map/tile_nodes.py",
        "        if not self._missing and self._cover is None:",
        "        if self._cover is None:",
        "viewer/test_tile_nodes.py::test_a_look_of_ones_own_hides_the_shared_one_when_all_of_it_is_there_for_who_reads",
    ),
    # checkpoints, merges, what headers tell, moves
    Fault(
        "fuser/map_checkpoints.py",
        "for at in (0, -1) if",
        "for at in (0,) if",
        "fuser/test_fuser.py::test_a_checkpoint_whose_last_keyframe_alone_is_of_another_map_is_set_aside",
    ),
    Fault(
        "journal/record_scan.py",
        "(session, seq) and found.logged_ns <= until_ns",
        "(session, seq)",
        "fuser/test_fuser.py::test_a_journal_that_begins_anew_beside_an_older_checkpoint_keeps_it",
    ),
    Fault(
        "journal/record_scan.py",
        "isinstance(one, Erased) or (isinstance(one, Record) and one.logged_ns <= until_ns)",
        "isinstance(one, (Record, Erased))",
        "fuser/test_fuser.py::test_a_journal_that_begins_anew_beside_an_older_checkpoint_keeps_it",
    ),
    Fault(
        "tsdf/files/map_history.py",
        "    check_worlds(worlds(here), worlds(there), same_frame=same_frame)\n",
        "",
        "tsdf/test_map_addition.py::test_maps_of_other_worlds_are_merged_only_on_request",
    ),
    Fault(
        "tsdf/files/map_history.py",
        "    if len({one.position for one in origins}) > same_frame:",
        "    if len({one.position for one in origins}) > 1 and not same_frame:",
        "end_to_end/test_georeferenced.py::test_a_map_in_utm",
    ),
    Fault(
        "pipelines/maps/map_alignment.py",
        "max(initial=0.0))) > _MOST_THROUGH:",
        "max(initial=0.0))) > 2:",
        "cli/test_map_command.py::test_merge_asks_whether_maps_of_given_poses_are_in_one_frame",
    ),
    Fault(
        "pipelines/maps/map_alignment.py",
        "    if on.sum() / count * len(shared) < MIN_OVERLAP * min(len(ours), len(theirs)):",
        "    if False:",
        "cli/test_map_command.py::test_merge_asks_whether_maps_of_given_poses_are_in_one_frame",
    ),
    Fault(
        "tsdf/files/saved_map_addition.py",
        "        checkpoint.verify(path, header, digest.hexdigest())\n",
        "",
        "cli/test_map_command.py::test_what_a_header_tells_is_checked",
    ),
    Fault(
        "gateway/maps/map_registry.py",
        "(one for one in idle if one.name not in in_use)",
        "idle",
        "gateway/test_map_moves.py::test_a_map_in_use_keeps_its_process",
    ),
    Fault(
        "gateway/maps/map_registry.py",
        "one.fuser.waits and one.name not in self.arriving",
        "one.fuser.waits",
        "gateway/test_map_moves.py::test_a_map_that_comes_is_read_by_an_empty_ones_process",
    ),
    Fault(
        "fuser/__main__.py",
        "    _held.close()\n",
        "",
        "end_to_end/test_moved_maps.py::test_a_map_comes_into_the_process_of_an_empty_one_which_gets_another",
    ),
    Fault(
        "cluster/ray_scheduler.py",
        '            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))\n',
        "",
        "cluster/test_fusing.py::test_a_ray_cluster_of_ones_own_is_loopbacks_and_asks_for_a_token",
    ),
    Fault(
        "cluster/ray_scheduler.py",
        '    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",',
        "",
        "cluster/test_fusing.py::test_a_ray_cluster_of_ones_own_is_loopbacks_and_asks_for_a_token",
    ),
    Fault(
        "pipelines/runs/run_files.py",
        '    if find_spec("matplotlib") is not None:',
        "    if True:",
        "pipelines/test_latency_ledger.py::test_a_robot_without_matplotlib_has_the_figures",
    ),
    Fault(
        "pipelines/runs/target_server.py",
        '                with saved.open("rb") as old, replacing(path) as new:\n                    shutil.copyfileobj(old, new)',
        "                path.unlink(missing_ok=True)\n                os.link(saved, path)",
        "pipelines/test_target_server.py::test_a_saved_map_is_kept_whatever_became_of_others",
    ),
    # files that others read
    Fault(
        "geometry/mesh_encoding.py",
        "        scene.apply_transform(turn)\n",
        "",
        "geometry/test_mesh_encoding.py::test_glb",
    ),
    Fault(
        "geometry/mesh_encoding.py",
        '            if "material" not in part:',
        "            if False:",
        "geometry/test_mesh_encoding.py::test_glb",
    ),
    Fault(
        "geometry/mesh_encoding.py",
        '                tree["accessors"][number]["normalized"] = True\n',
        "",
        "geometry/test_mesh_encoding.py::test_glb",
    ),
    Fault(
        "geometry/point_files.py",
        "    header.global_encoding.wkt = True",
        "    pass",
        "geometry/test_point_files.py::test_las_holds_the_bytes_of_the_standard",
    ),
    Fault(
        "geometry/point_files.py",
        ".astype(np.float64) + origin.position",
        ".astype(np.float64)",
        "geometry/test_point_files.py::test_las_has_the_coordinates_that_the_poses_came_with",
    ),
    Fault(
        "journal/ros2_export.py",
        "            stamp_ns += 1\n",
        "            break\n",
        "journal/test_ros2_export.py::test_time_is_the_sensor_s_or_that_of_arrival",
    ),
)
