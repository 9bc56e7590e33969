"""Ctrl-C and SIGTERM end every command, leave nothing half-written, and are not lost."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import command_line
from paths import ROOT

HEARD = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
"""A job in the background of a shell ignores SIGINT, and so do its children."""
PROGRAM = [sys.executable, "-c", f"{HEARD}from jaximp.cli.main import main; main()"]
LOSES_IT = f"""{HEARD}
import gc, time
from jaximp.cli.signals import signals_heard
def lose(phase, about):
    gc.callbacks.remove(lose)
    signal.raise_signal(NUMBER)
    for _ in range(10_000):
        pass
with signals_heard():
    gc.callbacks.append(lose)
    gc.collect()
    print("lost", flush=True)
    time.sleep(60)
"""


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    try:
        said, complained = process.communicate(timeout=90)
    finally:
        process.kill()
    return process.returncode, said, complained


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("command", ["identify", "check", "posterior"])
def test_a_command_ends_and_leaves_nothing_behind(command: str, number: signal.Signals, tmp_path: Path) -> None:
    """Where it is in the middle of its work: with a folder that has no name yet, if it makes one."""
    for name in ("ankle.toml", "ankle.csv"):
        shutil.copy(ROOT / "examples" / name, tmp_path)
    before = sorted(os.listdir(tmp_path))
    arguments = [command, "ankle.toml"] + ([] if command == "check" else ["--out", "out"])
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([*PROGRAM, *arguments], cwd=tmp_path, **pipes)
    for _ in range(600):
        if command == "check" or sorted(os.listdir(tmp_path)) != before:
            break
        time.sleep(0.05)
    time.sleep(2.0)
    process.send_signal(number)
    status, _, complained = ended(process)
    assert status == 128 + number, complained
    assert complained.strip().splitlines()[-1] == "interrupted"
    assert "Traceback" not in complained
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_that_python_drops_is_raised_again(number: signal.Signals) -> None:
    code = LOSES_IT.replace("NUMBER", f"signal.{number.name}")
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    status, said, _ = ended(subprocess.Popen([sys.executable, "-c", code], **pipes))
    assert said == "lost\n"
    assert status == 128 + number


def test_a_command_inside_somebodys_program_leaves_its_signals_alone() -> None:
    before = signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM), sys.unraisablehook
    assert command_line.jaximp("--version") == 0
    assert (signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM), sys.unraisablehook) == before
