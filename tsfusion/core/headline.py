# SPDX-License-Identifier: MIT
"""Summarise a run in one line: does it work, does it keep up, is anything lost?"""

from typing import Literal

from msgspec import Struct

from tsfusion.core.readable_numbers import count_of, span

Severity = Literal["good", "notice", "bad"]
MARKS: dict[Severity, str] = {"good": "✓", "notice": "!", "bad": "✗"}
_FEW = 3  # so many keyframes are no delay, even with a slow map: one travels, one waits, one is fused
_SOON = 1.0  # seconds: keyframes that are fused in this time are no delay, whatever their number


class Headline(Struct, frozen=True, kw_only=True):
    """State of a run, a map or a server in words; the mark and the colours only repeat it.

    Attributes:
        doing: current activity, in a word or two.
        trouble: the problem, in a few words; empty = all works.
        waiting: keyframes that are taken, but not fused yet.
        rate: keyframes fused a second; 0 = unknown.
        lost: keyframes that are not in the map and never will be.
    """

    doing: str = "working"
    trouble: str = ""
    waiting: int = 0
    rate: float = 0.0
    lost: int = 0

    @property
    def is_behind(self) -> bool:
        """True if more keyframes wait than the few that are always between scanner and map."""
        return self.waiting > _FEW and (not self.rate or self.waiting / self.rate > _SOON)

    @property
    def parts(self) -> list[tuple[str, Severity]]:
        """The activity or the trouble, the pace, and the lost keyframes: each as text with its severity."""
        works: tuple[str, Severity] = (self.trouble, "bad") if self.trouble else (self.doing, "good")
        pace: tuple[str, Severity] = (self.pace, "notice" if self.is_behind else "good")
        return [works, pace, (f"lost {count_of(self.lost, 'keyframe')}", "bad" if self.lost else "good")]

    @property
    def pace(self) -> str:
        """The pace as text: keeping up, or the number of waiting keyframes and the time that they take."""
        if not self.is_behind:
            return "keeping up"
        seconds = f", about {span(self.waiting / self.rate)}" if self.rate else ""
        return f"behind by {count_of(self.waiting, 'keyframe')}{seconds}"

    @property
    def mark(self) -> tuple[str, Severity]:
        """The sign (such as ✓) and severity of the worst part of the line."""
        level = max((level for _, level in self.parts), key=list(MARKS).index)
        return MARKS[level], level

    @property
    def words(self) -> str:
        """The line's parts as text, without the mark."""
        return " · ".join(words for words, _ in self.parts)

    def __str__(self) -> str:
        return f"{self.mark[0]} {self.words}"
