"""The overview of a study: one page with all recordings, their parameter over time, and the means of groups.

One HTML file that needs no other file and no network, and can fetch nothing: its content security policy forbids it.
What is shown may come from anywhere (file names, subjects, reasons): it travels as JSON and becomes text, never markup.
"""

from __future__ import annotations

import base64
import math
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pyarrow as pa
from markupsafe import Markup

from jaximp import plots
from jaximp.reports.pages import embedded, part, policy, style_source, template, versions, without_nan
from jaximp.trust.verdicts import TRUSTED, VERDICTS
from jaximp.types import AnyArray, Numbers

OK = "ok"
"""The status of a recording that was identified; any other is one that failed."""
POINTS = 100
"""A recording's panel shows at most this many windows ..."""
ALL_POINTS = 1_200_000
"""... and all panels together at most this many, so that the page opens at once; each shows ten at the least."""
LISTED = 20
"""Failed recordings that are named above the table, which holds all of them."""
CHOICES = 200
"""A column with more different values than this is searched, not chosen from a list."""
MOST = "most windows"
"""The column that this page adds: the verdict of most windows."""


@dataclass(frozen=True, eq=False)
class Series:
    """One parameter of one recording over time."""

    time: Numbers
    """(M,) end of each window [s]."""
    values: Numbers
    """(M,) the estimates; NaN where there is none."""
    trusted: AnyArray
    """(M,) False where the estimate must not be believed."""


@dataclass(frozen=True)
class GroupMean:
    """The mean of a parameter over the recordings (or subjects) of a group, and how far it can be off."""

    group: tuple[Any, ...]
    """The value of each grouping column."""
    recordings: int
    """How many have a mean of their own, and count."""
    left_out: int
    """How many do not: failed, without a trusted window, suspected of other units, or without a subject where there
    are subjects."""
    subjects: int | None
    """How many subjects the recordings come from; None where the recordings themselves are averaged."""
    mean: float
    sd: float
    """Standard deviation between subjects (or recordings); NaN for a single one."""
    low: float
    """Lower end of the 95 % interval of the mean; NaN for a single one."""
    high: float


def write_overview(
    path: str | Path,
    recordings: pa.Table,
    series: Mapping[str, Series] | None = None,
    groups: Sequence[str] = (),
    links: Mapping[str, str] | None = None,
    parameter: str | None = None,
    title: str = "Study",
) -> None:
    """Write the overview of a study as one HTML file.

    **Arguments:**

    - `recordings`: one row per recording, in the order of the page: `recording` (its name, only once), `status` (`ok`,
      or anything else for one that failed), and where there are any `reason` (why it failed), the number of windows
      with each verdict (`trusted`, `weak excitation`, ...), `<parameter>_mean` and `<parameter>_sd` over its trusted
      windows, and anything else worth a column (file, subject, condition, `duration_s`). A column's unit is its field's
      metadata `unit`.
    - `series`: the parameter over time, by recording; `thinned` takes what a panel does not show.
    - `groups`: columns whose values (all combinations that occur) make the groups; see `group_means`.
    - `links`: the report's file by recording, relative to the page's folder.
    - `parameter`: which one `series` holds and which stands for all where one is shown; the stiffness by default.

    **Raises:** `ValueError` for a missing column, a recording that is named twice, or series and links of recordings
    that the table does not have.
    """
    names = _checked_names(recordings, groups, {"series": series or {}, "links": links or {}})
    means = [one.name for one in recordings.schema if one.name.endswith("_mean") and pa.types.is_floating(one.type)]
    parameters = [name.removesuffix("_mean") for name in means]
    if parameter is None and parameters:
        parameter = plots.main_parameter(parameters)
    if parameter is not None and parameter not in parameters:
        raise ValueError(f"there is no column '{parameter}_mean': choose a parameter among {', '.join(parameters)}")
    drawn, packed = _pack(names, series or {})
    unit = "" if parameter is None else _unit(recordings, f"{parameter}_mean")
    data = {
        "recordings": names,
        "columns": _columns(recordings, parameter),
        "links": [_address((links or {}).get(name)) for name in names],
        "parameter": None if parameter is None else {"name": parameter, "unit": plots.pretty_unit(unit)},
        "series": drawn,
    }
    script, style = part("overview.js"), part("style.css") + part("overview.css")
    page = template("overview.jinja").render(
        title=title,
        counts=Counter(recordings.column("status").to_pylist()),
        failures=_failures(recordings),
        listed=LISTED,
        data=embedded(data),
        packed=Markup(packed),
        has_series=bool(series),
        parameter=parameter,
        main_first=sorted(parameters, key=lambda name: name != parameter),
        units={name: _unit(recordings, f"{name}_mean") for name in parameters},
        groups=groups,
        means={name: _drawn(group_means(recordings, groups, name)) for name in parameters},
        by_subject="subject" in recordings.column_names and "subject" not in groups,
        script=Markup(script),
        style=Markup(style),
        policy=policy([script], "script-src", style_source(style)),
        versions=versions(),
    )
    Path(path).write_text(page, encoding="utf-8")


def group_means(recordings: pa.Table, groups: Sequence[str], parameter: str) -> list[GroupMean]:
    """Means of a parameter over groups of recordings, each with a 95 % interval: mean ± t s / sqrt(n).

    Every recording counts once, whatever its number of windows. Where the table has a column `subject` (and subjects
    are not what is compared), a subject's recordings are averaged first, and n is the number of subjects: recordings
    of one person are no independent draws from all people. s is the standard deviation between the n, so that it holds
    their true differences as well as the errors of estimation, and no standard error of a single fit is needed.

    A recording with a `suspicion`, such as of other units, stays out.

    **Arguments:** `recordings` as for `write_overview`; `groups` names of columns, none for a mean over everything.

    **Returns:** the groups in the order of their values.
    """
    units = [name for name in ("subject",) if name in recordings.column_names and name not in groups]
    columns = [recordings.column(name).to_pylist() for name in [*groups, *units, "status", f"{parameter}_mean"]]
    known = "suspicion" in recordings.column_names
    suspicions = recordings.column("suspicion").to_pylist() if known else [""] * len(recordings)
    found: dict[tuple[Any, ...], list[tuple[Any, float]]] = {}
    left_out: Counter[tuple[Any, ...]] = Counter()
    for row, cells in enumerate(zip(*columns, strict=True)):
        group, unit = cells[: len(groups)], cells[len(groups)] if units else row
        status, mean = cells[-2:]
        found.setdefault(group, [])
        if status == OK and unit is not None and mean is not None and math.isfinite(mean) and not suspicions[row]:
            found[group].append((unit, mean))
        else:
            left_out[group] += 1
    return [
        _group_mean(group, found[group], left_out[group], bool(units))
        for group in sorted(found, key=lambda values: [(value is None, str(type(value)), value) for value in values])
    ]


def _group_mean(
    group: tuple[Any, ...], means: Sequence[tuple[Any, float]], left_out: int, by_subject: bool
) -> GroupMean:
    """The mean over the units (subjects or recordings) among (unit, mean) pairs."""
    from scipy.special import stdtrit

    of_unit: dict[Any, list[float]] = {}
    for unit, mean in means:
        of_unit.setdefault(unit, []).append(mean)
    values = np.array([math.fsum(several) / len(several) for several in of_unit.values()])
    n = len(values)
    mean = float(values.mean()) if n else math.nan
    sd = float(values.std(ddof=1)) if n > 1 else math.nan
    half = float(stdtrit(n - 1, 0.975)) * sd / math.sqrt(n) if n > 1 else math.nan
    subjects = n if by_subject else None
    return GroupMean(group, len(means), left_out, subjects, mean, sd, mean - half, mean + half)


def thinned(series: Series, points: int = POINTS) -> Series:
    """At most `points` of a series, evenly spread, the first and the last among them: estimates as they are, no means.

    Neighbouring windows overlap and hardly differ; an outlier that is alone can fall out.
    """
    if len(series.time) <= points:
        return series
    kept = np.linspace(0, len(series.time) - 1, points).round().astype(int)
    return Series(series.time[kept], series.values[kept], np.asarray(series.trusted)[kept])


def _checked_names(recordings: pa.Table, groups: Iterable[str], given: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Names of all recordings, of a table that has what the page needs."""
    for name in ("recording", "status", *groups):
        if name not in recordings.column_names:
            raise ValueError(f"the table of recordings has no column '{name}': add it, or name one that is there")
    names = recordings.column("recording").to_pylist()
    if twice := [str(name) for name, count in Counter(names).items() if count > 1]:
        raise ValueError(f"the recording '{twice[0]}' stands in {names.count(twice[0])} rows: give each row its name")
    if None in names:
        raise ValueError(f"row {names.index(None)} has no recording: give each row its name")
    for what, content in given.items():
        if unknown := sorted(content.keys() - set(names)):
            raise ValueError(f"{what} has '{unknown[0]}', which is no recording of the table: name those it has")
    return [str(name) for name in names]


def _columns(recordings: pa.Table, parameter: str | None) -> list[dict[str, Any]]:
    """All columns as the page shows them: name, the parameter, status, what most windows are, reasons, the rest."""
    found = {
        field.name: _column(field.name, recordings.column(field.name), _unit(recordings, field.name))
        for field in recordings.schema
    }
    counted = [name for name in VERDICTS if name in found]
    if counted:
        rows = zip(*(recordings.column(name).to_pylist() for name in counted), strict=True)
        most = [_most(dict(zip(counted, row, strict=True))) for row in rows]
        found[MOST] = _column(MOST, pa.chunked_array([pa.array(most, pa.string())]), "")
    found["recording"]["choices"] = False
    first = ["recording", f"{parameter}_mean", f"{parameter}_sd", "status", MOST, "reason"]
    others = [name for name in found if name not in (*first, "file", "suspicion")]  # a suspicion is told as the reason
    return [found[name] for name in [*first, *others, "file"] if name in found]


def _most(counts: Mapping[str, int | None]) -> str | None:
    """The verdict of most windows; the one that is trusted less where two have as many."""
    verdict = max(counts, key=lambda name: (counts[name] or 0, name != TRUSTED))
    return verdict if counts[verdict] else None


def _column(name: str, values: pa.ChunkedArray, unit: str) -> dict[str, Any]:
    """One column: `kind` text, whole or real; None where there is no value."""
    cells = values.to_pylist()
    kind = "whole" if pa.types.is_integer(values.type) else "real" if pa.types.is_floating(values.type) else "text"
    if kind == "text":
        cells = [_text(cell) for cell in cells]
    elif kind == "real":
        cells = [float(f"{cell:.6g}") if cell is not None and math.isfinite(cell) else None for cell in cells]
    several = {cell for cell in cells if cell is not None} if kind != "real" else set()
    return {
        "name": name,
        "label": f"{name} windows" if name in VERDICTS else plots.words(name.removesuffix(f"_{unit}")),
        "unit": "" if unit == "1" else plots.pretty_unit(unit),
        "kind": kind,
        "decimals": _decimals(cells) if kind == "real" else 0,
        "choices": 2 <= len(several) <= CHOICES and name not in (*VERDICTS, "file", "reason"),
        "values": cells,
    }


def _decimals(values: Sequence[float | None]) -> int | None:
    """Decimals that show four digits of a usual value; None where only powers of ten do."""
    sizes = [abs(value) for value in values if value]
    usual = math.floor(math.log10(float(np.median(sizes)))) if sizes else 0
    return max(0, 3 - usual) if -4 <= usual < 7 else None


def _text(value: Any) -> str | None:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return None if value is None else str(value)


def _unit(recordings: pa.Table, name: str) -> str:
    about = recordings.schema.field(name).metadata or {}
    return about.get(b"unit", b"").decode("utf-8", "replace")


def _failures(recordings: pa.Table) -> list[tuple[str, str]]:
    """Recording and reason of every one that failed."""
    names, statuses = (recordings.column(name).to_pylist() for name in ("recording", "status"))
    known = "reason" in recordings.column_names
    reasons = recordings.column("reason").to_pylist() if known else [None] * len(names)
    return [
        (str(name), reason or f"{status}, no reason given")
        for name, status, reason in zip(names, statuses, reasons, strict=True)
        if status != OK
    ]


def _address(file: str | None) -> str | None:
    """A file beside the page as an address, which is relative to it whatever the file is called."""
    return None if file is None else "./" + quote(os.fsencode(file))


def _pack(names: Sequence[str], series: Mapping[str, Series]) -> tuple[dict[str, Any], str]:
    """All series as one base64 text, and what reads it: where each begins, how long it is, and when it was.

    Per point two bytes of time (a share of the recording), four of the value and one bit for its trust; each series
    fills whole groups of three bytes, so that one panel can decode its own part alone.
    """
    points = min(POINTS, max(10, ALL_POINTS // max(1, len(series))))
    parts, counts, spans, believed = [], [], [], []
    for name in names:
        if name not in series:
            counts.append(0)
            spans.append([0.0, 0.0])
            continue
        one = thinned(_checked_series(name, series[name]), points)
        begin, end = (float(one.time[0]), float(one.time[-1])) if len(one.time) else (0.0, 0.0)
        share = (one.time - begin) / ((end - begin) or 1)
        trusted = np.asarray(one.trusted, bool)
        packed = (share * 65535).round().astype("<u2").tobytes() + np.asarray(one.values, "<f4").tobytes()
        packed += np.packbits(trusted, bitorder="little").tobytes()
        parts.append(base64.b64encode(packed + bytes(-len(packed) % 3)).decode())
        counts.append(len(one.time))
        spans.append([round(begin, 4), round(end, 4)])
        believed.append(one.values[trusted & np.isfinite(one.values)])
    about = {"counts": counts, "spans": spans, "range": _common_range(believed)}
    return without_nan(about), "".join(parts)


def _checked_series(name: str, one: Series) -> Series:
    """With its times in order, and as many values and verdicts as times."""
    if not len(one.time) == len(one.values) == len(one.trusted):
        raise ValueError(
            f"the series of '{name}' has {len(one.time)} times, {len(one.values)} values and {len(one.trusted)} "
            "verdicts: give as many of each"
        )
    if not np.isfinite(one.time).all() or (np.diff(one.time) < 0).any():
        raise ValueError(f"the times of the series of '{name}' do not rise: sort its windows by their time")
    return one


def _common_range(believed: Sequence[Numbers]) -> list[float] | None:
    """What all panels can show on one scale: all trusted values but the outermost per cent."""
    values = np.concatenate(believed) if believed else np.empty(0)
    if not len(values):
        return None
    low, high = np.percentile(values, [0.5, 99.5])
    margin = 0.1 * (high - low) or 0.1 * abs(high) or 1.0
    return [float(f"{low - margin:.6g}"), float(f"{high + margin:.6g}")]


def _drawn(means: Sequence[GroupMean]) -> dict[str, Any]:
    """Groups with their places on one scale from 0 to 100, which holds all intervals."""
    ends = [end for one in means for end in (one.mean, one.low, one.high) if math.isfinite(end)]
    low, high = (min(ends), max(ends)) if ends else (0.0, 1.0)
    length = (high - low) or 1.0

    def place(value: float) -> float | None:
        return round(100 * (value - low) / length, 2) if math.isfinite(value) else None

    return {
        "low": low,
        "high": high,
        "zero": place(0.0) if low <= 0 <= high else None,
        "rows": [
            {"texts": [_text(value) or "not stated" for value in one.group], "of": one}
            | {end: place(getattr(one, end)) for end in ("mean", "low", "high")}
            for one in means
        ],
    }
