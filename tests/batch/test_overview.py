"""The overview of a study: right means, nothing but text from the data, and a page that works in a real browser."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from scipy import stats

from browser import Browser, browser, executable
from jaximp.batch import overview
from jaximp.batch.overview import Series, group_means, thinned, write_overview
from jaximp.reports.pages import table_of

NASTY = "<script>window.ran = 1</script>"
REASON = "it says </script><img src=x onerror='window.ran = 2'> and <!-- and \u2028 & more"
N = 300


def study() -> pa.Table:
    """300 recordings of 12 subjects in two conditions; the last ones failed, one has no trusted window."""
    rng = np.random.default_rng(1)
    subjects = [f"s{k % 12}" for k in range(N)]
    subjects[0] = NASTY
    failed = np.arange(N) >= N - 5
    stiffness = np.where(failed, np.nan, 20 + rng.normal(0, 3, N))
    stiffness[7] = np.nan
    trusted = np.where(failed | (np.arange(N) == 7), 0, 40)
    return table_of(
        [
            ("recording", "", [f"trial {k}" for k in range(N)]),
            ("subject", "", subjects),
            ("condition", "", [("push", "rest")[k // 12 % 2] for k in range(N)]),
            ("status", "", np.where(failed, "failed", "ok")),
            ("reason", "", [REASON if bad else None for bad in failed]),
            ("trusted", "1", trusted),
            ("weak excitation", "1", 50 - trusted),
            ("stiffness_mean", "N m/rad", stiffness),
            ("stiffness_sd", "N m/rad", 0.1 * stiffness),
            ("damping_mean", "N m s/rad", stiffness / 1e3),
            ("duration_s", "s", np.full(N, 10.0)),
            ("file", "", [f"trial_{k}.csv" for k in range(N)]),
        ],
        "",
    )


def ramps() -> dict[str, Series]:
    """Every recording rises from its number, and is trusted in the middle."""
    time = np.linspace(2, 10, 250)
    return {f"trial {k}": Series(time, k + np.linspace(0, 1, len(time)), abs(time - 6) < 2) for k in range(N - 5)}


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("study") / "overview.html"
    links = {"trial 1": "reports/trial 1#.html", "trial 2": "javascript:window.ran = 3"}
    write_overview(file, study(), ramps(), ["condition"], links, title=f"Study of {NASTY}")
    return file


@pytest.fixture(scope="module")
def text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def data_of(text: str) -> Any:
    """What the page's script reads, by an independent reader of HTML and JSON."""
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', text, re.S)
    assert found
    return json.loads(found[1])


def column(text: str, name: str) -> dict[str, Any]:
    return next(one for one in data_of(text)["columns"] if one["name"] == name)


# ---- means of groups -------------------------------------------------------------------------------------------------


def test_group_means_are_students_over_recordings() -> None:
    table = study().drop_columns(["subject"])
    frame = {name: np.array(table.column(name).to_pylist(), dtype=object) for name in table.column_names}
    found = group_means(table, ["condition"], "stiffness")
    assert [one.group for one in found] == [("push",), ("rest",)]
    for one in found:
        values = frame["stiffness_mean"][(frame["condition"] == one.group[0]) & (frame["status"] == "ok")].astype(float)
        values = values[np.isfinite(values)]
        low, high = stats.t.interval(0.95, len(values) - 1, values.mean(), stats.sem(values))
        np.testing.assert_allclose(
            [one.mean, one.low, one.high, one.sd], [values.mean(), low, high, values.std(ddof=1)]
        )
        assert one.recordings == len(values)
        assert one.subjects is None
    assert sum(one.recordings + one.left_out for one in found) == N
    assert sum(one.left_out for one in found) == 6


def test_subjects_count_once_however_many_recordings_they_have() -> None:
    of_subject = {"a": [1.0] * 50, "b": [4.0, 6.0], "c": [9.0]}
    table = pa.table(
        {
            "recording": [str(k) for k in range(53)],
            "status": ["ok"] * 53,
            "subject": [name for name, values in of_subject.items() for _ in values],
            "stiffness_mean": [value for values in of_subject.values() for value in values],
        }
    )
    (found,) = group_means(table, [], "stiffness")
    low, high = stats.t.interval(0.95, 2, 5, stats.sem([1, 5, 9]))
    np.testing.assert_allclose([found.mean, found.low, found.high], [5, low, high])
    assert (found.subjects, found.recordings) == (3, 53)
    by_subject = group_means(table, ["subject"], "stiffness")  # subjects are compared: recordings count
    assert [(one.group, one.mean, one.recordings) for one in by_subject] == [
        (("a",), 1, 50),
        (("b",), 5, 2),
        (("c",), 9, 1),
    ]


def test_one_recording_has_a_mean_and_no_interval() -> None:
    table = pa.table({"recording": ["a", "b"], "status": ["ok", "failed"], "stiffness_mean": [3.0, None]})
    (found,) = group_means(table, [], "stiffness")
    assert (found.mean, found.left_out) == (3, 1)
    assert np.isnan([found.sd, found.low, found.high]).all()


def test_groups_come_in_order_and_without_a_value_last() -> None:
    table = pa.table(
        {"recording": list("abcd"), "status": ["ok"] * 4, "age": [10, None, 9, 10], "stiffness_mean": [1.0, 2, 3, 4]}
    )
    assert [one.group for one in group_means(table, ["age"], "stiffness")] == [(9,), (10,), (None,)]


def test_the_intervals_hold_what_they_promise() -> None:
    """Subjects differ, and have several recordings each: intervals over recordings hold the mean far too rarely."""
    rng = np.random.default_rng(0)
    held = {"subject": 0, "person": 0}
    for _ in range(300):
        values = rng.normal(0, 1, 8)[np.arange(40) % 8] + rng.normal(0, 0.2, 40)
        for name in held:  # the same column under another name is no subject
            table = pa.table({"status": ["ok"] * 40, name: np.arange(40) % 8, "stiffness_mean": values})
            (found,) = group_means(table, [], "stiffness")
            held[name] += found.low < 0 < found.high
    assert 0.92 < held["subject"] / 300 < 0.98
    assert held["person"] / 300 < 0.8


# ---- what is written -------------------------------------------------------------------------------------------------


def test_page_needs_nothing_else(text: str) -> None:
    assert not re.search(r"https?:|<link|@import|url\(|\bsrc=(?!x onerror)", text.replace(REASON, ""))


def test_policy_allows_only_what_is_in_the_page(text: str) -> None:
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]*)"', text)
    assert policy
    rules = policy[1].replace("&#39;", "'")
    assert rules.startswith("default-src 'none';")
    assert "unsafe" not in rules
    for tag in ("script", "style"):
        (inline,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.S)
        digest = base64.b64encode(hashlib.sha256(inline.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in rules


def test_data_cannot_leave_their_element(text: str) -> None:
    assert NASTY not in text
    assert "</script><img" not in text
    assert "\u2028" not in text.split('id="data"')[1]
    assert column(text, "subject")["values"][0] == NASTY
    assert column(text, "reason")["values"][-1] == REASON


def test_columns_know_their_units_and_have_no_nan(text: str) -> None:
    stiffness = column(text, "stiffness_mean")
    assert (stiffness["unit"], stiffness["kind"], stiffness["decimals"]) == ("N m/rad", "real", 2)
    assert stiffness["values"][7] is None
    assert column(text, "duration_s")["label"] == "duration"
    assert column(text, "damping_mean")["decimals"] == 5
    assert column(text, "most windows")["values"][6:8] == ["trusted", "weak excitation"]
    assert column(text, "subject")["choices"]
    assert not column(text, "file")["choices"]


def test_links_lead_to_files_whatever_they_are_called(text: str) -> None:
    links = data_of(text)["links"]
    assert links[:3] == [None, "./reports/trial%201%23.html", "./javascript%3Awindow.ran%20%3D%203"]


def test_series_are_as_they_were(text: str) -> None:
    """Decoded in another language than the page's."""
    about = data_of(text)["series"]
    found = re.search(r'id="series">(.*?)</script>', text, re.S)
    assert found
    raw = base64.b64decode(found[1], validate=True)
    n, (begin, end) = about["counts"][0], about["spans"][0]
    size = -(-(6 * n + -(-n // 8)) // 3) * 3
    one = raw[3 * size : 4 * size]
    expected = thinned(ramps()["trial 3"])
    times = begin + (end - begin) * np.frombuffer(one, "<u2", n) / 65535
    np.testing.assert_allclose(times, expected.time, atol=1e-3)
    np.testing.assert_array_equal(np.frombuffer(one, "<f4", n, 2 * n), expected.values.astype(np.float32))
    trusted = np.unpackbits(np.frombuffer(one, np.uint8, -1, 6 * n), bitorder="little")[:n]
    np.testing.assert_array_equal(trusted, expected.trusted)
    assert about["counts"][-5:] == [0] * 5
    assert len(raw) == size * (N - 5)


def test_thinned_series_keep_both_ends_and_no_value_is_made_up() -> None:
    one = Series(np.arange(1000.0), np.arange(1000.0) ** 2, np.arange(1000) % 3 == 0)
    few = thinned(one, 10)
    assert few.time[[0, -1]].tolist() == [0, 999]
    assert len(few.time) == 10
    np.testing.assert_array_equal(few.values, few.time**2)
    np.testing.assert_array_equal(few.trusted, few.time % 3 == 0)
    assert thinned(few, 10) is few


def test_ten_thousand_recordings_stay_below_15_megabytes(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n, time = 1000, np.linspace(0, 10, 800)
    names = [f"subject-{k % 12:02d}/session-{k % 5}/trial-{k:05d}.parquet" for k in range(n)]
    counts = {name: rng.integers(0, 800, n) for name in overview.VERDICTS}
    numbers = {
        f"{name}_{end}": rng.normal(size=n) for name in ("inertia", "damping", "stiffness") for end in ("mean", "sd")
    }
    table = pa.table({"recording": names, "file": names, "status": ["ok"] * n, **counts, **numbers})
    series = {name: Series(time, rng.normal(size=800), rng.random(800) < 0.5) for name in names}
    write_overview(tmp_path / "page.html", table, series)
    assert (tmp_path / "page.html").stat().st_size < 1_500_000


def test_more_recordings_have_fewer_points_each(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(overview, "ALL_POINTS", 20 * (N - 5))
    write_overview(tmp_path / "page.html", study(), ramps())
    assert data_of((tmp_path / "page.html").read_text(encoding="utf-8"))["series"]["counts"][0] == 20


def test_odd_studies_have_a_page(tmp_path: Path) -> None:
    empty = study().slice(0, 0)
    write_overview(tmp_path / "empty.html", empty, {}, ["condition"])
    write_overview(tmp_path / "failed.html", study().slice(N - 5), {}, ["condition"])
    bare = pa.table({"recording": ["a"], "status": ["ok"]})
    write_overview(tmp_path / "bare.html", bare, {"a": Series(np.empty(0), np.empty(0), np.empty(0, bool))})
    assert "5 of 5 recordings could not be identified" in (tmp_path / "failed.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"groups": ["sex"]}, "no column 'sex'"),
        ({"recordings": pa.table({"recording": ["a"]})}, "no column 'status'"),
        ({"recordings": pa.table({"recording": ["a", "a"], "status": ["ok", "ok"]})}, "'a' stands in 2 rows"),
        ({"recordings": pa.table({"recording": ["a", None], "status": ["ok", "ok"]})}, "row 1 has no recording"),
        ({"links": {"trial -1": "a.html"}}, "links has 'trial -1'"),
        ({"parameter": "mass"}, "'mass_mean': choose a parameter among stiffness, damping"),
        (
            {"series": {"trial 1": Series(np.zeros(2), np.zeros(2), np.ones(3, bool))}},
            "2 times, 2 values and 3 verdicts",
        ),
        ({"series": {"trial 1": Series(np.array([1.0, 0]), np.zeros(2), np.ones(2, bool))}}, "times .* do not rise"),
    ],
)
def test_bad_input_is_refused_in_a_line(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        write_overview(tmp_path / "page.html", **({"recordings": study()} | change))
    assert not (tmp_path / "page.html").exists()


# ---- in a browser ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def running() -> Iterator[Browser]:
    if executable() is None:
        pytest.skip("no Chromium here: install it (apt-get install chromium), or set CHROMIUM to its path")
    with browser() as one:
        yield one


@pytest.fixture
def page(running: Browser, path: Path) -> Iterator[Browser]:
    """The page, just opened; afterwards it must have kept quiet, run nothing of the data and asked for nothing."""
    running.size(1200, 800)
    visit(running, path)
    yield running
    assert running.complaints() == []
    assert running.evaluate("window.ran") is None
    assert {address.split("#")[0] for address in running.requests()} == {path.as_uri()}


def visit(page: Browser, path: Path, fragment: str = "") -> None:
    page.open(path.as_uri() + fragment)
    page.wait("document.documentElement.dataset.usable")


def rows(page: Browser) -> list[str]:
    """Names of the recordings whose rows are in the page."""
    return texts(page, "#table tbody th")


def texts(page: Browser, selector: str) -> list[str]:
    found: list[str] = page.evaluate(f"[...document.querySelectorAll('{selector}')].map(one => one.textContent)")
    return found


def ordered(key: str, descending: bool = False) -> list[str]:
    """Names in the order of a column, by Python; those without a value at the end."""
    table = study()
    pairs = list(zip(table.column(key).to_pylist(), table.column("recording").to_pylist(), strict=True))
    having = [pair for pair in pairs if pair[0] is not None and pair[0] == pair[0]]
    values = sorted(having, key=lambda pair: -pair[0] if descending else pair[0])
    return [name for _, name in values] + [name for value, name in pairs if value is None or value != value]


def test_table_shows_rows_and_makes_only_those_in_view(page: Browser) -> None:
    shown = rows(page)
    assert shown == [f"trial {k}" for k in range(len(shown))]
    assert 10 < len(shown) < 60
    assert page.evaluate("document.querySelector('#table table').getAttribute('aria-rowcount')") == str(N + 1)
    page.evaluate("void (document.getElementById('table').scrollTop = 1e9)")
    page.frame()
    assert rows(page)[-1] == f"trial {N - 1}"
    assert len(rows(page)) < 60


def test_nasty_texts_are_texts(page: Browser) -> None:
    assert page.evaluate("document.querySelector('h1').textContent") == f"Study of {NASTY}"
    cells = texts(page, "#table tbody tr:nth-child(2) td")
    assert NASTY in cells
    choices = texts(page, "#filters option")
    assert NASTY in choices
    page.evaluate("document.getElementById('show-failures').click()")
    page.frame()
    reasons = texts(page, "#table tbody td")
    assert reasons.count(REASON) == 5
    assert page.evaluate("document.querySelectorAll('img').length") == 0


def test_a_click_sorts_and_another_turns_it_round(page: Browser) -> None:
    click = "document.querySelectorAll('#table thead button')[1].click()"
    for descending in (False, True):
        page.evaluate(click)
        shown = rows(page)
        assert shown == ordered("stiffness_mean", descending)[: len(shown)]
        said = page.evaluate("document.querySelectorAll('#table thead th')[1].getAttribute('aria-sort')")
        assert said == ("descending" if descending else "ascending")
    page.evaluate("void (document.getElementById('table').scrollTop = 1e9)")
    page.frame()
    assert set(rows(page)[-6:]) == {"trial 7", *(f"trial {k}" for k in range(N - 5, N))}  # without a value: last


def test_names_sort_as_people_count(page: Browser) -> None:
    page.evaluate("document.querySelectorAll('#table thead button')[0].click()")
    assert rows(page)[:12] == [f"trial {k}" for k in range(12)]


def test_search_and_lists_filter(page: Browser) -> None:
    page.evaluate(
        "(() => { const box = document.getElementById('text'); box.value = 'PUSH s3 ok';"
        "box.dispatchEvent(new Event('input')); })()"
    )
    expected = [k for k in range(N - 5) if k // 12 % 2 == 0 and k % 12 == 3]
    assert page.evaluate("document.getElementById('count').textContent") == f"{len(expected)} of {N} recordings"
    assert rows(page) == [f"trial {k}" for k in expected]
    page.evaluate("document.querySelector('#filters [type=reset]').click()")
    assert page.evaluate("document.getElementById('count').textContent") == f"{N} recordings"
    page.evaluate(
        "(() => { const lists = [...document.querySelectorAll('#filters select')];"
        "const list = lists.find(one => one.parentElement.firstChild.textContent === 'most windows');"
        "list.value = 'weak excitation'; list.dispatchEvent(new Event('change')); })()"
    )
    assert rows(page) == ["trial 7", *(f"trial {k}" for k in range(N - 5, N))]


def test_an_address_holds_the_view(page: Browser, path: Path) -> None:
    visit(page, path, "#sort=-stiffness_mean&only.condition=rest&text=s5")
    wanted = {f"trial {k}" for k in range(N) if k // 12 % 2 == 1 and k % 12 == 5}
    assert rows(page) == [name for name in ordered("stiffness_mean", descending=True) if name in wanted]
    assert page.evaluate("document.getElementById('text').value") == "s5"
    page.evaluate("document.querySelectorAll('#table thead button')[0].click()")
    assert page.evaluate("location.hash") == "#sort=recording&text=s5&only.condition=rest"
    visit(page, path, "#sort=nothing&only.file=x&only.__proto__=x")  # what it does not know, it leaves
    assert page.evaluate("document.getElementById('count').textContent") == f"{N} recordings"


def test_keys_are_enough(page: Browser) -> None:
    page.evaluate("document.querySelectorAll('#table thead button')[1].focus()")
    page.press("Enter", 13)
    assert rows(page)[0] == ordered("stiffness_mean")[0]
    page.evaluate("document.getElementById('table').focus()")
    page.press("End", 35)
    page.wait(f"document.querySelector('#table tbody').textContent.includes('trial {N - 1}')")


def test_panels_are_drawn_when_somebody_comes_near(page: Browser) -> None:
    page.size(1200, 400)
    visit(page, Path(page.evaluate("decodeURI(location.pathname)")))
    assert page.evaluate("document.querySelectorAll('.panel').length") == 0
    page.evaluate("document.getElementById('panels').scrollIntoView()")
    page.wait("document.querySelectorAll('.panel svg').length")
    drawn = page.evaluate("document.querySelectorAll('.panel').length")
    assert 8 <= drawn < 100
    about = page.evaluate(
        "['trusted', 'doubted'].map(kind => document.querySelector(`.panel .${kind}`).getAttribute('d'))"
    )
    segments = [re.findall(r"M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)", path) for path in about]
    kept = thinned(ramps()["trial 0"])
    both = int((np.asarray(kept.trusted)[1:] & np.asarray(kept.trusted)[:-1]).sum())
    assert [len(several) for several in segments] == [both, len(kept.time) - 1 - both]
    assert float(segments[1][-1][2]) == 224.0  # the last window ends where the panel does


def test_each_panel_can_have_its_own_scale(page: Browser) -> None:
    page.evaluate("document.getElementById('panels').scrollIntoView()")
    page.wait("document.querySelectorAll('.panel svg').length")
    lowest = ".panel text:first-of-type"
    first, second = texts(page, lowest)[:2]
    assert first == second
    page.evaluate("document.querySelector('[value=own]').click()")
    page.frame()
    first, second = texts(page, lowest)[:2]
    assert (float(first), float(second)) == (0.4, 1.4)
    heights = page.evaluate("document.querySelector('.panel .trusted').getAttribute('d')")
    rising = [float(y) for y in re.findall(r"L[\d.]+ ([\d.]+)", heights)]
    assert rising == sorted(rising, reverse=True)  # up is less in a drawing
    # A tenth of the trusted values' range is left at either end of the 91 high panel, which stands on 98.
    ends = [98 - 91 * 1.1 / 1.2, 98 - 91 * 0.1 / 1.2]
    np.testing.assert_allclose([rising[-1], rising[0]], ends, atol=2)


def test_panels_follow_the_table_and_say_what_failed(page: Browser) -> None:
    page.evaluate("document.getElementById('panels').scrollIntoView()")
    page.wait("document.querySelectorAll('.panel svg').length")
    page.evaluate("document.getElementById('show-failures').click()")
    page.frame()
    panels = texts(page, ".panel")
    assert panels == [f"trial {k}failed: {REASON}" for k in range(N - 5, N)]


def test_narrow_pages_do_not_overflow(page: Browser) -> None:
    page.size(390, 800)
    page.evaluate("document.getElementById('panels').scrollIntoView()")
    page.wait("document.querySelectorAll('.panel svg').length")
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert page.evaluate("document.querySelector('.strip').childElementCount") == 1


def test_the_policy_stops_scripts_and_requests(running: Browser, path: Path) -> None:
    """Were a text ever to become markup, the browser would still refuse to run or fetch anything for it."""
    visit(running, path)
    running.evaluate(
        "(() => { window.stopped = [];"
        "addEventListener('securitypolicyviolation', (event) => stopped.push(event.effectiveDirective));"
        "const add = (name, about) => document.body.append(Object.assign(document.createElement(name), about));"
        "add('script', { textContent: 'window.ran = 4' });"
        "add('img', { src: 'http://127.0.0.1:9/' });"
        "fetch('http://127.0.0.1:9/').catch(() => 0); })()"
    )
    running.wait("stopped.length >= 3")
    assert set(running.evaluate("stopped")) == {"script-src-elem", "img-src", "connect-src"}
    assert running.evaluate("window.ran") is None


def test_without_groups_series_or_links_the_page_works_too(running: Browser, tmp_path: Path) -> None:
    write_overview(tmp_path / "bare.html", pa.table({"recording": ["a", "b"], "status": ["ok", "ok"]}))
    write_overview(tmp_path / "empty.html", study().slice(0, 0), {}, ["condition"])
    for name, expected in (("bare", ["a", "b"]), ("empty", [])):
        visit(running, tmp_path / f"{name}.html")
        assert rows(running) == expected
        assert running.complaints() == []
