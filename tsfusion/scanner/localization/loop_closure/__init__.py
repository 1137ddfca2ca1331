# SPDX-License-Identifier: MIT
"""Loop closure: places seen again, and the poses corrected by them."""
