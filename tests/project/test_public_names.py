"""What users may import, where it is, and what importing it costs."""

from __future__ import annotations

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import jaximp

PACKAGE = Path(jaximp.__file__).parent
FACES = sorted(path.parent for path in PACKAGE.rglob("__init__.pyi"))


def listed(folder: Path) -> list[tuple[str, str]]:
    """The names of a package's `__init__.pyi`, each with the file that it comes from; none if it is a file itself."""
    nodes = ast.parse((folder / "__init__.pyi").read_text(encoding="utf-8")).body
    return [(a.name, node.module or "") for node in nodes if isinstance(node, ast.ImportFrom) for a in node.names]


def test_the_top_level_is_small() -> None:
    packages = {name for name, file in listed(PACKAGE) if not file}
    assert packages == {folder.name for folder in FACES} - {"jaximp"}
    assert set(jaximp.__all__) - packages == {
        "ArmImpedance", "Design", "Estimates", "Inference", "Job", "Limits", "Posterior", "Recording", "TrustLimits",
        "adaptive_least_squares", "compare_models", "confidence_interval", "design_excitation", "fit_stiffness",
        "identify", "identify_impedance", "identify_recording", "identify_trials", "infer", "load_posterior",
        "load_recording", "parse_job", "read_job", "recording_from_arrays", "recursive_least_squares",
        "sample_posterior", "save_posterior", "save_recording", "sliding_least_squares", "sliding_pieces", "track",
    }  # fmt: skip


@pytest.mark.parametrize("folder", FACES, ids=lambda folder: folder.name)
def test_public_names_are_where_the_stub_says(folder: Path) -> None:
    dotted = ".".join(folder.relative_to(PACKAGE.parent).parts)
    package = import_module(dotted)
    assert sorted(package.__all__) == sorted(dict(listed(folder)))
    for name, file in listed(folder):
        home = import_module(f"{dotted}.{file}" if file else f"{dotted}.{name}")
        assert getattr(package, name) is (getattr(home, name) if file else home)


@pytest.mark.parametrize("folder", FACES, ids=lambda folder: folder.name)
def test_no_public_name_is_that_of_a_file_beside_it(folder: Path) -> None:
    """Python puts a file that was imported into its package by its name, and would hide the other."""
    beside = {path.stem for path in folder.iterdir()}
    assert not beside & {name for name, file in listed(folder) if file}


def test_names_that_moved_say_where_they_are() -> None:
    for package, names in jaximp.MOVED.items():
        for name in names.split():
            with pytest.warns(DeprecationWarning, match=rf"jaximp\.{name} has moved: use jaximp\.{package}\.{name}$"):
                found = getattr(jaximp, name)
            assert found is getattr(getattr(jaximp, package), name)
            assert name not in jaximp.__all__


def test_what_never_was_is_missing() -> None:
    with pytest.raises(AttributeError, match="no_such_name"):
        jaximp.no_such_name  # noqa: B018


HEAVY = (
    "arviz", "blackjax", "bokeh", "cvxpy", "dask", "distributed", "emcee", "h5py", "jaxopt", "matplotlib", "pandas",
    "pint", "pyarrow", "scipy.fft", "scipy.interpolate", "scipy.ndimage", "scipy.optimize", "scipy.signal",
    "scipy.special", "scipy.stats", "xarray",
)  # fmt: skip
TOUCHED = "import jaximp; [getattr(jaximp, name) for name in jaximp.__all__]"


@pytest.mark.parametrize(
    ("program", "absent"),
    [
        ("import jaximp", ("jax", "numpy", *HEAVY)),
        (TOUCHED, ("rich", "typer", *HEAVY)),
        ("import jaximp.cli.main", ("jax", "numpy", *HEAVY)),
    ],
    ids=["import", "every name", "command line"],
)
def test_what_is_slow_to_import_waits_until_it_is_needed(program: str, absent: tuple[str, ...]) -> None:
    program += f"; import sys; print(*sorted({{*{absent!r}}} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout == "\n"
