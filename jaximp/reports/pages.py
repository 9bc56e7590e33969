"""What all results on disk share: templates of pages, tables with units, JSON without NaN."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import pyarrow as pa

from jaximp import plots


def versions() -> dict[str, str]:
    """Of what made the numbers."""
    return {name: _version(name) for name in ("jaximp", "jax", "numpy")}


@cache
def _version(name: str) -> str:
    return metadata.version(name)


def table_of(columns: Sequence[tuple[str, str, Any]], job: str) -> pa.Table:
    """A table of (name, unit, values): the unit is its field's metadata `unit`, the job's text is in the schema's."""
    arrays = [values if isinstance(values, pa.Array) else pa.array(np.asarray(values)) for _, _, values in columns]
    fields = [
        pa.field(name, array.type, metadata={"unit": unit})
        for (name, unit, _), array in zip(columns, arrays, strict=True)
    ]
    about = {"jaximp_version": _version("jaximp"), "job": job}
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=about))


def write_figures(folder: Path, figures: Mapping[str, bytes]) -> None:
    """One PNG file each."""
    for name, image in figures.items():
        (folder / f"{name}.png").write_bytes(image)


def write_summary(folder: Path, content: Mapping[str, Any]) -> None:
    """Write `summary.json`."""
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")


def inline(images: Mapping[str, bytes], captions: Mapping[str, str]) -> list[tuple[str, str, str]]:
    """Name, base64 and caption of each figure that there is, in the order of the captions."""
    return [
        (name, base64.b64encode(images[name]).decode(), caption) for name, caption in captions.items() if name in images
    ]


def without_nan(value: Any) -> Any:
    """The same with plain numbers, and None where there is no number: JSON knows neither NaN nor infinity."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def percent(share: float | None) -> str:
    return "–" if share is None else f"{plots.number(100 * share, 3)}\N{NO-BREAK SPACE}%"


@cache
def template(name: str) -> jinja2.Template:
    """A page; everything that it is given is escaped."""
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(
            lambda part: resources.files("jaximp.reports").joinpath("templates", part).read_text(encoding="utf-8")
        ),
    )
    environment.filters.update(
        number=lambda value, digits=4: plots.number(math.nan if value is None else value, digits),
        percent=percent,
        words=plots.words,
        unit=plots.pretty_unit,
    )
    return environment.get_template(name)
