# SPDX-License-Identifier: MIT
"""Synthetic worlds with a known surface, rendered as keyframes."""
