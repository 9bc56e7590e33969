"""Float64, enforced shapes, and where the real recordings are."""

import os
from collections.abc import Iterator
from pathlib import Path

import jax
import jaxtyping
import pytest
from jaxtyping import install_import_hook

jax.config.update("jax_enable_x64", True)
install_import_hook("jaximp", "shapes.checked")


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Real recordings, which are not part of this project."""
    folder = Path(os.environ.get("JAXIMP_DATA") or Path(__file__).parents[1] / "../shared/data")
    if not folder.is_dir():
        pytest.skip("no real recordings here: set JAXIMP_DATA to the folder that holds emps, ankle, double_pendulum")
    return folder


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Annotations are not enforced, as for a user: the library's own error messages come out."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
