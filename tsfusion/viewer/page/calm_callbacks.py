# SPDX-License-Identifier: MIT
"""Callbacks of browsers: what goes wrong in one is a line in the log, and nothing else ends."""

import logging
from collections.abc import Callable
from typing import Any

log = logging.getLogger(__name__)


def calm(callback: Callable[..., object]) -> Callable[..., None]:
    """The callback, whose exceptions are logged in a line."""

    def call(*given: Any) -> None:
        try:
            callback(*given)
        except Exception as error:  # noqa: BLE001 - a browser may leave at any moment, in any call
            log.warning("a request of a browser failed: %s: %s", type(error).__name__, error)

    return call
