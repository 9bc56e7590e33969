"""Whether the robot is the same in all recordings of a pair, and what its changes do to the human's parameters.

Parameters that the human has too (viscous friction and damping, both inertias) change unseen: that takes a second
recording of the robot alone, or a stated `robot_drift`. What the human has not (Coulomb friction, gravity) is
estimated in both recordings and compared.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.separation import Regression, Separation
from jaximp.identification.whitening import White
from jaximp.least_squares.window import WindowFit
from jaximp.models.base import Model, combine
from jaximp.trust.score_tests import ERRORS, FAMILYWISE, SHARE, added_weights, p_in_words
from jaximp.types import AnyArray, Numbers, listed, nearest

NOT_ASKED = (
    "standard errors assume that the robot did not change between its recording and that with the human: record it "
    "again afterwards ([robot_recording_after]), or state by what share it may have changed (model.robot_drift)"
)
"""What is said where nobody stated how far the robot may have changed."""

OTHER_METHODS = "repeat the motion, or use another method (model.methods)"
RECORD_AGAIN = "record the robot alone again, as warm and as it is mounted with the human"
"""Against what makes the human doubtful."""

Drift = float | Mapping[str, float] | None
"""Standard deviation of a change of the robot's parameters between recordings, as a share of each: of those that the
human shares, or by name."""


def mean_of_both(before: WindowFit, after: WindowFit) -> WindowFit:
    """The robot's parameters from its recordings before and after that with the human."""
    covariance = (before.covariance + after.covariance) / 4
    theta, dof = (before.theta + after.theta) / 2, np.minimum(before.dof, after.dof)
    new = (theta, np.sqrt(np.diagonal(covariance)), dof, covariance)
    return eqx.tree_at(lambda f: (f.theta, f.stderr, f.dof, f.covariance), before, new)


def between(before: WindowFit, after: WindowFit) -> Numbers:
    """(r, r) covariance of what the robot's parameters may be off their mean while the human was held: half the
    difference is one standard deviation, so that 95 % intervals reach beyond the robot before and the robot after."""
    half = np.asarray(after.theta - before.theta) / 2
    return np.outer(half, half)


def compared(names: Sequence[str], before: WindowFit, after: WindowFit) -> tuple[float, str]:
    """Probability of a difference as large as this of a robot that did not change, and what is said of it."""
    difference, covariance = (np.asarray(x) for x in (after.theta - before.theta, after.covariance + before.covariance))
    p = _chance(difference, covariance, float(min(before.dof, after.dof)))
    errors = "the human's standard errors hold this difference, if the robot was between the two meanwhile"
    if p >= FAMILYWISE:
        return p, f"the robot's recordings before and after agree ({p_in_words(p)}); {errors}"
    changes = _changes(names, np.asarray(before.theta), difference, covariance)
    return p, f"the robot changed from its recording before to that after ({p_in_words(p)}): {changes}; {errors}"


def drift_covariance(robot: Model, human: Model, theta: AnyArray, drift: Drift) -> Numbers:
    """(r, r) covariance of a stated change of the robot's parameters theta (r,).

    **Raises:** `ValueError` for a parameter that the robot has not.
    """
    if not drift:
        return np.zeros((len(robot.names), len(robot.names)))
    if isinstance(drift, Mapping):
        for name in drift:
            if name not in robot.names:
                raise ValueError(
                    f"model.robot_drift has an unknown parameter '{name}': {nearest(name, list(robot.names))}"
                )
        share = np.array([drift.get(name, 0.0) for name in robot.names])
    else:
        share = np.zeros(len(robot.names))
        share[np.setdiff1d(np.arange(len(share)), own_columns(robot, human))] = drift
    return np.diag((share * np.asarray(theta)) ** 2)


def drift_in_words(robot: Model, covariance: Numbers, theta: AnyArray) -> str:
    """What was stated; empty where that is nothing."""
    sd, size = np.sqrt(np.diagonal(covariance)), np.abs(np.asarray(theta))
    shares = [f"{name} by {s / t:.1%}" for name, s, t in zip(robot.names, sd, size, strict=True) if s > 0]
    if not shares:
        return ""
    return f"standard errors hold that the robot may have changed by robot_drift (one sd): {listed(shares)}"


def own_columns(robot: Model, human: Model) -> NDArray[np.int64]:
    """Which of the robot's parameters have a column that the human's model has not."""
    place = np.argmax(np.asarray(combine(robot, human).merge), axis=0)
    of_robot, of_human = np.split(place, [len(robot.names)])
    return np.flatnonzero(~np.isin(of_robot, of_human))


@dataclass(frozen=True)
class Sameness:
    """Parameters that are the robot's alone, in the recording with the human less those of the robot alone."""

    names: tuple[str, ...]
    columns: NDArray[np.int64]
    """(k,) which of the robot's they are."""
    usual: Numbers
    """(k,) of the robot alone."""
    difference: Numbers
    """(k,)"""
    covariance: Numbers
    """(k, k) of the difference, by the errors of both."""
    p: float
    """Probability of a difference as large as this of one and the same robot."""

    @classmethod
    def of(
        cls, robot: Model, human: Model, fit: WindowFit, change: Numbers, loaded: Regression, white: White
    ) -> Sameness | None:
        """Of a pair; None where there is nothing to compare.

        Every window keeps a human of its own, who takes whatever his columns share with the robot's; what is left tells
        of the robot's own columns, with one change of the parameters in the whole record.

        **Arguments:** the robot's `fit`, and the covariance (r, r) of a `change` that is allowed for; `white` rows of
        the human's model and what the robot's leaves of the torque (method 1).
        """
        own = own_columns(robot, human)
        if not len(own):
            return None
        columns = white.apply(np.asarray(loaded.robot)[:, own], loaded.valid)
        difference, covariance, freedom = added_weights(np.asarray(white.W), columns, white.windows, white.every)
        if not freedom > len(own) or not np.isfinite(covariance).all():
            return None
        covariance = covariance + (np.asarray(fit.covariance) + change)[np.ix_(own, own)]
        p = _chance(difference, covariance, freedom)
        names = tuple(robot.names[k] for k in own)
        return cls(names, own, np.asarray(fit.theta)[own], difference, covariance, p)

    @property
    def differs(self) -> bool:
        """Whether the robot is another one."""
        return self.p < FAMILYWISE

    def in_words(self) -> str:
        """Which parameters differ, and by how much."""
        if not self.differs:
            agree = "agrees" if len(self.names) == 1 else "agree"
            return f"{listed(self.names)} {agree} in both recordings ({p_in_words(self.p)})"
        changes = _changes(self.names, self.usual, self.difference, self.covariance)
        return f"the robot is not the same in both recordings ({p_in_words(self.p)}): {changes} in that with the human"


@dataclass(frozen=True)
class Doubts:
    """What speaks against the human's parameters, beside what their model lacks."""

    of: Mapping[str, str]
    """Why some parameters cannot be trusted."""
    remedy: str = ""
    moves: Numbers | None = None
    """(h,) by how much parameters that stay trusted may be off."""
    note: str = ""

    @classmethod
    def of_method(cls, names: Sequence[str], found: Separation, same: Sameness | None) -> Doubts:
        """Of the human's parameters by one method."""
        by_motion = {names[k]: why for k, why in found.doubts.items()}
        by_robot = NO_DOUBTS
        if same is not None and same.differs and found.passed_on is not None:
            by_robot = cls._by_robot(names, found, same)
        remedies = [OTHER_METHODS if by_motion else "", by_robot.remedy]
        return replace(by_robot, of={**by_robot.of, **by_motion}, remedy="; or ".join(filter(None, remedies)))

    @classmethod
    def _by_robot(cls, names: Sequence[str], found: Separation, same: Sameness) -> Doubts:
        """With the robot's parameters of the recording with the human in place, the human's would move by so much."""
        usual = np.abs(_median(np.asarray(found.fit.theta)))
        follows = np.stack([_median(one) for one in np.asarray(found.passed_on)[same.columns]])
        move = -follows.T @ same.difference
        error = np.sqrt(np.einsum("kh,kl,lh->h", follows, same.covariance, follows))
        sure = np.abs(move) > ERRORS * error
        off = sure & (np.abs(move) > SHARE * usual)
        shares = [f"{name} by {m / u:+.0%}" for name, m, u, o in zip(names, move, usual, off, strict=True) if o and u]
        moves = np.where(sure & ~off, np.abs(move), 0.0)
        if not shares:
            small = "that moves no parameter of the human beyond error and 5 %, and standard errors hold it"
            return cls({}, "", moves, f"{same.in_words()}; {small}")
        why = f"{same.in_words()}, which would change {listed(shares)}"
        return cls({name: why for name, o in zip(names, off, strict=True) if o}, RECORD_AGAIN, moves, why)


NO_DOUBTS = Doubts({})


def _median(values: Numbers) -> Numbers:
    """Over the windows that are solved; zero where there are none."""
    known = values[np.isfinite(values).all(axis=1)]
    return np.median(known, axis=0) if len(known) else np.zeros(values.shape[1])


def _chance(difference: Numbers, covariance: Numbers, freedom: float) -> float:
    """Probability of a difference as large as this where there is none, by Hotelling's statistic."""
    from scipy.special import fdtrc

    size = np.sqrt(np.diagonal(covariance))
    size = np.where(size > 0, size, 1)
    z, k = difference / size, len(difference)
    statistic = float(z @ np.linalg.pinv(covariance / size / size[:, None], hermitian=True) @ z)
    return float(fdtrc(k, max(freedom, 1.0), statistic / k))


def _changes(names: Sequence[str], usual: Numbers, difference: Numbers, covariance: Numbers) -> str:
    """Each parameter that differs beyond chance, of all of them, or the one that does most."""
    from scipy.special import ndtri

    errors = np.sqrt(np.diagonal(covariance))
    z = np.abs(difference) / np.where(errors > 0, errors, np.inf)
    said = []
    for k in np.flatnonzero(z >= min(-ndtri(FAMILYWISE / 2 / len(z)), z.max())).tolist():
        known = abs(usual[k]) > ERRORS * errors[k]
        said.append(
            f"{names[k]} by {difference[k] / abs(usual[k]):+.1%}" if known else f"{names[k]} by {difference[k]:+.2g}"
        )
    return listed(said)
