# SPDX-License-Identifier: MIT
"""Public recordings: where they are, fetched and checked."""
