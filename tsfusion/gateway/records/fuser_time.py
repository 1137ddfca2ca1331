# SPDX-License-Identifier: MIT
"""The fuser's time, shared out among clients: who took least of it is next.

Start-time fair queueing (Goyal, Vin and Cheng 1996), in seconds: a record is charged to its client with what
it is expected to take, and, when the fuser has answered, with what it took. A client that was away has saved
nothing up: it begins where the one that was served last began. A new one begins later by the longest of the
last records: without keys each session counts as a client, and who opens many must not go before all others.
"""

from collections import OrderedDict
from collections.abc import Iterable

from msgspec import Struct

_AHEAD = 0.1  # seconds of work that the fuser may have in its queue: whoever comes next waits so long
_FADING = 0.8  # of what records are expected to take, each time that one took less
_MAX_CLIENTS = 4096


class _Account(Struct):
    taken: float  # seconds, as if the client had always been there
    expected: float = _AHEAD  # seconds that its next record may take


class FuserTime:
    """The accounts of the clients of one map."""

    def __init__(self) -> None:
        self._accounts: OrderedDict[str, _Account] = OrderedDict()
        self._charged: dict[int, tuple[str, float]] = {}  # index of a record under way → client, seconds
        self._now = 0.0  # what the client that was served last had taken before
        self._longest = 0.0  # seconds that one of the last records took

    def next_of(self, clients: Iterable[str]) -> str:
        """The client that took least; of equals the one whose record is expected to take least."""
        return min(clients, key=self._place_of)

    def _place_of(self, client: str) -> tuple[float, float]:
        account = self._account(client)
        return max(account.taken, self._now), account.expected

    def has_room_for(self, client: str) -> bool:
        """True if a record of a client may wait in the fuser's queue."""
        ahead = sum(seconds for _, seconds in self._charged.values())
        return not self._charged or ahead + self._account(client).expected <= _AHEAD

    def charge(self, client: str, index: int) -> None:
        """Note that a client's record was handed out."""
        account = self._account(client)
        self._now = max(account.taken, self._now)
        account.taken = self._now + account.expected
        self._charged[index] = client, account.expected

    def settle(self, index: int, seconds: float) -> None:
        """Note how long the fuser took for a record."""
        client, charged = self._charged.pop(index, (None, 0.0))
        if client is not None:
            account = self._account(client)
            account.taken += seconds - charged
            account.expected = max(seconds, _FADING * account.expected)
            self._longest = max(seconds, _FADING * self._longest)

    def restart(self) -> None:
        """Forget what was under way: the fuser has ended. It stays charged."""
        self._charged.clear()

    def _account(self, client: str) -> _Account:
        account = self._accounts.get(client)
        if account is None:
            account = self._accounts[client] = _Account(self._now + self._longest)
            if len(self._accounts) > _MAX_CLIENTS:
                self._accounts.popitem(last=False)
        self._accounts.move_to_end(client)
        return account
