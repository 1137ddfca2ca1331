# SPDX-License-Identifier: MIT
"""Keyframes that are to leave a map: those that somebody names, and those beyond its window."""

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tsfusion.fuser import messages as fuser_messages
from tsfusion.fuser.keep_window import KeepWindow
from tsfusion.fuser.keyframe_search import KeyframeSearch
from tsfusion.fuser.messages import Begin, Expire, Find, SessionProgress
from tsfusion.journal import state_folder
from tsfusion.journal.keyframe_poses import KeyframePoses


class Departures:
    """The searches of one map. Call `look` when `wait` is over: the gateway journals what is found.

    Args:
        done: how far the map is with each session.
        send: takes a message.
    """

    def __init__(
        self,
        begin: Begin,
        poses: KeyframePoses,
        done: dict[bytes, SessionProgress],
        *,
        send: Callable[[Any], None],
    ) -> None:
        self._folder, self._poses, self._done, self._send = Path(begin.folder), poses, done, send
        self._searches: deque[KeyframeSearch] = deque()
        self.window = KeepWindow(
            poses,
            self._folder / state_folder.JOURNAL_FOLDER,
            seconds=begin.keep_seconds,
            keyframes=begin.keep_keyframes,
            radius=begin.keep_radius,
            send=send,
        )

    def ask(self, message: Find | Expire) -> None:
        """Take what the gateway wants to know, or to let go."""
        if isinstance(message, fuser_messages.Find):
            self._searches.append(KeyframeSearch(message, self._folder, self._poses, self._done))
        else:
            self.window.expire(message.before_segment)

    def wait(self, idle: bool) -> float | None:
        """Seconds until it is time to `look`; None = for ever."""
        return self._searches[0].wait(idle) if self._searches else self.window.wait(idle)

    def look(self) -> bool:
        """Look for a moment, and send what was found; whether it was the window that was looked at."""
        if not self._searches:
            self.window.look()
            return True
        if (found := self._searches[0].go_on()) is not None:
            self._searches.popleft()
            self._send(found)
        return False
