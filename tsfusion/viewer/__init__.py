# SPDX-License-Identifier: MIT
"""Show a map, also while it grows, in a browser (the live page), or in Foxglove.

Rooms:
    panels: controls and text beside the map.
    foxglove: the map as topics of a WebSocket server.
    map: tiles of the surface, colours, clipping, scanners.
    page: the web server, its guard, and the browser's messages.
"""

LISTEN = "127.0.0.1:5558"  # the page's address; its port follows those of a server
FOXGLOVE = "127.0.0.1:8765"  # where Foxglove looks first
