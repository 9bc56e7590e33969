"""The documentation builds without a warning, needs no other host, and knows every public name and every command."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from importlib import import_module
from pathlib import Path
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

import pytest
import typer

import jaximp
from jaximp.cli.main import app
from paths import ROOT

PACKAGES = ["jaximp", *(f"jaximp.{path.parent.name}" for path in sorted((ROOT / "jaximp").glob("*/__init__.pyi")))]
COMMANDS = typer.main.get_command(app).commands  # type: ignore[attr-defined]
FETCHED = {"script": "src", "img": "src", "link": "href", "iframe": "src", "source": "src"}
"""Elements by which a browser fetches something as it shows a page, and where from."""

pytestmark = pytest.mark.slow


class Page(NamedTuple):
    """What the pages of a site say of each other."""

    fetched: list[str]
    links: list[str]
    anchors: set[str]


class Reader(HTMLParser):
    """Collects what a page fetches, where it leads, and the places in it."""

    def __init__(self) -> None:
        super().__init__()
        self.page = Page([], [], set())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if "id" in given:
            self.page.anchors.add(given["id"])
        if tag == "a" and "href" in given:
            self.page.links.append(given["href"])
        if given.get(FETCHED.get(tag, "")):
            self.page.fetched.append(given[FETCHED[tag]])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("docs") / "site"
    program = [sys.executable, str(ROOT / "docs" / "site" / "build.py"), str(folder)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    found = {}
    for path in site.rglob("*.html"):
        reader = Reader()
        reader.feed(path.read_text(encoding="utf-8"))
        found[path.resolve()] = reader.page
    return found


def elsewhere(target: str) -> bool:
    return bool(urlsplit(target).netloc or urlsplit(target).scheme not in ("", "data"))


def broken(pages: dict[Path, Page]) -> Iterator[str]:
    """Links and files that lead nowhere within the site."""
    for path, page in pages.items():
        for target in filter(lambda target: not elsewhere(target), page.links + page.fetched):
            file, anchor = urlsplit(target).path, unquote(urlsplit(target).fragment)
            other = (path.parent / unquote(file)).resolve() if file else path
            if not target.startswith("data:") and not other.exists():
                yield f"{path.name}: {target}"
            if anchor and other in pages and anchor not in pages[other].anchors:
                yield f"{path.name}: {target} has no such place"


def test_nothing_comes_from_another_host(site: Path, pages: dict[Path, Page]) -> None:
    assert not [target for page in pages.values() for target in page.fetched if elsewhere(target)]
    styles = "".join(path.read_text(encoding="utf-8") for path in site.rglob("*.css"))
    assert "url(http" not in styles.replace('"', "").replace("'", "")
    assert "@import" not in styles


def test_every_link_leads_somewhere(pages: dict[Path, Page]) -> None:
    assert not list(broken(pages))


def test_every_public_name_has_an_entry(pages: dict[Path, Page]) -> None:
    anchors = set().union(*(page.anchors for page in pages.values()))
    top = {id(getattr(jaximp, name)): f"jaximp.{name}" for name in jaximp.__all__}
    for package in PACKAGES:
        for name in import_module(package).__all__:
            full = f"{package}.{name}"
            known = {full, top.get(id(getattr(import_module(package), name))), f"module-{full}"}
            assert known & anchors, full


def test_every_command_has_its_section(pages: dict[Path, Page]) -> None:
    (page,) = (page for path, page in pages.items() if path.name == "command-line.html")
    assert {f"jaximp-{name}" for name in COMMANDS} <= page.anchors


def test_every_page_of_docs_is_there(site: Path, pages: dict[Path, Page]) -> None:
    names = {path.stem for path in (ROOT / "docs").glob("*.md")}
    names |= {f"notebooks/{path.stem}" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert {(site / f"{name}.html").resolve() for name in names} <= set(pages)


def test_the_search_knows_the_pages(site: Path) -> None:
    index = (site / "searchindex.js").read_text(encoding="utf-8")
    assert '"stiff"' in index or "stiff:" in index
    assert '"your-recording"' in index


def test_what_is_no_site_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years")
    program = [sys.executable, str(ROOT / "docs" / "site" / "build.py"), str(tmp_path)]
    done = subprocess.run(program, capture_output=True, text=True, check=False)
    assert done.returncode
    assert "is no site" in done.stderr
    assert (tmp_path / "thesis.tex").exists()
