# SPDX-License-Identifier: MIT
"""Fuse parts of journals and datasets by many processes, on one machine or a cluster, and add the parts."""
