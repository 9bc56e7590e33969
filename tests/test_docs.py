"""What the documentation says is so: the pages are those that the code makes, and what they name exists."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
JOB_KEYS = runpy.run_path(str(ROOT / "docs" / "make_job_keys.py"))
TABLES = [table for job in ("RECORDING_JOB", "TRIALS_JOB", "DESIGN_JOB") for table in JOB_KEYS[job]]


def test_the_job_keys_are_those_of_the_code() -> None:
    assert JOB_KEYS["PAGE"].read_text(encoding="utf-8") == JOB_KEYS["page"](), "run `make job-keys`"


@pytest.mark.parametrize("table", TABLES, ids=[table.title for table in TABLES])
def test_every_job_key_is_explained(table) -> None:  # type: ignore[no-untyped-def]
    meaning = JOB_KEYS["texts"](table.settings)
    assert not [key.name for key in JOB_KEYS["keys"](table) if key.name not in meaning]
