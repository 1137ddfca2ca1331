# SPDX-License-Identifier: MIT
"""Maps fused by many processes, of this machine or of a cluster: parts of a journal, and their sum."""
