"""Friction of a robot's joints as rows of a table: what each model of it adds to the regressor.

The names are those of Khalil and Dombre 2002, 9.2, and Armstrong-Hélouvry, Dupont and Canudas de Wit 1994 (Stribeck).
All are linear in their parameters but for the two of Stribeck's curve, which are given, or found beforehand
(`identification.stribeck`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import ModuleType
from typing import NamedTuple

from jaximp.types import AnyArray, nearest


class Speed(NamedTuple):
    """What friction depends on, of every joint."""

    velocity: AnyArray
    sign: AnyArray
    """Of the velocity; gradual where the model is smoothed."""
    stribeck: tuple[AnyArray, AnyArray]
    """Velocity [rad/s or m/s] and exponent of Stribeck's curve, for arrays that broadcast."""
    xp: ModuleType
    """`numpy` or `jax.numpy`, whose arrays these are."""


class Term(NamedTuple):
    """One parameter of each joint."""

    name: str
    unit: str
    """That of the parameter of a joint called so (`joint.parameter_units`)."""
    column: str
    value: Callable[[Speed], AnyArray]


def stribeck(at: Speed) -> AnyArray:
    """Of size one; the curve is `exp(-|velocity / at.stribeck[0]| ** at.stribeck[1])`."""
    velocity, exponent = at.stribeck
    ratio, where = abs(at.velocity) / velocity, at.xp.where
    # The power of zero has no slope along the exponent: what stands still is put in afterwards.
    power = where(ratio > 0, where(ratio > 0, ratio, 1.0) ** exponent, 0.0)
    return at.sign * at.xp.exp(-power)


FRICTION: dict[str, tuple[Term, ...]] = {
    "viscous": (Term("viscous_friction", "viscous_friction", "dq", lambda at: at.velocity),),
    "coulomb": (Term("coulomb_friction", "coulomb_friction", "sign(dq)", lambda at: at.sign),),
    "asymmetric_coulomb": (
        Term("coulomb_forward", "coulomb_friction", "max(sign(dq), 0)", lambda at: at.xp.maximum(at.sign, 0)),
        Term("coulomb_backward", "coulomb_friction", "min(sign(dq), 0)", lambda at: at.xp.minimum(at.sign, 0)),
    ),
    "stribeck": (Term("stribeck_friction", "coulomb_friction", "sign(dq) exp(-|dq/v|^e)", stribeck),),
}
"""Every model of friction: viscous, Coulomb's, Coulomb's with another size in each direction, and what Stribeck's curve
adds to Coulomb's at small velocities."""


def friction_terms(friction: bool | str | Sequence[str]) -> tuple[Term, ...]:
    """The terms of a choice: names of `FRICTION`, True for `viscous` and `coulomb`, False for none.

    **Raises:** `ValueError` for an unknown name, and for Coulomb's friction twice.
    """
    if isinstance(friction, bool):
        friction = ("viscous", "coulomb") if friction else ()
    chosen = (friction,) if isinstance(friction, str) else tuple(friction)
    for name in chosen:
        if name not in FRICTION:
            raise ValueError(f"friction has an unknown model '{name}': {nearest(str(name), list(FRICTION))}")
    if {"coulomb", "asymmetric_coulomb"} <= set(chosen):
        raise ValueError("asymmetric_coulomb is coulomb with another size in each direction: choose one of the two")
    return tuple(term for name in FRICTION if name in chosen for term in FRICTION[name])
