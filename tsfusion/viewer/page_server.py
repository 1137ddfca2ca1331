# SPDX-License-Identifier: MIT
"""The web server of a page: who may open it, from where."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    pass


class PageServer:
    """A running web server with an empty page.

    Attributes:
        server: to fill the page with.
        url: to open it with.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, *, token: str | None = None) -> None:
        import viser

        self.server: viser.ViserServer = viser.ViserServer(host=host, port=port, verbose=False)
        self.url = f"http://{host}:{self.server.get_port()}"

    def close(self) -> None:
        """End it, and every connection to it."""
        self.server.stop()
