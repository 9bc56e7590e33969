"""Units in the names of columns: taken with a note, or refused with the line to write; never SI without a word."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factories.recordings import matches, signals, write_csv
from jaximp.recordings import load_recording
from jaximp.recordings.named_units import unit_in
from jaximp.types import Recording

DEG = np.pi / 180
COLUMNS = signals()


def loaded(folder: Path, names: dict[str, str], row: str = "", **mapping: Any) -> Recording:
    path = write_csv(folder / "a.csv", {names.get(name, name): values for name, values in COLUMNS.items()})
    if row:
        head, rest = path.read_text().split("\n", 1)
        path.write_text(f"{head}\n{row}\n{rest}")
    asked = {"time": names.get("t", "t"), "position": names.get("q", "q"), "torque": names.get("tau", "tau")}
    return load_recording(path, **(asked | mapping))


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        *[(name, DEG) for name in ("angle (deg)", "angle [deg]", "angle (°)", "angleDeg", "knee_deg", "q [degrees]")],
        *[(name, DEG) for name in ("angle / deg", "angle deg", "Angle [°] left", "angle(deg)")],
        *[(name, DEG) for name in ("knee_degrees", "kneeDegrees", "knee.degrees", "knee_Deg")],
        ("c1 position [rev]", 2 * np.pi),
        ("q (mrad)", 1e-3),
    ],
)
def test_a_named_unit_of_the_position_is_taken(tmp_path: Path, name: str, factor: float) -> None:
    recording = loaded(tmp_path, {"q": name})
    np.testing.assert_allclose(recording.position[:, 0], factor * COLUMNS["q"], rtol=1e-14)
    assert any(
        f"the name of column {name!r} says" in note and note.endswith("taken as that") for note in recording.notes
    )


@pytest.mark.parametrize(
    ("name", "factor"),
    [
        ("torque [mNm]", 1e-3),
        ("torque (N·mm)", 1e-3),
        ("torque [Ncm]", 1e-2),
        ("M (kN m)", 1e3),
        ("T [in-lb]", 0.1129848),
        *[(name, 1e-3) for name in ("torque_mNm", "torquemNm", "torque mNm", "log.torque-mNm", "tau_Nmm", "tauNmm")],
        *[(name, 1e3) for name in ("torque_kNm", "torquekNm", "M:kNm")],
        *[(name, 1e-2) for name in ("torque_Ncm", "tau Ncm")],
        *[(name, 1.0) for name in ("torque_Nm", "torqueNm", "tau Nm")],
    ],
)
def test_a_named_unit_of_the_torque_is_taken(tmp_path: Path, name: str, factor: float) -> None:
    recording = loaded(tmp_path, {"tau": name})
    np.testing.assert_allclose(recording.torque[:, 0], factor * COLUMNS["tau"], rtol=1e-6)


@pytest.mark.parametrize(("name", "factor"), [("Time (ms)", 1e-3), ("t_us", 1e-6), ("Time [s]", 1.0), ("timeMs", 1e-3)])
def test_a_named_unit_of_time_is_taken(tmp_path: Path, name: str, factor: float) -> None:
    recording = loaded(tmp_path, {"t": name})
    np.testing.assert_allclose(recording.time, factor * COLUMNS["t"], rtol=1e-12)
    assert bool(recording.notes) == (factor != 1)


@pytest.mark.parametrize("name", ["q (rad)", "q [radians]", "q_rad", "qRad", "q[1]", "joint (1)", "q"])
def test_what_is_si_or_nothing_needs_no_note(tmp_path: Path, name: str) -> None:
    recording = loaded(tmp_path, {"q": name})
    np.testing.assert_array_equal(recording.position[:, 0], COLUMNS["q"])
    assert recording.notes == ()


def test_a_row_of_units_is_taken(tmp_path: Path) -> None:
    recording = loaded(tmp_path, {}, row="ms,deg,Nm")
    np.testing.assert_allclose(recording.position[:, 0], DEG * COLUMNS["q"], rtol=1e-14)
    np.testing.assert_allclose(recording.time, 1e-3 * COLUMNS["t"], rtol=1e-12)
    assert "position: the file gives column 'q' in 'deg': taken as that" in recording.notes


def test_a_column_by_number_has_the_unit_of_its_name(tmp_path: Path) -> None:
    recording = loaded(tmp_path, {"q": "angle (deg)"}, position=2)
    np.testing.assert_allclose(recording.position[:, 0], DEG * COLUMNS["q"], rtol=1e-14)


def test_a_word_in_brackets_is_noted(tmp_path: Path) -> None:
    recording = loaded(tmp_path, {"q": "angle (filtered)"})
    assert (
        "position: 'filtered' of column 'angle (filtered)' is taken for no unit: it is read in 'rad'" in recording.notes
    )


@pytest.mark.parametrize(
    ("names", "change", "message"),
    [
        (
            {"q": "angle (xyz)"},
            {},
            'no unit that is known; state it: position = {column = "angle (xyz)", unit = "rad"}',
        ),
        ({"q": "enc [counts]"}, {}, 'gain = "0.00153 rad"'),
        ({"q": "enc"}, {"position": {"column": "enc", "unit": "ticks"}}, 'gain = "0.00153 rad"'),
        ({"tau": "torque [V]"}, {}, "says 'V', but without a unit it would be read in 'N m'"),
        ({"q": "a (deg)"}, {"position": {"column": "a (deg)", "unit": "rad"}}, "says 'deg', and the mapping 'rad'"),
        ({"q": "a (deg)"}, {"position": {"column": "a (deg)", "gain": 2}}, "State the unit of the product"),
    ],
)
def test_what_is_unclear_is_refused(
    tmp_path: Path, names: dict[str, str], change: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=matches(message)):
        loaded(tmp_path, names, **change)


@pytest.mark.parametrize(
    ("name", "entry", "factor"),
    [
        ("a (deg)", {"unit": "rad", "despite_name": True}, 1.0),
        ("a (deg)", {"gain": 2, "unit": "rad"}, 2.0),
        ("a (xyz)", {"unit": "mrad"}, 1e-3),
        ("enc [counts]", {"gain": "0.00153 rad"}, 0.00153),
        ("enc [counts]", {"gain": "0.00153 rad/count"}, 0.00153),
        ("a [V]", {"gain": "3 rad/V"}, 3.0),
        ("a", {"unit": "rev"}, 2 * np.pi),
        ("a", {"unit": "°"}, DEG),
    ],
)
def test_what_the_mapping_states_holds(tmp_path: Path, name: str, entry: dict[str, Any], factor: float) -> None:
    recording = loaded(tmp_path, {"q": name}, position={"column": name, **entry})
    np.testing.assert_allclose(recording.position[:, 0], factor * COLUMNS["q"], rtol=1e-14)


@pytest.mark.parametrize("name", ["Grad", "brand", "Gerard", "arms", "items", "class", "theta_m_deg2", "FZ", "pos L"])
def test_a_word_that_ends_like_a_unit_says_none(name: str) -> None:
    assert unit_in(name) is None
