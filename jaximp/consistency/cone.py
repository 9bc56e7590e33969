"""The cone of standard parameters that a robot can have, in coordinates in which its URDF is the unit.

A link is real if the matrix of its moments of mass is positive definite (Wensing, Kim and Slotine 2018); rotors'
inertias and friction are at least zero. With `P0 = T T'` the matrix of the URDF's own link and `P = T S T'` that of
another, `S` is the identity for the URDF, it has no unit, and `P` is positive definite where `S` is. A link's
coordinates `x` are the ten numbers of `S - I`, and near the URDF their length is the affine-invariant distance from it
(Lee, Wensing and Park 2020).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Num

from jaximp.models import rigid_body
from jaximp.models.chain import Chain
from jaximp.models.spatial import about, from_pseudo_inertia, pseudo_inertia
from jaximp.types import AnyArray, Numbers, listed

THINNEST, SMALLEST = 1e-2, 1e-3
"""Where the URDF's link is no body, its second moments of mass are raised to this share of the largest, and to those of
a radius of gyration of so many metres."""
UNKNOWN_MASS = 1.0
"""Of a link [kg], where no link of the file has any."""
UNKNOWN_EFFORT, UNKNOWN_SPEED = 100.0, 1.0
"""Of a joint without limits [N m or N, rad/s or m/s]: the natural size of its friction."""
POSES = 8
"""By so many the inertia that a motor sees is averaged."""

ELEMENTS = [(i, j) for j in range(4) for i in range(j + 1)]


def _symmetric_basis() -> Numbers:
    basis = np.zeros((10, 4, 4))
    for k, (i, j) in enumerate(ELEMENTS):
        basis[k, i, j] = basis[k, j, i] = 1.0 if i == j else np.sqrt(0.5)
    return basis


BASIS = _symmetric_basis()
"""(10, 4, 4) orthonormal basis of the symmetric matrices, column by column."""


@dataclass(frozen=True, eq=False)
class Cone:
    """All robots that have a chain's geometry: `standard = reference + scale @ x` where every link's matrix
    `I + sum of x BASIS` is positive definite and what is `positive` is at least zero."""

    names: tuple[str, ...]
    """Of the P standard parameters."""
    units: tuple[str, ...]
    n_bodies: int
    reference: Numbers
    """(P,) the URDF's values, made possible where they are not."""
    scale: Numbers
    """(P, P) natural sizes: block by block for links, numbers for what joints have."""
    positive: AnyArray
    """(P,) which parameters of joints cannot be below zero: rotors' inertias and friction."""
    notes: tuple[str, ...]
    """What was changed in the URDF's own values, in words."""

    def coordinates(self, standard: Num[AnyArray, " P"]) -> Numbers:
        """(P,) of standard parameters."""
        return np.asarray(np.linalg.solve(self.scale, np.asarray(standard, float) - self.reference), float)

    def smallest(self, standard: Num[AnyArray, " P"]) -> Numbers:
        """(n_b,) smallest eigenvalue of each link's matrix, as a share of the URDF's: above zero for real bodies."""
        x = self.coordinates(standard)[: 10 * self.n_bodies].reshape(-1, 10)
        return np.asarray(np.linalg.eigvalsh(np.eye(4) + np.tensordot(x, BASIS, 1))[:, 0], float)

    def holds(self, standard: Num[AnyArray, " P"]) -> bool:
        """Whether every link is a real body, and rotors and friction are at least zero."""
        return bool((self.smallest(standard) > 0).all() and (np.asarray(standard)[self.positive] >= 0).all())


def cone_of(chain: Chain) -> Cone:
    """The cone of a chain's standard parameters, with its URDF in the middle."""
    links, notes = _possible(chain)
    n, P = chain.n_joints, len(chain.base.standard_names)
    reference, scale = np.array(chain.standard_parameters, float), np.zeros((P, P))
    reference[: links.size] = links.ravel()
    for k, link in enumerate(links):
        T, at = upper_factor(pseudo_inertia(link)), slice(10 * k, 10 * k + 10)
        scale[at, at] = np.stack([from_pseudo_inertia(T @ E @ T.T) for E in BASIS], axis=1)
    sizes, positive = _sizes_of_joints(chain, links), np.zeros(P, bool)
    scale[range(links.size, P), range(links.size, P)] = sizes
    positive[links.size : P - n * chain.offset] = True
    return Cone(chain.base.standard_names, chain.standard_units, len(links), reference, scale, positive, tuple(notes))


def upper_factor(P: Numbers) -> Numbers:
    """Upper triangular T with `P = T T'`, of a positive definite matrix."""
    return np.asarray(np.linalg.cholesky(P[::-1, ::-1])[::-1, ::-1], float)


def _possible(chain: Chain) -> tuple[Numbers, list[str]]:
    """(n_b, 10) the URDF's links, each made a body if it is none, and which were."""
    links, notes = np.array(chain.links, float), []
    masses = links[:, 0]
    usual = float(np.median(masses[masses > 0])) if (masses > 0).any() else UNKNOWN_MASS
    for k, link in enumerate(links):
        mass = link[0] if link[0] > 0 else usual
        centre = link[1:4] / mass
        second = pseudo_inertia(link)[:3, :3] / mass - np.outer(centre, centre)
        values, axes = np.linalg.eigh(second)
        least = max(THINNEST * values[-1], SMALLEST**2)
        if link[0] > 0 and values[0] > 1e-6 * max(values[-1], SMALLEST**2):
            continue
        second = (axes * np.maximum(values, least)) @ axes.T
        links[k] = about(mass, centre, mass * (np.trace(second) * np.eye(3) - second))
        notes.append(f"link{k + 1} ({listed(chain.link_names[k])})")
    return links, [f"in the URDF no real bodies: {listed(notes)}; the nearest took their place"] if notes else []


def _sizes_of_joints(chain: Chain, links: Numbers) -> Numbers:
    """Natural sizes of what each joint has: of a rotor, the inertia that its motor sees; of friction, what the joint's
    largest effort overcomes at its largest speed."""
    effort, speed = (
        np.where(np.isfinite(x), x, default)
        for x, default in ((chain.limits.effort, UNKNOWN_EFFORT), (chain.limits.velocity, UNKNOWN_SPEED))
    )
    rotors = [_inertia_at_motors(chain, links)] if chain.rotor else []
    friction = [effort / speed if term.name == "viscous_friction" else effort for term in chain.terms]
    return np.concatenate([np.zeros(0), *rotors, *friction, *[effort] * chain.offset])


def _inertia_at_motors(chain: Chain, links: Numbers) -> Numbers:
    """(n,) of the links, averaged over poses."""
    n = chain.n_joints
    q = np.repeat(np.random.default_rng(0).uniform(-np.pi, np.pi, (n, POSES)), n, axis=1)
    weightless = eqx.tree_at(lambda tree: tree.gravity, chain.tree, np.zeros(3))
    columns = rigid_body.regressor_columns(weightless, q, np.zeros_like(q), np.tile(np.eye(n), POSES), np)
    torque = np.einsum("pknN,kp->nN", np.stack([np.broadcast_to(c, (len(links), *q.shape)) for c in columns]), links)
    mass = torque.reshape(n, POSES, n).mean(axis=1)
    motors = np.asarray(chain.motors, float)
    return np.diag(np.linalg.solve(motors.T, np.linalg.solve(motors.T, mass.T).T))


class Posed(NamedTuple):
    """Standard parameters by what the data say of them and what they leave open: `x = start + map @ y`, of which the
    first `known` numbers of `y` are independent standard normal errors of the estimate, and the others, of unit length
    in `x`, move no torque that was estimated."""

    cone: Cone
    start: Float[AnyArray, " P"]
    map: Float[AnyArray, "P P"]
    known: int

    def standard(self, y: Numbers) -> Numbers:
        """(..., P) standard parameters."""
        return self.offset + y @ self.slope.T

    @property
    def slope(self) -> Numbers:
        """(P, P) of the standard parameters along `y`."""
        return self.cone.scale @ self.map

    @property
    def offset(self) -> Numbers:
        return self.cone.reference + self.cone.scale @ self.start


def pose(chain: Chain, estimate: Num[AnyArray, " p"], covariance: Num[AnyArray, "p p"]) -> Posed:
    """Base parameters that were estimated, as a distribution over what is in the cone.

    **Arguments:** estimates of `chain.names` with their covariance; NaN for what was not determined.

    **Raises:** `ValueError` for shapes that do not fit, and a covariance that is not positive definite.
    """
    theta, C = np.asarray(estimate, float), np.asarray(covariance, float)
    p = len(chain.names)
    if theta.shape != (p,) or C.shape != (p, p):
        raise ValueError(
            f"the estimate has the shape {theta.shape} and its covariance {C.shape}: for the {p} base parameters of "
            f"this chain they are ({p},) and ({p}, {p}), in the order of chain.names"
        )
    return pose_in(cone_of(chain), np.asarray(chain.base.map, float), chain.names, theta, C)


def pose_in(cone: Cone, B: Float[AnyArray, "p P"], names: Sequence[str], theta: Numbers, C: Numbers) -> Posed:
    """The same for estimates `theta` (p,) of `B` times the standard parameters of any cone, with their `names`."""
    seen = np.isfinite(theta)
    theta, L = theta[seen], _factor(C[np.ix_(seen, seen)], [n for n, k in zip(names, seen, strict=True) if k])
    B = np.asarray(B, float)[seen]
    # B scale = R' Q': the columns of Q beyond the first are what moves no base parameter.
    Q, R = np.linalg.qr((B @ cone.scale).T, mode="complete")
    k = len(theta)
    errors = np.column_stack([theta - B @ cone.reference, L])
    back: Numbers = np.linalg.solve(R[:k].T, errors) if k else errors
    return Posed(cone, Q[:, :k] @ back[:, 0], np.hstack([Q[:, :k] @ back[:, 1:], Q[:, k:]]), k)


def _factor(C: Numbers, names: Sequence[str]) -> Numbers:
    """Lower triangular factor of a covariance, whatever its units."""
    size = np.sqrt(np.maximum(np.diag(C), 0))
    bad = ~(np.isfinite(size) & (size > 0))
    if bad.any():
        raise ValueError(
            f"the variance of {names[int(bad.argmax())]} is {np.diag(C)[bad][0]:g}: it must be above zero; pass NaN "
            "for the estimate of what was not determined"
        )
    try:
        return size[:, None] * np.linalg.cholesky(C / np.outer(size, size))
    except np.linalg.LinAlgError:
        raise ValueError(
            "the covariance of the base parameters is not positive definite: pass that of the estimate, of full rank"
        ) from None
