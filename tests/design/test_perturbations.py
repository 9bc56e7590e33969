"""Perturbations of an arm, the paper's and designed ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jaximp.design.limits import Limits
from jaximp.design.perturbations import condition_of, design_perturbations
from jaximp.models import BaseInertia, PlanarArm
from jaximp.papers.lakatos2011 import noise_free_conditions
from jaximp.simulation.held_arm import DIRECTIONS, HeldArm, imposed_motion

POSTURE = np.asarray(HeldArm().posture)
INERTIA = np.asarray(HeldArm().inertia)
ARM = PlanarArm((0.0, 0.0))


def by_hand(duration: float) -> float:
    """Eqs. (12), (13), (16) and (19) of Lakatos et al. 2011 in numpy, over T_k + 70 ms at 1 kHz."""
    t = np.arange(round(1e3 * (duration + 0.07)) + 1) / 1e3
    u = np.clip(t / duration, 0, 1)
    profile = np.stack([
        10 * u**3 - 15 * u**4 + 6 * u**5,
        (30 * u**2 - 60 * u**3 + 30 * u**4) / duration,
        (60 * u - 180 * u**2 + 120 * u**3) / duration**2,
    ])  # fmt: skip
    blocks = []
    for direction in DIRECTIONS:
        (d1, d2), (v1, v2), (a1, a2) = [(x * direction[0], x * direction[1]) for x in profile]
        q2, zero = POSTURE[1] + d2, np.zeros_like(d1)
        first = [a1, (2 * a1 + a2) * np.cos(q2) - (2 * v1 * v2 + v2**2) * np.sin(q2), a2]
        second = [zero, a1 * np.cos(q2) + v1**2 * np.sin(q2), a1 + a2]
        blocks.append(np.stack([*first, v1, v2, zero, zero, d1, d2, zero, zero], axis=1))
        blocks.append(np.stack([*second, zero, zero, v1, v2, zero, zero, d1, d2], axis=1))
    return float(np.linalg.cond(np.concatenate(blocks)))


def test_condition_of_the_papers_motions_is_an_independent_one() -> None:
    """All 26 durations of the paper."""
    durations = 0.04 + 0.01 * np.arange(1, 27)
    expected = [by_hand(duration) for duration in durations]
    np.testing.assert_allclose(noise_free_conditions(durations), expected, rtol=1e-8)
    assert (np.diff(expected) < 0).all()


@pytest.mark.slow
def test_designed_perturbations_keep_their_limits_and_are_better_conditioned() -> None:
    limits = Limits(position=(-0.05, 0.05), velocity=0.3, torque=1.0)
    found = design_perturbations(ARM, POSTURE, 0.3, INERTIA, limits, way_points=3, starts=2)
    assert found.points.shape == (6, 4, 2)
    t = np.linspace(0, 0.3, 301)
    motions = [found.motion(k, t) for k in range(6)]
    away, dq, ddq = (np.stack([np.asarray(motion[i]) for motion in motions]) for i in range(3))
    reached = np.array([np.abs(away).max() / 0.05, np.abs(dq).max() / 0.3])
    assert (reached < 1.001).all()
    np.testing.assert_allclose(away[:, 0], 0, atol=1e-15)
    np.testing.assert_allclose(dq[:, 0], 0, atol=1e-15)
    assert found.condition == pytest.approx(float(condition_of(ARM, POSTURE, (away, dq, ddq))), rel=0.02)
    same_time = float(condition_of(ARM, POSTURE, imposed_motion(DIRECTIONS, 0.23, t)))
    assert found.condition < 0.9 * same_time
    assert found.conditions[-1] < 1.05 * found.conditions[0]


@pytest.mark.usefixtures("unchecked")
def test_a_design_without_time_is_refused() -> None:
    with pytest.raises(ValueError, match="observed"):
        design_perturbations(ARM, POSTURE, 0.0, INERTIA, Limits(position=(-0.05, 0.05)))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (Limits(), "displacement from the posture"),
        (Limits(position=(0.5, 1.5)), "displacement from the posture"),
        (Limits(position=(-0.05, 0.05), velocity=-1.0), "velocity"),
        (Limits(position=(-0.05, 0.05), jerk=10.0), "jerk"),
    ],
    ids=["none", "absolute", "negative", "jerk"],
)
def test_perturbations_have_limits(limits: Limits, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        design_perturbations(ARM, POSTURE, 0.3, INERTIA, limits)


@pytest.mark.slow
@pytest.mark.usefixtures("unchecked")
def test_the_order_of_the_inertia_is_lakatos_or_named() -> None:
    named = BaseInertia.from_lakatos(INERTIA)
    limits = Limits(position=(-0.05, 0.05), torque=0.5)
    options: dict[str, Any] = {"way_points": 2, "starts": 1}
    plain, by_name = (design_perturbations(ARM, POSTURE, 0.3, one, limits, **options) for one in (INERTIA, named))
    np.testing.assert_allclose(by_name.points, plain.points, rtol=1e-9)
    # A forearm so heavy has no such coupling: here physics can tell that the order is another.
    heavy = BaseInertia(upper_arm=0.1, forearm=0.09, coupling=0.01)
    np.testing.assert_allclose(BaseInertia.from_lakatos(heavy.lakatos).check().borner, heavy.borner)
    with pytest.raises(ValueError, match="no rigid body has the inertia"):
        design_perturbations(ARM, POSTURE, 0.3, np.asarray(heavy.borner), limits, **options)


@pytest.mark.slow
def test_every_joint_and_direction_has_its_own_limit() -> None:
    limits = Limits(position=((-0.01, -0.02), (0.05, 0.03)))
    found = design_perturbations(ARM, POSTURE, 0.3, INERTIA, limits, way_points=3, starts=2)
    away = np.stack([np.asarray(found.motion(k, np.linspace(0, 0.3, 777))[0]) for k in range(6)])
    assert (away >= np.array([-0.01, -0.02]) * 1.001).all()
    assert (away <= np.array([0.05, 0.03]) * 1.001).all()
