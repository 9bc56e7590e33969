"""The simulated ankles and arms of the experiments."""

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


@pytest.fixture(scope="session")
def arms() -> Iterator[ModuleType]:
    """Module experiments/arms.py."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT / "experiments")
        yield importlib.import_module("arms")
