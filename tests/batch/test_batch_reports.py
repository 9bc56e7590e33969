"""Reports of the recordings of a batch: those that were asked for, and no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factories.studies import JOB, joint
from jaximp.batch import results as batch_results
from jaximp.batch import run as batch
from jaximp.jobs.job import Job, parse_job
from jaximp.recordings.load import recording_from_arrays
from jaximp.recordings.save import save_recording
from jaximp.types import Recording


@pytest.mark.parametrize("name", [".", "..", ".hidden", "a/../..", "x.csv"])
def test_a_report_stands_in_a_folder_of_its_own(tmp_path: Path, name: str) -> None:
    folder = batch_results.report_folder(tmp_path, name)
    assert folder.resolve().parent == tmp_path / "reports"
    assert not folder.name.startswith(".")


REPORTS = [
    ("failed", ["noise.parquet"]),
    *(
        pytest.param(*case, marks=pytest.mark.slow)
        for case in [("none", []), ("all", ["good.parquet", "noise.parquet"])]
    ),
]


@pytest.mark.parametrize(("reports", "expected"), REPORTS)
def test_reports_are_those_that_were_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, reports: str, expected: list[str]
) -> None:
    """A recording has failed if none of its windows can be trusted."""
    written: list[str] = []
    monkeypatch.setattr(batch_results, "write_report_of", lambda job, one, *others: written.append(one.name))
    good = joint(1000)
    torque = np.random.default_rng(0).normal(size=(1000, 1))
    save_recording(good, tmp_path / "good.parquet")
    save_recording(recording_from_arrays(good.time, good.position, torque), tmp_path / "noise.parquet")
    assert batch.run(parse_job(JOB), [tmp_path], tmp_path / "out", reports=reports).exit_status == 0
    assert sorted(written) == expected


def test_a_report_can_be_had_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a recording by its name, though its batch is done; the overview links it. A changed recording loses it."""

    def write(job: Job, one: Recording, alone: Recording | None, folder: Path, held_out: object) -> None:
        folder.mkdir(parents=True)
        (folder / "report.html").write_text(one.name)

    monkeypatch.setattr(batch_results, "write_report_of", write)
    for name in ("a", "b"):
        save_recording(joint(1000), tmp_path / f"{name}.parquet")
    job, out = parse_job(JOB), tmp_path / "out"
    files = [tmp_path / "a.parquet", tmp_path / "b.parquet"]
    batch.run(job, files, out)
    assert "reports/" not in (out / "overview.html").read_text()
    assert batch.run(job, files, out, resume=True, reports=["b.parquet"]).skipped == 2
    assert [path.read_text() for path in out.glob("reports/*/report.html")] == ["b.parquet"]
    assert "./reports/b.parquet/report.html" in (out / "overview.html").read_text()
    with pytest.raises(ValueError, match="there is no recording 'c'"):
        batch.run(job, files, out, resume=True, reports=["c"])
    save_recording(joint(1000, 5), tmp_path / "b.parquet")
    batch.run(job, files, out, resume=True)
    assert not list(out.glob("reports/*"))
    assert "reports/" not in (out / "overview.html").read_text()


@pytest.mark.slow
def test_what_did_not_change_keeps_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Though it is done again with those beside it; and what another run leaves out is told."""

    def write(job: Job, one: Recording, alone: Recording | None, folder: Path, held_out: object) -> None:
        folder.mkdir(parents=True)
        (folder / "report.html").write_text(f"{one.name} {job.text.splitlines()[0]}")

    monkeypatch.setattr(batch_results, "write_report_of", write)
    files = [tmp_path / f"{name}.parquet" for name in "abc"]
    for k, file in enumerate(files):
        save_recording(joint(1000, k), file)
    job, out = parse_job(JOB), tmp_path / "out"
    batch.run(job, files, out, reports="all")
    assert (out / "reports/a.parquet/report.html").read_text() == f"a.parquet # recording: {files[0]}"
    save_recording(joint(1000, 9), files[0])
    again = batch.run(job, files, out, resume=True)
    assert (again.skipped, again.outdated, again.dropped) == (0, 1, 0)
    assert sorted(path.name for path in (out / "reports").iterdir()) == ["b.parquet", "c.parquet"]
    assert batch.run(job, files[:2], out, resume=True).dropped == 1
    assert batch.run(parse_job(JOB + "[trust]\nmin_vaf = 0.8\n"), files[:2], out, resume=True).outdated == 1


@pytest.mark.slow
def test_a_report_that_fails_costs_no_batch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*args: object) -> None:
        raise RuntimeError("no figure")

    monkeypatch.setattr(batch_results, "write_report_of", fail)
    save_recording(joint(1000), tmp_path / "a.parquet")
    events: list[dict[str, object]] = []
    outcome = batch.run(parse_job(JOB), [tmp_path / "a.parquet"], tmp_path / "out", reports="all", tell=events.append)
    assert outcome.exit_status == 0
    assert {"event": "no report", "recording": "a.parquet", "reason": "RuntimeError: no figure"} in events
