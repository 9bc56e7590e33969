"""Builds the documentation as a site that needs no network: `make docs`, or `python docs/site/build.py FOLDER`.

The pages are those of `docs/`, as they stand. What the code says itself is made from it: the public names, the command
line, the tables of the studies, and the notebooks with their results. A warning is an error.
"""

from __future__ import annotations

import json
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from api_pages import api_pages, links_of_names
from notebook_pages import notebook_page

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "experiments" / "results"

NAVIGATION = {
    "Tutorials": (
        "notebooks/00_my_first_recording",
        "robot-and-human",
        "arm-trials",
        "robots",
        "live",
        "batch",
    ),
    "Notebooks": (
        "notebooks/01_design_a_trajectory",
        "notebooks/02_fit_a_data_set",
        "notebooks/03_how_sure_are_we",
        "notebooks/04_parameters_that_move",
    ),
    "How to": ("your-recording", "windows", "tracking", "posteriors", "design", "payload", "arm"),
    "Reference": ("command-line", "job-keys", "All public names <api/jaximp>", "equations", "transformations"),
    "Background": ("gallery", "results", "tables", "limits", "architecture", "contributing", "changelog"),
}
"""What stands beside every page: captions and pages, in order. A page that is missing here breaks the build."""


def relinked(text: str) -> str:
    """A page of `docs/` or one of the files beside it, as a page of the site, where all of them stand in one folder."""
    text = re.sub(r"\]\((?:\.\./|docs/)", "](", text)
    text = re.sub(r"\]\(experiments/results/(\w+)\.md\)", r"](tables.md#\1)", text)
    return re.sub(r"\]\((\w+/)?(README|CONTRIBUTING|CHANGELOG|\w+)\.(md|ipynb)\b", _target, text)


def _target(found: re.Match[str]) -> str:
    folder, name, _ = found.groups()
    name = {"README": "index", "CONTRIBUTING": "contributing", "CHANGELOG": "changelog"}.get(name, name)
    return f"]({folder or ''}{name}.md"


def navigation() -> Iterator[str]:
    """What Sphinx makes the list beside every page of."""
    for caption, pages in NAVIGATION.items():
        yield "\n".join(["\n```{toctree}", ":hidden:", f":caption: {caption}\n", *pages, "```\n"])


def command_line() -> str:
    """All commands with their options, as the program knows them."""
    import typer
    from typer.cli import get_docs_for_click

    from jaximp.cli.main import app

    command = typer.main.get_command(app)
    text: str = get_docs_for_click(obj=command, ctx=typer.Context(command, info_name="jaximp"), name="jaximp")
    text = text.replace("# `jaximp`", "# The command line", 1)
    return re.sub(r"^\* `(\w+)`: .*$", r"* [`jaximp \1`](#jaximp-\1)", text, flags=re.MULTILINE)


def tables() -> Iterator[str]:
    """The tables that the studies wrote."""
    yield "# Tables of the studies\n"
    yield "As the studies and `jaximp reproduce` wrote them; [results](results.md) says what they mean."
    for path in sorted(RESULTS.rglob("*.md")):
        name = path.stem if path.parent == RESULTS else path.parent.name
        yield f"\n## {name}\n\n{path.read_text(encoding='utf-8').strip()}\n"


def stage(folder: Path) -> None:
    """Write the sources of all pages into an empty folder."""
    (folder / "notebooks").mkdir()
    (folder / "api").mkdir()
    pages = {path.name: path for path in (ROOT / "docs").glob("*.md")}
    pages |= {"index.md": ROOT / "README.md"}
    pages |= {f"{name}.md": ROOT / f"{name.upper()}.md" for name in ("contributing", "changelog")}
    written = {name: relinked(path.read_text(encoding="utf-8")) for name, path in pages.items()}
    written["index.md"] += "".join(navigation())
    written["command-line.md"] = command_line()
    written["tables.md"] = "\n".join(tables())
    written |= api_pages(ROOT)
    for path in sorted((ROOT / "notebooks").glob("*.ipynb")):
        written[f"notebooks/{path.stem}.md"] = relinked(notebook_page(path, folder / "notebooks"))
    for name, text in written.items():
        (folder / name).write_text(text, encoding="utf-8")
    (folder / "names.json").write_text(json.dumps(links_of_names(ROOT)), encoding="utf-8")
    for name in ("LICENSE", "CITATION.cff"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(
        RESULTS, folder / "experiments" / "results", ignore=shutil.ignore_patterns("*.json", "*.md", "*.txt")
    )


def build(site: Path) -> int:
    """Build the site into a folder: it is replaced when the new one is whole. Returns the exit status of Sphinx."""
    from sphinx.cmd.build import build_main

    if site.exists() and not (site / "objects.inv").exists():
        raise SystemExit(f"{site} is there and is no site: name another folder, or remove it")
    with tempfile.TemporaryDirectory(prefix="jaximp-docs-") as name:
        work = Path(name)
        (work / "source").mkdir()
        stage(work / "source")
        here = str(Path(__file__).parent)
        options = [
            "--quiet",
            "--fail-on-warning",
            "--keep-going",
            "-b",
            "html",
            "-c",
            here,
            "-d",
            str(work / "doctrees"),
        ]
        failed = build_main([*options, str(work / "source"), str(work / "site")])
        if not failed:
            shutil.rmtree(site, ignore_errors=True)
            site.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(work / "site", site)
    return failed


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out" / "site"
    status = build(target)
    if not status:
        print(f"the site is in {target}: open {target / 'index.html'}")
    raise SystemExit(status)
