"""Exciting trajectories by gradient: what a motion is worth to an estimate, within the limits of joint and robot.

Tout et al. 2023, III-A, after Swevers et al. 1997: the coefficients of a finite Fourier series that make the regressor
of one period, or of its worst window, as well conditioned as can be. The regressor is differentiable, so the gradient
is exact, and all starts descend at once.

**Every motion on the way is feasible.** The optimiser's numbers are a direction: the motion starts from rest at its
offset and goes as far that way as the limits allow. For all limits but the torque's that is a division; the torque's is
a root, which is found and then differentiated as an implicit function. Nothing is penalised, no weight is chosen.

**Objectives** see the Gram matrix `W'W` alone, p by p, of the period or of every window (`objectives.py`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaximp.design.bounds import condition_bound
from jaximp.design.objectives import log_condition, log_sigma_min, log_stderr, log_volume
from jaximp.models.base import Model
from jaximp.motion.trajectories import FourierSeries, at_rest, jerk
from jaximp.numerics.cores import cores
from jaximp.numerics.optimise import METHODS, minimise, onto_polytope
from jaximp.numerics.precision import require_float64
from jaximp.signals.derivatives import central_differences
from jaximp.signals.filters import butterworth
from jaximp.types import AnyArray, Numbers, Progress, nearest

OBJECTIVES = {
    "condition": "condition number of the regressor",
    "determinant": "volume of the confidence ellipsoid",
    "sigma_min": "smallest singular value of the regressor",
    "stderr": "standard error of one parameter",
}
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
ACTIVE = 0.999
"""A limit is active where the motion reaches such a share of it."""
COLLINEAR = 1e6
"""From this condition number on, parameters cannot be told apart."""
INFEASIBLE = 50.0
"""The objective where not even rest is allowed: it is above the logarithm of any condition number."""


@dataclass(frozen=True)
class Limits:
    """What the motion must keep at every instant: one number for all joints, or one for each."""

    position: tuple[Any, Any] = (-math.inf, math.inf)
    """Lowest and highest position [rad or m]; both finite, or neither."""
    velocity: Any = math.inf
    """Largest speed [rad/s]."""
    acceleration: Any = math.inf
    """Largest acceleration [rad/s^2]."""
    jerk: Any = math.inf
    """Largest jerk [rad/s^3]."""
    torque: Any = math.inf
    """Largest torque of the model [N m]; needs the parameters of the model."""


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


@dataclass(frozen=True)
class Design:
    """A motion that excites a model, and how good it is."""

    trajectory: FourierSeries
    model: Model
    """The model that is to be identified."""
    condition: float
    """Condition number of the regressor over one period."""
    worst_condition: float
    """Condition number of the worst sliding window if windows were designed for, otherwise that of the period."""
    lower_bound: float
    """No motion has a smaller condition number over a period; NaN where no bound is known."""
    bound_source: str
    """Where the lower bound comes from, or why none is known."""
    period: float
    """[s]."""
    objective: str
    value: float
    """The objective: a condition number, a singular value, a standard error in units of the torque's noise at
    `sample_rate` samples per second, or the determinant of the Gram matrix to the power -1/(2p)."""
    limits: Limits
    active: tuple[str, ...]
    """The limits that the motion reaches, in words."""
    conditions: Numbers
    """Condition number, over the period or of the worst window, that every start has reached; best first."""
    parameters: Numbers | None = None
    """Parameters of the model of everything that is moved, where they were given."""
    window: float | None = None
    """Length of the windows that were designed for [s]."""
    moved: Model | None = None
    """The model of everything that is moved, where that is more than what is identified."""
    parameter: str | None = None
    """The parameter whose standard error was made small."""

    def in_words(self) -> list[str]:
        """The result in words, one line for each fact."""
        lines = [f"condition number over a period of {self.period:g} s: {self.condition:.4g}"]
        if self.objective != "condition":
            lines.insert(0, self._objective_in_words())
        if math.isnan(self.lower_bound):
            lines.append(f"how far above the least possible: not known ({self.bound_source})")
        else:
            source = f"{self.bound_source}; it knows no limits"
            lines.append(
                f"{_above(self.condition, self.lower_bound)} the lower bound {self.lower_bound:.4g} ({source})"
            )
        if self.window is not None:
            lines.append(f"condition number in the worst window of {self.window:.4g} s: {self.worst_condition:.4g}")
        if not self.worst_condition < COLLINEAR:
            lines.append("not all parameters can be told apart: use another objective, or a smaller model")
        lines.append("limits reached: " + (", ".join(self.active) or "none"))
        if self.objective == "condition" and not self.active and self.limits != Limits():
            lines.append(
                "a larger motion would keep the limits: the condition number does not ask for size, stderr does"
            )
        return lines

    def _objective_in_words(self) -> str:
        where = f"over a period of {self.period:g} s" if self.window is None else f"in windows of {self.window:.4g} s"
        if self.objective != "stderr":
            return f"{OBJECTIVES[self.objective]} {where}: {self.value:.4g}"
        unit = self.model.units[self.model.names.index(self.parameter or "")]
        noise = "white torque noise of 1 N m in every sample"
        return f"standard error of {self.parameter} {where}, for {noise}: {self.value:.4g} {unit}"

    def sliding_condition(self, length: float) -> tuple[Numbers, Numbers]:
        """Condition number of the regressor in every window of `length` seconds.

        **Returns:** the end of each window (M,) [s], evenly spread over one period, and its condition number (M,),
        infinite where the window does not determine the parameters. Windows that reach back beyond the beginning of
        the period see the end of the one before.
        """
        count = FINER * max(200, PER_CYCLE * np.shape(self.trajectory.sine)[-1])
        motion = self.sampled(count / self.period)
        q, dq, ddq = (motion[name] for name in ("position", "velocity", "acceleration"))
        rows = self.model.over_period(q, dq, ddq, count / self.period)
        products = np.einsum("tni,tnj->tij", *[np.asarray(rows).reshape(count, self.model.n_joints, -1)] * 2)
        n = min(count, max(1, round(length / self.period * count)))
        values = np.linalg.eigvalsh(_sliding_sums(products, n))
        low, high = np.maximum(values[:, 0], 0), values[:, -1]
        known = low > np.finfo(float).eps * high
        cond = np.sqrt(np.divide(high, low, out=np.full(count, np.inf), where=known))
        return motion["time"], np.roll(cond, n - 1)

    def sampled(self, sample_rate: float) -> dict[str, Numbers]:
        """One period at a controller's sample rate [Hz]: `time`, `position`, `velocity`, `acceleration` (N, n), and
        `torque` of everything that is moved, where its parameters are known."""
        time = np.arange(round(self.period * sample_rate)) / sample_rate
        q, dq, ddq = (np.asarray(x) for x in self.trajectory(time))
        found = {"time": time, "position": q, "velocity": dq, "acceleration": ddq}
        if self.parameters is not None:
            rows = np.asarray((self.moved or self.model).over_period(q, dq, ddq, sample_rate))
            found["torque"] = rows @ np.asarray(self.parameters)
        return found


def _above(condition: float, bound: float) -> str:
    """Say in words how far a condition number is above its bound."""
    share = condition / bound - 1
    if share < 1e-4:
        return "at"
    return f"{100 * share:.2g} % above" if share < 1 else f"{share + 1:.2g} times"


class _Problem(eqx.Module):
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

    @property
    def n(self) -> int:
        return self.model.n_joints

    def instants(self, finer: int = 1) -> Array:
        """Times of one period, evenly spread."""
        count = finer * max(200, PER_CYCLE * self.harmonics)
        return jnp.arange(count) * (self.period / count)


def design_excitation(
    model: Model,
    *,
    harmonics: int = 5,
    period: float = 10.0,
    limits: Limits = Limits(),
    objective: str = "condition",
    parameter: str | None = None,
    window: float | None = None,
    rest: bool = False,
    mean: Any = None,
    scale: Any = None,
    parameters: Any = None,
    moved: Model | None = None,
    encoder: Encoder | None = None,
    sample_rate: float = 1000.0,
    starts: int = 32,
    seed: int = 0,
    method: str = "bfgs",
    progress: Progress = lambda share: None,
) -> Design:
    """Design a periodic motion, a finite Fourier series, that excites every parameter of a model.

    **Arguments:** `harmonics` and `period` [s]: the highest frequency is their ratio. `objective` one of `OBJECTIVES`
    (`stderr` is that of `parameter`, by its name), over the whole period, or over the worst of all sliding windows of
    `window` seconds. `rest` makes the period begin and end at rest. `mean` position [rad or m], for all joints or for
    each; where it is not given, it is designed as well. `scale` (p,) the size of each parameter: columns are compared
    by the torque that they make. `parameters` (p,) of the model, which a limit of the torque needs. Where more is moved
    than is to be identified, such as a known robot with the human in it, `moved` is the model of it all, and the
    `parameters` and the limit of the torque are its.
    `encoder` brings the quantised position into the objective. `sample_rate` [Hz] of the measurements that a standard
    error counts. `starts` random motions are improved by `method` (`optimise.METHODS`); `seed` draws them.

    **Returns:** a `Design`: the best motion. It keeps the limits on a grid of at least 240 instants in every period of
    the highest harmonic.

    **Raises:** `ValueError` for limits that no motion can keep (it names them), and for settings that make no sense.

    **Source:** Tout et al. 2023, III-A; the series of Swevers et al. 1997.
    """
    require_float64()
    if method not in METHODS:
        raise ValueError(f"method is '{method}': there are {', '.join(METHODS)}")
    problem = _problem(
        model, moved or model, harmonics=harmonics, period=period, limits=limits, objective=objective,
        parameter=parameter, window=window, rest=rest, mean=mean, scale=scale, parameters=parameters,
        encoder=encoder, sample_rate=sample_rate,
    )  # fmt: skip
    x = _random_starts(problem, starts, seed)
    x = _descend(problem, x, method, progress)
    found = [_judged(problem, one) for one in x]
    values = np.array([value for _, value, _, _ in found])
    conditions = np.sort([worst for *_, worst in found])
    series, value, condition, worst = found[int(np.nanargmin(values))]
    if not math.isfinite(value):
        raise ValueError(
            "no motion of so few harmonics tells all parameters apart: give more harmonics, wider limits, or a smaller "
            "model"
        )
    bound, source = condition_bound(model, harmonics, period)
    return Design(
        series, model, condition, worst, bound, source, period, objective, _in_units(problem, value), limits,
        _active(problem, series), conditions, None if parameters is None else np.asarray(parameters, float), window,
        moved, parameter,
    )  # fmt: skip


def _problem(
    model: Model,
    moved: Model,
    *,
    harmonics: int,
    period: float,
    limits: Limits,
    objective: str,
    parameter: str | None = None,
    window: float | None = None,
    rest: bool = False,
    mean: Any = None,
    scale: Any = None,
    parameters: Any = None,
    encoder: Encoder | None = None,
    sample_rate: float = 1000.0,
) -> _Problem:
    """The settings, checked."""
    if model.n_joints != moved.n_joints:
        raise ValueError(
            f"the model has {model.n_joints} joints, but that of what is moved has {moved.n_joints}: give both the "
            "same joints"
        )
    _check_motion(harmonics, period, sample_rate, window, rest, encoder)
    _check_objective(model, objective, parameter)
    low, high, most = room(limits, model.n_joints)
    if mean is not None:
        mean = jnp.asarray(_per_joint("mean", mean, model.n_joints))
        if not ((low < mean) & (mean < high)).all():
            raise ValueError(f"mean is {mean.tolist()}: it must be inside limits.position")
    if np.isfinite(most[-1]).any() and parameters is None:
        raise ValueError(
            f"limits.torque needs the parameters of the model, here {', '.join(moved.names)}: pass parameters=..., or "
            "write a [parameters] table"
        )
    scale = jnp.ones(len(model.names)) if scale is None else _per_parameter("scale", scale, model)
    if not (scale > 0).all():
        raise ValueError("scale must be above zero: it is the size of each parameter")
    return _Problem(
        model=model,
        moved=moved,
        period=float(period),
        harmonics=harmonics,
        rest=rest,
        low=jnp.asarray(low),
        high=jnp.asarray(high),
        most=jnp.asarray(most),
        parameters=None if parameters is None else _per_parameter("parameters", parameters, moved),
        scale=scale,
        mean=mean,
        objective=objective,
        parameter=-1 if parameter is None else model.names.index(parameter),
        window=None if window is None else window / period,
        encoder=encoder,
        samples=period * (sample_rate if encoder is None else encoder.sample_rate),
    )


def _check_motion(
    harmonics: int, period: float, sample_rate: float, window: float | None, rest: bool, encoder: Encoder | None
) -> None:
    if harmonics < (3 if rest else 1):
        raise ValueError(f"harmonics is {harmonics}: give at least {3 if rest else 1}")
    for name, number in (("period", period), ("sample_rate", sample_rate)):
        if not (math.isfinite(number) and number > 0):
            raise ValueError(f"{name} is {number}: it must be a number above zero")
    if window is not None and not 0 < window <= period:
        raise ValueError(f"window is {window:g} s: it must be above zero and no longer than the period of {period:g} s")
    if encoder is not None and not round(period * encoder.sample_rate) >= 2 * harmonics:
        raise ValueError(
            "the encoder takes fewer than two samples in a period of the highest harmonic: raise its sample rate, or "
            "give fewer harmonics"
        )


def _check_objective(model: Model, objective: str, parameter: str | None) -> None:
    if objective not in OBJECTIVES:
        raise ValueError(f"objective is '{objective}': {nearest(objective, list(OBJECTIVES))}")
    if (objective == "stderr") != (parameter is not None):
        raise ValueError(
            "the objective 'stderr' needs a parameter, and no other objective takes one: parameter may be "
            + ", ".join(model.names)
        )
    if parameter is not None and parameter not in model.names:
        raise ValueError(f"parameter is '{parameter}': {nearest(parameter, list(model.names))}")


_SYMMETRIC = ("velocity", "acceleration", "jerk", "torque")


def room(limits: Limits, n: int) -> tuple[Numbers, Numbers, Numbers]:
    """Lowest and highest position (n,), and the most of everything else (4, n)."""
    low, high = (_per_joint(f"limits.position[{k}]", x, n) for k, x in enumerate(limits.position))
    most = np.stack([_per_joint(f"limits.{name}", getattr(limits, name), n) for name in _SYMMETRIC])
    if not (np.isfinite(low) == np.isfinite(high)).all():
        raise ValueError("limits.position is finite on one side only: give both, or neither")
    if not (low < high).all():
        raise ValueError(f"limits.position: the lowest, {low.tolist()}, is not below the highest, {high.tolist()}")
    for name, most_of in zip(_SYMMETRIC, most, strict=True):
        if not (most_of > 0).all():
            raise ValueError(f"limits.{name} is {most_of.tolist()}: no motion keeps a limit that is not above zero")
    return low, high, most


def _per_joint(name: str, value: Any, n: int) -> Numbers:
    given = np.asarray(value, float)
    if given.shape not in ((), (n,)) or np.isnan(given).any():
        raise ValueError(f"{name} is {value}: give one number, or one for each of {n} joints")
    return np.broadcast_to(given, (n,))


def _per_parameter(name: str, values: Any, model: Model) -> Array:
    if np.shape(values) != (len(model.names),) or not np.isfinite(values).all():
        raise ValueError(f"{name} must be {len(model.names)} finite numbers, one for each of {', '.join(model.names)}")
    return jnp.asarray(values, float)


# The motion that a vector of numbers stands for.


def _direction(problem: _Problem, x: Array) -> FourierSeries:
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


def _times(series: FourierSeries, factor: Array | float) -> FourierSeries:
    return FourierSeries(series.sine * factor, series.cosine * factor, series.offset, series.period)


def _feasible(problem: _Problem, x: Array, t: Array, smooth: Array | None) -> tuple[FourierSeries, Array]:
    """As far from rest as the limits allow, and how much rest itself exceeds the limit of the torque."""
    series = _direction(problem, x)
    series = _times(series, 1 / jnp.maximum(_reached(problem, series, t).max(), 1.0))
    if problem.parameters is None:
        return series, jnp.zeros(())
    return _within_torque(problem, series, t, smooth)


def _reached(problem: _Problem, series: FourierSeries, t: Array) -> Array:
    """(5, n) how far the motion goes, as a share of each limit: up, down, and of velocity, acceleration and jerk."""
    q, dq, ddq = series(t)
    swing = q - series.offset
    up = swing.max(axis=0) / jnp.where(jnp.isfinite(problem.high), problem.high - series.offset, jnp.inf)
    down = -swing.min(axis=0) / jnp.where(jnp.isfinite(problem.low), series.offset - problem.low, jnp.inf)
    others = [jnp.abs(x).max(axis=0) / most for x, most in zip((dq, ddq, jerk(series, t)), problem.most, strict=False)]
    return jnp.stack([up, down, *others])


def _within_torque(
    problem: _Problem, series: FourierSeries, t: Array, smooth: Array | None
) -> tuple[FourierSeries, Array]:
    """The largest part of a motion whose torque keeps its limit: a root, differentiated as an implicit function."""

    def excess(factor: Array, series: FourierSeries) -> Array:
        return _torque_share(problem, _times(series, factor), t, smooth).max() - 1

    fixed = jax.lax.stop_gradient(series)
    at_rest = _torque_share(problem, _times(series, 0.0), t[:1], smooth).max() - 1
    at_most = excess(jnp.ones(()), fixed)
    root = _root(lambda factor: excess(factor, fixed), jax.lax.stop_gradient(at_rest), at_most)
    slope = jax.lax.stop_gradient(jax.jvp(lambda factor: excess(factor, fixed), (root,), (jnp.ones(()),))[1])
    step = excess(root, series) / jnp.where(slope == 0, 1, slope)
    factor = jnp.where(at_most <= 0, 1.0, root - (step - jax.lax.stop_gradient(step)))
    return _times(series, factor), jnp.maximum(at_rest, 0)


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


def _torque_share(problem: _Problem, series: FourierSeries, t: Array, smooth: Array | None) -> Array:
    """(n,) largest torque as a share of its limit."""
    assert problem.parameters is not None
    torque = _rows(problem.moved, series(t), smooth, problem.period) @ problem.parameters
    return jnp.abs(torque).max(axis=0) / problem.most[-1]


# What a motion is worth.


def _rows(model: Model, motion: tuple[Array, ...], smooth: Array | None, period: float) -> Array:
    """(N, n, p) regressor; dry friction changes sign within a share `smooth` of the largest velocity."""
    (q, dq, ddq), one_joint = motion, model.n_joints == 1
    rate = len(q) / period
    if smooth is not None:
        width = jnp.maximum(smooth * jnp.abs(dq).max(axis=0), jnp.finfo(dq.dtype).eps)  # at rest it would vanish
        model = model.smoothed(width[0] if one_joint else width)
    if one_joint:
        return model.over_period(q[:, 0], dq[:, 0], ddq[:, 0], rate)[:, None]
    return model.over_period(q, dq, ddq, rate)


def _measured(encoder: Encoder, series: FourierSeries, t: Array) -> tuple[Array, ...]:
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
    problem: _Problem, series: FourierSeries, t: Array, smooth: Array | None, whole: bool = False, every: int = 1
) -> Array:
    """(M, p, p) sums over the period, or over sliding windows, as many as measurements in the same time make.

    `every` is the number of windows in the length of one: 1 stands for all that there are.
    """
    motion: tuple[Array, ...] = series(t)
    if problem.encoder is not None:
        t = jnp.arange(round(problem.samples)) / problem.encoder.sample_rate
        motion = _measured(problem.encoder, series, t)
    rows = _rows(problem.model, motion, smooth, problem.period) * problem.scale
    products = jnp.einsum("tni,tnj->tij", rows, rows) * (problem.samples / len(t))
    if problem.window is None or whole:
        return products.sum(axis=0)[None]
    length = max(1, round(problem.window * len(t)))
    return _sliding_sums(products, length)[:: max(1, length // every) if every > 1 else 1]


def _sliding_sums(products: AnyArray, length: int) -> Array:
    """Sums over the windows of `length` instants that begin at each instant; they wrap around, as the motion does."""
    products = jnp.asarray(products)
    sums = jnp.cumsum(jnp.concatenate([jnp.zeros_like(products[:1]), products, products[:length]]), axis=0)
    return sums[length : length + len(products)] - sums[: len(products)]


def _worth(problem: _Problem, series: FourierSeries, t: Array, smooth: Array | None, sharpness: Array | None) -> Array:
    """Logarithm of the objective, the smaller the better; of the worst window a smooth maximum."""
    objectives: dict[str, Callable[[Array], Array]] = {
        "condition": log_condition,
        "determinant": log_volume,
        "sigma_min": log_sigma_min,
        "stderr": partial(log_stderr, parameter=problem.parameter),
    }
    every = 1 if sharpness is None else DESCENDING
    values = objectives[problem.objective](_grams(problem, series, t, smooth, every=every))
    return values.max() if sharpness is None else jax.nn.logsumexp(sharpness * values) / sharpness


# Descent.


def _random_starts(problem: _Problem, count: int, seed: int) -> Array:
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


def _rests(problem: _Problem, count: int, random: np.random.Generator) -> Numbers:
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
def _farthest(problem: _Problem, x: Array) -> Array:
    """How far each motion goes, as a share of the limit that it comes closest to."""
    t = problem.instants()
    return jax.vmap(lambda x: _reached(problem, _direction(problem, x), t).max())(x)


@eqx.filter_jit
def _shares_at_rest(problem: _Problem, x: Array) -> Array:
    return jax.vmap(lambda x: _torque_share(problem, _direction(problem, x), jnp.zeros(1), None))(x)


def _descend(problem: _Problem, x: Array, method: str, progress: Progress) -> Array:
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
    problem: _Problem,
    x: Array,
    smooth: Array,
    sharpness: Array,
    method: str,
    polytope: tuple[Array, Array] | None,
) -> Array:
    t = problem.instants()

    def objective(x: Array) -> Array:
        series, excess = _feasible(problem, x, t, smooth)
        value = _worth(problem, series, t, smooth, sharpness)
        return jnp.where(excess > 0, INFEASIBLE * (1 + excess), jnp.nan_to_num(value, nan=INFEASIBLE))

    return minimise(objective, x, method, project=None if polytope is None else onto_polytope(*polytope)).x


def _linear_limits(problem: _Problem) -> tuple[Array, Array]:
    """`A x <= b`: the limits that are linear in the coefficients, with the offset in the middle."""
    t, size = problem.instants(), problem.n * (2 * problem.harmonics + 1)

    def reached(x: Array) -> Array:
        series = _direction(problem, x)
        q, dq, ddq = series(t)
        return jnp.stack([q - series.offset, dq, ddq, jerk(series, t)])

    A = jax.jacobian(reached)(jnp.zeros(size)).reshape(-1, size)
    half = jnp.stack([(problem.high - problem.low) / 2, *problem.most[:3]])
    b = jnp.broadcast_to(half[:, None], (4, len(t), problem.n)).ravel()
    kept = np.isfinite(b)
    if not kept.any():
        raise ValueError("projected_gradient needs limits to project onto: give some, or use bfgs")
    return jnp.concatenate([A[kept], -A[kept]]), jnp.concatenate([b[kept], b[kept]])


# The result.


def _judged(problem: _Problem, x: Array) -> tuple[FourierSeries, float, float, float]:
    """The motion on the fine grid, its objective, its condition number over the period and in the worst window."""
    series, *numbers = _judge(problem, x)
    single = problem.n == 1
    sine, cosine, offset = (np.asarray(x) for x in (series.sine, series.cosine, series.offset))
    if single:
        sine, cosine, offset = sine[0], cosine[0], offset[0]
    return FourierSeries(sine, cosine, offset, problem.period), *(float(number) for number in numbers)  # type: ignore[return-value]


@eqx.filter_jit
def _judge(problem: _Problem, x: Array) -> tuple[FourierSeries, Array, Array, Array]:
    t = problem.instants(FINER)
    series, _ = _feasible(problem, x, problem.instants(), None)
    series = _times(series, 1 / jnp.maximum(_reached(problem, series, t).max() * (1 + ROUNDING), 1.0))
    excess = jnp.zeros(())
    if problem.parameters is not None:
        series, excess = _within_torque(problem, series, t, None)
    value = jnp.where(excess > 0, jnp.inf, _worth(problem, series, t, None, None))
    plain = eqx.tree_at(lambda p: p.scale, problem, jnp.ones_like(problem.scale))
    windows = log_condition(_grams(plain, series, t, None))
    return series, value, jnp.exp(log_condition(_grams(plain, series, t, None, whole=True)))[0], jnp.exp(windows.max())


def _in_units(problem: _Problem, value: float) -> float:
    """The objective in the unit in which the user knows it."""
    return math.exp(-value if problem.objective == "sigma_min" else value)


def _active(problem: _Problem, series: FourierSeries) -> tuple[str, ...]:
    """The limits that the motion reaches, in words."""
    n, t = problem.n, problem.instants(FINER)
    sine, cosine = (jnp.reshape(x, (n, -1)) for x in (series.sine, series.cosine))
    several = FourierSeries(sine, cosine, jnp.reshape(series.offset, n), series.period)
    names = ["highest position", "lowest position", *_SYMMETRIC]
    reached = list(np.asarray(_reached(problem, several, t)))
    if problem.parameters is not None:
        reached.append(np.asarray(_torque_share(problem, several, t, None)))
    of = [f" of joint {j + 1}" if n > 1 else "" for j in range(n)]
    return tuple(
        name + of[j] for name, shares in zip(names, reached, strict=False) for j in range(n) if shares[j] >= ACTIVE
    )
