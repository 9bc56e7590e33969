"""Every name of jaximp itself has an example, and it prints what stands below it.

`jaximp` and `np` are imported, float64 is on, and the folder holds `examples`. What takes long is parsed, and not run:
designs and posteriors are those of pages in docs, whose code runs as printed, and trials of an arm have tests of their
own.
"""

from __future__ import annotations

import ast
import doctest
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import griffe
import numpy as np
import pytest

import jaximp
from paths import ROOT

NAMES = sorted(name for name in jaximp.__all__ if not (ROOT / "jaximp" / name).is_dir())
TOO_LONG = {
    "ArmImpedance", "identify_impedance", "identify_trials", "Design", "design_excitation", "Inference", "infer",
    "compare_models",
}  # fmt: skip
"""Names whose examples are not run."""


@cache
def code() -> Any:
    """The library, as it is written: a union of types keeps no docstring."""
    return griffe.load("jaximp", search_paths=[ROOT])


def example(name: str) -> doctest.DocTest:
    found = code()[name].docstring
    return doctest.DocTestParser().get_doctest(found.value, {"jaximp": jaximp, "np": np}, name, None, found.lineno)


@pytest.mark.parametrize("name", NAMES)
def test_every_name_has_an_example(name: str) -> None:
    steps = example(name).examples
    assert steps
    assert any("jaximp." in step.source for step in steps)
    for step in steps:
        ast.parse(step.source)
        assert (doctest.SKIP in step.options) == (name in TOO_LONG)
        assert not (step.want and name in TOO_LONG), "what is not run says nothing"


@pytest.mark.slow
@pytest.mark.compiles
@pytest.mark.parametrize("name", [name for name in NAMES if name not in TOO_LONG])
def test_examples_print_what_they_say(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unchecked: None
) -> None:
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    said: list[str] = []
    doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(example(name), out=said.append)
    assert not said, "".join(said)
