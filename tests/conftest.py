# SPDX-License-Identifier: MIT
"""Fixtures shared by all tests."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

DATA = Path(os.environ.get("TSFUSION_DATA", Path(__file__).parents[2] / "shared" / "data"))


@pytest.fixture(scope="session")
def data() -> Callable[[str], Path]:
    """`data("7scenes/redkitchen")`: a folder of real sensor data, or a skip that says what is missing."""

    def find(name: str) -> Path:
        folder = DATA / name
        if not folder.exists():
            pytest.skip(f"no {name} in {DATA}: set TSFUSION_DATA to the folder of recorded datasets")
        return folder

    return find
