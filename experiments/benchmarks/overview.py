"""Time from opening the overview of 10 000 recordings to a table that answers, in Chromium without a window.

The study is made up: 100 subjects, two conditions, 200 recordings with no answer. Writes results/overview.json.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parents[1] / "tests"))

from browser import Browser, browser, executable  # noqa: E402
from jaximp.batch.overview import Series, write_overview  # noqa: E402
from jaximp.reports.pages import table_of  # noqa: E402

FILTERED = """(() => {
  const box = document.getElementById('text'), begin = performance.now();
  box.value = 'subject-042'; box.dispatchEvent(new Event('input'));
  document.body.offsetHeight;
  return performance.now() - begin;
})()"""
SORTED = """(() => {
  const begin = performance.now();
  document.querySelectorAll('#table thead button')[%d].click();
  document.body.offsetHeight;
  return performance.now() - begin;
})()"""


def study(n: int, windows: int = 400, seed: int = 0) -> tuple[pa.Table, dict[str, Series], dict[str, str]]:
    """Recordings, series and links of a study that never was."""
    rng = np.random.default_rng(seed)
    names = [f"subject-{k % 100:03d}/trial-{k:05d}" for k in range(n)]
    condition = np.where(np.arange(n) % 2, "pushing", "resting")
    failed = np.arange(n) % 50 == 49
    level = rng.normal(25, 5, 100)[np.arange(n) % 100] + np.where(np.arange(n) % 2, 8, 0) + rng.normal(0, 1, n)
    trusted = rng.binomial(windows, 0.9, n)
    columns: list[tuple[str, str, Any]] = [
        ("recording", "", names),
        ("file", "", [f"data/{name}.parquet" for name in names]),
        ("subject", "", [f"subject-{k % 100:03d}" for k in range(n)]),
        ("session", "", np.arange(n) % 3 + 1),
        ("condition", "", condition),
        ("duration_s", "s", np.full(n, 10.0)),
        ("status", "", np.where(failed, "failed", "ok")),
        ("reason", "", [f"no column 'torque' in trial-{k:05d}" if failed[k] else None for k in range(n)]),
        ("trusted", "1", trusted),
        ("weak excitation", "1", windows - trusted),
        ("poor fit", "1", np.zeros(n, int)),
    ]
    sizes = (("stiffness", "N m/rad", 1.0), ("damping", "N m s/rad", 0.04), ("inertia", "kg m^2", 2e-3))
    for name, unit, size in sizes:
        values = np.where(failed, np.nan, size * level)
        columns += [(f"{name}_mean", unit, values), (f"{name}_sd", unit, 0.05 * np.abs(values))]
    time_s = np.linspace(2, 10, windows)
    series = {}
    for k in np.flatnonzero(~failed):
        wave = level[k] + 2 * np.sin(time_s + k) + rng.normal(0, 0.4, windows)
        believed = (time_s < 4 + k % 5) | (time_s > 5 + k % 5)
        series[names[k]] = Series(time_s, np.where(believed, wave, wave + rng.normal(0, 6, windows)), believed)
    links = {name: f"reports/{name}.html" for name in names[:: max(1, n // 500)]}
    return table_of(columns, ""), series, links


def measure(page: Browser, path: Path, count: int) -> dict[str, float]:
    """Milliseconds of one visit."""
    page.open(path.as_uri())
    page.wait("document.documentElement.dataset.usable")
    found = {
        "usable_ms": float(page.evaluate("document.documentElement.dataset.usable")),
        "loaded_ms": page.evaluate("performance.getEntriesByType('navigation')[0].loadEventEnd"),
        "sort_names_ms": page.evaluate(SORTED % 0),
        "sort_numbers_ms": page.evaluate(SORTED % 1),
        "filter_ms": page.evaluate(FILTERED),
    }
    assert page.evaluate("document.getElementById('count').textContent") == f"{count // 100} of {count} recordings"
    page.evaluate("document.getElementById('panels').scrollIntoView()")
    page.wait("document.querySelectorAll('.panel svg').length")
    assert not page.complaints(), page.complaints()
    return found


if __name__ == "__main__":
    if executable() is None:
        print("skipped: no Chromium here")
        sys.exit(0)
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000
    table, series, links = study(count)
    with tempfile.TemporaryDirectory() as folder, browser(limit=60) as page:
        path = Path(folder) / "overview.html"
        begin = time.perf_counter()
        write_overview(path, table, series, ["condition"], links, title="A study that never was")
        written = time.perf_counter() - begin
        page.size(1280, 900)
        visits = [measure(page, path, count) for _ in range(5)]
        results = {
            "recordings": count,
            "megabytes": round(path.stat().st_size / 1e6, 1),
            "written_s": round(written, 2),
            **{name: round(sorted(one[name] for one in visits)[2], 1) for name in visits[0]},
            "slowest_usable_ms": max(one["usable_ms"] for one in visits),
            "first_usable_ms": visits[0]["usable_ms"],
            "browser": page.call("Browser.getVersion")["product"],
            "cores": os.cpu_count(),
        }
    if len(sys.argv) == 1:
        (HERE.parent / "results" / "overview.json").write_text(json.dumps(results) + "\n")
    print(results)
