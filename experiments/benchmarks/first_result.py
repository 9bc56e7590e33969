"""How long a person waits for the first result of every command, each in a process of its own, compilation included.

Each command runs with an empty cache of compiled programs and again with what the first left there; seconds on the
clock and of the processors, medians of several. Then the first call of `fit_stiffness` inside Python, plain, under
`jit` and under `vmap`. Writes results/first_result.json and .md.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
RESULTS = HERE.parent / "results"
COMMAND = str(Path(sys.executable).parent / "jaximp")
RATE, SECONDS, REPEATS = 1000.0, 60.0, 3

JOINT = """
[recording]
file = "ankle.npz"
sample_rate = 1000
position = "position"
torque = "torque"
[model]
human = {HUMAN}
[filter]
position_cutoff = 45
decimation_cutoff = 45
[window]
length = 5
"""
ARM = """
[recording]
file = "arm.npz"
sample_rate = 500
position = "q"
torque = "tau"
[model.arm]
equilibrium = [0.1, 1.0]
[filter]
position_cutoff = 20
decimation_cutoff = 10
[window]
length = 5
"""
FIT = """
import os, time
import jax
jax.config.update("jax_enable_x64", True)
import numpy as np
from jaximp.perturbation import fit_stiffness
random = np.random.default_rng(0)
q, dq = random.normal(size=(2, 20, 460, 2))
tau = dq @ np.array([[2.4, 1.2], [1.2, 1.4]]) + q @ np.array([[29.0, 14.0], [14.0, 17.0]])
tau += random.normal(0, 0.3, tau.shape)
work = {"plain": fit_stiffness, "jit": jax.jit(fit_stiffness), "vmap": jax.vmap(fit_stiffness)}["HOW"]
given = [x[None] if "HOW" == "vmap" else x for x in (q, dq, tau)]
begin = time.perf_counter(), time.process_time()
jax.block_until_ready(work(*given))
print(time.perf_counter() - begin[0], time.process_time() - begin[1])
"""


def coloured(random: np.random.Generator, n: int, highest: float, rate: float, joints: int) -> np.ndarray:
    """(n, joints) random motion of root mean square one up to a frequency [Hz]."""
    spectrum = np.fft.rfft(random.normal(size=(n, joints)), axis=0)
    spectrum[np.fft.rfftfreq(n, 1 / rate) > highest] = 0
    motion = np.fft.irfft(spectrum, n, axis=0)
    return motion / motion.std(axis=0)


def derivatives(q: np.ndarray, rate: float) -> tuple[np.ndarray, np.ndarray]:
    """Of a periodic motion."""
    w = 2j * np.pi * np.fft.rfftfreq(len(q), 1 / rate)[:, None]
    spectrum = np.fft.rfft(q, axis=0)
    return np.fft.irfft(w * spectrum, len(q), axis=0), np.fft.irfft(w**2 * spectrum, len(q), axis=0)


def write_recordings(folder: Path) -> None:
    """An ankle of 60 s at 1 kHz, and a horizontal arm of two joints of 60 s at 500 Hz."""
    random = np.random.default_rng(3)
    q = 0.03 * coloured(random, round(SECONDS * RATE), 20.0, RATE, 1)
    dq, ddq = derivatives(q, RATE)
    torque = (0.015 * ddq + 0.7 * dq + 60 * q)[:, 0] + random.normal(0, 0.3, len(q))
    np.savez(folder / "ankle.npz", position=q[:, 0], torque=torque)
    rate = RATE / 2
    q = 0.05 * coloured(random, round(SECONDS * rate), 8.0, rate, 2) + np.array([0.1, 1.0])
    dq, ddq = derivatives(q, rate)
    c, s = np.cos(q[:, 1]), np.sin(q[:, 1])
    i1, i2, i3 = 0.4, 0.08, 0.1
    mass = np.stack([i1 + 2 * i2 * c, i3 + i2 * c, i3 + i2 * c, np.full_like(c, i3)], axis=1).reshape(-1, 2, 2)
    around = i2 * s * np.stack([-2 * dq[:, 0] * dq[:, 1] - dq[:, 1] ** 2, dq[:, 0] ** 2]).reshape(2, -1)
    tau = np.einsum("nij,nj->ni", mass, ddq) + around.T
    tau += dq @ np.array([[2.4, 1.2], [1.2, 1.4]]) + (q - [0.1, 1.0]) @ np.array([[29.0, 14.0], [14.0, 17.0]])
    np.savez(folder / "arm.npz", q=q, tau=tau + random.normal(0, 0.1, tau.shape))
    for name, human in (("ankle", "{ offset = false }"), ("reflex", "{ offset = false, reflex = true }")):
        (folder / f"{name}.toml").write_text(JOINT.replace("{HUMAN}", human))
    (folder / "arm.toml").write_text(ARM)


COMMANDS = {
    "`jaximp --help`": ["--help"],
    "`check`, ankle of 60 s at 1 kHz": ["check", "ankle.toml"],
    "`identify`, the same": ["identify", "ankle.toml", "--out", "out", "--force"],
    "`identify`, with a reflex": ["identify", "reflex.toml", "--out", "out", "--force"],
    "`posterior`, the ankle": ["posterior", "ankle.toml", "--out", "out", "--force"],
    "`identify`, an arm of 60 s at 500 Hz": ["identify", "arm.toml", "--out", "out", "--force"],
}


def measured(command: Sequence[str], folder: Path, environment: dict[str, str]) -> tuple[float, float]:
    """Seconds on the clock and of the processors."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.perf_counter() - begin, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def median(several: Sequence[tuple[float, float]]) -> list[float]:
    return np.median(np.array(several), axis=0).round(2).tolist()


def of_commands() -> dict[str, dict[str, list[float]]]:
    found = {}
    for name, arguments in COMMANDS.items():
        cold, warm = [], []
        for _ in range(REPEATS):
            folder = Path(tempfile.mkdtemp())
            write_recordings(folder)
            environment = os.environ | {"XDG_CACHE_HOME": str(folder / "cache")}
            cold.append(measured([COMMAND, *arguments], folder, environment))
            warm.append(measured([COMMAND, *arguments], folder, environment))
            shutil.rmtree(folder)
        found[name] = {"empty_cache": median(cold), "with_cache": median(warm)}
        print(name, found[name], flush=True)
    return found


def of_fits() -> dict[str, dict[str, list[float]]]:
    """First calls in a new process that finds nothing in a cache."""
    found = {}
    for how in ("plain", "jit", "vmap"):
        several = []
        for _ in range(REPEATS):
            command = [sys.executable, "-c", FIT.replace("HOW", how)]
            said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
            several.append(tuple(map(float, said.split())))
        found[f"`fit_stiffness`, first call, {how}"] = {"empty_cache": median(several)}
        print(how, median(several), flush=True)
    return found


def machine() -> str:
    model = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")), "")
    return f"{os.cpu_count()} cores, {model.split(':')[-1].strip() or platform.processor()}"


def table(found: dict[str, dict[str, list[float]]]) -> str:
    lines = [
        "Seconds on the clock, and of the processors in brackets; medians of several.",
        "",
        "| what | first time ever | with what it left in the cache |",
        "| --- | --- | --- |",
    ]
    for name, times in found.items():
        cells = [f"{times[key][0]:.2g} ({times[key][1]:.2g})" if key in times else "" for key in KEYS]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


KEYS = ("empty_cache", "with_cache")


if __name__ == "__main__":
    found = of_commands() | of_fits()
    text = f"{machine()}\n\n{table(found)}\n"
    (RESULTS / "first_result.json").write_text(json.dumps({"machine": machine(), "seconds": found}, indent=1) + "\n")
    (RESULTS / "first_result.md").write_text(text)
    print(text)
