"""One body, such as a load: the real one that is nearest to an estimate of its ten parameters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Num

from jaximp.consistency.cone import BASIS, Cone, pose_in, upper_factor
from jaximp.consistency.programs import MARGIN, WEAK, nearest_robot
from jaximp.models.spatial import PARAMETERS, about, from_pseudo_inertia, pseudo_inertia
from jaximp.types import AnyArray, Numbers

RADIUS = 0.05
"""Of gyration [m]: what nothing is known of is taken for a ball of this size."""
SAME = 0.1
"""Standard errors by which a body may differ from an estimate that is one: the solver keeps a margin."""


@dataclass(frozen=True, eq=False)
class RealBody:
    """A body whose mass is above zero and whose moments of inertia some distribution of mass has."""

    parameters: Numbers
    """(10,) in the order of `models.spatial.PARAMETERS`, about the origin of the frame of the estimate."""
    distance: float
    """From the estimate, in its standard errors: near zero if the estimate is that of a body."""
    known: int = 10
    """How many parameters the estimate has."""

    @property
    def is_estimate(self) -> bool:
        """Whether the estimate is that of a real body itself."""
        return self.distance < SAME

    @property
    def centre(self) -> Numbers:
        """(3,) of mass [m]."""
        return self.parameters[1:4] / self.parameters[0]

    @property
    def inertia_about_centre(self) -> Numbers:
        """(3, 3) [kg m^2]."""
        mass, moment = self.parameters[0], self.parameters[1:4]
        second = pseudo_inertia(self.parameters)[:3, :3] - np.outer(moment, moment) / mass
        return np.asarray(np.trace(second) * np.eye(3) - second)

    def in_words(self) -> list[str]:
        """Whether the estimate is that of a body, and if not, which one is nearest and how far it is."""
        from scipy.special import chdtri

        if self.is_estimate:
            return ["a real body can have these parameters"]
        x, y, z = 1e3 * self.centre
        moments = ", ".join(f"{one:.2g}" for one in np.linalg.eigvalsh(self.inertia_about_centre))
        found = (
            f"no real body has these parameters: the nearest one is {self.distance:.2g} standard errors away, with "
            f"mass {self.parameters[0]:.4g} kg, centre of mass x {x:.3g}, y {y:.3g}, z {z:.3g} mm, and principal "
            f"moments of inertia about it {moments} kg m^2"
        )
        if self.distance**2 > chdtri(self.known, 0.05):
            return [found, "errors do not explain that: they are claimed too small, or the model lacks something"]
        return [found, "that is within the errors of the estimate"]


def nearest_body(estimate: Num[AnyArray, "10"], covariance: Num[AnyArray, "10 10"]) -> RealBody:
    """The real body nearest to an estimate, in the metric of its covariance.

    What the estimate leaves open (NaN) is that of a ball about the centre of mass, as far as the rest allows.

    **Arguments:** `theta` and `covariance` of `identification.identify_payload`, for example.

    **Raises:** `ValueError` in one line for other shapes, a covariance that is not definite, and without cvxpy.

    **Source:** Wensing, Kim and Slotine 2018, eq. (8).
    """
    theta, C = np.asarray(estimate, float), np.asarray(covariance, float)
    if theta.shape != (10,) or C.shape != (10, 10):
        raise ValueError(f"the estimate has the shape {theta.shape} and its covariance {C.shape}: a body has ten")
    posed = pose_in(_ball_like(theta), np.eye(10), tuple(PARAMETERS), theta, C)
    y, distance = nearest_robot(posed, None, MARGIN, WEAK)
    return RealBody(posed.standard(y), distance, posed.known)


def _ball_like(theta: Numbers) -> Cone:
    """The cone of one body, with a ball in the middle that has the estimate's mass and centre where there are any."""
    mass = theta[0] if theta[0] > 0 else 1.0
    ball = about(mass, np.nan_to_num(theta[1:4]) / mass, 2 * mass * RADIUS**2 * np.eye(3))
    T = upper_factor(pseudo_inertia(ball))
    scale = np.stack([from_pseudo_inertia(T @ E @ T.T) for E in BASIS], axis=1)
    return Cone(tuple(PARAMETERS), tuple(PARAMETERS.values()), 1, ball, scale, np.zeros(10, bool), ())
