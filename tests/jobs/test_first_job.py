"""A first job for a recording, by the names of its columns and what it shows."""

from __future__ import annotations

import tomllib
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

from command_line import jaximp
from factories.joints import joint
from jaximp.jobs.first_job import Columns, find_columns, first_job, read_job_or_recording, words_of
from jaximp.jobs.job import parse_job
from jaximp.recordings.readers.contents import columns_in

TIME = np.arange(1500) / 250.0


def table(position: str = "angle (rad)", torque: str = "torque [Nm]", **others: np.ndarray) -> pd.DataFrame:
    recording = joint(TIME)
    columns = {"Time (s)": TIME, position: recording.position[:, 0], torque: recording.torque[:, 0]}
    return pd.DataFrame(columns | others)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("JointAngle_2 (deg)", ["joint", "angle"]),
        ("tau", ["tau"]),
        ("motorTorque [Nm]", ["motor", "torque"]),
        ("q1", ["q"]),
        ("data.pos", ["data", "pos"]),
        ("TORQUE", ["torque"]),
    ],
)
def test_words_of_a_name(name: str, words: list[str]) -> None:
    assert words_of(name) == words


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["t", "q", "tau"], Columns("t", ("q",), ("tau",))),
        (["Time (ms)", "Angle (deg)", "Moment (Nm)"], Columns("Time (ms)", ("Angle (deg)",), ("Moment (Nm)",))),
        (["time", "pos1", "pos2", "vel1", "tau1", "tau2"], Columns("time", ("pos1", "pos2"), ("tau1", "tau2"))),
        (["t", "q", "q_des", "tau", "tau_cmd"], Columns("t", ("q",), ("tau",))),
        (["q", "tau"], Columns(None, ("q",), ("tau",))),
        (["timestamp", "position", "encoder", "effort"], Columns("timestamp", ("position",), ("effort",))),
    ],
)
def test_columns_are_found_by_their_names(names: list[str], expected: Columns) -> None:
    assert find_columns(dict.fromkeys(names, 1)) == expected


@pytest.mark.parametrize(
    ("names", "given", "message"),
    [
        (["t", "knee_angle", "hip_angle", "torque"], {}, "could each be the position: name one by --position"),
        (["t", "q1", "q2", "tau1"], {}, "do not match"),
        (["t", "x", "tau"], {}, "no column looks like the position; name it by --position NAME; there are: t, x, tau"),
        (["stamp", "clock", "q", "tau"], {}, "could each be the time: name one by --time"),
    ],
)
def test_what_is_not_beyond_doubt_is_asked_for(names: list[str], given: dict[str, list[str]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        find_columns(dict.fromkeys(names, 1), **given)


def test_what_is_given_is_taken() -> None:
    found = find_columns(dict.fromkeys(["t", "knee", "hip", "moment"], 1), position=["knee"])
    assert found.position == ("knee",)


def test_files_say_what_they_hold(tmp_path: Path) -> None:
    q, scalar = np.zeros((50, 2)), np.ones(1)
    savemat(tmp_path / "a.mat", {"q": q, "t": np.arange(50.0), "fs": scalar, "log": {"tau": q}})
    np.savez(tmp_path / "a.npz", q=q, t=np.arange(50.0), fs=scalar)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["run/q"], file["t"] = q, np.arange(50.0)
    table().to_csv(tmp_path / "a.csv", index=False)
    table().to_parquet(tmp_path / "a.parquet")
    (tmp_path / "b.csv").write_text("0.0,1.0\n0.1,2.0\n0.2,3.0\n")
    assert columns_in(tmp_path / "a.mat") == {"q": 2, "t": 1, "log.tau": 2}
    assert columns_in(tmp_path / "a.npz") == {"q": 2, "t": 1}
    assert columns_in(tmp_path / "a.h5") == {"run/q": 2, "t": 1}
    assert list(columns_in(tmp_path / "a.csv")) == list(columns_in(tmp_path / "a.parquet")) == list(table())
    assert list(columns_in(tmp_path / "b.csv")) == ["1", "2"]
    with pytest.raises(FileNotFoundError, match="no such file"):
        columns_in(tmp_path / "none.csv")
    (tmp_path / "a.doc").write_text("no")
    with pytest.raises(ValueError, match=r"cannot look into '\.doc' files"):
        columns_in(tmp_path / "a.doc")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of a torque that is turned round, and an angle in degrees whose unit nobody said."""
    folder = tmp_path_factory.mktemp("init")
    whole = table("angle", "moment")
    whole["angle"], whole["moment"] = np.degrees(whole["angle"]), -whole["moment"]
    whole.to_csv(folder / "knee 1.csv", index=False)
    return first_job(folder / "knee 1.csv", {})


@pytest.mark.slow
@pytest.mark.compiles
def test_a_first_job_can_be_run_and_says_what_it_took(written: str) -> None:
    found = tomllib.loads(written)
    assert found["recording"]["file"] == "knee 1.csv"
    assert found["recording"]["position"] == {"columns": ["angle"], "unit": "deg"}
    assert found["recording"]["torque"]["sign"] == -1
    assert found["filter"]["position_cutoff"] > found["filter"]["decimation_cutoff"] > 0
    assert found["window"]["length"] > 0
    assert "no unit is said" in written
    parse_job(written)


@pytest.mark.slow
@pytest.mark.compiles
def test_init_writes_beside_the_recording_and_replaces_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table().to_csv(tmp_path / "a.csv", index=False)
    assert jaximp("init", tmp_path / "a.csv") == 0
    job = (tmp_path / "a.toml").read_text()
    assert tomllib.loads(job)["recording"]["time"] == "Time (s)"
    assert jaximp("init", tmp_path / "a.csv") == 1
    assert "pass --force" in capsys.readouterr().err
    assert read_job_or_recording(tmp_path / "a.csv").text == job == read_job_or_recording(tmp_path / "a.toml").text


def test_a_unit_that_nobody_said_is_no_matter_for_identify(tmp_path: Path) -> None:
    table("angle").to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(ValueError, match="the unit of angle is not said: run `jaximp init"):
        read_job_or_recording(tmp_path / "a.csv")


def test_a_file_without_time_needs_its_rate(tmp_path: Path) -> None:
    table().drop(columns="Time (s)").to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(ValueError, match="--sample-rate HZ"):
        first_job(tmp_path / "a.csv", {})
