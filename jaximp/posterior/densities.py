"""Log densities of parameters given a recording: what samplers sample.

A `Density` is called with one vector of parameters `theta`, the last of which are logarithms of the noise's scale, one
per output. It is pure: for `jit`, `grad`, and `vmap` over `theta`; over the densities of many windows, whose arrays
have a leading axis, `eqx.filter_vmap`. It is -inf outside its support. Linear models of torque with Gaussian noise need
no rows: the triangle of a QR decomposition of the whitened `[W y]` and how many rows were independent say it all.

Without a prior it is flat in every parameter (for a stiffness in K, not in its factor) and in the logarithms of the
noise. For one output the parameters then follow Student's t with `count - p` degrees of freedom, exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammaln
from jaxtyping import Array, Float, Num, Shaped

from jaximp.least_squares.noise import WhiteRows, triangles
from jaximp.numerics.definite import eigenvalues
from jaximp.numerics.linear_algebra import back_substitute, cholesky, triangle
from jaximp.numerics.precision import require_float64
from jaximp.perturbation.stiffness import (
    FEWEST_TRIALS,
    MATRICES,
    MATRIX_OF,
    SEVEN,
    SYMMETRIC_ELEMENTS,
    element_columns,
    symmetric_matrix,
)
from jaximp.posterior.predictive import NU, student
from jaximp.posterior.priors import Prior, make_prior
from jaximp.types import AnyArray, Numbers

FLAT = 1e-12
"""A direction is flat if its information is below this, in units in which the information of every parameter is one."""
NO_NOISE = 1e-12
"""Residuals that are smaller than this share of the torque are taken as rounding."""
STEPS, DECREMENT = 60, 1e-14
"""Of Newton's method: how many at most, and the squared distance from the mode, in standard deviations, at its end."""
STIFFNESS = SYMMETRIC_ELEMENTS
FACTOR = ("l11", "l21", "l22")
UNITS = tuple(MATRICES[MATRIX_OF[name]] for name in STIFFNESS)
FACTOR_UNITS = ("N m s/rad",) * 4 + ("(N m/rad)^0.5",) * 3
K = slice(4, 7)
"""The parameters of a stiffness among all elements."""


class GaussianRows(eqx.Module):
    """Torques with Gaussian noise, from the triangles of their rows."""

    rows: Float[AnyArray, "*M n k q"]
    """For each of n outputs the rows `[W y]`, or the triangle of their QR decomposition."""
    count: Float[AnyArray, "*M n"]
    """How many independent rows each output has."""

    def log_likelihood(self, x: Float[Array, " P"]) -> Float[Array, ""]:
        p, log_noise = self.rows.shape[-1] - 1, x[self.rows.shape[-1] - 1 :]
        residual = (self.rows[..., :p] * x[:p]).sum(axis=-1) - self.rows[..., p]
        squares = (residual**2).sum(axis=-1) * jnp.exp(-2 * log_noise)
        return -(squares / 2 + self.count * (log_noise + jnp.log(2 * jnp.pi) / 2)).sum()

    def guess(self) -> Float[Array, " P"]:
        """Least squares, every output alike, and the noise that it leaves."""
        return _least_squares(self.rows, self.count)


class HeavyRows(eqx.Module):
    """Torques whose noise has heavy tails: Student's t, of a scale that is unknown."""

    rows: Float[AnyArray, "*M n k q"]
    """For each of n outputs the rows `[W y]`."""
    valid: Shaped[AnyArray, "*M n k"]
    count: Float[AnyArray, "*M n"]
    nu: Float[AnyArray, "*M"]
    """Degrees of freedom."""

    def log_likelihood(self, x: Float[Array, " P"]) -> Float[Array, ""]:
        p, log_noise = self.rows.shape[-1] - 1, x[self.rows.shape[-1] - 1 :, None]
        residual = (self.rows[..., :p] * x[:p]).sum(axis=-1) - self.rows[..., p]
        return jnp.where(self.valid, student(residual * jnp.exp(-log_noise), self.nu) - log_noise, 0).sum()

    def guess(self) -> Float[Array, " P"]:
        return _least_squares(self.rows, self.count)


class StudentEstimate(eqx.Module):
    """The likelihood of an estimate with standard errors: a multivariate Student's t around it."""

    mean: Float[AnyArray, "*M p"]
    root: Float[AnyArray, "*M p p"]
    """A root of the precision: root' root is the inverse of the covariance."""
    dof: Float[AnyArray, "*M"]

    def log_likelihood(self, x: Float[Array, " p"]) -> Float[Array, ""]:
        p = len(x)
        squares = ((self.root * (x - self.mean)).sum(axis=1) ** 2).sum()
        scale = gammaln((self.dof + p) / 2) - gammaln(self.dof / 2) - p * jnp.log(self.dof * jnp.pi) / 2
        scale += jnp.log(jnp.abs(jnp.diagonal(self.root))).sum()
        return scale - (self.dof + p) / 2 * jnp.log1p(squares / self.dof)

    def guess(self) -> Float[Array, " p"]:
        return jnp.asarray(self.mean)


class Curved(eqx.Module):
    """A likelihood that was stretched about its mode."""

    inner: Any
    mode: Float[AnyArray, "*M P"]
    stretch: Float[AnyArray, "*M P P"]

    def log_likelihood(self, x: Float[Array, " P"]) -> Float[Array, ""]:
        return self.inner.log_likelihood(self.mode + (self.stretch * (x - self.mode)).sum(axis=1))

    def guess(self) -> Float[Array, " P"]:
        return jnp.asarray(self.mode)


class Density(eqx.Module):
    """Log density of parameters: a likelihood and a prior; the place of a stiffness K may be taken by its factor."""

    likelihood: Any
    """The likelihood of the elements: `GaussianRows`, `HeavyRows`, `StudentEstimate` or `Curved`."""
    prior: Prior
    """The prior of the elements."""
    names: tuple[str, ...] = eqx.field(static=True)
    """Of the parameters; K = L L' has l11, l21 and l22, of which the first and the last are positive."""
    units: tuple[str, ...] = eqx.field(static=True)
    definite: bool = eqx.field(static=True, default=False)
    """Elements 4 to 6 are those of a positive definite stiffness K, `stiffness_11`, `_12` and `_22`."""

    @property
    def element_names(self) -> tuple[str, ...]:
        """The names with the elements of K in place of those of its factor."""
        return self.prior.names

    @property
    def element_units(self) -> tuple[str, ...]:
        return (*UNITS, *self.units[len(UNITS) :]) if self.definite else self.units

    def __call__(self, theta: Num[AnyArray, " P"]) -> Float[Array, ""]:
        theta = jnp.asarray(theta)
        inside = ((theta[4] > 0) & (theta[6] > 0)) if self.definite else jnp.array(True)
        # Outside all is evaluated at a harmless place, so that gradients stay finite.
        safe = jnp.where(inside, theta, jnp.ones_like(theta))
        x = self.elements(safe)
        value = self.likelihood.log_likelihood(x) + self.prior.log_density(x)
        if self.definite:  # of the Jacobian of K along its factor
            value += jnp.log(4 * safe[4] ** 2 * safe[6])
        return jnp.where(inside & jnp.isfinite(value), value, -jnp.inf)

    def elements(self, theta: Num[AnyArray, "*draws P"]) -> Float[Array, "*draws P"]:
        """Parameters with the elements of K in place of its factor; for one vector, or samples."""
        theta = jnp.asarray(theta)
        if not self.definite:
            return theta
        l11, l21, l22 = (theta[..., k] for k in (4, 5, 6))
        return theta.at[..., K].set(jnp.stack([l11**2, l11 * l21, l21**2 + l22**2], axis=-1))

    def laplace(self) -> tuple[Float[Array, " P"], Float[Array, "P P"]]:
        """Mode, and the inverse of minus the second derivatives there: by Newton's method from least squares."""
        return _laplace(self)

    def start(self) -> Float[Array, " P"]:
        """Parameters that lie inside the support, near the mode."""
        x = self.likelihood.guess()
        logarithmic = np.array(self.prior.logarithmic)
        x = jnp.where(logarithmic & (x <= 0), jnp.exp(jnp.where(logarithmic, self.prior.mean, 0)), x)
        if not self.definite:
            return x
        low, high = eigenvalues(x[K])
        size = jnp.maximum(jnp.abs(high), jnp.abs(low))
        a, b, c = x[K] + jnp.maximum(0.01 * size - low, 0) * jnp.array([1.0, 0.0, 1.0])
        l11 = jnp.sqrt(a)
        return x.at[K].set(jnp.stack([l11, b / l11, jnp.sqrt(c - (b / l11) ** 2)]))


def linear_density(
    names: Sequence[str],
    units: Sequence[str],
    rows: WhiteRows,
    prior: Prior | None = None,
    *,
    heavy_tails: bool | float = False,
    column_noise: Num[AnyArray, " p"] | Num[AnyArray, "*n p p"] | None = None,
    noise_unit: str = "N m",
) -> Density:
    """Log density of `torque = W theta + noise`, and of the logarithm of the noise's scale in every output.

    **Arguments:** names and units of the p parameters; `rows` as `noise.whiten` makes them of a window or a whole
    recording, and `noise.joined` of trials together; `prior` of these names and of `noise_names`, else flat;
    `heavy_tails` for noise of Student's t, with so many degrees of freedom or `NU`; `column_noise`, the noise in the
    regressor: root mean square (p,) where it is independent from column to column, or covariance of whitened rows
    (p, p) or (n, p, p), `whitened_covariance`. It is corrected for where it matters, see `corrected`.

    **Raises:** ValueError where float64 is off, and where the data and the prior leave something undetermined.
    """
    require_float64()
    names, n = tuple(names), len(rows.count)
    prior = _prior_for(prior, (*names, *noise_names(n)))
    likelihood, why = _likelihood_of(rows, prior, heavy_tails, column_noise)
    if why:
        raise ValueError(why)
    return _on_device(Density(likelihood, prior, prior.names, (*units, *(f"ln({noise_unit})",) * n)))


def window_densities(
    names: Sequence[str],
    units: Sequence[str],
    parts: Sequence[WhiteRows],
    prior: Prior | None = None,
    *,
    heavy_tails: bool | float = False,
    column_noise: Num[AnyArray, " p"] | Num[AnyArray, "*n p p"] | None = None,
) -> tuple[Density, tuple[str, ...]]:
    """Log densities of many windows at once, their arrays with a leading axis, for `eqx.filter_vmap`.

    Arguments as for `linear_density`; `parts` are the rows of the windows, as many in each.

    **Returns:** the densities of the windows that determine all parameters, and for each of them all why it does not;
    empty where it does.

    **Raises:** ValueError where none does.
    """
    require_float64()
    n = len(parts[0].count)
    flat = _prior_for(prior, (*names, *noise_names(n)))
    found, reasons = [], []
    for rows in parts:
        try:
            likelihood, why = _likelihood_of(rows, flat, heavy_tails, column_noise)
        except ValueError as error:
            why = str(error)
        reasons.append(why)
        found += [] if why else [Density(likelihood, flat, flat.names, (*units, *("ln(N m)",) * n))]
    if not found:
        raise ValueError(f"no window determines all parameters; the first: {reasons[0]}")
    return _on_device(jax.tree.map(lambda *leaves: np.stack(leaves), *found)), tuple(reasons)


def _likelihood_of(
    rows: WhiteRows, prior: Prior, heavy_tails: bool | float, column_noise: AnyArray | None
) -> tuple[GaussianRows | HeavyRows, str]:
    """Of rows with Gaussian noise or heavy tails, and what these and the prior leave undetermined."""
    given = triangles(rows, column_noise)
    why = undetermined(given, rows.count, prior)
    if not heavy_tails:
        return GaussianRows(given, rows.count), why
    if not np.array_equal(given, rows.triangles()):
        raise ValueError("heavy tails and noise in the regressor do not go together: filter the position more")
    nu = NU if heavy_tails is True else float(heavy_tails)
    if not nu > 0:
        raise ValueError(f"heavy_tails is {nu:g}: degrees of freedom are above zero")
    return HeavyRows(rows.columns(), rows.valid.T, rows.count, np.asarray(nu)), why


def stiffness_density(
    triangle_of_trials: Num[AnyArray, "6 6"], samples: int | Num[AnyArray, ""], prior: Prior | None = None
) -> Density:
    """Log density of damping, the factor of a positive definite stiffness K = L L', and the logarithm of the noise.

    Flat in K: with 4 l11^2 l22, the determinant of the derivatives of K along l11, l21, l22. The residuals are taken as
    independent; those of perturbation trials are not, see `adjusted`.

    **Arguments:** the triangle of `stiffness.residual_triangle`, of one trial or merged; its samples, each of them two
    torques; `prior` of `damping_11` to `stiffness_22` and `log_noise`.

    **Source:** Börner et al. 2020, eqs. (36) to (38).
    """
    require_float64()
    columns = _element_columns(np.asarray(triangle_of_trials, float))
    given, count = np.asarray(np.linalg.qr(columns.T, mode="r"))[None], np.array([2.0 * float(samples)])
    prior = _prior_for(prior, (*STIFFNESS, *noise_names(1)))
    why = undetermined(given, count, prior)
    if why:
        raise ValueError(why)
    names = (*STIFFNESS[:4], *FACTOR, *noise_names(1))
    return _on_device(Density(GaussianRows(given, count), prior, names, (*FACTOR_UNITS, "ln(N m)"), definite=True))


def estimate_density(
    names: Sequence[str],
    units: Sequence[str],
    theta: Num[AnyArray, " p"],
    covariance: Num[AnyArray, "p p"],
    dof: float | Num[AnyArray, ""],
    prior: Prior | None = None,
) -> Density:
    """Log density of parameters of which an estimate, its covariance and its degrees of freedom are known.

    Student's t around the estimate. Where the parameters are those of `STIFFNESS`, K must be positive
    definite, and is sampled by its factor.

    **Raises:** ValueError for an estimate without a covariance.
    """
    require_float64()
    names, covariance = tuple(names), np.asarray(covariance, float)
    root = _inverse_root(covariance, "the estimate")
    if not (np.isfinite(np.asarray(theta)).all() and 0 < float(dof) < np.inf):
        raise ValueError("there is no estimate to draw around: its numbers, or its degrees of freedom, are not finite")
    likelihood = StudentEstimate(np.asarray(theta, float), root, np.asarray(dof, float))
    prior = _prior_for(prior, names)
    if names != STIFFNESS:
        return _on_device(Density(likelihood, prior, names, tuple(units)))
    return _on_device(Density(likelihood, prior, (*STIFFNESS[:4], *FACTOR), FACTOR_UNITS, definite=True))


def adjusted(density: Density, covariance: Num[AnyArray, "q q"]) -> Density:
    """The same density with the likelihood's curvature that of a known covariance: `inv(covariance)`.

    For residuals that are not independent, as those within a perturbation trial: the covariance is then that of whole
    trials, the jackknife of `stiffness.fit_triangles`. The likelihood is evaluated at `mode + C (x - mode)`, x being
    elements; prior and support stay. What the covariance does not cover (the noise) keeps its own: its width is that of
    independent residuals. A covariance from few trials is itself uncertain, which `estimate_density` knows and this
    does not.

    **Arguments:** covariance of the first q elements (`damping_11` to `stiffness_22`).

    **Source:** Ribatet, Cooley and Davison 2012, section 2.2.
    """
    base, covariance = density.likelihood, np.asarray(covariance, float)
    mode, own = (np.array(x) for x in _likelihood_alone(base))
    asked, q = own.copy(), len(covariance)
    asked[:q, q:] = asked[q:, :q] = 0
    asked[:q, :q] = covariance
    root = _inverse_root(asked, f"the trials (there is none from fewer than {FEWEST_TRIALS})")
    stretch = np.linalg.inv(_inverse_root(own, "the likelihood")) @ root
    return _on_device(eqx.tree_at(lambda d: d.likelihood, density, Curved(base, mode, stretch)))


def noise_names(n: int) -> tuple[str, ...]:
    """Names of the logarithms of the noise in n outputs."""
    return ("log_noise",) if n == 1 else tuple(f"log_noise_{k + 1}" for k in range(n))


def stiffness_matrices(elements: Num[AnyArray, "*draws P"]) -> tuple[Numbers, Numbers]:
    """Damping and stiffness (*draws, 2, 2) of samples of the elements `STIFFNESS`, and whatever follows them."""
    x = np.asarray(elements)
    shape = (*x.shape[:-1], 2, 2)
    return x[..., :4].reshape(shape), symmetric_matrix(x[..., K])


@eqx.filter_jit
def _laplace(density: Any) -> tuple[Array, Array]:
    return newton(density, density.start())


@eqx.filter_jit
def _likelihood_alone(likelihood: Any) -> tuple[Array, Array]:
    return newton(likelihood.log_likelihood, likelihood.guess())


def newton(log_density: Any, start: Float[Array, " P"]) -> tuple[Float[Array, " P"], Float[Array, "P P"]]:
    """Mode of a log density and the inverse of minus its second derivatives there, for `vmap` as well.

    Newton's method, damped after Levenberg and Marquardt. NaN where no curvature was found.
    """

    def lost(theta: Array) -> Array:
        return -log_density(theta)

    def slopes(theta: Array) -> tuple[Array, Array]:
        return jax.grad(lost)(theta), jax.hessian(lost)(theta)

    def unfinished(state: tuple[Array, ...]) -> Array:
        return (state[-1] < STEPS) & (state[-2] > DECREMENT)

    def step(state: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array, Array]:
        theta, value, damping, _, count = state
        gradient, H = slopes(theta)
        R, definite = cholesky(H + damping * jnp.diag(jnp.abs(jnp.diagonal(H))))
        move = _solved(R, gradient)
        new = theta - move
        there = lost(new)
        better = definite & (there <= value + 1e-12 * jnp.abs(value))
        near = jnp.where(better & (damping < 1e-3), gradient @ move, jnp.inf)
        eased = jnp.where(damping > 1e-6, damping / 10, 0)
        return (
            jnp.where(better, new, theta),
            jnp.where(better, there, value),
            jnp.where(better, eased, jnp.maximum(10 * damping, 1e-3)),
            near,
            count + 1,
        )

    first = (start, lost(start), jnp.array(0.0), jnp.array(jnp.inf), jnp.array(0))
    mode = jax.lax.while_loop(unfinished, step, first)[0]
    R, definite = cholesky(slopes(mode)[1])
    covariance = jax.vmap(lambda unit: _solved(R, unit))(jnp.eye(len(start)))
    return mode, jnp.where(definite, (covariance + covariance.T) / 2, jnp.nan)


def undetermined(triangles: Numbers, count: Numbers, prior: Prior) -> str:
    """What rows and prior leave undetermined, in one line; empty if nothing."""
    names, p = prior.names, triangles.shape[-1] - 1
    columns, torque = triangles[..., :p], triangles[..., p]
    size = np.abs(columns).max(axis=(0, 1))
    columns = columns / np.where(size > 0, size, 1)
    ranks = [int(np.linalg.matrix_rank(R)) for R in columns]
    if (count <= ranks).any() or count.sum() <= p:
        return (
            f"{count.sum():.0f} independent rows cannot determine {p} parameters and the noise: lengthen the window, "
            "or filter and decimate less"
        )
    left = np.linalg.norm(torque - columns @ np.linalg.lstsq(columns.reshape(-1, p), torque.ravel())[0], axis=1)
    if (left <= NO_NOISE * np.linalg.norm(torque, axis=1)).any():
        return "the parameters reproduce the torque to the last digit: without noise there is nothing to be unsure of"
    weighted = triangles[..., :p] * (np.sqrt(count) / left)[:, None, None]
    return flat_direction(np.einsum("nki,nkj->ij", weighted, weighted) + prior.information()[:p, :p], names[:p])


def flat_direction(information: Num[AnyArray, "p p"], names: Sequence[str]) -> str:
    """Names the parameters that cannot be told apart, or that have no effect; empty if there are none."""
    information = np.asarray(information, float)
    diagonal = np.diagonal(information)
    nothing = [name for name, value in zip(names, diagonal, strict=True) if not value > 0]
    if nothing:
        return f"{' and '.join(nothing)} has no effect on the torque: leave it out, or give it a prior"
    size = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    if values[0] > FLAT:
        return ""
    share = np.abs(vectors[:, 0])
    alike = [name for name, one in zip(names, share, strict=True) if one > 0.1 * share.max()]
    return (
        f"{', '.join(alike[:-1])} and {alike[-1]} cannot be told apart: their columns are proportional in this motion. "
        "Move with more frequencies, or give one of them a prior"
    )


def _least_squares(rows: Array, count: Array) -> Array:
    p = rows.shape[-1] - 1
    R = triangle(jnp.moveaxis(jnp.asarray(rows), -1, 0).reshape(p + 1, -1))
    theta = back_substitute(R[:p, :p], R[:p, p])
    left = (((rows[..., :p] * theta).sum(axis=-1) - rows[..., p]) ** 2).sum(axis=-1)
    return jnp.concatenate([theta, jnp.log(left / count) / 2])


def _solved(R: Array, right: Array) -> Array:
    """`x` with `R' R x = right`."""
    return back_substitute(R, back_substitute(R.T[::-1, ::-1], right[::-1])[::-1])


@jax.jit
def _element_columns(R: Array) -> Array:
    return element_columns(jnp.asarray(R), SEVEN)


def _prior_for(prior: Prior | None, names: tuple[str, ...]) -> Prior:
    prior = make_prior(names) if prior is None else prior
    if prior.names != names:
        raise ValueError(f"the prior is for {', '.join(prior.names)}: make it for {', '.join(names)}")
    return prior


def _inverse_root(covariance: Numbers, whose: str) -> Numbers:
    """Lower triangular root with root' root the inverse of a covariance."""
    size = np.sqrt(np.abs(np.diagonal(covariance)))  # numpy takes it for singular if units differ much
    try:
        if not (np.isfinite(covariance).all() and (size > 0).all()):
            raise np.linalg.LinAlgError
        factor = np.linalg.cholesky(covariance / np.outer(size, size))
    except np.linalg.LinAlgError:
        raise ValueError(f"the covariance of {whose} is not positive definite: standard errors must be known") from None
    return np.asarray(np.linalg.inv(factor) / size)


def _on_device(density: Density) -> Density:
    return jax.tree.map(jnp.asarray, density)
