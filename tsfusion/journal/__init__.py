# SPDX-License-Identifier: MIT
"""Write and read a map's journal: the write-ahead log of its records, as MCAP segments in a folder.

A keyframe is on the disk when `Journal.append` returns. MCAP files cannot be appended to, so each start opens
a new segment. Each keyframe is one chunk with a CRC, uncompressed because its arrays are compressed already.
"""

from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import (
    Damage,
    Erased,
    describe,
    has_another,
    is_closed,
    list_records,
    records,
    scan_records,
)
from tsfusion.journal.segments import (
    RecordEntry,
    SegmentReader,
    is_away,
    is_segment,
    logged_ns,
    read,
    read_at,
    segment_number,
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
