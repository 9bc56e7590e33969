"""Damping and stiffness of an arm's joints as numbers, before anything is said of whether to believe them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Num

from jaximp.least_squares.window import confidence_interval
from jaximp.models.endpoint import EndpointImpedance, endpoint_impedance
from jaximp.models.inertia import BASE_INERTIA
from jaximp.perturbation.deviations import Deviations, JointDeviations, KnownArm
from jaximp.perturbation.isolation.isolated import Impedance
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.perturbation.stiffness import ELEMENTS, MATRICES, MATRIX_OF, SYMMETRIC_ELEMENTS, symmetric_matrix
from jaximp.results import Result
from jaximp.types import AnyArray, Numbers


@dataclass(frozen=True)
class Evidence:
    """What rules must know of an estimate besides its numbers."""

    failure: str = ""
    """Why there is no estimate; empty where there is one."""
    on_boundary: bool = False
    """The stiffness is singular, since the data ask for an indefinite one."""
    asked: float = np.nan
    """Smaller eigenvalue of the stiffness that the data ask for, where it need not be definite [N m/rad]."""
    disagreement: float = 0.0
    """Share of the recorded force by which it differs from what command and handle make."""
    about_handle: str = ""
    """That in words, with what to do about it."""
    speed: float = 0.0
    """Of the hand at the onset, mean of the perturbed trials [m/s]."""
    deviation: float = np.nan
    """Of the hand at the end of the window, root mean square over the trials [m]."""


@dataclass(frozen=True)
class Curves:
    """What figures show of an estimate."""

    deviations: Deviations
    """Unperturbed less perturbed, at the hand."""
    joint: JointDeviations
    """The same at the joints."""
    cutoff: Numbers | None
    """(2,) of the high-pass [Hz], where there was one."""
    sample_rate: float
    """[Hz]"""

    def model_torque(self, D: Numbers, K: Numbers) -> Numbers:
        """(T, S, 2) what damping and stiffness make of the deviations of the joints [N m]."""
        return np.asarray(self.joint.velocity) @ D.T + np.asarray(self.joint.displacement) @ K.T


@dataclass(frozen=True)
class ArmEstimate(Result):
    """Damping and stiffness of an arm's joints by one method."""

    method: str
    """Key of `isolation.METHODS`."""
    window: float
    """After the onset [s]."""
    trials: int
    """Perturbed ones."""
    unperturbed: int
    theta: Numbers
    """(p,) the estimates, called by `names`: elements of damping and stiffness."""
    covariance: Numbers
    """(p, p), with what the standard errors of the inertia add; NaN where it is not known."""
    dof: float
    """Degrees of freedom of the standard errors."""
    vaf: float
    """Share of the isolated joint torques that damping and stiffness account for; NaN of a method that estimates the
    impedance itself, which need not know the acceleration well: there the `misfit` tells."""
    held_out_vaf: float
    """Share of the torques that is predicted from the other half of the trials; NaN where it was not tried."""
    arm: KnownArm
    """What was known: geometry and inertia."""
    own: Impedance | None
    """What a method says that estimates the impedance itself."""
    position: Numbers
    """(2,) mean place of the hand at the onset [m]."""
    evidence: Evidence
    curves: Curves

    @property
    def title(self) -> str:
        """The method, in words."""
        return METHODS[self.method].title

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) `ELEMENTS`, or `SYMMETRIC_ELEMENTS` of a method that makes the stiffness symmetric."""
        return ELEMENTS if len(self.theta) == len(ELEMENTS) else SYMMETRIC_ELEMENTS

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(MATRICES[MATRIX_OF[name]] for name in self.names)

    @property
    def value(self) -> Numbers:
        """(p,) `theta`."""
        return self.theta

    @property
    def D(self) -> Numbers:
        """(2, 2) damping [N m s/rad]."""
        return self.theta[:4].reshape(2, 2)

    @property
    def K(self) -> Numbers:
        """(2, 2) stiffness [N m/rad]."""
        elements = self.theta[4:]
        return np.asarray(elements.reshape(2, 2) if len(elements) == 4 else symmetric_matrix(elements))

    @property
    def stderr(self) -> Numbers:
        """(p,) standard errors of `theta`."""
        return np.sqrt(np.diagonal(self.covariance))

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(p,) lower and upper end."""
        low, high = confidence_interval(self.theta[None], self.stderr[None], np.array([self.dof]), level)
        return low[0], high[0]

    @property
    def misfit(self) -> float | None:
        """Mean square of the residuals over what was expected, where the method knows it."""
        return None if self.own is None else float(self.own.misfit)

    @property
    def angles(self) -> Numbers:
        """(2,) of the joints where the hand is at the onset [rad]."""
        return np.asarray(self.arm.geometry.inverse(self.position))

    @property
    def improved(self) -> KnownArm:
        """What was known, with the inertia as a method improved it."""
        return self.arm if self.own is None else self.arm.with_inertia(self.own.inertia)

    @property
    def at_hand(self) -> EndpointImpedance:
        """What is felt at the hand, where it was at the onset."""
        return endpoint_impedance(self.arm.geometry, self.angles, self.improved.xi, self.D, self.K)

    @property
    def inertia(self) -> dict[str, float]:
        """Base inertial parameters as they were given, by their names in `BASE_INERTIA` [kg m^2]."""
        return _by_name(self.arm.inertia)

    @property
    def inertia_stderr(self) -> dict[str, float]:
        """Their standard errors [kg m^2]; NaN where they are not known."""
        return _by_name(np.full(3, np.nan) if self.arm.inertia_stderr is None else self.arm.inertia_stderr)

    @property
    def improved_inertia(self) -> dict[str, float]:
        """As a method improved them [kg m^2]; as they were given where it does not."""
        return _by_name(self.improved.inertia)


def _by_name(pi: Num[AnyArray, "3"]) -> dict[str, float]:
    return dict(zip(BASE_INERTIA, np.asarray(pi, float).tolist(), strict=True))
