# SPDX-License-Identifier: MIT
"""One file a recording layout."""
