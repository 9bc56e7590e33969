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


MANY_MAPS = 20_000
"""Pieces of memory of one process. Every compiled program takes some, and at 65 530 Linux gives no more: XLA aborts."""


@pytest.fixture(scope="module", autouse=True)
def few_compiled_programs() -> Iterator[None]:
    """A worker compiles for hundreds of tests: what it has compiled is dropped before there is too much of it."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()


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
