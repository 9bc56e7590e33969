"""The `[model.arm]` table of a job: the arm of two links, beside a recording of its joints or beside `[trials]`.

```toml
[model.arm]
lengths = [0.29, 0.34]     # m, of upper arm and forearm
# beside [recording], of the joints: which columns are identified
gravity = true             # then the first length, if it is given, ties inertia to gravity
equilibrium = [0.1, 1.0]   # rad: damping and stiffness about it
# beside [trials], of the hand: where the arm is, and its inertia (or [trials.posture])
shoulder = [0.0, 0.0]      # m
inertia = { upper_arm = 0.19, forearm = 0.074, coupling = 0.084 }   # kg m^2: I1 + m2 l1^2, I2, m2 c2 l1
```
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from jaximp.jobs.settings import settings
from jaximp.models.arm import PlanarArm
from jaximp.models.inertia import BASE_INERTIA, BaseInertia
from jaximp.models.kinematics import ArmGeometry

OF_JOINTS = ("equilibrium", "gravity", "viscous", "coulomb", "offset", "rotor", "g", "zero")
"""Keys that have a meaning beside a recording of the joints alone,"""
OF_HAND = ("elbow", "shoulder", "inertia_stderr")
"""and beside trials of the hand alone."""


@dataclass(frozen=True)
class InertiaSettings:
    """`[model.arm.inertia]` and `[model.arm.inertia_stderr]`, see `BaseInertia`."""

    upper_arm: float
    """`I_1 + m_2 l1^2` [kg m^2]."""
    forearm: float
    """`I_2` [kg m^2]."""
    coupling: float
    """`m_2 c_2 l1` [kg m^2]."""

    def make(self) -> BaseInertia:
        return BaseInertia(self.upper_arm, self.forearm, self.coupling)


@dataclass(frozen=True)
class ArmSettings:
    """`[model.arm]`."""

    lengths: list[float] | None = None
    """Of upper arm and forearm [m]. Trials of the hand need both. Beside a recording of the joints the first ties
    inertia to gravity, and the second may be left out."""
    elbow: str = "right"
    """On which side the elbow lies, seen from the shoulder along the line to the hand: `right` or `left`."""
    shoulder: list[float] = field(default_factory=lambda: [0.0, 0.0])
    """Where the shoulder is in the frame of the hand's position [m]."""
    inertia: bool | InertiaSettings = True
    """Beside a recording of the joints: whether it is identified. Beside trials: what it is, if it is known."""
    inertia_stderr: InertiaSettings | None = None
    """Standard errors of the inertia that is known [kg m^2]."""
    equilibrium: list[float] | None = None
    """Two angles [rad]; damping and stiffness about them are identified where it is given."""
    gravity: bool = False
    """Columns of gravity: the arm does not move in a horizontal plane."""
    viscous: bool = False
    """A column of viscous friction for each joint."""
    coulomb: bool = False
    """A column of Coulomb friction for each joint."""
    offset: bool = False
    """A column of a constant torque for each joint."""
    rotor: bool = False
    """A column of the inertia of the second motor's rotor behind its gear, which counts on its own joint alone."""
    g: float = 9.81
    """Acceleration of gravity [m/s^2]."""
    zero: str = "horizontal"
    """Where gravity acts: at angles of zero the arm is `horizontal`, or `hanging`."""

    def make(self) -> PlanarArm:
        """The model, for recordings of the joints."""
        columns = {name: getattr(self, name) for name in OF_JOINTS}
        length = self.lengths[0] if self.lengths else None
        return PlanarArm(**columns, inertia=bool(self.inertia), impedance=self.equilibrium is not None, length=length)

    def geometry(self) -> ArmGeometry:
        """Of an arm whose hand was recorded."""
        return ArmGeometry(self.lengths or [], self.elbow, self.shoulder)

    @property
    def known_inertia(self) -> BaseInertia | None:
        """Where the job gives it."""
        return self.inertia.make() if isinstance(self.inertia, InertiaSettings) else None

    @property
    def known_stderr(self) -> BaseInertia | None:
        """Its standard errors, where the job gives them."""
        return None if self.inertia_stderr is None else self.inertia_stderr.make()


def arm_of_joints(table: Any) -> ArmSettings:
    """`[model.arm]` of a job with a recording of the joints, or `arm = true`.

    **Raises:** `ValueError` that names the key and the remedy.
    """
    arm = _settings(table, OF_HAND, "[trials] of the hand")
    if isinstance(arm.inertia, InertiaSettings):
        raise ValueError(
            "model.arm.inertia is known beside [trials] alone: here it is true or false, whether it is identified"
        )
    if arm.lengths == []:
        raise ValueError("model.arm.lengths is []: give that of the upper arm [m], or leave it out")
    if arm.lengths is not None and not (arm.inertia and arm.gravity):
        raise ValueError(
            "model.arm.lengths tie inertia to gravity, and the job does not ask for both: leave them out, or set "
            "gravity = true"
        )
    arm.make()  # refuses what does not go together
    return arm


def arm_of_trials(table: Any) -> ArmSettings:
    """`[model.arm]` of a job with `[trials]`.

    **Raises:** `ValueError` that names the key and the remedy.
    """
    arm = _settings(table, OF_JOINTS, "a [recording] of the joints")
    if not arm.lengths:
        raise ValueError("[model.arm] has no 'lengths': add it, lengths = [upper arm, forearm] in m")
    arm.geometry()  # refuses lengths that cannot be
    if "inertia" in table and not isinstance(arm.inertia, InertiaSettings):
        raise ValueError(
            "model.arm.inertia is true or false beside a [recording] alone: here write what it is, inertia = { "
            "upper_arm = ..., forearm = ..., coupling = ... } in kg m^2, or leave it out beside [trials.posture]"
        )
    for key, one in (("inertia", arm.inertia), ("inertia_stderr", arm.inertia_stderr)):
        if isinstance(one, InertiaSettings) and not all(x > 0 and math.isfinite(x) for x in vars(one).values()):
            raise ValueError(f"model.arm.{key} is {vars(one)}: all must be numbers above zero, in kg m^2")
    if arm.inertia_stderr is not None and arm.known_inertia is None:
        raise ValueError("model.arm.inertia_stderr needs model.arm.inertia: add it")
    return arm


def _settings(table: Any, foreign: tuple[str, ...], where: str) -> ArmSettings:
    """Every key and type checked; `foreign` keys belong beside something else."""
    if table is True:
        return ArmSettings()
    if isinstance(table, dict):
        for key in foreign:
            if key in table:
                raise ValueError(f"model.arm.{key} is for {where}: leave it out")
        for key in ("inertia", "inertia_stderr"):
            _refuse_numbers_without_names(key, table.get(key))
        table = _with_lengths(table)
    return settings(ArmSettings, table, "model.arm")


def _with_lengths(table: Mapping[str, Any]) -> dict[str, Any]:
    """A single `length` is that of the upper arm, as jobs had it earlier."""
    if "length" not in table:
        return dict(table)
    if "lengths" in table:
        raise ValueError("model.arm.length and model.arm.lengths both stand there: keep lengths = [upper arm, forearm]")
    return {key: value for key, value in table.items() if key != "length"} | {"lengths": [table["length"]]}


def _refuse_numbers_without_names(key: str, value: Any) -> None:
    """Three numbers do not say in which of two orders they stand; earlier jobs wrote Börner's."""
    if not isinstance(value, list):
        return
    names = [name.removesuffix("_inertia") for name in BASE_INERTIA]
    given = value if len(value) == len(names) else ["..."] * len(names)
    named = ", ".join(f"{name} = {number}" for name, number in zip(names, given, strict=True))
    raise ValueError(
        f"model.arm.{key} is {value}, and numbers alone do not say which is which: write {key} = {{ {named} }}, if "
        f"they are {', '.join(BASE_INERTIA.values())} in kg m^2"
    )
