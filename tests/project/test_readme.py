"""Every command and every block of code of the README runs as printed, and so do those of the pages in docs.

A block whose first line says `fragment` (```` ```python fragment ````) is a part of something: it is only parsed.
"""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import typer

from jaximp.cli.main import app
from jaximp.jobs.design import parse_design_job
from jaximp.jobs.job import parse_job
from paths import ROOT

README = ROOT / "README.md"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
EXAMPLES = sorted((ROOT / "examples").glob("*.toml"))


class Block(NamedTuple):
    """A block of code of a page."""

    page: Path
    language: str
    fragment: bool
    text: str

    @property
    def name(self) -> str:
        """What a test of it is called."""
        return f"{self.page.stem}: {self.text.splitlines()[0]}"


def blocks(page: Path, language: str) -> list[Block]:
    """All blocks of a page in one language, in order."""
    found = re.findall(r"^```(\w*)( fragment)?\n(.*?)^```$", page.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    return [Block(page, one, bool(fragment), text) for one, fragment, text in found if one == language]


def commands(page: Path) -> list[str]:
    """All lines of the shell, without their comments."""
    lines = "".join(block.text for block in blocks(page, "bash")).splitlines()
    return [command for line in lines if (command := re.sub(r"(^|\s)#.*", "", line).strip())]


def jaximp_commands(page: Path) -> list[str]:
    return [command for command in commands(page) if command.startswith(".venv/bin/jaximp ")]


def marked(values: list[Any]) -> list[Any]:
    """Parameters of a test: what draws from posteriors or designs is slow, the search of a window length, and robots
    that are simulated."""
    words = ("posterior", "design", "jaximp check", "payload", "robots.md")
    slow = [any(word in str(value) for word in words) for value in values]
    return [pytest.param(x, marks=pytest.mark.slow if late else ()) for x, late in zip(values, slow, strict=True)]


TOML = [block for page in PAGES for block in blocks(page, "toml")]
WITH_PYTHON = [page for page in PAGES if any(not block.fragment for block in blocks(page, "python"))]


@pytest.fixture
def workshop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder like a fresh clone: the examples, and an environment in which jaximp is installed."""
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_first_example_comes_early() -> None:
    text = README.read_text(encoding="utf-8")
    assert text[: text.index("```python")].count("\n") < 25
    assert text.count("\n") < 200


def test_the_first_example_finds_what_it_says() -> None:
    names: dict[str, object] = {}
    exec(blocks(README, "python")[0].text, names)
    stiffness = np.asarray(names["fit"].theta)[:, 2]  # type: ignore[attr-defined]
    np.testing.assert_allclose(stiffness[:9], 20, rtol=0.03)
    np.testing.assert_allclose(stiffness[-9:], 30, rtol=0.03)


@pytest.mark.parametrize("page", marked(WITH_PYTHON), ids=lambda page: page.stem)
def test_python_runs_as_printed(page: Path, workshop: Path, unchecked: None) -> None:
    names: dict[str, object] = {}
    for block in blocks(page, "python"):
        if not block.fragment:
            exec(compile(block.text, page.name, "exec"), names)


@pytest.mark.parametrize("command", marked(jaximp_commands(README)))
def test_commands_of_the_readme_run_as_printed(command: str, workshop: Path) -> None:
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert not done.stderr


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_all_commands_exist(page: Path) -> None:
    """Commands and options are known, extras are in pyproject.toml, targets in the Makefile."""
    known: Any = typer.main.get_command(app)
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    for command in commands(page):
        program, *arguments = command.split()
        if program == ".venv/bin/jaximp":
            assert arguments[0] in known.commands, command
            known.commands[arguments[0]].make_context(arguments[0], arguments[1:])
        elif program == "make":
            done = subprocess.run(["make", "-n", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
        else:
            assert command == "pip install .", f"{command}: teach this test how to check it"
    for names in re.findall(r"pip install '\.\[(.*?)\]'|'\.\[(.*?)\]'", page.read_text(encoding="utf-8")):
        assert set("".join(names).split(",")) <= set(extras), names


@pytest.mark.parametrize("block", TOML, ids=lambda block: block.name)
def test_jobs_are_valid(block: Block) -> None:
    tables = tomllib.loads(block.text)
    if not block.fragment:
        (parse_design_job if "design" in tables or "limits" in tables else parse_job)(block.text)


def test_the_printed_jobs_are_those_of_the_examples() -> None:
    shipped = "\n".join(path.read_text(encoding="utf-8") for path in EXAMPLES)
    printed = [*blocks(README, "toml"), *blocks(ROOT / "docs" / "design.md", "toml")]
    assert len(printed) == len(EXAMPLES)
    assert not [block.name for block in printed if block.text not in shipped]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_fragments_are_python(page: Path) -> None:
    for block in blocks(page, "python"):
        ast.parse(block.text)


@pytest.mark.parametrize("page", [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"], ids=lambda page: page.stem)
def test_links_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\((?!https?://)([^)]+)\)", page.read_text(encoding="utf-8")):
        name, _, anchor = target.partition("#")
        file = (page.parent / name) if name else page
        assert file.exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.+)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            known = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]
            assert anchor in known, target
