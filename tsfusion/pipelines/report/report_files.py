# SPDX-License-Identifier: MIT
"""Files of a report: pictures, then the page; each whole or not there."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import OutputError
from tsfusion.pipelines import mesh_preview

ENDINGS = (".html", ".htm")
Pictures = dict[str, NDArray[np.uint8]]  # name, (height, width, 3) RGB


def write(html: str, drawn: Pictures, out: Path) -> list[Path]:
    """Write a page as `out`, and its pictures as `OUT-NAME.png` beside it; the files, the page last.

    Raises:
        OutputError: when they cannot be written.
    """
    files = []
    for name, rgb in drawn.items():
        files.append(out.with_name(f"{out.stem}-{name}.png"))
        mesh_preview.write_png(rgb, files[-1])
    try:
        with durable_files.replacing(out) as file:
            # Lone surrogates come from names of files that are no text.
            file.write(html.encode("utf-8", errors="backslashreplace"))
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    return [*files, out]
