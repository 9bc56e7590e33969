"""A load weighed in a stream: how often intervals hold the mass, and whether changes are seen where there are some.

The simulated arm of six joints of `payload.py`, known as well as 20 s of it alone tell it (what is believed of it is
drawn from these errors), with a load of 2 kg that grows by 30 % in the middle of the window, or does not. Full windows
of 4 s at 200 Hz, with white noise and with noise that remembers 50 ms and 0.2 s (a block of the window lasts 0.2 s).
And the real arm of `payload.py` with its 2.805 kg, in windows of 5 s: gains and robot from the first half of the pair,
the load from the second; every 2.5 s an estimate.

Writes experiments/results/payload_windows.json and payload_windows.md.

    python experiments/payload_stream.py [--records 300]
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from payload import DATA, FILTER, GAINS, MASS, OTHER, RATE, RESULTS, arm, measured, real, real_arm
from scipy.signal import lfilter

from jaximp.identification import PayloadWindow, Pipeline, identify_gains, identify_robot
from jaximp.identification.payload import load_columns
from jaximp.signals import differentiate, filter_zero_phase
from jaximp.simulation import exciting_motion, true_parameters

WINDOW, GROWN, MOTIONS = 4.0, 1.3, 8
MEMORIES = {"white": 0.0, "memory of 50 ms": 0.05, "memory of 0.2 s": 0.2}
NOISE = 0.005
"""Of the largest torque of each joint."""
REAL_WINDOW, EVERY = 5.0, 250


def windows(records: int, memory: float) -> dict[str, Any]:
    """Full windows, each with motion, noise, robot and load of its own."""
    chain, n = arm(), round(WINDOW * RATE)
    alone = measured(np.random.default_rng(1), 0, "", 0.2)
    robot = identify_robot(Pipeline(RATE, chain, filter=FILTER), replace(alone, torque=alone.torque * GAINS))
    truth, (values, axes) = np.asarray(chain.base.map) @ true_parameters(chain, 1), np.linalg.eigh(robot.covariance)
    root = axes * np.sqrt(np.maximum(values, 0))
    random, t, columns = np.random.default_rng(13), np.arange(n) / RATE, load_columns(chain)
    old = np.exp(-1 / (memory * RATE)) if memory else 0.0
    off, claimed, inside, changed = [], [], [], {1.0: 0, GROWN: 0}
    for k in range(records):
        series = exciting_motion(chain, 20.0, seed=k % MOTIONS)
        motion = [np.asarray(x) for x in series(jnp.asarray(t + random.uniform(0, 16)))]
        W = np.asarray(chain.observation_matrix(*motion))
        size = NOISE * np.abs(W @ truth).max(axis=0)
        white = random.normal(size=(n + 500, 6))
        noise = size * lfilter([np.sqrt(1 - old**2)], [1, -old], white, axis=0)[500:]
        believed = truth + root @ random.normal(size=len(truth))
        weigh = PayloadWindow(chain, believed, robot.covariance, WINDOW, RATE, size=robot.size)
        for factor in changed:
            load = np.where((t < WINDOW / 2)[:, None], 1.0, factor) * OTHER
            torque = np.einsum("snp,sp->sn", W, truth + load @ columns.T) + noise
            found = weigh.estimate(weigh.update(weigh.start(), *motion, torque))
            changed[factor] += found.changed
            if factor == 1.0:
                low, high = found.mass.interval()
                inside.append(bool(low < OTHER[0] < high))
                off.append(float(found.mass.value) - OTHER[0])
                claimed.append(float(found.mass.stderr))
        print(f"\r{k + 1}/{records}", end="", flush=True)
    print()
    known = np.isfinite(off)
    return {
        "records": records,
        "mass is known": float(known.mean()),
        "intervals of 95 % that hold": float(np.array(inside)[known].mean()),
        "standard deviation [kg]": float(np.std(np.array(off)[known])),
        "claimed [kg]": float(np.sqrt(np.mean(np.square(np.array(claimed)[known])))),
        "changes seen where there are none": changed[1.0] / records,
        "changes seen of 30 %": changed[GROWN] / records,
    }


def of_real_arm() -> dict[str, Any]:
    """The second half of the recording with the load, as a stream of filtered samples."""
    pipeline = real_arm()
    gains = identify_gains(pipeline, real("alone", 0), real("loaded", 0), MASS)
    robot = identify_robot(pipeline, gains.applied(real("alone", 0)))
    loaded, low_pass = gains.applied(real("loaded", 1)), pipeline.filters.position
    q, torque = (np.asarray(filter_zero_phase(low_pass, x)) for x in (loaded.position, loaded.torque))
    dq, ddq = (np.asarray(x) for x in differentiate(q, loaded.sample_rate, pipeline.filters.differentiator))
    weigh = PayloadWindow.of(robot, REAL_WINDOW, loaded.sample_rate)
    state, masses, changes = weigh.start(), [], 0
    for k in range(0, len(q) - EVERY + 1, EVERY):
        state = weigh.update(state, *(x[k : k + EVERY] for x in (q, dq, ddq, torque)))
        found = weigh.estimate(state)
        if (k + EVERY) / loaded.sample_rate >= REAL_WINDOW:
            low, high = found.mass.interval()
            masses.append([float(found.mass.value), float(low), float(high)])
            changes += found.changed
    value, low, high = np.array(masses).T
    return {
        "estimates": len(masses),
        "mass [kg]": value.tolist(),
        "half of the interval [kg]": ((high - low) / 2).tolist(),
        "intervals of 95 % that hold": float(np.mean((low < MASS) & (high > MASS))),
        "changes seen where there are none": changes / len(masses),
    }


def table(found: dict[str, Any]) -> str:
    keys = [key for key in next(iter(found["simulation"].values())) if key != "records"]
    lines = ["| noise | " + " | ".join(keys) + " |", "| --- " * (len(keys) + 1) + "|"]
    for noise, cell in found["simulation"].items():
        lines.append(f"| {noise} | " + " | ".join(f"{cell[key]:.3g}" for key in keys) + " |")
    if "real" in found:
        of = found["real"]
        masses = ", ".join(f"{one:.2f}" for one in of["mass [kg]"])
        lines += [
            "",
            f"Real arm, 2.805 kg: {masses} kg, half of the interval {np.median(of['half of the interval [kg]']):.2f} "
            f"kg; {of['intervals of 95 % that hold']:.0%} hold it, and in "
            f"{of['changes seen where there are none']:.0%} a change was seen that was none.",
        ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=300)
    records = parser.parse_args().records
    found: dict[str, Any] = {"simulation": {name: windows(records, memory) for name, memory in MEMORIES.items()}}
    if DATA.is_dir():
        found["real"] = of_real_arm()
    (RESULTS / "payload_windows.json").write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    (RESULTS / "payload_windows.md").write_text(table(found), encoding="utf-8")
    print(table(found))


if __name__ == "__main__":
    main()
