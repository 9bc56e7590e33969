"""The load of a robot of six joints: how often intervals hold the truth, and a real pair of recordings.

**Simulation.** The arm that comes with the package, with friction, on motions by formula; currents are its torques over
gains that nobody knows, with white noise or with noise that remembers 0.2 s, and encoders have steps. Gains come from a
pair of recordings without and with a load of 3 kg that is known, and another load of 2 kg from another pair, by all
methods.

**Real.** `ur10e` (JAXIMP_DATA, else ../shared/data): a pair without and with 2.805 kg at the flange, on one motion.
This was chosen before the load was looked at: the filters of the folder's notes (position 10 Hz, both sides 5 Hz); the
model of the held-out test (viscous and Coulomb friction, rotors, constants, signs over 0.005 rad/s); all rows, whatever
their velocity; for the gains, friction of its own with the load, as friction grows with it; the mass known without
error and the centre not at all; halves by rows. Other choices stand beside it.

Writes experiments/results/payload.json and payload.md.

    python experiments/payload.py [--records 100] [--skip-simulation]
"""

from __future__ import annotations

import argparse
import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import lfilter

from jaximp.identification import FilterSettings, Payload, Pipeline, identify_gains, identify_payload
from jaximp.identification.payload import LOAD_METHODS, load_columns
from jaximp.models import SIX_JOINT_ARM, Chain
from jaximp.models.spatial import about
from jaximp.recordings import recording_from_arrays, recordings_from_mapping
from jaximp.simulation import exciting_motion, true_parameters
from jaximp.types import Recording

jax.config.update("jax_enable_x64", True)

RESULTS = Path(__file__).parent / "results"
DATA = Path(os.environ.get("JAXIMP_DATA", Path(__file__).parents[2] / "shared" / "data")) / "ur10e"
FILTER = FilterSettings(position_cutoff=10.0, decimation_cutoff=5.0)

# --- simulation -------------------------------------------------------------------------------------------------------

RATE, SECONDS, WIDTH = 200.0, 20.0, 0.02
ENCODER = 2 * np.pi / 2**17
GAINS = np.array([12.0, 11.0, 9.0, 8.0, 9.5, 10.5])
KNOWN = about(3.0, np.array([0.02, -0.01, 0.06]), np.diag([0.008, 0.009, 0.006]))
OTHER = about(2.0, np.array([-0.03, 0.02, 0.09]), np.diag([0.006, 0.005, 0.004]))
MEMORIES = {"white": 0.0, "memory of 0.2 s": 0.2}


@cache
def arm() -> Chain:
    return Chain.from_urdf(SIX_JOINT_ARM, tip="tool", friction=True, rotor=True).with_sign_width(WIDTH)


@cache
def simulated(motion: int, load: str) -> tuple[Any, Any, Any]:
    """Time, encoder and true torque of a motion, of the robot alone or with a load."""
    chain, t = arm(), np.arange(round(SECONDS * RATE)) / RATE
    theta = np.asarray(chain.base.map) @ true_parameters(chain, 1)
    theta = theta + load_columns(chain) @ {"": np.zeros(10), "known": KNOWN, "other": OTHER}[load]
    q, dq, ddq = (np.asarray(x) for x in exciting_motion(chain, period=SECONDS, seed=motion)(jnp.asarray(t)))
    torque = np.asarray(chain.observation_matrix(q, dq, ddq)) @ theta
    return t, ENCODER * np.round(q / ENCODER), torque


def measured(random: np.random.Generator, motion: int, load: str, memory: float) -> Recording:
    """Currents with noise of 0.5 % of the largest torque of each joint, and three times as much where it is white."""
    time, position, torque = simulated(motion, load)
    white = random.normal(size=(len(time) + 1000, 6))
    old = np.exp(-1 / (memory * RATE)) if memory else 0.0
    noise = lfilter([np.sqrt(1 - old**2)], [1, -old], white, axis=0)[1000:]
    size = 0.005 * np.abs(torque).max(axis=0) * (3.0 if not memory else 1.0)
    return recording_from_arrays(
        time, position, (torque + size * noise) / GAINS, name=f"motion {motion} {load or 'alone'}"
    )


def coverage(records: int, memory: float) -> dict[str, Any]:
    """Of gains, and of the mass and centre of the other load."""
    pipeline = Pipeline(RATE, arm(), filter=FILTER)
    gains: list[Any] = []
    loads: dict[int, list[Any]] = {method: [] for method in LOAD_METHODS}
    for k in range(records):
        random = np.random.default_rng((11, k))
        pair = measured(random, 0, "", memory), measured(random, 1, "known", memory)
        drives = identify_gains(pipeline, *pair, mass=KNOWN[0])
        low, high = drives.interval()
        gains.append([drives.theta / GAINS - 1, drives.stderr / GAINS, (low < GAINS) & (high > GAINS)])
        alone, other = (drives.applied(measured(random, 2 + j, load, memory)) for j, load in ((0, ""), (1, "other")))
        same = drives.applied(measured(random, 2, "other", memory))
        for method, seen in loads.items():
            found = identify_payload(pipeline, alone, same if method == 3 else other, method)
            seen.append(held(found))
        print(f"\r{k + 1}/{records}", end="", flush=True)
    print()
    error, claimed, inside = np.moveaxis(np.array(gains), 1, 0)
    return {
        "records": records,
        "gains": {
            "intervals of 95 % that hold": inside.mean(axis=0).tolist(),
            "standard deviation [%]": (100 * error.std(axis=0)).tolist(),
            "claimed [%]": (100 * np.sqrt((claimed**2).mean(axis=0))).tolist(),
            "mean error [%]": (100 * error.mean(axis=0)).tolist(),
        },
        "other load": {f"method {method}": summary(seen) for method, seen in loads.items()},
    }


def held(found: Payload) -> list[Any]:
    truth = np.concatenate([OTHER[:1], OTHER[1:4] / OTHER[0]])
    estimate = np.concatenate([found.theta[:1], found.centre.theta])
    error = np.concatenate([found.stderr[:1], found.centre.stderr])
    (low, high), (near, far) = found.interval(), found.centre.interval()
    lower, upper = np.concatenate([low[:1], near]), np.concatenate([high[:1], far])
    return [estimate - truth, error, (lower < truth) & (truth < upper)]


def summary(seen: list[Any]) -> dict[str, Any]:
    error, claimed, inside = np.moveaxis(np.array(seen), 1, 0)
    names = ("mass", "centre_x", "centre_y", "centre_z")
    return {
        name: {
            "intervals of 95 % that hold": float(inside[:, k].mean()),
            "standard deviation": float(error[:, k].std()),
            "claimed": float(np.sqrt((claimed[:, k] ** 2).mean())),
            "mean error": float(error[:, k].mean()),
        }
        for k, name in enumerate(names)
    }


# --- the real arm -----------------------------------------------------------------------------------------------------

MASS = 2.805
OWNERS = [10.0, 10.70, 8.46, 9.00, 9.48, 10.12]
FILES = {"alone": ("14harm50sec.csv", 195, 4966), "loaded": ("14harm50secLoad.csv", 308, 5071)}


def real(which: str, half: int | None = None, gain: Any = None, gain_error: Any = None) -> Recording:
    """A recording of the arm, or its first (0) or second (1) half, in amperes or by gains."""
    file, first, last = FILES[which]
    middle = (first + last) // 2
    rows = {None: [first, last], 0: [first, middle], 1: [middle + 1, last]}[half]
    torque: dict[str, Any] = {"columns": [14, 15, 16, 17, 18, 19]}
    torque |= {"gain": gain} if gain else {}
    torque |= {"gain_error": gain_error} if gain_error else {}
    columns = {"time": 1, "position": [2, 3, 4, 5, 6, 7], "torque": torque}
    (found,) = recordings_from_mapping({"file": file, "rows": rows, **columns}, DATA)
    return replace(found, name=f"{which}{'' if half is None else f', half {half + 1}'}")


def real_arm(min_velocity: float = 0.0) -> Pipeline:
    chain = Chain.from_urdf(DATA / "ur10e.urdf", friction=True, rotor=True, offset=True, min_velocity=min_velocity)
    return Pipeline(100.0, chain.with_sign_width(0.005), filter=FILTER)


def said(found: Payload) -> dict[str, Any]:
    low, high = found.interval()
    mass = {"mass": found.theta[0], "stderr": found.stderr[0], "low": low[0], "high": high[0]}
    other = {"of gains": found.gain_stderr[0], "off [%]": 100 * (found.theta[0] / MASS - 1)}
    inside = {"holds": bool(low[0] < MASS < high[0]), "centre [m]": found.centre.theta.tolist()}
    return mass | other | inside | {"centre, stderr [m]": found.centre.stderr.tolist()}


def by_methods(pipeline: Pipeline, alone: Recording, loaded: Recording) -> dict[str, Any]:
    found = {method: identify_payload(pipeline, alone, loaded, method) for method in LOAD_METHODS}
    return {f"method {method}": said(one) for method, one in found.items()} | {"in words": found[4].in_words()}


def from_half(pipeline: Pipeline, half: int, **settings: Any) -> dict[str, Any]:
    """Gains from one half of the pair, the mass from the other."""
    gains = identify_gains(pipeline, real("alone", half), real("loaded", half), MASS, **settings)
    other = (gains.applied(real(which, 1 - half)) for which in FILES)
    found = {"gains": gains.theta.tolist(), "stderr": gains.stderr.tolist(), "gain_error [%]": gains.gain_error}
    return found | by_methods(pipeline, *other)


def of_real_arm() -> dict[str, Any]:
    pipeline = real_arm()
    error = {"common": 10}
    whole = [real(which, None, OWNERS, error) for which in FILES]
    found: dict[str, Any] = {"owners' gains, 10 % in common": by_methods(pipeline, *whole)}
    ways: dict[str, tuple[float, dict[str, Any]]] = {
        "as chosen": (0.0, {}),
        "the same friction with the load": (0.0, {"same_friction": True}),
        "rows above 0.02 rad/s": (0.02, {}),
        "rows above 0.05 rad/s": (0.05, {}),
    }
    for name, (least, settings) in ways.items():
        for half in (0, 1):
            place = f"gains from half {half + 1}, mass from half {2 - half}: {name}"
            found[place] = from_half(real_arm(least), half, **settings)
    return found


def table(found: dict[str, Any]) -> str:
    lines = []
    for noise, cell in found.get("simulation", {}).items():
        lines += [f"**Simulation, {noise}** ({cell['records']} records): intervals of 95 % that hold the truth", ""]
        inside = cell["gains"]["intervals of 95 % that hold"]
        lines += ["| | |", "| --- | --- |", f"| six gains | {' '.join(f'{100 * x:.1f}' for x in inside)} % |"]
        for method, of in cell["other load"].items():
            shares = " ".join(f"{100 * one['intervals of 95 % that hold']:.1f}" for one in of.values())
            lines.append(f"| {method}: mass, centre x y z | {shares} % |")
        lines.append("")
    for place, cell in found.get("real", {}).items():
        lines += [f"**{place}**", "", "| | mass [kg] | 95 % | off | holds 2.805 |", "| --- | --- | --- | --- | --- |"]
        for method, one in cell.items():
            if method.startswith("method"):
                interval = f"{one['low']:.3f} to {one['high']:.3f}"
                mass, off = f"{one['mass']:.3f} ± {one['stderr']:.3f}", f"{one['off [%]']:+.1f} %"
                lines.append(f"| {method} | {mass} | {interval} | {off} | {'yes' if one['holds'] else '**no**'} |")
        lines.append("")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--records", type=int, default=100)
    parser.add_argument("--skip-simulation", action="store_true")
    given = parser.parse_args()
    path = RESULTS / "payload.json"
    found = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    steps: dict[str, Callable[[], Any]] = {}
    if not given.skip_simulation:
        steps["simulation"] = lambda: {name: coverage(given.records, memory) for name, memory in MEMORIES.items()}
    if DATA.is_dir():
        steps["real"] = of_real_arm
    for name, step in steps.items():
        found[name] = step()
        path.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        (RESULTS / "payload.md").write_text(table(found), encoding="utf-8")
    print(table(found))


if __name__ == "__main__":
    main()
