"""Stiffness that changes: `track` against sliding windows whose length was chosen knowing the truth.

A simulated ankle of 60 s: small pseudo-random steps of the position, torque noise with a memory of 0.3 s, 45 Hz
low-pass, 0.3 Hz high-pass, rows at 100 Hz. Inertia and damping are constant, the stiffness is a sine, a ramp, a square
wave or constant; `track` is told none of it. Rows are made white by the autoregression of what windows of 2 s leave.

Total error: root mean square of estimate less truth, over instants and records; its parts are the bias, of the mean
estimate over the records, and the random error around it. Smoother against centred windows, filter against trailing
ones, all of white rows, at the same instants; one length per truth, that with the least total error. Rise time: from
10 to 90 % of the upward steps in the mean estimate of the filter, and of the trailing window of 2 s.
Measures after van de Ruit et al. 2021: also the variance of the white torque that is accounted for. Beside them rivals
from the literature (`time_varying_rivals`), and the rise time on the simulated rig of Tout et al. 2023, whose stiffness
doubles. Writes experiments/results/time_varying.json, .md and .png.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np
import time_varying_rivals as rivals
from numpy.typing import NDArray

from jaximp import plots, signals, sliding_least_squares, track
from jaximp.least_squares.autoregression import fit_window_noise, whiten_rows
from jaximp.papers.tout2023 import human_rows
from jaximp.simulation.rig import ROBOT_TRAJECTORY, HumanLoad
from jaximp.simulation.rig_recordings import rig_recordings

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
RIG_SECONDS, DOUBLES, RIG_EVERY = 20.0, 10.0, 50  # s, s, samples


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
    """Estimates in all records."""

    def __init__(self) -> None:
        self.estimates: list[Numbers] = []
        self.accounted: list[float] = []

    def add(self, theta: Numbers, W: Numbers, y: Numbers, which: NDArray[np.bool_]) -> None:
        """Parameters (N, 3), judged at these instants."""
        self.estimates.append(theta[:, 2])
        self.accounted.append(float(1 - np.var((y - (W * theta).sum(axis=1))[which]) / np.var(y[which])))

    def measured(self, truth: Numbers, which: NDArray[np.bool_]) -> dict[str, float]:
        all_records = np.array(self.estimates)[:, which]
        bias, spread = all_records.mean(axis=0) - truth[which], all_records.std(axis=0)
        return {
            "total": float(np.sqrt(np.mean((all_records - truth[which]) ** 2))),
            "bias": float(np.sqrt(np.mean(bias**2))),
            "random": float(np.sqrt(np.mean(spread**2))),
            "accounted": float(np.mean(self.accounted)) if self.accounted else float("nan"),
        }


def windows(W: Numbers, y: Numbers, seconds: float, every: int = EVERY) -> Numbers:
    """(M, 3) parameters of all windows of this length."""
    return np.asarray(sliding_least_squares(W, y, round(seconds * RATE / every), 1).theta)


def rise_time(mean: Numbers, time: Numbers) -> float:
    """[s] from the mean estimate (G,) after all upward steps."""
    ups = [t for t in np.arange(PERIOD, SECONDS, 2 * PERIOD) if t > BEGUN]
    after = np.arange(round(PERIOD / GRID))
    step = np.mean([mean[np.searchsorted(time, t - 1e-9) + after] for t in ups], axis=0)
    share = (step - LOW) / (HIGH - LOW)
    return float((np.argmax(share > 0.9) - np.argmax(share > 0.1)) * GRID)


def instants() -> tuple[Numbers, NDArray[np.bool_], NDArray[np.bool_]]:
    """Time of the rows, and which are judged: of what knows the whole record, and of what knows the past."""
    time = np.arange(round(SECONDS * RATE) // EVERY) * EVERY / RATE
    return time, (time >= EDGE) & (time < SECONDS - EDGE), (time >= BEGUN) & (time < SECONDS - EDGE)


def study(truth: str, records: int, first: int) -> tuple[dict[str, Any], dict[str, Numbers]]:
    """What was measured, and mean estimates of the filters."""
    time, inside, begun = instants()
    n, K = len(time), stiffness(truth, time)
    true = np.column_stack([np.full(n, INERTIA), np.full(n, DAMPING), K])
    centred, trailing = ({length: Errors() for length in LENGTHS} for _ in range(2))
    offline: dict[str, Errors] = {name: Errors() for name in ("smoother", "whole record", "basis expansion")}
    causal: dict[str, Errors] = {"filter": Errors()}
    covered: dict[str, list[Numbers]] = {"smoother": [], "filter": []}
    smooth, moves, rows = [], [], []
    for seed in range(first, first + records):
        W, y = white(*simulated(truth, seed))
        rows.append((W, y))
        found = track(W, y, grid=GRID, sample_rate=RATE / EVERY, names=NAMES, units=UNITS)
        smooth.append(found.smooth)
        moves.append(found.drift.moves)
        for name, path, which in (("smoother", found.path, inside), ("filter", found.filtered, begun)):
            low, high = path.interval(0.95)
            covered[name].append(((low <= true) & (true <= high))[which].mean(axis=0))
        offline["smoother"].add(found.value, W, y, inside)
        causal["filter"].add(np.asarray(found.filtered.theta), W, y, begun)
        offline["whole record"].add(np.tile(np.linalg.lstsq(W, y)[0], (n, 1)), W, y, inside)
        offline["basis expansion"].add(rivals.basis_expansion(W, y), W, y, inside)
        for name, theta in rivals.causal(W, y, RATE / EVERY).items():
            causal.setdefault(name, Errors()).add(theta, W, y, begun)
        for length in LENGTHS:
            theta = windows(W, y, length)
            size = n - len(theta) + 1
            middle = np.clip(np.arange(n) - size // 2, 0, len(theta) - 1)
            centred[length].add(theta[middle], W, y, inside)
            trailing[length].add(theta[np.clip(np.arange(n) - size + 1, 0, None)], W, y, begun)
    for name, several in rivals.ensembles(rows, RATE / EVERY).items():
        offline[name] = Errors()
        for theta in several:
            offline[name].add(theta, *rows[0], inside)

    found_here: dict[str, Any] = {"records": records, "smooth": float(np.mean(smooth))}
    found_here["moves"] = dict(zip(NAMES, np.mean(moves, axis=0).tolist(), strict=True))
    for name, ours, of_lengths, which in (
        ("smoother", offline, centred, inside), ("filter", causal, trailing, begun),
    ):  # fmt: skip
        by_length = {length: errors.measured(K, which) for length, errors in of_lengths.items()}
        best = min(by_length, key=lambda length: by_length[length]["total"])
        error, shares = ours[name].measured(K, which), np.array(covered[name])
        ours["best window"] = of_lengths[best]
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
        fit = offline["whole record"].measured(K, inside)
        found_here["whole_record"] = {**fit, "ratio": found_here["smoother"]["error"]["total"] / fit["total"]}
    causal["window of 2 s"] = trailing[TRAILING]
    means = {name: np.mean(one.estimates, axis=0) for name, one in (causal | offline).items()}
    found_here["methods"] = {
        kind: {name: one.measured(K, which) for name, one in several.items()}
        for kind, several, which in (("whole record", offline, inside), ("past", causal, begun))
    }
    if truth == "step":
        found_here["rise_time_s"] = {name: rise_time(mean, time) for name, mean in means.items()}
    return found_here, {"truth": K, **means}


def rig(records: int, first: int) -> dict[str, Any]:
    """The simulated rig of the paper, whose handle becomes twice as stiff: rows of the human's model, below 10 Hz and
    taken at 20 Hz, where their noise is nearly white."""
    ours, window, covered = [], [], []
    human = HumanLoad(step_time=DOUBLES)
    for seed in range(first, first + records):
        recordings = rig_recordings(human, seed, ROBOT_TRAJECTORY, RIG_SECONDS)
        W, y, valid, time = (np.asarray(x)[::RIG_EVERY] for x in human_rows(recordings, False))
        W, y = W * valid[:, None], y * valid
        found = track(W, y, grid=RIG_EVERY / RATE, sample_rate=RATE / RIG_EVERY, valid=valid)
        ours.append(np.asarray(found.filtered.theta)[:, 2])
        theta = windows(W, y, TRAILING, RIG_EVERY)[:, 2]
        window.append(np.append(np.full(len(y) - len(theta), theta[0]), theta))
        low, high = found.interval(0.95)
        true = np.where(time < DOUBLES, float(human.stiffness), float(human.stiffness_after))
        covered.append(float(((low[:, 2] <= true) & (true <= high[:, 2])).mean()))
    after, before = time >= DOUBLES, (time > TRAILING + EDGE) & (time < DOUBLES)
    levels = float(human.stiffness), float(human.stiffness_after)

    def rise(estimates: list[Numbers]) -> float:
        share = (np.mean(estimates, axis=0)[after] - levels[0]) / (levels[1] - levels[0])
        return float((np.argmax(share > 0.9) - np.argmax(share > 0.1)) * RIG_EVERY / RATE)

    def noise(estimates: list[Numbers]) -> float:
        return float(np.sqrt(np.mean(np.var(np.array(estimates)[:, before], axis=0))) / levels[0])

    return {
        "records": records,
        "rise_time_s": {"filter": rise(ours), "window of 2 s": rise(window)},
        "noise": {"filter": noise(ours), "window of 2 s": noise(window)},
        "covered": float(np.mean(covered)),
    }


def run(records: int, truths: list[str], first: int = 0) -> tuple[dict[str, Any], Any]:
    """What was measured, and a figure of the mean estimates of the square wave."""
    found: dict[str, Any] = {}
    panels = []
    time = instants()[0]
    for truth in truths:
        found[truth], means = study(truth, records, first)
        shown = (time > BEGUN) & (time < 58)
        for title, names in (
            ("what is known up to each instant", ("truth", "filter", "window of 2 s", "RLS 0.999")),
            (
                "the whole record",
                ("truth", "smoother", "basis expansion", f"segments of {min(rivals.TRIALS, records)}"),
            ),
        ):
            lines = [(name, time[shown], means[name][shown]) for name in names]
            if truth == "step":
                panels.append(plots.Panel(f"Mean estimate, {title}", "time [s]", "N m/rad", lines))
    found["rig"] = rig(max(2, records // 2), first)
    return found, plots.curves(panels) if panels else None


def table(found: dict[str, Any]) -> str:
    """The square wave and the sine, method by method."""
    lines = [
        "| | square wave: total error | bias | random | rise time [s] | VAF [%] | sine: total | ramp: total |",
        "|---|---|---|---|---|---|---|---|",
    ]
    step = found["step"]
    for kind, title in (("whole record", "from the whole record"), ("past", "from the past")):
        lines.append(f"| **{title}** | | | | | | | |")
        for name, one in step["methods"][kind].items():
            others = [f"{found[truth]['methods'][kind][name]['total']:.1f}" for truth in ("sine", "ramp")]
            label = {"smoother": "`track`", "filter": "`track`, filter"}.get(name, name)
            errors = " | ".join(f"{one[key]:.1f}" for key in ("total", "bias", "random"))
            lines.append(
                f"| {label} | {errors} | {step['rise_time_s'][name]:.2f} | {100 * one['accounted']:.1f} | "
                f"{' | '.join(others)} |"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=30)
    parser.add_argument("--first", type=int, default=0, help="seed of the first record")
    parser.add_argument("--truths", nargs="+", default=["sine", "ramp", "step", "constant"])
    parser.add_argument("--into", type=Path, default=RESULTS / "time_varying.json")
    given = parser.parse_args()
    result, drawn = run(given.records, given.truths, given.first)
    given.into.write_text(json.dumps(result, indent=1) + "\n")
    if {"step", "sine", "ramp"} <= set(given.truths):
        given.into.with_suffix(".md").write_text(table(result))
        drawn.savefig(given.into.with_suffix(".png"), dpi=90)
        print(table(result))
    print(json.dumps(result["rig"]))
