"""The motion that a vector of numbers stands for, within all limits; what it is worth; and the descent to a better one.

**Every motion on the way is feasible.** The optimiser's numbers are a direction: the motion starts from rest at its
offset and goes as far that way as the limits allow. For all limits but the torque's that is a division; the torque's is
a root, which is found and then differentiated as an implicit function. Nothing is penalised, no weight is chosen.

**Objectives** see the Gram matrix `W'W` alone, p by p, of the period or of every window (`objectives.py`).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaximp.design.clearance import Clearance
from jaximp.design.objectives import log_condition, log_sigma_min, log_stderr, log_volume
from jaximp.models.base import Model
from jaximp.motion.trajectories import FourierSeries, at_rest, jerk
from jaximp.numerics.cores import cores
from jaximp.numerics.optimise import minimise, onto_polytope
from jaximp.signals.derivatives import central_differences
from jaximp.signals.filters import butterworth
from jaximp.types import AnyArray, Numbers, Progress

PER_CYCLE = 24
"""How many instants of a period of the highest harmonic a motion is judged at, while it is designed."""
FINER = 10
"""The result must keep its limits on a grid that is so many times finer."""
STAGES = ((0.1, 20.0), (0.01, 200.0))
"""While a motion is designed, dry friction changes its sign within such a share of the largest velocity, and the worst
window is a smooth maximum of such sharpness."""
TOUCHING = 1e-12
"""A torque this far below its limit, as a share of it, has reached it."""
MOST_STEPS = 60
ROUNDING = 1e-12
DESCENDING = 16
"""While a motion is designed, a new window starts so many times in the length of one; the result is judged by all
windows."""
BATCH = 8
"""How many starts are minimised together; each core has one batch at a time."""
INFEASIBLE = 50.0
"""The objective where not even rest is allowed: it is above the logarithm of any condition number."""


@dataclass(frozen=True)
class Encoder:
    """How the motion will be measured, if its quantisation is to be in the loop (Tout et al. 2023, V-A)."""

    step: float
    """Quantisation step [rad or m]."""
    sample_rate: float
    """[Hz]."""
    cutoff: float
    """Low-pass of the position before it is differentiated [Hz]."""
    order: int = 8


class Problem(eqx.Module):
    """The design problem, as arrays and static settings."""

    model: Model
    moved: Model
    period: float = eqx.field(static=True)
    harmonics: int = eqx.field(static=True)
    rest: bool = eqx.field(static=True)
    low: Array
    """(n,) position limits."""
    high: Array
    most: Array
    """(4, n) limits of velocity, acceleration, jerk and torque."""
    parameters: Array | None
    scale: Array
    """(p,) factors by which the columns are multiplied."""
    mean: Array | None
    """(n,) mean position, where it is given."""
    objective: str = eqx.field(static=True)
    parameter: int = eqx.field(static=True)
    window: float | None = eqx.field(static=True)
    """Length of the window as a share of the period."""
    encoder: Encoder | None = eqx.field(static=True)
    samples: float = eqx.field(static=True)
    """How many measurements one period has."""
    unit: bool = eqx.field(static=True, default=False)
    """Columns are compared at unit norm."""
    whole: bool = eqx.field(static=True, default=True)
    """What is moved is what is identified, and nothing else."""
    clearance: Clearance | None = None

    @property
    def n(self) -> int:
        return self.model.n_joints

    def instants(self, finer: int = 1) -> Array:
        """Times of one period, evenly spread."""
        count = finer * max(200, PER_CYCLE * self.harmonics)
        return jnp.arange(count) * (self.period / count)


def direction_of(problem: Problem, x: Array) -> FourierSeries:
    """Move the offsets inside their limits; leave the coefficients as they are."""
    n, h = problem.n, problem.harmonics
    offset = problem.mean
    if offset is None:
        middle, half = (problem.high + problem.low) / 2, (problem.high - problem.low) / 2
        limited = jnp.isfinite(half)
        inside = jnp.where(limited, middle, 0) + jnp.where(limited, half, 1) * jnp.tanh(x[:n])
        offset = jnp.where(limited, inside, x[:n])
    sine, cosine = x[n:].reshape(2, n, h)
    series = FourierSeries(sine, cosine, offset, problem.period)
    return at_rest(series) if problem.rest else series


def times(series: FourierSeries, factor: Array | float) -> FourierSeries:
    return FourierSeries(series.sine * factor, series.cosine * factor, series.offset, series.period)


def feasible_motion(problem: Problem, x: Array, t: Array, smooth: Array | None) -> tuple[FourierSeries, Array]:
    """As far from rest as the limits allow, and how much rest itself exceeds the limit of the torque."""
    series = direction_of(problem, x)
    series = times(series, 1 / jnp.maximum(shares_reached(problem, series, t).max(), 1.0))
    if problem.parameters is None:
        return series, jnp.zeros(())
    return _within_torque(problem, series, t, smooth)


def shares_reached(problem: Problem, series: FourierSeries, t: Array) -> Array:
    """(5, n) how far the motion goes, as a share of each limit: up, down, and of velocity, acceleration and jerk."""
    q, dq, ddq = series(t)
    swing = q - series.offset
    up = swing.max(axis=0) / jnp.where(jnp.isfinite(problem.high), problem.high - series.offset, jnp.inf)
    down = -swing.min(axis=0) / jnp.where(jnp.isfinite(problem.low), series.offset - problem.low, jnp.inf)
    others = [jnp.abs(x).max(axis=0) / most for x, most in zip((dq, ddq, jerk(series, t)), problem.most, strict=False)]
    return jnp.stack([up, down, *others])


def _within_torque(
    problem: Problem, series: FourierSeries, t: Array, smooth: Array | None
) -> tuple[FourierSeries, Array]:
    """The largest part of a motion whose torque keeps its limit: a root, differentiated as an implicit function."""

    def excess(factor: Array, series: FourierSeries) -> Array:
        return torque_share(problem, times(series, factor), t, smooth).max() - 1

    fixed = jax.lax.stop_gradient(series)
    at_rest = torque_share(problem, times(series, 0.0), t[:1], smooth).max() - 1
    at_most = excess(jnp.ones(()), fixed)
    root = _root(lambda factor: excess(factor, fixed), jax.lax.stop_gradient(at_rest), at_most)
    slope = jax.lax.stop_gradient(jax.jvp(lambda factor: excess(factor, fixed), (root,), (jnp.ones(()),))[1])
    step = excess(root, series) / jnp.where(slope == 0, 1, slope)
    factor = jnp.where(at_most <= 0, 1.0, root - (step - jax.lax.stop_gradient(step)))
    return times(series, factor), jnp.maximum(at_rest, 0)


def _root(excess: Callable[[Array], Array], at_zero: Array, at_one: Array) -> Array:
    """Where a function of a number between 0 and 1 rises above zero, or just below; regula falsi, after Illinois.

    Nothing is done where it stays below: most motions keep the limit of the torque.
    """

    def go_on(state: tuple[Array, Array, Array, Array, Array, Array]) -> Array:
        *_, done, count = state
        return (at_zero < 0) & (at_one > 0) & ~done & (count < MOST_STEPS)

    def step(
        state: tuple[Array, Array, Array, Array, Array, Array],
    ) -> tuple[Array, Array, Array, Array, Array, Array]:
        low, at_low, high, at_high, _, count = state
        middle = (low * at_high - high * at_low) / (at_high - at_low)
        value = excess(middle)
        below = value <= 0
        # The end that stays counts half the next time, so that both ends close in.
        return (
            jnp.where(below, middle, low),
            jnp.where(below, value, at_low / 2),
            jnp.where(below, high, middle),
            jnp.where(below, at_high / 2, value),
            below & (value > -TOUCHING),
            count + 1,
        )

    start = (jnp.zeros(()), at_zero, jnp.ones(()), at_one, jnp.array(False), jnp.zeros((), int))
    return jax.lax.while_loop(go_on, step, start)[0]


def torque_share(problem: Problem, series: FourierSeries, t: Array, smooth: Array | None) -> Array:
    """(n,) largest torque as a share of its limit."""
    assert problem.parameters is not None
    torque = regressor_rows(problem.moved, series(t), smooth, problem.period) @ problem.parameters
    return jnp.abs(torque).max(axis=0) / problem.most[-1]


def regressor_rows(model: Model, motion: tuple[Array, ...], smooth: Array | None, period: float) -> Array:
    """(N, n, p) regressor; dry friction changes sign within a share `smooth` of the largest velocity."""
    (q, dq, ddq), rate = motion, len(motion[0]) / period
    model = _smoothed(model, dq, smooth)
    if model.n_joints == 1:
        return model.over_period(q[:, 0], dq[:, 0], ddq[:, 0], rate)[:, None]
    return model.over_period(q, dq, ddq, rate)


def torque_of(problem: Problem, motion: tuple[Array, ...], smooth: Array | None) -> Array:
    """(N, n) torque of everything that is moved."""
    assert problem.parameters is not None
    if problem.moved.memory or problem.n == 1:
        return regressor_rows(problem.moved, motion, smooth, problem.period) @ problem.parameters
    return _smoothed(problem.moved, motion[1], smooth).torque(problem.parameters, *motion)


def _smoothed(model: Model, dq: Array, smooth: Array | None) -> Model:
    if smooth is None:
        return model
    width = jnp.maximum(smooth * jnp.abs(dq).max(axis=0), jnp.finfo(dq.dtype).eps)  # at rest it would vanish
    return model.smoothed(width[0] if model.n_joints == 1 else width)


def measured_motion(encoder: Encoder, series: FourierSeries, t: Array) -> tuple[Array, ...]:
    """The motion as it will be estimated from the encoder; its derivatives are those of the motion itself."""
    from scipy.signal import freqz_sos

    motion = series(t)
    q = jax.lax.stop_gradient(motion[0])
    counts = jnp.round(q / encoder.step) * encoder.step
    sos = butterworth(encoder.order, encoder.cutoff, encoder.sample_rate)
    gain = np.abs(freqz_sos(sos, np.fft.rfftfreq(len(t)) * 2 * np.pi)[1]) ** 2
    smooth = jnp.fft.irfft(jnp.fft.rfft(counts, axis=0) * gain[:, None], len(t), axis=0)
    around = jnp.concatenate([smooth[-1:], smooth, smooth[:1]])  # the motion is periodic
    dq, ddq = (x[1:-1] for x in central_differences(around, encoder.sample_rate))
    return tuple(jax.lax.stop_gradient(seen - x) + x for seen, x in zip((smooth, dq, ddq), motion, strict=True))


def _grams(
    problem: Problem, series: FourierSeries, t: Array, smooth: Array | None, whole: bool = False, every: int = 1
) -> Array:
    """(M, p, p) sums over the period, or over sliding windows, as many as measurements in the same time make.

    `every` is the number of windows in the length of one: 1 stands for all that there are.
    """
    motion: tuple[Array, ...] = series(t)
    if problem.encoder is not None:
        t = jnp.arange(round(problem.samples)) / problem.encoder.sample_rate
        motion = measured_motion(problem.encoder, series, t)
    return grams_of(problem, regressor_rows(problem.model, motion, smooth, problem.period), whole, every)


def grams_of(problem: Problem, rows: Array, whole: bool = False, every: int = 1) -> Array:
    """The same from the regressor (N, n, p) of evenly spread instants."""
    rows, count = rows * problem.scale, len(rows)
    share = problem.samples / count
    if problem.window is None or whole:
        rows = rows.reshape(-1, rows.shape[-1])
        grams = (share * (rows.T @ rows))[None]
    else:
        products = share * jnp.einsum("tni,tnj->tij", rows, rows)
        length = max(1, round(problem.window * count))
        grams = sliding_sums(products, length)[:: max(1, length // every) if every > 1 else 1]
    return of_unit_columns(grams) if problem.unit else grams


def of_unit_columns(grams: Array) -> Array:
    """Gram matrices (M, p, p) of the same columns at unit norm."""
    size = jnp.sqrt(jnp.diagonal(grams, axis1=-2, axis2=-1))
    size = jnp.where(size > 0, size, 1.0)
    return grams / (size[:, :, None] * size[:, None, :])


def sliding_sums(products: AnyArray, length: int) -> Array:
    """Sums over the windows of `length` instants that begin at each instant; they wrap around, as the motion does."""
    products = jnp.asarray(products)
    sums = jnp.cumsum(jnp.concatenate([jnp.zeros_like(products[:1]), products, products[:length]]), axis=0)
    return sums[length : length + len(products)] - sums[: len(products)]


def worth_of(problem: Problem, series: FourierSeries, t: Array, smooth: Array | None, sharpness: Array | None) -> Array:
    """Logarithm of the objective, the smaller the better; of the worst window a smooth maximum."""
    every = 1 if sharpness is None else DESCENDING
    return worth_of_grams(problem, _grams(problem, series, t, smooth, every=every), sharpness)


def worth_of_grams(problem: Problem, grams: Array, sharpness: Array | None) -> Array:
    """The same from the Gram matrices of all windows."""
    objectives: dict[str, Callable[[Array], Array]] = {
        "condition": log_condition,
        "determinant": log_volume,
        "sigma_min": log_sigma_min,
        "stderr": partial(log_stderr, parameter=problem.parameter),
    }
    values = objectives[problem.objective](grams)
    return values.max() if sharpness is None else jax.nn.logsumexp(sharpness * values) / sharpness


def random_starts(problem: Problem, count: int, seed: int) -> Array:
    """Motions of all shapes, near their limits; where the torque is limited, from rests that keep it."""
    random, (n, h) = np.random.default_rng(seed), (problem.n, problem.harmonics)
    if count < 1:
        raise ValueError(f"starts is {count}: give at least one")
    spectrum = np.arange(1, h + 1) ** random.uniform(-1, 1, (count, 1, n, 1))
    coefficients = random.normal(size=(count, 2, n, h)) * spectrum
    x = np.concatenate([_rests(problem, count, random), coefficients.reshape(count, -1)], axis=1)
    reached = np.asarray(_farthest(problem, jnp.asarray(x)))
    wanted = np.where(reached > 0, random.uniform(0.5, 1.5, count) / np.where(reached > 0, reached, 1), 1.0)
    x[:, n:] *= wanted[:, None]
    return jnp.asarray(x)


def _rests(problem: Problem, count: int, random: np.random.Generator) -> Numbers:
    x = random.normal(size=(max(count, 4000), problem.n))
    if problem.parameters is None or not np.isfinite(problem.most[-1]).any():
        return 0.5 * x[:count]
    still = np.zeros((len(x), 2 * problem.n * problem.harmonics))
    shares = np.asarray(_shares_at_rest(problem, jnp.asarray(np.concatenate([x, still], axis=1))))
    fits = (shares < 1).all(axis=1)
    if not fits.any():
        joint = int(shares.min(axis=0).argmax())
        raise ValueError(
            f"limits.torque: even at rest joint {joint + 1} needs {shares[:, joint].min():.3g} times the torque that "
            "is allowed, in every position: raise the limit of the torque, or move those of the position"
        )
    return np.resize(x[fits], (count, problem.n))


@eqx.filter_jit
def _farthest(problem: Problem, x: Array) -> Array:
    """How far each motion goes, as a share of the limit that it comes closest to."""
    t = problem.instants()
    return jax.vmap(lambda x: shares_reached(problem, direction_of(problem, x), t).max())(x)


@eqx.filter_jit
def _shares_at_rest(problem: Problem, x: Array) -> Array:
    return jax.vmap(lambda x: torque_share(problem, direction_of(problem, x), jnp.zeros(1), None))(x)


def descend(problem: Problem, x: Array, method: str, progress: Progress) -> Array:
    """All starts, in batches of one size, on as many cores as there are."""
    polytope = _linear_limits(problem) if method == "projected_gradient" else None
    size = min(BATCH, -(-len(x) // cores()))
    batches = [jnp.resize(x[k : k + size], (size, x.shape[1])) for k in range(0, len(x), size)]
    done = 0

    def descend(batch: Array) -> Array:
        nonlocal done
        for smooth, sharpness in STAGES:
            batch = _stage(problem, batch, jnp.asarray(smooth), jnp.asarray(sharpness), method, polytope)
            done += 1
            progress(done / (len(STAGES) * len(batches)))
        return jax.block_until_ready(batch)

    with ThreadPoolExecutor(cores()) as pool:
        return jnp.concatenate(list(pool.map(descend, batches)))[: len(x)]


@eqx.filter_jit
def _stage(
    problem: Problem,
    x: Array,
    smooth: Array,
    sharpness: Array,
    method: str,
    polytope: tuple[Array, Array] | None,
) -> Array:
    t = problem.instants()

    def objective(x: Array) -> Array:
        series, excess = feasible_motion(problem, x, t, smooth)
        value = worth_of(problem, series, t, smooth, sharpness)
        return jnp.where(excess > 0, INFEASIBLE * (1 + excess), jnp.nan_to_num(value, nan=INFEASIBLE))

    return minimise(objective, x, method, project=None if polytope is None else onto_polytope(*polytope)).x


def _linear_limits(problem: Problem) -> tuple[Array, Array]:
    """`A x <= b`: the limits that are linear in the coefficients, with the offset in the middle."""
    t, size = problem.instants(), problem.n * (2 * problem.harmonics + 1)

    def reached(x: Array) -> Array:
        series = direction_of(problem, x)
        q, dq, ddq = series(t)
        return jnp.stack([q - series.offset, dq, ddq, jerk(series, t)])

    A = jax.jacobian(reached)(jnp.zeros(size)).reshape(-1, size)
    half = jnp.stack([(problem.high - problem.low) / 2, *problem.most[:3]])
    b = jnp.broadcast_to(half[:, None], (4, len(t), problem.n)).ravel()
    kept = np.isfinite(b)
    if not kept.any():
        raise ValueError("projected_gradient needs limits to project onto: give some, or use bfgs")
    return jnp.concatenate([A[kept], -A[kept]]), jnp.concatenate([b[kept], b[kept]])


class Motion(NamedTuple):
    """A finished motion, and what it is worth."""

    series: FourierSeries
    value: float
    """Logarithm of the objective, infinite where a limit is not kept."""
    condition: float
    """Condition number over the period."""
    worst: float
    """Condition number in the worst window."""
    unit: float | None = None
    """Condition number over the period of columns of unit norm."""


def judged(problem: Problem, x: Array) -> Motion:
    """The motion on the fine grid."""
    series, *numbers = _judge(problem, x)
    return Motion(as_given(problem, series), *(float(number) for number in numbers))


def as_given(problem: Problem, series: FourierSeries) -> FourierSeries:
    """In numpy, and without an axis of joints where there is only one."""
    sine, cosine, offset = (np.asarray(x) for x in (series.sine, series.cosine, series.offset))
    if problem.n == 1:
        sine, cosine, offset = sine[0], cosine[0], offset[0]
    return FourierSeries(sine, cosine, offset, problem.period)


@eqx.filter_jit
def _judge(problem: Problem, x: Array) -> tuple[FourierSeries, Array, Array, Array]:
    t = problem.instants(FINER)
    series, _ = feasible_motion(problem, x, problem.instants(), None)
    series = times(series, 1 / jnp.maximum(shares_reached(problem, series, t).max() * (1 + ROUNDING), 1.0))
    excess = jnp.zeros(())
    if problem.parameters is not None:
        series, excess = _within_torque(problem, series, t, None)
    value = jnp.where(excess > 0, jnp.inf, worth_of(problem, series, t, None, None))
    plain = in_si(problem)
    windows = log_condition(_grams(plain, series, t, None))
    return series, value, jnp.exp(log_condition(_grams(plain, series, t, None, whole=True)))[0], jnp.exp(windows.max())


def in_si(problem: Problem) -> Problem:
    """The same with columns as they are."""
    return replace(problem, scale=jnp.ones_like(problem.scale), unit=False)
