"""The command line as a person meets it: exit status, one line for bad input, nothing half-written."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

import command_line
import jaximp
from factories.joints import TIME, joint
from jaximp import papers
from jaximp.cli.main import keep_small
from jaximp.cli.reproduce import Paper
from jaximp.recordings.save import save_recording

JOB = """
[recording]
file = "joint.csv"
time = "time_s"
position = { column = "position_rad", unit = "rad" }
torque = { column = "torque_Nm", unit = "N m" }
[model]
human = true
[filter]
position_cutoff = 40
decimation_cutoff = 20
[window]
length = 1
step = 0.2
"""


@pytest.fixture
def job(tmp_path: Path) -> Path:
    save_recording(joint(), tmp_path / "joint.csv")
    (tmp_path / "job.toml").write_text(JOB)
    return tmp_path / "job.toml"


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    """Run `jaximp ...` in this process: exit status, standard output, standard error."""

    def call(*arguments: object) -> tuple[int, str, str]:
        status = command_line.jaximp(*arguments)
        said, complained = (re.sub(r"\x1b\[[0-9;]*m", "", text) for text in capsys.readouterr())  # without colours
        return status, said, complained

    return call


@pytest.mark.slow
@pytest.mark.compiles
def test_identify_writes_everything(run, job: Path) -> None:  # type: ignore[no-untyped-def]
    out = job.parent / "out"
    status, said, _ = run("identify", job, "--out", out)
    assert status == 0
    assert "report.html" in said
    table = pq.read_table(out / "estimates.parquet")
    expected = {"start_s", "end_s", "stiffness", "stiffness_stderr", "condition", "sigma_min", "residual_rms", "vaf"}
    assert expected | {"verdict"} <= set(table.column_names)
    assert table.num_rows == 36
    summary = json.loads((out / "summary.json").read_text())
    assert summary["parameters"]["stiffness"]["mean"] == pytest.approx(20, rel=0.05)
    assert (out / "report.html").read_text().count("<img") >= 4
    assert run("identify", job, "--out", out)[0] == 1
    assert run("identify", job, "--out", out, "--force")[0] == 0


@pytest.mark.slow
def test_check_proposes(run, job: Path) -> None:  # type: ignore[no-untyped-def]
    status, said, _ = run("check", job)
    assert status == 0
    assert "position_cutoff = " in said
    assert "delay" in said


def test_simulate_writes_what_identify_reads(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    assert run("simulate", "rig", "--holding", "bands", "-o", tmp_path / "rig")[0] == 0
    names = {path.name for path in (tmp_path / "rig").iterdir()}
    assert {"job.toml", "robot_alone.csv", "robot_with_human.csv"} <= names


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--perturbed", 1, "at least 2 and 0 are needed"),
        ("--duration", 0.5, "it must last from 1 to 20 s"),
    ],
)
def test_arms_that_cannot_be_simulated_are_refused(
    run, tmp_path: Path, option: str, value: float, message: str
) -> None:  # type: ignore[no-untyped-def]
    status, _, said = run("simulate", "arm", "--out", tmp_path / "arm", option, value)
    assert status == 1
    assert message in said
    assert not (tmp_path / "arm").exists()


@pytest.mark.slow
def test_demo_finds_the_step(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    status, said, _ = run("demo", "--out", tmp_path / "demo")
    assert status == 0
    assert "stiffness 60 until 12 s, then 120 N m/rad" in said
    truth = json.loads((tmp_path / "demo" / "truth.json").read_text())
    table = pq.read_table(tmp_path / "demo" / "estimates.parquet").to_pydict()
    start, end, trusted = np.array(table["start_s"]), np.array(table["end_s"]), np.array(table["verdict"]) == "trusted"
    stiffness, stderr = np.array(table["stiffness"]), np.array(table["stiffness_stderr"])
    assert trusted.mean() > 0.7
    before, after = trusted & (end < truth["change_s"]), trusted & (start > truth["change_s"])
    for value, when in zip(truth["stiffness"], (before, after), strict=True):
        assert np.abs((stiffness - value) / stderr)[when].max() < 4
        np.testing.assert_allclose(stiffness[when].mean(), value, rtol=0.03)


def test_a_reader_that_leaves_takes_no_results_along(job: Path) -> None:
    """As `| head -0` does."""
    out = job.parent / "out"
    read, write = os.pipe()
    os.close(read)
    command = [
        sys.executable,
        "-c",
        "from jaximp.cli.main import main; main()",
        "identify",
        str(job),
        "--out",
        str(out),
    ]
    subprocess.run(command, stdout=write, stderr=subprocess.PIPE, timeout=300, check=False)
    os.close(write)
    assert (out / "estimates.parquet").is_file()


@pytest.mark.slow
def test_a_simulated_robot_is_identified(run, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    assert run("simulate", "robot", "--out", tmp_path / "robot", "--duration", 12)[0] == 0
    assert run("identify", tmp_path / "robot" / "job.toml", "--out", tmp_path / "out")[0] == 0
    truth = json.loads((tmp_path / "robot" / "truth.json").read_text())
    table = pq.read_table(tmp_path / "out" / "estimates.parquet").to_pydict()
    found, stderr = (np.array([table[f"{name}{end}"][0] for name in truth]) for end in ("", "_stderr"))
    z = (found - [one["value"] for one in truth.values()]) / stderr
    assert np.sqrt(np.mean(z**2)) < 2
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["held_out"]["total_moving"] < 0.03


def test_usage_errors_have_status_2(run) -> None:  # type: ignore[no-untyped-def]
    assert run("identify")[0] == 2
    assert run("reproduce", "nobody1900", "--out", "x")[0] == 2
    assert run("simulate", "rig", "--colour", "red")[0] == 2


def test_every_paper_can_be_reproduced() -> None:
    """That of every study which has a function for it."""
    folder = Path(papers.__file__).parent
    there = {file.stem for file in folder.glob("*.py") if "\ndef reproduce(" in file.read_text(encoding="utf-8")}
    assert there == {paper.value for paper in Paper} == {"tout2023", "lakatos2011", "borner2020"}


COMMANDS = [
    "demo", "init", "check", "identify", "monitor", "posterior", "design", "export", "simulate", "batch", "reproduce",
]  # fmt: skip


@pytest.mark.parametrize("command", COMMANDS)
def test_help_teaches(run, command: str) -> None:  # type: ignore[no-untyped-def]
    status, said, _ = run(command, "--help")
    assert status == 0
    assert "Usage" in said
    assert len(said) > 300
    assert run(command, "-h")[:2] == (0, said)
    if command not in ("init", "check", "export", "monitor"):
        assert re.search(r"--out +-o ", said)


def test_commands_are_listed(run) -> None:  # type: ignore[no-untyped-def]
    status, said, _ = run("-h")
    assert status == 0
    assert re.findall(r"^│ ([a-z]+) ", said, re.MULTILINE) == COMMANDS


def test_the_version_is_said(run) -> None:  # type: ignore[no-untyped-def]
    assert run("--version") == (0, f"jaximp {jaximp.__version__}\n", "")


LINES = "\n".join(f"{t:.3f},{np.sin(9 * t):.6f},{np.sin(9 * t + 1):.6f}" for t in TIME[:3000])
HEADER = "time_s,position_rad,torque_Nm\n"
BAD_FILES = {
    "empty file": (b"", "empty"),
    "header only": (HEADER.encode(), "0 samples"),
    "text in a number column": ((HEADER + LINES.replace("0.003,", "0.003,x", 1)).encode(), "position_rad"),
    "constant": ((HEADER + "\n".join(f"{t:.3f},0.5,1.0" for t in TIME[:3000])).encode(), "constant"),
    "all NaN": ((HEADER + "\n".join(f"{t:.3f},nan,1.0" for t in TIME[:3000])).encode(), "position_rad"),
    "Inf": ((HEADER + LINES + "\n3.000,inf,0.1\n").encode(), "row 3001"),
    "time backwards": ((HEADER + LINES + "\n0.500,0.1,0.1\n").encode(), "row 3001"),
    "few samples": ((HEADER + "\n".join(LINES.split("\n")[:200])).encode(), "shorten window.length"),
}


@pytest.mark.parametrize("case", BAD_FILES)
def test_bad_files_end_in_one_line(run, job: Path, case: str) -> None:  # type: ignore[no-untyped-def]
    content, message = BAD_FILES[case]
    (job.parent / "joint.csv").write_bytes(content)
    refused(run, job, message)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"position_rad"', '"positon_rad"', "did you mean 'position_rad'"),
        ('unit = "rad"', 'unit = "parsnip"', "parsnip"),
        ('unit = "rad"', 'unit = "kg"', "kg"),
        ("position_cutoff = 40", "position_cutoff = 4000", "between 0 and 500 Hz"),
        ("length = 1", "length = 0.02", "cannot determine 4 parameters"),
        ("length = 1", "length = 60", "shorten window.length"),
        ('time = "time_s"', 'time = "time_s"\ngear_ratio = -2', "gear_ratio"),
        ("joint.csv", "joint.parquet", "there is no such file"),
    ],
)
def test_bad_jobs_end_in_one_line(run, job: Path, old: str, new: str, message: str) -> None:  # type: ignore[no-untyped-def]
    job.write_text(job.read_text().replace(old, new, 1))
    refused(run, job, message)


def test_truncated_and_pickled_files_end_in_one_line(run, job: Path) -> None:  # type: ignore[no-untyped-def]
    folder, text = job.parent, job.read_text()
    save_recording(joint(), folder / "joint.parquet")
    (folder / "joint.parquet").write_bytes((folder / "joint.parquet").read_bytes()[:2000])
    job.write_text(text.replace("joint.csv", "joint.parquet"))
    refused(run, job, "joint.parquet")
    savemat(folder / "joint.mat", {"time_s": TIME, "position_rad": TIME, "torque_Nm": TIME})
    (folder / "joint.mat").write_bytes((folder / "joint.mat").read_bytes()[:-1000])
    job.write_text(text.replace("joint.csv", "joint.mat"))
    refused(run, job, "it was cut")
    (folder / "joint.mat").write_bytes(b"MATLAB 5.0 MAT-file" + b" " * 200)
    job.write_text(text.replace("joint.csv", "joint.mat"))
    refused(run, job, "joint.mat")
    np.savez(folder / "joint.npz", time_s=TIME, position_rad=np.array([{}], dtype=object), torque_Nm=TIME)
    job.write_text(text.replace("joint.csv", "joint.npz"))
    refused(run, job, "Python objects")


def refused(run, job: Path, message: str) -> None:  # type: ignore[no-untyped-def]
    before = {path.name for path in job.parent.iterdir()}
    status, _, complained = run("identify", job, "--out", job.parent / "out")
    assert status == 1
    assert complained.startswith("error: ")
    assert complained.strip().count("\n") == 0
    assert message in complained
    assert {path.name for path in job.parent.iterdir()} == before


def test_of_compiled_code_the_oldest_goes_where_there_is_much_of_it(tmp_path: Path) -> None:
    for k in range(5):
        (tmp_path / f"program{k}").write_bytes(bytes(100))
        os.utime(tmp_path / f"program{k}", (1000 - k, 1000 - k))
    keep_small(tmp_path, 1000)
    assert len(os.listdir(tmp_path)) == 5
    keep_small(tmp_path, 250)
    assert sorted(os.listdir(tmp_path)) == ["program0", "program1"]
