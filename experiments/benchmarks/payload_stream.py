"""A load weighed in a stream: microseconds of the processor for a sample of a six-joint arm, and for an estimate.

One sample at a time, in chunks of fifty, and the estimate with its interval and its test for a change. Writes
results/payload_stream.json and .md.

    python experiments/benchmarks/payload_stream.py
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import numpy as np

from jaximp.identification import PayloadWindow
from jaximp.models import SIX_JOINT_ARM, Chain

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parents[1] / "results"
RATE, WINDOW, SAMPLES, CHUNK, ROUNDS = 500.0, 4.0, 2000, 50, 5
WANTED = 1000.0
"""Microseconds for a sample."""


def fastest(function: Callable[[], Any]) -> float:
    """Microseconds of the processor, the least of several rounds."""
    times = []
    for _ in range(ROUNDS):
        begin = time.process_time()
        jax.block_until_ready(function())
        times.append(time.process_time() - begin)
    return 1e6 * min(times)


def main() -> None:
    chain = Chain.from_urdf(SIX_JOINT_ARM, friction=True, rotor=True)
    p = len(chain.names)
    t = np.arange(SAMPLES)[:, None] / RATE
    w = 2 * np.pi * np.array([0.2, 0.3, 0.45, 0.6, 0.8, 1.1])
    motion = np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t)
    torque = np.asarray(chain.observation_matrix(*motion)) @ chain.parameters
    torque += np.random.default_rng(0).normal(size=torque.shape)
    weigh = PayloadWindow(chain, chain.parameters, 1e-4 * np.eye(p), WINDOW, RATE)

    def passed(chunk: int) -> Any:
        state = weigh.start()
        for k in range(0, SAMPLES, chunk):
            here = slice(k, k + chunk) if chunk > 1 else k
            state = weigh.update(state, *(x[here] for x in (*motion, torque)))
        return state

    begin = time.perf_counter()
    state = passed(CHUNK)
    weigh.estimate(state)
    compile_seconds = time.perf_counter() - begin
    found = {
        "joints": chain.n_joints,
        "robot's parameters": p,
        "one sample at a time [us a sample]": fastest(lambda: passed(1)) / SAMPLES,
        f"chunks of {CHUNK} [us a sample]": fastest(lambda: passed(CHUNK)) / SAMPLES,
        "estimate with interval [us]": fastest(lambda: [weigh.estimate(state).mass for _ in range(20)]) / 20,
        "wanted [us a sample]": WANTED,
        "first update and estimate [s]": compile_seconds,
    }
    (RESULTS / "payload_stream.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    rows = [f"| {name} | {value:.3g} |" for name, value in found.items()]
    table = "\n".join(["| | |", "| --- | --- |", *rows]) + "\n"
    (RESULTS / "payload_stream.md").write_text(table, encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
