# SPDX-License-Identifier: MIT
"""The write-ahead log of keyframe messages: MCAP segments in a folder.

A keyframe is on the disk when `Journal.append` returns. MCAP cannot be appended to, so each start opens a
new segment. One chunk a keyframe, uncompressed: the arrays are compressed already, and a chunk has a CRC.
"""

from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import Damage, segment_number, walk
from tsfusion.journal.segments import (
    Scan,
    describe,
    is_closed,
    read,
    read_at,
    records,
    scan,
    segment_path,
    segments,
)
from tsfusion.journal.writer import Journal, write_file

__all__ = [
    "Damage",
    "Journal",
    "Position",
    "Record",
    "Scan",
    "describe",
    "is_closed",
    "read",
    "read_at",
    "records",
    "scan",
    "segment_number",
    "segment_path",
    "segments",
    "walk",
    "write_file",
]
