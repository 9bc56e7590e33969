"""The load of a robot, or the gains of its drives by a known load: a section of the report, and a table beside it."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaximp import plots
from jaximp.identification.drive_gains import DriveGains
from jaximp.identification.payload import Payload
from jaximp.identification.quantities import Quantities
from jaximp.jobs.payload import Weighed
from jaximp.models.determined import determined, sizes_of_body
from jaximp.models.spatial import PARAMETERS
from jaximp.plots.wording import number, pretty_unit
from jaximp.reports.pages import Alert, Column, Figure, Listing, Part, Prose, Section, Table, capitalised, digits
from jaximp.types import Numbers

FIGURE, TITLE = "load_by_method", "Load by method"
CAPTION = (
    "The same load by several methods, with intervals of 95 %. Methods that differ by more than their intervals say "
    "that the robot was not the same in both recordings: compare 4, which takes friction as the same, with 2."
)
INERTIA = tuple(PARAMETERS)[4:]


# ---- the report ------------------------------------------------------------------------------------------------------


def load_sections(found: Weighed | DriveGains | None) -> list[Section]:
    """What the report says first."""
    if found is None:
        return []
    return [_of_gains(found)] if isinstance(found, DriveGains) else [_of_load(found)]


def load_pictures(found: Weighed | DriveGains | None) -> dict[str, bytes]:
    """A figure where there is something to compare."""
    if not isinstance(found, Weighed) or len(found.loads) < 2:
        return {}
    return {FIGURE: plots.png(plots.load_by_method(found.loads))}


def _of_load(found: Weighed) -> Section:
    """In words, as a table, and what is to be known of it."""
    load = found.loads[0]
    mass, centre, *_ = load.in_words()
    told = "The recordings do not determine the mass of the load." if not load.determined[0] else ""
    said = f"The load has {mass}; {centre}. In brackets are intervals of 95 %, by method {load.method}."
    parts: list[Part] = [Alert("caution", told)] if told else []
    parts.append(Prose(said))
    body = found.of_body()
    if found.body is not None and not found.body.is_estimate:
        lines = [f"{capitalised(pretty_unit(line))}." for line in body]
        parts.append(Alert("caution", "These are not the parameters of a real body.", lines))
        body = []
    parts.append(_table(found))
    parts.append(Alert("notes", items=[*load.notes, *body]))
    if len(found.loads) > 1:
        parts.append(Figure(FIGURE, TITLE, CAPTION))
    return Section("The load", parts)


class _Row(NamedTuple):
    """One quantity of a load in a table."""

    name: str
    unit: str
    value: Any
    half: Any
    """Of its interval."""
    determined: bool


def _rows(load: Payload) -> list[_Row]:
    """Mass, centre of mass, and inertia about it."""
    mass = Quantities(load.names[:1], load.units[:1], load.theta[:1], load.covariance[:1, :1], load.dof[:1])
    centre, inertia = load.centre, load.inertia_about_centre
    low = load.interval()[0]
    first = sizes_of_body(low)[1:4] / load.theta[0] if load.theta[0] > 0 else np.zeros(3)
    six = sizes_of_body(np.concatenate([low[:4], inertia.interval()[0]]))[4:]
    several = (
        (mass, ["mass"], "kg", 1.0, np.zeros(1)),
        (centre, [f"centre of mass, {axis}" for axis in "xyz"], "mm", 1e3, first),
        (inertia, [f"{name} about the centre" for name in INERTIA], "kg m²", 1.0, six),
    )
    return [
        _Row(name, unit, factor * value, factor * half, bool(known))
        for found, names, unit, factor, size in several
        for name, value, half, known in zip(
            names, found.theta, _halves(found), determined(*found.interval(), size), strict=True
        )
    ]


def _halves(found: Quantities) -> Numbers:
    low, high = found.interval()
    return np.asarray((high - low) / 2)


def _table(found: Weighed) -> Table:
    """A row for each quantity, a column for each method, and for the nearest body where the estimate is none."""
    first, *others = (_rows(load) for load in found.loads)
    body = None if found.body is None or found.body.is_estimate else found.body
    heads = [Column("Quantity", "text"), Column(f"Method {found.loads[0].method}", "answer"), Column("95 % interval")]
    heads += [Column("Unit", "text"), Column("Verdict", "text")]
    heads += [Column("Nearest real body")] if body is not None else []
    heads += [Column(f"Method {load.method}") for load in found.loads[1:]]
    of_body = [] if body is None else [body.parameters[0], *(1e3 * body.centre), *body.inertia_about_centre[_SIX]]
    rows = []
    for k, row in enumerate(first):
        verdict = "determined" if row.determined else "not determined"
        cells = [row.name, digits(row.value), _reach(row.half), row.unit, verdict]
        cells += [digits(of_body[k], 3)] if body is not None else []
        rows.append([*cells, *(f"{digits(other[k].value)} {_reach(other[k].half)}".strip() for other in others)])
    remark = (
        f"In the frame of {found.loads[0].frame}; the inertia in axes parallel to those of that frame. Determined is "
        "what has an interval of at most a quarter of its size to either side: of itself, or of what a coordinate of "
        "the centre or a product of inertia can be in a body of this mass and these moments of inertia. Nothing is "
        "known of the centre where the mass may be zero."
    )
    void = [k for k, row in enumerate(first) if not row.determined]
    return Table(heads, rows, void, remark)


_SIX = ([0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2])
"""Of a matrix, in the order of `INERTIA`."""


def _reach(half: float) -> str:
    return f"± {number(half, 2)}" if np.isfinite(half) else ""


def _of_gains(found: DriveGains) -> Section:
    """What makes torques of the currents of each joint."""
    common = np.asarray(found.gain_error["common"]).item()
    said = (
        f"By the load that is known the gains of {len(found.names)} drives are those of the table; their common scale "
        f"is known to {number(common, 2)} %."
    )
    halves = _halves(found)
    rows = [
        [f"joint {k + 1}", digits(gain), _reach(halves[k]), digits(left, 2), found.units[k]]
        for k, (gain, left) in enumerate(zip(found.theta, found.residual, strict=True))
    ]
    columns = [Column("Gain of", "text"), Column("Estimate", "answer"), Column("95 % interval")]
    columns += [Column("Left of the current"), Column("Unit", "text")]
    remark = "Where the recording holds torques by nominal gains, these are the factors by which they are off."
    for_job = Prose("For the torque of a later job, which then knows what is not known of the gains:")
    listing = Listing("\n".join(found.in_words()[-2:]))
    return Section("Gains of the drives", [Prose(said), Table(columns, rows, remark=remark), for_job, listing])


# ---- beside it -------------------------------------------------------------------------------------------------------


def write_load(folder: str | Path, found: Weighed | DriveGains) -> None:
    """Write `payload.json` (or `gains.json`) into an existing folder: each parameter with its unit, interval and
    standard error, and all in words. What is not determined is null."""
    content: dict[str, Any] = {"words": found.in_words()}
    if isinstance(found, DriveGains):
        content |= {"parameters": _as_json([found]), "gain_error_percent": found.gain_error}
    else:
        content |= _of_method(found.loads[0])
        content["further_methods"] = [_of_method(load) for load in found.loads[1:]]
        content["nearest_body"] = (
            None
            if found.body is None
            else {
                "distance": found.body.distance,
                "is_the_estimate": found.body.is_estimate,
                "parameters": dict(zip(found.loads[0].names, found.body.parameters.tolist(), strict=True)),
            }
        )
    name = "gains.json" if isinstance(found, DriveGains) else "payload.json"
    (Path(folder) / name).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _of_method(load: Payload) -> dict[str, Any]:
    return {
        "method": load.method,
        "frame": load.frame,
        "parameters": _as_json([load, load.centre, load.inertia_about_centre]),
        "determined": dict(zip(load.names, load.determined.tolist(), strict=True)),
        "recordings": load.recording_notes,
    }


def _as_json(several: Sequence[Quantities]) -> dict[str, dict[str, Any]]:
    found: dict[str, dict[str, Any]] = {}
    for one in several:
        names, *columns = one.columns()
        rows = zip(*(column.values for column in columns), strict=True)
        keys = [column.name for column in columns]
        found |= {
            name: dict(zip(keys, map(_plain, row), strict=True)) for name, row in zip(names.values, rows, strict=True)
        }
    return found


def _plain(value: Any) -> Any:
    """As JSON has it, which knows no NaN."""
    return value if isinstance(value, str) else float(value) if np.isfinite(value) else None
