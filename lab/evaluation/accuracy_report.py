# SPDX-License-Identifier: MIT
"""Report of the ablation's rows: a file of JSON lines, Markdown tables and plots."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from tsfusion.core import durable_files

Rows = dict[str, dict[str, Any]]  # by name
ROWS, TABLES = "rows.jsonl", "tables.md"
BEGIN, END = "<!-- tables: python lab/evaluation/accuracy.py --write-docs -->", "<!-- end of tables -->"


class Column(NamedTuple):
    """A figure of a row."""

    title: str
    path: str  # keys, joined by dots
    digits: int

    def of(self, row: dict[str, Any]) -> float | None:
        value: Any = row
        for key in self.path.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        return None if value is None else float(value)

    def text(self, row: dict[str, Any]) -> str:
        value = self.of(row)
        return "" if value is None else f"{value:.{self.digits}f}"


MEAN = Column("mean mm", "accuracy_mm.mean", 2)
F_SCORE = Column("F", "f_score", 1)
EDGE = Column("edge mm", "edge_mm", 2)
PREDICTED = (
    Column("unseen median mm", "predicted.median_mm", 2), Column("p90", "predicted.p90_mm", 1),
    Column("p90 of all", "predicted.all_p90_mm", 1), Column("within 1 voxel %", "predicted.within_voxel", 1),
    Column("predicted %", "predicted.predicted", 1),
)  # fmt: skip
COLUMNS = (
    MEAN, Column("RMSE", "accuracy_mm.rmse", 2), Column("p95", "accuracy_mm.p95", 1),
    Column("precision %", "precision", 1), Column("completeness %", "completeness", 1), F_SCORE,
    Column("normal ° median", "normal_deg.median", 2), Column("normal ° mean", "normal_deg.mean", 2),
    EDGE, Column("edge completeness %", "edge_completeness", 1),
    *PREDICTED,
    Column("CPU ms a keyframe", "keyframe_cpu_ms", 1), Column("mesh CPU ms", "mesh_cpu_ms", 0),
)  # fmt: skip


class Question(NamedTuple):
    """Question that a group of rows answers, the figures that answer it, and which of them is plotted."""

    title: str
    plot: str
    figures: tuple[Column, ...]
    plotted: int = 0


QUESTIONS = {
    "noise": Question("Noise: the shared room, 40 keyframes, 2 cm", "noise", (MEAN, F_SCORE)),
    "keyframes": Question("How many keyframes: the room on a circle, 2 cm", "keyframes", (MEAN, F_SCORE)),
    "trajectories": Question("Other paths and seeds: the room, 80 keyframes, 2 cm", "paths", (MEAN, F_SCORE)),
    "street": Question("The street, 40 keyframes, 10 cm", "street", (MEAN, F_SCORE)),
    "details": Question("Corners, edges and thin parts, 60 keyframes, 2 cm", "edges", (EDGE, MEAN)),
    "bunny": Question("Real range scans: the bunny against its reference, 1 mm", "bunny", (MEAN, F_SCORE)),
    "predicted": Question("Real views that were not fused, predicted", "predicted", PREDICTED, 3),
    "drift": Question("A still camera: does the surface drift?", "drift", (MEAN,)),
}


def read(folder: Path) -> Rows:
    """The rows a folder keeps."""
    path = folder / ROWS
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return {row["row"]: row for row in map(json.loads, lines)}


def keep(folder: Path, rows: Rows) -> None:
    """Write the rows of a folder, all of them or none."""
    folder.mkdir(parents=True, exist_ok=True)
    with durable_files.replacing(folder / ROWS) as file:
        file.writelines(f"{json.dumps(row)}\n".encode() for row in rows.values())


def write(folder: Path, rows: Rows, order: list[str]) -> list[Path]:
    """The tables with every column, and the plots; without matplotlib no plots."""
    chosen = [rows[name] for name in order if name in rows]
    parts = [f"## {QUESTIONS[key].title}\n\n{full_table(group)}" for key, group in _questions(chosen)]
    (folder / TABLES).write_text("\n".join(parts), encoding="utf-8")
    return [folder / ROWS, folder / TABLES, *plots(folder, "", chosen)]


def write_docs(docs: Path, rows: Rows, order: list[str]) -> list[Path]:
    """A summary a question with its plot, between the marks of accuracy.md; every column in a file beside."""
    chosen = [rows[name] for name in order if name in rows]
    images = {path.stem: path for path in plots(docs / "images", "accuracy-", chosen)}
    parts = [_provenance(chosen)]
    for key, group in _questions(chosen):
        question = QUESTIONS[key]
        parts.append(f"### {question.title}\n\n{summary_table(group, question.figures)}")
        if path := images.get(f"accuracy-{question.plot}"):
            parts.append(f"![{question.title}](images/{path.name})\n")
    page, every = docs / "accuracy.md", docs / "accuracy-rows.md"
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{BEGIN}\n\n" + "\n".join(parts) + f"\n{END}{after}", encoding="utf-8")
    tables = [f"## {QUESTIONS[key].title}\n\n{full_table(group)}" for key, group in _questions(chosen)]
    says = "Written by `python lab/evaluation/accuracy.py`; [accuracy.md](accuracy.md) says what it is."
    head = f"# Every row\n\n{says}\n"
    every.write_text("\n".join([head, *tables]), encoding="utf-8")
    return [page, every, *images.values()]


def full_table(rows: list[dict[str, Any]]) -> str:
    """Markdown: a line a row, every column that some row has."""
    columns = [column for column in COLUMNS if any(column.of(row) is not None for row in rows)]
    lines = [["setup", "method", *(column.title for column in columns)]]
    lines += [[row["setup"], row["method"], *(column.text(row) for column in columns)] for row in rows]
    return _markdown(lines)


def summary_table(rows: list[dict[str, Any]], figures: tuple[Column, ...]) -> str:
    """Markdown: a line a setup, a column a method; the best of the first figure is bold."""
    methods = _distinct(row["method"] for row in rows)
    unit = " / ".join(figure.title for figure in figures)
    lines = [[unit, *methods]]
    for setup in _distinct(row["setup"] for row in rows):
        found = {row["method"]: row for row in rows if row["setup"] == setup}
        known = [value for row in found.values() if (value := figures[0].of(row)) is not None]
        best = min(known, default=None)
        cells = [_cell(found.get(method), figures, best) for method in methods]
        lines.append([setup, *cells])
    return _markdown(lines)


def plots(folder: Path, prefix: str, rows: list[dict[str, Any]]) -> list[Path]:
    """One PNG a question; none without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for key, group in _questions(rows):
        question = QUESTIONS[key]
        draw = _lines if key in ("keyframes", "drift") else _bars
        panels = draw(group)
        high, wide = -(-len(panels) // 3), min(len(panels), 3)
        figure = Figure(figsize=(max(5.0, 3.4 * wide), 3.4 * high), dpi=100, layout="constrained")
        axes = figure.subplots(high, wide, squeeze=False).flat
        for axis in axes[len(panels) :]:
            axis.set_visible(False)
        for (title, paint), axis in zip(panels, axes, strict=False):
            paint(axis, question.figures[question.plotted])
            axis.set_title(title, fontsize=9)
            axis.spines[["top", "right"]].set_visible(False)
            axis.tick_params(labelsize=8)
            axis.set_ylabel(question.figures[question.plotted].title, fontsize=8)
        figure.suptitle(question.title, fontsize=10)
        path = folder / f"{prefix}{question.plot}.png"
        figure.savefig(path)
        written.append(path)
    return written


Panel = tuple[str, Callable[[Any, Column], None]]


def _bars(rows: list[dict[str, Any]]) -> list[Panel]:
    """A panel a setup, a bar a method."""

    def painter(group: list[dict[str, Any]]) -> Callable[[Any, Column], None]:
        def paint(axis: Any, figure: Column) -> None:
            shown = [row for row in group if figure.of(row) is not None]
            bars = axis.bar(
                [row["method"] for row in shown], [figure.of(row) for row in shown],
                color=[_color(row["method"]) for row in shown],
            )  # fmt: skip
            axis.bar_label(bars, [figure.text(row) for row in shown], fontsize=6)
            axis.tick_params(axis="x", labelrotation=90)

        return paint

    setups = _distinct(row["setup"] for row in rows)
    return [(setup, painter([row for row in rows if row["setup"] == setup])) for setup in setups]


def _lines(rows: list[dict[str, Any]]) -> list[Panel]:
    """A panel a noise, a line a method over the number of keyframes."""

    def painter(group: list[dict[str, Any]]) -> Callable[[Any, Column], None]:
        def paint(axis: Any, figure: Column) -> None:
            for method in _distinct(row["method"] for row in group):
                points = [(row["keyframes"], figure.of(row)) for row in group if row["method"] == method]
                style = {"color": _color(method), "marker": "o", "markersize": 3, "linewidth": 1.2}
                if method == "default":  # on top, and what it lies on shows through
                    style |= {"linestyle": ":", "zorder": 9, "linewidth": 2}
                axis.plot(*zip(*points, strict=True), label=method, **style)
            counts = sorted({row["keyframes"] for row in group})
            axis.set(xscale="log", xlabel="keyframes", ylim=(0, None))
            axis.set_xticks(counts, [str(count) for count in counts])
            axis.minorticks_off()
            axis.legend(fontsize=7, frameon=False)

        return paint

    noises = _distinct(row["noise"] for row in rows)
    return [(noise, painter([row for row in rows if row["noise"] == noise])) for noise in noises]


def _color(method: str) -> str:
    known = {
        "default": "#111111", "off": "#8c8c8c", "exact": "#c7c7c7", "paper": "#d62728", "ray": "#1f77b4",
        "normal": "#17becf", "field": "#2ca02c", "ray+normal": "#9467bd", "ray+field": "#bcbd22",
        "open3d": "#ff7f0e", "open3d-1": "#ffbb78", "vdbfusion": "#8c564b", "carving": "#e377c2",
    }  # fmt: skip
    return known[method]


def _cell(row: dict[str, Any] | None, figures: tuple[Column, ...], best: float | None) -> str:
    if row is None or figures[0].of(row) is None:
        return ""
    text = " / ".join(figure.text(row) or "–" for figure in figures)
    return f"**{text}**" if figures[0].of(row) == best else text


def _provenance(rows: list[dict[str, Any]]) -> str:
    """Versions that the rows were measured with."""
    commits = ", ".join(_distinct(row["commit"] for row in rows))
    versions = {name: number for row in rows for name, number in row["versions"].items()}
    packages = ", ".join(f"{name} {number}" for name, number in versions.items())
    place = f"{rows[0]['machine']}, threads: {rows[0]['threads']}"
    return f"{len(rows)} rows; commit {commits}; {place}; {packages}.\n"


def _questions(rows: list[dict[str, Any]]) -> list[tuple[str, list[dict[str, Any]]]]:
    groups = [(key, [row for row in rows if row["question"] == key]) for key in QUESTIONS]
    return [(key, group) for key, group in groups if group]


def _markdown(lines: list[list[str]]) -> str:
    head, *body = ["| " + " | ".join(line) + " |" for line in lines]
    rule = "|---" * len(lines[0]) + "|"
    return "\n".join([head, rule, *body]) + "\n"


def _distinct(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))
