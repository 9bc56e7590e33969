"""Rotations, and the ten inertial parameters of a rigid body in one frame and another (numpy)."""

from __future__ import annotations

import numpy as np

from jaximp.types import Numbers

PARAMETERS = {
    "mass": "kg",
    "mc_x": "kg m",
    "mc_y": "kg m",
    "mc_z": "kg m",
    "Ixx": "kg m^2",
    "Ixy": "kg m^2",
    "Iyy": "kg m^2",
    "Ixz": "kg m^2",
    "Iyz": "kg m^2",
    "Izz": "kg m^2",
}
"""Inertial parameters of a rigid body with their units: its mass, mass times the centre of mass, and its inertia about
the origin of its frame (not about the centre of mass), in the order of pinocchio."""

NEVER_NEGATIVE = ("mass", "Ixx", "Iyy", "Izz")
"""Which of them are at least zero in every body."""


def rotation(angles: Numbers) -> Numbers:
    """(3, 3) matrix of URDF's roll, pitch and yaw [rad]: about the fixed x, then y, then z axis."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(angles), np.sin(angles)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_about(axis: Numbers, angle: float) -> Numbers:
    """(3, 3) matrix of a turn by an angle [rad] about an axis of length one (Rodrigues)."""
    K = cross_matrix(axis)
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def cross_matrix(v: Numbers) -> Numbers:
    """(3, 3) matrix whose product with another vector is the cross product of both."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def about(mass: float, centre: Numbers, inertia: Numbers) -> Numbers:
    """(10,) parameters about the origin from mass, centre of mass (3,) and inertia (3, 3) about the centre of mass."""
    at_origin = inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre))
    return np.concatenate([[mass], mass * centre, _six(at_origin)])


def pseudo_inertia(parameters: Numbers) -> Numbers:
    """(4, 4) matrix of a body's zeroth, first and second moments of mass, which is positive definite for every real
    body (Wensing, Kim and Slotine 2018, eq. 8); `parameters` (10,)."""
    _, _, _, _, xx, xy, yy, xz, yz, zz = parameters
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    P = np.empty((4, 4))
    P[:3, :3] = np.trace(inertia) / 2 * np.eye(3) - inertia
    P[:3, 3] = P[3, :3] = parameters[1:4]
    P[3, 3] = parameters[0]
    return P


def from_pseudo_inertia(P: Numbers) -> Numbers:
    """(10,) parameters from the (4, 4) matrix of moments."""
    second = P[:3, :3]
    return np.concatenate([[P[3, 3]], P[:3, 3], _six(np.trace(second) * np.eye(3) - second)])


def moved(parameters: Numbers, R: Numbers, p: Numbers) -> Numbers:
    """(10,) parameters of a body in another frame, in which its own frame is turned by `R` (3, 3) and at `p` (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return from_pseudo_inertia(T @ pseudo_inertia(parameters) @ T.T)


def largest(parameters: Numbers) -> Numbers:
    """(10,) the largest size that each parameter can have in a body of this mass and these moments of inertia (10,).

    A first moment is at most the root of mass times moment of inertia about either other axis, and a product of inertia
    at most half of the moment about the third: `(m c_x)^2 <= m * sum of x^2`, and `2 |x y| <= x^2 + y^2`. Mass and
    moments are their own size. Parameters that are not known (NaN) bound nothing.
    """
    mass, xx, yy, zz = np.maximum(np.nan_to_num(parameters[[0, 4, 6, 9]]), 0.0)
    known = np.where(np.isfinite(parameters[[4, 6, 9]]), [xx, yy, zz], np.inf)
    least = np.minimum(known[[1, 0, 0]], known[[2, 2, 1]])
    first = np.sqrt(mass * np.where(np.isfinite(least), least, 0.0))
    return np.array([mass, *first, xx, zz / 2, yy, yy / 2, xx / 2, zz])


def _six(inertia: Numbers) -> Numbers:
    return inertia[[0, 0, 1, 0, 1, 2], [0, 1, 1, 2, 2, 2]]
