"""Many recordings by one command against a loop over files; two workers against one; memory; compilations.

Recordings of 10 s at 1 kHz of a simulated joint, in Parquet; model with offset; windows of 2 s every 10 ms; filters run
once over each recording. Two jobs: `decimated` (low-pass of all columns, one row of ten kept, standard errors for
coloured noise) and `every sample` (low-pass of the position alone, 1 kHz rows, white noise). The loops read the same
files with pyarrow, filter with scipy and solve every window with numpy's least squares, for theta alone or with
standard errors (those of white noise), condition number and variance accounted for; or all windows with statsmodels'
RollingOLS, theta alone. The batch's time is that of a whole run, compilation and overview among it. All is measured in
one run of this script. Writes results/batch.json and .md.

The batch estimates the noise and tests the model, as it does by default; beside it runs one with the filters' noise.

    python experiments/benchmarks/batch.py [recordings, 10000 by default]
"""

from __future__ import annotations

import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np

jax.config.update("jax_enable_x64", True)
compiled: list[str] = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **about: compiled.append(event) if event.endswith("backend_compile_duration") else None
)

from jaximp.batch import find_items, make_plan  # noqa: E402
from jaximp.batch import results as batch_results  # noqa: E402
from jaximp.batch import run as batch  # noqa: E402
from jaximp.identification import rows as identification_rows  # noqa: E402
from jaximp.jobs import Job, read_job  # noqa: E402
from jaximp.recordings import recording_from_arrays, save_recording  # noqa: E402

HERE = Path(__file__).parent
DISTINCT = 100
"""Different recordings; the others are hard links to them."""
IN_LOOP = 12
"""Recordings that the loops are timed on."""
JOB = """
[recording]
file = "r00000.parquet"
time = "time_s"
position = "position_rad"
torque = "torque_Nm"
[model]
human = true
[filter]
position_cutoff = 40
{filter}
[window]
length = 2
step = 0.01
noise = "{noise}"
"""
JOBS = {"decimated": "decimation_cutoff = 20", "every_sample": ""}


def simulate(folder: Path, count: int, lengths: bool = False) -> None:
    """Recordings of a joint that moves at three frequencies; `lengths` makes as many different ones as it can."""
    lines = ((0.2, 1.1, 0.0), (0.1, 2.9, 0.5), (0.04, 6.3, 1.0))
    folder.mkdir()
    for k in range(min(count, DISTINCT) if not lengths else count):
        n = 5000 + 5 * k if lengths else 10_000
        t, random = np.arange(n) * 1e-3, np.random.default_rng(k)
        q, dq, ddq = (
            sum(a * (2 * np.pi * f) ** j * np.sin(2 * np.pi * f * t + p + j * np.pi / 2) for a, f, p in lines)
            for j in range(3)
        )
        torque = 0.1 * ddq + 1.5 * dq + (20 + 0.1 * k) * q - 2 + random.normal(0, 0.2, n)
        recording = recording_from_arrays(t, q + random.normal(0, 1e-4, n), torque)
        save_recording(recording, folder / f"r{k:05d}.parquet")
    for k in range(DISTINCT, 0 if lengths else count):
        os.link(folder / f"r{k % DISTINCT:05d}.parquet", folder / f"r{k:05d}.parquet")
    for name, text in JOBS.items():
        (folder / f"{name}.toml").write_text(JOB.format(filter=text, noise="estimated"))
        (folder / f"{name}_filtered.toml").write_text(JOB.format(filter=text, noise="filtered"))


def rows_by_scipy(path: Path, low_pass: bool) -> tuple[np.ndarray, np.ndarray, int]:
    """What anybody would write: read, filter, differentiate, filter, decimate."""
    import pyarrow.parquet as pq
    from scipy.signal import butter, sosfiltfilt

    table = pq.read_table(path, columns=["position_rad", "torque_Nm"])
    q, torque = (column.to_numpy() for column in table.columns)
    q = sosfiltfilt(butter(8, 40, fs=1000, output="sos"), q)
    dq = np.gradient(q, 1e-3)
    W = np.stack([np.gradient(dq, 1e-3), dq, q, np.ones_like(q)], axis=1)
    if not low_pass:
        return W, torque, 1
    sos = butter(4, 20, fs=1000, output="sos")
    return sosfiltfilt(sos, W, axis=0)[::10], sosfiltfilt(sos, torque)[::10], 10


def loop(path: Path, low_pass: bool, statistics: bool) -> None:
    """Numpy's least squares, window by window."""
    W, y, n = rows_by_scipy(path, low_pass)
    window, step = 2000 // n, 10 // n
    for first in range(0, len(W) - window + 1, step):
        A, b = W[first : first + window], y[first : first + window]
        theta, rss, _, singular = np.linalg.lstsq(A, b)
        if statistics:
            R = np.linalg.qr(A, mode="r")
            inverse = np.linalg.inv(R)
            _ = np.sqrt(rss / (window - 4) * (inverse**2).sum(axis=1)), singular[0] / singular[-1]
            _ = 1 - np.var(b - A @ theta) / np.var(b)


def rolling(path: Path, low_pass: bool) -> None:
    """Statsmodels, every row; its windows cannot step."""
    from statsmodels.regression.rolling import RollingOLS

    W, y, n = rows_by_scipy(path, low_pass)
    RollingOLS(y, W, 2000 // n).fit(params_only=True)


def seconds(function: Callable[[], Any], clock: Callable[[], float] = time.perf_counter) -> float:
    begin = clock()
    function()
    return clock() - begin


def per_file(folder: Path, function: Callable[[Path], None]) -> tuple[float, float]:
    """Median time of a file, by the clock and of all processors together [ms]."""
    function(folder / "r00000.parquet")
    both = []
    for k in range(IN_LOOP):
        begin = time.process_time()
        wall = seconds(lambda k=k: function(folder / f"r{k:05d}.parquet"))
        both.append((1e3 * wall, 1e3 * (time.process_time() - begin)))
    wall, processor = np.median(both, axis=0).tolist()
    return wall, processor


def one_run(folder: Path, job: Job, out: Path, **options: Any) -> list[tuple[float, int]]:
    """When how many recordings were done [s]."""
    times: list[tuple[float, int]] = []
    begin = time.perf_counter()

    def tell(event: dict[str, Any]) -> None:
        if event["event"] == "batch":
            times.append((time.perf_counter() - begin, event["done"]))

    outcome = batch.run(job, [folder / "r*.parquet"], out, tell=tell, **options)
    assert outcome.exit_status == 0
    times.append((time.perf_counter() - begin, outcome.recordings))
    shutil.rmtree(out)
    return times


def rate(times: list[tuple[float, int]]) -> float:
    """Recordings per second once everything is compiled: behind the first third."""
    first = next(k for k, (_, done) in enumerate(times) if done >= times[-1][1] / 3)
    (begin, before), (end, after) = times[first], times[-1]
    return (after - before) / (end - begin)


def phases(folder: Path, job: Job, out: Path) -> dict[str, float]:
    """Where the time of a batch goes [ms per recording], on one thread."""
    plan = make_plan(job, find_items([str(folder / "r*.parquet")]))
    task, spent = batch_results.Task.of(job, plan, out), {"read": 0.0, "solve": 0.0, "measure": 0.0}
    originals = {"read": batch_results._read, "solve": batch_results._prepared, "measure": batch_results.measure}

    def timed(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def call(*args: Any) -> Any:
            begin = time.perf_counter()
            found = function(*args)
            spent[name] += time.perf_counter() - begin
            return found

        return call

    batch_results._read = timed("read", originals["read"])
    batch_results._prepared = timed("solve", originals["solve"])
    batch_results.measure = timed("measure", originals["measure"])
    chosen = [one for one in plan.batches if len(one.items) == one.stacked][:4]
    total = seconds(lambda: [batch_results.solve_batch(task, one) for one in chosen])
    batch_results._read, batch_results._prepared = originals["read"], originals["solve"]
    batch_results.measure = originals["measure"]
    count = sum(len(one.items) for one in chosen)
    spent["read"], spent["solve"] = spent["read"] - spent["measure"], spent["solve"] + spent["measure"]
    found = {f"{name}_ms": 1e3 * spent[name] / count for name in ("read", "solve")}
    return found | {"overhead_ms": 1e3 * (total - spent["read"] - spent["solve"]) / count}


def peak_memory(folder: Path, job: Path, out: Path) -> float:
    """Of a whole run in a process of its own [MB]."""
    command = [sys.executable, __file__, "--memory", str(folder), str(job), str(out)]
    return float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])


def main(count: int) -> None:
    results: dict[str, Any] = {"recordings": count, "cores": os.cpu_count(), "load_before": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as temporary:
        top = Path(temporary)
        folder = top / "study"
        simulate(folder, count)
        for which in JOBS:
            job, low_pass = read_job(folder / f"{which}.toml"), which == "decimated"
            loops: dict[str, Callable[[Path], None]] = {
                "loop_theta": lambda path, f=low_pass: loop(path, f, False),
                "loop_statistics": lambda path, f=low_pass: loop(path, f, True),
                "rolling_ols": lambda path, f=low_pass: rolling(path, f),
            }
            found: dict[str, Any] = {}
            for name, function in loops.items():
                found[f"{name}_ms"], found[f"{name}_processor_ms"] = per_file(folder, function)
            begin = time.process_time()
            times = one_run(folder, job, top / which)
            found["batch_processor_ms"] = 1e3 * (time.process_time() - begin) / count
            found |= {"batch_ms": 1e3 * times[-1][0] / count, "batch_once_compiled_ms": 1e3 / rate(times)}
            begin = time.process_time()
            one_run(folder, read_job(folder / f"{which}_filtered.toml"), top / f"{which}_filtered")
            found["filtered_processor_ms"] = 1e3 * (time.process_time() - begin) / count
            found["estimated_over_filtered"] = found["batch_processor_ms"] / found["filtered_processor_ms"]
            times = one_run(folder, job, top / which, workers=2)
            found["two_workers_ms"] = 1e3 * times[-1][0] / count
            one_worker = one_run(folder, job, top / which, workers=1)
            found["two_workers_over_one"] = rate(times) / rate(one_worker)
            faster = min(found["loop_theta_ms"], found["rolling_ols_ms"])
            found["times_faster_than_theta_alone"] = faster / found["batch_ms"]
            found["times_faster_than_with_statistics"] = found["loop_statistics_ms"] / found["batch_ms"]
            found |= phases(folder, job, top / f"{which}_phases")
            results[which] = found
            print(which, found, flush=True)
        job = read_job(folder / "every_sample.toml")
        simulate(top / "few", max(1, count // 10))
        memory = [peak_memory(one, folder / "every_sample.toml", top / "memory") for one in (top / "few", folder)]
        results |= {"peak_mb_tenth": memory[0], "peak_mb_all": memory[1], "peak_ratio": memory[1] / memory[0]}
        simulate(top / "lengths", 1000, lengths=True)
        jax.clear_caches()
        identification_rows._known.clear()
        compiled.clear()
        one_run(top / "lengths", job, top / "l")
        results["compilations_1000_lengths"] = len(compiled)
    results["load_after"] = os.getloadavg()[0]
    write(results)


def write(results: dict[str, Any]) -> None:
    rounded = json.loads(json.dumps(results), parse_float=lambda text: float(f"{float(text):.3g}"))
    (HERE.parent / "results" / "batch.json").write_text(json.dumps(rounded, indent=1) + "\n")
    columns = "decimated", "every_sample"
    rows = [
        ("loop, theta alone [ms]", "loop_theta_ms"),
        ("loop, with statistics [ms]", "loop_statistics_ms"),
        ("statsmodels RollingOLS, theta alone [ms]", "rolling_ols_ms"),
        ("batch, in process [ms]", "batch_ms"),
        ("batch, in process, once compiled [ms]", "batch_once_compiled_ms"),
        ("batch, two workers [ms]", "two_workers_ms"),
        ("loop, theta alone, of all processors [ms]", "loop_theta_processor_ms"),
        ("loop, with statistics, of all processors [ms]", "loop_statistics_processor_ms"),
        ("RollingOLS, of all processors [ms]", "rolling_ols_processor_ms"),
        ("batch in process, of all processors [ms]", "batch_processor_ms"),
        ("the same with the filters' noise and no tests, of all processors [ms]", "filtered_processor_ms"),
        ("estimated noise and tests, over that", "estimated_over_filtered"),
        ("two workers over one, once compiled", "two_workers_over_one"),
        ("times faster than the faster of theta alone", "times_faster_than_theta_alone"),
        ("times faster than the loop with statistics", "times_faster_than_with_statistics"),
        ("of it reading, one thread [ms]", "read_ms"),
        ("of it filtering and solving, one thread [ms]", "solve_ms"),
        ("all else, one thread [ms]", "overhead_ms"),
    ]
    lines = [
        f"{results['recordings']} recordings of 10 s at 1 kHz on {results['cores']} cores; milliseconds per recording.",
        "", "| | one row of ten | every sample |", "|---|---|---|",
        *(f"| {title} | {rounded[columns[0]][key]:g} | {rounded[columns[1]][key]:g} |" for title, key in rows),
        "",
        f"Peak memory of a tenth of the recordings and of all: {rounded['peak_mb_tenth']:g} and "
        f"{rounded['peak_mb_all']:g} MB. Programs compiled for 1000 lengths: "
        f"{rounded['compilations_1000_lengths']}. Load of the machine before and after: {rounded['load_before']:g}, "
        f"{rounded['load_after']:g}: above the number of cores, others took their share of all times.",
    ]  # fmt: skip
    (HERE.parent / "results" / "batch.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--memory"]:
        where, job_file, to = (Path(text) for text in sys.argv[2:5])
        one_run(where, read_job(job_file), to)
        print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3)
    else:
        main(int(sys.argv[1]) if len(sys.argv) > 1 else 10_000)
