# SPDX-License-Identifier: MIT
"""Reports: a run, or a saved map, as one page: pictures, a 3-D view, charts, tables."""
