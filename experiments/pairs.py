"""A human in a robot: do 95 % intervals hold the truth where the motions differ, or the robot does?

The ankle of `ankles` in a robot with friction and gravity, 60 s alone and 60 s together: motion, noise, the human, by
how much the motions differ, and what changes of the robot are drawn for every pair. Windows of 2 s side by side. Writes
experiments/results/pairs.json and pairs.md.

    python experiments/pairs.py [--pairs 60] [--cases NAME ...]
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import ankles
import jax
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import estimate
from jaximp.identification.pipeline import Pipeline
from jaximp.models import RobotJoint
from jaximp.recordings import recording_from_arrays
from jaximp.types import Recording, RobotAlone

jax.config.update("jax_enable_x64", True)

Numbers = NDArray[np.float64]
PAIRS, SECONDS, RATE = 60, 60.0, 500.0
NAMES = ("inertia", "damping", "stiffness")
ROBOT = {"gravity_x": 0.3, "gravity_y": 0.05, "viscous_friction": 0.4, "coulomb_friction": 0.8, "inertia": 0.015}
MOTIONS, NOISES = ("random", "multisine"), ("white", "pink", "AR(1) of 50 ms")
FOLDER = Path(__file__).parent / "results"


@dataclass(frozen=True)
class Case:
    """What is not the same, and what the job says of it."""

    methods: tuple[int, ...] = (1, 3)
    motion: tuple[float, float] = (0.0, 0.0)
    """Least and largest share by which the motion of the robot alone differs, drawn evenly."""
    changes: Mapping[str, float] | None = None
    """Standard deviation of the robot's change to the recording with the human, as a share of each parameter."""
    shift: Mapping[str, float] | None = None
    """A change that is the same in all pairs."""
    drift: float | None = None
    """As the job states it."""
    after: bool = False
    """Whether the robot was recorded again; it was somewhere between both with the human then."""


CASES: dict[str, Case] = {
    "same motion": Case((1, 2, 3, 4)),
    "motions differ by 0 to 5 %": Case((1, 3, 4), (0.0, 0.05)),
    "motions differ by 5 to 10 %": Case((1, 3), (0.05, 0.10)),
    "other motions": Case((3,), (1.0, 1.0)),
    "viscous friction and inertia change by 3 %": Case((1, 3, 4), changes={"viscous_friction": 0.03, "inertia": 0.03}),
    "the same, robot_drift = 0.03": Case((1, 2, 3, 4), changes={"viscous_friction": 0.03, "inertia": 0.03}, drift=0.03),
    "they change by 10 %, and the robot is recorded again": Case(
        (1, 2, 3, 4), changes={"viscous_friction": 0.10, "inertia": 0.10}, after=True
    ),
    "Coulomb friction 20 % larger": Case((1, 3, 4), shift={"coulomb_friction": 0.2}),
}


def motion_like(random: np.random.Generator, motion: ankles.Motion, name: str, share: float) -> ankles.Motion:
    """One whose every frequency differs by such a share; or another one."""
    if share >= 1:
        return ankles.move(random, name, RATE, SECONDS)
    lines = random.normal(size=(2, len(motion.spectrum))) / np.sqrt(2)
    return replace(motion, spectrum=motion.spectrum * (1 + share * (lines[0] + 1j * lines[1])))


def changed(shares: Mapping[str, float]) -> dict[str, float]:
    return {name: value * (1 + shares.get(name, 0)) for name, value in ROBOT.items()}


def recorded(motion: ankles.Motion, noise: Numbers, robot: Mapping[str, float], human: Numbers) -> Recording:
    """A robot, and a human (inertia, damping, stiffness, offset) that may be zero."""
    q, dq, ddq = motion.position, motion.velocity, motion.through(lambda s: s**2)
    rows = RobotJoint().regressor(q, dq, ddq)
    torque = np.asarray(rows) @ np.array(list(robot.values()))
    torque = torque + np.stack([ddq, dq, q, np.ones_like(q)], axis=1) @ human
    return recording_from_arrays(np.arange(len(q)) / RATE, q, torque + noise)


def pair(random: np.random.Generator, case: Case) -> tuple[Recording, RobotAlone, dict[str, float]]:
    """The robot with the human, the robot alone, and the truth."""
    truth = {name: ankles.TRUTH[name] * float(np.exp(random.normal(0, 0.3))) for name in NAMES}
    human = np.array([*truth.values(), ankles.TRUTH["offset_torque"]])
    name, noise = str(random.choice(MOTIONS)), str(random.choice(NOISES))
    moved = {name: sd * float(random.normal()) for name, sd in (case.changes or {}).items()} | dict(case.shift or {})
    at = float(random.random()) if case.after else 1.0
    motion = ankles.move(random, name, RATE, SECONDS)
    first = motion_like(random, motion, name, random.uniform(*case.motion))
    now = changed({name: at * share for name, share in moved.items()})
    level = ankles.NOISE * float(np.exp(random.uniform(np.log(0.1), 0)))
    noises = [level * ankles.NOISES[noise](random, one) for one in (motion, first, first)]
    held = recorded(motion, noises[0], now, human)
    alone: RobotAlone = recorded(first, noises[1], ROBOT, 0 * human)
    if case.after:
        assert isinstance(alone, Recording)
        alone = alone, recorded(first, noises[2], changed(moved), 0 * human)
    return held, alone, truth


def pipeline(case: Case) -> Pipeline:
    usual = ankles.pipeline(RATE, 2.0)
    window = replace(usual.window, step=2.0)
    return replace(usual, window=window, robot=RobotJoint(), methods=case.methods, robot_drift=case.drift)


def judged(found: Estimates, truth: Mapping[str, float]) -> dict[str, Any]:
    """How many of the windows hold the truth in each parameter, of all and of the trusted."""
    low, high = found.interval()
    value = np.array([truth[name] for name in NAMES])
    inside = (low[:, :3] < value) & (value < high[:, :3])
    trusted = np.stack([found.trusted_in(name) for name in NAMES], axis=1)
    return {
        "held": inside.mean(axis=0).tolist(),
        "trusted": trusted.mean(axis=0).tolist(),
        "held_if_trusted": [float(x[t].mean()) if t.any() else None for x, t in zip(inside.T, trusted.T, strict=True)],
        "off": np.median(found.value[:, :3] / value - 1, axis=0).tolist(),
        "stderr": np.median(found.stderr[:, :3] / value, axis=0).tolist(),
        "reason": next((str(r) for r in found.verdicts.reason if r), ""),
    }


def run(name: str, pairs: int) -> dict[int, list[dict[str, Any]]]:
    case, found = CASES[name], dict[int, list[dict[str, Any]]]()
    for k in range(pairs):
        random = np.random.default_rng((list(CASES).index(name), k))
        held, alone, truth = pair(random, case)
        for one in estimate(pipeline(case), held, alone):
            assert one.method is not None
            found.setdefault(one.method, []).append(judged(one, truth))
    return found


def table(results: Mapping[str, Mapping[int, list[dict[str, Any]]]]) -> str:
    lines = [
        "Windows of 2 s whose 95 % interval holds the truth, and windows that are trusted: inertia / damping / "
        "stiffness. Root mean square of the error of a pair's median, and the median standard error of a window.",
        "",
        "| pairs | method | hold the truth | of the trusted | trusted | error | standard error |",
        "| --- |" + " --- |" * 6,
    ]
    for name, by_method in results.items():
        for method, pairs in by_method.items():
            held, trusted = (100 * np.mean([one[key] for one in pairs], axis=0) for key in ("held", "trusted"))
            off = 100 * np.sqrt(np.mean(np.square([one["off"] for one in pairs]), axis=0))
            error = 100 * np.median([one["stderr"] for one in pairs], axis=0)
            sure = [[x for one in pairs if (x := one["held_if_trusted"][j]) is not None] for j in range(3)]
            of_trusted = " / ".join(f"{100 * np.mean(x):.1f}" if x else "-" for x in sure)
            cells = [
                " / ".join(f"{x:.{d}f}" for x in row) for row, d in ((held, 1), (trusted, 0), (off, 1), (error, 1))
            ]
            lines.append(
                f"| {name} | {method} | {cells[0]} % | {of_trusted} % | {cells[1]} % | {cells[2]} % | {cells[3]} % |"
            )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--pairs", type=int, default=PAIRS)
    arguments.add_argument("--cases", nargs="+", choices=CASES, default=list(CASES))
    given = arguments.parse_args()
    results = {}
    for name in given.cases:
        results[name] = run(name, given.pairs)
        (FOLDER / "pairs.json").write_text(json.dumps(results) + "\n")
        (FOLDER / "pairs.md").write_text(table(results))
    print(table(results))
