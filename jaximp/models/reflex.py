"""The stretch reflex of a joint: torque that follows the velocity of a stretch, some time later.

The parallel cascade of Kearney, Stein and Parameswaran 1997: the torque of a joint is intrinsic (inertia, damping,
stiffness) plus reflex, and the reflex answers a stretch alone: its input is the half-wave rectified velocity, its
delay some 40 ms, its dynamics those of the muscle. Where they give these dynamics a form, here every lag has its own
weight: linear in its parameters, so that everything that is made for such models serves it too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models.base import Model
from jaximp.types import AnyArray

LAGS = tuple(round(0.040 + 0.015 * k, 3) for k in range(31))
"""The lags that are used by default [s]: 40 to 490 ms. Lags that are closer together than half a period of the low-pass
cannot be told apart. If the weights have not come to zero at the last lag, part of the reflex's torque is taken for
stiffness (experiments/reflex.py)."""
LONGEST = 5.0
"""No reflex lasts longer [s]; a greater lag was surely given in milliseconds."""


class ReflexPathway(Model):
    """Stretch reflex as a bank of lags: `torque = sum_k reflex_k * max(direction * dq(t - lag_k), 0)`.

    A lag between two samples is interpolated linearly, before the velocity is rectified. The parameters are called by
    their lags to the nearest millisecond, such as `reflex_040ms` [N m s/rad]; with `direction = 1` those of a reflex
    that resists the stretch are above zero, as damping is, and with -1 below. `HumanJoint(reflex=...)` has it beside
    the intrinsic parameters; it may also be stacked, `HumanJoint() + ReflexPathway(...)`.

    **Arguments:** `sample_rate` [Hz] of the recordings; `lags` [s] in rising order; `direction` 1 where a velocity
    above zero stretches the muscle, else -1.

    **Raises:** `ValueError` for lags that are below zero, above 5 s, or less than 1 ms apart, another direction, and a
    sample rate that is not above zero.

    **Source:** Kearney, Stein and Parameswaran 1997, IEEE Trans. Biomed. Eng. 44(6), the parallel-cascade model.
    """

    lags: tuple[float, ...] = eqx.field(static=True)
    """How far each lag is behind the velocity [s]."""
    rate: float = eqx.field(static=True)
    direction: int = eqx.field(static=True)

    def __init__(self, sample_rate: float, lags: Sequence[float] | Num[AnyArray, " k"] = LAGS, direction: int = 1):
        if not (math.isfinite(sample_rate) and sample_rate > 0):
            raise ValueError(f"sample_rate is {sample_rate}: give that of the recording, in Hz")
        if direction not in (1, -1):
            raise ValueError(f"direction is {direction}: it must be 1 or -1, the sign of the velocity of a stretch")
        self.lags, self.rate, self.direction = _checked(lags), float(sample_rate), int(direction)
        self.names = tuple(f"reflex_{round(1e3 * lag):03d}ms" for lag in self.lags)
        self.units = ("N m s/rad",) * len(self.lags)
        sign = "-" if direction < 0 else ""
        self.columns = tuple(f"max({sign}dq(t - {lag:g}), 0)" for lag in self.lags)
        self.label = "reflex"
        self.n_joints = 1

    @property
    def memory(self) -> int:
        return max(whole + (part > 0) for whole, part in self._shifts())

    @property
    def sample_rate(self) -> float:
        return self.rate

    def sampled_at(self, sample_rate: float) -> ReflexPathway:
        return ReflexPathway(sample_rate, self.lags, self.direction)

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        return self.regressor(q, dq, ddq)  # which refuses

    def regressor(
        self, q: Num[ArrayLike, "..."], dq: Num[ArrayLike, "..."], ddq: Num[ArrayLike, "..."]
    ) -> Float[Array, "... p"]:
        raise ValueError(
            "the reflex of one sample needs the velocity before it: pass a whole recording to observation_matrix"
        )

    def observation_matrix(
        self, q: Num[ArrayLike, " N"], dq: Num[ArrayLike, " N"], ddq: Num[ArrayLike, " N"]
    ) -> Float[Array, "N p"]:
        dq = jnp.asarray(dq)
        n, unknown = len(dq), jnp.full(self.memory + 1, jnp.nan, dq.dtype)
        past = jnp.concatenate([unknown, dq])

        def before(samples: int) -> Array:
            return past[len(unknown) - samples :][:n]

        velocity = [
            before(whole) if part == 0 else (1 - part) * before(whole) + part * before(whole + 1)
            for whole, part in self._shifts()
        ]
        return jnp.maximum(self.direction * jnp.stack(velocity, axis=-1), 0)

    def _shifts(self) -> list[tuple[int, float]]:
        """Every lag in samples: the whole samples, and the fraction that is left."""
        found = []
        for lag in self.lags:
            samples = lag * self.rate
            whole = math.floor(samples + 1e-6)  # a lag that is meant to be whole is
            part = samples - whole
            found.append((whole, part if part > 1e-6 else 0.0))
        return found

    def _prefixed(self) -> tuple[str, ...]:
        return self.names  # which say already what they are


def _checked(lags: Sequence[float] | AnyArray) -> tuple[float, ...]:
    values = np.asarray(lags, float)
    if values.ndim != 1 or not len(values) or not (np.isfinite(values) & (values >= 0) & (values <= LONGEST)).all():
        raise ValueError(f"lags are {lags}: give seconds, one number or more from 0 to {LONGEST:g}")
    if (np.diff(np.round(1e3 * values)) < 1).any():
        raise ValueError("lags must rise by at least a millisecond from one to the next")
    return tuple(values.tolist())


class ReflexGain(eqx.Module):
    """A reflex in two numbers, gain and delay, for one estimate or for M of them."""

    gain: Float[AnyArray, "*M"]
    """Gain: torque for a lasting stretch of one radian a second [N m s/rad]; above zero where it resists the
    stretch."""
    gain_stderr: Float[AnyArray, "*M"]
    delay: Float[AnyArray, "*M"]
    """Delay: the mean lag, weighted by what each lag contributes [s]."""
    delay_stderr: Float[AnyArray, "*M"]
    """Standard error of the delay, to first order; it says little where the gain is not well above zero."""


def reflex_gain(model: Model, theta: Num[AnyArray, "*M p"], covariance: Num[AnyArray, "*M p p"]) -> ReflexGain:
    """Gain and mean delay of the reflex in a model, with standard errors.

    With weights h_k at the lags t_k: gain `sum h_k` (times the direction), delay `sum t_k h_k / sum h_k`. Both know no
    more of the reflex than the bank does: lags at the end whose weights are not zero say that it is too short.

    **Arguments:** `model` a `ReflexPathway`, or a `HumanJoint`, sum or combination with one; `theta` and `covariance`
    of all its parameters.

    **Raises:** `ValueError` for a model without a reflex.
    """
    pathway = pathway_of(model)
    index = np.array([model.columns.index(column) for column in pathway.columns])
    theta, covariance = jnp.asarray(theta)[..., index], jnp.asarray(covariance)[..., index[:, None], index]
    lags = jnp.asarray(pathway.lags)

    def stderr(slope: Array) -> Array:
        return jnp.sqrt((slope[..., None, :] @ covariance @ slope[..., :, None])[..., 0, 0])

    total = theta.sum(axis=-1)
    delay = theta @ lags / total
    slope = (lags - delay[..., None]) / total[..., None]
    return ReflexGain(
        gain=pathway.direction * total,
        gain_stderr=stderr(jnp.ones_like(theta)),
        delay=delay,
        delay_stderr=stderr(slope),
    )


def pathway_of(model: Model) -> ReflexPathway:
    """The reflex in a model of one joint.

    **Raises:** `ValueError` where there is none.
    """
    parts: list[Model | None] = [model]
    while parts:
        part = parts.pop(0)
        if isinstance(part, ReflexPathway):
            return part
        parts += [getattr(part, name, None) for name in ("reflex", "first", "second")]
        parts = [one for one in parts if one is not None]
    raise ValueError("the model has no reflex: give HumanJoint one, reflex=ReflexPathway(sample_rate)")


def with_gain(model: Model, W: Num[AnyArray, "*N p"]) -> Float[Array, "*N p"]:
    """The same regressor for other parameters: the gain of the reflex in place of its first weight.

    Whatever solves for the parameters gives the gain's standard error so, without their covariance.
    """
    pathway = pathway_of(model)
    first, *others = (model.columns.index(column) for column in pathway.columns)
    W, rest = jnp.asarray(W), jnp.array(others, int)
    return W.at[..., rest].add(-W[..., first, None]).at[..., first].multiply(pathway.direction)
