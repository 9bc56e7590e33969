"""Motions for robots from a URDF: every limit is kept on the fine grid, and files say what controllers need."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from factories.robots import joint, link, robot
from jaximp.cli.main import app
from jaximp.design import Clearance, Design, Load, Plane, Selected, design_excitation, urscript
from jaximp.design.limits import Limits, completed
from jaximp.design.motions import Encoder
from jaximp.jobs.design import parse_design_job, read_design_job
from jaximp.models import SIX_JOINT_ARM, Chain, HumanJoint, rigid_body
from jaximp.models.urdf import parse_urdf
from jaximp.motion.trajectories import FourierSeries, at_rest

LIMIT = '<limit lower="-2.6" upper="2.6" velocity="3" effort="{effort}"/>'
TEXT = robot(
    link("base"),
    joint("shoulder", "base", "upper", axis="0 1 0", limit=LIMIT.format(effort=8)),
    link("upper", 2.0, "0.01 0.02 0.15"),
    joint("elbow", "upper", "fore", axis="0 1 0", limit=LIMIT.format(effort=1.6)),
    link("fore", 1.0, "0.02 0.01 0.1"),
    joint("mount", "fore", "tool", "fixed", "0 0 0.25"),
    link("tool", 0.1, "0 0 0.01", "0.0001 0 0 0.0001 0 0.0001"),
    name="two_joints",
)
"""Two links in a vertical plane, on a column that the second one could meet."""
JOB = """
[model.robot]
urdf = "robot.urdf"
tip = "tool"
friction = "viscous"
[limits]
acceleration = 12
[clearance]
distance = 0.03
radii = { base = 0.08, upper = 0.05, fore = 0.05, tool = 0.03 }
table = 0.02
[design]
harmonics = 4
period = 5
rest = true
starts = 2
sample_rate = 200
"""
PERIOD, FINE = 5.0, 2000


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("robot")
    (folder / "robot.urdf").write_text(TEXT, encoding="utf-8")
    (folder / "job.toml").write_text(JOB, encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def chain(folder: Path) -> Chain:
    return Chain.from_urdf(folder / "robot.urdf", tip="tool", friction="viscous")


@pytest.fixture(scope="module")
def design(folder: Path) -> Design:
    return read_design_job(folder / "job.toml").run()


def fine(design: Design) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(x) for x in design.trajectory(np.arange(FINE) * PERIOD / FINE))


def test_every_limit_is_kept_and_those_that_are_reached_are_named(chain: Chain, design: Design) -> None:
    q, dq, ddq = fine(design)
    torque = (
        chain.inverse_dynamics(q, dq, ddq)
        + dq * chain.parameters[[n.endswith("viscous_friction") for n in chain.names]]
    )
    shares = {
        "highest position": q / 2.6,
        "lowest position": -q / 2.6,
        "velocity": np.abs(dq) / 3,
        "acceleration": np.abs(ddq) / 12,
        "torque": np.abs(torque) / [8, 1.6],
    }
    most = {f"{name} of joint {j + 1}": x[:, j].max() for name, x in shares.items() for j in (0, 1)}
    assert max(most.values()) <= 1 + 1e-9
    assert design.clearance is not None
    distance = np.asarray(design.clearance.distances(q)).min(axis=0)
    assert distance.min() >= 0.03 - 1e-9
    close = {name for name, x in zip(design.clearance.names, distance, strict=True) if x <= 0.03 + 1e-5}
    expected = {name for name, share in most.items() if share > 0.9995} | {f"clearance of {name}" for name in close}
    assert expected <= set(design.active)
    assert {"torque", "clearance"} & {name.split(" of ")[0] for name in expected}  # they were made to matter


def test_it_begins_and_ends_at_rest(design: Design) -> None:
    q, dq, ddq = (np.asarray(x) for x in design.trajectory(np.array([0.0, PERIOD])))
    np.testing.assert_allclose([dq, ddq], 0, atol=1e-9)
    np.testing.assert_allclose(q[0], q[1], atol=1e-9)


def test_conditions_are_those_of_numpy_and_words_name_the_scaling(chain: Chain, design: Design) -> None:
    W = np.asarray(chain.observation_matrix(*fine(design))).reshape(-1, len(chain.names))
    assert design.condition == pytest.approx(np.linalg.cond(W), rel=1e-6)
    assert design.unit_condition == pytest.approx(np.linalg.cond(W / np.linalg.norm(W, axis=0)), rel=1e-6)
    words = design.in_words()
    assert (
        f"{design.condition:.4g} of columns in SI units, {design.unit_condition:.4g} of columns of unit norm"
        in words[0]
    )
    assert design.condition == design.conditions.min()
    random = np.random.default_rng(0)
    for _ in range(50):  # of motions within the same limits of position and velocity that nobody designed
        series = at_rest(FourierSeries(*random.normal(size=(2, 2, 4)), random.uniform(-1, 1, 2), PERIOD))
        W = np.asarray(chain.observation_matrix(*(np.asarray(x) for x in series(np.arange(200) * PERIOD / 200))))
        assert design.condition < np.linalg.cond(W.reshape(-1, len(chain.names)))


def test_files_and_words_of_the_command(folder: Path, design: Design) -> None:
    result = CliRunner().invoke(app, ["design", str(folder / "job.toml"), "--out", str(folder / "out")])
    assert result.exit_code == 0, result.output
    assert "limits reached: " in result.output
    ros = yaml.safe_load((folder / "out/trajectory.yaml").read_text())
    assert ros["joint_names"] == ["shoulder", "elbow"]
    q = np.asarray(design.trajectory(np.arange(1000) / 200)[0])
    np.testing.assert_allclose([point["positions"] for point in ros["points"]], q, atol=1e-9)
    summary = json.loads((folder / "out/summary.json").read_text())
    assert summary["condition_of_unit_columns"] == pytest.approx(design.unit_condition)
    assert "base and fore" in summary["clearance"]["pairs"]
    assert summary["limits"]["torque"] == [8.0, 1.6]
    assert not (folder / "out/trajectory.script").exists()


def test_a_program_in_urscript_is_the_motion() -> None:
    random = np.random.default_rng(0)
    series = at_rest(FourierSeries(*random.normal(size=(2, 6, 4)), random.normal(size=6), 1.0))
    head, comment, approach, *follow, stop, end, call = urscript(series).splitlines()
    assert (head, stop, end, call) == ("def excitation():", "  stopj(2.0)", "end", "excitation()")
    assert comment.strip().startswith("#")
    number = r"-?\d+\.\d+"
    pose = rf"\[({number}(?:, {number}){{5}})\]"
    assert re.fullmatch(rf"  movej\({pose}, a={number}, v={number}\)", approach)
    parsed = [
        re.fullmatch(rf"  servoj\({pose}, t=(0\.008), lookahead_time={number}, gain=\d+\)", line) for line in follow
    ]
    q = np.array([[float(x) for x in line[1].split(", ")] for line in parsed if line])
    assert len(parsed) == len(q) == 126
    np.testing.assert_allclose(q, series(0.008 * np.arange(126))[0], atol=1e-6)


def test_a_load_is_what_it_adds_to_the_torque(chain: Chain) -> None:
    load = np.array([1.2, 0.1, -0.05, 0.2, 0.03, 0.001, 0.04, 0.002, -0.003, 0.02])
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 20, 2))
    links = np.array(chain.links)
    heavy = links + np.array([np.zeros(10), chain.load_in_link @ load])
    more = rigid_body.inverse_dynamics(chain.tree, heavy, q, dq, ddq) - chain.inverse_dynamics(q, dq, ddq)
    model = Load(chain)
    assert model.names[0] == "load.mass"
    still = np.zeros_like(q)
    weight = -np.einsum("ban,a->bn", np.asarray(chain.jacobian(q))[:, :3], np.asarray(chain.tree.gravity))
    np.testing.assert_allclose(model.observation_matrix(q, still, still)[..., 0], weight, atol=1e-12)
    np.testing.assert_allclose(model.observation_matrix(q, dq, ddq) @ load, more, atol=1e-12)
    with pytest.raises(ValueError, match="bears a load"):
        Load(Chain(parse_urdf(TEXT), tip="base"))


def test_some_columns_are_those_of_the_model(chain: Chain) -> None:
    wanted = [chain.names[k] for k in (3, 1)]
    model = Selected(chain, wanted)
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 20, 2))
    assert set(model.names) == set(wanted)
    columns = np.asarray(chain.observation_matrix(q, dq, ddq))[..., [1, 3]]
    np.testing.assert_array_equal(model.observation_matrix(q, dq, ddq), columns)
    assert model.roles == tuple(chain.roles[k] for k in (1, 3))


def test_limits_are_the_files_where_none_are_given(chain: Chain) -> None:
    found = completed(Limits(velocity=1.5), chain)
    np.testing.assert_array_equal(found.position, [[-2.6, -2.6], [2.6, 2.6]])
    assert found.velocity == 1.5
    np.testing.assert_array_equal(found.torque, [8.0, 1.6])
    assert found.acceleration == np.inf
    geared = Chain(parse_urdf(TEXT), gear=10.0, sign={"elbow": -1}, zero={"elbow": 0.6})
    found = completed(Limits(), geared)
    np.testing.assert_allclose(found.position, [[-26, -20], [26, 32]])
    np.testing.assert_allclose(found.velocity, 30)
    np.testing.assert_allclose(found.torque, [0.8, 0.16])
    coupled = Chain(parse_urdf(TEXT), coupling=[[1, 0], [-1, 1]])
    with pytest.raises(ValueError, match="motors that share joints"):
        completed(Limits(), coupled)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"columns": ["link1.mas"]}, "columns has 'link1.mas'"),
        ({"columns": []}, "columns is empty"),
        ({"scale": "units"}, "scale is 'units': write 'unit'"),
        ({"method": "python", "encoder": Encoder(0.1, 100, 10)}, "knows no encoder"),
        ({"method": "lbfgsb", "clearance": 0}, "keeps no clearance"),
        ({"limits": Limits(torque=(1e-3, 1.6)), "method": "python"}, "limits.torque: even at rest joint 1 needs"),
        ({"clearance": 3.0}, "clearance of .* is kept in no position"),
    ],
)
def test_errors_name_the_cause(chain: Chain, settings: dict[str, Any], message: str) -> None:
    if "clearance" in settings:
        settings |= {"clearance": Clearance.of(chain, planes=[Plane(offset=settings["clearance"])])}
    with pytest.raises(ValueError, match=message):
        design_excitation(chain, rest=True, harmonics=4, period=5, starts=2, **settings)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("harmonics = 4", 'identify = "human"', "write 'load', or a list of parameters"),
        ("harmonics = 4", 'identify = ["link1.mass", "link9.mass"]', "columns has"),
        ("harmonics = 4", "joints = 2", "the URDF says what joints there are"),
        ("table = 0.02", "walls = { left = [1, 0] }", "clearance.walls.left is"),
        ("table = 0.02", 'ignore = [["base"]]', "clearance.ignore lists pairs"),
        ("table = 0.02", "tabel = 0.02", "did you mean 'table'"),
        ('"robot.urdf"', '"lost.urdf"', "lost.urdf cannot be read"),
    ],
)
def test_a_wrong_job_names_the_key(folder: Path, old: str, new: str, message: str) -> None:
    assert old in JOB
    with pytest.raises(ValueError, match=message):
        parse_design_job(JOB.replace(old, new), folder).run()


def test_a_clearance_needs_a_urdf() -> None:
    with pytest.raises(ValueError, match=r"it needs \[model.robot\] with a urdf"):
        parse_design_job("[model]\nhuman = true\n[clearance]\ntable = 0.0\n")


@pytest.mark.slow
def test_small_models_have_the_same_motion_by_either_search() -> None:
    """The human joint, whose floor is known."""
    design = design_excitation(HumanJoint(offset=False), limits=Limits(position=(-0.5, 0.5)), method="python", starts=8)
    assert design.condition == pytest.approx(np.sqrt(3), rel=1e-3)


@pytest.mark.slow
def test_a_load_at_the_tip_of_six_joints() -> None:
    chain = Chain.from_urdf(SIX_JOINT_ARM, tip="tool")
    design = design_excitation(Load(chain), moved=chain, limits=Limits(acceleration=5), rest=True, starts=8)
    q, dq, ddq = (np.asarray(x) for x in design.trajectory(np.arange(FINE) * 10.0 / FINE))
    assert (np.abs(chain.inverse_dynamics(q, dq, ddq)) <= chain.limits.effort * (1 + 1e-9)).all()
    W = np.asarray(Load(chain).observation_matrix(q, dq, ddq)).reshape(-1, 10)
    assert design.condition == pytest.approx(np.linalg.cond(W), rel=1e-6)
    assert design.condition < 20
