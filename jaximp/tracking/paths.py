"""Parameters of a record as a path with a band: `track`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, Shaped
from numpy.typing import NDArray

from jaximp.least_squares.autoregression import Autoregression, whiten_rows
from jaximp.least_squares.noise import Noise, whiten
from jaximp.least_squares.sliding import in_samples
from jaximp.least_squares.window import check_finite
from jaximp.numerics.compilation import compiled, require_numbers
from jaximp.numerics.linear_algebra import root
from jaximp.numerics.precision import require_float64
from jaximp.tracking.blocks import Blocks, Scales, as_blocks, compress, scaled, scales, without_curves
from jaximp.tracking.curves import Curves, curves_of
from jaximp.tracking.drift import NONE
from jaximp.tracking.following import Found, Moments, Shapes, find, follow, mixed
from jaximp.tracking.results import Curve, Drift, Path, Track
from jaximp.tracking.state_space import Motion, forward, smoother
from jaximp.types import AnyArray, Numbers

ORDERS = (0, 1, 2)
"""How often a random walk may be integrated."""
FEW = 5
"""For more parameters than these, smooth motion is a random walk integrated once and not twice, which costs less."""
ROUNDS, SETTLED = 5, 1e-3
"""How often paths are followed where drift sizes are given, until the noise is as large as it was taken to be."""
TOGETHER = 128
"""Records that are followed side by side: for more the processor's nearest memory is too small."""
NEGLIGIBLE = 1e-3
"""A kind of motion that is less probable than this is not followed."""


def track(
    W: Num[AnyArray, "..."],
    y: Num[AnyArray, "..."],
    *,
    grid: float,
    sample_rate: float | None = None,
    valid: Shaped[AnyArray, "..."] | None = None,
    noise: Noise | Sequence[Autoregression] | None = None,
    drift: Num[AnyArray, " p"] | None = None,
    order: int | None = None,
    jumps: bool = True,
    varies_with: Mapping[str, AnyArray] | None = None,
    names: Sequence[str] = (),
    units: Sequence[str] = (),
    seed: int = 0,
) -> Track:
    """Follow parameters that move, from all rows of a record, without a window to choose.

    **Arguments:** `W` (N, p) or (N, n, p) and `y` (N,) or (N, n) [N m] rows at equal steps of time, for n outputs that
    share the parameters (each is weighed by its own noise); `grid` how far apart the points are at which parameters may
    move, in seconds where a `sample_rate` [Hz] is given, else in rows; `valid` False for rows that must not count.
    `noise` is what is known of the noise: a `Noise`, or an `Autoregression` for each output; without it the rows are
    taken as white.

    Drift sizes come from the likelihood, unless `drift` (p,) gives them, as in `Drift.size`: zero for a parameter that
    stays where it is, NaN for one to be estimated. Parameters do a random walk, or move smoothly, with slopes that die
    away, sooner or later: what the likelihood makes of it, unless `order` says how often a random walk is integrated
    (0, 1 or 2). With `jumps=False` no parameter
    jumps. `varies_with` gives, by the name of a parameter (`theta_0` and so on without `names`), what it depends on in
    each row (N,), such as a position: the parameter is then a smooth function of it, which may drift and jump besides.
    `seed` draws the models that are averaged, and the same seed the same ones.

    **Returns:** a `Track`. Its bands hold what is not known of drift sizes, of the kind of motion, and of times of
    jumps. Where nothing moves that would tell a parameter, they are wide: before all measurements a parameter is taken
    as zero within a hundred times the size that the record suggests.

    **Raises:** ValueError for shapes that do not match, numbers that are not finite, a grid that is none, and inside
    `jit`, `vmap` and `grad`, where `smoothed_path` serves.

    **Source:** Rauch, Tung and Striebel 1965; Durbin and Koopman, Time series analysis by state space methods, 2012;
    jumps: de Jong and Penzer 1998; see `tracking.drift` for the average over models.

    **Example:**

    ```pycon
    >>> t = np.arange(0, 10, 0.05)
    >>> W = np.column_stack([np.cos(9 * t), np.sin(5 * t)])
    >>> y = W[:, 0] + (20 + t) * W[:, 1] + 0.1 * np.random.default_rng(0).normal(size=len(t))
    >>> drift = np.array([0.0, 1.0])  # by default from the likelihood
    >>> found = jaximp.track(W, y, grid=0.2, sample_rate=20, drift=drift, jumps=False, names=("damping", "stiffness"))
    >>> print(found["stiffness"].value[[0, -1]].round(0))
    [20. 30.]

    ```
    """
    require_numbers("track", "give drift sizes to smoothed_path", W, y, valid, drift)
    require_float64(W, y)
    W, y, valid = _checked(W, y, valid, step := in_samples("grid", grid, sample_rate))
    samples, p = len(y), W.shape[-1]
    named, counts = _named(p, names, units), valid.any(axis=1)
    curves = curves_of(dict(varies_with or {}), named[0], counts)
    W, y, valid, every = _white(W if curves is None else curves.columns(W), y, valid, noise)
    step = max(1, step // every)
    blocks = _compress(*_weighed(W, y, valid, step), step)
    if not float(blocks.count) > p:
        raise ValueError(f"{int(blocks.count)} rows count, for {p} parameters: give more rows")
    rate = 1.0 if sample_rate is None else sample_rate
    sizes = np.full(p, np.nan) if drift is None else np.asarray(drift, float)
    if sizes.shape != (p,) or (sizes < 0).any():
        raise ValueError(f"drift has shape {sizes.shape}: give {p} numbers from zero up, NaN for what is to be found")
    if order not in (None, *ORDERS):
        raise ValueError(f"order is {order}: give 0, 1 or 2, how often a random walk is integrated, or None")
    kinds = kinds_of(p) if order is None else (order,)
    coefficients = () if curves is None else curves.coefficients
    look = partial(find, sizes=sizes, jumps=jumps, apart=step * every / rate, coefficients=coefficients, seed=seed)
    by, fine, found = found_in(
        blocks, sizes, () if curves is None else curves.owners, lambda *scaled: [look(*scaled, order=k) for k in kinds]
    )
    time = _middles(len(blocks.rows), step, every, samples) / rate
    return _averaged(fine, by, found, curves, step * every, time, named, sample_rate is not None, seed)


def kinds_of(p: int) -> tuple[int, ...]:
    """How often random walks are integrated that p parameters may do: the kinds of motion that are weighed."""
    return (0, 2) if p <= FEW else (0, 1)


def smoothed_path(
    W: Num[AnyArray, "N *n p"],
    y: Num[AnyArray, "N *n"],
    *,
    grid: int,
    drift: Num[AnyArray, " p"],
    noise: float | Num[AnyArray, ""],
    order: int = 0,
    valid: Shaped[AnyArray, "N *n"] | None = None,
) -> tuple[Path, Float[Array, ""]]:
    """The path for known drift sizes, and the logarithm of the likelihood: `jit`, `vmap` and `grad` go through.

    **Arguments:** white rows, as in `track`; `grid` in rows; `drift` (p,) standard deviation of a random step of each
    parameter from one point of the grid to the next, or (`order` 1) of its slope per point, or (2) of the slope's;
    `noise` standard deviation of a row [N m].

    **Returns:** the path with the covariance of its errors. Before all measurements parameters are zero within a
    hundred times of what would explain the whole torque, and slopes within what they become in the record.

    **Source:** Rauch, Tung and Striebel 1965, with square roots of information (`tracking.state_space`).
    """
    valid = jnp.ones(jnp.shape(y), bool) if valid is None else jnp.asarray(valid, bool)
    W, y, valid = (jnp.asarray(x)[None] for x in (W, y, valid))
    path, log_likelihood = smoothed_paths(W, y, grid=grid, drift=drift, noise=noise, order=order, valid=valid)
    return Path(path.theta[0], path.covariance[0]), log_likelihood[0]


def smoothed_paths(
    W: Num[AnyArray, "R N *n p"],
    y: Num[AnyArray, "R N *n"],
    *,
    grid: int,
    drift: Num[AnyArray, "*R p"],
    noise: float | Num[AnyArray, "*R"],
    order: int = 0,
    valid: Shaped[AnyArray, "R N *n"] | None = None,
) -> tuple[Path, Float[Array, " R"]]:
    """`smoothed_path` of R records of one length, side by side: much faster than one after the other, or by `vmap`."""
    records, p = W.shape[0], W.shape[-1]
    counts = jnp.ones(jnp.shape(y), bool) if valid is None else jnp.asarray(valid, bool)
    each = (
        W, y, counts, jnp.broadcast_to(jnp.asarray(drift, float), (records, p)),
        jnp.broadcast_to(jnp.asarray(noise, float), (records,)),
    )  # fmt: skip
    lanes = min(records, TOGETHER)
    whole = -(-records // lanes) * lanes  # the last one again, where some lanes would have none
    each = jax.tree.map(lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], whole - records, axis=0)]), each)
    each = jax.tree.map(lambda x: x.reshape(-1, lanes, *x.shape[1:]), each)
    found = jax.lax.map(lambda some: _side_by_side(*some, grid=grid, order=order), each)
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:records], found)


def _side_by_side(
    W: Array, y: Array, counts: Array, drift: Array, noise: Array, *, grid: int, order: int
) -> tuple[Path, Float[Array, " R"]]:
    """`smoothed_paths` of as many as the nearest memory of a processor can hold."""
    rows = jnp.moveaxis(jax.vmap(partial(as_blocks, grid=grid))(W, y, counts).rows, 0, -1)
    size = root((rows**2).sum(axis=(0, 1)))
    unit = jnp.where(size[:-1] > 0, size[-1] / jnp.where(size[:-1] > 0, size[:-1], 1), 1)
    rows = rows * (jnp.concatenate([unit, jnp.ones_like(unit[:1])]) / noise)

    step = drift.T / unit
    walk, slope = (step**2, 0 * step) if order == 0 else (0 * step, step)
    none = jnp.full((0, len(noise)), NONE)
    motion = Motion(walk, slope, jnp.full_like(step, len(rows)), none, none, order)
    found, before = forward(rows, motion)
    theta, covariance = smoother(rows, motion, before)
    theta, covariance = jnp.moveaxis(theta * unit, -1, 0), jnp.moveaxis(covariance * unit[:, None] * unit, -1, 0)
    log_noise = counts.reshape(len(counts), -1).sum(axis=1) * (jnp.log(noise) + 0.5 * math.log(2 * math.pi))
    return Path(theta, covariance), found.log_determinant - found.squares / 2 - log_noise


def found_in(
    blocks: Blocks, sizes: Numbers, owners: tuple[int, ...], look: Callable[[Blocks, Scales], list[Found]]
) -> tuple[Scales, Blocks, list[Found]]:
    """Models of all kinds, in scales of the record. Sizes that are given are no multiples of the noise: where there are
    any, this is repeated until the noise is as large as it was taken to be."""
    by: Scales = _scales(without_curves(blocks, len(sizes)))
    for _ in range(ROUNDS):
        fine = _scaled(blocks, by, owners)
        found = look(fine, by)
        noise = max((one.drawn for one in found), key=lambda drawn: drawn.log_evidence).noise
        if not (sizes > 0).any() or abs(noise - 1) < SETTLED:
            break
        by = eqx.tree_at(lambda x: x.noise, by, by.noise * noise)
    return by, fine, found


def _averaged(
    fine: Blocks, by: Scales, found: list[Found], curves: Curves | None, step: int, time: Numbers,
    named: tuple[tuple[str, ...], ...], seconds: bool, seed: int,
) -> Track:  # fmt: skip
    """The kinds of motion that are not out of the question, followed, and weighed by their evidence."""
    evidence = np.array([one.drawn.log_evidence for one in found])
    shares = np.exp(evidence - np.logaddexp.reduce(evidence))
    kept = np.flatnonzero(shares > NEGLIGIBLE)
    weight, unit, kinds = shares[kept] / shares[kept].sum(), np.asarray(by.theta), [found[k] for k in kept]
    p = len(unit)
    at, shown = (np.zeros((0, 0)), np.zeros((0, p))) if curves is None else curves.shown(p)
    points = None if curves is None else curves.at_points(step, len(time), p)
    several = [follow(fine, one, Shapes(points, shown), seed) for one in kinds]
    best, lanes = int(np.argmax(weight)), len(several[0].size)
    in_units = float(fine.freedom(p) * np.log(by.noise))

    def path(moments: list[Moments]) -> Path:
        theta = np.stack([one.theta for one in moments], axis=-1)
        known = mixed(theta, np.stack([one.covariance for one in moments], axis=-1), weight)
        return Path(known.theta * unit, known.covariance * np.outer(unit, unit))

    def shapes() -> list[Curve]:
        if curves is None:
            return []
        theta = np.stack([one.curves.theta for one in several], axis=-1)
        known = mixed(theta, np.stack([one.curves.covariance for one in several], axis=-1), weight)
        theta, stderr = (x.reshape(at.shape) for x in (known.theta, np.sqrt(known.covariance)))
        return [
            Curve(at[:, v], theta[:, v] * unit[i], stderr[:, v] * unit[i], named[0][i], named[1][i])
            for v, i in enumerate(curves.which)
        ]

    return Track(
        time=time,
        path=path([one.path for one in several]),
        filtered=path([one.filtered for one in several]),
        jumped=np.einsum("k,kgp->gp", weight, np.stack([one.jumped for one in several])),
        drift=Drift(
            np.concatenate([one.size for one in several]),
            np.repeat([one.search.order for one in kinds], lanes),
            np.repeat(weight / lanes, lanes),
        ),
        smooth=float(shares @ [one.search.order > 0 for one in found]),
        noise=float(by.noise) * kinds[best].drawn.noise,
        log_likelihood=float(np.logaddexp.reduce(evidence) - np.log(len(evidence)) - in_units),
        innovations=several[best].innovations,
        names=named[0],
        units=named[1],
        seconds=seconds,
        curves=tuple(shapes()),
    )


def _middles(points: int, step: int, every: int, samples: int) -> Numbers:
    """(G,) middle of the rows that belong to each point, as indices of the given ones; `every`-th of these was kept."""
    first = np.arange(points) * step
    last = np.minimum(first + step, -(-samples // every)) - 1
    return every * (first + last) / 2


_compress = compiled(compress, static_argnums=3)
_scales, _scaled = compiled(scales), compiled(scaled, static_argnums=2)


def _checked(W: AnyArray, y: AnyArray, valid: AnyArray | None, grid: int) -> tuple[Numbers, Numbers, NDArray[np.bool_]]:
    """Shapes and numbers, with an axis of outputs."""
    W, y = np.asarray(W, float), np.asarray(y, float)
    if W.ndim not in (2, 3) or y.shape != W.shape[:-1]:
        raise ValueError(f"W has shape {W.shape} and y {y.shape}: give (N, p) and (N,), or (N, n, p) and (N, n)")
    counts = np.ones(y.shape, bool) if valid is None else np.asarray(valid, bool)
    if counts.shape == y.shape[:1]:
        counts = np.broadcast_to(counts.reshape(-1, *(1,) * (y.ndim - 1)), y.shape)
    if counts.shape != y.shape:
        raise ValueError(f"valid has shape {counts.shape}: give that of y, {y.shape}")
    if not (isinstance(grid, int | np.integer) and 1 <= grid <= len(y)):
        raise ValueError(f"grid is {grid} rows of {len(y)}: give a whole number, or seconds and a sample_rate")
    check_finite(W, y, counts)
    if y.ndim == 1:
        W, y, counts = W[:, None], y[:, None], counts[:, None]
    return np.where(counts[..., None], W, 0), np.where(counts, y, 0), counts


def _white(
    W: Numbers, y: Numbers, valid: NDArray[np.bool_], noise: Noise | Sequence[Autoregression] | None
) -> tuple[Numbers, Numbers, NDArray[np.bool_], int]:
    """White rows, and how many of the given ones there were for each of them."""
    if noise is None:
        return W, y, valid, 1
    if isinstance(noise, Noise):
        white = whiten(W, y, noise, valid)
        return white.W, white.y, white.valid, noise.every
    several = [noise] if isinstance(noise, Autoregression) else list(noise)
    if len(several) != y.shape[1]:
        raise ValueError(f"noise has {len(several)} autoregressions for {y.shape[1]} outputs: give one for each")
    every = max(one.every for one in several)
    columns = np.concatenate([W, y[..., None]], axis=-1)
    rows = np.stack([whiten_rows(columns[:, j], valid[:, j], one) for j, one in enumerate(several)], axis=1)[::every]
    return rows[..., :-1], rows[..., -1], valid[::every], every


def _weighed(W: Numbers, y: Numbers, valid: NDArray[np.bool_], step: int) -> tuple[Numbers, Numbers, AnyArray]:
    """Rows in units of their output's own noise, where there are several outputs."""
    if y.shape[1] == 1:
        return W, y, valid
    size = np.array([float(_scales(_compress(W[:, j], y[:, j], valid[:, j], step)).noise) for j in range(y.shape[1])])
    return W / size[:, None], y / size, valid


def _named(p: int, names: Sequence[str], units: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    names = tuple(names) or tuple(f"theta_{k}" for k in range(p))
    units = tuple(units) or ("",) * p
    if len(names) != p or len(units) != p:
        raise ValueError(f"there are {len(names)} names and {len(units)} units for {p} parameters: give one for each")
    return names, units
