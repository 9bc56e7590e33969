"""Every kind of result answers the same questions: by name, as a table, as a figure."""

from __future__ import annotations

from functools import cache

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure
from matplotlib.text import Text

from factories.joints import JOB, joint
from jaximp.identification.estimates import Estimates
from jaximp.jobs.job import parse_job
from jaximp.jobs.run import identify_recording, infer_recording
from jaximp.posterior.inference import Inference
from jaximp.reports.contents import estimates_table
from jaximp.results import Result


@cache
def estimates() -> Estimates:
    return identify_recording(parse_job(JOB), joint())[0]


@cache
def inference() -> Inference:
    return infer_recording(parse_job(JOB), joint())


RESULTS = pytest.mark.parametrize("result", [estimates, inference], ids=["windows", "posterior"])


@RESULTS
def test_a_parameter_is_found_by_its_name(result) -> None:  # type: ignore[no-untyped-def]
    found: Result = result()
    stiffness, k = found["stiffness"], found.names.index("stiffness")
    assert stiffness.unit == "N m/rad"
    np.testing.assert_array_equal(stiffness.value, np.asarray(found.value)[..., k])
    np.testing.assert_array_equal(stiffness.stderr, np.asarray(found.stderr)[..., k])
    low, high = stiffness.interval(0.95)
    assert np.all((low < stiffness.value) & (stiffness.value < high))
    wide = stiffness.interval(0.999)
    assert np.all((wide[0] < low) & (high < wide[1]))
    assert np.all(np.abs(stiffness.value - 20) < 1)


@RESULTS
def test_a_misspelt_name_is_answered_with_the_nearest(result) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(KeyError, match="did you mean 'stiffness'"):
        result()["stifness"]


@RESULTS
def test_tables_have_a_row_for_each_window_and_units(result) -> None:  # type: ignore[no-untyped-def]
    found = result()
    frame, dataset = found.to_pandas(), found.to_xarray()
    assert len(frame) == len(found.end) == dataset.sizes["window"]
    assert frame.attrs["units"]["stiffness"] == dataset["stiffness"].attrs["units"] == "N m/rad"
    np.testing.assert_array_equal(frame["stiffness"], dataset["stiffness"])
    np.testing.assert_array_equal(dataset["end_s"], found.end)


def test_a_data_frame_is_the_table_on_disk(tmp_path) -> None:  # type: ignore[no-untyped-def]
    pq.write_table(estimates_table(estimates()), tmp_path / "estimates.parquet")
    table, frame = pq.read_table(tmp_path / "estimates.parquet"), estimates().to_pandas()
    assert table.column_names == list(frame.columns)
    for name in table.column_names:
        assert table[name].to_pylist() == pytest.approx(frame[name].tolist(), nan_ok=True)
        assert table.schema.field(name).metadata[b"unit"].decode() == frame.attrs["units"][name]


@RESULTS
def test_a_result_draws_itself(result) -> None:  # type: ignore[no-untyped-def]
    figure = result().plot()
    assert isinstance(figure, Figure)
    shown = [text.get_text() for text in figure.findobj(Text)]
    assert any("stiffness" in text for text in shown)
