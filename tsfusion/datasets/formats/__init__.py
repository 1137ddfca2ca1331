# SPDX-License-Identifier: MIT
"""Readers of recording layouts, one file each."""
