"""A robot from its URDF in a job: the table `[model.robot]` with a `urdf`.

```toml
[model.robot]
urdf = "ur10e.urdf"        # beside the job file
tip = "tool0"
friction = ["viscous", "coulomb"]
rotor = true
offset = true
min_velocity = 0.02        # rad/s: slower rows of a joint do not count
```
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from jaximp.models.chain import Chain
from jaximp.models.tip import TipImpedance
from jaximp.types import listed

PerJoint = float | list[float] | dict[str, float]


@dataclass(frozen=True)
class TipSettings:
    """Keywords of `models.TipImpedance`: a human who holds the end of the robot."""

    directions: str | list[list[float]] = "xyz"
    """In which the human's impedance is looked for: axes of the base's frame, such as `"xz"`, or vectors of three
    numbers each, orthogonal to each other."""
    full: bool = False
    """Also elements of the matrices between directions, such as `stiffness_xz`."""
    mass: bool = True
    """Columns of the human's mass."""
    damping: bool = True
    """Columns of damping."""
    stiffness: bool = True
    """Columns of stiffness."""
    force: bool = True
    """Columns of a constant force, which says where the spring is at rest."""

    def make(self, chain: Chain) -> TipImpedance:
        """The model.

        **Raises:** `ValueError` with one line for directions that are none, no columns, and a chain without a tip.
        """
        if not (self.mass or self.damping or self.stiffness or self.force):
            raise ValueError("model.human has no columns: leave out some of mass, damping, stiffness or force = false")
        if chain.tip is None or chain.tree.tip_body < 0:
            raise ValueError("model.human: which link is held? Name one that moves as tip in [model.robot]")
        try:
            return _human(chain, json.dumps(vars(self)))
        except ValueError as error:
            raise ValueError(f"model.human: {error}") from None


@dataclass(frozen=True)
class ChainSettings:
    """Keywords of `models.Chain`."""

    urdf: str
    """The robot's URDF, a path that begins at the job's folder."""
    tip: str | None = None
    """Link whose pose is meant; by default the one that the last joint moves."""
    base: str | None = None
    """Link from which the chain starts and that does not move; by default the root."""
    gravity: list[float] | None = None
    """In the base's frame [m/s^2]; by default `[0, 0, -9.81]`."""
    locked: list[str] | dict[str, float] | None = None
    """Joints that stay: their names, or a table with their positions [rad or m]."""
    friction: bool | str | list[str] = False
    """`viscous`, `coulomb`, `asymmetric_coulomb`, `stribeck`, or several of them; `true` for the first two."""
    rotor: bool = False
    """A column for the inertia of each motor's rotor."""
    offset: bool = False
    """A column of a constant torque for each joint."""
    gear: PerJoint = 1.0
    """Turns of the motor for one of the joint: a number, one for each joint, or a table with those of some."""
    coupling: list[list[float]] | None = None
    """Where motors share joints: joints = coupling @ (motors / gear)."""
    side: str = "motor"
    """Whether positions and torques are those of the `motor` or of the `joint`, where there is a gear or coupling."""
    zero: PerJoint = 0.0
    """The URDF's position of each joint where the recorded one is zero [rad or m]."""
    sign: PerJoint = 1.0
    """-1 where the controller counts the other way than the URDF."""
    stribeck_velocity: PerJoint | str = 0.1
    """Velocity at which Stribeck's friction has fallen [rad/s or m/s]; or `"estimate"`: it and the exponent are then
    those that explain the recording best."""
    stribeck_exponent: PerJoint = 2.0
    """Exponent of Stribeck's curve, where its velocity is given."""
    sign_width: PerJoint = 0.0
    """Velocity around which the sign of dry friction turns gradually [rad/s or m/s]; at zero it jumps, and near
    standstill it then follows the noise of the velocity."""
    min_velocity: PerJoint = 0.0
    """Slower rows of a joint do not count [rad/s or m/s]: below its breakaway friction is not what the model says."""
    strict: bool = True
    """`false` takes links without inertia for massless, and limits of zero for none."""

    def make(self, folder: Path) -> Chain:
        """The model, read once from each state of the file.

        **Raises:** `ValueError` with one line for what is wrong with the file or does not fit it.
        """
        path = folder / self.urdf
        changed = path.stat().st_mtime_ns if path.is_file() else 0
        return _read(path, changed, json.dumps({key: value for key, value in vars(self).items() if key != "urdf"}))

    def check(self, chain: Chain, joints: Sequence[str]) -> None:
        """Refuse a recording of other joints than the URDF's."""
        if len(joints) != chain.n_joints:
            raise ValueError(
                f"{self.urdf} has {chain.n_joints} joints that move ({listed(chain.joint_names)}), but the recording "
                f"{len(joints)}: map a column of position and torque for each, in this order, or name others in locked"
            )
        for name, kind, recorded in zip(chain.joint_names, chain.joint_kinds, joints, strict=True):
            if kind != recorded:
                kinds = ", ".join(f'"{one}"' for one in chain.joint_kinds)
                raise ValueError(f"joint '{name}' of {self.urdf} is {kind}: write joint = [{kinds}] in [recording]")


@lru_cache(maxsize=8)
def _read(path: Path, changed: int, settings: str) -> Chain:
    given: dict[str, Any] = json.loads(settings)
    if given["gravity"] is None:
        del given["gravity"]
    velocity, exponent = given.pop("stribeck_velocity"), given.pop("stribeck_exponent")
    given["stribeck"] = velocity if isinstance(velocity, str) else (velocity, exponent)
    width = given.pop("sign_width")
    chain = Chain.from_urdf(path, **given)
    return chain.with_sign_width(width) if width != 0 else chain


@lru_cache(maxsize=8)
def _human(chain: Chain, settings: str) -> TipImpedance:
    given: dict[str, Any] = json.loads(settings)
    directions = given.pop("directions")
    if isinstance(directions, list):
        if not all(len(one) == 3 for one in directions):
            raise ValueError("directions must be axes such as 'xz', or vectors of three numbers each")
        directions = np.array(directions)
    return TipImpedance(chain, directions, **given)
