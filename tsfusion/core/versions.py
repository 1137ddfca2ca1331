# SPDX-License-Identifier: MIT
"""Versions of installed packages."""

from importlib import metadata

import tsfusion


def version_of(package: str) -> str:
    """Version of a package, or `missing`. tsfusion also runs where it is not installed, from its sources."""
    if package == "tsfusion":
        return tsfusion.__version__
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "missing"
