# SPDX-License-Identifier: MIT
"""The live page: a map that grows in a browser.

Rooms:
    panels: what the page says beside the map, and its switches.
    map: tiles of the surface, colours, clipping, scanners.
    page: the web server, its guard, and the browser's messages.
"""

LISTEN = "127.0.0.1:5558"  # where it is shown: the port after those of a server
