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


@dataclass(frozen=True, eq=False)
class RealBody:
    """A body whose mass is above zero and whose moments of inertia some distribution of mass has."""

    parameters: Numbers
    """(10,) in the order of `models.spatial.PARAMETERS`, about the origin of the frame of the estimate."""
    distance: float
    """From the estimate, in its standard errors: near zero if the estimate is that of a body."""


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
    return RealBody(posed.standard(y), distance)


def _ball_like(theta: Numbers) -> Cone:
    """The cone of one body, with a ball in the middle that has the estimate's mass and centre where there are any."""
    mass = theta[0] if theta[0] > 0 else 1.0
    ball = about(mass, np.nan_to_num(theta[1:4]) / mass, 2 * mass * RADIUS**2 * np.eye(3))
    T = upper_factor(pseudo_inertia(ball))
    scale = np.stack([from_pseudo_inertia(T @ E @ T.T) for E in BASIS], axis=1)
    return Cone(tuple(PARAMETERS), tuple(PARAMETERS.values()), 1, ball, scale, np.zeros(10, bool), ())
