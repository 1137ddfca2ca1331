# SPDX-License-Identifier: MIT
"""A display of `tsfusion fuse` that shows nothing."""


class Silent:
    """Remembers how many keyframes were read and fused, of how many."""

    def __init__(self) -> None:
        self.shown: list[tuple[int, int, int]] = []

    def stage(self, text: str) -> None:
        pass

    def show_fused(self, read: int, fused: int, total: int) -> None:
        self.shown.append((read, fused, total))

    def show_steps(self, text: str, done: int, total: int) -> None:
        pass
