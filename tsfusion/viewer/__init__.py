# SPDX-License-Identifier: MIT
"""The live page: a map that grows in a browser."""
