"""What a batch will do: its files and lengths, its manifest, and what a manifest may not do."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factories.studies import JOB, LENGTHS, joint
from jaximp.batch import plan as batch_plan
from jaximp.batch import run as batch
from jaximp.batch.plan import find_items, make_plan, padded_sizes
from jaximp.jobs.job import parse_job
from jaximp.recordings.readers import formats
from jaximp.recordings.save import save_recording


@pytest.mark.parametrize("most", [1, 2, 5])
def test_as_little_as_possible_is_padded(most: int) -> None:
    """Against all choices of sizes."""
    from itertools import combinations

    lengths = np.random.default_rng(0).choice(np.arange(100, 200), 12, replace=False).tolist()
    lengths += [150, 150]
    chosen = padded_sizes(lengths, most)

    def padded(sizes: list[int]) -> int:
        return sum(min(size for size in sizes if size >= n) for n in lengths)

    choices = combinations(sorted(set(lengths))[:-1], most - 1)
    assert padded(chosen) == min(padded([*some, max(lengths)]) for some in choices)
    assert len(chosen) == most


def test_results_are_no_recordings(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of an earlier run, in the folder that is searched."""
    monkeypatch.chdir(study)
    for given in (".", str(study), "**/*.parquet"):
        names = {item.name for item in find_items([given])} - {"study.csv"}
        assert names == {f"r{k}.parquet" for k in range(len(LENGTHS))}


def test_packed_text_in_a_folder_is_a_recording(tmp_path: Path) -> None:
    for name in ("a.csv", "b.csv.gz", "c.TXT", "notes.gz.md", "d.parquet.gz", "e.tar.gz"):
        (tmp_path / name).touch()
    assert [item.name for item in find_items([str(tmp_path)])] == ["a.csv", "b.csv.gz", "c.TXT"]


@pytest.mark.parametrize("path", ["../r0.parquet", "/etc/passwd", "away/r0.parquet", "x/../../r0.parquet"])
def test_a_manifest_cannot_leave_its_folder(tmp_path: Path, path: str) -> None:
    inside = tmp_path / "inside"
    inside.mkdir()
    (inside / "away").symlink_to(tmp_path)
    (inside / "study.csv").write_text(f"file\n{path}\n")
    with pytest.raises(ValueError, match="allow-outside"):
        find_items([], inside / "study.csv")
    assert len(find_items([], inside / "study.csv", allow_outside=True)) == 1


def test_the_variable_of_the_sample_rate_is_counted_too(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "r.npz", q=np.zeros(10), tau=np.zeros(10), fs=np.zeros(20_000))
    table = {"position": "q", "torque": "tau", "sample_rate": "fs"}
    assert formats.count_samples(tmp_path / "r.npz", batch_plan.channel_columns(table)) == 20_000


@pytest.mark.parametrize(
    ("manifest", "why"),
    [
        ("file\na.csv\nsub/../a.csv\n", "more than once"),
        ("file,subject, subject\na.csv,1,2\n", "same name"),
        ("subject\nS1\n", "column 'file' .*, but its columns are subject: rename"),
        ("file,File\na.csv,b.csv\n", "same name"),
        ("file\n\n", "has no rows"),
        ("file\na.csv\na.csv\n", "more than once"),
        ("file,subject\na.csv\n", "more or fewer fields"),
        ("file,robot_file\na.csv,b.csv\n", "no \\[robot_recording\\]"),
        ("file,robot_file_after\na.csv,b.csv\n", "no \\[robot_recording_after\\]"),
        ("file,verdict\na.csv,x\n", "name of a result"),
        ("file,stiffness_stderr\na.csv,x\n", "name of a result"),
        ("file,stiffness_mean\na.csv,x\n", "name of a result"),
        ("file,subject\na.csv," + 200 * "x" + "\n", "too long"),
    ],
)
def test_bad_manifests_are_refused(tmp_path: Path, manifest: str, why: str) -> None:
    (tmp_path / "study.csv").write_text(manifest)
    with pytest.raises(ValueError, match=why):
        batch.run(parse_job(JOB), out=tmp_path / "out", manifest=tmp_path / "study.csv")


def test_a_job_with_trials_is_refused(tmp_path: Path) -> None:
    columns = "time = 't'\nposition = ['x', 'y']\ntorque = ['fx', 'fy']"
    job = parse_job(f"[trials]\nfile = 't.csv'\n{columns}\n[model.arm]\nlengths = [0.3, 0.3]\n", tmp_path)
    with pytest.raises(ValueError, match=r"with \[trials\] is one study by itself: batch works on jobs with"):
        batch.run(job, [tmp_path], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_manifests_are_what_spreadsheets_write(tmp_path: Path) -> None:
    """With a mark at the beginning and semicolons, too; a path from Windows is told what is wrong with it."""
    save_recording(joint(1000), tmp_path / "a b.parquet")
    text = "File;Subject\na b.parquet;1\n.\\a b.parquet;2\n;\n"
    (tmp_path / "study.csv").write_text(text, encoding="utf-8-sig")
    plan = make_plan(parse_job(JOB), find_items([], tmp_path / "study.csv"))
    assert [item.metadata for item in plan.items] == [(("subject", "1"),), (("subject", "2"),)]
    words = plan.in_words(parse_job(JOB))
    assert words[0] == "2 recordings in 2 batches"
    assert words[1].startswith(f"refused: .\\a b.parquet: there is no file {tmp_path}/.\\a b.parquet: check the path")
    assert words[1].endswith("write / between folders")
    assert words[2] == "model: human; windows of 1 s every 0.05 s"
    assert batch.first_trouble(parse_job(JOB), plan) == ""
    trouble = batch.first_trouble(parse_job(JOB.replace("torque_Nm", "torque")), plan)
    assert trouble.startswith("a b.parquet would fail: ")
    assert "'torque_Nm'" in trouble
    (tmp_path / "study.csv").write_text("file,subject\na b.parquet,1\n,2\n")
    with pytest.raises(ValueError, match=r"study.csv, line 3: the column 'file' is empty"):
        find_items([], tmp_path / "study.csv")
