# SPDX-License-Identifier: MIT
"""The verdicts and figures of a run, put into docs/paper.md."""

import shutil
from collections.abc import Sequence
from pathlib import Path

from lab.paper.paper_report import AteRow
from lab.paper.paper_verdicts import Findings, Verdict
from tsfusion.pipelines.report import run_record

BEGIN, END = "<!-- table: python lab/paper/reproduce_paper.py --write-docs -->", "<!-- end of table -->"
_STATE = {True: "met", False: "**not met**", None: "not measured"}


def write(
    docs: Path, found: Findings, made: dict[str, Verdict], rows: Sequence[AteRow], drawn: dict[str, Path]
) -> Path:
    """Write what stands between the marks of paper.md, and copy the figures beside it."""
    page, images = docs / "paper.md", docs / "images"
    where = run_record.circumstances()
    parts = [
        f"{where.cpu}, {where.cores} cores, {where.finished[:10]}; "
        + "; ".join(f"{world.stands_for}: {world.title}" for world in found.worlds)
        + ".\n",
        _table([("claim", "here", "what was seen", "wanted"), *map(_line, made.items())]),
        _table(_errors(rows)),
    ]
    for name, path in drawn.items():
        copied = images / f"paper-{path.name}"
        shutil.copyfile(path, copied)
        parts.append(f"![{name}](images/{copied.name})\n")
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{BEGIN}\n\n" + "\n".join(parts) + f"\n{END}{after}", encoding="utf-8")
    return page


def _line(named: tuple[str, Verdict]) -> tuple[str, ...]:
    name, verdict = named
    return name, _STATE[verdict.met], verdict.words, verdict.wanted


def _errors(rows: Sequence[AteRow]) -> list[tuple[str, ...]]:
    names = ("min", "max", "mean", "median", "std", "rmse")
    lines: list[tuple[str, ...]] = [("run, metres", "part", *names, "drift %")]
    lines += [
        (
            row.outcome.name,
            row.part if row.until_frame is None else f"until frame {row.until_frame}",
            *(f"{getattr(row.error, name):.4f}" for name in names),
            f"{row.error.drift_percent:.2f}",
        )
        for row in rows
    ]
    return lines


def _table(lines: Sequence[Sequence[str]]) -> str:
    """Markdown, the first line its head."""
    head, *rest = lines
    marks = ["---"] * len(head)
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, marks, *rest)) + "\n"
