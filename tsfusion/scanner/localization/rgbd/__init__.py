# SPDX-License-Identifier: MIT
"""The localizer of RGB-D cameras: corners and planes together."""
