"""Jobs with a robot from its URDF."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from command_line import jaximp
from factories.chains import arrays, chain_in
from jaximp.jobs import WindowJob, parse_job
from jaximp.jobs.export import export_robot
from jaximp.models import Chain

JOB = """
held_out = 0.25
[recording]
file = ["a.csv", "b.csv"]
rows = [[1, 1200], [101, 1400]]
time = 1
position = [2, 3]
torque = { columns = [4, 5], gain = [2.0, 0.5], gain_error = { common = 5, each = [1, 2] } }
[model.robot]
urdf = "two_joints.urdf"
friction = true
min_velocity = { elbow = 0.05 }
[filter]
position_cutoff = 8.0
decimation_cutoff = 4.0
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("job")
    chain = chain_in(found)
    for seed, name in enumerate(("a.csv", "b.csv")):
        time, q, torque = arrays(chain, seed)
        np.savetxt(found / name, np.column_stack([time, q, torque / [2.0, 0.5]]), delimiter=",", fmt="%.9g")
    (found / "job.toml").write_text(JOB, encoding="utf-8")
    return found


def job_of(text: str, folder: Path) -> WindowJob:
    job = parse_job(text, folder)
    assert isinstance(job, WindowJob)
    return job


def test_a_gear_stands_in_the_recording_or_in_the_model(folder: Path) -> None:
    geared = JOB.replace("[model.robot]", "gear_ratio = 15\n[model.robot]")
    assert job_of(geared, folder).recording["gear_ratio"] == 15
    with pytest.raises(ValueError, match="keep one of them"):
        job_of(geared.replace("friction = true", "friction = true\ngear = 15.0"), folder)


@pytest.mark.slow  # compiles the programs of two lengths, and draws a report
def test_a_job_leads_to_a_report(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "out"
    assert jaximp("identify", folder / "job.toml", "--out", out) == 0
    assert "residual, held out" in capsys.readouterr().out
    content = json.loads((out / "summary.json").read_text())
    own = content["parameters"]["link2.mc_z"]
    assert own["stands_for"] == "link2.mc_z"
    assert abs(own["mean"] - own["urdf"]) < 1.2 * own["half_width_95"]
    assert len(content["held_out"]["moving"]) == 2
    assert content["held_out"]["total"] < 0.2
    assert content["residuals"]["still"][0] is None
    assert content["residuals"]["still"][1] > 0
    schema = pq.read_schema(out / "estimates.parquet")
    assert json.loads(schema.metadata[b"sums"])["link2.mc_z"] == "link2.mc_z"
    page = (out / "report.html").read_text()
    assert "Stands for" in page
    assert "Residuals of each joint" in page
    assert "Parameters against the URDF" in page


@pytest.mark.slow  # compiles the program of that length
def test_a_robot_is_exported_with_its_identified_links(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = folder / "identified.urdf"
    assert jaximp("export", folder / "job.toml", "--urdf", urdf) == 0
    said = capsys.readouterr().out
    assert "of 20 numbers the data determined" in said
    assert "mass of link 1: " in said
    with urdf.with_suffix(".csv").open() as file:
        rows = list(csv.DictReader(file))
    chain = Chain.from_urdf(urdf)
    np.testing.assert_allclose([float(row["value"]) for row in rows[:20]], chain.standard_parameters[:20], atol=1e-12)
    truth = Chain.from_urdf(folder / "two_joints.urdf")
    for row, own in zip(rows[:20], truth.standard_parameters, strict=False):
        assert float(row["low"]) - 0.02 <= own <= float(row["high"]) + 0.02
    assert jaximp("export", folder / "job.toml", "--urdf", urdf) == 1
    assert "exists: choose another --urdf, or pass --force" in capsys.readouterr().err


def test_only_robots_from_a_urdf_are_exported(folder: Path) -> None:
    head = JOB.split("[model.robot]")[0].replace("held_out = 0.25", "")
    job = parse_job(head + "[model]\nrobot = true\n[window]\nlength = 2\n", folder)
    with pytest.raises(
        ValueError, match=re.escape("only a robot from a URDF can be written as one: give [model.robot]")
    ):
        export_robot(job, folder / "no.urdf")


def test_the_job_lists_its_files(folder: Path) -> None:
    names = [path.name for path in job_of(JOB, folder).files()]
    assert names == ["a.csv", "b.csv", "two_joints.urdf"]


def test_several_tables_are_several_files(folder: Path) -> None:
    first, rest = JOB.split("[model.robot]")
    tables = "".join(
        first.replace("[recording]", "[[recording]]").replace("held_out = 0.25", "")
        .replace('["a.csv", "b.csv"]', f'"{name}"').replace("[[1, 1200], [101, 1400]]", rows)
        for name, rows in (("a.csv", "[1, 1200]"), ("b.csv", "[101, 1400]"))
    )  # fmt: skip
    by_list = job_of(JOB.replace("held_out = 0.25", ""), folder).load()
    by_table = job_of(tables + "[model.robot]" + rest, folder).load()
    np.testing.assert_array_equal(by_table.position, by_list.position)


def test_the_end_of_a_recording_is_kept_back(folder: Path) -> None:
    job = job_of(JOB, folder)
    held_out = job.load_held_out()
    assert held_out is not None
    assert len(held_out) == pytest.approx(len(job.load()) / 3, abs=1)
    assert held_out.time[0] > job.load().time[-1]


def test_a_table_of_what_is_held_out_names_its_file_alone(folder: Path) -> None:
    job = job_of(JOB.replace("held_out = 0.25", "") + '[held_out]\nfile = "b.csv"\n', folder)
    held_out = job.load_held_out()
    assert held_out is not None
    assert len(held_out) == 2000


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("position = [2, 3]", "position = [2]", "torque has 2 columns for 1 joints"),
        ('urdf = "two_joints.urdf"', 'urdf = "other.urdf"', "other.urdf"),
        ("friction = true", "frition = true", "did you mean 'friction'?"),
        ("friction = true", "human = true", "unknown key 'human'"),
        ("[filter]", "[model.human]\n[filter]", "a human in a robot needs the recording of the robot alone"),
        ("[filter]", "[model.arm]\n[filter]", "model.robot has a urdf: leave out model.arm"),
        ("{ elbow = 0.05 }", "{ elbo = 0.05 }", "elbo"),
        ("{ elbow = 0.05 }", '{ elbow = "x" }', "model.robot.min_velocity.elbow is 'x'"),
        ("time = 1", 'time = 1\njoint = "prismatic"', 'write joint = ["revolute", "revolute"]'),
        ("min_velocity = { elbow = 0.05 }", 'locked = ["elbow"]', "has 1 joints that move (shoulder)"),
        ("held_out = 0.25", "held_out = 1.5", "held_out is 1.5: it is the share"),
        ("[filter]", "[window]\nlength = inf\n[filter]", "window.length is inf"),
    ],
)
def test_one_line_for_what_does_not_fit(folder: Path, old: str, new: str, message: str) -> None:
    def resolve() -> None:
        job = job_of(JOB.replace(old, new), folder)
        job.pipeline_for(job.load())

    with pytest.raises((ValueError, FileNotFoundError)) as caught:
        resolve()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
