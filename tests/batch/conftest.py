"""A study that all tests of batches share."""

from __future__ import annotations

from pathlib import Path

import pytest

from factories.studies import JOB, LENGTHS, joint, run
from jaximp.recordings.save import save_recording


@pytest.fixture(scope="session")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Eight recordings of several lengths with a manifest, and the job; `reference` holds an undisturbed run."""
    folder = tmp_path_factory.mktemp("study")
    for k, n in enumerate(LENGTHS):
        save_recording(joint(n, k, stiffness=20.0 + k), folder / f"r{k}.parquet")
    subjects = ["S1", "1", "<script>alert(1)</script>", "../x", "01", "S2", "..", ""]
    rows = [f"r{k}.parquet,{subject},{k % 2}" for k, subject in enumerate(subjects)]
    (folder / "study.csv").write_text("file,subject,arm\n" + "\n".join(rows) + "\n")
    (folder / "job.toml").write_text(JOB)
    run(folder, folder / "reference")
    return folder


@pytest.fixture(autouse=True)
def own_folders(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes leave nothing in the user's folders."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.getbasetemp() / "cache"))
