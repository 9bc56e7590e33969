"""The search for motions of robots: models with many columns, and limits that are no multiples of the motion.

A robot's regressor takes seconds to compile, and an optimiser that is compiled with it holds many copies. Here it is
compiled once with its gradient, once more to judge motions, and the optimiser is driven from Python. Apart from
that the search differs from `motions.descend` in three ways:

- **Each joint goes as far as its own limits allow**: a division again, by a norm of high power in place of the largest
  share, so that the objective is smooth.
- **Torque and clearance are penalised**, more and more. What is left in the end is taken away on the fine grid, as the
  motion is scaled back towards its mean position until all is kept.
- **Starts are compared** after a few steps, and only the better ones go on.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaximp.design.motions import (
    DESCENDING,
    FINER,
    ROUNDING,
    Motion,
    Problem,
    as_given,
    direction_of,
    grams_of,
    in_si,
    regressor_rows,
    shares_reached,
    torque_of,
    worth_of_grams,
)
from jaximp.design.objectives import log_condition
from jaximp.motion.trajectories import FourierSeries, jerk
from jaximp.numerics.compilation import filter_compiled
from jaximp.numerics.optimise import descend_from_python
from jaximp.types import Numbers, Progress


class Stage(NamedTuple):
    """A part of the search: smooth at first, then ever closer to what is meant."""

    smooth: float
    """Dry friction changes its sign within such a share of the largest velocity."""
    sharpness: float
    """Of the smooth maximum over windows and eigenvalues."""
    power: float
    """Of the norm that stands for the largest share of a limit."""
    weight: float
    """Of the penalty on torque and clearance."""
    steps: int
    kept: float
    """Which share of the starts goes on; at least `FEWEST`."""


STAGES = (
    Stage(0.1, 4.0, 10.0, 1.0, 60, 0.2),
    Stage(0.03, 20.0, 40.0, 30.0, 200, 0.5),
    Stage(0.01, 200.0, 300.0, 1000.0, 400, 1.0),
)
FEWEST = 2
"""So many starts go on at least."""
TOLERANCE = 1e-6
HEADROOM = 1e-5
"""A motion that is scaled back keeps such a share of each limit free."""


class Knobs(NamedTuple):
    smooth: Array
    sharpness: Array
    power: Array
    weight: Array


class Seen(NamedTuple):
    """A motion as it is judged."""

    value: Array
    """Logarithm of the objective."""
    condition: Array
    worst: Array
    """Condition number of the worst window."""
    unit: Array
    """Condition number over the period of columns of unit norm."""
    most: Array
    """The largest share by which torque and clearance exceed their limits."""
    excess: Array
    """(N, n + C) the same at each instant."""


def search(problem: Problem, starts: int, seed: int, progress: Progress) -> list[Motion]:
    """Motions from random starts, those that went on to the end first."""
    x = _random_starts(problem, starts, seed)
    done, given_up = 0.0, []
    work = _work(starts)
    for stage, share in zip(STAGES, work, strict=True):
        knobs = Knobs(*(jnp.asarray(number) for number in stage[:4]))
        value_and_slope = partial(filter_compiled(_value_and_slope), problem, knobs)
        found = descend_from_python(value_and_slope, x, stage.steps, TOLERANCE)
        order = np.argsort(np.asarray(found.value))
        count = max(FEWEST, math.ceil(stage.kept * len(order)))
        given_up += list(found.x[order[count:]])
        x = found.x[order[:count]]
        done += share
        progress(done / sum(work))
    return [finished(problem, one) for one in [*x, *given_up[::-1]]]


def _work(starts: int) -> list[float]:
    """How much each stage has to do."""
    shares = []
    for stage in STAGES:
        shares.append(float(starts * stage.steps))
        starts = max(FEWEST, math.ceil(stage.kept * starts))
    return shares


def finished(problem: Problem, x: Array) -> Motion:
    """The motion on the fine grid, within all limits; its objective is infinite where there is none."""
    t = problem.instants(FINER)
    series = direction_of(problem, x)
    series = times_each(series, 1 / jnp.maximum(_reached(problem, x[None], FINER)[0] * (1 + ROUNDING), 1.0))

    @cache
    def seen(factor: float) -> Seen:
        return filter_compiled(_seen)(problem, *times_each(series, factor)(t))

    factor = 1.0 if seen(1.0).most <= 0 else _factor(lambda factor: float(seen(factor).most))
    if factor is None:
        return Motion(as_given(problem, series), *[math.inf] * 4)
    value, *conditions = (float(number) for number in seen(factor)[:4])
    return Motion(
        as_given(problem, times_each(series, factor)), value if math.isfinite(value) else math.inf, *conditions
    )


def _reached(problem: Problem, x: Array, finer: int = 1) -> Array:
    """(m, n) how far the motion of each joint goes, as a share of the limit that it comes closest to."""
    return filter_compiled(_reached_by_all)(problem, x, problem.instants(finer))


def _reached_by_all(problem: Problem, x: Array, t: Array) -> Array:
    return jax.vmap(lambda x: shares_reached(problem, direction_of(problem, x), t).max(axis=0))(x)


def _factor(excess: Callable[[float], float]) -> float | None:
    """The largest factor not far below one at which nothing is exceeded; None where even rest exceeds a limit.

    Torque and clearance may be kept again by a smaller motion that passes what a larger one does not.
    """
    back = 1e-3
    while excess(1 - back) > -HEADROOM:
        if back >= 1:
            return None
        back = min(2 * back, 1.0)
    low, high = 1 - back, 1 - back / 2 if back > 1e-3 else 1.0
    for _ in range(12):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) <= -HEADROOM else (low, middle)
    return low


def times_each(series: FourierSeries, factor: Array | float) -> FourierSeries:
    """With a factor for each joint."""
    factor = jnp.broadcast_to(jnp.asarray(factor), series.offset.shape)[:, None]
    return FourierSeries(series.sine * factor, series.cosine * factor, series.offset, series.period)


def _value_and_slope(problem: Problem, knobs: Knobs, x: Array) -> tuple[Array, Array]:
    return jax.value_and_grad(_objective, argnums=1)(problem, x, knobs)


def _objective(problem: Problem, x: Array, knobs: Knobs) -> Array:
    t = problem.instants()
    motion = _within_limits(problem, direction_of(problem, x), t, knobs.power)
    rows = regressor_rows(problem.model, motion, knobs.smooth, problem.period)
    value = _smooth_worth(problem, grams_of(problem, rows, every=DESCENDING), knobs.sharpness)
    excess = _excess(problem, motion, rows, knobs.smooth)
    return value + knobs.weight * (jnp.maximum(excess, 0) ** 2).sum()


def _smooth_worth(problem: Problem, grams: Array, sharpness: Array) -> Array:
    if problem.objective != "condition":
        return worth_of_grams(problem, grams, sharpness)
    size = jnp.log(jnp.maximum(jnp.linalg.eigvalsh(grams), jnp.finfo(grams.dtype).tiny))
    values = (
        (jax.nn.logsumexp(sharpness * size, axis=-1) + jax.nn.logsumexp(-sharpness * size, axis=-1)) / sharpness / 2
    )
    return jax.nn.logsumexp(sharpness * values) / sharpness


def _within_limits(problem: Problem, series: FourierSeries, t: Array, power: Array) -> tuple[Array, ...]:
    """Position, velocity and acceleration (N, n) of each joint, divided by what it exceeds its limits by, smoothly."""
    q, dq, ddq = series(t)
    swing, offset = q - series.offset, series.offset
    up = swing / jnp.where(jnp.isfinite(problem.high), problem.high - offset, jnp.inf)
    down = -swing / jnp.where(jnp.isfinite(problem.low), offset - problem.low, jnp.inf)
    others = [jnp.abs(x) / most for x, most in zip((dq, ddq, jerk(series, t)), problem.most, strict=False)]
    shares = jnp.concatenate([up, down, *others, jnp.ones_like(q[:1])])
    logs = jnp.log(jnp.maximum(shares, jnp.finfo(q.dtype).tiny))
    factor = jnp.exp(-jax.nn.logsumexp(power * logs, axis=0) / power)
    return offset + factor * swing, factor * dq, factor * ddq


def _excess(problem: Problem, motion: tuple[Array, ...], rows: Array, smooth: Array | None) -> Array:
    """(N, n + C) by how much torque and clearance exceed their limits, as shares of them; the regressor is `rows`."""
    parts = [jnp.zeros((len(rows), 0))]
    if problem.parameters is not None:
        torque = rows @ problem.parameters if problem.whole else torque_of(problem, motion, smooth)
        parts.append(jnp.abs(torque) / problem.most[-1] - 1)
    if problem.clearance is not None:
        parts.append(problem.clearance.shares(motion[0]) - 1)
    return jnp.concatenate(parts, axis=1)


def _seen(problem: Problem, q: Array, dq: Array, ddq: Array) -> Seen:
    motion = (q, dq, ddq)
    rows = regressor_rows(problem.model, motion, None, problem.period)
    plain = in_si(problem)
    whole = grams_of(plain, rows, whole=True)
    windows = log_condition(grams_of(plain, rows)).max()
    unit = log_condition(grams_of(replace(plain, unit=True), rows, whole=True))[0]
    value = worth_of_grams(problem, grams_of(problem, rows), None)
    excess = _excess(problem, motion, rows, None)
    return Seen(
        value, jnp.exp(log_condition(whole))[0], jnp.exp(windows), jnp.exp(unit), excess.max(initial=-1.0), excess
    )


def _random_starts(problem: Problem, count: int, seed: int) -> Array:
    """Motions of all shapes, each joint near its limits, about mean positions that keep torque and clearance."""
    if count < 1:
        raise ValueError(f"starts is {count}: give at least one")
    random, (n, h) = np.random.default_rng(seed), (problem.n, problem.harmonics)
    spectrum = np.arange(1, h + 1) ** random.uniform(-1, 1, (count, 1, n, 1))
    coefficients = random.normal(size=(count, 2, n, h)) * spectrum
    rests = _rests(problem, count, random)
    x = np.concatenate([rests, coefficients.reshape(count, -1)], axis=1)
    reached = np.asarray(_reached(problem, jnp.asarray(x)))
    size = np.where(reached > 0, random.uniform(0.5, 1.5, (count, n)) / np.where(reached > 0, reached, 1), 1.0)
    x[:, n:] = (x[:, n:].reshape(count, 2, n, h) * size[:, None, :, None]).reshape(count, -1)
    return jnp.asarray(x)


def _rests(problem: Problem, count: int, random: np.random.Generator) -> Numbers:
    """(count, n) of the optimiser's numbers for mean positions at which the robot may stand still."""
    poses = len(problem.instants(FINER))
    x = random.normal(size=(poses, problem.n))
    still = jnp.zeros((poses, problem.n))
    zero = np.zeros(2 * problem.n * problem.harmonics)
    offsets = jax.vmap(lambda own: direction_of(problem, jnp.concatenate([own, jnp.asarray(zero)])).offset)(
        jnp.asarray(x)
    )
    excess = np.asarray(filter_compiled(_seen)(problem, offsets, still, still).excess)
    fits = (excess < 0).all(axis=1)
    if not fits.any():
        raise ValueError(_nowhere(problem, excess))
    return np.resize(x[fits], (count, problem.n))


def _nowhere(problem: Problem, excess: Numbers) -> str:
    least = excess.min(axis=0)
    worst = int(least.argmax())
    joints = 0 if problem.parameters is None else problem.n
    if least[worst] < 0:
        return "limits: no mean position was found at which all joints may stand still: widen limits or clearance"
    if worst < joints:
        return (
            f"limits.torque: even at rest joint {worst + 1} needs {least[worst] + 1:.3g} times the torque that is "
            "allowed, in every position: raise the limit of the torque, or move those of the position"
        )
    assert problem.clearance is not None
    return (
        f"clearance of {problem.clearance.names[worst - joints]} is kept in no position: ask for a smaller distance or "
        "radius, or name the pair in ignore"
    )
