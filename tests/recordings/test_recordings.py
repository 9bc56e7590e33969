"""Recordings: units, saving, the table of a job file, real ones, and what is refused."""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from factories.recordings import CHANNELS, MAPPING, assert_equal, matches, signals, write_csv
from jaximp.recordings.load import load_recording, recording_from_arrays, recording_from_mapping
from jaximp.recordings.mapping import KEYS
from jaximp.recordings.save import save_recording
from jaximp.types import Recording

# --- units ------------------------------------------------------------------------------------------------------------

DEG = np.pi / 180


@pytest.mark.parametrize(
    ("channel", "joint", "entry", "factor"),
    [
        pytest.param("position", "revolute", {}, 1, id="si"),
        pytest.param("position", "revolute", {"unit": "deg"}, DEG, id="deg"),
        pytest.param("position", "revolute", {"unit": "mrad", "sign": -1}, -1e-3, id="sign"),
        pytest.param("position", "prismatic", {"unit": "mm"}, 1e-3, id="mm"),
        pytest.param("position", "revolute", {"unit": "count", "gain": "0.002 rad/count"}, 0.002, id="encoder-counts"),
        pytest.param("position", "revolute", {"gain": "0.5 deg"}, 0.5 * DEG, id="gain-of-a-bare-column"),
        pytest.param("velocity", "revolute", {"unit": "rpm"}, 2 * np.pi / 60, id="rpm"),
        pytest.param("velocity", "revolute", {"unit": "deg/s"}, DEG, id="deg-per-s"),
        pytest.param("acceleration", "prismatic", {"unit": "mm/s^2"}, 1e-3, id="mm-per-s2"),
        pytest.param("torque", "revolute", {"unit": "Nm"}, 1, id="Nm"),
        pytest.param("torque", "revolute", {"unit": "mNm"}, 1e-3, id="mNm"),
        pytest.param("torque", "revolute", {"unit": "N*cm"}, 1e-2, id="N-cm"),
        pytest.param("torque", "revolute", {"gain": 35.0}, 35, id="bare-gain"),
        pytest.param("torque", "revolute", {"gain": "35", "unit": "mN m"}, 0.035, id="bare-gain-unit-of-product"),
        pytest.param("torque", "prismatic", {"unit": "V", "gain": "35.1507 N/V"}, 35.1507, id="gain-with-unit"),
        pytest.param("torque", "revolute", {"unit": "mA", "gain": "2 (N m)/A"}, 2e-3, id="torque-constant"),
        pytest.param("force", "revolute", {"unit": "kgf"}, 9.80665, id="force"),
        pytest.param("reference", "prismatic", {"unit": "cm"}, 1e-2, id="reference"),
        pytest.param("command", "prismatic", {"unit": "kN"}, 1e3, id="command"),
    ],
)
def test_units(tmp_path: Path, channel: str, joint: str, entry: dict[str, Any], factor: float) -> None:
    path = tmp_path / "a.npz"
    columns = signals()
    np.savez(path, **columns, x=columns["q"])
    mapping = MAPPING | {channel: {"column": "x", **entry}}
    values = getattr(load_recording(path, **mapping, joint=joint), channel)
    np.testing.assert_allclose(values[:, 0], factor * columns["q"], rtol=1e-14)


def test_time_in_milliseconds_and_mixed_joints(tmp_path: Path) -> None:
    columns = signals()
    path = tmp_path / "a.npz"
    np.savez(
        path, t=1000 * columns["t"], q=np.c_[columns["q"], columns["q"]], tau=np.c_[columns["tau"], columns["tau"]]
    )
    mapping = MAPPING | {"time": {"column": "t", "unit": "ms"}}
    recording = load_recording(path, **mapping, joint=["revolute", "prismatic"])
    np.testing.assert_allclose(recording.time, columns["t"], atol=1e-12)
    assert recording.joints == ("revolute", "prismatic")


def test_gear_ratio_brings_motor_columns_to_the_joint(tmp_path: Path) -> None:
    columns = signals()
    np.savez(tmp_path / "a.npz", **columns)
    everything = MAPPING | dict.fromkeys(("velocity", "acceleration", "reference", "command", "force"), "q")
    recording = load_recording(tmp_path / "a.npz", **everything, gear_ratio=4)
    for channel in ("position", "velocity", "acceleration", "reference"):
        np.testing.assert_allclose(getattr(recording, channel)[:, 0], columns["q"] / 4)
    np.testing.assert_allclose(recording.torque[:, 0], columns["tau"] * 4)
    np.testing.assert_allclose(recording.command[:, 0], columns["q"] * 4)
    np.testing.assert_allclose(recording.force[:, 0], columns["q"])


@given(q=hnp.arrays(float, 10, elements=st.floats(-1e6, 1e6), unique=True))
@settings(max_examples=25, deadline=None, derandomize=True)
def test_degrees_and_radians_agree(tmp_path_factory: pytest.TempPathFactory, q: np.ndarray) -> None:
    path = tmp_path_factory.mktemp("units") / "a.npz"
    np.savez(path, rad=q, deg=np.rad2deg(q), tau=q)
    in_rad = load_recording(path, sample_rate=100, position="rad", torque="tau")
    in_deg = load_recording(path, sample_rate=100, position={"column": "deg", "unit": "deg"}, torque="tau")
    np.testing.assert_allclose(in_deg.position, in_rad.position, rtol=1e-14, atol=1e-300)


def test_si_units_need_no_unit_library(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", **signals())
    code = (
        "import sys; from jaximp.recordings.load import load_recording as load;"
        "heavy = {'pint', 'pandas', 'pyarrow', 'h5py'}; assert not heavy & set(sys.modules), 'at import';"
        "load('a.npz', time='t', position={'column': 'q', 'unit': 'rad'}, torque={'column': 'tau', 'unit': 'Nm'});"
        "assert not heavy & set(sys.modules), 'after loading'"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# --- saving -----------------------------------------------------------------------------------------------------------

finite = st.floats(allow_nan=False, allow_infinity=False, width=64)


@st.composite
def recordings(draw: st.DrawFn) -> Recording:
    size, n = draw(st.integers(3, 20)), draw(st.integers(1, 3))
    matrices = hnp.arrays(np.float64, (size, n), elements=finite)
    moving = matrices.filter(lambda values: (np.ptp(values[:3] / 4, axis=0) > 0).any())
    optional = {c: draw(st.none() | matrices) for c in ("velocity", "acceleration", "force", "reference", "command")}
    position, torque = draw(moving), draw(moving)
    masked = draw(st.lists(st.integers(3, max(3, size - 1)), max_size=3))
    position[[row for row in masked if row < size]] = np.nan
    joint = draw(st.lists(st.sampled_from(["revolute", "prismatic"]), min_size=n, max_size=n))
    time = draw(st.sampled_from([0.0, 0.1, -5.0, 1.7e9])) + np.arange(size) / draw(
        st.sampled_from([3, 100, 1000, 1024])
    )
    return recording_from_arrays(time, position, torque, **optional, joint=joint)


def mapping_of_saved(recording: Recording) -> dict[str, Any]:
    units = {
        "revolute": {"position": "rad", "torque": "Nm", "velocity": "rad_s", "acceleration": "rad_s2"},
        "prismatic": {"position": "m", "torque": "N", "velocity": "m_s", "acceleration": "m_s2"},
    }
    mapping: dict[str, Any] = {"time": "time_s", "joint": recording.joints}
    for channel in CHANNELS:
        values = getattr(recording, channel)
        if values is not None:
            numbers = range(1, values.shape[1] + 1) if values.shape[1] > 1 else [""]
            kind = {"reference": "position", "command": "torque"}.get(channel, channel)
            suffixes = ["N" if channel == "force" else units[joint][kind] for joint in recording.joints]
            mapping[channel] = [f"{channel}{k}_{suffix}" for k, suffix in zip(numbers, suffixes, strict=True)]
    return mapping


# The check of annotations draws random elements of long tuples, which hypothesis notices.
@pytest.mark.filterwarnings("ignore:Do not use the `random` module")
@pytest.mark.parametrize("extension", ["csv", "parquet"])
@given(recording=recordings())
@settings(max_examples=40, deadline=None, derandomize=True)
def test_saved_recording_reads_back_equal(
    tmp_path_factory: pytest.TempPathFactory, extension: str, recording: Recording
) -> None:
    folder = tmp_path_factory.mktemp("saved")
    path = folder / f"a.{extension}"
    save_recording(recording, path)
    assert os.listdir(folder) == [path.name]
    assert_equal(load_recording(path, **mapping_of_saved(recording)), recording)


def test_saving_to_an_unknown_format_names_the_known_ones(tmp_path: Path) -> None:
    columns = signals()
    with pytest.raises(ValueError, match=matches("use one of: .csv, .parquet")):
        save_recording(recording_from_arrays(columns["t"], columns["q"], columns["tau"]), tmp_path / "a.xlsx")
    assert os.listdir(tmp_path) == []


# --- what is refused --------------------------------------------------------------------------------------------------


def changed(**columns: Any) -> dict[str, Any]:
    """The signals with single values replaced: `q={3: nan}`, or whole columns."""
    table: dict[str, Any] = {name: values.tolist() for name, values in signals().items()}
    for name, change in columns.items():
        if isinstance(change, dict):
            for row, value in change.items():
                table[name][row] = value
        else:
            table[name] = list(change)
    return table


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        pytest.param(changed(t={7: 0.06}), "'t', row 8: the time stamp 0.06 s repeats the one before", id="repeated"),
        pytest.param(changed(t={7: 0.01}), "'t', row 8: the time stamp 0.01 s steps backwards", id="backwards"),
        pytest.param(changed(t={7: NAN}), "'t', row 8: the time stamp is nan", id="nan-time"),
        pytest.param(changed(t={7: INF}), "'t', row 8: the time stamp is inf", id="inf-time"),
        pytest.param(changed(q={2: INF}), "column 'q', row 3: the value is infinite", id="inf"),
        pytest.param(changed(q=[NAN] * 50), "column 'q' is NaN throughout", id="all-nan"),
        pytest.param(changed(q=[NAN] * 48 + [1, 2]), "only 2 of 50 samples are usable", id="nearly-all-nan"),
        pytest.param(changed(q=[0.25] * 50), "column 'q' is constant (0.25): the joint did not move", id="resting"),
        pytest.param(changed(tau=[0] * 50), "column 'tau' is constant (0): nothing was measured", id="dead-sensor"),
        pytest.param(
            changed(t={49: 1e9}), "after row 49 would fill the uniform grid with 2e+09 times", id="hostile-gap"
        ),
        pytest.param(changed(t=np.arange(50) * 1e-320), "correct the unit of time", id="impossible-rate"),
        pytest.param(changed(tau={4: "1,5"}), "is not a number", id="decimal-comma"),
        pytest.param(changed(tau={4: "broken"}), "column 'tau', row 5: 'broken' is not a number", id="text"),
        pytest.param(changed(tau={4: "1_0"}), "column 'tau', row 5: '1_0' is not a number", id="underscore"),
        pytest.param(changed(tau={4: "1,5,6"}), "the first is row 5 (it has 5 fields, the others 3", id="ragged"),
        pytest.param({"t": [], "q": [], "tau": []}, "has 0 samples; at least 3 are needed", id="header-only"),
        pytest.param({"t": [0, 1], "q": [0, 1], "tau": [0, 1]}, "has 2 samples; at least 3", id="too-short"),
        pytest.param({"t": [0], "angle": [0], "tau": [0]}, "column 'q' is not there; there are: 't',", id="no-column"),
    ],
)
def test_bad_data(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    delimiter = ";" if "1,5" in columns["tau"] else ","
    path = write_csv(tmp_path / "a.csv", columns, delimiter)
    with pytest.raises(ValueError, match=matches(message)) as caught:
        load_recording(path, **MAPPING)
    assert str(caught.value).startswith(f"{path}: ")


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("change", "message"),
    [
        pytest.param({"position": "q_1"}, "column 'q_1' is not there; did you mean 'q1'?", id="nearest-column"),
        pytest.param({"time": None}, "give either 'time' (a column) or 'sample_rate'", id="no-clock"),
        pytest.param({"sample_rate": 100}, "give either 'time' (a column) or 'sample_rate'", id="two-clocks"),
        pytest.param({"time": None, "sample_rate": 0}, "sample_rate must be one positive number", id="zero-rate"),
        pytest.param({"time": None, "sample_rate": "q1"}, "sample_rate must be one positive number", id="vector-rate"),
        pytest.param({"time": ["t", "q1"]}, "time has 2 columns", id="two-times"),
        pytest.param({"position": None}, "position: None names no column", id="no-position"),
        pytest.param({"position": 3}, "column 3: numbers are for text files", id="number-for-a-column"),
        pytest.param({"position": 0}, "position: 0 names no column", id="number-below-one"),
        pytest.param({"position": []}, "position: [] names no column", id="empty-list"),
        pytest.param({"position": {"column": "q1", "unti": "deg"}}, "did you mean 'unit'?", id="unknown-key"),
        pytest.param({"time": {"column": "t", "sign": -1}}, "time: unknown key 'sign'", id="sign-of-time"),
        pytest.param({"position": {"column": "q1", "unit": 1}}, "position: the unit must be text", id="unit-type"),
        pytest.param({"position": {"column": "q1", "unit": "dge"}}, "position: unknown unit 'dge'", id="unknown-unit"),
        pytest.param({"position": {"column": "q1", "unit": "9**9**9"}}, "unknown unit '9**9**9'", id="hostile-unit"),
        pytest.param({"position": {"column": "q1", "unit": "mm"}}, "'mm' does not convert to 'rad'", id="length"),
        pytest.param({"velocity": {"column": "q1", "unit": "Hz"}}, "'Hz' does not convert to 'rad/s'", id="hertz"),
        pytest.param({"torque": {"column": "q1", "gain": "3 N/V"}}, "does not convert to 'N m'", id="gain-unit"),
        pytest.param({"torque": {"column": "q1", "gain": "__import__('os')"}}, "gain must be a number", id="gain-text"),
        pytest.param({"torque": {"column": "q1", "gain": 0}}, "gain must be a number other than 0", id="gain-zero"),
        pytest.param({"torque": {"column": "q1", "sign": 2}}, "sign must be 1 or -1, not 2", id="sign"),
        pytest.param({"gear_ratio": 0}, "gear_ratio must be a positive number, not 0", id="gear-zero"),
        pytest.param({"gear_ratio": "6"}, "gear_ratio must be a positive number, not '6'", id="gear-text"),
        pytest.param({"joint": "revolut"}, "did you mean 'revolute'?", id="joint"),
        pytest.param({"joint": ["revolute"] * 2}, "2 types for 1 position columns", id="joint-count"),
        pytest.param({"velocity": ["q1", "tau"]}, "velocity has 2 columns for 1 joints", id="joint-columns"),
        pytest.param(
            {"position": {"column": "knee_deg", "unit": "rad"}},
            "column 'knee_deg' says 'deg', and the mapping 'rad'; write unit = \"deg\", or if the name is wrong: "
            'position = {column = "knee_deg", unit = "rad", despite_name = true}',
            id="suffix",
        ),
        pytest.param({"velocity": "knee_rad"}, "'knee_rad' says 'rad', but without a unit", id="suffix-rad"),
        pytest.param({"position": "short"}, "'t' has 50 samples, but 'short' has 40", id="lengths"),
        pytest.param({"position": ["q1", "short"]}, "'q1' has 50 samples, but 'short' has 40", id="lengths-in-list"),
        pytest.param({"position": "words"}, "'words' does not hold real numbers", id="text-variable"),
        pytest.param({"position": "cube"}, "'cube' has shape (50, 1, 1)", id="three-dimensional"),
    ],
)
def test_bad_mapping(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    columns = signals()
    q = columns.pop("q")
    more = {"knee_deg": q, "knee_rad": q, "short": q[:40], "words": np.array(["a"] * 50), "cube": q[:, None, None]}
    np.savez(tmp_path / "a.npz", **columns, q1=q, **more)
    mapping = {"time": "t", "position": "q1", "torque": "tau"}
    with pytest.raises(ValueError, match=matches(message)):
        load_recording(tmp_path / "a.npz", **(mapping | change))


@pytest.mark.parametrize("suffix", ["mrad", "rad"])
def test_a_stated_unit_wins_over_a_name_that_is_said_to_be_wrong(tmp_path: Path, suffix: str) -> None:
    columns = signals()
    np.savez(tmp_path / "a.npz", **columns, **{f"x_{suffix}": columns["q"]})
    entry = {"column": f"x_{suffix}", "unit": "deg", "despite_name": True}
    recording = load_recording(tmp_path / "a.npz", **(MAPPING | {"position": entry}))
    np.testing.assert_allclose(recording.position[:, 0], columns["q"] * DEG)


# --- the table of a job file ------------------------------------------------------------------------------------------


def test_mapping_of_a_job_file(tmp_path: Path) -> None:
    columns = signals()
    write_csv(tmp_path / "run.csv", columns)
    recording = recording_from_mapping({"file": "run.csv", **MAPPING}, tmp_path)
    assert_equal(recording, recording_from_arrays(columns["t"], columns["q"], columns["tau"]))
    assert recording.name == "run"


def test_the_keys_of_a_mapping_are_the_keywords_of_load_recording() -> None:
    assert tuple(inspect.signature(load_recording).parameters) == ("path", *KEYS)


@pytest.mark.parametrize(
    ("table", "message"),
    [
        pytest.param(
            {"file": "a.csv", "positon": "q"}, "unknown key 'positon'; did you mean 'position'?", id="unknown"
        ),
        pytest.param({"position": "q", "torque": "tau"}, "'file' is missing", id="no-file"),
        pytest.param({"file": "a.csv", "position": "q"}, "'torque' is missing", id="no-torque"),
        pytest.param({"file": 1, "position": "q", "torque": "tau"}, "'file' must be a path in quotes", id="file-type"),
    ],
)
def test_bad_tables(tmp_path: Path, table: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=matches(message)):
        recording_from_mapping(table, tmp_path)


def test_one_file_has_one_time_base(tmp_path: Path) -> None:
    np.savez(tmp_path / "t.npz", q=np.random.default_rng(0).normal(size=(99, 2)), f=np.zeros((50, 2)))
    columns: dict[str, Any] = {"sample_rate": 1000.0, "joint": "prismatic", "position": "q"}
    with pytest.raises(ValueError, match=r"'q\[1\]' has 99 samples, but 'f\[1\]' has 50; .*one time base"):
        load_recording(tmp_path / "t.npz", torque="f", **columns)


def test_a_command_is_a_force(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    recording = recording_from_arrays(
        np.arange(9) / 10, rng.normal(size=9), rng.normal(size=9), command=rng.normal(size=9)
    )
    save_recording(recording, tmp_path / "r.csv")
    columns: dict[str, Any] = {"time": "time_s", "position": "position_rad", "torque": "torque_Nm"}
    command = {"column": "command_Nm", "unit": "mN m", "despite_name": True}
    read = load_recording(tmp_path / "r.csv", command=command, gear_ratio=2.0, **columns)
    np.testing.assert_allclose(read.command, 2e-3 * np.asarray(recording.command))
    with pytest.raises(ValueError, match="command: unit 'deg' does not convert"):
        load_recording(tmp_path / "r.csv", command=command | {"unit": "deg"}, **columns)


# --- real recordings --------------------------------------------------------------------------------------------------


def test_emps(data_folder: Path) -> None:
    drive = {"column": "vir", "unit": "V", "gain": "35.1507 N/V"}
    path = data_folder / "emps" / "DATA_EMPS.mat"
    recording = load_recording(path, joint="prismatic", time="t", position="qm", reference="qg", torque=drive)
    assert recording.position.shape == recording.torque.shape == (24841, 1)
    assert recording.sample_rate == pytest.approx(1000, rel=1e-6)
    assert recording.notes == ()
    raw = scipy.io.loadmat(path)
    np.testing.assert_allclose(recording.torque, 35.1507 * raw["vir"], rtol=1e-14)


def test_ankle(data_folder: Path) -> None:
    channels: dict[str, Any] = {"position": "position_rad", "torque": {"column": "torque_Nm", "sign": -1}}
    clean = load_recording(data_folder / "ankle" / "z_df2.csv", time="time_s", **channels)
    assert (len(clean), clean.sample_rate, clean.notes) == (60000, pytest.approx(1000), ())
    assert clean.torque[0, 0] == 2.93377161
    reflex = load_recording(data_folder / "ankle" / "z_pf.npz", sample_rate="sample_rate_Hz", **channels)
    assert (len(reflex), reflex.sample_rate, reflex.notes) == (60000, pytest.approx(1000), ())


def test_double_pendulum(data_folder: Path) -> None:
    files = sorted((data_folder / "double_pendulum").glob("*.csv"))
    assert len(files) == 4
    columns = {"position": ["pos1", "pos2"], "torque": ["tau1", "tau2"], "velocity": ["vel1", "vel2"]}
    for file in files:
        recording = load_recording(file, time="time", **columns)
        assert recording.n_joints == 2
        assert recording.sample_rate == pytest.approx(200, rel=1e-3)
        assert recording.valid.all()
