"""A human in a robot: do 95 % intervals hold the truth where the motions differ, or the robot does?

The rig of Tout et al. 2023 with its controller, alone and held, 60 s each: the human, the share by which the motions
differ, and what changes of the robot are drawn for every pair. Windows of 2 s side by side. Writes
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

import equinox as eqx
import jax
import numpy as np

from jaximp.identification import FilterSettings, WindowSettings
from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import estimate
from jaximp.identification.pipeline import Pipeline
from jaximp.models import HumanJoint, RobotJoint
from jaximp.motion.trajectories import FourierSeries
from jaximp.simulation.rig import HUMAN_TRAJECTORY, HumanLoad, Rig, record, simulate_rig
from jaximp.trust.limits import TrustLimits
from jaximp.types import Recording, RobotAlone

jax.config.update("jax_enable_x64", True)

PAIRS, SECONDS, RATIO = 60, 60.0, 15.0
NAMES = ("inertia", "damping", "stiffness")
USUAL = {"inertia": 4e-5, "damping": 2e-4, "stiffness": 2e-3}
"""Of the human, at the motor."""
OWN = {"coulomb_friction", "gravity_x", "gravity_y"}
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


def motion_of(random: np.random.Generator, share: float) -> FourierSeries:
    """The usual one, larger by such a share and with every harmonic turned; or another one."""
    usual = HUMAN_TRAJECTORY
    sine, cosine = np.asarray(usual.sine), np.asarray(usual.cosine)
    turn = random.normal(size=len(sine)) * (share if share < 1 else np.pi)
    size = 1 + share * random.choice([-1, 1]) * (share < 1)
    turned = (
        size * (np.cos(turn) * sine - np.sin(turn) * cosine),
        size * (np.sin(turn) * sine + np.cos(turn) * cosine),
    )
    return eqx.tree_at(lambda f: (f.sine, f.cosine), usual, turned)


def changed(rig: Rig, shares: Mapping[str, float]) -> Rig:
    return replace(rig, **{name: getattr(rig, name) * (1 + share) for name, share in shares.items()})


def pair(random: np.random.Generator, case: Case) -> tuple[Recording, RobotAlone, dict[str, float]]:
    """The robot with the human, the robot alone, and the truth."""
    truth = {name: usual * float(np.exp(random.normal(0, 0.3))) for name, usual in USUAL.items()}
    rig = replace(Rig(), gravity_y=3e-4)
    moved = {name: sd * float(random.normal()) for name, sd in (case.changes or {}).items()} | dict(case.shift or {})
    at = float(random.random()) if case.after else 1.0
    human = HumanLoad(stiffness_after=truth["stiffness"], **truth)
    keys = jax.random.split(jax.random.key(int(random.integers(1 << 31))), 3)
    first = motion_of(random, random.uniform(*case.motion))
    held = simulate_rig(changed(rig, {name: at * share for name, share in moved.items()}), HUMAN_TRAJECTORY, SECONDS,
                        human, key=keys[0])  # fmt: skip
    alone: RobotAlone = record(simulate_rig(rig, first, SECONDS, key=keys[1]), "before")
    if case.after:
        assert isinstance(alone, Recording)
        alone = alone, record(simulate_rig(changed(rig, moved), first, SECONDS, key=keys[2]), "after")
    return record(held, "held"), alone, truth


def pipeline(case: Case) -> Pipeline:
    return Pipeline(
        1000.0,
        HumanJoint(gear_ratio=RATIO),
        WindowSettings(2.0, 2.0, min_velocity=0.1),
        FilterSettings(position_cutoff=20, decimation_cutoff=10),
        TrustLimits(joint_name="other"),
        RobotJoint(RATIO),
        case.methods,
        robot_drift=case.drift,
    )


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
        "notes": [note for note in found.notes if "robot" in note or "motions" in note],
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
        (FOLDER / "pairs.json").write_text(json.dumps(results, indent=1) + "\n")
        (FOLDER / "pairs.md").write_text(table(results))
    print(table(results))
