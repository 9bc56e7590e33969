"""Imports point down only, and what must stay in one place stays there."""

from __future__ import annotations

import ast
import os
import re
import subprocess
import sys
from collections.abc import Iterator

import pytest

from paths import ROOT

PACKAGE = ROOT / "jaximp"
TESTS = ROOT / "tests"

PACKAGES = (
    "types", "results", "numerics", "signals", "recordings", "motion", "models", "least_squares", "tracking",
    "consistency", "trust", "identification", "perturbation", "posterior", "design", "simulation", "jobs", "live",
    "plots", "reports", "batch", "papers", "cli",
)  # fmt: skip
"""From the ground up: a package imports from those before it, and from itself."""

HEIGHT = {name: height for height, name in enumerate(PACKAGES)}

MODULES = {
    ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__"): path
    for path in sorted(PACKAGE.rglob("*.py"))
}
del MODULES["__init__"]  # the public names: imports from everywhere, and is imported from nowhere
every_module = pytest.mark.parametrize("module", MODULES)


def tree(module: str) -> ast.Module:
    return ast.parse(MODULES[module].read_text(encoding="utf-8"))


def imports(module: str) -> Iterator[str]:
    """Every name that a module imports, with dots, at its top or inside a function: `numpy`, `jaximp.types`, ..."""
    here = ["jaximp", *module.split(".")]
    inside = here if MODULES[module].name == "__init__.py" else here[:-1]
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            start = ".".join(inside[: len(inside) - node.level + 1]) + "." if node.level else ""
            source = (start + (node.module or "")).strip(".")
            yield from (f"{source}.{name.name}" for name in node.names)


def own(module: str) -> Iterator[str]:
    """The packages that a module imports from; jaximp itself is an empty string (its version may be had by all)."""
    for name in imports(module):
        parts = name.split(".")
        if parts[0] == "jaximp" and name != "jaximp.__version__":
            yield parts[1] if len(parts) > 1 and parts[1] in HEIGHT else ""


def called(module: str) -> Iterator[str]:
    """What a module calls, as written: `print`, `jax.config.update`, ..."""
    for node in ast.walk(tree(module)):
        if isinstance(node, ast.Call):
            yield ast.unparse(node.func)


def test_the_map_is_that_of_the_packages() -> None:
    """Every package stands in the table, in the order in which they import."""
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE)
    assert tuple(named) == PACKAGES


@every_module
def test_imports_point_one_way(module: str) -> None:
    package = module.split(".")[0]
    assert package in HEIGHT, f"'{package}' is new: give it a place in this test"
    for other in own(module):
        assert other, f"{module} imports from jaximp itself: import from the file that holds the name"
        assert HEIGHT[other] <= HEIGHT[package], f"{module} imports from {other}, which stands above it"


@every_module
def test_names_are_imported_from_the_file_that_holds_them(module: str) -> None:
    """Never through the public face of a package, which is for users: so no import can go round in a circle."""
    for name in imports(module):
        source, _, last = name.removeprefix("jaximp.").rpartition(".")
        if name.startswith("jaximp.") and name.removeprefix("jaximp.") not in {*MODULES, "__version__"}:
            assert MODULES[source].name != "__init__.py", f"import {last} from its file, not from jaximp.{source}"


@every_module
def test_only_plots_imports_matplotlib_and_bokeh(module: str) -> None:
    if module.split(".")[0] != "plots":
        assert not [name for name in imports(module) if name.split(".")[0] in ("matplotlib", "bokeh")]


@every_module
def test_only_the_command_line_changes_the_configuration_of_jax(module: str) -> None:
    if module != "cli.main":
        assert not [call for call in called(module) if call.endswith("config.update")]
        assert "jax.config" not in imports(module)
        changed = [
            ast.unparse(target)
            for node in ast.walk(tree(module))
            if isinstance(node, ast.Assign)
            for target in node.targets
        ]
        assert not [target for target in changed if "config.jax" in target]


@every_module
def test_only_the_command_line_prints(module: str) -> None:
    if module.split(".")[0] != "cli":
        assert not [call for call in called(module) if call.split(".")[-1] in ("print", "pprint")]
        assert not [call for call in called(module) if call in ("sys.stdout.write", "sys.stderr.write")]


def test_importing_the_library_leaves_jax_as_it_is() -> None:
    below = [f"jaximp.{name}" for name in MODULES if name.split(".")[0] not in ("cli", "papers")]
    program = (
        "import importlib, jax\n"
        f"for name in ['jaximp', *{below}]:\n"
        "    importlib.import_module(name)\n"
        "assert not jax.config.jax_enable_x64, 'x64 was switched on'"
    )
    environment = {key: value for key, value in os.environ.items() if key != "JAX_ENABLE_X64"}
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr


def test_nothing_is_pickled() -> None:
    """Files from elsewhere are data: whoever unpickles one runs it."""
    for path in sorted(PACKAGE.rglob("*.py")):
        nodes = [
            node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)
        ]
        imported = {alias.name for node in nodes for alias in node.names}
        assert not imported & {"pickle", "cloudpickle", "dill", "joblib", "shelve", "marshal"}, path.name
        assert "allow_pickle=True" not in path.read_text(), path.name


def test_the_tests_stand_in_the_folders_of_the_packages() -> None:
    """But for those of the project as a whole, and what tests share: `factories` and the modules beside it."""
    folders = {path.parent.name for path in TESTS.glob("*/*.py")}
    assert folders - {"project", "factories"} <= {*PACKAGES}


def test_no_test_file_imports_from_another() -> None:
    """Also not in a program that it starts."""
    files = sorted(TESTS.rglob("test_*.py"))
    assert len({path.name for path in files}) == len(files), "two test files share a name"
    for path in TESTS.rglob("*.py"):
        found = re.findall(r"^\s*(?:from|import)\s+([\w.]*\btest_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
        assert not found, f"{path.name} imports from {found[0]}: move what both need into tests/factories"
