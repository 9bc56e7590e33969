"""Float64, enforced shapes, little memory, one store of compiled programs, and where the real recordings are."""

import ctypes
import gc
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import jax
import jaxtyping
import pytest
from jaxtyping import install_import_hook

from paths import DATA

jax.config.update("jax_enable_x64", True)
install_import_hook("jaximp", "shapes.checked")
pytest.register_assert_rewrite("factories")

CHOSEN = "JAX_DISABLE_MOST_OPTIMIZATIONS" in os.environ
STORE, KEPT, PLAIN = pytest.StashKey[Path](), pytest.StashKey[int](), pytest.StashKey[bool]()
MUCH_MEMORY, MOST_MEMORY, MORE_MEMORY = 1_500_000_000, 2_300_000_000, 600_000_000
"""Of one process [bytes]: compilers leave it full of holes, which are given back from here on, and programs with it;
these again when so much has come on top of what was left."""
MANY_MAPS = 20_000
"""Pieces of memory of one process. Every compiled program takes some, and at 65 530 Linux gives no more: XLA aborts."""


def pytest_configure(config: pytest.Config) -> None:
    """What takes long to compile is compiled once: for all workers, and for all processes that tests start."""
    gc.set_threshold(20_000, 10, 10)  # tracing makes many objects, few of them garbage
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        config.stash[STORE] = Path(tempfile.mkdtemp(prefix="jaximp-tests-"))
        os.environ["JAX_COMPILATION_CACHE_DIR"] = str(config.stash[STORE])
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.1"
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"] or None)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """What most tests compile they run once: without XLA's optimisations that takes half as long.

    Tests that compute for long (`slow`) and those of equal bits (`optimised`) run what users run; slow ones that
    mostly compile (`compiles`) do not. With JAX_DISABLE_MOST_OPTIMIZATIONS=0 all do.
    """
    if CHOSEN:
        return
    marked = {marker.name for marker in item.iter_markers()}
    quick = "optimised" not in marked and ("slow" not in marked or "compiles" in marked)
    stash = item.config.stash
    if "optimised" in marked and stash.get(PLAIN, False):  # whatever ran in between
        jax.clear_caches()
        stash[PLAIN] = False
    stash[PLAIN] = stash.get(PLAIN, False) or quick
    jax.config.update("jax_disable_most_optimizations", quick)
    os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = str(int(quick))  # for processes that tests start


def pytest_unconfigure(config: pytest.Config) -> None:
    if STORE in config.stash:
        shutil.rmtree(config.stash[STORE], ignore_errors=True)


def _memory() -> int:
    """Of this process [bytes]; 0 where that cannot be told."""
    statm = Path("/proc/self/statm")
    return int(statm.read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") if statm.exists() else 0


@pytest.fixture(autouse=True)
def little_memory(request: pytest.FixtureRequest) -> Iterator[None]:
    """A worker compiles for hundreds of tests. Linux only; elsewhere nothing is given back."""
    yield
    kept = request.config.stash.get(KEPT, MOST_MEMORY - MORE_MEMORY)
    if (used := _memory()) < MUCH_MEMORY:
        return
    full = used > kept + MORE_MEMORY or Path("/proc/self/maps").read_bytes().count(b"\n") > MANY_MAPS
    if full:
        jax.clear_caches()
        gc.collect()
    with suppress(AttributeError):  # some C libraries have no such function
        ctypes.CDLL(None).malloc_trim(0)
    if full:
        request.config.stash[KEPT] = max(_memory(), MOST_MEMORY - MORE_MEMORY)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Real recordings, which are not part of this project."""
    if not DATA.is_dir():
        pytest.skip("no real recordings here: set JAXIMP_DATA to the folder that holds emps, ankle, double_pendulum")
    return DATA


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Annotations are not enforced, as for a user: the library's own error messages come out."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
