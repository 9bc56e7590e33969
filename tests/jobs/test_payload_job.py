"""Jobs that weigh a load, or find gains by a load that is known."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import jaximp
from factories.chains import chain_in, with_load
from jaximp.batch.plan import of_recordings
from jaximp.cli.identify import identify_into
from jaximp.identification import DriveGains
from jaximp.jobs import WindowJob, parse_job
from jaximp.jobs import run as jaximp_run
from jaximp.jobs.payload import Weighed
from jaximp.jobs.run import weigh
from jaximp.models.spatial import about, pseudo_inertia
from jaximp.recordings.load import recording_from_mapping
from jaximp.reports.pages import Alert, Listing, Page, Table, write_page
from jaximp.reports.payload import load_pictures, load_sections, write_load

LOAD = about(0.7, np.array([0.03, 0.02, 0.08]), np.diag([2e-3, 3e-3, 1e-3]))
GAINS = np.array([8.0, 3.0])
COLUMNS = "time = 1\nposition = [2, 3]\ntorque = { columns = [4, 5], gain = [8, 3], gain_error = { common = 10 } }\n"
JOB = f"""
[recording]
file = ["with_a.csv", "with_b.csv"]
{COLUMNS}
[robot_recording]
file = "without.csv"
{COLUMNS}
[model.robot]
urdf = "two_joints.urdf"
friction = true
[filter]
position_cutoff = 8.0
decimation_cutoff = 4.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("payload")
    chain = chain_in(found)
    runs = {"without": (50, None), "with_a": (51, LOAD), "with_b": (52, LOAD)}
    for name, (seed, load) in runs.items():
        run = with_load(chain, seed, load, gain=GAINS)
        np.savetxt(found / f"{name}.csv", np.column_stack([run.time, run.position, run.torque]), delimiter=",")
    return found


def job_of(more: str, folder: Path) -> WindowJob:
    job = parse_job(JOB + more, folder)
    assert isinstance(job, WindowJob)
    return job


def test_a_job_weighs_its_load(folder: Path, tmp_path: Path) -> None:
    weighed = weigh(job_of("[payload]\nmethod = 1\n", folder))
    assert isinstance(weighed, Weighed)
    (found,) = weighed.loads
    assert found.method == 1
    assert abs(found.mass.value - 0.7) < 4 * found.mass.stderr
    assert found.gain_stderr[0] == pytest.approx(0.1 * found.mass.value, rel=1e-6)
    write_load(tmp_path, weighed)
    content = json.loads((tmp_path / "payload.json").read_text())
    assert content["parameters"]["load.mass"]["value"] == pytest.approx(found.mass.value)
    assert content["parameters"]["load.centre_y"]["value"] is None
    assert content["determined"]["load.mass"] is bool(found.determined[0])
    assert content["words"] == weighed.in_words()
    assert load_pictures(weighed) == {}


@pytest.fixture(scope="module")
def weighed(folder: Path) -> Weighed:
    """By two methods."""
    found = weigh(job_of("[payload]\nmethod = [4, 1]\n", folder))
    assert isinstance(found, Weighed)
    return found


def test_the_report_begins_with_the_load(weighed: Weighed, tmp_path: Path) -> None:
    assert [load.method for load in weighed.loads] == [4, 1]
    assert weighed.in_words()[-1].startswith("by method 1: mass 0.")
    (section,) = load_sections(weighed)
    (table,) = (part for part in section.parts if isinstance(part, Table))
    rows, heads = {row[0]: row for row in table.rows}, [column.head for column in table.columns]
    load, other = weighed.loads
    low, high = load.mass.interval()
    expected = [f"{load.mass.value:.4g}", f"± {(high - low) / 2:.2g}", "kg", "determined"]
    assert rows["mass"][:-1] == ["mass", *expected]
    assert rows["mass"][heads.index("Method 1")].startswith(f"{other.mass.value:.4g} ± ")
    assert rows["centre of mass, x"][1] == f"{1e3 * load.centre.theta[0]:.4g}"
    assert rows["centre of mass, y"][1:5] == ["–", "", "mm", "not determined"]  # it moves no torque
    assert "Nearest real body" not in heads
    write_page(tmp_path, Page("a load", "", [section], load_pictures(weighed)), {})
    page = (tmp_path / "report.html").read_text()
    assert f"The load has {load.in_words()[0]}; centre of mass in the frame of fore: x" in page
    assert "a real body can have these parameters" in page
    assert (tmp_path / "load_by_method.png").is_file()


def test_a_load_that_no_body_is_gets_the_nearest(weighed: Weighed, tmp_path: Path) -> None:
    load = weighed.loads[0]
    seen = int(np.flatnonzero(np.isfinite(load.theta))[-1])
    assert load.names[seen] == "load.Iyy"
    theta = load.theta.copy()
    theta[seen] = -20 * load.stderr[seen]
    found = Weighed.of([replace(load, theta=theta)])
    assert found.body is not None
    assert found.body.distance > 10
    assert np.linalg.eigvalsh(pseudo_inertia(found.body.parameters))[0] > 0
    assert any(line.startswith("no real body has these parameters: the nearest one is ") for line in found.in_words())
    assert found.in_words()[-1].startswith("errors do not explain that")
    (section,) = load_sections(found)
    (table,) = (part for part in section.parts if isinstance(part, Table))
    place = [column.head for column in table.columns].index("Nearest real body")
    assert table.rows[0][place] == f"{found.body.parameters[0]:.3g}"
    assert any(isinstance(part, Alert) and part.level == "caution" for part in section.parts)
    write_load(tmp_path, found)
    nearest = json.loads((tmp_path / "payload.json").read_text())["nearest_body"]
    assert nearest["is_the_estimate"] is False
    assert nearest["parameters"]["load.mass"] == found.body.parameters[0]


def test_a_job_finds_gains_by_a_known_load(folder: Path, tmp_path: Path) -> None:
    """What was made torques by nominal gains is off by one."""
    found = weigh(job_of("[payload]\nmass = 0.7\nmass_error = 0.001\n", folder))
    assert isinstance(found, DriveGains)
    assert (np.abs(found.theta - 1) < 4 * found.stderr).all()
    write_load(tmp_path, found)
    content = json.loads((tmp_path / "gains.json").read_text())
    assert content["gain_error_percent"]["common"] == pytest.approx(found.gain_error["common"])
    assert content["words"][-2].startswith("gain = [")
    assert content["words"][-1].startswith("gain_error = { common = ")
    (section,) = load_sections(found)
    (table,) = (part for part in section.parts if isinstance(part, Table))
    assert [row[1] for row in table.rows] == [f"{gain:.4g}" for gain in found.theta]
    assert any(isinstance(part, Listing) and part.text == "\n".join(content["words"][-2:]) for part in section.parts)


@pytest.mark.parametrize("table", ["robot_recording", "held_out"])
def test_columns_are_those_of_the_recording_where_a_table_names_none(table: str, folder: Path) -> None:
    text = JOB.replace(f'[robot_recording]\nfile = "without.csv"\n{COLUMNS}', f'[{table}]\nfile = "without.csv"\n')
    job = parse_job(text + ("[payload]\n" if table == "robot_recording" else ""), folder)
    assert isinstance(job, WindowJob)
    if table == "held_out":
        own = job.load_held_out()
        assert own is not None
    else:
        ((own,), _) = job.load_pair()
    known = recording_from_mapping({**job.recording, "file": "without.csv"}, folder)
    np.testing.assert_array_equal(own.torque, known.torque)
    text = text.replace(f"[{table}]\n", f"[{table}]\nsample_rate = 100\n")
    other = parse_job(text + ("[payload]\n" if table == "robot_recording" else ""), folder)
    assert isinstance(other, WindowJob)
    assert "time" not in getattr(other, table)


def test_a_table_with_columns_of_its_own_takes_none_of_the_recording(folder: Path) -> None:
    text = JOB.replace("[robot_recording]", "reference = [2, 3]\n[robot_recording]")
    job = parse_job(text + "[payload]\n", folder)
    assert isinstance(job, WindowJob)
    assert "reference" not in (job.robot_recording or {})


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"without.csv"', '"no.csv"', "no.csv: there is no such file"),
        ('file = "without.csv"', "", r"\[robot_recording\]: 'file' is missing"),
        ('file = "without.csv"', 'file = "without.csv"\nvelocty = 4', r"\[robot_recording\]: unknown key 'velocty'"),
        ("[model.robot]", '[model.robot]\ntip = "base"', "which link bears the load"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_computed(
    old: str, new: str, message: str, folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(jaximp_run, "prepare", lambda *args: pytest.fail("it was prepared"))
    job = parse_job(JOB.replace(old, new) + "[payload]\n", folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        identify_into(job, tmp_path)


def test_a_job_without_a_payload_weighs_nothing(folder: Path) -> None:
    text = JOB.replace("[robot_recording]", "[held_out]")
    job = parse_job(text, folder)
    assert isinstance(job, WindowJob)
    assert weigh(job) is None


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("[payload]\nmethod = 5\n", "payload.method is 5"),
        ("[payload]\nmethod = [4, 5]\n", "payload.method is .4, 5.: choose 1, 2, 3 or 4"),
        ("[payload]\nmethod = [4, 4]\n", "list each method once"),
        ("[payload]\nmehtod = 1\n", "did you mean 'method'"),
        ("[payload]\ncentre = [0.0, 0.0, 0.1]\n", "payload.centre is of use only with a payload.mass"),
        ("[payload]\nmethod = 1\nmass = 0.7\n", "payload.method is of no use with a payload.mass"),
        ("", "robot_recording.* is of use only with .* or with .payload"),
    ],
)
def test_keys_are_checked(more: str, message: str, folder: Path) -> None:
    with pytest.raises(ValueError, match=message):
        parse_job(JOB + more, folder)


def test_a_payload_needs_a_robot_and_its_recording(folder: Path) -> None:
    with pytest.raises(ValueError, match="needs a robot with a urdf"):
        parse_job(JOB.replace("[robot_recording]", "[held_out]") + "[payload]\n", folder)
    with pytest.raises(ValueError, match="one pair of recordings"):
        of_recordings(job_of("[payload]\n", folder))


def test_without_a_solver_the_load_is_told_all_the_same(weighed: Weighed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jaximp.consistency.programs.find_spec", lambda name: None)
    found = Weighed.of(weighed.loads)
    assert found.body is None
    assert found.of_body()[0].startswith("whether a real body has these parameters is not known: ")
    assert "pip install" in found.in_words()[-2]
    (section,) = load_sections(found)
    assert any(isinstance(part, Alert) and part.items[-1] == found.remark for part in section.parts)


@pytest.mark.slow  # compiles the programs of two lengths, and draws a report
def test_the_command_line_says_what_the_load_is(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "job.toml").write_text(JOB + "[payload]\n", encoding="utf-8")
    out = folder / "out"
    assert jaximp("identify", folder / "job.toml", "--out", out) == 0
    said = capsys.readouterr().out
    assert "mass 0." in said
    assert "centre of mass in the frame of fore: x" in said
    assert (out / "payload.json").is_file()
    assert "The robot with its load" in (out / "report.html").read_text()
