"""Jobs with a human who holds the end of a robot from a URDF, by the four methods."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from command_line import jaximp
from factories.chains import HELD, HUMAN, held, with_load
from jaximp.identification import Estimates
from jaximp.jobs import WindowJob, check, identify_recording, infer_recording, parse_job
from jaximp.jobs.design import parse_design_job
from jaximp.jobs.export import export_robot
from jaximp.models import Chain, TipImpedance
from jaximp.types import Recording

COLUMNS = "time = 1\nposition = [2, 3]\ntorque = [4, 5]\n"
JOB = f"""
[recording]
file = "held.csv"
{COLUMNS}
[robot_recording]
file = "alone.csv"
{COLUMNS}
[model]
methods = [1, 2, 3, 4]
[model.robot]
urdf = "held.urdf"
tip = "hand"
friction = true
[model.human]
directions = "xz"
[filter]
position_cutoff = 8.0
decimation_cutoff = 4.0
"""
TRUTH = np.array(list(HUMAN.values()))
SEEDS = 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    found = tmp_path_factory.mktemp("held")
    (found / "held.urdf").write_text(HELD, encoding="utf-8")
    for name, one in zip(("alone", "held"), pair(found, 0), strict=True):
        np.savetxt(found / f"{name}.csv", np.column_stack([one.time, one.position, one.torque]), delimiter=",")
    return found


def models(folder: Path) -> tuple[Chain, TipImpedance]:
    chain = Chain.from_urdf(folder / "held.urdf", tip="hand", friction=True)
    return chain, TipImpedance(chain, "xz")


def pair(folder: Path, seed: int) -> tuple[Recording, Recording]:
    """The robot alone and held, on one motion with noise of its own each."""
    chain, human = models(folder)
    return with_load(chain, 200 + seed, moves=100 + seed), held(chain, human, 300 + seed, moves=100 + seed)


def job_of(folder: Path, *changes: tuple[str, str]) -> WindowJob:
    text = JOB
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    job = parse_job(text, folder)
    assert isinstance(job, WindowJob)
    return job


@pytest.fixture(scope="module")
def found(folder: Path) -> list[list[Estimates]]:
    """Of several pairs, by each method."""
    job, pairs = job_of(folder), [pair(folder, seed) for seed in range(SEEDS)]
    return [identify_recording(job, loaded, alone) for alone, loaded in pairs]


@pytest.mark.slow  # compiles the filters of both models
@pytest.mark.parametrize("k", range(4), ids=["method 1", "method 2", "method 3", "method 4"])
def test_intervals_hold_the_human(found: list[list[Estimates]], k: int) -> None:
    """In about 95 of 100 cases, of parameters that are told to some per cent."""
    holds = []
    for several in found:
        one = several[k]
        assert one.method == k + 1
        assert one.names == tuple(HUMAN)
        assert one.trusted.all()
        low, high = one.interval()
        holds.append((low[0] <= TRUTH) & (high[0] >= TRUTH))
        assert (np.abs(one.value[0] - TRUTH) < 5 * one.stderr[0]).all()
        assert (one.stderr[0] < 0.08 * np.abs(TRUTH)).all()
    assert np.mean(holds) >= 0.85


@pytest.mark.slow  # compiles the filters of both models
def test_the_robot_is_told_too(found: list[list[Estimates]], folder: Path) -> None:
    one, (chain, _) = found[0][0], models(folder)
    assert one.robot is not None
    assert one.robot_names == chain.names
    assert any(note.startswith("the human's spring is at rest at x 0.2") for note in one.notes)
    assert any("its own torque differs by" in note for note in found[0][2].notes)


@pytest.mark.slow  # compiles the filters of both models
def test_windows_tell_a_human_who_changes(folder: Path) -> None:
    """The robot's recording counts as a whole, whatever the length of a window."""
    alone, loaded = pair(folder, 0)
    _, human = models(folder)
    stiffer = np.array([0, 0, 0, 0, 100.0, 0, 0, 0])
    q, late = alone.position, loaded.time > 12.0
    W = np.asarray(human.observation_matrix(q, 0 * q, 0 * q))
    changed = replace(loaded, torque=loaded.torque + late[:, None] * (W @ stiffer))
    job = job_of(folder, ("[filter]", "[window]\nlength = 6\nstep = 2\n[filter]"), ("[1, 2, 3, 4]", "[1, 4]"))
    for one in identify_recording(job, changed, alone):
        k = one.names.index("stiffness_x")
        before, after = one.end < 12.0, one.start > 12.0
        assert before.any()
        assert after.any()
        for which, truth in ((before, 150.0), (after, 250.0)):
            assert (np.abs(one.value[which, k] - truth) < 5 * one.stderr[which, k]).all()


@pytest.mark.slow  # compiles the filters of both models
def test_errors_hold_what_is_not_known_of_robot_and_gains(found: list[list[Estimates]], folder: Path) -> None:
    alone, loaded = pair(folder, 0)
    first = ("[1, 2, 3, 4]", "[1]")
    drifting = job_of(folder, ("[1, 2, 3, 4]", '[1]\nrobot_drift = { "joint2.viscous_friction" = 0.2 }'))
    drifted = identify_recording(drifting, loaded, alone)[0]
    plain = found[0][0]
    assert (drifted.value == plain.value).all()
    assert drifted.stderr[0, 2] > 2 * plain.stderr[0, 2]  # damping
    assert any("joint2.viscous_friction by 20.0%" in note for note in drifted.notes)
    gains = np.full((2, 2), 0.1**2)
    uncertain = [replace(one, gain_covariance=gains) for one in (alone, loaded)]
    scaled = identify_recording(job_of(folder, first), uncertain[1], uncertain[0])[0]
    expected = np.hypot(plain.stderr[0], 0.1 * np.abs(plain.value[0]))
    np.testing.assert_allclose(scaled.stderr[0], expected, rtol=1e-6)


@pytest.mark.slow  # compiles the filters of both models
def test_a_second_recording_of_the_robot_counts(found: list[list[Estimates]], folder: Path) -> None:
    """Both are one robot, and half of what they differ by is not known."""
    alone, loaded = pair(folder, 0)
    again = pair(folder, 7)[0]
    both = identify_recording(job_of(folder, ("[1, 2, 3, 4]", "[1]")), loaded, (alone, again))[0]
    assert (np.abs(both.value[0] - TRUTH) < 5 * both.stderr[0]).all()
    assert any("recordings before and after agree" in note for note in both.notes)
    assert both.robot_change is not None
    assert (both.robot_change > 0).all()


@pytest.mark.slow  # compiles the filters of both models
def test_method_3_needs_one_motion(folder: Path) -> None:
    alone, loaded = pair(folder, 0)[0], pair(folder, 1)[1]
    one = identify_recording(job_of(folder, ("[1, 2, 3, 4]", "[3]")), loaded, alone)[0]
    assert not one.trusted.any()
    assert "two motions and not one" in one.verdicts.complaint()


@pytest.mark.slow  # compiles programs of several lengths
def test_a_look_at_the_recording_proposes_a_window(folder: Path) -> None:
    alone, loaded = pair(folder, 0)
    findings, proposal = check(job_of(folder, ("[1, 2, 3, 4]", "[1]")), loaded, alone)
    (of_robot,) = (one for one in findings if one.topic == "robot")
    assert "record it again afterwards ([robot_recording_after])" in of_robot.text
    assert proposal.window is not None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('directions = "xz"', 'directions = "xq"', "model.human: directions has 'q'"),
        ('directions = "xz"', "directions = [[1, 0, 0], [1, 0, 1]]", "model.human: directions must be orthogonal"),
        (
            'directions = "xz"',
            "directions = 3",
            "directions is 3: it must be text or a list of vectors",
        ),
        ('directions = "xz"', "directions = [[1.0, 0.0]]", "vectors of three numbers each"),
        ('directions = "xz"', "offset = true", "[model.human] has an unknown key 'offset'"),
        (
            'directions = "xz"',
            "mass = false\ndamping = false\nstiffness = false\nforce = false",
            "model.human has no columns",
        ),
        ('[robot_recording]\nfile = "alone.csv"\n' + COLUMNS, "", "add a [robot_recording] table"),
        ("[model.human]", "[payload]\n[model.human]", "a [payload] is that of a robot which nobody holds"),
        ("methods = [1, 2, 3, 4]", "methods = [5]", "model.methods is [5]"),
        ("methods = [1, 2, 3, 4]", "robot_drift = 0.03", "say which parameters may have changed, as a table"),
        ("methods = [1, 2, 3, 4]", "robot_drift = { stiffness = 0.03 }", "unknown parameter 'stiffness'"),
        ('[model.human]\ndirections = "xz"\n', "", "add [model.human], or leave them out"),
        (
            "friction = true",
            'friction = "stribeck"\nstribeck_velocity = "estimate"',
            "Stribeck's curves are not",
        ),
        ("[filter]", '[window]\nestimates = "generalised"\n[filter]', "by ordinary least squares: leave out"),
        ("[filter]", "held_out = 0.2\n[filter]", "unknown key 'held_out'"),
        ("[filter]", "[filter]\nhigh_pass = 0.1", "set offset = false in the model"),
    ],
)
def test_one_line_for_what_does_not_fit(folder: Path, old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        identify_recording(job_of(folder, (old, new)), *pair(folder, 0)[::-1])
    assert "\n" not in str(caught.value)


def test_what_a_held_robot_cannot_do(folder: Path) -> None:
    job = job_of(folder)
    with pytest.raises(ValueError, match="has no posterior"):
        infer_recording(job, *pair(folder, 0)[::-1])
    with pytest.raises(ValueError, match="exported from a recording of it alone"):
        export_robot(job, folder / "no.urdf")
    with pytest.raises(ValueError, match="designed for a robot from a URDF that nobody holds"):
        parse_design_job('[model]\nhuman = true\n[model.robot]\nurdf = "held.urdf"\n', folder)


@pytest.mark.slow  # compiles the programs of two lengths, and draws a report
def test_the_report_compares_the_methods(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "job.toml").write_text(JOB, encoding="utf-8")
    out = folder / "out"
    assert jaximp("identify", folder / "job.toml", "--out", out) == 0
    assert "stiffness_x" in capsys.readouterr().out
    content = json.loads((out / "summary.json").read_text())
    assert [one["method"] for one in content["further_methods"]] == [2, 3, 4]
    assert content["parameters"]["stiffness_x"]["mean"] == pytest.approx(150, rel=0.02)
    assert content["robot"]["joint2.viscous_friction"]["value"] == pytest.approx(0.8, rel=0.1)
    page = (out / "report.html").read_text()
    assert "Robot alone" in page
    assert (out / "methods.png").is_file()
    assert (out / "estimates_method4.parquet").is_file()
