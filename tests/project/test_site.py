# SPDX-License-Identifier: MIT
"""The site builds without a warning, fetches nothing from elsewhere, and its reference is complete."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace

import msgspec
import pytest
import typer
from headless_browser import browser
from repository import ROOT

import tsfusion
from tsfusion import cli
from tsfusion.core.config import Config

pytestmark = pytest.mark.skipif(
    find_spec("material") is None or find_spec("mkdocstrings_handlers") is None,
    reason="the site's generator is not installed: pip install '.[docs]'",
)
_LOADS = {"link": "href", "script": "src", "img": "src", "iframe": "src", "source": "src"}


class Loaded(HTMLParser):
    """Addresses that a page makes a browser load, and the ids in it."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.ids: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.ids.add(given.get("id") or "")
        if tag in _LOADS and given.get("rel") not in ("canonical", "next", "prev"):
            self.addresses.append(given.get(_LOADS[tag]) or "")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", folder], cwd=ROOT, text=True,
        capture_output=True, check=False, timeout=240,
    )  # fmt: skip
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert not re.search(r"^(WARNING|ERROR)", said, re.MULTILINE), said
    return folder


def test_a_page_loads_nothing_from_elsewhere(site: Path) -> None:
    pages = [page for page in site.rglob("*.html") if page.name != "404.html"]
    assert len(pages) > 40
    for page in pages:
        for address in Loaded(page).addresses:
            assert "//" not in address, f"{page.name}: {address}"
            assert (page.parent / address.partition("#")[0].partition("?")[0]).exists(), (
                f"{page.name}: {address}"
            )


def test_the_reference_has_every_verb_and_every_name(site: Path) -> None:
    verbs = (site / "reference" / "cli.html").read_text(encoding="utf-8")
    root = typer.main.get_command(cli.app)
    for name, command in root.commands.items():  # type: ignore[attr-defined]
        below = [f"{name} {word}" for word in getattr(command, "commands", {})]
        for words in (name, *below):
            assert f'id="tsfusion-{words.replace(" ", "-")}"' in verbs, words
    ids = Loaded(site / "reference" / "python.html").ids
    found = {one.rsplit(".", 1)[-1] for one in ids}
    assert not set(tsfusion.__all__) - {"__version__"} - found


def test_the_settings_have_a_table_for_each_part(site: Path) -> None:
    page = (site / "reference" / "settings.html").read_text(encoding="utf-8")
    parts = re.split(r'<h2 id="(\w+)">', page)[1:]
    found = dict(zip(parts[::2], parts[1::2], strict=True))
    for name in ("volume", "server", "client", "scan"):
        fields = {field.name for field in msgspec.structs.fields(getattr(Config(), name))}
        assert set(re.findall(r"<tr>\s*<td><code>(\w+)</code>", found[name])) == fields, name
        assert "<td>##" not in page


def test_each_drawing_takes_the_colours_of_the_page(site: Path) -> None:
    page = (site / "concepts.html").read_text(encoding="utf-8")
    assert page.count('<div class="drawing"><svg') == 2
    assert "prefers-color-scheme: dark) { }" in page or ":root {" not in page


def test_search_finds_a_page_in_a_folder_without_a_server(site: Path) -> None:
    with browser() as chromium:
        for opened in ("index.html", "reference/wire.html"):
            chromium.open(site / opened)
            chromium.wait(
                "(() => { const field = document.querySelector('[data-md-component=search-query]');"
                "field.focus(); field.value = 'quarantine'; field.dispatchEvent(new Event('keyup'));"
                "return document.querySelector('.md-search-result__item a') !== null; })()"
            )
            found = chromium.evaluate(
                "[...document.querySelectorAll('.md-search-result__item a')].map((link) => link.href)"
            )
            assert any(link.partition("?")[0] == (site / "glossary.html").as_uri() for link in found), found
            assert not chromium.errors
            assert all(address.startswith(("file:", "data:", "about:")) for address in chromium.requests)


@pytest.mark.slow
@pytest.mark.parametrize("pages", ["[ic]*.html", pytest.param("**/*.html", marks=pytest.mark.nightly)])
def test_each_page_fits_a_phone_and_shows_its_pictures(site: Path, pages: str) -> None:
    with browser() as chromium:
        for page in sorted(site.glob(pages)):
            if page.name == "404.html":  # its addresses are those of a server
                continue
            chromium.open(page, width=390, height=844)
            place = page.relative_to(site)
            assert chromium.evaluate("document.documentElement.scrollWidth") <= 390, f"{place}: too wide"
            lazy = "[...document.images].filter((image) => !image.complete || !image.naturalWidth)"
            assert chromium.evaluate(f"{lazy}.map((image) => image.src)") == [], f"{place}: no such picture"


def hooks() -> ModuleType:
    """Module that `mkdocs.yml` names as its hooks."""
    spec = spec_from_file_location("site_hooks", ROOT / "scripts" / "_site.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_page_that_the_navigation_forgot_is_listed(tmp_path: Path) -> None:
    for name in ("listed.md", "forgotten.md"):
        (tmp_path / name).write_text("# A page\n")
    config = SimpleNamespace(docs_dir=str(tmp_path), nav=[{"Start": ["listed.md"]}, {"Guides": []}])
    assert hooks().on_config(config).nav[1] == {"Guides": ["forgotten.md"]}


def test_links_to_files_that_the_site_has_not_keep_their_names() -> None:
    made = hooks()
    here = SimpleNamespace(file=SimpleNamespace(src_uri="tutorials/own-slam.md"))
    files = SimpleNamespace(get_file_from_path=lambda path: path)
    for written, expected in {
        "[the tree](../../ARCHITECTURE.md#files)": "[the tree](../reference/architecture.md#files)",
        "[maps](../maps.md)": "[maps](../maps.md)",
        "[alerts](../../tests/project/alerts.yml)": "`tests/project/alerts.yml`",
        "[MCAP](https://mcap.dev)": "[MCAP](https://mcap.dev)",
        "![picture](../images/soak.png)": "![picture](../images/soak.png)",
    }.items():
        assert made.on_page_markdown(written, here, None, files) == expected
