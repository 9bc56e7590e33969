"""The page builder and its live figures: escaped, small, silent on the network, and at work in a real browser."""

from __future__ import annotations

import base64
import hashlib
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from browser import Browser, browser, executable
from factories.estimates import JOB, identified, recording, repeat
from jaximp import plots
from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import parse_job
from jaximp.models import ArmGeometry, endpoint_impedance
from jaximp.plots import interactive, interactive_arm, interactive_windows
from jaximp.plots.interactive_windows import Torque, Windows, over_time
from jaximp.reports import estimates as report
from jaximp.reports.pages import Alert, Column, Figure, Listing, Page, Prose, Section, Table, html
from jaximp.trust.verdicts import POOR, TRUSTED

HOSTILE = (
    "<script>window.ran = 1</script>",
    "</script><img src=x onerror='window.ran = 2'>",
    "\"' onmouseover='window.ran = 3' \\",
    "<!-- \u202e & \u2028 $$\\sqrt{x}$$ @reason{safe} {{ 7 * 7 }}",
)
PIXEL = base64.b64decode("iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAQAAAC1HAwCAAAAC0lEQVR42mNkYAAAAAYAAjCB0C8AAAAASUVORK5CYII=")


def windows(names: tuple[str, ...] = ("stiffness",), reason: str = "as the test says", n: int = 20) -> Windows:
    """A ramp in windows of two seconds, of which the last five are poor."""
    start = np.arange(n) * 1.0
    value = np.linspace(1, 2, n)[:, None] * np.arange(1, len(names) + 1)
    bad = np.arange(n) >= n - 5
    return Windows(
        names, ["N m/rad"] * len(names), start, start + 2, value, value - 0.1, value + 0.1,
        np.where(bad, POOR, TRUSTED), [reason if one else "" for one in bad],
    )  # fmt: skip


def torque(n: int = 20, name: str = "torque (N m)") -> Torque:
    time = np.linspace(0, n + 1, 2000)
    measured = np.sin(time)[:, None]
    return Torque(time, [name], measured, {"fitted": measured + 0.01, "held out": measured - 0.05})


def page_of(figures: dict[str, interactive.Live], title: str = "A page") -> Page:
    sections = [Section(name, [Figure(name, name, "A caption.")]) for name in figures]
    return Page(title, "Of a test", sections, dict.fromkeys(figures, PIXEL), figures)


def hostile_page() -> Page:
    """Hostile texts wherever a text can stand."""
    live = over_time(windows(HOSTILE, HOSTILE[1]), torque(name=HOSTILE[3]))
    live["parameters"] = replace(live["parameters"], key=[interactive.Key("line", "#000000", HOSTILE[0])])
    table = Table([Column(HOSTILE[0], "text"), Column(HOSTILE[1])], [HOSTILE[:2], HOSTILE[2:]], remark=HOSTILE[1])
    parts = [Prose(HOSTILE[0]), Alert("caution", HOSTILE[1], HOSTILE, HOSTILE), table, Listing(HOSTILE[1])]
    figures = [Figure(name, HOSTILE[2], HOSTILE[1]) for name in live]
    sections = [Section(HOSTILE[1], parts), Section(HOSTILE[0], figures)]
    return Page(HOSTILE[0], HOSTILE[1], sections, dict.fromkeys(live, PIXEL), live)


def without_scripts(page: str) -> str:
    return re.sub(r"<script>.*?</script>", "", page, flags=re.S)


# ---- what is written -------------------------------------------------------------------------------------------------


def test_a_page_has_its_sections_in_order() -> None:
    rows = [["stiffness", "60", "N m/rad"], ["damping", "1", "N m s/rad"]]
    table = Table([Column("Parameter", "text"), Column("Mean", "answer"), Column("Unit", "text")], rows, void=[1])
    page = html(
        Page(
            "Title",
            "Subtitle",
            [
                Section("", [Alert("refusal", "Stop.", ["One reason."])]),
                Section("Numbers", [table, Prose("So it is.")], void=True),
                Section("Nothing", []),
                Section("Figure", [Figure("one", "One figure", "Its caption.")]),
                Section("Job", [Listing("[window]")]),
            ],
            {"one": PIXEL},
        )
    )
    order = ["<h1>Title", "Subtitle", "Stop.", "One reason.", "<h2>Numbers", "stiffness", "So it is.", "<h2>Figure",
             "Its caption.", "<h2>Job", "<pre>[window]</pre>", "<footer>"]  # fmt: skip
    places = [page.index(text) for text in order]
    assert places == sorted(places)
    assert "Nothing" not in page
    assert "<script" not in page  # nothing moves on it
    assert re.search(r'<tr class="void"><th>damping</th><td class="answer">1</td><td class="text">N m s/rad</td>', page)
    assert f'src="data:image/png;base64,{base64.b64encode(PIXEL).decode()}"' in page


def test_hostile_texts_stay_texts() -> None:
    page = html(hostile_page())
    for text in (*HOSTILE[:2], "<!-- \u202e"):
        assert text not in page
    attributes: list[tuple[str, str | None]] = []
    texts: list[str] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            attributes.extend((f"{tag}.{name}", value) for name, value in attrs)

        def handle_data(self, data: str) -> None:
            texts.append(data)

    Reader().feed(page)
    assert not [name for name, _ in attributes if name.split(".")[1].startswith("on")]
    assert {value[:15] for name, value in attributes if name == "img.src" and value} == {"data:image/png;"}
    assert ("img.alt", HOSTILE[2]) in attributes
    assert set(HOSTILE) <= set(texts)
    (data,) = re.findall(r'<script type="application/json" id="figures">(.*?)</script>', page, re.S)
    assert not set(data) & set("<>&\u2028")
    assert json.dumps(HOSTILE[1])[1:-1] in json.dumps(json.loads(data))


def test_the_policy_allows_what_is_in_the_page_and_no_network() -> None:
    page = html(page_of(over_time(windows(), torque())))
    (policy,) = re.findall(r'http-equiv="Content-Security-Policy" content="([^"]*)"', page)
    rules = policy.replace("&#39;", "'").split("; ")
    assert rules[0] == "default-src 'none'"
    assert not [rule for rule in rules if "http" in rule or "*" in rule]
    scripts = re.findall(r"<script>(.*?)</script>", page, re.S)
    assert len(scripts) == 2
    digests = [base64.b64encode(hashlib.sha256(text.encode()).digest()).decode() for text in scripts]
    assert f"script-src 'unsafe-eval' 'sha256-{digests[0]}' 'sha256-{digests[1]}'" in rules
    assert page.count(scripts[0][:200]) == 1
    outside = without_scripts(page)
    assert not re.search(r"<link|@import|url\(|\bsrc=\"(?!data:image/png;base64,)|https?://", outside)


def test_a_page_without_live_figures_runs_no_script() -> None:
    page = html(Page("Still", "", [Section("", [Figure("one", "One", "")])], {"one": PIXEL}))
    assert "script-src &#39;none&#39;" in page
    assert len(page) < 20_000


@pytest.mark.slow
def test_five_minutes_at_a_kilohertz_stay_below_three_megabytes() -> None:
    rng = np.random.default_rng(0)
    long = repeat(identified(), windows=5900, samples=300_000)
    noisy = {name: getattr(long, name) + rng.normal(0, 0.1, long.torque.shape) for name in
             ("torque", "reconstructed", "predicted")}  # fmt: skip
    time = np.arange(300_000) / 1000
    start = np.arange(5900) * 0.05
    long = replace(long, time=time, start=start, end=start + 2, **noisy)
    content = report.summary([long], parse_job(JOB), recording())
    page = html(report.page([long], [long, replace(long, window=4.0)], content))
    assert 1_500_000 < len(page.encode()) < 3_000_000


def test_bands_have_gaps_where_nothing_is_known() -> None:
    """Canvas areas bridge what is no number: there the band must have no height."""
    plot = interactive.empty_panel(100, interactive_windows.Range1d(0, 9), interactive_windows.Range1d(0, 9), "y")
    low = np.array([1, 1, np.nan, np.nan, 2, 2, np.nan, 3.0])
    interactive_windows._band(plot, np.arange(8.0), low, low + 1)
    data = plot.renderers[0].data_source.data
    np.testing.assert_array_equal(data["x"], [0, 0, 1, 1, 4, 4, 5, 5, 7, 7, 7])
    np.testing.assert_array_equal(data["high"] - data["low"], [0, 1, 1, 0, 0, 1, 1, 0, 0, 1, 0])


def test_wild_numbers_and_single_windows_have_figures() -> None:
    one = windows(n=6)
    wild = replace(one, value=np.where(np.arange(6)[:, None] > 3, 1e200, np.nan), low=one.low * np.nan)
    single = Windows(
        ["a"], ["1"], *(np.array([x]) for x in (0.0, 2.0)), *(np.ones((1, 1)),) * 3, np.array([TRUSTED]), [""]
    )
    for case in (wild, single, replace(one, verdict=np.full(6, "draws not to be trusted"))):
        json.dumps(interactive.document(over_time(case, torque(6)))[0], allow_nan=False)
    nothing = Torque(np.arange(9.0), ["torque (N m)"], np.full((9, 1), np.nan), {"fitted": np.full((9, 1), np.nan)})
    interactive.document(over_time(one, nothing))


def test_ellipses_have_axes_of_one_scale_and_leave_out_what_is_unknown() -> None:
    geometry, q = ArmGeometry((0.29, 0.34)), np.array([0.5, 1.5])
    xi, D, K = np.array([0.268, 0.084, 0.074]), np.array([[2.4, 1.2], [1.2, 1.4]]), np.array([[29, 14], [14, 17.0]])
    found = endpoint_impedance(geometry, q, xi, D, K)
    unknown = endpoint_impedance(geometry, q, xi, D, K * np.nan)
    live = interactive_arm.ellipses(geometry, q, {HOSTILE[0]: found, "unknown": unknown})
    panels = [plot for plot, _, _ in live.root.children]
    assert all(plot.match_aspect for plot in panels)
    assert [len(plot.hover) for plot in panels] == [2, 2, 1]
    outline = panels[2].hover[0].renderers[0].data_source.data
    middle = np.asarray(geometry.forward(q))
    np.testing.assert_allclose([outline["x"][:-1].mean(), outline["y"][:-1].mean()], middle, atol=1e-6)


def test_nothing_heavy_is_imported_before_a_figure_is_made() -> None:
    program = (
        "import sys, jaximp.plots, jaximp.reports.estimates, jaximp.reports.impedance, jaximp.reports.posterior\n"
        "found = {'matplotlib', 'bokeh', 'PIL'} & set(sys.modules)\n"
        "assert not found, found\n"
        "assert jaximp.plots.png and 'matplotlib' in sys.modules and 'bokeh' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_result_finds_its_figure() -> None:
    estimates = identified()
    figure = plots.figure_of(estimates)
    assert [axis.get_title(loc="left") for axis in figure.axes][2] == "stiffness (N m/rad)"
    with pytest.raises(TypeError, match=r"no figure of a str: give one of .*Estimates"):
        plots.figure_of("estimates")


# ---- in a browser ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def running() -> Iterator[Browser]:
    if executable() is None:
        pytest.skip("no Chromium here: install it (apt-get install chromium), or set CHROMIUM to its path")
    with browser(60) as one:
        one.size(1200, 900)
        yield one


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report of the recording with a still phase."""
    folder = tmp_path_factory.mktemp("report")
    report.write_results(folder, [identified()], [], parse_job(JOB), recording())
    return folder / "report.html"


@pytest.fixture
def page(running: Browser, written: Path) -> Iterator[Browser]:
    """The report, just opened; afterwards it must have kept quiet and asked for nothing."""
    visit(running, written)
    yield running
    quiet(running, written)


def visit(page: Browser, path: Path) -> None:
    page.open(path.as_uri())
    page.wait("document.documentElement.dataset.usable")


def quiet(page: Browser, path: Path) -> None:
    assert page.complaints() == []
    assert page.evaluate("window.ran") is None
    assert {address for address in page.requests() if not address.startswith("data:")} == {path.as_uri()}


def near(page: Browser, figure: str) -> None:
    """Go to a figure, and wait until it is drawn."""
    page.evaluate(f"document.getElementById('{figure}').scrollIntoView()")
    page.wait(f"{COLOURS % (CANVASES % figure)} > 10")
    page.frame()


CANVASES = """(() => {
  const found = [];
  const walk = (node) => {
    if (node.tagName === 'CANVAS' && node.width) found.push(node);
    for (const child of [...node.children, ...(node.shadowRoot?.children ?? [])]) walk(child);
  };
  walk(document.getElementById('%s'));
  return found;
})()"""
TEXT = """(() => {
  const parts = (node) => [...(node.shadowRoot?.childNodes ?? []), ...node.childNodes];
  const walk = (node) => node.nodeType === 3 ? node.textContent
    : parts(node).filter((one) => !['STYLE', 'SCRIPT'].includes(one.tagName)).map(walk).join('');
  return walk(document.body);
})()"""
"""All text of the page, also within the shadows of its elements."""
COLOURS = """new Set(%s.flatMap((one) => [
  ...new Uint32Array(one.getContext('2d').getImageData(0, 0, one.width, one.height).data.buffer)
])).size"""
"""How many different colours canvases have."""


def mouse(page: Browser, kind: str, x: float, y: float, **more: object) -> None:
    page.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


def place_of(page: Browser, time: float) -> tuple[float, float]:
    """Where a time is in the first panel of the parameters."""
    plot = "Bokeh.documents.at(-1).roots()[0].children.find(([one]) => one.x_range)[0]"
    low, high, left, width, x, y = page.evaluate(
        f"(() => {{ const f = {plot}, box = document.getElementById('parameters').getBoundingClientRect();"
        "return [f.x_range.start, f.x_range.end, f.min_border_left, f.inner_width, box.x, box.y]; })()"
    )
    return x + left + width * (time - low) / (high - low), y + 100


def hover(page: Browser, time: float, text: str) -> str:
    """Move about over a time until the page says a text, and tell all that it then says."""
    for shift in range(200):
        x, y = place_of(page, time)
        mouse(page, "mouseMoved", x, y + shift % 5)
        page.frame()
        found: str = page.evaluate(TEXT)
        if text in found:
            return found
    raise AssertionError(f"nothing says '{text}'")


def click(page: Browser, time: float) -> None:
    x, y = place_of(page, time)
    mouse(page, "mousePressed", x, y, button="left", buttons=1, clickCount=1)
    mouse(page, "mouseReleased", x, y, button="left", clickCount=1)


@pytest.mark.slow
@pytest.mark.compiles
def test_figures_are_drawn_when_somebody_comes_near(page: Browser) -> None:
    assert page.evaluate(f"{CANVASES % 'condition'}.length") == 0
    near(page, "condition")
    page.wait(f"{CANVASES % 'condition'}.length >= 3")
    assert page.evaluate("getComputedStyle(document.querySelector('.still')).display") == "none"


def test_a_window_tells_its_values_and_its_reason(page: Browser) -> None:
    estimates = identified()
    doubted = int(np.flatnonzero(~estimates.verdicts.trusted)[3])
    middle = float(estimates.start[doubted] + estimates.end[doubted]) / 2
    near(page, "parameters")
    before = page.evaluate("document.getElementById('about-window').textContent")
    assert before.startswith("trusted")
    reason = str(estimates.verdicts.reason[doubted])
    hovering = hover(page, middle, reason)
    assert f"window from {estimates.start[doubted]:.5g} to {estimates.end[doubted]:.5g} s" in hovering
    assert str(estimates.verdicts.verdict[doubted]) in hovering

    click(page, middle)
    page.wait("!document.getElementById('about-window').textContent.startsWith('trusted')")
    told = page.evaluate("document.getElementById('about-window').textContent")
    assert reason[1:] in told
    assert "N m/rad" in told
    drawn = "Bokeh.documents.at(-1).roots()[1].children.find(([one]) => one.x_range)[0]"
    ends = page.evaluate(f"[{drawn}.x_range.start, {drawn}.x_range.end]")
    np.testing.assert_allclose(ends, [estimates.start[doubted], estimates.end[doubted]], atol=1e-4)
    times = page.evaluate(f"[...{drawn}.renderers[0].data_source.data.time]")
    inside = (estimates.time > ends[0] - 1e-4) & (estimates.time < ends[1] + 1e-4)
    np.testing.assert_allclose(times, estimates.time[inside], atol=1e-4)

    page.evaluate("document.querySelector('.steps [value=\"1\"]').click()")
    after = page.evaluate(f"{drawn}.x_range.start")
    assert after == pytest.approx(estimates.start[doubted + 1], abs=1e-4)


def test_figures_over_time_zoom_together(page: Browser) -> None:
    near(page, "parameters")
    hover(page, 4, "window from")  # now it answers
    (x0, y), (x1, _) = (place_of(page, time) for time in (4, 8))
    mouse(page, "mousePressed", x0, y - 20, button="left", buttons=1, clickCount=1)
    for share in (0.25, 0.5, 1):
        mouse(page, "mouseMoved", x0 + share * (x1 - x0), y + 20 * share, button="left", buttons=1)
    mouse(page, "mouseReleased", x1, y + 20, button="left", clickCount=1)
    ranges = "Bokeh.documents.at(-1).roots()[0].children.map(([one]) => one.x_range).filter(Boolean)"
    page.wait(f"{ranges}[0].start > 1")
    low, high = page.evaluate(f"[{ranges}[0].start, {ranges}[0].end]")
    assert low == pytest.approx(4, abs=0.2)
    assert high == pytest.approx(8, abs=0.2)
    near(page, "torque")
    roots = "Bokeh.documents.at(-1).roots()"
    assert page.evaluate(f"{roots}.at(-1).children.find(([one]) => one.x_range)[0].x_range.start") == low


def test_paper_and_pages_without_scripts_show_the_pictures(page: Browser, written: Path) -> None:
    shown = "[...document.querySelectorAll('figure img')].map((one) => one.offsetHeight > 100)"
    assert page.evaluate(shown) == [False, False, False, True, True]
    page.call("Emulation.setEmulatedMedia", media="print")
    assert page.evaluate(shown) == [True] * 5
    assert page.evaluate("document.getElementById('parameters').offsetHeight") == 0
    page.call("Emulation.setEmulatedMedia", media="")
    page.call("Emulation.setScriptExecutionDisabled", value=True)
    page.open(written.as_uri())
    page.wait(f"{shown}.every(Boolean)")
    page.call("Emulation.setScriptExecutionDisabled", value=False)


def test_hostile_texts_do_nothing_in_a_browser(running: Browser, tmp_path: Path) -> None:
    path = tmp_path / "page.html"
    path.write_text(html(hostile_page()), encoding="utf-8")
    visit(running, path)
    near(running, "parameters")
    hover(running, 19, f"{POOR}{HOSTILE[1]}")
    click(running, 19)
    running.wait(f"document.getElementById('about-window').textContent.includes({json.dumps(HOSTILE[1])})")
    assert running.evaluate("document.querySelector('h1').textContent") == HOSTILE[0]
    assert running.evaluate("document.querySelectorAll('img').length") == 2
    near(running, "torque")
    quiet(running, path)


def test_a_trial_can_be_picked_among_deviations(running: Browser, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    position, force = rng.normal(size=(2, 6, 40, 2)).cumsum(axis=2)
    live = {"deviations": interactive_arm.deviations(1e-3 * position, force, 1000.0)}
    path = tmp_path / "page.html"
    path.write_text(html(page_of(live)), encoding="utf-8")
    visit(running, path)
    near(running, "deviations")
    running.wait(f"{CANVASES % 'deviations'}.length >= 4")
    source = "Bokeh.documents.at(-1).roots()[0].children.find(([one]) => one.x_range)[0].renderers[0].data_source"
    assert running.evaluate(f"[...{source}.data.trial]") == [1, 2, 3, 4, 5, 6]
    np.testing.assert_allclose(running.evaluate(f"[...{source}.data.y0[2]]"), position[2, :, 0], rtol=1e-5)
    quiet(running, path)


def test_narrow_pages_do_not_overflow(running: Browser, written: Path) -> None:
    running.size(390, 800)
    visit(running, written)
    near(running, "parameters")
    assert running.evaluate("document.documentElement.scrollWidth") <= 390
    running.size(1200, 900)


def estimates_of_two_joints(one: Estimates) -> Estimates:
    two = {name: np.repeat(getattr(one, name), 2, axis=1) for name in ("torque", "reconstructed", "predicted")}
    return replace(one, **two)


def test_every_joint_has_its_torque() -> None:
    live = report.live_figures(estimates_of_two_joints(identified()))
    titles = [plot.above[0].text.text for plot, _, _ in live["torque"].root.children]
    assert titles == [f"{part}torque of joint {k} (N m)" for k in (1, 2) for part in ("", "residual ")]
