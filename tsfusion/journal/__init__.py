# SPDX-License-Identifier: MIT
"""The write-ahead log of keyframe messages: MCAP segments in a folder.

A keyframe is on the disk when `Journal.append` returns. MCAP cannot be appended to, so each start opens a
new segment. One chunk a keyframe, uncompressed: the arrays are compressed already, and a chunk has a CRC.
"""

from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import Damage, Erased, scan_records, segment_number
from tsfusion.journal.segments import (
    RecordEntry,
    SegmentReader,
    describe,
    has_another,
    is_away,
    is_closed,
    is_segment,
    list_records,
    logged_ns,
    read,
    read_at,
    records,
    segment_path,
    segments,
)
from tsfusion.journal.writer import Journal, ReadingWatcher, Unwritten, write_file

__all__ = [
    "Damage",
    "Erased",
    "Journal",
    "Position",
    "ReadingWatcher",
    "Record",
    "RecordEntry",
    "SegmentReader",
    "Unwritten",
    "describe",
    "has_another",
    "is_away",
    "is_closed",
    "is_segment",
    "list_records",
    "logged_ns",
    "read",
    "read_at",
    "records",
    "scan_records",
    "segment_number",
    "segment_path",
    "segments",
    "write_file",
]
