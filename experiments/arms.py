"""Simulated recordings of planar arms: a human's that a robot moves, and a robot's in the vertical plane. Each joint
has torque noise of its own, and some arms do what the model does not know.

Each joint moves as the ankle of `ankles` does, by a motion of its own that is known exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import ankles
import numpy as np
from ankles import Motion, Numbers
from scipy.signal import lfilter

from jaximp.identification.filter_settings import FilterSettings
from jaximp.identification.pipeline import Pipeline, WindowSettings
from jaximp.models import PlanarArm
from jaximp.recordings import recording_from_arrays
from jaximp.types import Recording

RATE, SECONDS, WINDOW = 500.0, 60.0, 2.0
NOISE = (0.3, 0.15)
"""Standard deviation of the torque noise of each joint [N m], above 10 Hz too."""
MEMORY = 0.1
"""Time constant of noise that is not white [s]."""
STEADY = (1.0, 1.0)
"""The gain of each joint's torque."""


@dataclass(frozen=True)
class Arm:
    """What an arm is, and what its model knows of it."""

    truth: Mapping[str, float]
    model: PlanarArm
    rest: tuple[float, float]
    """Middle of the motion of each joint [rad]."""
    size: float
    """Standard deviation of the motion [rad]."""


HUMAN = Arm(
    truth={
        "inertia_1": 0.268, "inertia_2": 0.084, "inertia_3": 0.074,
        "damping_11": 2.42, "damping_12": 1.2, "damping_21": 1.2, "damping_22": 1.42,
        "stiffness_11": 29.0, "stiffness_12": 14.4, "stiffness_21": 14.4, "stiffness_22": 17.1,
    },
    model=PlanarArm((0.1, 1.0)),
    rest=(0.1, 1.0),
    size=0.05,
)  # fmt: skip
ROBOT = Arm(
    truth={
        "inertia_1": 0.14, "inertia_3": 0.024, "gravity_1": 0.35, "gravity_2": 0.111, "rotor_inertia_2": 0.007,
        "viscous_friction_1": 0.05, "viscous_friction_2": 0.03, "coulomb_friction_1": 0.09, "coulomb_friction_2": 0.08,
    },
    model=PlanarArm(
        impedance=False, gravity=True, zero="hanging", length=0.3, rotor=True, viscous=True, coulomb=True
    ),
    rest=(0.5, 0.8),
    size=0.4,
)  # fmt: skip


@dataclass(frozen=True)
class Wrong:
    """What an arm does beside its model."""

    culprits: tuple[str, ...]
    """Groups any of which names it rightly, as `jaximp.identification.misfit` calls them."""
    friction: float = 0.0
    """Dry friction of joint 2 [N m]."""
    late: tuple[float, float] = (0.0, 0.0)
    """Seconds by which the torque of each joint is late."""
    drift: float = 0.0
    """Share of its stiffness and damping that joint 1 has more at the end of every window than at its beginning."""
    gain: float = 1.0
    """By which the torque of joint 2 is too large."""
    unknown: tuple[str, ...] = ()
    """Settings of the model that are left out."""


WRONG: Mapping[str, tuple[Arm, Wrong]] = {
    "dry friction of joint 2, 0.2 N m": (HUMAN, Wrong(("joint 2: friction",), friction=0.2)),
    "torque 1 late by 2 ms": (HUMAN, Wrong(("joint 1: delay", "joint 1: lag"), late=(0.002, 0.0))),
    "both torques late by 2 ms": (
        HUMAN, Wrong(("joint 1: delay", "joint 2: delay", "joint 1: lag", "joint 2: lag"), late=(0.002, 0.002))
    ),
    "stiffness of joint 1 that rises by 60 % in a record": (HUMAN, Wrong(("joint 1: drift",), drift=0.6)),
    "torque 2 too large by 20 %": (HUMAN, Wrong(("scale",), gain=1.2)),
    "robot without dry friction": (
        ROBOT, Wrong(("joint 1: friction", "joint 2: friction"), unknown=("coulomb",))
    ),
    "robot without viscous friction": (
        ROBOT, Wrong(("joint 1: viscous", "joint 2: viscous"), unknown=("viscous",))
    ),
    "robot without gravity": (ROBOT, Wrong(("gravity",), unknown=("gravity", "length"))),
    "robot, torque 2 late by 2 ms": (ROBOT, Wrong(("joint 2: delay", "joint 2: lag"), late=(0.0, 0.002))),
    "robot, torque 2 too large by 20 %": (ROBOT, Wrong(("scale",), gain=1.2)),
}  # fmt: skip


def known(arm: Arm, wrong: Wrong | None) -> PlanarArm:
    """The model that identifies it."""
    if wrong is None or not wrong.unknown:
        return arm.model
    settings = {
        "impedance": False, "gravity": True, "zero": "hanging", "length": 0.3, "rotor": True, "viscous": True,
        "coulomb": True,
    }  # fmt: skip
    kept = {name: value for name, value in settings.items() if name not in wrong.unknown}
    return PlanarArm(**kept)  # type: ignore[arg-type]


def record(
    random: np.random.Generator,
    arm: Arm = HUMAN,
    noise: str = "white",
    wrong: Wrong | None = None,
    *,
    rate: float = RATE,
    seconds: float = SECONDS,
    level: float = 1.0,
) -> Recording:
    """One recording, with noise that is `white` or an autoregression of first `order`; with `level` times `NOISE`."""
    wrong = Wrong(()) if wrong is None else wrong
    scale = arm.size / ankles.SIZE
    moved = [ankles.move(random, rate=rate, seconds=seconds) for _ in arm.rest]
    moved = [replace(one, spectrum=scale * one.spectrum) for one in moved]
    position = np.stack([one.position + rest for one, rest in zip(moved, arm.rest, strict=True)], axis=1)
    torque = np.stack([_torque(arm, wrong, moved, late)[:, j] for j, late in enumerate(wrong.late)], axis=1)
    torque = torque * [1.0, wrong.gain] + level * _noise(random, noise, len(position), rate) * NOISE
    return recording_from_arrays(np.arange(len(position)) / rate, position, torque)


def _torque(arm: Arm, wrong: Wrong, moved: list[Motion], late: float) -> Numbers:
    """(N, 2) of the motion some seconds ago."""
    motion = [
        np.stack([one.through(lambda s, k=k: s**k * np.exp(-s * late)) for one in moved], axis=1) for k in (0, 1, 2)
    ]
    motion[0] = motion[0] + arm.rest
    torque = np.array(arm.model.torque(np.array(list(arm.truth.values())), *motion))
    torque[:, 1] += wrong.friction * np.sign(motion[1][:, 1])
    if wrong.drift:
        risen = wrong.drift * (np.linspace(0, 1, len(torque)) - 0.5)
        for j in (0, 1):
            torque[:, 0] += risen * arm.truth[f"stiffness_1{j + 1}"] * (motion[0][:, j] - arm.rest[j])
            torque[:, 0] += risen * arm.truth[f"damping_1{j + 1}"] * motion[1][:, j]
    return torque


def _noise(random: np.random.Generator, kind: str, n: int, rate: float) -> Numbers:
    white = random.normal(size=(n, 2))
    if kind == "white":
        return white
    a = np.exp(-1 / (MEMORY * rate))
    start = random.normal(size=(1, 2))
    return np.asarray(lfilter([np.sqrt(1 - a**2)], [1, -a], white, axis=0, zi=a * start)[0])


def pipeline(
    arm: Arm = HUMAN, wrong: Wrong | None = None, rate: float = RATE, window: float = WINDOW, noise: str = "estimated"
) -> Pipeline:
    """Windows side by side, behind a low-pass above the motion."""
    return Pipeline(
        rate,
        known(arm, wrong),
        WindowSettings(window, step=window, noise=noise),
        FilterSettings(position_cutoff=min(40.0, 0.45 * rate), decimation_cutoff=20.0),
    )
