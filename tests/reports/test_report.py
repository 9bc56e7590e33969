"""Report, summary and table: complete, self-contained, and silent where nothing can be trusted."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pyarrow.parquet as pq
import pytest

from factories.estimates import JOB, identified, recording, without_trust
from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import Job, parse_job
from jaximp.reports import contents
from jaximp.reports import estimates as report
from jaximp.trust.frequencies import ByFrequency
from jaximp.types import Recording

NONE = "No dependence on the frequency beyond error and 5 % was found"
NASTY = "<script>alert(1)</script>"


@pytest.fixture(scope="module")
def case() -> tuple[Job, Recording, Estimates]:
    return parse_job(JOB + "# <b>bold</b>\n"), recording(name=NASTY), identified()


@pytest.fixture(scope="module")
def folder(case: tuple[Job, Recording, Estimates], tmp_path_factory: pytest.TempPathFactory) -> Path:
    job, source, estimates = case
    out = tmp_path_factory.mktemp("results")
    report.write_results(out, [estimates, replace(estimates, method=3)], [estimates], job, source)
    return out


def strict(text: str) -> Any:
    def refuse(constant: str) -> None:
        raise AssertionError(f"{constant} is not JSON")

    return json.loads(text, parse_constant=refuse)


def test_all_files_are_there(folder: Path) -> None:
    figures = {"parameters", "torque", "condition", "residual_spectrum", "by_frequency", "window_lengths"}
    figures |= {"methods"}
    tables = {"estimates.parquet", "estimates_method3.parquet", "summary.json", "report.html"}
    assert {path.name for path in folder.iterdir()} == tables | {f"{name}.png" for name in figures}


def test_report_needs_nothing_else(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "default-src &#39;none&#39;" in page  # nor may it ask for anything
    outside = re.sub(r"<script>.*?</script>", "", page, flags=re.S)
    assert not re.search(r"https?://|<link|<script src|@import|url\(", outside)
    sources = re.findall(r'src="([^"]{30})', outside)
    assert len(sources) == 7
    assert all(source.startswith("data:image/png;base64,") for source in sources)
    assert len(page) < 2_000_000


def test_report_escapes_what_it_is_given(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert NASTY not in page
    assert "&lt;script&gt;" in page
    assert "&lt;b&gt;bold" in page


def test_report_closes_every_tag(folder: Path) -> None:
    opened: list[str] = []

    class Balance(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            if tag not in ("meta", "img", "br"):
                opened.append(tag)

        def handle_endtag(self, tag: str) -> None:
            assert opened.pop() == tag

    Balance().feed((folder / "report.html").read_text(encoding="utf-8"))
    assert not opened


def test_report_gives_the_answer_before_the_figures(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert page.index("95 % interval") < page.index("What to do") < page.index("<figure>") < page.index("<pre>")
    assert "No window can be trusted" not in page


def test_summary_is_strict_json_and_right(folder: Path) -> None:
    content = strict((folder / "summary.json").read_text(encoding="utf-8"))
    assert content["parameters"]["stiffness"]["mean"] == pytest.approx(60, rel=0.02)
    assert content["parameters"]["stiffness"]["unit"] == "N m/rad"
    assert content["equilibrium"]["equilibrium"]["median"] == pytest.approx(0.01, rel=0.05)
    assert content["windows"]["count"] == sum(v["count"] for v in content["windows"]["verdicts"].values())
    assert content["at_joint"] is None
    assert content["threshold"] is None
    assert [result["method"] for result in content["further_methods"]] == [3]
    assert len(content["window_lengths"]) == 1
    assert set(content["versions"]) == {"jaximp", "jax", "numpy"}


def test_summary_gives_values_at_the_joint(case: tuple[Job, Recording, Estimates]) -> None:
    _, source, estimates = case
    geared = parse_job(JOB.replace("offset = true", "offset = true, gear_ratio = 10"))
    behind_gear = replace(estimates, model=geared.pipeline_for(source).model)
    content = report.summary([behind_gear], geared, source)
    joint, motor = content["at_joint"]["parameters"], content["parameters"]
    for name, factor in {"inertia": 100, "damping": 100, "stiffness": 100, "offset_torque": 10}.items():
        assert joint[name]["mean"] == pytest.approx(factor * motor[name]["mean"])
        assert joint[name]["half_width_95"] == pytest.approx(factor * motor[name]["half_width_95"])
    at_motor = content["equilibrium"]["equilibrium"]["median"]
    assert content["at_joint"]["equilibrium"]["equilibrium"]["median"] == pytest.approx(at_motor / 10)


def test_table_has_columns_units_and_the_job(folder: Path, case: tuple[Job, Recording, Estimates]) -> None:
    job, _, estimates = case
    table = pq.read_table(folder / "estimates.parquet")
    expected = ["start_s", "end_s", "condition", "sigma_min", "residual_rms", "vaf", "held_out_vaf", "dof", "samples"]
    parameters = [column for name in estimates.names for column in (name, f"{name}_stderr")]
    assert set(table.column_names) == {*expected, *parameters, "equilibrium", "verdict", "reason"}
    assert len(table) == len(estimates.end)
    units = {field.name: field.metadata[b"unit"].decode() for field in table.schema}
    assert units["stiffness"] == units["stiffness_stderr"] == "N m/rad"
    assert units["start_s"] == "s"
    assert units["equilibrium"] == "rad"
    assert units["residual_rms"] == "N m"
    assert table.schema.metadata[b"job"].decode() == job.text
    np.testing.assert_array_equal(table["stiffness"].to_numpy(), np.asarray(estimates.fit.theta)[:, 2])
    assert table["verdict"].to_pylist() == estimates.verdicts.verdict.tolist()


@pytest.mark.slow
@pytest.mark.compiles
def test_no_trusted_window_is_said_before_any_number(case: tuple[Job, Recording, Estimates], tmp_path: Path) -> None:
    job, source, estimates = case
    report.write_results(tmp_path, [without_trust(estimates)], [], job, source)
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert page.index("No window can be trusted") < page.index("<table")
    answer = page[page.index("<table") : page.index("</table>")]
    assert not re.search(r"<td[^>]*>[^<]*\d", re.sub(r'<td class="text">[^<]*</td>', "", answer))
    content = strict((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert content["windows"]["trusted"] == 0
    assert content["parameters"]["stiffness"]["mean"] is None


def of_bands(stiffness: list[float], p: float) -> ByFrequency:
    """A stiffness beside a damping of 0.7 in all bands."""
    value = np.column_stack([np.full(4, 0.7), stiffness])
    edges, middle, whole = np.array([0.5, 2.0, 4.0, 8.0, 16.0]), np.array([1.0, 3.0, 6.0, 12.0]), np.array([0.7, 60.0])
    names, units = ("damping", "stiffness"), ("N m s/rad", "N m/rad")
    return ByFrequency(names, units, edges, middle, value, 0.1 * value, 11.0, whole, whole, np.array([0.4, p]))


@pytest.mark.parametrize(
    ("stiffness", "p", "said"),
    [
        (
            [60.0, 61.0, 59.0, 60.0],
            0.5,
            f"{NONE} of damping and stiffness.",
        ),
        (
            [60.0, 65.0, 80.0, 75.0],
            1e-5,
            "Stiffness (60 around 1 Hz and 80 around 6 Hz, in N m/rad; p < 0.001) depends on the frequency. "
            f"{NONE} of damping.",
        ),
        (
            [60.0, math.nan, math.nan, math.nan],
            math.nan,
            f"{NONE} of damping. Whether stiffness does cannot be told: fewer than two bands determine it. "
            "Left out, since the band does not determine it: stiffness at 2 to 16 Hz.",
        ),
        (
            [math.nan, 60.0, math.nan, 60.0],
            0.9,
            f"{NONE} of damping and stiffness. "
            "Left out, since the band does not determine it: stiffness at 0.5 to 2 and 4 to 8 Hz.",
        ),
    ],
    ids=["the same", "depends", "one band", "left out"],
)
def test_what_depends_on_the_frequency_is_said(stiffness: list[float], p: float, said: str) -> None:
    assert report.frequencies_in_words(of_bands(stiffness, p)) == said


def test_the_report_says_whether_estimates_depend_on_the_frequency(folder: Path) -> None:
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert (
        "No dependence on the frequency beyond error and 5 % was found" in page[page.index("Estimates by frequency") :]
    )


@pytest.mark.slow
@pytest.mark.compiles
def test_windows_that_do_not_predict_the_next_are_counted(
    case: tuple[Job, Recording, Estimates], tmp_path: Path
) -> None:
    job, source, estimates = case
    held_out = np.where(np.cumsum(estimates.trusted) <= 3, -0.5, estimates.held_out_vaf)
    report.write_results(tmp_path, [replace(estimates, held_out_vaf=held_out)], [], job, source)
    assert strict((tmp_path / "summary.json").read_text(encoding="utf-8"))["windows"]["unpredictive"] == 3
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Of these windows 3 predict the torque of the next one worse than a constant would." in page


@pytest.mark.slow
@pytest.mark.compiles
def test_a_parameter_that_is_not_determined_is_said_in_the_table(
    case: tuple[Job, Recording, Estimates], tmp_path: Path
) -> None:
    job, source, estimates = case
    stderr = np.array(estimates.fit.stderr)
    stderr[:, 0] = 0.3 * np.abs(estimates.value[:, 0])
    loose = replace(estimates, fit=eqx.tree_at(lambda fit: fit.stderr, estimates.fit, stderr))
    report.write_results(tmp_path, [loose], [], job, source)
    determined = {
        name: value["determined"]
        for name, value in strict((tmp_path / "summary.json").read_text(encoding="utf-8"))["parameters"].items()
    }
    assert determined == {"inertia": False, "damping": True, "stiffness": True, "offset_torque": True}
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    answer = page[page.index("<table") : page.index("</table>")]
    rows = {name: answer[answer.index(name) :].split("</tr>")[0] for name in ("inertia", "damping", "stiffness")}
    assert ["not determined" in row for row in rows.values()] == [True, False, False]


def test_the_tests_of_a_robot_name_what_would_move_most() -> None:
    """Thirty-eight columns are no table."""
    names = [f"link{k}.mass" for k in range(9)]
    known = {"half_width_95": 0.1, "stands_for": "itself"}
    move = {name: (-1) ** k * 0.01 * k for k, name in enumerate(names)} | {"link4.mass": -0.5}
    one = {"group": "delay", "p": 0.001, "evidence": 12.3, "move": move, "move_stderr": dict.fromkeys(names, 0.004)}
    content = {
        "tests": [one], "parameters": dict.fromkeys(names, known), "reflex": {},
        "lacking": {name: f"{name} is off" for name in names},
    }  # fmt: skip
    (section,) = report._tests(content)
    said, table = section.parts
    assert [column.head for column in table.columns] == ["Is this missing?", "p", "Evidence", "Moves most"]
    (row,) = table.rows
    assert row[2] == "12"
    assert [part.split(" by ")[0] for part in row[3].split(", ")] == ["link4.mass", "link8.mass", "link7.mass"]
    assert said.text.endswith("link4.mass is off; and 4 more parameters")


def test_no_mean_stands_for_windows_that_exclude_each_other(case: tuple[Job, Recording, Estimates]) -> None:
    """A constant torque that is another one in the second half; wide intervals beside it say nothing."""
    job, source, estimates = case
    value = np.array(estimates.fit.theta)
    value[len(value) // 2 :, -1] -= 3.0
    moved = replace(estimates, fit=eqx.tree_at(lambda fit: fit.theta, estimates.fit, value))
    content = contents.summary([moved], job, source)
    ranges = {name: found["from_to_90"] for name, found in content["parameters"].items()}
    assert [name for name, ends in ranges.items() if ends is not None] == ["offset_torque"]
    np.testing.assert_allclose(ranges["offset_torque"], [-3.6, -0.6], atol=0.01)
    assert "Offset torque is between −3.6 and −0.6 N m in nine of ten windows." in content["headline"]
    (answer, *_) = report.page([moved], [], content).sections[0].parts
    assert answer.rows[-2][:2] == ["offset torque", "−3.6 to −0.6"]
