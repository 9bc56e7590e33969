"""The simulated ankles of the experiments."""

import importlib
from collections.abc import Iterator
from types import ModuleType

import pytest

from paths import ROOT


@pytest.fixture(scope="session")
def ankles() -> Iterator[ModuleType]:
    """Module experiments/ankles.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "experiments")
        yield importlib.import_module("ankles")
