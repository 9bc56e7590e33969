"""Whether a human joint can have such an impedance, and the question that fits where it cannot.

Angles in degrees, torques in N mm, a gear or a clock that was forgotten leave a perfect fit of wrong numbers. Only what
is known of joints beforehand can tell.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.types import Numbers, nearest

PARAMETERS = ("inertia", "damping", "stiffness")
UNITS = ("kg m^2", "N m s/rad", "N m/rad")
OTHER = "other"
"""The name of a joint that is no human's: nothing is known of it."""
Range = tuple[float, float]


class Ranges(NamedTuple):
    """Of one joint about its own axis: relaxed to strongly contracted, small to large people, with a footplate or a
    handle. They are wide on purpose; the papers that are named report values inside."""

    inertia: Range
    """[kg m^2]"""
    damping: Range
    """[N m s/rad]"""
    stiffness: Range
    """[N m/rad]"""
    source: str

    @property
    def bounds(self) -> tuple[Range, Range, Range]:
        """Of inertia, damping and stiffness."""
        return self.inertia, self.damping, self.stiffness


JOINTS: Mapping[str, Ranges] = {
    "finger": Ranges((2e-5, 1e-3), (1e-3, 0.1), (0.05, 10), "Hajian and Howe 1997; Milner and Franklin 1998"),
    "wrist": Ranges((1e-3, 2e-2), (0.01, 1), (0.3, 60), "Gielen and Houk 1984; Milner and Cloutier 1998"),
    "elbow": Ranges((0.03, 0.2), (0.1, 6), (1, 250), "Lacquaniti et al. 1982; Bennett et al. 1992"),
    "shoulder": Ranges((0.1, 0.8), (0.3, 15), (3, 400), "Zhang et al. 2000; de Vlugt et al. 2006"),
    "ankle": Ranges((5e-3, 6e-2), (0.1, 6), (3, 700), "Weiss et al. 1988; Mirbagheri et al. 2000"),
    "knee": Ranges((0.1, 0.7), (0.2, 10), (3, 500), "Zhang et al. 1998; Koopman et al. 2016"),
    "hip": Ranges((0.5, 6), (0.5, 40), (5, 1500), "Koopman et al. 2016"),
}
"""By name. A new one also widens `WIDEST`; `TrustLimits.joint_name` and docs/your-recording.md list the names."""
WIDEST = Ranges(
    inertia=(min(one.inertia[0] for one in JOINTS.values()), max(one.inertia[1] for one in JOINTS.values())),
    damping=(min(one.damping[0] for one in JOINTS.values()), max(one.damping[1] for one in JOINTS.values())),
    stiffness=(min(one.stiffness[0] for one in JOINTS.values()), max(one.stiffness[1] for one in JOINTS.values())),
    source="all of them",
)
"""Of a joint whose name is not known."""

MISTAKES: tuple[tuple[float, str], ...] = (
    (180 / np.pi, "is the angle in degrees"),
    (1e-3, "is the torque in N mm, or the angle in mrad"),
    (1e-2, "is the torque in N cm"),
    (np.pi / 180, "were radians read as degrees"),
    (1e3, "is the torque in kN m"),
)
"""By what an impedance is to be multiplied if it is so, and the question."""
GEARS = (2.0, 500.0)
"""Ratios of gears that are asked for."""


def ranges_of(name: str | None) -> Ranges | None:
    """What is known of a joint; None of one that is no human's.

    **Raises:** `ValueError` for another name.
    """
    if name is None:
        return WIDEST
    if name == OTHER:
        return None
    if name not in JOINTS:
        hint = nearest(name, [*JOINTS, OTHER])
        raise ValueError(f"joint_name is '{name}': {hint} ('{OTHER}' for what is no human joint)")
    return JOINTS[name]


def times_outside(theta: Numbers, stderr: Numbers, ranges: Ranges, errors: float) -> Numbers:
    """(..., 3) by what factor inertia, damping and stiffness (..., 3) lie outside, above one or below; one inside, or
    where they are not outside by so many standard errors."""
    low, high = np.array(ranges.bounds).T
    with np.errstate(invalid="ignore", divide="ignore"):
        near_zero = np.maximum(theta + errors * stderr, 1e-12)
        above = np.where(theta - errors * stderr > high, theta / high, 1.0)
        below = np.where(near_zero < low, np.maximum(theta, 1e-12) / low, 1.0)
    return np.asarray(np.where(above > 1, above, below))


def question(theta: Numbers, ranges: Ranges) -> str:
    """What is probably wrong with inertia, damping and stiffness (3,) outside of these ranges: all that would explain
    it."""
    if (theta <= 0).any():
        return f"does the torque come late, or is a sign wrong ('{OTHER}' as joint_name for no human joint)?"
    asked = [text for factor, text in MISTAKES if _inside(theta * factor, ranges)]
    least, most = _ratios(theta, ranges, np.array([2, 2, 2]))
    if least <= most and least < GEARS[1] and most > GEARS[0]:
        asked.append(f"is a gear of {max(least, GEARS[0]):.2g} to {min(most, GEARS[1]):.2g} forgotten (gear_ratio)")
    if least <= most < 1 / GEARS[0]:
        asked.append("was a gear_ratio given though the columns are those of the joint")
    least, most = _ratios(theta, ranges, np.array([2, 1, 0]))
    if least <= most and not least <= 1 <= most:
        fast = (
            f"{least:.2g} to {most:.2g} times too fast" if least > 1 else f"{1 / most:.2g} to {1 / least:.2g} too slow"
        )
        asked.append(f"does the clock run {fast} (sample_rate, or the unit of the time)")
    return (
        ", or ".join(asked or [f"are units, gear and clock right ('{OTHER}' as joint_name for no human joint)"]) + "?"
    )


def _ratios(theta: Numbers, ranges: Ranges, powers: NDArray[np.int64]) -> tuple[float, float]:
    """Between which ratios, to these powers (3,), an impedance (3,) comes inside; the first is larger if it never
    does."""
    if (theta <= 0).any():
        return np.inf, 0.0
    low, high = np.array(ranges.bounds).T
    fixed = powers == 0
    if ((theta < low) | (theta > high))[fixed].any():
        return np.inf, 0.0
    least, most = ((bound / theta)[~fixed] ** (1 / powers[~fixed]) for bound in (low, high))
    return float(least.max()), float(most.min())


def likeness(theta: Numbers) -> str:
    """Which human joints could have inertia, damping and stiffness (3,), in words."""
    like = [name for name, ranges in JOINTS.items() if _inside(theta, ranges)]
    whose = " or ".join(f"{'an' if name[0] in 'ae' else 'a'} {name}" for name in like)
    return f"the impedance is that of {whose or 'no human joint'}: joint_name lets units and gears be checked"


def _inside(theta: Numbers, ranges: Ranges) -> bool:
    low, high = np.array(ranges.bounds).T
    return bool(((low <= theta) & (theta <= high)).all())


def worst(outside: Numbers) -> NDArray[np.int64]:
    """(...) which of the three is farthest outside (..., 3)."""
    return np.asarray(np.abs(np.log(outside)).argmax(axis=-1))
