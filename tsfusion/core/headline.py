# SPDX-License-Identifier: MIT
"""One line that answers three questions: is it working, is it keeping up, is anything lost?"""

from typing import Literal

from msgspec import Struct

from tsfusion.core.readable_numbers import count_of, span

Severity = Literal["good", "notice", "bad"]
MARKS: dict[Severity, str] = {"good": "✓", "notice": "!", "bad": "✗"}
_FEW = 3  # keyframes under way are no delay, however slow the map is: one travels, one waits, one is fused
_SOON = 1.0  # seconds: what is fused within these is no delay either, however many keyframes it is


class Headline(Struct, frozen=True, kw_only=True):
    """State of a run, a map or a server in words; the mark before them and their colours only support.

    Attributes:
        doing: current activity, in a word or two.
        trouble: reason why it does not work, in a few words; empty = it works.
        waiting: keyframes that are taken, but not fused yet.
        rate: keyframes fused a second; 0 = not known.
        lost: keyframes that are not in the map and will not come into it.
    """

    doing: str = "working"
    trouble: str = ""
    waiting: int = 0
    rate: float = 0.0
    lost: int = 0

    @property
    def is_behind(self) -> bool:
        """True if more keyframes wait than are always on their way."""
        return self.waiting > _FEW and (not self.rate or self.waiting / self.rate > _SOON)

    @property
    def parts(self) -> list[tuple[str, Severity]]:
        """The three answers, each with its severity."""
        works: tuple[str, Severity] = (self.trouble, "bad") if self.trouble else (self.doing, "good")
        pace: tuple[str, Severity] = (self.pace, "notice" if self.is_behind else "good")
        return [works, pace, (f"lost {count_of(self.lost, 'keyframe')}", "bad" if self.lost else "good")]

    @property
    def pace(self) -> str:
        """Words for the pace: keeping up, or the number and, if known, the time of waiting keyframes."""
        if not self.is_behind:
            return "keeping up"
        seconds = f", about {span(self.waiting / self.rate)}" if self.rate else ""
        return f"behind by {count_of(self.waiting, 'keyframe')}{seconds}"

    @property
    def mark(self) -> tuple[str, Severity]:
        """Sign of the worst of the three answers."""
        level = max((level for _, level in self.parts), key=list(MARKS).index)
        return MARKS[level], level

    @property
    def words(self) -> str:
        """The three answers without the mark."""
        return " · ".join(words for words, _ in self.parts)

    def __str__(self) -> str:
        return f"{self.mark[0]} {self.words}"
