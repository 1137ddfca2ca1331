# SPDX-License-Identifier: MIT
"""Hooks of mkdocs while it builds the site: pages that are generated, and links that leave `docs/`.

`mkdocs.yml` names this file as its hooks. Nothing that is generated here is kept in the repository.
"""

import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import griffe
import typer
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from tsfusion import cli
from tsfusion.core.config import SENSORS, Config, SensorModel, to_toml

ROOT = Path(__file__).resolve().parents[1]
# Documents beside the package, and where the site has them.
BESIDE = {
    "README.md": "index.md",
    "ARCHITECTURE.md": "reference/architecture.md",
    "CONTRIBUTING.md": "reference/contributing.md",
    "CHANGELOG.md": "reference/changelog.md",
    "contrib/README.md": "reference/contrib.md",
}
MORE = "Guides"  # heading of the navigation for pages that it does not list
_LINK = re.compile(r"(?<!!)\[([^\]]+)\]\(([^)#\s]+)(#[^)\s]*)?\)")
_SETTING = re.compile(r"(?:# )?(\w+) = ?(.*?) *(?:# (.*))?")
_DRAWING = re.compile(r'<p><img alt="[^"]*" src="([^"]*assets/[\w-]+\.svg)" ?/?></p>')


class Rooms(griffe.Extension):
    """Folders of a wing, which have no `__init__`: griffe passes over such a folder, and over all in it."""

    def on_module_members(self, *, mod: griffe.Module, **_: Any) -> None:
        """Add a wing's rooms before its other files are read, those within rooms too."""
        here = mod.filepath
        if mod.parent and isinstance(here, Path) and here.name == "__init__.py":
            for folder in sorted({path.parent for path in here.parent.rglob("*.py")} - {here.parent}):
                room = griffe.Module(folder.name, filepath=folder / here.name)
                mod.set_member(folder.relative_to(here.parent).parts, room)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """List pages of `docs/` that the navigation forgot, so that none is out of reach."""
    docs = Path(config.docs_dir)
    listed = set(_pages(config.nav))
    left = [path.relative_to(docs).as_posix() for path in sorted(docs.rglob("*.md"))]
    for section in config.nav or []:
        if MORE in section:
            section[MORE] += [name for name in left if name not in listed]
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages, and the documents that lie beside `docs/`."""
    pages = {"reference/cli.md": commands_page(), "reference/settings.md": settings_page()}
    for source, place in BESIDE.items():
        if source != "README.md":
            pages[place] = (ROOT / source).read_text(encoding="utf-8")
    for place, text in pages.items():
        files.append(File.generated(config, place, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point links at the site's own pages; a file that the site does not have keeps its name alone."""
    here = page.file.src_uri
    source = next((name for name, place in BESIDE.items() if place == here and here != "index.md"), None)
    folder = posixpath.dirname(source if source is not None else f"docs/{here}")

    def moved(link: re.Match[str]) -> str:
        words, target, anchor = link[1], link[2], link[3] or ""
        if "://" in target:
            return link[0]
        named = posixpath.normpath(posixpath.join(folder, target))
        place = BESIDE.get(named, named.removeprefix("docs/") if named.startswith("docs/") else None)
        if place is None:
            return words if words.startswith("`") else f"`{named}`"
        if files.get_file_from_path(place) is None:
            return link[0]  # mkdocs says that it leads nowhere
        return f"[{words}]({posixpath.relpath(place, posixpath.dirname(here) or '.')}{anchor})"

    return _LINK.sub(moved, markdown)


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Put drawings into the page itself: there they take its colours, light or dark."""

    def drawn(image: re.Match[str]) -> str:
        path = posixpath.join(posixpath.dirname(page.file.dest_uri), image[1])
        svg = (Path(config.docs_dir) / posixpath.normpath(path)).read_text(encoding="utf-8")
        return f'<div class="drawing">{re.sub(r":root {[^}]*}", "", svg)}</div>'

    return _DRAWING.sub(drawn, html)


def _pages(nav: Any) -> Iterator[str]:
    """Every file that a navigation lists."""
    if isinstance(nav, str):
        yield nav
    elif nav is not None:
        for below in nav.values() if isinstance(nav, dict) else nav:
            yield from _pages(below)


def commands_page() -> str:
    """Every verb with all its flags, from the command itself."""
    root: Any = typer.main.get_command(cli.app)
    parts = [
        "# The command line\n",
        "Made from the command itself. `tsfusion VERB --help` shows the usual flags on one screen, "
        "`--help-all` every one; here the rare ones are marked *rare*. Each flag is an environment variable, "
        "too: `TSFUSION_VOXEL_SIZE` for `--voxel-size`. What ends well has status 0, what fails 1, a wrong "
        "flag 2, Ctrl-C 130, SIGTERM 143; errors are one line on stderr.\n",
    ]
    for words, command in _commands(root):
        if words:
            parts.append(_command(words, command))
    return "\n".join(parts)


def _commands(command: Any, *words: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        yield from _commands(below, *words, name)


def _command(words: tuple[str, ...], command: Any) -> str:
    name = " ".join(("tsfusion", *words))
    context = command.make_context(words[-1], [], resilient_parsing=True)
    flags = [param for param in command.get_params(context) if param.param_type_name == "option"]
    arguments = [param for param in command.get_params(context) if param.param_type_name == "argument"]
    usage = " ".join([name, *(_metavar(param) for param in arguments)])
    lines = [f"{'#' * (len(words) + 1)} {name}\n", _text(command.help or ""), f"\n```text\n{usage}\n```\n"]
    rows = [(f"`{_metavar(param)}`", "", getattr(param, "help", "") or "") for param in arguments]
    rows += [(_flag(param), _default(param), _meaning(param)) for param in flags if _is_shown(param)]
    if rows:
        lines += ["| flag | default | meaning |", "|---|---|---|"]
        lines += [f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows]
    shown = [line.removeprefix("$ ") for line in (command.epilog or "").splitlines()[1:]]
    if shown:
        lines += ["\n```sh", *shown, "```\n"]
    return "\n".join(lines)


def _is_shown(param: Any) -> bool:
    return bool(param.help) and not ({"--help", "--help-all"} & set(param.opts))


def _metavar(param: Any) -> str:
    return str(param.metavar or param.name.upper())


def _flag(param: Any) -> str:
    metavar = "" if param.is_flag or not param.metavar else f" {param.metavar}"
    return "`" + ", ".join([*param.opts, *param.secondary_opts]) + f"{metavar}`"


def _default(param: Any) -> str:
    value = param.default
    if value is None or callable(value) or value is False or value == () or value is Ellipsis:
        return ""
    return f"`{getattr(value, 'value', value)}`"


def _meaning(param: Any) -> str:
    return _text(param.help) + (" *Rare.*" if param.hidden else "")


def _text(words: str) -> str:
    return words.replace("\b", "").replace("<", "&lt;").strip()


def settings_page() -> str:
    """Every setting with its default, bounds and meaning, as `tsfusion config dump` writes them."""
    parts = [
        "# Settings\n",
        "Made from the code. A flag overrides its environment variable, which overrides the TOML file of "
        "`--config`. `tsfusion config dump` writes such a file with every default; in it, what is empty here "
        "is commented out: the sensor's preset decides, or there is no limit.\n",
    ]
    for line in to_toml(Config()).splitlines():
        if line.startswith("["):
            heading = f"\n## {line}\n"
            parts += [heading, parts.pop(), "\n| setting | default | meaning |\n|---|---|---|"]
        elif setting := _SETTING.fullmatch(line):
            name, value, meaning = (group or "" for group in setting.groups())
            cells = (f"`{name}`", f"`{value}`" if value else "", _text(meaning).replace("|", "\\|"))
            parts.append(f"| {' | '.join(cells)} |")
        elif line.startswith("# "):
            parts.append(line[2:])
    parts += ["\n## Sensors\n", 'What `sensor = "NAME"` stands for; a setting of `[volume]` overrides it.\n']
    parts += ["| | " + " | ".join(f"`{name}`" for name in SENSORS) + " |", "|---" * (len(SENSORS) + 1) + "|"]
    for name in SensorModel.__struct_fields__:
        values = (f"{getattr(sensor, name)}" for sensor in SENSORS.values())
        parts.append(f"| `{name}` | " + " | ".join(values) + " |")
    return "\n".join(parts) + "\n"
