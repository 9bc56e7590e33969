"""The posterior over robots that can be: an estimate's errors, and the URDF's own values as the prior."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaximp.consistency.cone import BASIS, ELEMENTS, Posed, pose
from jaximp.models.chain import Chain
from jaximp.numerics.precision import require_float64
from jaximp.posterior.draws import Posterior, make_posterior
from jaximp.posterior.hamiltonian import sample_many
from jaximp.types import AnyArray, Numbers, Progress

STEPS, ENOUGH, SHORTEST, FLATTEST = 200, 1e-9, 1e-12, 1e-9
"""Most steps of Newton's method to the mode; a step that gains less than this ends it, and one shorter than this share
of Newton's gains nothing; curvature is at least this share of the largest."""
UNIT = np.array([BASIS[k][ij] for k, ij in enumerate(ELEMENTS)])
IDENTITY = np.array([float(i == j) for i, j in ELEMENTS])
"""From coordinates of a link to its matrix: `UNIT * x + IDENTITY` are the elements of the upper triangle."""


@dataclass(frozen=True, eq=False)
class ConsistentPosterior:
    """Draws of robots, all of them real."""

    standard: Posterior
    """Draws of all standard parameters."""
    base: Posterior
    """The base parameters of the same draws."""
    spread: float
    """By which links may differ from the URDF's, before the data."""
    notes: tuple[str, ...]

    @property
    def ok(self) -> bool:
        """Whether the diagnostics of the draws pass."""
        return not self.why

    @property
    def why(self) -> str:
        return self.standard.why

    def quantiles(self, levels: Num[AnyArray, " k"] = (0.025, 0.5, 0.975)) -> dict[str, Numbers]:
        """(k,) quantiles of every standard parameter, by name."""
        found = np.quantile(self.standard.samples, levels, axis=0)
        return dict(zip(self.standard.names, found.T, strict=True))


class ConsistentDensity(eqx.Module):
    """Log density of P numbers that are free, by the estimate and the prior, up to a constant.

    Of each link they are log-Cholesky parameters relative to the URDF's (Rucker and Wensing 2022), in standard
    deviations of the prior: the matrix is `S = V V'` with `V = exp(a) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2],
    [0, 0, exp(d3), t3], [0, 0, 0, 1]]`, all of them normal and independent. So the mass is log-normal, and so are the
    squared radii of gyration; the centre of mass moves by `t` radii of gyration. What a joint cannot have below zero is
    there by its logarithm, and follows Rayleigh's distribution.
    """

    errors: tuple[Float[AnyArray, "*M k P"], Float[AnyArray, "*M k"]]
    """Of the estimate, in its own independent units: `errors[0] @ x - errors[1]` for coordinates `x` in the cone."""
    reference: Float[AnyArray, "*M e"]
    """The URDF's values of what joints have, in natural sizes."""
    widths: Float[AnyArray, "*M 10"]
    """Standard deviations of a, d, s and t."""
    n_bodies: int = eqx.field(static=True)
    positive: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, free: Num[AnyArray, " P"]) -> Float[Array, ""]:
        links, joints = jnp.split(jnp.asarray(free), [10 * self.n_bodies])
        u = self.errors[0] @ self.coordinates(free) - self.errors[1]
        positive = np.array(self.positive, bool)
        value = jnp.where(positive, jnp.exp(joints), joints)
        # Rayleigh's density of the value, times the value for that of its logarithm.
        of_joints = 2 * jnp.where(positive, joints, 0.0).sum() - (value**2).sum() / 2
        return of_joints - ((u**2).sum() + (links**2).sum()) / 2

    def coordinates(self, free: Num[AnyArray, " P"]) -> Float[Array, " P"]:
        """In the cone, as `Cone.coordinates`."""
        links, joints = jnp.split(jnp.asarray(free), [10 * self.n_bodies])
        triangles = jax.vmap(_triangle)(links.reshape(-1, 10) * self.widths)
        value = jnp.where(np.array(self.positive, bool), jnp.exp(joints), joints)
        return jnp.concatenate([((triangles - IDENTITY) / UNIT).reshape(-1), value - self.reference])


def _triangle(parameters: Float[Array, "10"]) -> Float[Array, "10"]:
    """Upper triangle of `S`, column by column, of the log-Cholesky parameters a, d, s12, s13, s23 and t."""
    e = jnp.exp(parameters[0])
    v1, v2, v3 = (e * jnp.exp(d) for d in parameters[1:4])
    v12, v13, v23, t1, t2, t3 = e * parameters[4:]
    first = (v1**2 + v12**2 + v13**2 + t1**2, v12 * v2 + v13 * v23 + t1 * t2, v2**2 + v23**2 + t2**2)
    return jnp.stack([*first, v13 * v3 + t1 * t3, v23 * v3 + t2 * t3, v3**2 + t3**2, t1 * e, t2 * e, t3 * e, e**2])


def consistent_posterior(
    chain: Chain,
    estimate: Num[AnyArray, " p"],
    covariance: Num[AnyArray, "p p"],
    *,
    spread: float = 0.5,
    ess: float = 400,
    seed: int = 0,
    progress: Progress | None = None,
) -> ConsistentPosterior:
    """Draws of standard parameters by an estimate of base parameters, with the URDF's own values as the prior.

    Before the data a link's mass is log-normal about the URDF's, within a factor of `1 + spread` with a probability of
    68 %, and so are its three squared radii of gyration; its centre of mass is within `spread` radii of gyration. All
    that holds for independent log-Cholesky parameters, in which every number is free. What joints have is hardly known
    before: Rayleigh's distribution, whose mode for a rotor's inertia is that of the links as the motor sees it, and for
    friction the limit of effort (over that of velocity); offsets are normal with this size. Drawn by Hamiltonian Monte
    Carlo, four chains, with gradients by JAX.

    **Arguments:** estimates (p,) of `chain.names` with their covariance (p, p), NaN where there is none; `ess` the
    effective samples that every parameter should have.

    **Raises:** `ValueError` in one line for shapes that do not fit, a covariance that is not positive definite, a
    spread that is not above zero, float64 that is off, and without blackjax.

    **Source:** Rucker and Wensing 2022 (parameters); Wensing, Kim and Slotine 2018, eq. (8).
    """
    require_float64()
    if not 0 < spread < np.inf:
        raise ValueError(f"spread is {spread:g}: it must be above zero, such as 0.5 for 50 %")
    if find_spec("blackjax") is None:
        raise ValueError("posteriors of robots need blackjax: pip install 'jaximp[robots]'")
    posed = pose(chain, estimate, covariance)
    density = _density(posed, spread)
    mode, around = _mode(density)
    many = jax.tree.map(lambda x: jnp.asarray(x)[None], density)
    drawn = sample_many(many, mode[None], around[None], jax.random.key(seed), ess=ess, progress=progress)[0]
    free = np.asarray(drawn.chains)
    x = np.asarray(_coordinates(density, free.reshape(-1, free.shape[-1]))).reshape(free.shape)
    standard = posed.cone.reference + x @ posed.cone.scale.T
    base = standard @ np.asarray(chain.base.map, float).T
    units = tuple(posed.cone.units[k] for k in chain.base.kept)
    settings: dict[str, Any] = {"log_density": drawn.log_density, "acceptance": drawn.acceptance}
    return ConsistentPosterior(
        make_posterior(standard, posed.cone.names, posed.cone.units, sampler=drawn.sampler, **settings),
        make_posterior(base, chain.names, units, sampler=drawn.sampler, **settings),
        spread,
        posed.cone.notes,
    )


def _density(posed: Posed, spread: float) -> ConsistentDensity:
    cone = posed.cone
    links = 10 * cone.n_bodies
    back = np.linalg.inv(posed.map)[: posed.known]
    reference = cone.reference[links:] / np.diag(cone.scale)[links:]
    widths = np.array([np.log1p(spread) / 2] * 4 + [spread] * 6)
    return ConsistentDensity(
        (back, back @ posed.start), reference, widths, cone.n_bodies, tuple(cone.positive[links:].tolist())
    )


@eqx.filter_jit
def _coordinates(density: ConsistentDensity, free: Any) -> Array:
    return jax.vmap(density.coordinates)(jnp.asarray(free))


@eqx.filter_jit
def _slopes(density: ConsistentDensity, free: Any) -> tuple[Array, Array, Array]:
    """Value, gradient and second derivatives."""
    return density(free), jax.grad(density)(free), jax.hessian(density)(free)


def _mode(density: ConsistentDensity) -> tuple[Numbers, Numbers]:
    """(P,) the mode of the density, and (P, P) the covariance there, by Newton's method from the URDF.

    Directions that curve upwards count by the size of their curvature, and a step is halved until it gains: so it
    climbs from wherever it is.
    """
    free = np.zeros(10 * density.n_bodies + len(density.positive))
    value, gradient, hessian = (np.asarray(x) for x in _slopes(density, jnp.asarray(free)))
    for _ in range(STEPS):
        values, axes = np.linalg.eigh(-hessian)
        step = axes @ ((axes.T @ gradient) / np.maximum(abs(values), FLATTEST * abs(values).max()))
        share, before = 1.0, value
        while share > SHORTEST:
            there = [np.asarray(x) for x in _slopes(density, jnp.asarray(free + share * step))]
            if there[0] > value:  # not so for NaN, where exponentials overflow
                free, (value, gradient, hessian) = free + share * step, there
                break
            share /= 2
        if share <= SHORTEST or (share == 1.0 and value - before < ENOUGH):
            break
    values, axes = np.linalg.eigh(-hessian)
    return free, (axes / np.maximum(abs(values), FLATTEST * abs(values).max())) @ axes.T
