# SPDX-License-Identifier: MIT
"""Download public recordings, check and unpack them."""
