"""Inertia, damping and stiffness at the hand of a planar arm, from those of its joints, and their ellipses.

With J the Jacobian of the hand's position, an outside force F on the hand is the torque `J' F` at the joints, and what
the joints resist it with is felt at the hand as `J^-T A J^-1`: Börner et al. 2020, eq. (23) and figure 11.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models.arm import mass_matrix
from jaximp.models.kinematics import ArmGeometry
from jaximp.numerics.linear_algebra import solve_pair
from jaximp.types import AnyArray

Values = TypeVar("Values")


def endpoint_inertia(
    geometry: ArmGeometry, q: Num[ArrayLike, "... 2"], xi: Num[AnyArray, "3"]
) -> Float[Array, "... 2 2"]:
    """Inertia at the hand [kg] at the angles `q` [rad], from base parameters `xi` in the order of Lakatos et al. 2011
    [kg m^2] (`PlanarArm`, `BaseInertia.lakatos`); NaN or huge where the arm is straight or folded, as for damping and
    stiffness."""
    return _at_the_hand(geometry, q, mass_matrix(q, xi))


def endpoint_damping(
    geometry: ArmGeometry, q: Num[ArrayLike, "... 2"], D: Num[AnyArray, "... 2 2"]
) -> Float[Array, "... 2 2"]:
    """Damping at the hand [N s/m] at the angles `q` [rad], from that of the joints [N m s/rad]."""
    return _at_the_hand(geometry, q, D)


def endpoint_stiffness(
    geometry: ArmGeometry,
    q: Num[ArrayLike, "... 2"],
    K: Num[AnyArray, "... 2 2"],
    force: Num[ArrayLike, "... 2"] | None = None,
) -> Float[Array, "... 2 2"]:
    """Stiffness at the hand [N/m] at the angles `q` [rad], from that of the joints [N m/rad].

    `K` is the slope of the outside torque that holds the joints, along the angles; the result is the slope of the
    outside force that holds the hand, along its position: `J^-T (K - G) J^-1`.

    **Arguments:** `force` [N] is the outside force that holds the hand at `q`. As the arm moves, so does the torque
    `J' force` of the same force, by `G = d(J' force)/dq` [N m/rad], which is not the joints' stiffness. Without a force
    this term is left out.

    **Source:** McIntyre, Mussa-Ivaldi and Bizzi 1996, for the term of the force.
    """
    K = jnp.asarray(K)
    if force is not None:
        K = K - _turning(geometry.jacobian(q), jnp.asarray(force))
    return _at_the_hand(geometry, q, K)


class EndpointImpedance(eqx.Module):
    """Inertia, damping and stiffness with which the hand resists a motion."""

    inertia: Float[Array, "*N 2 2"]
    """Inertia at the hand [kg]."""
    damping: Float[Array, "*N 2 2"]
    """Damping at the hand [N s/m]."""
    stiffness: Float[Array, "*N 2 2"]
    """Stiffness at the hand [N/m]."""


def endpoint_impedance(
    geometry: ArmGeometry,
    q: Num[ArrayLike, "... 2"],
    xi: Num[AnyArray, "3"],
    D: Num[AnyArray, "... 2 2"],
    K: Num[AnyArray, "... 2 2"],
    force: Num[ArrayLike, "... 2"] | None = None,
) -> EndpointImpedance:
    """Inertia, damping and stiffness at the hand: `endpoint_inertia`, `endpoint_damping` and `endpoint_stiffness`.

    **Arguments:** those of these three; `xi` base parameters in the order of Lakatos et al. 2011 [kg m^2].
    """
    return EndpointImpedance(
        endpoint_inertia(geometry, q, xi), endpoint_damping(geometry, q, D), endpoint_stiffness(geometry, q, K, force)
    )


class Ellipse(eqx.Module):
    """Where the force's tip goes, for a matrix A, as `A u` for all directions u of length one.

    Of the symmetric part of A; an indefinite one has the sizes of its eigenvalues. Lengths have A's unit.
    """

    major: Float[Array, "*N"]
    """Length of the larger half axis."""
    minor: Float[Array, "*N"]
    """Length of the smaller half axis."""
    orientation: Float[Array, "*N"]
    """Angle [rad] of the major axis from the x axis, within a quarter turn of it."""
    size: Float[Array, "*N"]
    """Area, in A's unit squared."""
    shape: Float[Array, "*N"]
    """Major over minor axis, at least one."""

    def outline(self, n: int = 200) -> Float[Array, "*N n 2"]:
        """Points around the ellipse; the last one is the first one again."""
        return _outline(self, n)


@partial(jax.jit, static_argnums=1)
def _outline(one: Ellipse, n: int) -> Array:
    turn = jnp.linspace(0, 2 * jnp.pi, n)
    along, across = one.major[..., None] * jnp.cos(turn), one.minor[..., None] * jnp.sin(turn)
    cosine, sine = jnp.cos(one.orientation)[..., None], jnp.sin(one.orientation)[..., None]
    return jnp.stack([cosine * along - sine * across, sine * along + cosine * across], axis=-1)


@jax.jit
def ellipse(matrix: Num[AnyArray, "*N 2 2"]) -> Ellipse:
    """Size, shape and orientation of an endpoint stiffness (damping, inertia), as Mussa-Ivaldi et al. 1985 define them.

    A circle has an orientation of zero, and no derivative of shape and orientation.
    """
    matrix = jnp.asarray(matrix, float)
    mean = (matrix[..., 0, 0] + matrix[..., 1, 1]) / 2
    half, shear = (matrix[..., 0, 0] - matrix[..., 1, 1]) / 2, (matrix[..., 0, 1] + matrix[..., 1, 0]) / 2
    radius = jnp.hypot(half, shear)
    angle = jnp.arctan2(shear, half) / 2  # of the larger eigenvalue
    turned = jnp.where(angle > 0, angle - jnp.pi / 2, angle + jnp.pi / 2)
    major, minor = jnp.abs(mean) + radius, jnp.abs(jnp.abs(mean) - radius)
    orientation = jnp.where(mean < 0, turned, angle)
    return Ellipse(major, minor, orientation, jnp.pi * major * minor, major / minor)


def propagated_stderr(
    function: Callable[[Array], Values], theta: Float[Array, " p"], covariance: Float[Array, "p p"]
) -> Values:
    """Standard errors of whatever `function` returns for the estimate `theta`, to first order, in the same structure.

    For instance of the stiffness ellipse of a `StiffnessFit`: `function` takes its `theta`, puts K together and returns
    `ellipse(endpoint_stiffness(geometry, q, K))`. `vmap` over estimates.
    """

    def stderr(slope: Array) -> Array:
        return jnp.sqrt(jnp.einsum("...i,ij,...j->...", slope, covariance, slope, precision="highest"))

    return jax.tree.map(stderr, jax.jacfwd(function)(theta))


def _at_the_hand(geometry: ArmGeometry, q: ArrayLike, matrix: AnyArray) -> Array:
    """`J^-T A J^-1`."""
    return _transformed(geometry.jacobian(q), jnp.asarray(matrix))


@jax.jit
def _transformed(J: Array, matrix: Array) -> Array:
    across = jnp.swapaxes(J, -1, -2)

    def from_the_left(A: Array) -> Array:
        return jnp.stack([solve_pair(across, column) for column in (A[..., 0], A[..., 1])], axis=-1)

    return jnp.swapaxes(from_the_left(jnp.swapaxes(from_the_left(matrix), -1, -2)), -1, -2)


@jax.jit
def _turning(J: Array, force: Array) -> Array:
    """How the torque of a constant force changes as the arm moves [N m/rad]: minus the force along the links."""
    along = J[..., 0, :] * force[..., 1, None] - J[..., 1, :] * force[..., 0, None]
    first, second = along[..., 0], along[..., 1]
    return jnp.stack([jnp.stack([first, second], axis=-1), jnp.stack([second, second], axis=-1)], axis=-2)
