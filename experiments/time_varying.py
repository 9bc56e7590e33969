"""Stiffness that changes: `track` against sliding windows whose length was chosen knowing the truth.

A simulated ankle of 60 s: small pseudo-random steps of the position, torque noise with a memory of 0.3 s, 45 Hz
low-pass, 0.3 Hz high-pass, rows at 100 Hz. Inertia and damping are constant, the stiffness is a sine, a ramp, a square
wave or constant; `track` is told none of it. Rows are made white by the autoregression of what windows of 2 s leave.

Total error: root mean square of estimate less truth, over instants and records; its parts are the bias, of the mean
estimate over the records, and the random error around it. Smoother against centred windows, filter against trailing
ones, all of white rows, at the same instants; one length per truth, that with the least total error. Rise time: from
10 to 90 % of the upward steps in the mean estimate of the filter, and of the trailing window of 2 s.
Measures after van de Ruit et al. 2021. Writes experiments/results/time_varying.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaximp import signals, sliding_least_squares, track
from jaximp.least_squares.autoregression import fit_window_noise, whiten_rows

jax.config.update("jax_enable_x64", True)

Numbers = NDArray[np.float64]

RESULTS = Path(__file__).parent / "results"
NAMES, UNITS = ("inertia", "damping", "stiffness"), ("kg m^2", "N m s/rad", "N m/rad")
INERTIA, DAMPING, LOW, HIGH = 0.018, 1.1, 60.0, 120.0
SECONDS, RATE, EVERY, GRID = 60.0, 1000.0, 10, 0.01
EDGE, BEGUN = 1.0, 16.0  # s from the ends that are not judged, and before the first instant of filters
LENGTHS = np.array([0.4, 0.6, 0.8, 1.0, 1.4, 2.0, 2.8, 4.0, 6.0, 8.0, 11.0, 15.0])  # s
PERIOD = 10.0  # s, of a square wave's half
TRAILING = 2.0  # s


def stiffness(truth: str, t: Numbers) -> Numbers:
    match truth:
        case "sine":
            return 80 + 40 * np.sin(2 * np.pi * t / 12)
        case "ramp":
            return np.interp(t, [20.0, 40.0], [LOW, HIGH])
        case "step":
            return np.where(t // PERIOD % 2 == 0, LOW, HIGH)
    return np.full(len(t), 80.0)


def simulated(truth: str, seed: int) -> tuple[Numbers, Numbers]:
    """Rows (N, 3) and torque (N,) as they were filtered."""
    from scipy.signal import lfilter

    random, n = np.random.default_rng(seed), round(SECONDS * RATE)
    levels = np.repeat(random.choice([-1.0, 1.0], n // 150 + 1), 150)[:n]
    q = 0.016 * np.asarray(signals.filter_zero_phase(signals.butterworth(2, 12, RATE), levels))
    dq, ddq = (np.asarray(x) for x in signals.central_differences(q, RATE))
    decay = np.exp(-1 / (0.3 * RATE))
    slow = 0.5 * np.sqrt(1 - decay**2) * lfilter([1.0], [1.0, -decay], random.normal(size=n))
    K = stiffness(truth, np.arange(n) / RATE)
    torque = INERTIA * ddq + DAMPING * dq + K * q + slow + 0.02 * random.normal(size=n)
    z = np.column_stack([ddq, dq, q, torque])
    for sos in (signals.butterworth(4, 45, RATE), signals.butterworth(2, 0.3, RATE, kind="highpass")):
        z = np.asarray(signals.filter_zero_phase(sos, z))
    return z[::EVERY, :3], z[::EVERY, 3]


def white(W: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    counts = np.ones(len(y), bool)
    noise = fit_window_noise(W, y, counts, round(2 * RATE / EVERY))
    z = whiten_rows(np.column_stack([W, y]), counts, noise)
    return z[:, :3], z[:, 3]


class Errors:
    """Estimates of the stiffness in all records."""

    def __init__(self) -> None:
        self.estimates: list[Numbers] = []

    def measured(self, truth: Numbers) -> dict[str, float]:
        all_records = np.array(self.estimates)
        bias, spread = all_records.mean(axis=0) - truth, all_records.std(axis=0)
        return {
            "total": float(np.sqrt(np.mean((all_records - truth) ** 2))),
            "bias": float(np.sqrt(np.mean(bias**2))),
            "random": float(np.sqrt(np.mean(spread**2))),
        }


def windows(W: Numbers, y: Numbers, seconds: float) -> Numbers:
    """(M,) stiffness of all windows of this length."""
    return np.asarray(sliding_least_squares(W, y, round(seconds * RATE / EVERY), 1).theta)[:, 2]


def rise_time(mean: Numbers, time: Numbers) -> float:
    """[s] from the mean estimate (G,) after all upward steps."""
    ups = [t for t in np.arange(PERIOD, SECONDS, 2 * PERIOD) if t > BEGUN]
    after = np.arange(round(PERIOD / GRID))
    step = np.mean([mean[np.searchsorted(time, t - 1e-9) + after] for t in ups], axis=0)
    share = (step - LOW) / (HIGH - LOW)
    return float((np.argmax(share > 0.9) - np.argmax(share > 0.1)) * GRID)


def study(truth: str, records: int, first: int) -> dict[str, Any]:
    n = round(SECONDS * RATE) // EVERY
    time = np.arange(n) * EVERY / RATE
    K = stiffness(truth, time)
    inside, begun = (time >= EDGE) & (time < SECONDS - EDGE), (time >= BEGUN) & (time < SECONDS - EDGE)
    true = np.column_stack([np.full(n, INERTIA), np.full(n, DAMPING), K])
    ours = {"smoother": Errors(), "filter": Errors()}
    centred, trailing, whole = ({length: Errors() for length in LENGTHS} for _ in range(3))
    covered: dict[str, list[Numbers]] = {name: [] for name in ours}
    smooth, moves = [], []
    for seed in range(first, first + records):
        W, y = white(*simulated(truth, seed))
        found = track(W, y, grid=GRID, sample_rate=RATE / EVERY, names=NAMES, units=UNITS)
        smooth.append(found.smooth)
        moves.append(found.drift.moves)
        for name, path, which in (("smoother", found.path, inside), ("filter", found.filtered, begun)):
            ours[name].estimates.append(np.asarray(path.theta)[:, 2])
            low, high = path.interval(0.95)
            covered[name].append(((low <= true) & (true <= high))[which].mean(axis=0))
        for length in LENGTHS:
            estimate = windows(W, y, length)
            size = n - len(estimate) + 1
            centred[length].estimates.append(np.interp(np.arange(n), np.arange(len(estimate)) + size // 2, estimate))
            trailing[length].estimates.append(np.append(np.full(size - 1, estimate[0]), estimate))
        whole[LENGTHS[0]].estimates.append(np.full(n, np.linalg.lstsq(W, y)[0][2]))

    def of(errors: Errors, which: NDArray[np.bool_]) -> dict[str, float]:
        cut = Errors()
        cut.estimates = [estimate[which] for estimate in errors.estimates]
        return cut.measured(K[which])

    found_here: dict[str, Any] = {"records": records, "smooth": float(np.mean(smooth))}
    found_here["moves"] = dict(zip(NAMES, np.mean(moves, axis=0).tolist(), strict=True))
    for name, rivals, which in (("smoother", centred, inside), ("filter", trailing, begun)):
        by_length = {length: of(errors, which) for length, errors in rivals.items()}
        best = min(by_length, key=lambda length: by_length[length]["total"])
        error, shares = of(ours[name], which), np.array(covered[name])
        found_here[name] = {
            "error": error,
            "best_window_s": float(best),
            "error_of_best_window": by_length[best],
            "ratio": error["total"] / by_length[best]["total"],
            "covered": dict(zip(NAMES, shares.mean(axis=0).tolist(), strict=True)),
            "standard_error_of_covered": dict(
                zip(NAMES, (shares.std(axis=0) / np.sqrt(records)).tolist(), strict=True)
            ),
        }
    if truth == "constant":
        fit = of(whole[LENGTHS[0]], inside)
        found_here["whole_record"] = {**fit, "ratio": found_here["smoother"]["error"]["total"] / fit["total"]}
    if truth == "step":
        means = (np.mean(one.estimates, axis=0) for one in (ours["filter"], trailing[TRAILING]))
        found_here["rise_time_s"] = dict(
            zip(("filter", "window of 2 s"), (rise_time(m, time) for m in means), strict=True)
        )
    return found_here


def run(records: int, truths: list[str], first: int = 0) -> dict[str, Any]:
    return {truth: study(truth, records, first) for truth in truths}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=400)
    parser.add_argument("--first", type=int, default=0, help="seed of the first record")
    parser.add_argument("--truths", nargs="+", default=["sine", "ramp", "step", "constant"])
    parser.add_argument("--into", type=Path, default=RESULTS / "time_varying.json")
    given = parser.parse_args()
    text = json.dumps(run(given.records, given.truths, given.first), indent=1)
    given.into.write_text(text + "\n")
    print(text)
