# SPDX-License-Identifier: MIT
"""How good a surface is: measures against a known truth, and of real views that were not fused."""
