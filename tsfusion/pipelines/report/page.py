# SPDX-License-Identifier: MIT
"""Build the page of a report: one HTML file that makes no network request."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.headline import Severity
from tsfusion.pipelines.maps import mesh_preview
from tsfusion.viewer.map.vertex_colors import color_ramp

# No request leaves the page, whatever text it holds.
_POLICY = (
    "default-src 'none'; base-uri 'none'; "
    "img-src data:; style-src 'unsafe-inline'; script-src 'unsafe-inline'"
)
ENDINGS = (".html", ".htm")
Pictures = dict[str, NDArray[np.uint8]]  # name, (height, width, 3) RGB


@dataclass
class Page:
    """Contents of a report page.

    Attributes:
        verdict: a sentence that says if all is well; `level` gives its colour.
        warnings: a sentence each.
        tiles: title, figure and note of each headline figure.
        sections: title and HTML of each section.
    """

    title: str
    subtitle: str
    verdict: str
    level: Severity = "good"
    warnings: list[str] = field(default_factory=list)
    tiles: list[tuple[str, str, str]] = field(default_factory=list)
    sections: list[tuple[str, str]] = field(default_factory=list)
    footer: str = ""

    def html(self) -> str:
        """Return the whole page as HTML."""
        sections = "".join(
            f"<section><h2>{escape(title)}</h2>{body}</section>" for title, body in self.sections if body
        )
        viewer = f"<script>{_resource('viewer.js')}</script>" if 'class="viewer"' in sections else ""
        colors = json.dumps(color_ramp().ravel().tolist(), separators=(",", ":")) if viewer else "[]"
        return (
            '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f'<meta http-equiv="Content-Security-Policy" content="{_POLICY}">'
            f"<title>{escape(self.title)}</title><style>{_resource('page.css')}</style></head>\n<body><main>"
            f'<header><h1>{escape(self.title)}</h1><p class="sub">{escape(self.subtitle)}</p>'
            f'<p class="verdict {self.level}">{escape(self.verdict)}</p>{self._warnings()}'
            f"</header>{self._tiles()}\n{sections}\n<footer>{escape(self.footer)}</footer></main>\n"
            f'<script type="application/json" id="ramp">{colors}</script>{viewer}</body></html>\n'
        )

    def _warnings(self) -> str:
        lines = "".join(f"<li>{escape(line)}</li>" for line in self.warnings)
        return f'<ul class="warnings">{lines}</ul>' if lines else ""

    def _tiles(self) -> str:
        boxes = "".join(
            f"<div><dt>{escape(title)}</dt><dd>{escape(figure)}<small>{escape(note)}</small></dd></div>"
            for title, figure, note in self.tiles
        )
        return f'<dl class="tiles">{boxes}</dl>' if boxes else ""


def table(head: Sequence[str], rows: Iterable[Sequence[str]], *, styles: Sequence[str] = ()) -> str:
    """Return the HTML of a table of texts, in which all columns but the first hold numbers.

    Args:
        styles: CSS class of the colour sample before each row.
    """
    top = "".join(f"<th>{escape(cell)}</th>" for cell in head)
    lines = []
    for number, row in enumerate(rows):
        swatch = f'<i class="{styles[number]}"></i>' if number < len(styles) and styles[number] else ""
        first, *rest = (escape(cell) for cell in row)
        lines.append(f"<tr><td>{swatch}{first}</td>{''.join(f'<td>{cell}</td>' for cell in rest)}</tr>")
    rows_of = "".join(lines)
    inner = f'<table class="numbers"><thead><tr>{top}</tr></thead><tbody>{rows_of}</tbody></table>'
    return f'<div class="scroll">{inner}</div>'


def facts(rows: Iterable[tuple[str, str]]) -> str:
    """Return the HTML of a table of names and texts, without rows that have no text."""
    lines = (f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>" for name, text in rows if text)
    return f'<table class="facts"><tbody>{"".join(lines)}</tbody></table>'


def folded(title: str, text: str) -> str:
    """Return the HTML of a text that the reader opens by a click on its title."""
    return f"<details><summary>{escape(title)}</summary><pre>{escape(text)}</pre></details>"


def note(text: str) -> str:
    """Return the HTML of a sentence that explains something."""
    return f'<p class="note">{escape(text)}</p>'


def picture(url: str, caption: str) -> str:
    """Return the HTML of a picture with a caption."""
    return (
        f'<figure><img src="{url}" alt="{escape(caption)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
    )


def chart(svg: str, caption: str, *, legend: str = "", is_wide: bool = False) -> str:
    """Return the HTML of a chart with its title above."""
    inner = f'<div class="scroll">{svg}</div>' if is_wide else svg
    return f"<figure><h3>{escape(caption)}</h3>{legend}{inner}</figure>"


def pair(*parts: str) -> str:
    """Return the HTML of figures side by side, if there is room."""
    return f'<div class="pair">{"".join(parts)}</div>'


def _resource(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


def write(html: str, drawn: Pictures, out: Path) -> list[Path]:
    """Write a page as `out` and its pictures as `OUT-NAME.png` beside it. Return the files, the page last.

    Raises:
        OutputError: when they cannot be written.
    """
    files = []
    for name, rgb in drawn.items():
        files.append(out.with_name(f"{out.stem}-{name}.png"))
        mesh_preview.write_png(rgb, files[-1])
    with durable_files.written(out) as file:
        # Lone surrogates come from names of files that are no text.
        file.write(html.encode("utf-8", errors="backslashreplace"))
    return [*files, out]
