"""What the documentation says is so: the pages are those that the code makes, and what they name exists."""

from __future__ import annotations

import ast
import importlib
import re
import runpy

import pytest

from paths import ROOT

JOB_KEYS = runpy.run_path(str(ROOT / "docs" / "make_job_keys.py"))
EQUATIONS = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
TABLES = [table for job in ("RECORDING_JOB", "TRIALS_JOB", "DESIGN_JOB") for table in JOB_KEYS[job]]


def test_the_job_keys_are_those_of_the_code() -> None:
    assert JOB_KEYS["PAGE"].read_text(encoding="utf-8") == JOB_KEYS["page"](), "run `make job-keys`"


@pytest.mark.parametrize("table", TABLES, ids=[table.title for table in TABLES])
def test_every_job_key_is_explained(table) -> None:  # type: ignore[no-untyped-def]
    meaning = JOB_KEYS["texts"](table.settings)
    assert not [key.name for key in JOB_KEYS["keys"](table) if key.name not in meaning]


ROWS = re.findall(r"^\| .* \| `([\w.]+)` \| `(\w+\.py)::(\w+)` \|$", EQUATIONS, re.MULTILINE)


def test_every_row_of_equations_is_checked() -> None:
    tables = [
        line for line in EQUATIONS.splitlines() if line.startswith("| ") and not line.startswith(("| ---", "| eq"))
    ]
    assert len(ROWS) == len([line for line in tables if not line.startswith("| source")]) > 60


@pytest.mark.parametrize("function", sorted({row[0] for row in ROWS}))
def test_functions_of_the_equations_exist(function: str) -> None:
    module, _, name = function.rpartition(".")
    assert (getattr(importlib.import_module(f"jaximp.{module}"), name).__doc__ or "").strip()


@pytest.mark.parametrize("file", sorted({row[1] for row in ROWS}))
def test_tests_of_the_equations_exist(file: str) -> None:
    (path,) = (ROOT / "tests").rglob(file)
    tree = ast.parse(path.read_text(encoding="utf-8"))
    defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    assert {row[2] for row in ROWS if row[1] == file} <= defined
