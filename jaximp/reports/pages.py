"""Pages: what all results on disk share, from the parts of a report to JSON without NaN.

A `Page` is a title and sections of parts: prose, remarks, tables, figures, notes, listings. `write_page` makes of it a
folder's `report.html`, `summary.json` and figures as PNG files. The page needs no other file and no network, and its
content security policy forbids it any. Figures are drawn by a script where there is one, and are pictures on paper and
where no script may run. All text is escaped, wherever it comes from.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import metadata, resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import jinja2
import numpy as np
from markupsafe import Markup

from jaximp.plots.wording import number, percent, pretty_unit, words

if TYPE_CHECKING:
    import pyarrow as pa

    from jaximp.plots.interactive import Live


# ---- the parts of a page ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Prose:
    """A paragraph, or a remark in small letters."""

    kind: ClassVar = "prose"
    text: str
    remark: bool = False


@dataclass(frozen=True)
class Alert:
    """What a reader must not miss: a `refusal`, a `caution` or, least of them, `notes`."""

    kind: ClassVar = "alert"
    level: str
    heading: str = ""
    lines: Sequence[str] = ()
    items: Sequence[str] = ()


@dataclass(frozen=True)
class Column:
    """Of a table: its head, and whether it holds `text`, a `number`, or the `answer`."""

    head: str
    kind: str = "number"


@dataclass(frozen=True)
class Table:
    """Rows of texts, the first of each its name."""

    kind: ClassVar = "table"
    columns: Sequence[Column]
    """Empty for a table without heads, of names and texts."""
    rows: Sequence[Sequence[str]]
    void: Sequence[int] = ()
    """Rows that are not to be believed."""
    remark: str = ""


@dataclass(frozen=True)
class Figure:
    """The place of a figure."""

    kind: ClassVar = "figure"
    name: str
    """Of the PNG file, and among the page's pictures and live figures."""
    title: str
    caption: str


@dataclass(frozen=True)
class Listing:
    """Text as it is, such as a job file."""

    kind: ClassVar = "listing"
    text: str


Part = Prose | Alert | Table | Figure | Listing


@dataclass(frozen=True)
class Section:
    """Parts below a heading."""

    heading: str
    parts: Sequence[Part]
    void: bool = False
    """Whether its numbers are grey, since they are not to be believed."""


@dataclass(frozen=True)
class Page:
    """All of a report."""

    title: str
    subtitle: str
    sections: Sequence[Section]
    pictures: Mapping[str, bytes] = field(default_factory=dict)
    """PNG files by the figures' names."""
    live: Mapping[str, Live] = field(default_factory=dict)
    """Figures for the screen by the same names; a figure may have none."""
    headline: str = ""
    """The result in words."""


def figure_sections(
    pictures: Mapping[str, bytes],
    titles: Mapping[str, str],
    captions: Mapping[str, str],
    more: Mapping[str, Sequence[Part]],
) -> list[Section]:
    """A section for each figure that there is, in the order of the captions, and what stands below some of them."""
    return [
        Section(titles[name], [Figure(name, titles[name], caption), *more.get(name, ())])
        for name, caption in captions.items()
        if name in pictures
    ]


def closing_sections(settings_heading: str, settings: Mapping[str, str], job: str) -> list[Section]:
    """What was set, and the job."""
    found = [Section(settings_heading, [Table((), list(settings.items()))])] if settings else []
    return [*found, Section("Job", [Listing(job)])] if job else found


# ---- writing ---------------------------------------------------------------------------------------------------------


def write_page(folder: Path, page: Page, summary: Mapping[str, Any]) -> None:
    """Write `report.html`, `summary.json` and every picture as `NAME.png` into an existing folder."""
    for name, image in page.pictures.items():
        (folder / f"{name}.png").write_bytes(image)
    text = json.dumps(summary, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / "summary.json").write_text(text + "\n", encoding="utf-8")
    (folder / "report.html").write_text(html(page), encoding="utf-8")


def html(page: Page) -> str:
    """One HTML file that needs no other file and no network."""
    scripts: list[str] = []
    document = ""
    if page.live:
        from jaximp.plots import interactive

        made, places = interactive.document(page.live)
        document = embedded({"document": made, "places": places})
        scripts = [interactive.script(), part("report.js")]
    style = part("style.css") + part("report.css")
    return template("report.jinja").render(
        page=page,
        pictures={name: base64.b64encode(image).decode() for name, image in page.pictures.items()},
        document=document,
        scripts=[Markup(script) for script in scripts],
        style=Markup(style),
        policy=policy(scripts, "script-src 'unsafe-eval'", "style-src 'unsafe-inline'", "img-src data:"),
        versions=versions(),
    )


def policy(scripts: Sequence[str], script_src: str, *others: str) -> str:
    """A content security policy under which these scripts run, no other, and nothing is loaded from anywhere.

    BokehJS styles its elements itself and compiles the figures' callbacks: pages with figures allow it to.
    """
    allowed = " ".join([script_src, *map(_hash, scripts)]) if scripts else "script-src 'none'"
    return "; ".join(["default-src 'none'", allowed, *others, "base-uri 'none'", "form-action 'none'"])


def style_source(style: str) -> str:
    """The one style sheet that a page without figures of BokehJS needs."""
    return f"style-src {_hash(style)}"


def _hash(text: str) -> str:
    """What a content security policy calls the one inline element with this text."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def embedded(data: Any) -> Markup:
    """JSON that cannot end the script element that holds it, whatever texts it has."""
    text = json.dumps(data, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    for character in "<>&\u2028\u2029":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(text)


def part(name: str) -> str:
    """A file among the templates."""
    return resources.files("jaximp.reports").joinpath("templates", name).read_text(encoding="utf-8")


@cache
def template(name: str) -> jinja2.Template:
    """A page; everything that it is given is escaped."""
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=jinja2.FunctionLoader(part),
    )
    environment.filters.update(number=digits, percent=percent, words=words, unit=pretty_unit)
    return environment.get_template(name)


# ---- numbers and tables ----------------------------------------------------------------------------------------------


def digits(value: float | None, count: int = 4) -> str:
    """A number for people; a dash for None."""
    return number(math.nan if value is None else value, count)


def capitalised(text: str) -> str:
    """With a capital first letter, and the others as they are."""
    return text[:1].upper() + text[1:]


def versions() -> dict[str, str]:
    """Of what made the numbers."""
    return {name: _version(name) for name in ("jaximp", "jax", "numpy")}


@cache
def _version(name: str) -> str:
    return metadata.version(name)


def table_of(columns: Sequence[tuple[str, str, Any]], job: str, **more: str) -> pa.Table:
    """A table of (name, unit, values): the unit is its field's metadata `unit`, the job's text (and `more`) is in the
    schema's."""
    import pyarrow as pa

    arrays = [values if isinstance(values, pa.Array) else pa.array(np.asarray(values)) for _, _, values in columns]
    fields = [
        pa.field(name, array.type, metadata={"unit": unit})
        for (name, unit, _), array in zip(columns, arrays, strict=True)
    ]
    about = {"jaximp_version": _version("jaximp"), "job": job, **more}
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields, metadata=about))


def write_table(path: Path, table: pa.Table) -> None:
    """As Parquet."""
    import pyarrow.parquet as pq

    pq.write_table(table, path)


def without_nan(value: Any) -> Any:
    """The same with plain numbers, and None where there is no number: JSON knows neither NaN nor infinity."""
    if isinstance(value, Mapping):
        return {key: without_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value
