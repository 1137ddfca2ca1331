# SPDX-License-Identifier: MIT
"""The gateway's messages to a fuser: questions to the map apart, for they go before everything else."""

from collections import deque
from collections.abc import Sequence

import zmq

from tsfusion.fuser import messages as fuser_messages
from tsfusion.fuser.messages import FuserQuestion, ToFuser
from tsfusion.wire import sockets


class Inbox:
    """Messages that came over the socket and were not handled yet.

    Args:
        link: the socket; None = nobody sends any.
    """

    def __init__(self, link: sockets.AnySocket | None = None) -> None:
        self.orders: deque[ToFuser] = deque()  # in the order of their coming
        self.questions: deque[tuple[FuserQuestion, Sequence[zmq.Frame]]] = deque()
        self._link = link

    def read(self) -> None:
        """Take all that has come; never waits."""
        while self._link is not None and int(self._link.getsockopt(zmq.EVENTS)) & zmq.POLLIN:
            head, *frames = self._link.recv_multipart(copy=False)
            message = fuser_messages.to_fuser.decode(head.buffer)
            if isinstance(message, FuserQuestion):
                self.questions.append((message, frames))
            else:
                self.orders.append(message)
