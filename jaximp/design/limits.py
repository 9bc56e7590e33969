"""What a motion must keep."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaximp.models.base import Model
from jaximp.models.chain import Chain
from jaximp.types import Numbers

SYMMETRIC = ("velocity", "acceleration", "jerk", "torque")
"""Limits that hold in both directions alike."""


@dataclass(frozen=True)
class Limits:
    """What the motion must keep at every instant: one number for all joints, or one for each.

    **Example:**

    ```pycon
    >>> limits = jaximp.Limits(position=(-0.3, 0.3), velocity=2)
    >>> print(limits.velocity, limits.torque)
    2 inf

    ```
    """

    position: tuple[Any, Any] = (-math.inf, math.inf)
    """Lowest and highest position [rad or m]; both finite, or neither."""
    velocity: Any = math.inf
    """Largest speed [rad/s]."""
    acceleration: Any = math.inf
    """Largest acceleration [rad/s^2]."""
    jerk: Any = math.inf
    """Largest jerk [rad/s^3]."""
    torque: Any = math.inf
    """Largest torque of the model [N m]; needs the parameters of the model."""


NO_LIMITS = Limits()


def unlimited(limits: Limits) -> tuple[str, ...]:
    """Names of what has no limit at all."""
    ends = {"position": limits.position} | {name: (getattr(limits, name),) for name in SYMMETRIC}
    return tuple(name for name, values in ends.items() if all(np.isinf(value).all() for value in values))


def completed(limits: Limits, moved: Model) -> Limits:
    """With what the URDF of a chain says of position, velocity and torque, where nothing else is given.

    **Raises:** `ValueError` for motors that share joints, whose limits must be given.
    """
    missing = {"position", "velocity", "torque"} & set(unlimited(limits))
    if not isinstance(moved, Chain) or not missing:
        return limits
    low, high, velocity, effort = (tuple(values.tolist()) for values in moved.recorded_limits)
    found: dict[str, Any] = {"position": (low, high), "velocity": velocity, "torque": effort}
    return replace(limits, **{name: found[name] for name in missing})


def room(limits: Limits, n: int) -> tuple[Numbers, Numbers, Numbers]:
    """Lowest and highest position (n,), and the most of everything else (4, n)."""
    low, high = (per_joint(f"limits.position[{k}]", x, n) for k, x in enumerate(limits.position))
    most = np.stack([per_joint(f"limits.{name}", getattr(limits, name), n) for name in SYMMETRIC])
    if not (np.isfinite(low) == np.isfinite(high)).all():
        raise ValueError("limits.position is finite on one side only: give both, or neither")
    if not (low < high).all():
        raise ValueError(f"limits.position: the lowest, {low.tolist()}, is not below the highest, {high.tolist()}")
    for name, most_of in zip(SYMMETRIC, most, strict=True):
        if not (most_of > 0).all():
            raise ValueError(f"limits.{name} is {most_of.tolist()}: no motion keeps a limit that is not above zero")
    return low, high, most


def per_joint(name: str, value: Any, n: int) -> Numbers:
    given = np.asarray(value, float)
    if given.shape not in ((), (n,)) or np.isnan(given).any():
        raise ValueError(f"{name} is {value}: give one number, or one for each of {n} joints")
    return np.broadcast_to(given, (n,))
