"""A notebook with its results as a page of the site: text as it is, code and output in blocks, figures as files."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nbformat

FENCE = "`" * 5


def notebook_page(path: Path, folder: Path) -> str:
    """The page, in Markdown; figures and the notebook itself are written into a folder beside it."""
    shutil.copy(path, folder)
    notebook = nbformat.read(path, as_version=4)
    title, rest = notebook.cells[0].source.split("\n", 1)
    parts = [title, f"{{download}}`The notebook <{path.name}>`, as it was run.", rest]
    for number, cell in enumerate(notebook.cells[1:], 1):
        parts += _cell(cell, folder, f"{path.stem}_{number}")
    return "\n\n".join(parts) + "\n"


def _cell(cell: Any, folder: Path, name: str) -> Iterator[str]:
    if cell.cell_type == "markdown":
        yield cell.source
    elif cell.cell_type == "code":
        yield _block("python", cell.source)
        printed = "".join(output.text for output in cell.outputs if output.output_type == "stream")
        if printed.strip():
            yield _block("text", printed.rstrip())
        for number, output in enumerate(cell.outputs):
            if output.output_type != "stream":
                yield _shown(output.data, folder, f"{name}_{number}.png")


def _shown(data: Any, folder: Path, file: str) -> str:
    if "image/png" in data:
        (folder / file).write_bytes(base64.b64decode(data["image/png"]))
        return f"![figure]({file})"
    return str(data["text/markdown"]) if "text/markdown" in data else _block("text", data["text/plain"])


def _block(language: str, text: str) -> str:
    return f"{FENCE}{language}\n{text}\n{FENCE}"
