"""Reference motions of one or several joints, as functions of time that give position, velocity and acceleration.

All of them are called alike, `q, dq, ddq = trajectory(t)`: times (*t) in, three arrays (*t, *n) out, in which n is the
number of joints, or nothing for a single one whose parameters are plain numbers. They are written for revolute joints
[rad]; positions in metres work as well. Everything can be compiled, batched and differentiated, in time and in the
parameters. A motion that begins, does so at t = 0; call it with `t - onset`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

Motion = tuple[Float[Array, "*out"], Float[Array, "*out"], Float[Array, "*out"]]
"""Position [rad], velocity [rad/s] and acceleration [rad/s^2], each (*t, *n)."""

Trajectory = Callable[[Array], tuple[Array, Array, Array]]
"""The type of every trajectory: a function of time that returns position, velocity and acceleration."""


def array_field(**options: Any) -> Any:
    """A module's field of which numbers become numpy float64 arrays: `jit` and `vmap` see them as arrays, and a module
    made at import keeps float64 whatever the configuration is then. Annotate it `Float[Any, shape]`: it accepts more
    than it holds."""
    return eqx.field(converter=lambda x: x if isinstance(x, jax.Array) else np.asarray(x, np.float64), **options)


def jerk(trajectory: Trajectory, t: Float[ArrayLike, "*t"]) -> Float[Array, "*out"]:
    """Third derivative (*t, *n) [rad/s^3] at the times `t`; where it jumps, that of the piece which `t` belongs to."""
    time = jnp.asarray(t, float)
    return jax.jvp(lambda time: trajectory(time)[2], (time,), (jnp.ones_like(time),))[1]


class FourierSeries(eqx.Module):
    """Finite Fourier series: periodic, smooth, and band-limited to `h / period` hertz.

    `q(t) = offset + sum_k [ a_k / (w k) sin(w k t) - b_k / (w k) cos(w k t) ]`, k = 1 .. h, w = 2 pi / period. The
    division by `w k` makes `a_k`, `b_k` the amplitudes of the velocity, so that all of them have the same unit and
    a similar size, which suits an optimiser.

    **Source:** Swevers et al. 1997, "Optimal robot excitation and identification" (the form that Tout et al. 2023,
    III-A, use).
    """

    sine: Float[Any, "*n h"] = array_field()
    """(*n, h) coefficients a_k of sin(w k t) / (w k) [rad/s]."""
    cosine: Float[Any, "*n h"] = array_field()
    """(*n, h) coefficients b_k of -cos(w k t) / (w k) [rad/s]."""
    offset: Float[Any, "*#n"] = array_field(default=0.0)
    """(*n) mean position [rad], or one for all joints."""
    period: Float[Any, ""] = array_field(default=10.0)
    """Time after which the motion repeats [s]."""

    def __check_init__(self) -> None:
        sine, cosine, offset = self.sine.shape, self.cosine.shape, self.offset.shape
        if not sine or not cosine or sine[:-1] != cosine[:-1] or offset not in ((), sine[:-1]):
            raise ValueError(
                f"sine is {sine}, cosine {cosine}, offset {offset}: give coefficients (harmonics,) and one offset, "
                "or coefficients (joints, harmonics) and offsets (joints,)"
            )
        if sine != cosine:
            raise ValueError(f"sine has {sine[-1]} harmonics and cosine {cosine[-1]}: give both the same number")
        _require_positive(period=self.period)

    @property
    def highest_frequency(self) -> Float[Any, ""]:
        """Frequency of the last harmonic [Hz]."""
        return self.sine.shape[-1] / self.period

    def __call__(self, t: Float[ArrayLike, "*t"]) -> Motion:
        time = jnp.asarray(t, float)
        sine, cosine, offset, period = jax.tree.map(jnp.asarray, (self.sine, self.cosine, self.offset, self.period))
        frequency = 2 * jnp.pi / period * jnp.arange(1, sine.shape[-1] + 1, dtype=float)
        sin, cos = jnp.sin(frequency * time[..., None]), jnp.cos(frequency * time[..., None])
        over_harmonics = partial(jnp.tensordot, axes=(-1, -1))
        position = offset + (over_harmonics(sin, sine / frequency) - over_harmonics(cos, cosine / frequency))
        velocity = over_harmonics(cos, sine) + over_harmonics(sin, cosine)
        acceleration = over_harmonics(cos, cosine * frequency) - over_harmonics(sin, sine * frequency)
        return position, velocity, acceleration


def at_rest(series: FourierSeries) -> FourierSeries:
    """The nearest series, in its coefficients, that begins and ends a period at its offset and at rest.

    At t = 0 the position is the offset if `sum b_k / k = 0`, the velocity is zero if `sum a_k = 0` and the acceleration
    if `sum k b_k = 0`; the coefficients are projected onto these conditions. They leave h - 1 sines and h - 2 cosines
    free: nothing of a single harmonic, which is refused, and only sines of two.
    """
    harmonics = series.sine.shape[-1]
    if harmonics < 2:
        raise ValueError("one harmonic cannot begin at rest: give the series at least 2, or 3 to keep cosines as well")
    k = np.arange(1.0, harmonics + 1)
    conditions = np.linalg.qr(np.stack([1 / k, k], axis=1))[0]
    sine = series.sine - series.sine.mean(axis=-1, keepdims=True)
    cosine = series.cosine - (series.cosine @ conditions) @ conditions.T
    return FourierSeries(sine, cosine, series.offset, series.period)


_ORDERS = np.array([0, 1, 2, 0, 1, 2])
"""Six numbers describe a piece of fifth order: position, velocity, acceleration at u = 0, then at u = 1."""

_QUINTIC = np.array(
    [
        [1, 0, 0, 0, 0, 0],
        [0, 1, 0, 0, 0, 0],
        [0, 0, 0.5, 0, 0, 0],
        [-10, -6, -1.5, 10, -4, 0.5],
        [15, 8, 1.5, -15, 7, -1],
        [-6, -3, -0.5, 6, -3, 0.5],
    ]
)
"""The matrix that makes the coefficients of u^0 .. u^5 from these six numbers."""

_SQUARED_JERK = _QUINTIC[3:].T @ np.array([[36, 72, 120], [72, 192, 360], [120, 360, 720]]) @ _QUINTIC[3:]
"""The integral of the squared jerk from u = 0 to 1, as a quadratic form of these six numbers."""


class MinimumJerk(eqx.Module):
    """Smoothest motion through way points: least integral of the squared jerk, over all motions that meet them.

    Two points and the defaults make the fifth-order polynomial from rest to rest, `u^3 (10 - 15 u + 6 u^2)` with
    `u = t / duration`. More points make a chain of such polynomials that is continuous up to the fourth derivative;
    e.g. `MinimumJerk([0, 0.05, 0], 0.1)` goes out and back. Before the first point and after the last one the velocity
    stays as it is there, zero by default.

    **Source:** Lakatos et al. 2011, eqs. (15), (16), who name Flash and Hogan 1985. Eq. (15) is read as the integral of
    the squared jerk from 0 to t_f.
    """

    points: Float[Any, "k *n"] = array_field()
    """(k, *n) positions that are passed [rad], k >= 2."""
    durations: Float[Any, "k-1"] | Float[Any, ""] = array_field()
    """(k - 1,) times from point to point [s], or one for all."""
    end_velocities: Float[Any, "2 *n"] | Float[Any, ""] = array_field(default=0.0)
    """(2, *n) velocities at the first and at the last point [rad/s], or one for all."""
    end_accelerations: Float[Any, "2 *n"] | Float[Any, ""] = array_field(default=0.0)
    """(2, *n) accelerations there [rad/s^2], or one for all."""

    def __check_init__(self) -> None:
        if self.points.ndim == 0 or self.points.shape[0] < 2:
            raise ValueError(f"points is {self.points.shape}: give at least a start and an end along its first axis")
        k, *joints = self.points.shape
        expected = {"durations": (k - 1,), "end_velocities": (2, *joints), "end_accelerations": (2, *joints)}
        for name, shape in expected.items():
            if (found := getattr(self, name).shape) not in ((), shape):
                raise ValueError(f"{name} is {found}: points {self.points.shape} need {shape} or one number")
        _require_positive(durations=self.durations)

    def __call__(self, t: Float[ArrayLike, "*t"]) -> Motion:
        ends = np.array([0, -1])
        states = jnp.zeros((self.points.shape[0], 3, *self.points.shape[1:])).at[:, 0].set(self.points)
        states = states.at[ends, 1].set(self.end_velocities).at[ends, 2].set(self.end_accelerations)
        durations = jnp.broadcast_to(self.durations, (self.points.shape[0] - 1,))
        if len(durations) > 1:
            states = _with_least_jerk(states, durations)
        rows = _QUINTIC * durations[:, None, None] ** (_ORDERS - np.arange(6)[:, None])
        pieces = jnp.einsum("mij,mj...->im...", rows, jnp.concatenate([states[:-1], states[1:]], axis=1))
        return _piecewise_polynomial(pieces, states[-1, :2], durations, jnp.asarray(t, float))


class SixthOrder(eqx.Module):
    """Polynomial of sixth order from rest to rest that ends without jerk: `u^3 (20 - 45 u + 36 u^2 - 10 u^3)`.

    The rival of the fifth order in Lakatos et al. 2011, III-B. The seventh condition is read as zero jerk at t_f
    (the sixth one is printed twice). No motion has the least squared jerk under it: motions that drop their jerk just
    before the end come as close to the fifth order as one likes. This one has the least integral of
    `jerk(t)^2 / (t_f - t)`.
    """

    start: Float[Any, "*n"] = array_field()
    """(*n) position up to t = 0 [rad]."""
    end: Float[Any, "*n"] = array_field()
    """(*n) position from t = duration on [rad]."""
    duration: Float[Any, ""] = array_field()
    """Duration of the motion [s]."""

    def __check_init__(self) -> None:
        if self.start.shape != self.end.shape:
            raise ValueError(f"start is {self.start.shape} and end {self.end.shape}: give both the same joints")
        _require_positive(duration=self.duration)

    def __call__(self, t: Float[ArrayLike, "*t"]) -> Motion:
        start, end, duration = (jnp.asarray(x, float) for x in (self.start, self.end, self.duration))
        powers = duration ** np.arange(3, 7)
        way = jnp.multiply.outer(np.array([20, -45, 36, -10]) / powers, end - start)
        rest = jnp.zeros_like(start)
        piece = jnp.concatenate([jnp.stack([start, rest, rest]), way])[:, None]
        return _piecewise_polynomial(piece, jnp.stack([end, rest]), duration[None], jnp.asarray(t, float))


class RaisedSine(eqx.Module):
    """Perturbation out and back: all of it is zero before t = 0 and after `duration (1 + ratio)`.

    The acceleration is eq. (27), `amplitude sin(2 pi t / duration)^2` in the first half of `duration` and minus that in
    the second, and then the same again, `ratio` times as long and minus `ratio^-2` times as high: the one height that
    brings the position back to zero. It is farthest away, by `amplitude duration^2 / 8`, at t = duration.

    **Source:** Börner et al. 2020, eqs. (27), (28). T_p is read as the duration of each of the two profiles, and the
    second as beginning when the first one ends. Several axes, eq. (29): `amplitude * [cos(angle), sin(angle)]`.
    """

    amplitude: Float[Any, "*n"] = array_field()
    """(*n) first peak of the acceleration, A_p,1 [m/s^2]."""
    duration: Float[Any, ""] = array_field()
    """Duration of the first profile, T_p,1 [s]."""
    ratio: Float[Any, ""] = array_field(default=1.5)
    """Duration of the second profile over that of the first."""

    def __check_init__(self) -> None:
        _require_positive(duration=self.duration, ratio=self.ratio)

    @classmethod
    def of_displacement(cls, peak: ArrayLike, duration: ArrayLike, ratio: ArrayLike = 1.5) -> RaisedSine:
        """With the largest displacement `peak` (*n) [m]: the static task of Börner et al. 2020 (8 mm, 160 ms)."""
        return cls(8 * jnp.asarray(peak) / jnp.asarray(duration) ** 2, duration, ratio)

    @classmethod
    def of_force(
        cls, peak: ArrayLike, duration: ArrayLike, inertia: ArrayLike, damping: ArrayLike, ratio: ArrayLike = 1.5
    ) -> RaisedSine:
        """With the first peak (*n) [N] of the force `inertia * ddq + damping * dq`: the dynamic task of Börner et al.
        2020 (40 N, 70 ms, 5 kg, 20 N s/m)."""
        # At x = w t the force of unit amplitude is mass sin(x/2)^2 + damping (x - sin x) / (2 w): d/dx = 0 where
        # tan(x/2) = -mass w / damping.
        mass, w = jnp.asarray(inertia), 4 * jnp.pi / jnp.asarray(duration)
        x = 2 * jnp.arctan2(mass * w, -jnp.asarray(damping))
        force = mass * jnp.sin(x / 2) ** 2 + damping / (2 * w) * (x - jnp.sin(x))
        return cls(jnp.asarray(peak) / force, duration, ratio)

    def __call__(self, t: Float[ArrayLike, "*t"]) -> Motion:
        half, ratio = jnp.asarray(self.duration, float) / 2, jnp.asarray(self.ratio, float)
        # The rest before, the four humps of the acceleration, the rest after; with what each of them begins with.
        lengths = half * jnp.array([1, 1, 1, ratio, ratio, 1])
        heights = jnp.array([0, 1, -1, -(ratio**-2), ratio**-2, 0])
        velocities = half * jnp.array([0, 0, 1 / 2, 0, -1 / (2 * ratio), 0])
        positions = half**2 * jnp.array([0, 0, 1 / 4, 1 / 2, 1 / 4, 0])
        piece, x = _locate(lengths[1:-1], jnp.asarray(t, float))
        w, height, velocity, position = (row[piece] for row in (2 * jnp.pi / lengths, heights, velocities, positions))
        hump = jnp.sin(w * x / 2) ** 2
        motion = (
            position + velocity * x + height * (x**2 / 4 - hump / w**2),
            velocity + height / 2 * (x - jnp.sin(w * x) / w),
            height * hump,
        )
        q, dq, ddq = (jnp.multiply.outer(values, jnp.asarray(self.amplitude)) for values in motion)
        return q, dq, ddq


def _with_least_jerk(states: Float[Array, "k 3 *n"], durations: Float[Array, "k-1"]) -> Float[Array, "k 3 *n"]:
    """The squared jerk is a quadratic form of all states: its minimum over velocities and accelerations, which have to
    be zero between the ends."""
    k, i = states.shape[0], np.arange(states.shape[0] - 1)
    cost = _SQUARED_JERK * durations[:, None, None] ** (_ORDERS[:, None] + _ORDERS - 5)
    form = jnp.zeros((k, 3, k, 3))
    for a in (0, 1):
        for b in (0, 1):
            form = form.at[i + a, :, i + b, :].add(cost[:, 3 * a : 3 * a + 3, 3 * b : 3 * b + 3])
    slope = jnp.tensordot(form[1:-1, 1:], states, 2)
    matrix = form[1:-1, 1:, 1:-1, 1:].reshape(2 * k - 4, 2 * k - 4)
    # Cholesky does not mind units: those of velocity and acceleration differ, durations may as well.
    step = jax.scipy.linalg.solve(matrix, slope.reshape(2 * k - 4, -1), assume_a="pos")
    return states.at[1:-1, 1:].add(-step.reshape(slope.shape))


def _piecewise_polynomial(
    pieces: Float[Array, "orders m *n"], end: Float[Array, "2 *n"], durations: Float[Array, " m"], t: Float[Array, "*t"]
) -> Motion:
    """Polynomials in the time since their beginning, one after the other from t = 0 on, between two straight lines: one
    up to the first polynomial, with its position and velocity there, and one from those of `end` on."""
    straight = jnp.zeros_like(pieces[:, :1])
    before, after = straight.at[:2, 0].set(pieces[:2, 0]), straight.at[:2, 0].set(end)
    index, x = _locate(durations, t)
    c = jnp.concatenate([before, pieces, after], axis=1)[:, index]
    x = x.reshape(t.shape + (1,) * (pieces.ndim - 2))
    position = velocity = half_acceleration = jnp.zeros_like(c[0])
    for coefficient in reversed(list(c)):  # Horner's scheme and its derivatives
        half_acceleration = half_acceleration * x + velocity
        velocity = velocity * x + position
        position = position * x + coefficient
    return position, velocity, 2 * half_acceleration


def _locate(durations: Float[Array, " m"], t: Float[Array, "*t"]) -> tuple[Array, Float[Array, "*t"]]:
    """Piece at each time, 0 before the first and m + 1 after the last, and the time since it began (piece 0: ends).

    A border belongs to the piece that begins there, but the last one to piece m: both ends are part of the motion.
    """
    borders = jnp.concatenate([jnp.zeros(1), jnp.cumsum(durations)])
    piece = jnp.sum(t[..., None] >= borders[:-1], axis=-1) + (t > borders[-1])
    return piece, t - borders[jnp.maximum(piece - 1, 0)]


def _require_positive(**values: Any) -> None:
    for name, value in values.items():
        known = not isinstance(value, jax.core.Tracer)
        if known and not np.all(np.isfinite(value) & (np.asarray(value) > 0)):
            raise ValueError(f"{name} is {np.asarray(value).tolist()}: it must be positive and finite")
