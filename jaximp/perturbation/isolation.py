"""What a perturbation added to a movement: isolation of the deviation from the movement that would have been.

A method takes perturbed trials, unperturbed ones where it needs them, and what is known of arm and handle; it returns
the deviations, `unperturbed - perturbed` throughout, and the impedance with its covariance where the method estimates
that itself. A new method is one function and one row of `METHODS`.

Deviations become impedance in `joint_deviations`, whose rows `torque = D velocity + K displacement` are those of
`stiffness.fit_stiffness`: eqs. (19) to (23), (37), (38) of Börner et al. 2020.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Integer, Num

from jaximp.models.arm import PlanarArm, borner_from_lakatos, lakatos_from_borner, rigid_body_torque
from jaximp.models.kinematics import ArmGeometry
from jaximp.motion.trajectories import array_field
from jaximp.numerics.lanes import solve_definite
from jaximp.perturbation.movements import VOLUNTARY_DELAY, Deviations, Handle, Movements, cut_at_onset
from jaximp.perturbation.output_error import output_error
from jaximp.signals.derivatives import central_differences
from jaximp.signals.filters import butterworth, filter_zero_phase
from jaximp.types import AnyArray, Numbers

FILTER_ORDER = 10
LOWEST_CUTOFF = 0.5
"""Below it the spectra are those of the movement and its surroundings [Hz]. A choice."""
HIGHEST_CUTOFF = 50.0
"""Where the search for a cut-off ends [Hz]."""
RESOLUTION = 0.02
"""Of the spectra [Hz]."""


class KnownArm(eqx.Module):
    """What is known before the perturbed movements are looked at."""

    geometry: ArmGeometry
    inertia: Float[Any, "3"] = array_field()
    """Base inertial parameters of eq. (12) [kg m^2]: those of `static_inertia`, or from anatomy."""
    handle: Handle | None = None
    """Of the robot: output error and feedback jerk isolation must know what it does."""
    inertia_stderr: Float[Any, "3"] | None = None
    """Their standard errors [kg m^2], where a method can use them."""

    def with_inertia(self, inertia: Num[AnyArray, "3"]) -> KnownArm:
        return KnownArm(self.geometry, inertia, self.handle, self.inertia_stderr)

    @property
    def xi(self) -> Array:
        """Base inertial parameters in the order of Lakatos et al. 2011 [kg m^2]."""
        return lakatos_from_borner(jnp.asarray(self.inertia))


class Impedance(eqx.Module):
    """Damping and stiffness of the joints, from a method that estimates them itself; of groups of trials, if asked."""

    D: Float[Array, "*G 2 2"]
    """[N m s/rad]"""
    K: Float[Array, "*G 2 2"]
    """Symmetric [N m/rad]."""
    covariance: Float[Array, "*G 7 7"]
    """Of D11, D12, D21, D22, K11, K12, K22."""
    inertia: Float[Array, "*G 3"]
    """Base inertial parameters of eq. (12), as the method improves them [kg m^2]."""
    dof: Float[Array, "*G"]
    """Degrees of freedom: a quantile of Student's t with so many makes the intervals."""
    misfit: Float[Array, "*G"]
    """Mean square of the residuals over what was expected: far above one, something is wrong."""
    converged: Bool[Array, "*G"]
    """Whether the iteration came to rest within its limits."""
    delay: Float[Array, "*G"]
    """Of the motion after the command [s]."""
    trend: Float[Array, "*G 3"]
    """How much K11, K12, K22 change over the window, as a share of their middle."""


class Isolated(eqx.Module):
    """What a method makes of the trials."""

    deviations: Deviations
    cutoff: Numbers | None = None
    """(2,) cut-off frequencies of the high-pass [Hz], where there was one."""
    impedance: Impedance | None = None
    """Where the method estimates it."""


@eqx.filter_jit
def in_window(movements: Movements, samples: int) -> Movements:
    """The `samples` from each onset on, of which it is the first."""

    signals = (movements.position, movements.velocity, movements.acceleration, movements.force, movements.command)
    x, v, a, force, command = (cut_at_onset(x, movements.onset, samples) for x in signals)
    return Movements(x, v, a, force, command, jnp.zeros_like(movements.onset), movements.sample_rate)


@jax.jit
def jerk(movements: Movements) -> Float[Array, "T N 2"]:
    """Derivative of the acceleration [m/s^3] by central differences."""
    return jax.vmap(lambda a: central_differences(a, movements.sample_rate)[0])(movements.acceleration)


def energy_spectra(perturbed: Movements, unperturbed: Movements) -> tuple[Numbers, Numbers, Numbers]:
    """Mean energy spectral densities of the jerk, eq. (24), with the feedback's as what perturbed trials have more.

    **Returns:** frequencies (F,) up to 50 Hz, and densities (F, 2) of unperturbed and perturbed trials [m^2/s^4].
    """
    from scipy.fft import next_fast_len

    rate = perturbed.sample_rate
    # Means of short blocks say all that there is to say of frequencies so low.
    block = max(1, int(rate / (8 * HIGHEST_CUTOFF)))
    n = next_fast_len(round(rate / block / RESOLUTION), real=True)
    frequency = np.fft.rfftfreq(n, block / rate)
    spectra = []
    for movements in (unperturbed, perturbed):
        x = np.swapaxes(jerk(movements), 1, 2)
        x = x[..., : x.shape[-1] // block * block].reshape(len(x), 2, -1, block).mean(axis=-1)
        density = np.abs(np.fft.rfft(x, n) * block / rate) ** 2
        spectra.append(density.mean(axis=0).T[frequency <= HIGHEST_CUTOFF])
    return np.asarray(frequency[frequency <= HIGHEST_CUTOFF], float), spectra[0], spectra[1]


def cutoff_frequencies(perturbed: Movements, unperturbed: Movements) -> Numbers:
    """(2,) first frequency [Hz] at which the feedback's jerk has more energy than that of unperturbed trials: 2.2.1.

    **Raises:** `ValueError` where it never has: the perturbation is too small, or the trials are not of one task.
    """
    frequency, without, with_it = energy_spectra(perturbed, unperturbed)
    above = (with_it - without > without) & (frequency >= LOWEST_CUTOFF)[:, None]
    if not above.any(axis=0).all():
        raise ValueError(
            "perturbed movements have no more jerk than unperturbed ones at any frequency up to "
            f"{HIGHEST_CUTOFF:g} Hz: the perturbation is too small, or the trials are not of the same task"
        )
    return frequency[above.argmax(axis=0)]


def feedback_jerk_isolation(
    perturbed: Movements,
    unperturbed: Movements | None,
    arm: KnownArm,
    window: float = VOLUNTARY_DELAY,
    cutoff: Num[AnyArray, "2"] | None = None,
) -> Isolated:
    """The deviation's jerk is what a high-pass without phase leaves of the jerk of the perturbed trial.

    It is integrated three times, from the onset on and from zero there. The unperturbed force is that of the handle
    on the unperturbed movement.

    **Arguments:** `cutoff` (2,) of the high-pass along both axes [Hz]; without it that of `cutoff_frequencies`, for
    which unperturbed trials are needed.

    **Raises:** `ValueError` without unperturbed trials and without a cut-off, and as `cutoff_frequencies`.

    **Source:** Börner et al. 2020, 2.2.1, figure 3.
    """
    handle = _known_handle(arm)
    if cutoff is None:
        if unperturbed is None:
            raise ValueError(
                "feedback jerk isolation finds its cut-off frequency from unperturbed trials, and there are none: "
                "give two cut-off frequencies, cutoff = [f1, f2] in Hz, such as [1.9, 2.2], or use another method"
            )
        cutoff = cutoff_frequencies(perturbed, unperturbed)
    cutoff = np.broadcast_to(np.asarray(cutoff, float), 2)
    of_all = jerk(perturbed)
    high = [
        filter_zero_phase(butterworth(FILTER_ORDER, float(f), perturbed.sample_rate, "highpass"), of_all[..., axis].T).T
        for axis, f in enumerate(cutoff)
    ]
    samples = _samples(perturbed, window)
    return Isolated(_integrated(perturbed, jnp.stack(high, axis=-1), handle, samples), cutoff)


@eqx.filter_jit
def _integrated(perturbed: Movements, high: Array, handle: Handle, samples: int) -> Deviations:
    """From the jerk of the feedback, over whole trials, to deviations in the window."""
    seen = in_window(perturbed, samples)
    acceleration = _integral(-cut_at_onset(high, perturbed.onset, samples), perturbed.sample_rate)
    velocity = _integral(acceleration, perturbed.sample_rate)
    position = _integral(velocity, perturbed.sample_rate)
    unperturbed = handle.force(jnp.zeros_like(velocity), seen.velocity + velocity, seen.acceleration + acceleration)
    return Deviations(position, velocity, acceleration, unperturbed - seen.force)


def _integral(x: Array, rate: float) -> Array:
    """By trapezia from the first sample on, which is zero. (Rectangles bias the damping by a tenth.)"""
    return jnp.pad(jnp.cumsum((x[:, 1:] + x[:, :-1]) / (2 * rate), axis=1), ((0, 0), (1, 0), (0, 0)))


def mean_of_perturbed(
    perturbed: Movements, unperturbed: Movements | None, arm: KnownArm, window: float = VOLUNTARY_DELAY
) -> Isolated:
    """The unperturbed movement is that at the onset plus what all perturbed trials did since on the average.

    Perturbations in all directions cancel in the mean; what the trials differ in, does not.

    **Source:** Gomi and Kawato 1997, as in Börner et al. 2020, 1.1.
    """

    def deviation(x: Array) -> Array:
        return x[:, :1] + (x - x[:, :1]).mean(axis=0) - x

    seen = in_window(perturbed, _samples(perturbed, window))
    return Isolated(Deviations(*map(deviation, (seen.position, seen.velocity, seen.acceleration, seen.force))))


def state_at_onset(
    perturbed: Movements, unperturbed: Movements | None, arm: KnownArm, window: float = VOLUNTARY_DELAY
) -> Isolated:
    """The unperturbed hand stays where it was at the onset, with the force that it had there, and does not move.

    **Source:** Erden and Billard 2015, as in Börner et al. 2020, 1.1; meant for postures and slow work.
    """
    seen = in_window(perturbed, _samples(perturbed, window))
    return Isolated(
        Deviations(
            seen.position[:, :1] - seen.position, -seen.velocity, -seen.acceleration, seen.force[:, :1] - seen.force
        )
    )


def learned_continuation(
    perturbed: Movements,
    unperturbed: Movements | None,
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
        perturbed, unperturbed, arm.geometry, _known_handle(arm), arm.inertia, arm.inertia_stderr,
        window=window, groups=groups,
    )  # fmt: skip
    of_both, dof = fit.covariance[..., :7, :7], fit.dof[..., :7].min(axis=-1)
    found = (fit.D, fit.K, of_both, fit.inertia, dof, fit.chi2, fit.converged, fit.delay, fit.kappa[..., 4:])
    return Isolated(fit.deviations, impedance=Impedance(*map(jnp.asarray, found)))


def _known_handle(arm: KnownArm) -> Handle:
    if arm.handle is None:
        raise ValueError(
            "this method must know the mass and the damping that the robot gives its handle: state them in "
            "[trials.handle] of a job, or as KnownArm(handle=...), or use gomi_kawato"
        )
    return arm.handle


def _samples(movements: Movements, window: float) -> int:
    """In a window that begins with the onset and has both of its ends.

    **Raises:** `ValueError` for a window that is longer than a trial lasts after its onset.
    """
    samples = round(window * movements.sample_rate) + 1
    left = movements.position.shape[-2] - int(np.max(np.asarray(movements.onset)))
    if samples > left:
        raise ValueError(
            f"a window of {window:g} s is longer than the {left / movements.sample_rate:g} s that a trial lasts after "
            "its onset: make it shorter, or leave that trial out"
        )
    return samples


class JointDeviations(eqx.Module):
    """Deviations as the joints feel them: `torque = D velocity + K displacement`."""

    displacement: Float[Array, "*T S 2"]
    """Unperturbed less perturbed angles [rad]."""
    velocity: Float[Array, "*T S 2"]
    """[rad/s]"""
    torque: Float[Array, "*T S 2"]
    """Of the handle on the joints, less what the inertia of the arm takes [N m]."""


@eqx.filter_jit
def joint_deviations(
    perturbed: Movements, deviations: Deviations, arm: KnownArm, linearised: bool = False
) -> JointDeviations:
    """Rows of the impedance model, with the inertia known: eqs. (19) to (23), (37) of Börner et al. 2020.

    **Arguments:** `linearised` takes the change of the inertial torque to first order around the unperturbed movement,
    as Gomi and Kawato 1997 do.
    """
    seen = in_window(perturbed, deviations.position.shape[-2])
    measured = arm.geometry.joint_motion(seen.position, seen.velocity, seen.acceleration)
    unperturbed = arm.geometry.joint_motion(
        seen.position + deviations.position,
        seen.velocity + deviations.velocity,
        seen.acceleration + deviations.acceleration,
    )
    change = jax.tree.map(jnp.subtract, unperturbed, measured)

    def inertial(q: Array, dq: Array, ddq: Array) -> Array:
        return rigid_body_torque(q, dq, ddq, arm.xi)

    to_first_order = jax.jvp(inertial, unperturbed, change)[1]
    body = to_first_order if linearised else inertial(*unperturbed) - inertial(*measured)
    outside = arm.geometry.joint_torque(unperturbed[0], seen.force + deviations.force)
    outside -= arm.geometry.joint_torque(measured[0], seen.force)
    return JointDeviations(change[0], change[1], outside - body)


_INERTIA = PlanarArm(impedance=False)


class StaticFit(eqx.Module):
    """What perturbed postures tell of the arm."""

    inertia: Float[Array, "3"]
    """Base inertial parameters of eq. (12) [kg m^2]."""
    inertia_stderr: Float[Array, "3"]
    """[kg m^2], from how much the trials contradict each other."""
    theta: Float[Array, "11"]
    """All parameters, in the order and units of `PlanarArm`."""


def static_inertia(
    movements: Movements, geometry: ArmGeometry, window: float = 0.4, linearised: bool = False
) -> StaticFit:
    """Base inertial parameters from perturbed postures, with damping and stiffness: eqs. (30) to (35).

    All 11 parameters are solved for over all trials together. The unperturbed state is that of the onset. Within a
    trial residuals are anything but independent, so that the standard errors count trials and not samples.

    **Arguments:** `linearised` takes the inertial torque to first order, as Gomi and Kawato 1997 do.

    **Source:** Börner et al. 2020, 2.2.3.
    """
    seen = in_window(movements, _samples(movements, window))
    return static_fit(seen, geometry, jnp.ones(seen.position.shape[1], bool), jnp.asarray(linearised))


@eqx.filter_jit
def static_fit(
    seen: Movements, geometry: ArmGeometry, inside: Bool[AnyArray, " S"], linearised: Bool[Array, ""]
) -> StaticFit:
    """`static_inertia` from trials that were cut to their window, of the samples `inside` a shorter one."""
    model = PlanarArm((0.0, 0.0))

    def normal_equations(trial: Movements) -> tuple[Array, Array]:
        q, dq, ddq = geometry.joint_motion(trial.position, trial.velocity, trial.acceleration)
        # To first order the body is where it was, and does not move.
        body = jnp.where(linearised, q[0], q), jnp.where(linearised, 0, dq), ddq
        W = jnp.concatenate([_INERTIA.regressor(*body), model.at(q[0]).regressor(q, dq, ddq)[..., 3:]], axis=-1)
        W = jnp.where(inside[:, None, None], W, 0)
        torque = geometry.joint_torque(q, trial.force)
        return jnp.einsum("snp,snq->pq", W, W), jnp.einsum("snp,sn->p", W, torque - torque[:1])

    grams, moments = jax.vmap(normal_equations)(seen)
    # Units of radians and their derivatives differ by orders of magnitude: the columns are scaled.
    size = jnp.sqrt(jnp.diagonal(grams.sum(axis=0)))
    grams, moments = grams / jnp.multiply.outer(size, size), moments / size
    gram = grams.sum(axis=0)
    theta = solve_definite(gram, moments.sum(axis=0)[:, None])[:, 0]
    influence = solve_definite(gram, (moments - grams @ theta).T) * jnp.sqrt(len(moments) / (len(moments) - 1))
    # The inertia in the order of eq. (12) is a linear function of the parameters.
    of_inertia = jax.vmap(borner_from_lakatos, 1, 1)((influence / size[:, None])[:3])
    theta = theta / size
    return StaticFit(borner_from_lakatos(theta[:3]), jnp.sqrt((of_inertia**2).sum(axis=1)), theta)


class Method(NamedTuple):
    """A way to isolate deviations."""

    short: str
    title: str
    isolate: Callable[..., Isolated]
    linearised: bool = False
    """Whether its authors take the inertia to first order, and leave the stiffness asymmetric."""
    smooth: bool = True
    """Whether it wants position and force smoothed as the derivatives are (`read_movements`), or as measured."""
    estimates: bool = False
    """Whether it estimates the impedance itself, of `groups` of trials."""
    at_rest: bool = False
    """Whether it takes the unperturbed hand to be at rest."""


METHODS = {
    "output_error": Method("OE", "output error (this project)", learned_continuation, smooth=False, estimates=True),
    "feedback_jerk": Method("FJI", "feedback jerk isolation (Börner et al. 2020)", feedback_jerk_isolation),
    "gomi_kawato": Method("GOM", "mean of all perturbed trials (Gomi and Kawato 1997)", mean_of_perturbed, True),
    "erden_billard": Method("ERD", "state at the onset (Erden and Billard 2015)", state_at_onset, at_rest=True),
}
