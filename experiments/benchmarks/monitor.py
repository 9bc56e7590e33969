"""`jaximp monitor` at 1 kHz for ten minutes: milliseconds from a sample to its estimate, and how many samples wait.

A robot joint with five parameters, samples one by one. What a step takes is measured, and with it, for samples that
come a millisecond apart, how many would wait; for a minute also with the verdict in words ten times a second. What
other programs do to this stands beside it: the time of the processor that a step takes, which does not know them, and
between the samples a loop of Python that takes about as long as a step and does the same each time.
Writes results/monitor.json and .md.

    python experiments/benchmarks/monitor.py
"""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.live import Batch, Monitor, Sample, Stepper, calibrate, init, live_of
from jaximp.models.joint import RobotJoint

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parents[1] / "results"
RATE, MINUTES, CALIBRATED = 1000.0, 10, 10
WANTED = 1.0
"""Milliseconds at the 99.9th percentile."""
KINDS = {
    "rows at 50 Hz (decimation_cutoff = 20)": FilterSettings(position_cutoff=40.0, decimation_cutoff=20.0),
    "rows at 1 kHz, no low-pass": FilterSettings(),
}
WHAT = ("sample to estimate [ms]", "of the processor [ms]", "with verdicts [ms]", "machine by itself [ms]")
LINES = ((0.4, 1.1), (0.2, 2.9), (0.08, 6.3))


def recording(samples: int) -> Batch:
    """A joint with gravity, friction and inertia."""
    t = np.arange(samples) / RATE
    w = 2 * np.pi * np.array([f for _, f in LINES])
    a = np.array([a for a, _ in LINES])
    q = np.sin(t[:, None] * w) @ a
    dq, ddq = np.cos(t[:, None] * w) @ (a * w), -np.sin(t[:, None] * w) @ (a * w**2)
    torque = 9.81 * (0.4 * np.sin(q) + 0.1 * np.cos(q)) + 0.8 * dq + 0.5 * np.sign(dq) + 0.1 * ddq
    random = np.random.default_rng(0)
    return Batch(t, q + 1e-4 * random.normal(size=samples), torque + 0.2 * random.normal(size=samples))


def backlog(service: NDArray[np.float64]) -> int:
    """Most samples that wait, where one comes every millisecond and each takes so many milliseconds."""
    waits, most = 0.0, 0.0
    for one in service.tolist():
        waits = max(0.0, waits + one - 1e3 / RATE)
        most = max(most, waits)
    return int(most * RATE / 1e3)


def percentiles(times: NDArray[np.float64]) -> dict[str, float]:
    """Milliseconds."""
    return {f"{q:g}": float(np.percentile(times, q)) for q in (50, 99, 99.9, 100)}


def measured(settings: FilterSettings) -> dict[str, object]:
    pipeline = Pipeline(RATE, RobotJoint(), WindowSettings(length=2.0, step=0.1), settings)
    given = recording(round(60 * MINUTES * RATE))
    stretch = slice(0, round(CALIBRATED * RATE))
    begin = time.perf_counter()
    ok = np.ones(stretch.stop, bool)
    calibration = calibrate(pipeline, Sample(given.position[stretch], given.torque[stretch], ok))
    calibrated = time.perf_counter() - begin
    live = live_of(pipeline, calibration)
    begin = time.perf_counter()
    stepper = Stepper(live, init(live))
    stepper.compile()
    compiled = time.perf_counter() - begin
    took, processor, machine = [], [], []
    for k in range(len(given.time)):
        q, torque = float(given.position[k]), float(given.torque[k])
        begin, worked = time.perf_counter(), time.process_time()
        stepper(q, torque)
        took.append(1e3 * (time.perf_counter() - begin))
        processor.append(1e3 * (time.process_time() - worked))
        if k % 10 == 0:
            begin = time.perf_counter()
            sum(range(16000))
            machine.append(1e3 * (time.perf_counter() - begin))
    times = np.array(took)
    watch = Monitor(lambda rate: pipeline, sample_rate=RATE, calibration=calibration)
    with_words = []
    for k in range(round(60 * RATE)):
        one = Batch(*(x[k : k + 1] for x in given))
        begin = time.perf_counter()
        watch.feed(one)
        with_words.append(1e3 * (time.perf_counter() - begin))
    assert watch.latest is not None
    return {
        "parameters": len(pipeline.model.names),
        "samples": len(times),
        "sample to estimate [ms]": percentiles(times),
        "of the processor [ms]": percentiles(np.array(processor)),
        "with verdicts [ms]": percentiles(np.array(with_words[500:])),
        "machine by itself [ms]": percentiles(np.array(machine)),
        "share of samples above 1 ms": float((times > WANTED).mean()),
        "most samples that wait": backlog(times),
        "processor share": float(times.mean() / (1e3 / RATE)),
        "calibration [s]": calibrated,
        "compilation [s]": compiled,
        "delay of the estimate [s]": watch.delay,
        "lost": watch.counts.received - watch.counts.used,
        "verdict at the end": watch.latest.verdict.label,
    }


def main() -> None:
    found = {name: measured(settings) for name, settings in KINDS.items()}
    found["load of the machine"] = {"average of a minute": os.getloadavg()[0], "cores": os.cpu_count()}
    (RESULTS / "monitor.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    lines = ["| | median | 99 % | 99.9 % | largest | most that wait |", "| --- | --- | --- | --- | --- | --- |"]
    for name in KINDS:
        one = found[name]
        for what in WHAT:
            times = one[what]
            assert isinstance(times, dict)
            waits = one["most samples that wait"] if what.startswith("sample") else ""
            cells = [f"{times[q]:.2g}" for q in ("50", "99", "99.9", "100")]
            if what.startswith("sample") and times["99.9"] > WANTED:
                cells[2] = f"**{cells[2]}**"
            lines.append(f"| {name}: {what} | {' | '.join(cells)} | {waits} |")
    load = os.getloadavg()[0]
    lines.append(f"\nThe load of the machine was {load:.2g} on {os.cpu_count()} cores, this program included.")
    table = "\n".join(lines) + "\n"
    (RESULTS / "monitor.md").write_text(table, encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
