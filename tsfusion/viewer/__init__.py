# SPDX-License-Identifier: MIT
"""The live page: a map that grows in a browser."""

LISTEN = "127.0.0.1:5558"  # where it is shown: the port after those of a server
