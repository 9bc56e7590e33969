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

from jaximp.consistency.cone import BASIS, ELEMENTS, Cone, Posed, pose
from jaximp.models.chain import Chain
from jaximp.numerics.precision import require_float64
from jaximp.posterior.draws import Posterior, make_posterior
from jaximp.posterior.hamiltonian import sample_many
from jaximp.types import AnyArray, Numbers, Progress

STEPS, ENOUGH, SHORTEST = 200, 1e-9, 1e-12
"""Most steps of Newton's method to the mode; a step that gains less than this ends it, and one shorter than this share
of Newton's gains nothing."""


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
    """Log density of `y` (see `cone.Posed`) by the estimate and the prior, up to a constant; NaN outside the cone.

    The prior belongs to log-Cholesky parameters of each link, relative to the URDF's (Rucker and Wensing 2022, eq. 11):
    `S = V V'` with `V = exp(a) [[exp(d1), s12, s13, t1], [0, exp(d2), s23, t2], [0, 0, exp(d3), t3], [0, 0, 0, 1]]`, all
    of them normal and independent. So the mass is log-normal, and so are the squared radii of gyration; the centre of
    mass moves by `t` radii of gyration. What a joint cannot have below zero follows Rayleigh's distribution.

    It is a density of `y`, in which the data's errors are normal as they stand and valleys are straight; the determinant
    of the change from the parameters of the prior is in it.
    """

    start: Float[AnyArray, "*M n_b 10"]
    """Upper triangle of `S` at `y = 0`, column by column."""
    links: Float[AnyArray, "*M n_b 10 P"]
    """Along `y`."""
    at_joints: tuple[Float[AnyArray, "*M e"], Float[AnyArray, "*M e P"]]
    """What joints have, in natural sizes: at `y = 0`, and along `y`."""
    shape: tuple[Float[AnyArray, "*M"], Float[AnyArray, "*M"]]
    """Standard deviations of the logarithms, and of shears and shifts."""
    known: int = eqx.field(static=True)
    positive: tuple[bool, ...] = eqx.field(static=True)

    def __call__(self, y: Num[AnyArray, " P"]) -> Float[Array, ""]:
        y = jnp.asarray(y)
        links = self.start + self.links @ y
        joints = self.at_joints[0] + self.at_joints[1] @ y
        positive = np.array(self.positive, bool)
        log_joints = jnp.log(jnp.where(positive, joints, 1.0)).sum() - (joints**2).sum() / 2
        return -(y[: self.known] ** 2).sum() / 2 + _log_prior(links, *self.shape).sum() + log_joints


def _log_prior(S: Float[Array, "n_b 10"], of_logarithms: Any, of_shears: Any) -> Float[Array, " n_b"]:
    """Log density of matrices by their upper triangles."""
    s11, s12, s22, s13, s23, s33, s14, s24, s34, s44 = jnp.moveaxis(S, -1, 0)
    v4 = jnp.sqrt(s44)
    t1, t2, t3 = s14 / v4, s24 / v4, s34 / v4
    v3 = jnp.sqrt(s33 - t3**2)
    v13, v23 = (s13 - t1 * t3) / v3, (s23 - t2 * t3) / v3
    v2 = jnp.sqrt(s22 - v23**2 - t2**2)
    v12 = (s12 - v13 * v23 - t1 * t2) / v2
    v1 = jnp.sqrt(s11 - v12**2 - v13**2 - t1**2)
    a, *d = jnp.log(v4), *(jnp.log(v / v4) for v in (v1, v2, v3))
    logarithms = sum(x**2 for x in (a, *d)) / of_logarithms**2
    shears = sum((x / v4) ** 2 for x in (v12, v13, v23, t1, t2, t3)) / of_shears**2
    # |dS / d(a, d, s, t)| = 16 v1^2 v2^3 v3^4 v4^11
    volume = 2 * jnp.log(v1) + 3 * jnp.log(v2) + 4 * jnp.log(v3) + 11 * jnp.log(v4)
    return -(logarithms + shears) / 2 - volume


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
    68 %, and so are its three squared radii of gyration; its centre of mass is within `spread` radii of gyration; all
    that by independent log-Cholesky parameters. What joints have is hardly known before: Rayleigh's distribution, whose
    mode is the links' inertia that the motor sees for a rotor's inertia, and the limit of effort (over that of velocity)
    for friction; offsets are normal with this size. Drawn by Hamiltonian Monte Carlo, four chains, with gradients by JAX.

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
    mode, spread_there = _mode(density, posed)
    many = jax.tree.map(lambda x: jnp.asarray(x)[None], density)
    key = jax.random.key(seed)
    drawn = sample_many(many, mode[None], spread_there[None], key, ess=ess, progress=progress)[0]
    standard = posed.standard(np.asarray(drawn.chains))
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
    cone: Cone = posed.cone
    links, P = 10 * cone.n_bodies, len(posed.start)
    # From coordinates along an orthonormal basis to elements of the matrix.
    unit = np.array([BASIS[k][ij] for k, ij in enumerate(ELEMENTS)])
    start = unit * posed.start[:links].reshape(-1, 10) + np.array([float(i == j) for i, j in ELEMENTS])
    slope = unit[:, None] * posed.map[:links].reshape(-1, 10, P)
    sizes = np.diag(cone.scale)[links:]
    own = cone.reference[links:] / sizes + posed.start[links:]
    widths = np.asarray(np.log1p(spread) / 2), np.asarray(float(spread))
    positive = tuple(cone.positive[links:].tolist())
    return ConsistentDensity(start, slope, (own, posed.map[links:]), widths, posed.known, positive)


@eqx.filter_jit
def _slopes(density: ConsistentDensity, y: Array) -> tuple[Array, Array, Array]:
    """Value, gradient and second derivatives."""
    value, gradient = jax.value_and_grad(density)(y)
    return value, gradient, jax.hessian(density)(y)


def _mode(density: ConsistentDensity, posed: Posed) -> tuple[Numbers, Numbers]:
    """(P,) the mode of the density, and (P, P) the covariance there, by Newton's method from inside the cone.

    Second derivatives that curve upwards count by their size, and a step is halved until it gains: so it climbs from
    the URDF, wherever that lies.
    """
    y = np.linalg.solve(posed.map, _inside(posed) - posed.start)
    value, gradient, hessian = (np.asarray(x) for x in _slopes(density, jnp.asarray(y)))
    for _ in range(STEPS):
        values, axes = np.linalg.eigh(-hessian)
        step = axes @ ((axes.T @ gradient) / np.maximum(abs(values), 1e-12 * abs(values).max()))
        share = 1.0
        while share > SHORTEST:
            there = [np.asarray(x) for x in _slopes(density, jnp.asarray(y + share * step))]
            if there[0] >= value:  # not so for NaN, outside the cone
                break
            share /= 2
        else:
            break
        y, gained = y + share * step, there[0] - value
        value, gradient, hessian = there
        if gained < ENOUGH and share == 1.0:
            break
    values, axes = np.linalg.eigh(-hessian)
    return y, (axes / np.maximum(abs(values), 1e-9 * values[-1])) @ axes.T


def _inside(posed: Posed) -> Numbers:
    """(P,) coordinates of the URDF's links with friction and rotors of natural size."""
    cone, x = posed.cone, np.zeros(len(posed.start))
    x[cone.positive] = 1.0 - (cone.reference / np.where(cone.positive, np.diag(cone.scale), 1.0))[cone.positive]
    return x
