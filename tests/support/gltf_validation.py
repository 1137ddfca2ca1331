# SPDX-License-Identifier: MIT
"""Verdict of Khronos' validator on GLB files; tests skip where it is not installed."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

_VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs');
validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[1])))
  .then(report => console.log(JSON.stringify(report)));
"""


def problems(file: Path) -> list[dict[str, Any]]:
    """Errors and warnings of a file: each with `code`, `message` and `pointer`, a place in its JSON."""
    if (node := shutil.which("node")) is None:
        pytest.skip("node is not installed")
    done = subprocess.run(
        [node, "-e", _VALIDATE, file], capture_output=True, text=True, timeout=120, check=False
    )
    if "Cannot find module 'gltf-validator'" in done.stderr:
        pytest.skip("gltf-validator is not installed (npm install gltf-validator; NODE_PATH=…/node_modules)")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)["issues"]
    assert not found["truncated"]
    return [one for one in found["messages"] if one["severity"] <= 1]
