"""Formats of motion capture, LabVIEW, OpenSim, spreadsheets and ROS: written by their own libraries, read as they are.

What needs a library of the extra `formats` is skipped where it is missing.
"""

from __future__ import annotations

import json
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factories.recordings import MAPPING, matches, signals
from jaximp.recordings import load_recording
from jaximp.recordings.readers.contents import columns_in
from jaximp.recordings.readers.formats import count_samples

COLUMNS = signals()
ROWS = np.column_stack(list(COLUMNS.values())).tolist()
DEG = np.pi / 180


def assert_columns(recording: Any, factor: float = 1.0, rtol: float = 0.0) -> None:
    np.testing.assert_allclose(recording.time, COLUMNS["t"], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(recording.position[:, 0], factor * COLUMNS["q"], rtol=rtol, atol=rtol)
    np.testing.assert_allclose(recording.torque[:, 0], COLUMNS["tau"], rtol=rtol, atol=rtol)


def lines(separator: str = "\t") -> str:
    return "".join(separator.join(map(repr, row)) + "\n" for row in ROWS)


@pytest.mark.parametrize(("in_degrees", "factor"), [("no", 1.0), ("yes", DEG)])
@pytest.mark.parametrize("extension", ["sto", "mot"])
def test_opensim(tmp_path: Path, extension: str, in_degrees: str, factor: float) -> None:
    head = (
        f"Coordinates\nversion=1\nnRows=50\nnColumns=3\ninDegrees={in_degrees}\nendheader\ntime\tankle_angle_r\ttau\n"
    )
    path = tmp_path / f"a.{extension}"
    path.write_text(head + lines())
    recording = load_recording(path, time="time", position="ankle_angle_r", torque="tau")
    assert_columns(recording, factor, 1e-14)
    assert any("its angles are in 'deg'" in note for note in recording.notes) == (factor != 1)
    assert count_samples(path, ["time"]) == 50


def test_labview(tmp_path: Path) -> None:
    head = (
        "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\nSeparator\tTab\nDecimal_Separator\t.\n"
        "Multi_Headings\tNo\nX_Columns\tOne\nTime_Pref\tAbsolute\nDate\t2024/03/01\nTime\t12:00:00.123456\n"
        "***End_of_Header***\t\n\nChannels\t2\t\t\nSamples\t50\t50\t\nDate\t2024/03/01\t2024/03/01\t\n"
        "Time\t12:00:00.123456\t12:00:00.123456\t\nY_Unit_Label\trad\tNm\t\nX_Dimension\tTime\tTime\t\nX0\t0.0\t0.0\t\n"
        "Delta_X\t0.010000\t0.010000\t\n***End_of_Header***\t\t\t\nX_Value\tangle\ttorque\tComment\n"
    )
    (tmp_path / "a.lvm").write_text(head + lines())
    assert_columns(load_recording(tmp_path / "a.lvm", time="X_Value", position="angle", torque="torque"))
    (tmp_path / "a.lvm").write_text(head.replace("r\t.", "r\t,") + lines().replace(".", ","))
    assert_columns(load_recording(tmp_path / "a.lvm", time="X_Value", position="angle", torque="torque"))


def test_json_lines(tmp_path: Path) -> None:
    rows = [{"t": a, "state": {"q": [0.0, b]}, "tau": c} for a, b, c in ROWS]
    rows[7]["tau"] = None
    (tmp_path / "a.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    recording = load_recording(tmp_path / "a.jsonl", time="t", position="state.q[2]", torque="tau")
    np.testing.assert_array_equal(recording.position[recording.valid, 0], np.delete(COLUMNS["q"], 7))
    assert np.flatnonzero(~recording.valid).tolist() == [7]
    assert count_samples(tmp_path / "a.jsonl", ["t"]) >= 50
    with pytest.raises(ValueError, match=matches("column 'tua' is not there; did you mean 'tau'?")):
        load_recording(tmp_path / "a.jsonl", time="t", position="state.q[2]", torque="tua")


# --- spreadsheets -----------------------------------------------------------------------------------------------------

NAMESPACE = "http://schemas.openxmlformats.org/"


def write_workbook(path: Path, sheets: dict[str, list[list[Any]]]) -> None:
    """The least that is a workbook: numbers and texts."""

    def cell(value: Any) -> str:
        return f'<c t="inlineStr"><is><t>{value}</t></is></c>' if isinstance(value, str) else f"<c><v>{value!r}</v></c>"

    relations = f"{NAMESPACE}officeDocument/2006/relationships"
    main = f'xmlns="{NAMESPACE}spreadsheetml/2006/main" xmlns:r="{relations}"'
    package = f'xmlns="{NAMESPACE}package/2006/relationships"'
    with zipfile.ZipFile(path, "w") as archive:
        kind = "application/vnd.openxmlformats-officedocument.spreadsheetml.sheet.main+xml"
        archive.writestr(
            "[Content_Types].xml",
            f'<Types xmlns="{NAMESPACE}package/2006/content-types"><Override PartName="/xl/workbook.xml" '
            f'ContentType="{kind}"/></Types>',
        )
        book = f'<Relationship Id="r" Type="{relations}/officeDocument" Target="xl/workbook.xml"/>'
        archive.writestr("_rels/.rels", f"<Relationships {package}>{book}</Relationships>")
        named, linked = "", ""
        for k, (name, rows) in enumerate(sheets.items()):
            named += f'<sheet name="{name}" sheetId="{k + 1}" r:id="s{k}"/>'
            linked += f'<Relationship Id="s{k}" Type="{relations}/worksheet" Target="worksheets/sheet{k}.xml"/>'
            body = "".join(f"<row>{''.join(map(cell, row))}</row>" for row in rows)
            archive.writestr(
                f"xl/worksheets/sheet{k}.xml", f"<worksheet {main}><sheetData>{body}</sheetData></worksheet>"
            )
        archive.writestr("xl/workbook.xml", f"<workbook {main}><sheets>{named}</sheets></workbook>")
        archive.writestr("xl/_rels/workbook.xml.rels", f"<Relationships {package}>{linked}</Relationships>")


def test_excel(tmp_path: Path) -> None:
    pytest.importorskip("python_calamine", reason="needs python-calamine, of the extra 'formats'")
    first = [["Subject 5, ankle"], ["t", "q (deg)", "tau"], *ROWS]
    second = [["t", "q", "tau"], *[[a, 2 * b, c] for a, b, c in ROWS]]
    write_workbook(tmp_path / "a.xlsx", {"About": [["made by hand"]], "Trial 1": first, "Trial 2": second})
    recording = load_recording(tmp_path / "a.xlsx", time="t", position="q (deg)", torque="tau")
    assert_columns(recording, DEG, 1e-15)
    assert "the sheet 'Trial 1' is read, one of 3 (name another: 'Sheet2!angle')" in recording.notes
    other = load_recording(tmp_path / "a.xlsx", time="Trial 2!t", position="Trial 2!q", torque="Trial 2!tau")
    assert_columns(other, 2.0)
    assert_columns(load_recording(tmp_path / "a.xlsx", time=1, position=2, torque=3), DEG, 1e-15)
    assert count_samples(tmp_path / "a.xlsx", ["t"]) >= 50
    assert list(columns_in(tmp_path / "a.xlsx")) == ["t", "q (deg)", "tau"]
    with pytest.raises(ValueError, match=matches("sheet 'Trial 3' is not there; did you mean")):
        load_recording(tmp_path / "a.xlsx", time="Trial 3!t", position="Trial 3!q", torque="Trial 3!tau")


# --- motion capture ---------------------------------------------------------------------------------------------------


def test_c3d(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d", reason="needs ezc3d, of the extra 'formats'")
    file, ratio = ezc3d.c3d(), 5
    file["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    file["parameters"]["POINT"]["LABELS"]["value"] = ["HEEL", "RAnkleAngles"]
    file["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    file.add_parameter("POINT", "ANGLES", ["RAnkleAngles"])
    file.add_parameter("POINT", "ANGLE_UNITS", ["deg"])
    file["parameters"]["ANALOG"]["RATE"]["value"] = [500.0]
    file["parameters"]["ANALOG"]["LABELS"]["value"] = ["Mz", "EMG"]
    file["parameters"]["ANALOG"]["UNITS"]["value"] = ["Nmm", "V"]
    points = np.zeros((4, 2, 50))
    points[0, 0], points[0, 1] = 1000 * COLUMNS["q"], 50 * COLUMNS["q"]
    points[3] = 1
    fast = np.arange(50 * ratio) / 500
    analogs = np.zeros((1, 2, 50 * ratio))
    analogs[0, 0] = 1000 * np.cos(3 * fast) - 500
    file["data"]["points"], file["data"]["analogs"] = points, analogs
    file.write(str(tmp_path / "a.c3d"))
    recording = load_recording(tmp_path / "a.c3d", time="time", position="RAnkleAngles.x", torque="Mz")
    assert recording.sample_rate == pytest.approx(500)
    assert recording.valid[:-ratio].all()
    np.testing.assert_allclose(recording.torque[:-ratio, 0], np.cos(3 * fast[:-ratio]) - 0.5, atol=1e-6)
    np.testing.assert_allclose(recording.position[:200, 0], 50 * DEG * np.sin(5 * fast[:200]), atol=1e-5)
    assert "points come at 100 Hz and analog channels at 500 Hz: each point is held" in recording.notes
    assert any("changes only every 5 samples" in note for note in recording.notes)
    assert count_samples(tmp_path / "a.c3d", ["Mz"]) == 250
    points = [f"{name}.{axis}" for name in ("HEEL", "RAnkleAngles") for axis in "xyz"]
    assert list(columns_in(tmp_path / "a.c3d")) == ["time", "Mz", "EMG", *points]
    with pytest.raises(ValueError, match=matches("column 'Mx' is not there; there are: 'time', 'Mz'")):
        load_recording(tmp_path / "a.c3d", time="time", position="RAnkleAngles.x", torque="Mx")


# --- ROS --------------------------------------------------------------------------------------------------------------


def write_bag(path: Path, kind: str) -> Path:
    """Joint states at 100 Hz, and the torque of a wrench at 200 Hz; the arm has two joints."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "bag" else Stores.ROS2_HUMBLE)
    types = store.types
    extra = {"seq": 0} if kind == "bag" else {}

    def header(stamp: float) -> Any:
        nanoseconds = round(stamp * 1e9)
        time = types["builtin_interfaces/msg/Time"](sec=100 + nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
        return types["std_msgs/msg/Header"](stamp=time, frame_id="", **extra)

    plugin = {"mcap": StoragePlugin.MCAP, "db3": StoragePlugin.SQLITE3}
    writer = Writer1(path / "a.bag") if kind == "bag" else Writer2(path / "a", version=8, storage_plugin=plugin[kind])
    state, wrench, vector = (
        types[name]
        for name in ("sensor_msgs/msg/JointState", "geometry_msgs/msg/WrenchStamped", "geometry_msgs/msg/Vector3")
    )
    with writer:
        joints = writer.add_connection("/joint_states", state.__msgtype__, typestore=store)
        forces = writer.add_connection("/ft/wrench", wrench.__msgtype__, typestore=store)

        def write(connection: Any, stamp: float, message: Any) -> None:
            made = store.serialize_ros1 if kind == "bag" else store.serialize_cdr
            writer.write(connection, round((100 + stamp) * 1e9) + 3_000_000, made(message, message.__msgtype__))

        for a, b, c in ROWS:
            both = np.array([0.0, b])
            write(joints, a, state(header(a), ["elbow", "ankle"], both, both, np.array([0.0, c])))
            for k in range(2):
                zero, turn = vector(0.0, 0.0, 0.0), vector(0.0, 0.0, c + k)
                inner = types["geometry_msgs/msg/Wrench"](force=zero, torque=turn)
                write(forces, a + 0.005 * k, wrench(header(a + 0.005 * k), inner))
    return path / "a.bag" if kind == "bag" else next((path / "a").glob(f"*.{kind}"))


@pytest.mark.parametrize("kind", ["bag", "db3", "mcap"])
def test_ros(tmp_path: Path, kind: str) -> None:
    pytest.importorskip("rosbags", reason="needs rosbags, of the extra 'formats'")
    path = write_bag(tmp_path, kind)
    topic = "/joint_states"
    mapping = {"time": "time", "position": f"{topic}.position.ankle", "torque": f"{topic}.effort[2]"}
    recording = load_recording(path, **mapping)
    assert_columns(recording)
    assert recording.notes == ()
    joined = load_recording(path, **(mapping | {"torque": "/ft/wrench.wrench.torque.z"}))
    assert_columns(joined, rtol=1e-6)
    assert joined.notes[0] == "time is that of /joint_states"
    assert joined.notes[1].startswith("/ft/wrench is joined on it, linearly between its 100 messages")
    assert count_samples(path, list(mapping.values())) == 50
    states = [f"{topic}.{what}.{joint}" for what in ("position", "velocity", "effort") for joint in ("elbow", "ankle")]
    wrench = [f"/ft/wrench.wrench.{what}.{axis}" for what in ("force", "torque") for axis in "xyz"]
    assert set(columns_in(path)) == {"time", *states, *wrench}
    with pytest.raises(
        ValueError, match=matches("'position.knee' of /joint_states is not there; there are: 'elbow', 'ankle'")
    ):
        load_recording(path, **(mapping | {"position": f"{topic}.position.knee"}))
    with pytest.raises(ValueError, match=matches("the topic of column '/joint_state.position.ankle' is not there")):
        load_recording(path, **(mapping | {"position": "/joint_state.position.ankle"}))


# --- tables of MATLAB -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", ["v7", "v7.3"])
def test_a_table_of_matlab(tmp_path: Path, version: str) -> None:
    matio = pytest.importorskip("matio", reason="needs mat-io, of the extra 'formats'")
    pandas = pytest.importorskip("pandas")
    matio.save_to_mat(str(tmp_path / "a.mat"), {"log": pandas.DataFrame(COLUMNS), "t": COLUMNS["t"]}, version=version)
    assert_columns(load_recording(tmp_path / "a.mat", time="log.t", position="log.q", torque="log.tau"))
    with pytest.raises(ValueError, match=matches("field 'tua' of 'log.tua' is not there; did you mean 'tau'?")):
        load_recording(tmp_path / "a.mat", time="t", position="log.q", torque="log.tua")


# --- without the library ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("extension", "module", "package"),
    [
        ("xlsx", "python_calamine", "python-calamine"),
        ("c3d", "ezc3d", "ezc3d"),
        ("bag", "rosbags.highlevel", "rosbags"),
    ],
)
def test_a_library_that_is_missing_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, extension: str, module: str, package: str
) -> None:
    (tmp_path / f"a.{extension}").write_bytes(b"content")
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(
        ValueError, match=matches(f"need {package}, which is not installed: pip install 'jaximp[formats]'")
    ):
        load_recording(tmp_path / f"a.{extension}", **MAPPING)
