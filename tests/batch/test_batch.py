"""The results of a batch: what `identify` gives for each recording, and a page over all."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from browser import browser, executable
from factories.chains import TWO_JOINTS, arrays, chain_in
from factories.studies import JOB, LENGTHS, beside, joint, still
from jaximp.batch import plan as batch_plan
from jaximp.batch import results as batch_results
from jaximp.batch import run as batch
from jaximp.batch import tables as batch_tables
from jaximp.batch.overview import group_means
from jaximp.batch.plan import find_items, make_plan
from jaximp.batch.task import Task
from jaximp.jobs.job import WindowJob, parse_job, read_job
from jaximp.jobs.run import identify, identify_recording
from jaximp.least_squares import sliding as windows
from jaximp.recordings.load import recording_from_arrays
from jaximp.recordings.save import save_recording
from jaximp.types import Recording


def test_the_data_set_holds_what_identify_finds(study: Path) -> None:
    out, job = study / "reference", read_job(study / "job.toml")
    recordings = batch.read_recordings(out)
    assert recordings["recording"].to_pylist() == [f"r{k}.parquet" for k in range(8)]
    assert recordings["status"].to_pylist() == ["ok"] * 8
    assert recordings["subject"].to_pylist()[2:4] == ["<script>alert(1)</script>", "../x"]
    assert recordings.schema.field("stiffness_mean").metadata == {b"unit": b"N m/rad"}
    import pyarrow.dataset as ds

    windows = ds.dataset(out / "estimates", format="parquet").to_table()
    stated = dict(zip(recordings["recording"].to_pylist(), recordings["subject"].to_pylist(), strict=True))
    assert {(row["recording"], row["subject"]) for row in windows.to_pylist()} == set(stated.items())
    for k in (0, 2):
        expected = identify_recording(job, joint(LENGTHS[k], k, stiffness=20.0 + k))[0]
        rows = windows.filter(pa.compute.equal(windows["recording"], f"r{k}.parquet")).sort_by("start_s")
        np.testing.assert_allclose(rows["stiffness"], np.asarray(expected.fit.theta)[:, 2], 1e-9)
        np.testing.assert_allclose(rows["stiffness_stderr"], np.asarray(expected.fit.stderr)[:, 2], 1e-9)
        row = {name: recordings[name][k].as_py() for name in ("trusted", "windows", "stiffness_mean")}
        assert row["windows"] == len(expected.start)
        assert row["trusted"] == expected.verdicts.trusted.sum()
        np.testing.assert_allclose(row["stiffness_mean"], expected.mean_over_trusted()[2], 1e-9)


@pytest.mark.parametrize("reader", ["pandas", "polars", "duckdb"])
def test_every_reader_reads_it(study: Path, reader: str) -> None:
    library = pytest.importorskip(reader)
    out = study / "reference"
    expected = batch.read_recordings(out)["windows"].to_pylist()
    if reader == "pandas":
        windows = library.read_parquet(out / "estimates")
        counts = windows.groupby("recording", observed=True).size().sort_index().tolist()
        subjects = set(windows["subject"])
    elif reader == "polars":
        windows = library.read_parquet(out / "estimates")
        counts = windows.group_by("recording").len().sort("recording")["len"].to_list()
        subjects = set(windows["subject"])
    else:
        where = f"'{out}/estimates/**/*.parquet'"
        query = f"SELECT count(*) FROM {where} GROUP BY recording ORDER BY recording"
        counts = [count for (count,) in library.sql(query).fetchall()]
        subjects = {subject for (subject,) in library.sql(f"SELECT DISTINCT subject FROM {where}").fetchall()}
    assert counts == expected
    assert {"S1", "S2", "../x", "..", "<script>alert(1)</script>", "1", "01", ""} == subjects


@pytest.mark.slow
def test_a_human_in_a_robot_takes_the_manifests_robot(tmp_path: Path) -> None:
    """One by one, with the recording of the robot alone that the manifest names."""
    text = JOB.replace("human = true", "human = true\nrobot = { gravity = false, coulomb = false }\nmethods = [1, 3]")
    text += '[robot_recording]\nfile = "none.parquet"\n' + "".join(JOB.splitlines(keepends=True)[3:6])
    save_recording(joint(1000, 1), tmp_path / "held.parquet")
    save_recording(joint(1000, 2, stiffness=0.0), tmp_path / "alone.parquet")
    (tmp_path / "study.csv").write_text("file,robot_file\nheld.parquet,alone.parquet\n")
    job = parse_job(text, tmp_path)
    plan = make_plan(job, find_items([], tmp_path / "study.csv"))
    assert any("one by one" in line for line in plan.in_words(job))
    outcome = batch.run_plan(job, plan, tmp_path / "out")
    assert outcome.failed == []
    expected = identify_recording(job, joint(1000, 1), joint(1000, 2, stiffness=0.0))
    for folder, one in zip(("estimates", "estimates_method3"), expected, strict=True):
        (path,) = (tmp_path / "out" / folder).rglob("*.parquet")
        np.testing.assert_allclose(pq.ParquetFile(path).read()["stiffness"], np.asarray(one.fit.theta)[:, 2], 1e-12)


@pytest.mark.slow
def test_a_study_has_conditions_of_its_own(tmp_path: Path) -> None:
    """Beside the condition number; and no column of the windows can be shadowed by one of the manifest."""
    import pyarrow.dataset as ds

    save_recording(joint(1000), tmp_path / "a.parquet")
    (tmp_path / "study.csv").write_text("file,condition\na.parquet,tense\n")
    job = parse_job(JOB, tmp_path)
    batch.run(job, out=tmp_path / "out", manifest=tmp_path / "study.csv")
    table = ds.dataset(tmp_path / "out/estimates", format="parquet").to_table()
    assert set(table["condition"].to_pylist()) == {"tense"}
    expected = identify_recording(job, joint(1000))[0]
    np.testing.assert_allclose(table["condition_number"], expected.fit.cond, 1e-6)
    assert {*table.column_names} - {"condition"} <= batch_tables.reserved_columns(job)


@pytest.mark.slow
@pytest.mark.parametrize("n_joints", [1, 2])
def test_a_reflex_is_what_it_is_alone(tmp_path: Path, n_joints: int) -> None:
    """Recordings of two rates in one table, with gain and delay of every window and the gain in the row of each."""
    text = JOB.replace("human = true", "human = { reflex = { first = 0.05, last = 0.25, count = 3 } }")
    text = text.replace("length = 1\n", "length = 2\n").replace("step = 0.05", "step = 0.2")
    both = {"a": joint(1000, 1), "b": joint(1300, 2, rate=300.0)}
    if n_joints == 2:
        both = {name: beside(one, joint(len(one), 7, one.sample_rate)) for name, one in both.items()}
        text = text.replace('"position_rad"', '["position1_rad", "position2_rad"]')
        text = text.replace('"torque_Nm"', '["torque1_Nm", "torque2_Nm"]')
    for name, one in both.items():
        save_recording(one, tmp_path / f"{name}.parquet")
    (tmp_path / "study.csv").write_text("file,subject\na.parquet,S\nb.parquet,S\n")
    job = parse_job(text, tmp_path)
    assert batch.run(job, out=tmp_path / "out", manifest=tmp_path / "study.csv").exit_status == 0
    alone = [identify_recording(job, one)[0] for one in both.values()]
    (path,) = (tmp_path / "out/estimates").rglob("*.parquet")
    found, rows = pq.ParquetFile(path).read(), batch.read_recordings(tmp_path / "out")
    for k, reflex in enumerate(alone[0].reflexes):
        for what in ("gain", "gain_stderr", "delay"):
            expected = np.concatenate([getattr(one.reflexes[k], what) for one in alone])
            np.testing.assert_allclose(found[f"{reflex.name}_{what}"], expected, 1e-12)
    means = [one.summarised().mean_over_trusted() for one in alone]
    for k, name in enumerate(alone[0].summarised().names):
        np.testing.assert_allclose(rows[f"{name}_mean"].to_numpy(), [mean[k] for mean in means], 1e-12)
    assert f"{alone[0].reflexes[-1].name}_gain_mean" in rows.column_names
    assert np.isfinite(rows[f"{alone[0].names[2]}_mean"].to_numpy()).all()


def test_a_long_recording_goes_in_chunks_without_a_seam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is too long to be stacked gives what `identify` gives, which solves it in overlapping chunks."""
    monkeypatch.setattr(batch_plan, "LONGEST_STACKED", 1200)
    monkeypatch.setattr("jaximp.identification.prepared.MOST_ROWS", 200)
    monkeypatch.setattr(windows, "FROM_CHUNKS", 1)
    save_recording(joint(1321), tmp_path / "long.parquet")
    save_recording(joint(1000), tmp_path / "short.parquet")
    job = parse_job(JOB, tmp_path)
    plan = make_plan(job, find_items([str(tmp_path)]))
    assert [one.padded for one in plan.batches] == [1000, 0]
    assert batch.run_plan(job, plan, tmp_path / "out").exit_status == 0
    found = pq.ParquetFile(tmp_path / "out/estimates/batch-00001.parquet").read()
    expected = identify_recording(job, joint(1321))[0]
    np.testing.assert_array_equal(found["stiffness"], np.asarray(expected.fit.theta)[:, 2])


def test_a_new_recording_of_the_robot_is_read(tmp_path: Path) -> None:
    text = JOB.replace("human = true", "human = true\nrobot = { gravity = false, coulomb = false }\nmethods = [1]")
    text += '[robot_recording]\nfile = "alone.parquet"\n' + "".join(JOB.splitlines(keepends=True)[3:6])
    job = parse_job(text)
    item = batch_plan.Item("x", tmp_path / "x.parquet", robot_file=tmp_path / "alone.parquet")
    task = batch_results.Task(job, tmp_path, (), (), (), 1)
    for seed in (1, 2):
        recording = joint(1000, seed)
        save_recording(recording, tmp_path / "alone.parquet")
        found = batch_results._alone(task, item)
        assert isinstance(found, Recording)
        np.testing.assert_array_equal(found.torque, recording.torque)


def test_the_robot_afterwards_is_that_of_the_manifest(tmp_path: Path) -> None:
    """Both are read, in their order, and either one's content makes the results those of another input."""
    text = JOB.replace("human = true", "human = true\nrobot = { gravity = false, coulomb = false }")
    columns = "".join(JOB.splitlines(keepends=True)[3:6])
    text += "".join(
        f'[{table}]\nfile = "none.parquet"\n{columns}' for table in ("robot_recording", "robot_recording_after")
    )
    names = ("held", "before", "after")
    for seed, name in enumerate(names):
        save_recording(joint(1000, seed), tmp_path / f"{name}.parquet")
    rows = "file,robot_file,robot_file_after\n" + ",".join(f"{name}.parquet" for name in names)
    (tmp_path / "study.csv").write_text(rows + "\n")
    job = parse_job(text, tmp_path)
    plan = make_plan(job, find_items([], tmp_path / "study.csv"))
    ((item,),) = (batch.items for batch in plan.batches)
    task = batch_results.Task.of(job, plan, tmp_path / "out")
    found = batch_results._alone(task, item)
    assert isinstance(found, tuple)
    for one, seed in zip(found, (1, 2), strict=True):
        np.testing.assert_array_equal(one.torque, joint(1000, seed).torque)
    before = batch_results.input_checksum(item)
    save_recording(joint(1000, 7), tmp_path / "after.parquet")
    assert batch_results.input_checksum(item) != before


def test_all_recordings_of_a_study_have_the_same_joints(tmp_path: Path) -> None:
    """Two in one variable, where the first recording has one."""
    for k, one in enumerate((joint(1000), beside(joint(1000), joint(1000, 1)))):
        np.savez(tmp_path / f"r{k}.npz", time_s=one.time, position_rad=one.position, torque_Nm=one.torque)
    job = parse_job(JOB, tmp_path)
    plan = make_plan(job, find_items([str(tmp_path)]))
    task = batch_results.Task.of(job, plan, tmp_path)
    found = [batch_results._read(task, plan.batches[0], item) for item in plan.items]
    assert [result.reason[-50:] for result in found if result.reason] == [found[1].reason[-50:]]
    assert "it has 2 joints, but this study 1" in found[1].reason


def test_where_nothing_is_trusted_it_is_said_why(tmp_path: Path) -> None:
    """At the end of a run, taken up or not, and beside the recording."""
    save_recording(joint(1000), tmp_path / "moves.parquet")
    save_recording(still(joint(1000, 1), slice(20, None)), tmp_path / "rests.parquet")
    job, files = parse_job(JOB, tmp_path), [tmp_path / "moves.parquet", tmp_path / "rests.parquet"]
    first, again = (batch.run(job, files, tmp_path / "out", resume=resume) for resume in (False, True))
    reasons = batch.read_recordings(tmp_path / "out")["reason"].to_pylist()
    assert reasons[0] == ""
    assert reasons[1].startswith("no window can be trusted, for example: ")
    for outcome in (first, again):
        assert (outcome.doubted, outcome.doubt) == (1, f"rests.parquet: {reasons[1]}")


@pytest.mark.slow
def test_other_units_are_noticed(tmp_path: Path) -> None:
    """Of one recording alone nobody could tell; a soft joint among stiff ones is none of these."""
    for k in range(6):
        one = joint(1000, k, stiffness=0.5 if k == 5 else 20.0)
        if k == 0:
            one = recording_from_arrays(one.time, np.degrees(one.position), one.torque)
        save_recording(one, tmp_path / f"r{k}.parquet")
    outcome = batch.run(parse_job(JOB), [tmp_path], tmp_path / "out")
    assert list(outcome.odd) == ["r0.parquet"]
    assert outcome.odd["r0.parquet"].startswith("stiffness is 0.017 times that of the median recording")
    assert "0.017 times" in (tmp_path / "out/overview.html").read_text()
    recordings = batch.read_recordings(tmp_path / "out")
    assert recordings["suspicion"].to_pylist() == [outcome.odd["r0.parquet"], *[""] * 5]
    (mean,) = group_means(recordings, [], "stiffness")
    assert (mean.recordings, mean.left_out) == (5, 1)
    again = batch.run(parse_job(JOB), [tmp_path], tmp_path / "out", resume=True)
    assert (again.skipped, again.odd) == (6, outcome.odd), "receipts know what was added to the tables"
    fewer = batch.run(parse_job(JOB), [tmp_path / f"r{k}.parquet" for k in range(4)], tmp_path / "out", resume=True)
    assert fewer.odd == {}
    assert set(batch.read_recordings(tmp_path / "out")["suspicion"].to_pylist()) == {""}
    few = batch.run(parse_job(JOB), [tmp_path / f"r{k}.parquet" for k in range(4)], tmp_path / "few")
    assert few.odd == {}


def test_the_overview_of_a_study_opens_in_a_browser(study: Path) -> None:
    """All recordings with their series; what a manifest says is text."""
    page = study / "reference/overview.html"
    assert "<script>alert" not in page.read_text()
    if executable() is None:
        pytest.skip("there is no chromium on this machine")
    with browser() as one:
        one.open(page.as_uri())
        one.wait("document.documentElement.dataset.usable")
        cells = one.evaluate("[...document.querySelectorAll('#table tbody :is(th, td)')].map(one => one.textContent)")
        assert {f"r{k}.parquet" for k in range(8)} | {"<script>alert(1)</script>", "../x"} <= set(cells)
        one.evaluate("document.getElementById('panels').scrollIntoView()")
        one.frame()
        one.wait("document.querySelectorAll('#panels svg path').length >= 4")
        assert one.complaints() == []


def test_columns_may_have_the_endings_of_results(study: Path, tmp_path: Path) -> None:
    """Of the page: a mean of somebody's own is text, and no parameter."""
    shutil.copytree(study / "reference", tmp_path / "out")
    for path in (tmp_path / "out" / "recordings").iterdir():
        table = pq.ParquetFile(path).read()
        for name in ("emg_mean", "x_median_stderr"):
            table = table.append_column(name, pa.array(["3"] * len(table), pa.string()))
        pq.write_table(table, path)
    batch.write_page(tmp_path / "out", ("subject", "arm", "emg_mean", "x_median_stderr"))
    page = (tmp_path / "out" / "overview.html").read_text()
    assert "emg_mean" in page
    assert "x_median_stderr" in page


ROBOT = """
held_out = 0.25
[recording]
file = "a.csv"
time = 1
position = { columns = [2, 3], unit = "rad" }
torque = [4, 5]
[model.robot]
urdf = "two_joints.urdf"
friction = true
[filter]
position_cutoff = 8.0
decimation_cutoff = 4.0
"""


def test_robots_from_a_urdf_are_a_study(tmp_path: Path) -> None:
    """Each is what `identify` finds of its file: with joints that are weighed, and an end that is held out."""
    chain = chain_in(tmp_path)
    for seed, name in enumerate(("a.csv", "b.csv")):
        np.savetxt(tmp_path / name, np.column_stack(arrays(chain, seed)), delimiter=",", fmt="%.9g")
    (tmp_path / "study.csv").write_text("file,condition\na.csv,cold\nb.csv,warm\n")
    job, out = parse_job(ROBOT, tmp_path), tmp_path / "out"
    assert isinstance(job, WindowJob)
    plan = make_plan(job, find_items([], tmp_path / "study.csv"))
    assert {"model: robot of two_joints.urdf; each recording as one window"} < set(plan.in_words(job))
    assert plan.one_by_one == "the joints of a robot are weighed by what is left of each"
    outcome = batch.run_plan(job, plan, out)
    assert (outcome.failed, outcome.windows, outcome.trusted) == ([], 2, 2)
    recordings = batch.read_recordings(out)
    for k, name in enumerate(("a", "b")):
        expected = identify(parse_job(ROBOT.replace("a.csv", f"{name}.csv"), tmp_path))[0]
        (path,) = (out / "estimates" / f"condition-{('cold', 'warm')[k]}").glob("*.parquet")
        found, low_high = pq.ParquetFile(path).read(), expected.interval()
        assert json.loads(found.schema.metadata[b"sums"]) == chain.sums
        for column, parameter in enumerate(chain.names):
            assert found[parameter][0].as_py() == np.asarray(expected.fit.theta)[0, column]
            assert found[f"{parameter}_stderr"][0].as_py() == np.asarray(expected.fit.stderr)[0, column]
            half = recordings[f"{parameter}_half_width_95"][k].as_py()
            np.testing.assert_allclose(2 * half, (low_high[1] - low_high[0])[0, column], 1e-9)
        for name_of, residuals in (("residual", expected.residuals), ("held_out_residual", expected.held_out)):
            assert recordings[name_of][k].as_py() == residuals.total
    page = (out / "overview.html").read_text()
    assert "link2.mc_z_half_width_95" in page
    assert "link2.mc_z_sd" not in page
    task = Task.of(job, plan, out)
    assert batch_results.finished(task, plan.batches[0]) is not None
    (tmp_path / "two_joints.urdf").write_text(TWO_JOINTS + "\n")
    assert batch_results.finished(task, plan.batches[0]) is None
