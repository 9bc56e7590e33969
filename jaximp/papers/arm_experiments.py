"""Simulated experiments of Börner et al. 2020: what a subject does, and the truth that only a simulation knows."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num, PRNGKeyArray
from numpy.typing import NDArray

from jaximp.models.arm import ArmLinks, rigid_body_torque
from jaximp.models.inertia import borner_from_lakatos
from jaximp.perturbation.deviations import Deviations
from jaximp.perturbation.stiffness import symmetric_matrix
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Trials, in_window
from jaximp.simulation.neuromuscular import (
    ANGLES,
    POSTURES,
    RATE,
    NeuromuscularArm,
    Reach,
    accelerate,
    hold_posture,
    neural_noise,
    perturbing_forces,
    reach,
)
from jaximp.types import AnyArray, Numbers

QUANTITIES = ("position", "velocity", "acceleration", "force")
GROUP = 20
"""How many trials one estimate is made of."""
LINKS = ArmLinks((0.29, 0.34), (1.93, 1.52), (0.165, 0.19), (0.0141, 0.0188))
"""Upper arm and forearm of the simulated subject: they have the base inertial parameters that the paper prints."""
HEIGHT, WEIGHT = (1.7483, 0.0738), (69.43, 9.82)
"""Mean and standard deviation of the paper's 12 participants [m], [kg]."""


class Case(NamedTuple):
    """One configuration of the simulation; the defaults are the original one."""

    duration: float = 2.0
    """Duration of a movement, T_mov [s]."""
    cutoff: float = 2.0
    """Cut-off of the neural noise, f_c,N [Hz]."""
    amplitude: Any = 12.5
    """Amplitude of the neural noise, alpha_N."""


class Experiment(eqx.Module):
    """The dynamic and the static task of one simulation."""

    perturbed: Trials
    """60 trials."""
    twins: Trials
    """The same trials without the perturbation."""
    unperturbed: Trials | None
    """Other trials of the same task, as an experiment has them."""
    postures: Trials | None
    """100 trials of the static task, where it was done."""
    stiffness: Float[Array, "*S T 3"]
    """True K11, K12, K22 [N m/rad], mean over the window of each trial, without the perturbation."""


def run_case(
    arm: NeuromuscularArm,
    case: Case,
    keys: Array,
    static: bool = True,
    others: int = 0,
    window: float = VOLUNTARY_DELAY,
) -> Iterator[Experiment]:
    """One experiment for each key; all of them are simulated in one call.

    **Arguments:** `static` says whether the static task is done as well; `others` is the number of unperturbed trials
    beside the twins; `window` [s] in which the true stiffness is averaged.
    """
    # As an array: amplitudes share their compiled code.
    case = case._replace(amplitude=jnp.asarray(case.amplitude))
    found = _simulate(arm, Reach(duration=case.duration), case, keys, static, others, window)
    for k in range(len(keys)):
        yield jax.tree.map(lambda x, k=k: x[k], found)


@eqx.filter_jit
def _simulate(
    arm: NeuromuscularArm, task: Reach, case: Case, keys: Array, static: bool, others: int, window: float
) -> Experiment:
    samples, S = round(case.duration * RATE) + 1, len(keys)
    parts = jax.vmap(lambda key: jax.random.split(key, 4))(keys)
    noise_of = lambda key, trials: neural_noise(key, trials, samples, case.amplitude, case.cutoff)  # noqa: E731
    forces = jax.vmap(perturbing_forces)(parts[:, 0])
    noise = jax.vmap(lambda key: noise_of(key, forces.shape[1]))(parts[:, 1])

    def trials(forces: Array, noise: Array) -> tuple[Trials, Array]:
        """All trials of all simulations side by side."""
        flat = reach(arm, task, forces.reshape(-1, 2), noise.reshape(-1, *noise.shape[2:]))
        apart = jax.tree.map(lambda x: x.reshape(S, -1, *x.shape[1:]), flat)
        return apart.movements, apart.stiffness

    perturbed, _ = trials(forces, noise)
    twins, stiffness = trials(jnp.zeros_like(forces), noise)
    unperturbed = None
    if others:
        more = jax.vmap(lambda key: noise_of(key, others))(parts[:, 2])
        unperturbed, _ = trials(jnp.zeros((S, others, 2)), more)

    def hold(key: PRNGKeyArray) -> Trials:
        held = neural_noise(key, 100, round(1.5 * RATE), case.amplitude, case.cutoff)
        return hold_posture(arm, np.repeat(POSTURES, 20, axis=0), np.tile(ANGLES, 5), held)

    inside = round(window * RATE) + 1
    cut = jax.vmap(jax.vmap(lambda K, first: jax.lax.dynamic_slice_in_dim(K, first, inside).mean(axis=0)))
    postures = jax.vmap(hold)(parts[:, 3]) if static else None
    return Experiment(perturbed, twins, unperturbed, postures, cut(stiffness, twins.onset))


def true_deviations(experiment: Experiment, window: float = VOLUNTARY_DELAY) -> Deviations:
    """Differences between the perturbed trials and their unperturbed twins."""
    samples = round(window * RATE) + 1
    with_it, without = (in_window(m, samples) for m in (experiment.perturbed, experiment.twins))
    return Deviations(
        without.position - with_it.position,
        without.velocity - with_it.velocity,
        without.acceleration - with_it.acceleration,
        without.force - with_it.force,
    )


def normalised_errors(true: Deviations, found: Deviations) -> Numbers:
    """(4, T, S) root mean squares over both axes [%], each divided by the largest true value of its trial: eq. (42)."""

    def one(true: Numbers, found: Numbers) -> Numbers:
        share = (true - found) / np.abs(true).max(axis=1, keepdims=True)
        return 100 * np.sqrt((share**2).mean(axis=-1))

    return np.stack([one(*(np.asarray(getattr(x, name)) for x in (true, found))) for name in QUANTITIES])


def as_matrix(K: Num[AnyArray, "*N 3"]) -> Numbers:
    """(*N, 2, 2) symmetric matrices from their elements 11, 12, 22."""
    return np.asarray(symmetric_matrix(np.asarray(K)))


def groups(trials: int) -> NDArray[np.int64]:
    """(G, 20) indices of the trials of each group: the first 20, and on trial by trial."""
    return np.arange(trials - GROUP + 1)[:, None] + np.arange(GROUP)


@eqx.filter_jit
def replayed_torque(
    arm: NeuromuscularArm,
    unperturbed: Trials,
    command: Num[AnyArray, "T S 2"],
    inertia: Num[AnyArray, "3"],
    D: Num[AnyArray, "T 2 2"],
    K: Num[AnyArray, "T 2 2"],
) -> Float[Array, "T S 2"]:
    """Deviation of the external torque [N m] of an arm with other inertia and impedance, pushed alike: Table 2B.

    **Arguments:** `unperturbed` trials, cut to the window, from which the muscles deviate by D and K alone; `command`
    the perturbing force [N] in the window; `inertia` in the order of eq. (12) [kg m^2]; D and K one for each trial.
    """
    geometry = arm.geometry
    q, dq, ddq = geometry.joint_motion(unperturbed.position, unperturbed.velocity, unperturbed.acceleration)
    other = eqx.tree_at(lambda arm: arm.inertia, arm, jnp.asarray(inertia))
    outside = geometry.joint_torque(q, unperturbed.force)
    intended = rigid_body_torque(q, dq, ddq, other.xi) - outside
    D, K = jnp.moveaxis(jnp.asarray(D), 0, -1), jnp.moveaxis(jnp.asarray(K), 0, -1)
    # Time first, trials last, as the simulator has them.
    plan = tuple(jnp.moveaxis(x, (1, 2, 0), (0, 1, 2)) for x in (q, dq, intended, jnp.asarray(command)))

    def rate(q: Array, dq: Array, at: tuple[Array, ...]) -> Array:
        away, slip = at[0] - q, at[1] - dq
        torque = at[2] + (D * slip + K * away).sum(axis=1)
        return accelerate(other, q, dq, torque, at[3])

    def step(state: tuple[Array, Array], x: Any) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        (q, dq), (now, then), h = state, x, 1 / RATE
        ddq = rate(q, dq, now)
        ahead, velocity = q + h * dq, dq + h * ddq
        later = rate(ahead, velocity, then)
        return (q + h / 2 * (dq + velocity), dq + h / 2 * (ddq + later)), (q, dq, ddq)

    then = jax.tree.map(lambda x: jnp.concatenate([x[1:], x[-1:]]), plan)
    _, motion = jax.lax.scan(step, (plan[0][0], plan[1][0]), (plan, then))
    q_hat, dq_hat, ddq_hat = (jnp.moveaxis(x, (0, 1, 2), (1, 2, 0)) for x in motion)
    _, v, a = geometry.hand_motion(q_hat, dq_hat, ddq_hat)
    return outside - geometry.joint_torque(q_hat, arm.handle.force(jnp.asarray(command), v, a))


def subject(seed: int) -> NeuromuscularArm:
    """A subject of another build: height and weight spread as in the paper, and muscles of another stiffness.

    Lengths and moment arms grow with the height, masses with the weight; the stiffness K0 of all muscles varies by a
    quarter, and that of each pair by another 15 %. All of this is a **choice**; height and weight within 1.5 standard
    deviations, or the shortest arm could not reach the goal.
    """
    random = np.random.default_rng(seed)
    taller, heavier = _spread(random, HEIGHT), _spread(random, WEIGHT)
    lengths = taller * np.asarray(LINKS.lengths)
    masses = heavier * np.asarray(LINKS.masses)
    links = ArmLinks(
        tuple(lengths), tuple(masses), tuple(taller * np.asarray(LINKS.centres)),
        tuple(heavier * taller**2 * np.asarray(LINKS.inertias)),
    )  # fmt: skip
    usual = NeuromuscularArm()
    stiffer = np.exp(0.25 * random.normal()) * np.repeat(np.exp(0.15 * random.normal(size=3)), 2)
    return NeuromuscularArm(
        lengths=lengths,
        inertia=borner_from_lakatos(links.base_parameters()),
        moment_arms=taller * usual.moment_arms,
        intrinsic_stiffness=stiffer * usual.intrinsic_stiffness,
    )


def _spread(random: np.random.Generator, of: tuple[float, float]) -> float:
    """A random number over its mean: normally distributed, but within 1.5 standard deviations."""
    return 1 + float(np.clip(random.normal(), -1.5, 1.5)) * of[1] / of[0]
