# SPDX-License-Identifier: MIT
"""Counts in sentences."""


def count_of(number: int, one: str, many: str = "") -> str:
    """`1 keyframe`, `3 keyframes`; give both forms where a verb follows: `keyframe is`, `keyframes are`."""
    return f"{number} {one if number == 1 else many or f'{one}s'}"
