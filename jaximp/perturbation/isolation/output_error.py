"""Impedance of an arm in motion by output error: how the movement would have gone on is learned, not filtered.

Unperturbed trials teach how a movement continues after a given past; the deviation that an impedance makes of the
commanded force is simulated; and the impedance is found for which

    measured motion = predicted motion - simulated deviation,

weighted by what the prediction cannot know. (Deviations are unperturbed less perturbed.) The source of all of it is
this project. Everything is measured in bins of 5 ms, in which f is the past of a trial, 300 ms up to its onset (with
5 ms the error of K11 is four times as large), and g what follows in the window.

**Prior.** Over n unperturbed trials aligned at their onsets, z = [f, g] has mean m and covariance S. The same trials
aligned anew where they cross other lines, up to 100 ms before and 50 ms after, and the perturbed trials where they
cross a line a whole window before their onset, give more windows of the same kind: with C their mean covariance,

    V = (n S + N C) / (n + N),   N = 60,        B = V_ff^-1 V_fg,        mu(f) = m_g + B' (f - m_f).

Ten-fold residuals R (n, b) of that prediction say what it cannot know: `E = R'R/n`. The weight of the fit is the
inverse of `Sigma = (R'R + 10 c A) / (n + 10) + s^2 I` with A the covariance of g that V expects given f, c how much
larger the residuals are, and s at least `RESOLUTION`.

**Deviation.** With `E(q, q', q'')` the torque that moves arm and handle, from rest at the onset on, by Heun's method,

    E(q + dq, q' + dq', q'' + dq'') = E(q, q', q'') - J(q)' u(t - tau) - K(t) dq - D(t) dq',
    K(t) = K (1 + kappa u + bend_2 (6 u^2 - 1/2) + bend_3 (20 u^3 - 3 u)),  u = t / window - 1/2,

element by element, and D alike, with the same bends. All shapes have the mean zero, so that K is the mean over the
window. The data hardly tell the bends: what is known before does, that a course that changes more may bend more
(`BEND`). So they widen the intervals in fast movements, and cost nothing in slow ones.


The measured motion enters both sides, so that its noise cancels to first order. K is symmetric; the parameters are
theta = [D (4), K (3), kappa (7), bend (6), pi (3), tau], see `Theta`.

**Fit.** With `r_i = mu(f_i) - g_i - delta_i` and `S_i` the derivative of delta_i, exact, `W_i = (Sigma + A_i A_i')^-1`
where A_i lets every trial have an impedance of its own (`SPREAD`), P the inverse covariance of what is known before
and H = n Sigma^-1 + sum W_i (the mean of the prior has an error of its own, which is integrated out):

    Z_i = S_i' W_i - (sum S_j' W_j) H^-1 W_i,      G = sum Z_i S_i + P,
    theta <- theta + G^-1 (sum Z_i r_i + P (theta_0 - theta)).

**Covariance.** G^-1 would be the covariance if Sigma were that of the prediction's errors. It is not: s^2 I is no
noise but what the arithmetic may rely on, and most of G^-1. What the errors really do to theta follows from the
residuals R of trials that the prediction had not seen, with X_i = Z_i S_i less its mean over the group's trials:

    cov = G^-1 [ sum Z_i E Z_i' + (sum Z_i) E/n (sum Z_i)' + sum X_i diag(spread)^2 X_i' + P ] G^-1.

What a residual does is told by weights that come from the residuals of the other nine folds: weights prefer
directions in which the residuals that they are made of happen to be small, and these would look harmless there. (With
a position noise of 10 um, where all 46 directions of 120 residuals matter, chi2 would be 1.22 in place of 1.0.) The
covariance is multiplied by chi2 where that is above one. So the interval is about the mean impedance of the group's own
trials over the window. Groups of one experiment share prior and inertia: their errors are not independent.

**Limits.** All numbers of this project for it are from a simulation whose arm is the fitted model: rigid, linear in the
window, noise that ends steeply at 2 Hz, no soft tissue, no drift, no fatigue, and the commanded force is really
applied; it is integrated by the method and the step of the fit. There 95 % intervals hold the elements of K in 92 to
99 % of groups of 20 trials, in movements of 1 s and with a position noise of 10 um too. `chi2` tells timing,
calibration or noise level that are grossly wrong; that it is low proves nothing: a command 1 % too large biases D by
3 % and is not noticed.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer, Num
from numpy.typing import NDArray

from jaximp.models.arm import coriolis_matrix, mass_matrix, rigid_body_torque
from jaximp.models.inertia import BaseInertia, lakatos_from_borner
from jaximp.models.kinematics import ArmGeometry
from jaximp.numerics.precision import require_float64
from jaximp.perturbation.deviations import Deviations, KnownArm
from jaximp.perturbation.isolation.isolated import Impedance, Isolated, known_handle
from jaximp.perturbation.stiffness import symmetric_matrix
from jaximp.perturbation.trials import HISTORY, VOLUNTARY_DELAY, Handle, Trials
from jaximp.types import AnyArray, Numbers

BIN = 0.005
"""What positions are averaged over [s]."""
REALIGNED = (-0.1, -0.075, -0.05, -0.025, 0.025, 0.05)
"""Where unperturbed trials are aligned anew [s]: at the line where they are this long after the onset."""
REALIGNED_BEFORE = (0.0, -0.015)
"""Where perturbed trials are, from the line that all of them cross a window before the onset [s]."""
BORROWED = 60
"""N: how many trials the windows aligned anew are worth together."""
FOLDS = 10
FEWEST_UNPERTURBED = 5
"""Unperturbed, from which a mean and its residuals can be told."""
RESOLUTION = 3e-7
"""Least s [m]: the rounding of an encoder of 1 um. Smaller is better only in simulations."""
SMALLEST_NOISE = 1e-7
"""On the past of a trial [m]: keeps V_ff regular."""
SPREAD = (0.03, 0.06)
"""Of a single trial's elements of D and K around the mean, as a share of it, and of kappa. A choice; between a third
and twice of it nothing changes."""
TREND = (0.5, 0.15, 0.05)
"""Standard deviations of what kappa is made of: common to all elements, common to D_ij and K_ij (stiff muscles damp
more), and each element's own. A choice: a movement of 1 s changes K by -0.6, one of 3 s by -0.04."""
BEND, LEAST_CHANGE = 0.15, 0.1
"""Standard deviation of how far a course is from straight, at the window's ends, as a share of what its straight part
is there; and the least change over the window of which that is reckoned. A choice: in a movement of 1 s it is 0.11 for
K11, which without it would be 1.8 % too small, and less for others and in slower movements."""
USUAL_STDERR = (0.012, 0.025, 0.022)
"""Of the base inertial parameters from the static task, as a share of them."""
START = (2.0, 1.0, 1.0, 1.2, 20.0, 10.0, 12.0)
"""Where D [N m s/rad] and K [N m/rad] begin."""
ITERATIONS = 8
"""At most."""
SMALL_STEP = 0.05
"""In standard errors, of D and K: the iteration ends."""
DELAYS = 0.009
"""Largest delay of the motion after the command that can be found [s]. Motion that is ahead of its command has begun at
the onset, which the fit cannot know: up to 1 ms it does little harm, and more is a misfit."""
STEP = 1 / 4000
"""Of the integration, at most [s]: twice as long a one biases the deviation by 0.2 %."""
MISFIT = 1.5
"""chi2 above which a fit is not ok."""


class Theta(NamedTuple):
    """What the fit is over, by name; the linear algebra sees one vector, `flat`."""

    impedance: Any
    """(..., 7) elements of D and K, means over the window, in the order of `SYMMETRIC_ELEMENTS`."""
    kappa: Any
    """(..., 7) how much each of them changes over the window, as a share of its mean."""
    bend: Any
    """(..., 6) what makes the courses of the elements 11, 12 and 22 (D and K alike) no straight lines: a parabola for
    each, then a cubic, that are so large a share of the mean at the window's ends."""
    inertia: Any
    """(..., 3) base inertial parameters in Börner's order [kg m^2]."""
    delay: Any
    """(...) of the motion after the command [s]."""

    @classmethod
    def of(cls, flat: Any) -> Theta:
        """From a vector (..., 24)."""
        return cls(flat[..., :7], flat[..., 7:14], flat[..., 14:20], flat[..., 20:23], flat[..., 23])

    @property
    def flat(self) -> Numbers:
        """(24,)"""
        return np.concatenate([self.impedance, self.kappa, self.bend, self.inertia, [self.delay]])


PLACES = Theta.of(np.arange(24))
"""Where each parameter stands in the vector."""
OF_ELEMENT = np.array([0, 1, 1, 2, 0, 1, 2])
"""Which of 11, 12 and 22 the elements of D and of K are."""
VARYING = np.concatenate([PLACES.impedance, PLACES.kappa])
"""Of a trial's own, around the mean of all trials."""


def _matrices(impedance: Any) -> tuple[Any, Any]:
    """D and K (..., 2, 2) of their elements (..., 7)."""
    return impedance[..., :4].reshape(*impedance.shape[:-1], 2, 2), symmetric_matrix(impedance[..., 4:])


class OutputErrorFit(eqx.Module):
    """Impedance of groups of trials; one group has no leading axis."""

    D: Float[Any, "*G 2 2"]
    """Damping, mean over the window [N m s/rad]."""
    K: Float[Any, "*G 2 2"]
    """Stiffness likewise [N m/rad]."""
    kappa: Float[Any, "*G 7"]
    """How much the elements of D and K (`SYMMETRIC_ELEMENTS`) change over the window, as a share of their mean."""
    bend: Float[Any, "*G 6"]
    """How far the courses of D and K are from straight, see `Theta`."""
    inertia: Float[Any, "*G 3"]
    """Base inertial parameters in Börner's order, given and improved [kg m^2]."""
    delay: Float[Any, "*G"]
    """Of the motion after the command [s]."""
    covariance: Float[Any, "*G 24 24"]
    """Of the elements of D and K (`SYMMETRIC_ELEMENTS`), kappa, bend, inertia and delay, as they stand in `Theta`."""
    dof: Float[Any, "*G 24"]
    """Degrees of freedom for Student's t: how well the unperturbed trials tell the variance."""
    chi2: Float[Any, "*G"]
    """Weighted sum of squares of the residuals over what is expected of it: about 1, or less where trials differ less
    than `SPREAD` allows."""
    converged: Bool[Any, "*G"]
    """Whether the iteration came to rest, with a delay within its limits, and all is finite."""
    residual: Float[Any, "T B 2"]
    """Predicted less measured motion less deviation, bin by bin [m], for the parameters of all trials together."""
    deviations: Deviations
    """As simulated with the parameters of all trials together."""

    @property
    def ok(self) -> Any:
        """(*G,) whether it converged, and chi2 is at most `MISFIT`."""
        return np.asarray(self.converged) & (np.asarray(self.chi2) <= MISFIT)

    @property
    def stderr(self) -> Numbers:
        """(*G, 24) standard errors, in the order of `covariance`."""
        return np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1))

    def margin(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """Half widths (*G, 2, 2) of the intervals that hold the elements of D and those of K with probability `level`:
        the mean impedance of the group's trials."""
        from scipy.stats import t as student

        return _matrices(Theta.of(student.ppf(0.5 + level / 2, self.dof) * self.stderr).impedance)


def output_error(
    perturbed: Trials,
    unperturbed: Trials,
    geometry: ArmGeometry,
    handle: Handle,
    inertia: BaseInertia | Num[AnyArray, "3"],
    inertia_stderr: Num[AnyArray, "3"] | None = None,
    *,
    window: float = VOLUNTARY_DELAY,
    sensor_noise: float = 0.0,
    groups: Integer[AnyArray, "G m"] | None = None,
) -> OutputErrorFit:
    """Involuntary damping and stiffness of the arm from force-perturbed trials of a movement.

    **Arguments:** `perturbed` and `unperturbed` are different trials of one task, aligned at their onsets, where the
    hand crosses one line; a line across its mean velocity is taken. Used of them are position, velocity and
    acceleration in the window, position before it, and the command. `inertia`, a `BaseInertia`, or three base
    parameters **in Börner's order** (eq. (12)) [kg m^2], as the static task gives them, and their standard errors in
    the same order (by default `USUAL_STDERR`);
    `window` [s] in which nothing voluntary happens; `sensor_noise` standard deviation of a sample of the position [m];
    `groups` (G, m) indices of perturbed trials, each group with an estimate of its own; without, all trials are one.

    **Returns:** see `OutputErrorFit`. Groups are one step from what fits all trials, which an impedance that differs
    by tenths between groups does not notice.

    **Raises:** ValueError where float64 is off, and for shapes and rates that do not match, too few unperturbed
    trials, too little before an onset or after it, values that are not finite, and trials without a command.

    **Source:** this project; equations and limits in the docstring of the module.
    """
    require_float64(perturbed.position, unperturbed.position)
    bins = _Bins.of(perturbed.sample_rate, window)
    _check(perturbed, unperturbed, bins)
    known = _Known.of(inertia, inertia_stderr)
    chosen = _members(groups, len(perturbed))
    noise = float(sensor_noise) / np.sqrt(bins.width)
    try:
        prior = learn_continuation(unperturbed, perturbed, window, noise)
    except np.linalg.LinAlgError:
        raise ValueError(
            "the unperturbed trials have no covariance that makes sense: are some of them copies, or in other units?"
        ) from None
    lanes = _in_lanes(perturbed, geometry, handle, bins)
    past, measured = _flat(_binned(perturbed, bins.before, 0, bins)), _flat(_binned(perturbed, 0, bins.after, bins))
    target = prior.predict(past) - measured

    theta = known.start
    for _ in range(ITERATIONS):
        linear = _Linear.of(theta, target, lanes, geometry, handle, prior)
        usual = known.around(theta)
        step = linear.solve(np.arange(len(perturbed)), usual)
        theta = known.within(step.theta)
        moved, stderr = np.abs(theta - linear.theta), np.sqrt(np.diag(step.covariance))
        rest = bool((moved < SMALL_STEP * stderr)[PLACES.impedance].all())
        if rest:
            break
    steps = [linear.solve(members, usual) for members in chosen]
    found = _Step(*(np.stack(x) if groups is not None else np.asarray(x[0]) for x in zip(*steps, strict=True)))
    of_groups = Theta.of(found.theta)
    D, K = _matrices(of_groups.impedance)
    return OutputErrorFit(
        D=D,
        K=K,
        kappa=of_groups.kappa,
        bend=of_groups.bend,
        inertia=of_groups.inertia,
        delay=of_groups.delay,
        covariance=found.covariance,
        dof=found.dof,
        chi2=found.chi2,
        converged=np.isfinite(found.theta).all(axis=-1) & rest & (np.abs(of_groups.delay) < DELAYS),
        residual=linear.r.reshape(len(perturbed), -1, 2),
        deviations=_full_rate(jnp.asarray(theta), lanes, geometry, handle, perturbed),
    )


def learned_continuation(
    perturbed: Trials,
    unperturbed: Trials | None,
    arm: KnownArm,
    window: float = VOLUNTARY_DELAY,
    groups: Integer[AnyArray, "G m"] | None = None,
) -> Isolated:
    """The unperturbed movement is how unperturbed trials teach that this one goes on, the deviation is simulated, and
    the impedance is that for which both meet the measured movement: `output_error`.

    **Arguments:** `groups` (G, m) indices of the perturbed trials of each estimate; without it, one of all of them.

    **Raises:** `ValueError` without unperturbed trials, and as `output_error`.
    """
    if unperturbed is None:
        raise ValueError(
            "output error learns from unperturbed trials how the movement goes on, and there are none: record some "
            "(30 or more), or use gomi_kawato"
        )
    fit = output_error(
        perturbed, unperturbed, arm.geometry, known_handle(arm), arm.inertia, arm.inertia_stderr,
        window=window, groups=groups,
    )  # fmt: skip
    at = PLACES.impedance
    of_both, dof = fit.covariance[..., at[:, None], at], fit.dof[..., at].min(axis=-1)
    found = (fit.D, fit.K, of_both, fit.inertia, dof, fit.chi2, fit.converged, fit.delay, fit.kappa[..., 4:])
    return Isolated(fit.deviations, impedance=Impedance(*map(jnp.asarray, found)))


# How a movement goes on.


class _Bins(NamedTuple):
    """How samples become bins."""

    width: int
    """Samples in one."""
    before: int
    """The first one, counted from the onset."""
    after: int
    """How many are in the window."""

    @classmethod
    def of(cls, rate: float, window: float) -> _Bins:
        width = max(1, round(BIN * rate))
        bins = cls(width, -round(HISTORY * rate / width), int(window * rate / width + 1e-9))
        if bins.after < 4:
            raise ValueError(f"a window of {window:g} s has {bins.after} bins of {BIN:g} s: it must have at least 4")
        return bins


class Continuation(NamedTuple):
    """What unperturbed trials say of the b bins after the onset (both axes) from the a before it; all in metres."""

    before: Numbers
    """(a,) mean."""
    after: Numbers
    """(b,) mean."""
    B: Numbers
    """(a, b) what a change before the onset does after it."""
    residuals: Numbers
    """(n, b) of unperturbed trials that the prediction had not seen."""
    weight: Numbers
    """(b, b) triangle L with `L L' = Sigma`."""
    folds: tuple[tuple[NDArray[np.bool_], Numbers], ...]
    """For each fold, which (n,) trials it has, and the triangle from the residuals of all others."""

    def predict(self, past: Float[np.ndarray, "T a"]) -> Numbers:
        """(T, b) mu."""
        return self.after + (past - self.before) @ self.B


def learn_continuation(
    unperturbed: Trials, perturbed: Trials, window: float = VOLUNTARY_DELAY, noise: float = 0.0
) -> Continuation:
    """How a movement goes on after its onset, from unperturbed trials and from what precedes the perturbation.

    **Arguments:** as in `output_error`; `noise` standard deviation of a bin [m].

    **Source:** this project; see the docstring of the module (**Prior**).
    """
    bins = _Bins.of(unperturbed.sample_rate, window)
    z = _flat(_binned(unperturbed, bins.before, bins.after, bins))
    n, a, s = len(z), -2 * bins.before, max(RESOLUTION, noise)
    own, shared = _realigned(unperturbed, perturbed, bins)
    ridge = max(SMALLEST_NOISE, noise) ** 2 * np.eye(a)

    def fit(kept: np.ndarray) -> tuple[Numbers, Numbers, Numbers]:
        x, more = z[kept], [w[kept] for w in own] + shared
        x, more = x - x.mean(axis=0), [w - w.mean(axis=0) for w in more]
        C = sum(w.T @ w for w in more) / sum(len(w) - 1 for w in more) if more else 0.0
        share = len(x) if more else len(x) + BORROWED
        V = (share * x.T @ x / (len(x) - 1) + BORROWED * C) / (len(x) + BORROWED)
        B = np.linalg.solve(V[:a, :a] + ridge, V[:a, a:])
        return z[kept].mean(axis=0), B, V[a:, a:] - V[a:, :a] @ B

    R, c, folds, expected = np.empty((n, z.shape[1] - a)), np.empty(n), [], []
    for k in range(min(FOLDS, n)):
        out = np.arange(n) % min(FOLDS, n) == k
        mean, B, A = fit(~out)
        folds.append(out)
        expected.append(A)
        R[out] = z[out, a:] - mean[a:] - (z[out, :a] - mean[:a]) @ B
        c[out] = (R[out] * np.linalg.solve(A + s**2 * np.eye(len(A)), R[out].T).T).mean(axis=1)

    def weight(known: NDArray[np.bool_], A: Numbers) -> Numbers:
        """From the residuals of the trials that are `known`."""
        squares = R[known].T @ R[known] + 10 * c[known].mean() * (A + A.T) / 2
        return np.linalg.cholesky(squares / (known.sum() + 10) + s**2 * np.eye(len(A)))

    mean, B, A = fit(np.ones(n, bool))
    without = tuple((out, weight(~out, own)) for out, own in zip(folds, expected, strict=True))
    return Continuation(mean[:a], mean[a:], B, R, weight(np.ones(n, bool), A), without)


def _realigned(unperturbed: Trials, perturbed: Trials, bins: _Bins) -> tuple[list[Numbers], list[Numbers]]:
    """Windows of the same kind at other places of the movement: lists of (n, a + b) and of (T, a + b)."""
    rate, first = unperturbed.sample_rate, np.asarray(unperturbed.onset)
    along = np.asarray(unperturbed.velocity)[np.arange(len(first)), first].mean(axis=0)
    along = along / np.linalg.norm(along)

    def at_lines(movements: Trials, shift: int, offsets: tuple[float, ...], last: int) -> list[Numbers]:
        """Of the offsets that leave room within every trial, of which samples count up to `onset + last`."""
        distance, onset = np.asarray(movements.position) @ along, np.asarray(movements.onset)
        found = []
        for offset in offsets:
            at = onset + shift + round(offset * rate)
            if (at < 0).any() or (at >= distance.shape[1]).any():
                continue
            reached = distance[np.arange(len(at)), at]
            beyond = distance >= (reached.min() if shift else reached.mean())
            cross = np.where(beyond.any(axis=1), beyond.argmax(axis=1), -1)
            enough = cross + 1 + bins.before * bins.width >= 0
            if (enough & (cross + bins.after * bins.width <= np.minimum(onset + last, distance.shape[1] - 1))).all():
                found.append(_flat(_binned(movements, bins.before, bins.after, bins, cross)))
        return found

    after = bins.after * bins.width
    everything = unperturbed.position.shape[1]
    return at_lines(unperturbed, 0, REALIGNED, everything), at_lines(perturbed, -after, REALIGNED_BEFORE, 0)


def _binned(movements: Trials, first: int, last: int, bins: _Bins, onset: np.ndarray | None = None) -> Numbers:
    """(T, last - first, 2) mean positions; the bin 0 begins one sample after the onset."""
    onset = np.asarray(movements.onset) if onset is None else onset
    samples = onset[:, None] + 1 + np.arange(first * bins.width, last * bins.width)
    x = np.asarray(movements.position)[np.arange(len(samples))[:, None], samples]
    return x.reshape(len(x), last - first, bins.width, 2).mean(axis=2)


def _flat(x: Numbers) -> Numbers:
    return x.reshape(len(x), -1)


# The deviation. Trials are the last axis of every array, so that a processor works on several in one instruction.


class _Lanes(eqx.Module):
    """The perturbed motion in the window, from the onset on, at a step of at most `STEP`."""

    q: Float[Array, "S 2 T"]
    """[rad]"""
    dq: Float[Array, "S 2 T"]
    """[rad/s]"""
    ddq: Float[Array, "S 2 T"]
    """[rad/s^2]"""
    carried: Float[Array, "S 2 T"]
    """Torque that the handle's own mass and damping take [N m]."""
    command: Float[Array, "S_and_delays 2 T"]
    """[N], from a little more than `DELAYS` before to as long after."""
    rate: float = eqx.field(static=True)
    """[Hz]"""
    finer: int = eqx.field(static=True)
    """Steps in a sample."""
    width: int = eqx.field(static=True)
    """Samples in a bin."""


def _in_lanes(perturbed: Trials, geometry: ArmGeometry, handle: Handle, bins: _Bins) -> _Lanes:
    rate, onset = perturbed.sample_rate, np.asarray(perturbed.onset)
    finer = int(np.ceil(1 / (rate * STEP) - 1e-9))
    room = int(np.ceil((DELAYS + 0.001) * rate - 1e-9))

    def cut(x: Any, first: int, last: int) -> Numbers:
        """(S, 2, T), with new samples between the old by a cubic spline."""
        from scipy.interpolate import CubicSpline

        x = np.asarray(x)
        samples = np.clip(onset[:, None] + np.arange(first, last + 1), 0, x.shape[1] - 1)
        x = np.moveaxis(x[np.arange(len(x))[:, None], samples], 0, -1)
        if finer == 1:
            return x
        at = np.arange(len(x))
        return CubicSpline(at, x)(np.arange((len(x) - 1) * finer + 1) / finer)

    end = bins.after * bins.width
    motion = [_last(cut(x, 0, end)) for x in (perturbed.position, perturbed.velocity, perturbed.acceleration)]
    q, dq, ddq = geometry.joint_motion(*motion)
    carried = geometry.joint_torque(q, -handle.force(jnp.zeros_like(q), *motion[1:]))
    q, dq, ddq, carried = (jnp.moveaxis(x, -1, 1) for x in (q, dq, ddq, carried))
    command = jnp.asarray(cut(perturbed.command, -room, end + room))
    return _Lanes(q, dq, ddq, carried, command, rate * finer, finer, bins.width)


def _last(x: Any) -> Array:
    """(S, 2, T) -> (S, T, 2)"""
    return jnp.moveaxis(x, 1, -1)


def _delayed(command: Array, samples: int, delay: Array) -> Array:
    """(S, 2, T) of the command, so many steps late."""
    room = (len(command) - samples) // 2
    at = jnp.clip(room - delay, 0, 2 * room)
    whole = jnp.clip(jnp.floor(jax.lax.stop_gradient(at)).astype(int), 0, 2 * room - 1)
    early = jax.lax.dynamic_slice_in_dim(command, whole, samples)
    return early + (at - whole) * (jax.lax.dynamic_slice_in_dim(command, whole + 1, samples) - early)


def _deviation(
    flat: Float[Array, "24"], lanes: _Lanes, geometry: ArmGeometry, handle: Handle
) -> tuple[Array, Array, Array]:
    """(S, 2, T) deviations of the joints' angles [rad], their velocities and accelerations; zero at the onset."""
    samples, h, theta = len(lanes.q), 1 / lanes.rate, Theta.of(flat)
    xi, carried = lakatos_from_borner(theta.inertia), handle.mass + handle.own_mass
    pushed = geometry.joint_torque(_last(lanes.q), _last(_delayed(lanes.command, samples, theta.delay * lanes.rate)))
    body = rigid_body_torque(_last(lanes.q), _last(lanes.dq), _last(lanes.ddq), xi)
    drive = jnp.moveaxis(body - pushed, -1, 1) + lanes.carried
    u = jnp.arange(samples) / (samples - 1) - 0.5
    parabola, cubic = (
        jnp.outer(shape, part[OF_ELEMENT])
        for shape, part in zip((6 * u**2 - 0.5, 20 * u**3 - 3 * u), (theta.bend[:3], theta.bend[3:]), strict=True)
    )
    course = 1 + jnp.outer(u, theta.kappa) + parabola + cubic
    impedance = course * theta.impedance

    def acceleration(away: Array, slip: Array, at: tuple[Array, ...]) -> Array:
        q, dq, ddq, drive, p = at
        angles, rates = jnp.moveaxis(q + away, 0, -1), jnp.moveaxis(dq + slip, 0, -1)
        J, M, C = geometry.jacobian(angles), mass_matrix(angles, xi), coriolis_matrix(angles, rates, xi)
        _, v, bend = geometry.hand_motion(angles, rates, jnp.zeros_like(rates))
        held = carried * bend + handle.damping * v
        # Sums of two written out, as a reduction over so short an axis costs more than all the rest.
        left = [
            drive[i]
            - sum(p[2 * i + j] * slip[j] + p[4 + i + j] * away[j] + C[..., i, j] * rates[..., j] for j in (0, 1))
            - sum(J[..., k, i] * held[..., k] for k in (0, 1))
            for i in (0, 1)
        ]
        (a, b), (_, d) = (
            [M[..., i, j] + sum(carried[k] * J[..., k, i] * J[..., k, j] for k in (0, 1)) for j in (0, 1)]
            for i in (0, 1)
        )
        return jnp.stack([d * left[0] - b * left[1], a * left[1] - b * left[0]]) / (a * d - b * b) - ddq

    def step(state: tuple[Array, Array], x: Any) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        (away, slip), (now, then) = state, x
        first = acceleration(away, slip, now)
        velocity = slip + h * first
        second = acceleration(away + h * slip, velocity, then)
        return (away + h / 2 * (slip + velocity), slip + h / 2 * (first + second)), (away, slip, first)

    series = (lanes.q, lanes.dq, lanes.ddq, drive, impedance)
    then = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), series)
    at_rest = jnp.zeros_like(lanes.q[0])
    return jax.lax.scan(step, (at_rest, at_rest), (series, then))[1]


def _deviation_in_bins(theta: Array, lanes: _Lanes, geometry: ArmGeometry, handle: Handle) -> Float[Array, "T b"]:
    """delta: of the hand [m], bin by bin and axis by axis."""
    away, _, _ = _deviation(theta, lanes, geometry, handle)
    away, q = (_last(x[lanes.finer :: lanes.finer]) for x in (away, lanes.q))
    x = geometry.forward(q + away) - geometry.forward(q)
    x = x.reshape(-1, lanes.width, *x.shape[1:]).mean(axis=1)
    return jnp.moveaxis(x, 1, 0).reshape(x.shape[1], -1)


@eqx.filter_jit
def _linearised(theta: Array, lanes: _Lanes, geometry: ArmGeometry, handle: Handle) -> tuple[Array, Array]:
    """delta (T, b) and its derivative (T, b, 24)."""

    def delta(theta: Array) -> Array:
        return _deviation_in_bins(theta, lanes, geometry, handle)

    return delta(theta), jax.jacfwd(delta)(theta)


@eqx.filter_jit
def _full_rate(theta: Array, lanes: _Lanes, geometry: ArmGeometry, handle: Handle, perturbed: Trials) -> Deviations:
    """At the rate of the measurement."""
    change = _deviation(theta, lanes, geometry, handle)
    measured = [_last(x[:: lanes.finer]) for x in (lanes.q, lanes.dq, lanes.ddq)]
    without = [q + _last(x[:: lanes.finer]) for q, x in zip(measured, change, strict=True)]
    (x, v, a), (x0, v0, a0) = geometry.hand_motion(*measured), geometry.hand_motion(*without)
    samples = len(x)
    force = jax.vmap(lambda u, k: jax.lax.dynamic_slice_in_dim(u, k, samples), out_axes=1)(
        perturbed.force, jnp.asarray(perturbed.onset)
    )
    free = handle.force(jnp.zeros_like(v0), v0, a0)
    return Deviations(*(jnp.moveaxis(d, 1, 0) for d in (x0 - x, v0 - v, a0 - a, free - force)))


# The fit. Small matrices by numpy: one at a time, and never inside compiled code.


class _Known(NamedTuple):
    """What is known before."""

    start: Numbers
    """(24,) theta_0"""
    P: Numbers
    """Inverse of its covariance; none of D, K and the delay."""

    @classmethod
    def of(cls, inertia: BaseInertia | AnyArray, stderr: AnyArray | None) -> _Known:
        pi = np.asarray(inertia.borner if isinstance(inertia, BaseInertia) else inertia, float)
        sd = np.multiply(USUAL_STDERR, pi) if stderr is None else np.asarray(stderr, float)
        for name, x in (("inertia", pi), ("inertia_stderr", sd)):
            if x.shape != (3,) or not (np.isfinite(x) & (x > 0)).all():
                raise ValueError(
                    f"{name} is {np.array2string(x)}: it must be three finite numbers above zero [kg m^2], the base "
                    "parameters I_1 + m_2 l1^2, I_2, m_2 c_2 l1"
                )
        common, pair, own = TREND
        trend = common**2 + pair**2 * (OF_ELEMENT[:, None] == OF_ELEMENT) + own**2 * np.eye(7)
        P, kappa, at = np.zeros((24, 24)), PLACES.kappa, PLACES.inertia
        P[np.ix_(kappa, kappa)], P[at, at] = np.linalg.inv(trend), sd**-2.0
        return cls(Theta(START, np.zeros(7), np.zeros(6), pi, 0.0).flat, P)

    def around(self, theta: Numbers) -> _Known:
        """The same for courses that change as much as theta says: what changes more also bends more."""
        change = np.abs(Theta.of(theta).kappa[4:])
        P = self.P.copy()
        P[PLACES.bend, PLACES.bend] = np.tile(BEND * np.maximum(change, LEAST_CHANGE) / 2, 2) ** -2.0
        return self._replace(P=P)

    def within(self, theta: Numbers) -> Numbers:
        """Where the arm can be simulated: trials that no impedance explains lead the iteration anywhere."""
        start, kappa, bend = Theta.of(self.start), np.full(7, 2.0), np.ones(6)
        low = Theta(-10 * start.impedance, -kappa, -bend, start.inertia / 2, -DELAYS)
        high = Theta(10 * start.impedance, kappa, bend, 2 * start.inertia, DELAYS)
        return np.clip(theta, low.flat, high.flat)


class _Step(NamedTuple):
    """Of Gauss and Newton, for one group."""

    theta: Numbers
    covariance: Numbers
    dof: Numbers
    chi2: Any


class _Toward(NamedTuple):
    """How a group's residuals move its estimate."""

    Z: Numbers
    """(T, p, b)"""
    X: Numbers
    """(T, p, p)"""
    inverse: Numbers
    """(p, p)"""


class _Weighed(NamedTuple):
    """The problem around theta, with bins divided by L: there Sigma is one."""

    white: Numbers
    """(T, b) residuals."""
    S: Numbers
    """(T, b, 24)"""
    W: Numbers
    """(T, b, b)"""
    spread: Numbers
    """(24,) standard deviation of a trial's own parameters."""
    unseen: Numbers
    """(m, b) residuals of the prior, of trials that L does not know: L makes those that it knows too small."""

    @classmethod
    def of(cls, r: Numbers, S: Numbers, spread: Numbers, unseen: Numbers, L: Numbers) -> _Weighed:
        whiten = np.linalg.inv(L)
        S = whiten @ S
        A = (S * spread)[..., VARYING]
        inner = np.eye(len(VARYING)) + A.swapaxes(1, 2) @ A
        W = np.eye(S.shape[1]) - A @ np.linalg.solve(inner, A.swapaxes(1, 2))
        return cls(r @ whiten.T, S, W, spread, unseen @ whiten.T)

    def toward(self, members: np.ndarray, n: int, known: _Known) -> _Toward:
        """For the trials `members`, with a prior from n."""
        S, W = self.S[members], self.W[members]
        WS = W @ S
        common = np.linalg.solve(n * np.eye(W.shape[1]) + W.sum(axis=0), WS.sum(axis=0))
        Z = WS.swapaxes(1, 2) - common.T @ W
        X = Z @ S
        return _Toward(Z, X, np.linalg.inv(X.sum(axis=0) + known.P))

    def expected(self, members: np.ndarray, to: _Toward) -> float:
        """Of the weighted sum of squares, less what the fit takes of it."""
        own = self.S[members] * self.spread
        errors = self.unseen.T @ self.unseen / len(self.unseen) + own @ own.swapaxes(1, 2)
        taken = (to.inverse * (to.Z @ errors @ to.Z.swapaxes(1, 2)).sum(axis=0)).sum()
        return float((self.W[members] * errors).sum() - taken)


class _Linear(NamedTuple):
    """The problem around theta."""

    theta: Numbers
    r: Numbers
    """(T, b) residuals [m]."""
    weighed: _Weighed
    """By the residuals of all unperturbed trials."""
    folds: tuple[_Weighed, ...]
    """By those of all but one fold, with those of the fold to tell what they do."""

    @classmethod
    def of(
        cls, theta: Numbers, target: Numbers, lanes: _Lanes, geometry: ArmGeometry, handle: Handle, prior: Continuation
    ) -> _Linear:
        delta, S = map(np.asarray, _linearised(jnp.asarray(theta), lanes, geometry, handle))
        r, impedance = target - delta, np.abs(Theta.of(theta).impedance)
        spread = Theta(SPREAD[0] * impedance, np.full(7, SPREAD[1]), np.zeros(6), np.zeros(3), 0.0).flat
        weighed = _Weighed.of(r, S, spread, prior.residuals[:0], prior.weight)
        folds = (_Weighed.of(r, S, spread, prior.residuals[out], L) for out, L in prior.folds)
        return cls(theta, r, weighed, tuple(folds))

    def solve(self, members: np.ndarray, known: _Known) -> _Step:
        """One step for the trials `members`, and what judges it."""
        n = sum(len(fold.unseen) for fold in self.folds)
        Z, X, inverse = self.weighed.toward(members, n, known)
        right = np.einsum("tpb,tb->p", Z, self.weighed.white[members])
        step = inverse @ (right + known.P @ (known.start - self.theta))

        folds = [(fold, fold.toward(members, n, known)) for fold in self.folds]
        of_unseen = np.concatenate([f.unseen @ (to.inverse @ to.Z).swapaxes(1, 2) for f, to in folds], axis=1)
        # What every unperturbed trial adds to the variance: of all trials' own errors, and of the mean's.
        added = (of_unseen**2).sum(axis=0)
        of_mean = of_unseen.sum(axis=0) / n
        apart = inverse @ ((X - X.mean(axis=0)) * self.weighed.spread)
        covariance = (
            (of_unseen.swapaxes(1, 2) @ of_unseen).sum(axis=0) / n
            + of_mean.T @ of_mean
            + (apart @ apart.swapaxes(1, 2)).sum(axis=0)
            + inverse @ known.P @ inverse
        )
        dof = 2 * n * np.diag(covariance) ** 2 / np.maximum(added.var(axis=0), 1e-300)
        left = self.weighed.white[members] - self.weighed.S[members] @ step
        squares = np.einsum("ti,tij,tj->", left, self.weighed.W[members], left)
        chi2 = squares / (sum(len(fold.unseen) * fold.expected(members, to) for fold, to in folds) / n)
        return _Step(self.theta + step, covariance * max(1.0, chi2), dof, np.asarray(chi2))


# What can be wrong with the trials.


def _members(groups: AnyArray | None, trials: int) -> list[np.ndarray]:
    if groups is None:
        return [np.arange(trials)]
    chosen = np.asarray(groups)
    if chosen.ndim != 2 or not np.issubdtype(chosen.dtype, np.integer) or chosen.size == 0:
        raise ValueError(
            f"groups is an array of {chosen.dtype} of shape {chosen.shape}: it must hold indices of perturbed trials, "
            "one row for each group"
        )
    if chosen.min() < 0 or chosen.max() >= trials:
        raise ValueError(f"groups name trials {chosen.min()} to {chosen.max()}, and there are trials 0 to {trials - 1}")
    return list(chosen)


def _check(perturbed: Trials, unperturbed: Trials, bins: _Bins) -> None:
    if perturbed.sample_rate != unperturbed.sample_rate:
        raise ValueError(
            f"perturbed trials have {perturbed.sample_rate:g} samples a second and unperturbed ones "
            f"{unperturbed.sample_rate:g}: bring them to one rate"
        )
    for name, movements in (("perturbed", perturbed), ("unperturbed", unperturbed)):
        _check_shapes(name, movements)
        _check_room(name, movements, bins)
    if len(unperturbed) < FEWEST_UNPERTURBED:
        raise ValueError(
            f"{len(unperturbed)} unperturbed trials cannot tell how a movement goes on: at least "
            f"{FEWEST_UNPERTURBED} are needed, and 30 or more are much better"
        )
    still = np.flatnonzero(~_in_use(perturbed, bins, perturbed.command).any(axis=(1, 2)))
    if still.size:
        raise ValueError(
            f"perturbed trial {still[0]} has no command in its window: leave it out, or pass it as an unperturbed one"
        )


def _check_shapes(name: str, movements: Trials) -> None:
    shape = np.shape(movements.position)
    others = [np.shape(x) for x in (movements.velocity, movements.acceleration, movements.force, movements.command)]
    if len(shape) != 3 or shape[-1] != 2 or set(others) != {shape} or np.shape(movements.onset) != shape[:1]:
        raise ValueError(
            f"{name} trials have positions of shape {shape}, other signals of {sorted(set(others))} and onsets of "
            f"{np.shape(movements.onset)}: all signals must be (trials, samples, 2), and onsets (trials,)"
        )


def _check_room(name: str, movements: Trials, bins: _Bins) -> None:
    onset, rate, N = np.asarray(movements.onset), movements.sample_rate, np.shape(movements.position)[1]
    before, after = -bins.before * bins.width, bins.after * bins.width
    early, late = np.flatnonzero(onset + 1 < before), np.flatnonzero(onset + after >= N)
    if early.size:
        raise ValueError(
            f"{name} trial {early[0]} has {(onset[early[0]] + 1) / rate:g} s before its onset, and {HISTORY:g} s are "
            "needed: record from earlier on, or leave it out"
        )
    if late.size:
        raise ValueError(
            f"{name} trial {late[0]} ends {(N - 1 - onset[late[0]]) / rate:g} s after its onset, before the window of "
            f"{after / rate:g} s does: shorten the window, or leave it out"
        )
    for signal in ("position", "velocity", "acceleration", "command"):
        wrong = np.flatnonzero(~np.isfinite(_in_use(movements, bins, getattr(movements, signal))).all(axis=(1, 2)))
        if wrong.size:
            raise ValueError(
                f"the {signal} of {name} trial {wrong[0]} is not finite near its onset: fill the gap, or leave it out"
            )


def _in_use(movements: Trials, bins: _Bins, x: AnyArray) -> np.ndarray:
    """(T, samples, 2) of a signal, from the history to the end of the window."""
    samples = np.arange(bins.before * bins.width, bins.after * bins.width) + 1
    return np.asarray(x)[np.arange(len(movements))[:, None], np.asarray(movements.onset)[:, None] + samples]
