"""Every notebook runs from top to bottom in a fresh kernel of this interpreter, and is kept with its results."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import nbformat
import pytest
from jupyter_client.kernelspec import KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError

from paths import DATA, ROOT

NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
LARGEST = 600_000
"""Of a notebook with its figures [bytes]."""
COLOURS = re.compile(r"\x1b\[[0-9;]*m")
# A notebook that looks for real recordings runs without them as well.
RUNS = [pytest.param(path, DATA, id=path.stem) for path in NOTEBOOKS] + [
    pytest.param(path, DATA / "nowhere", id=f"{path.stem}, without recordings")
    for path in NOTEBOOKS
    if DATA.is_dir() and "JAXIMP_DATA" in path.read_text(encoding="utf-8")
]
every_notebook = pytest.mark.parametrize("path", NOTEBOOKS, ids=[path.stem for path in NOTEBOOKS])


def outputs(notebook: Any, kind: str) -> list[Any]:
    """All outputs of one kind: `stream`, `error`, `display_data`, `execute_result`."""
    cells = (cell for cell in notebook.cells if cell.cell_type == "code")
    return [output for cell in cells for output in cell.outputs if output.output_type == kind]


def warned(notebook: Any) -> list[str]:
    return [output.text for output in outputs(notebook, "stream") if output.name == "stderr"]


def test_there_are_notebooks() -> None:
    assert NOTEBOOKS


@pytest.mark.slow
@pytest.mark.parametrize(("path", "data"), RUNS)
def test_it_runs(path: Path, data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAXIMP_DATA", str(data))
    for name in ("JUPYTER_CONFIG_DIR", "JUPYTER_DATA_DIR", "JUPYTER_RUNTIME_DIR", "IPYTHONDIR", "MPLCONFIGDIR"):
        monkeypatch.setenv(name, str(tmp_path / name))
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    # Without folders to look in, the one kernel known is that of the running interpreter.
    specs = KernelSpecManager(kernel_dirs=[])
    kernel = AsyncKernelManager(kernel_name="python3", kernel_spec_manager=specs)
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, km=kernel, timeout=600, resources={"metadata": {"path": str(tmp_path)}})
    failure = ""
    try:
        client.execute(cleanup_kc=True)  # ends the kernel, too
    except CellExecutionError as error:
        failure = COLOURS.sub("", str(error))
    if failure:
        pytest.fail(failure, pytrace=False)
    assert not warned(notebook)
    # The last cell checks what the text says.
    assert "assert" in notebook.cells[-1].source
    assert "all of it holds" in notebook.cells[-1].outputs[0].text


@every_notebook
def test_it_is_kept_with_its_results(path: Path) -> None:
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1)), "run `make notebooks`"
    assert not outputs(notebook, "error")
    assert not warned(notebook)
    assert path.stat().st_size < LARGEST
    text = path.read_text(encoding="utf-8")
    assert not [word for word in ("/home/", "/tmp/", "/Users/", "site-packages") if word in text]


def private(notebook: Any) -> Iterator[str]:
    """What a notebook takes from jaximp that is no public name."""
    source = "\n".join(cell.source for cell in notebook.cells if cell.cell_type == "code")
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "jaximp":
            public = getattr(import_module(str(node.module)), "__all__", ())
            yield from (f"{node.module}.{name.name}" for name in node.names if name.name not in public)
        elif isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name.startswith("jaximp."))
        elif isinstance(node, ast.Attribute) and (found := re.match(r"jaximp\.(\w+)\.(\w+)$", ast.unparse(node))):
            public = getattr(import_module("jaximp"), found[1])
            yield from [found[0]] * (found[2] not in getattr(public, "__all__", dir(public)))
        elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "jaximp":
            yield from [ast.unparse(node)] * (node.attr not in import_module("jaximp").__all__)


@every_notebook
def test_it_uses_public_names_alone(path: Path) -> None:
    assert not list(private(nbformat.read(path, as_version=4)))
