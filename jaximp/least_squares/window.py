"""Linear least squares of one window, with what is needed to judge it.

`W` holds one row per sample (or one block of n rows, for n outputs that share the parameters), `y` the torque. The
window is solved by a QR decomposition, so that its condition number enters once and not squared.
"""

from __future__ import annotations

from typing import Any, overload

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num, Shaped
from numpy.typing import NDArray

from jaximp.numerics.compilation import is_traced, require_numbers
from jaximp.numerics.linear_algebra import inverse_of_triangle, orthonormal, root, singular_values
from jaximp.types import AnyArray

DENSE_ROWS = 512
"""Up to so many rows the noise's covariance is multiplied as a matrix, beyond by fast Fourier transforms."""


class Fit(eqx.Module):
    """The estimate of one window, or of M. A window without a unique solution is NaN throughout, `samples` apart."""

    theta: Float[AnyArray, "*M p"]
    """Parameters, in the model's units."""
    stderr: Float[AnyArray, "*M p"]
    """Their standard errors."""
    dof: Float[AnyArray, "*M"]
    """Degrees of freedom of the variance estimate: a quantile of Student's t with so many makes the interval."""
    cond: Float[AnyArray, "*M"]
    """Condition number of W: largest over smallest singular value."""
    sigma_min: Float[AnyArray, "*M"]
    """Smallest singular value of W."""
    excitation: Float[AnyArray, "*M p"]
    """Norm of each column's part that the other columns cannot imitate."""
    residual_rms: Float[AnyArray, "*M"]
    """Root of the (weighted) mean squared residual [N m]."""
    vaf: Float[AnyArray, "*M"]
    """Variance accounted for, 1 - var(residual)/var(torque): a constant torque earns nothing."""
    samples: Int[AnyArray, "*M"]
    """How many torque samples counted."""


class WindowFit(Fit):
    """The estimate of one window, with what its parameters have in common."""

    covariance: Float[Array, "*M p p"]
    """Covariance of theta."""


class SlidingFit(Fit):
    """The estimates of M windows, with where each of them lies."""

    first: Int[AnyArray, "*M"]
    """Index of each window's first sample."""
    last: Int[AnyArray, "*M"]
    """Index of each window's last sample."""


def least_squares(
    W: Num[AnyArray, "S *n p"],
    y: Num[AnyArray, "S *n"],
    valid: Shaped[AnyArray, "S *n"] | None = None,
    noise: Num[AnyArray, " L"] | Num[AnyArray, "S S"] | None = None,
    *,
    weights: Num[AnyArray, "S *n"] | None = None,
) -> WindowFit:
    """Fit `y = W @ theta + noise` over the valid samples of one window.

    **Arguments:** `W` (S, p) or (S, n, p); `y` (S,) or (S, n) [N m]; `valid` False for samples that must not count;
    `weights` of the squared residuals. `noise` is what is known of the noise: its autocovariance by lag
    (`signals.autocovariance`), or the covariance matrix of the rows, up to a factor; without it the noise is taken as
    white, with weights of a variance in inverse proportion to them.

    **Returns:** a `WindowFit`. White noise gives the textbook standard errors, residual sum of squares over
    (samples - p). Known noise of covariance s^2 F F' gives `s^2 A F F' A'` with A the pseudo-inverse of W,
    `s^2 = |r|^2 / tr(G)` with G = M F F' M and M the residual projector, and Satterthwaite's degrees of freedom
    `tr(G)^2 / tr(G^2)`.

    **Source:** the estimator of Tout et al. 2023, III-B; Satterthwaite 1946 for the degrees of freedom.
    """
    scale = jnp.ones(y.shape, bool) if valid is None else jnp.asarray(valid, bool)
    return solve_window(W, y, scale if weights is None else root_of_weights(weights, scale), noise)


def root_of_weights(weights: AnyArray, valid: AnyArray) -> Array:
    """What each equation is multiplied by: zero where it does not count. (The root has no derivative there.)"""
    counts = valid & (weights > 0)
    return jnp.where(counts, jnp.sqrt(jnp.where(counts, weights, 1)), 0)


def solve_window(W: AnyArray, y: AnyArray, scale: AnyArray, noise: AnyArray | None) -> WindowFit:
    """As `least_squares`, with what each equation is multiplied by: False, True, or the root of its weight."""
    n_samples, p = W.shape[0], W.shape[-1]
    scale = jnp.asarray(scale, W.dtype)
    W, y = jnp.where(scale[..., None] > 0, W, 0), jnp.where(scale > 0, y, 0)  # whatever a masked sample holds
    rows, torque = (W * scale[..., None]).reshape(-1, p), (y * scale).reshape(-1)
    n, weight = (scale > 0).sum().astype(W.dtype), scale**2

    Q, R, independent = orthonormal(rows)
    solvable = (n >= p) & independent
    R = jnp.where(solvable, R, jnp.eye(p, dtype=R.dtype))  # what is not solvable must not make derivatives NaN
    singular, inverse = singular_values(R), inverse_of_triangle(R)
    theta = inverse @ (Q.T @ torque)
    residual = torque - rows @ theta
    rss = residual @ residual

    if noise is None:
        dof = n - p
        spread = jnp.eye(p, dtype=R.dtype) * rss / jnp.where(dof > 0, dof, 1)
    else:
        spread, dof = _coloured(Q, rss, scale.reshape(n_samples, -1), jnp.asarray(noise))

    def or_nan(value: Array, known: Array = solvable) -> Array:
        return jnp.where(known, value, jnp.nan)

    covariance, spread_known = inverse @ spread @ inverse.T, solvable & ((dof > 0) | (noise is not None))
    return WindowFit(
        theta=or_nan(theta),
        stderr=or_nan(root(jnp.diagonal(covariance)), spread_known),
        covariance=or_nan(covariance, spread_known),
        dof=or_nan(dof),
        cond=or_nan(singular[0] / singular[-1]),
        sigma_min=or_nan(singular[-1]),
        excitation=or_nan(1 / jnp.linalg.norm(inverse, axis=1)),
        residual_rms=or_nan(root(rss / jnp.where(n > 0, weight.sum(), 1))),
        vaf=or_nan(variance_accounted_for(y, y - W @ theta, weight)),
        samples=n.astype(int),
    )


def squares_left(W: AnyArray, y: AnyArray, scale: AnyArray, noise: AnyArray | None) -> tuple[Array, Array]:
    """Sum of squares of a window's residuals, and what it would be for noise of just this autocovariance (without one,
    white and of variance one); arguments as in `solve_window`. Columns may depend on each other."""
    scale = jnp.asarray(scale, W.dtype)
    rows = jnp.where(scale[..., None] > 0, W * scale[..., None], 0).reshape(-1, W.shape[-1])
    torque = jnp.where(scale > 0, y * scale, 0).ravel()
    Q = orthonormal(rows)[0]
    residual = torque - Q @ (Q.T @ torque)
    if noise is None:
        expected = (scale > 0).sum() - (Q**2).sum()
    else:
        inner, weighted = _shaped(Q, scale.reshape(len(W), -1), noise)[1:]
        expected = weighted - jnp.trace(inner)
    return residual @ residual, expected


def variance_accounted_for(
    torque: Num[AnyArray, "S *n"], residual: Num[AnyArray, "S *n"], weight: Num[AnyArray, "S *n"]
) -> Float[Array, ""]:
    """1 - var(residual)/var(torque) over the samples that count, means taken output by output; NaN without variance."""
    total = scatter(torque, weight)
    return jnp.where(total > 0, 1 - scatter(residual, weight) / jnp.where(total > 0, total, 1), jnp.nan)


def scatter(x: Num[AnyArray, "S *n"], weight: Num[AnyArray, "S *n"]) -> Float[Array, ""]:
    """Weighted sum of squares about the mean, which is taken output by output."""
    x, whole = jnp.where(weight > 0, x, 0), weight.sum(axis=0)
    mean = (weight * x).sum(axis=0) / jnp.where(whole > 0, whole, 1)
    return (weight * (x - mean) ** 2).sum()


def check_finite(W: AnyArray, y: AnyArray, valid: AnyArray) -> None:
    """Refuse numbers that are not finite where `valid` does not exclude them; while tracing nothing is known yet."""
    if is_traced(W, y, valid):
        return
    W, y = np.asarray(W), np.asarray(y)
    if np.isfinite(W).all() and np.isfinite(y).all():
        return
    finite = np.isfinite(W).all(axis=-1) & np.isfinite(y)
    bad = int((~finite & np.asarray(valid)).sum())
    if bad:
        raise ValueError(f"{bad} samples of W or y are not finite: mark them with valid=False, or mend them")


@overload
def confidence_interval(fit: Any, level: float = 0.95, /) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...


@overload
def confidence_interval(
    theta: Num[AnyArray, "*M p"], stderr: Num[AnyArray, "*M p"], dof: Num[AnyArray, "*M"], level: float = 0.95
) -> tuple[NDArray[np.float64], NDArray[np.float64]]: ...


def confidence_interval(
    theta: Any, stderr: Any = None, dof: Any = None, level: float = 0.95
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Lower and upper end of the interval that holds the truth with probability `level`, from Student's t.

    Of a fit, `confidence_interval(fit, level)`, or of numbers, `confidence_interval(theta, stderr, dof, level)`.

    **Arguments:** `fit` anything with `theta`, `stderr` and `dof`; or these: (..., p), (..., p) and (...).

    **Raises:** `ValueError` for a level that is no probability, and inside `jit`, `vmap` and `grad`: Student's quantile
    is scipy's.

    **Example:**

    ```pycon
    >>> t = np.arange(0, 4, 0.01)
    >>> W = np.column_stack([np.cos(9 * t), np.sin(5 * t)])
    >>> noise = 0.1 * np.random.default_rng(0).normal(size=len(t))
    >>> fit = jaximp.sliding_least_squares(W, W @ [1, 20] + noise, window=400)
    >>> low, high = jaximp.confidence_interval(fit)
    >>> print(low[0, 1] < 20 < high[0, 1])
    True

    ```
    """
    if hasattr(theta, "stderr"):
        level = level if stderr is None else stderr
        theta, stderr, dof = theta.theta, theta.stderr, theta.dof
    require_numbers("confidence_interval", "call it on the results", theta, stderr, dof, level)
    from scipy.stats import t

    if stderr is None or dof is None:
        raise ValueError("confidence_interval needs a fit, or theta with its stderr and dof")
    if not 0 < level < 1:
        raise ValueError(f"the level is {level}: it must be a probability between 0 and 1, such as 0.95")
    half = t.ppf(0.5 + level / 2, np.asarray(dof))[..., None] * np.asarray(stderr)
    return np.asarray(theta) - half, np.asarray(theta) + half


def _coloured(Q: Array, rss: Array, scale: Array, noise: Array) -> tuple[Array, Array]:
    """Covariance of `Q' y` and degrees of freedom, for noise of known covariance up to its scale.

    The equations were multiplied by `scale`, and so is the noise in them.
    """
    shaped, inner, weighted = _shaped(Q, scale, noise)
    trace, weight = weighted - jnp.trace(inner), scale**2
    squared = (weight * _covariance_times(noise**2, weight)).sum()
    trace_of_square = squared - 2 * (shaped * shaped).sum() + (inner * inner).sum()
    return inner * rss / trace, trace**2 / trace_of_square


def _shaped(Q: Array, scale: Array, noise: Array) -> tuple[Array, Array, Array]:
    """The noise's covariance times Q, the same along Q, and its trace; in the equations as they were multiplied."""
    n_samples, n_outputs = scale.shape
    p = Q.shape[1]
    blocks = (Q.reshape(n_samples, n_outputs, p) * scale[..., None]).reshape(n_samples, n_outputs * p)
    shaped = (_covariance_times(noise, blocks).reshape(n_samples, n_outputs, p) * scale[..., None]).reshape(-1, p)
    level = noise[0] if noise.ndim == 1 else jnp.diagonal(noise)[:, None]
    return shaped, Q.T @ shaped, (scale**2 * level).sum()


def _covariance_times(noise: Array, x: Float[Array, "S k"]) -> Float[Array, "S k"]:
    """Multiply by the noise's covariance: a matrix, or the Toeplitz matrix of an autocovariance by lag."""
    if noise.ndim == 2:
        return noise @ x
    n_samples = x.shape[0]
    lags = jnp.pad(noise[:n_samples].astype(x.dtype), (0, max(0, n_samples - len(noise))))
    if n_samples <= DENSE_ROWS:
        return jax.scipy.linalg.toeplitz(lags) @ x
    circle = jnp.concatenate([lags, jnp.zeros(1, x.dtype), lags[:0:-1]])
    spectrum = jnp.fft.rfft(circle)[:, None] * jnp.fft.rfft(x, n=2 * n_samples, axis=0)
    return jnp.fft.irfft(spectrum, n=2 * n_samples, axis=0)[:n_samples]
