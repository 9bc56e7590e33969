"""Impedance of an arm from perturbed movements: isolated deviations, the fit, and whether to believe it.

`identify_impedance` does it for movements in memory, `identify_trials` for a job with `[trials]`. Both read no results
and write no files.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Num
from numpy.typing import NDArray

from jaximp.jobs.job import Job
from jaximp.jobs.trials import TrialsSettings
from jaximp.least_squares.window import confidence_interval
from jaximp.models.endpoint import EndpointImpedance, endpoint_impedance
from jaximp.numerics.precision import require_float64
from jaximp.perturbation.isolation import (
    METHODS,
    Impedance,
    Isolated,
    JointDeviations,
    KnownArm,
    StaticFit,
    energy_spectra,
    in_window,
    joint_deviations,
    static_inertia,
)
from jaximp.perturbation.movement_trials import handle_disagreement, window_warning
from jaximp.perturbation.movements import VOLUNTARY_DELAY, Deviations, Movements
from jaximp.perturbation.output_error import DELAYS, MISFIT
from jaximp.perturbation.stiffness import (
    ELEMENTS,
    FEWEST_TRIALS,
    LinearFit,
    StiffnessFit,
    fit_triangles,
    fit_triangles_linear,
    residual_triangle,
)
from jaximp.trust.criteria import MatrixCriteria, impossible_body, matrix_criteria
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import NO_DATA, POOR, TRUSTED, WEAK
from jaximp.types import AnyArray, Numbers, Progress, nearest

USUAL = TrustLimits()
UNITS = {"D": "N m s/rad", "K": "N m/rad"}
MATRICES = {"D": "damping", "K": "stiffness"}
BIASES = {
    "feedback_jerk": "feedback jerk isolation: its stiffness came out 8 to 23 % too large on simulated recordings (the "
    "filter of the derivatives blurs the onset, from which the jerk is integrated), and 5 to 10 % too small on "
    "simulated motion that is known exactly; the standard errors know of neither (README)",
}
"""What users of a method must know, from 20 recordings of `simulate arm` and from simulated subjects."""
ENOUGH = 30
"""Unperturbed movements from which output error learns well how they go on."""
BENT = 0.4
"""Change of the stiffness within the window, as a share of it, up to which intervals about its middle hold."""
DISAGREEMENT = (0.02, 0.05)
"""Share of the recorded force by which it differs from what command and handle make: from the first on that is a
warning, from the second on the estimate is not believed. (With the handle's damping 5 % too small they differ by 4 %,
and output error finds 9 % too much damping of the arm, and fits as well as with the right one.)"""
PASSING = 0.2
"""Way that the hand would go in the window, as a share of its deviations, up to which it passes for being at rest."""
SHORTEST, BEYOND, LENGTHS = 0.04, 1.5, 16
"""Windows that are tried beside the job's own: the shortest [s], the longest as a share of it, and how many."""
BATCH = 4 * (LENGTHS + 1)
"""Fits that go together."""
LATE = f"the motion seems to lag its command by {1e3 * DELAYS:g} ms or more"
FAILURES = {
    "a number is not finite": (NO_DATA, "look for gaps and absurd values in the recordings"),
    "fewer samples than parameters": (NO_DATA, "lengthen the window"),
    "did not converge": (POOR, "shorten the window, or check the units of position, force and command"),
    LATE: (POOR, "record force and position by one clock, or shift the command beforehand"),
}
"""Verdict and remedy of fits that failed; the others are weak, and their reason says what to do."""
Rule = tuple[bool, str, Callable[[], str]]
"""Whether it is broken, the verdict, and the reason."""


@dataclass(frozen=True)
class ArmImpedance:
    """Damping and stiffness of an arm's joints by one method, and whether to believe them."""

    method: str
    """Key of `isolation.METHODS`."""
    trials: int
    """Perturbed ones."""
    unperturbed: int
    window: float
    """After the onset [s]."""
    names: tuple[str, ...]
    """D11, D12, D21, D22, K11, K12, K22, and K21 before the last where a method leaves the stiffness asymmetric."""
    theta: Numbers
    """(p,) their estimates."""
    covariance: Numbers
    """(p, p), with what the standard errors of the inertia add; NaN where it is not known."""
    dof: float
    """Degrees of freedom of the standard errors."""
    D: Numbers
    """(2, 2) damping [N m s/rad]."""
    K: Numbers
    """(2, 2) stiffness [N m/rad]."""
    arm: KnownArm
    """What was known: geometry and inertia."""
    on_boundary: bool
    """The stiffness is singular, since the data ask for an indefinite one."""
    explained: float
    """Share of the isolated joint torques that damping and stiffness explain; NaN of a method that estimates the
    impedance itself, which need not know the acceleration well: there the `misfit` tells."""
    held_out: float
    """Share of the torques that is predicted from the other half of the trials; NaN where it was not tried."""
    own: Impedance | None
    """What a method says that estimates the impedance itself."""
    position: Numbers
    """(2,) mean place of the hand at the onset [m]."""
    angles: Numbers
    """(2,) of the joints there [rad]."""
    cutoff: Numbers | None
    """(2,) of the high-pass [Hz], where there was one."""
    deviations: Deviations
    """Unperturbed less perturbed, at the hand."""
    joint: JointDeviations
    """The same at the joints."""
    sample_rate: float
    """[Hz]"""
    verdict: str
    """One of `trust.VERDICTS`."""
    reason: str
    """Cause with its measured number, and remedy; empty where the estimate is trusted."""
    warnings: tuple[str, ...] = ()
    """What does not change the verdict, and must be known with it."""
    notes: tuple[str, ...] = ()
    """What else a reader should know."""

    @property
    def title(self) -> str:
        """The method, in words."""
        return METHODS[self.method].title

    @property
    def trusted(self) -> bool:
        return self.verdict == TRUSTED

    @property
    def units(self) -> tuple[str, ...]:
        return tuple(UNITS[name[0]] for name in self.names)

    @property
    def stderr(self) -> Numbers:
        """(p,) standard errors of `theta`."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def misfit(self) -> float | None:
        """Mean square of the residuals over what was expected, where the method knows it."""
        return None if self.own is None else float(self.own.misfit)

    @property
    def inertia(self) -> Numbers:
        """(3,) base inertial parameters of Börner et al. 2020, eq. (12), as they were given [kg m^2]."""
        return np.asarray(self.arm.inertia, float)

    @property
    def improved(self) -> KnownArm:
        """What was known, with the inertia as a method improved it."""
        return self.arm if self.own is None else self.arm.with_inertia(self.own.inertia)

    @property
    def at_hand(self) -> EndpointImpedance:
        """What is felt at the hand, where it was at the onset."""
        return endpoint_impedance(self.arm.geometry, self.angles, self.improved.xi, self.D, self.K)

    @property
    def inertia_stderr(self) -> Numbers | None:
        """(3,) their standard errors, where they are known [kg m^2]."""
        return None if self.arm.inertia_stderr is None else np.asarray(self.arm.inertia_stderr, float)

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(p,) lower and upper end."""
        low, high = confidence_interval(self.theta[None], self.stderr[None], np.array([self.dof]), level)
        return low[0], high[0]

    def model_torque(self) -> Numbers:
        """(T, S, 2) what damping and stiffness make of the deviations of the joints [N m]."""
        return np.asarray(self.joint.velocity) @ self.D.T + np.asarray(self.joint.displacement) @ self.K.T


def identify_impedance(
    perturbed: Movements,
    unperturbed: Movements | None,
    arm: KnownArm,
    method: str,
    window: float = VOLUNTARY_DELAY,
    cutoff: Num[AnyArray, "2"] | None = None,
    limits: TrustLimits = USUAL,
    notes: Sequence[str] = (),
) -> ArmImpedance:
    """Isolate what the perturbations changed, fit damping and stiffness of the joints to it, and judge the estimate.

    A method that estimates the impedance itself is taken at its word; to the deviations of the others D and a
    symmetric, positive semidefinite K are fitted (to those of a linearised one a K of four free numbers). Standard
    errors come from how much the trials contradict each other, and from those of the inertia.

    **Arguments:** movements as `read_movements` makes them; `method` is a key of `isolation.METHODS`; `window` [s]
    after the onset; `cutoff` (2,) [Hz] for methods that have a high-pass; `notes` from reading.

    **Raises:** `ValueError` for a method that does not exist, and what the method raises.
    """
    check_method(method)
    found = isolate(perturbed, unperturbed, arm, method, window, cutoff)
    way, own = METHODS[method], found.impedance
    body = arm if own is None else arm.with_inertia(own.inertia)
    joint, moved = _joint_deviations(perturbed, found.deviations, body, way.linearised)
    fitted = _fitted(joint, moved, way.linearised) if own is None else _as_given(own)
    names = tuple(name for name in ELEMENTS if name != "K21" or len(fitted.covariance) == len(ELEMENTS))
    full = dict(zip(ELEMENTS, np.concatenate([fitted.D.ravel(), fitted.K.ravel()]), strict=True))
    position = np.asarray(in_window(perturbed, 1).position).reshape(-1, 2).mean(axis=0)
    result = ArmImpedance(
        method=method,
        trials=len(perturbed),
        unperturbed=0 if unperturbed is None else len(unperturbed),
        window=window,
        names=names,
        theta=np.array([full[name] for name in names]),
        covariance=fitted.covariance,
        dof=fitted.dof,
        D=fitted.D,
        K=fitted.K,
        arm=arm,
        on_boundary=fitted.on_boundary,
        explained=fitted.explained,
        held_out=fitted.held_out,
        own=own,
        position=position,
        angles=np.asarray(arm.geometry.inverse(position)),
        cutoff=None if found.cutoff is None else np.asarray(found.cutoff, float),
        deviations=found.deviations,
        joint=joint,
        sample_rate=perturbed.sample_rate,
        verdict=TRUSTED,
        reason="",
    )
    share, text = handle_disagreement(perturbed, arm.handle)
    impossible = share > DISAGREEMENT[1]
    verdict, reason = (POOR, text) if impossible else _judge(result, fitted, limits, perturbed)
    warnings = _warnings(result, limits, text if share > DISAGREEMENT[0] and not impossible else "")
    others = tuple(note for note in dict.fromkeys(notes) if note not in warnings)
    return replace(result, verdict=verdict, reason=reason, warnings=warnings, notes=others)


def check_method(method: str) -> None:
    """**Raises:** `ValueError` for a method that does not exist."""
    if method not in METHODS:
        raise ValueError(f"there is no method '{method}': {nearest(method, list(METHODS))}")


def isolate(
    perturbed: Movements,
    unperturbed: Movements | None,
    arm: KnownArm,
    method: str,
    window: float,
    cutoff: Num[AnyArray, "2"] | None = None,
) -> Isolated:
    """Deviations by one of `isolation.METHODS`; the `cutoff` is for those that have one."""
    function = METHODS[method].isolate
    takes = "cutoff" in inspect.signature(function).parameters and cutoff is not None
    return function(perturbed, unperturbed, arm, window, **({"cutoff": cutoff} if takes else {}))


def _joint_deviations(
    perturbed: Movements, deviations: Deviations, arm: KnownArm, linearised: bool
) -> tuple[JointDeviations, list[Array]]:
    """Of the joints, and the torques for an inertia that is one standard error larger in each parameter."""
    joint = joint_deviations(perturbed, deviations, arm, linearised)
    inertia = jnp.asarray(arm.inertia, float)
    stderr = jnp.zeros(3) if arm.inertia_stderr is None else jnp.asarray(arm.inertia_stderr, float)
    moved = []
    for k in range(3):
        other = KnownArm(arm.geometry, inertia.at[k].add(stderr[k]), arm.handle)
        moved.append(joint_deviations(perturbed, deviations, other, linearised).torque)
    return joint, moved


def _triangles(joint: JointDeviations, moved: Sequence[Array], inside: Bool[AnyArray, " S"]) -> Float[Array, "4 T 6 6"]:
    """Of the samples `inside` of the trials, with the torque for the given inertia first."""
    torque = jnp.stack([joint.torque, *moved])
    displacement, velocity = (jnp.broadcast_to(x, torque.shape) for x in (joint.displacement, joint.velocity))
    return residual_triangle(displacement, velocity, torque, jnp.broadcast_to(inside, torque.shape[:-1]))


@dataclass(frozen=True)
class _Fitted:
    """What was made of the deviations."""

    D: Numbers
    K: Numbers
    covariance: Numbers
    dof: float
    why: str
    """Why there is no estimate."""
    on_boundary: bool = False
    explained: float = np.nan
    held_out: float = np.nan
    asked: float = np.nan
    """Smaller eigenvalue of the stiffness that the data ask for, where it need not be definite [N m/rad]."""


def _as_given(own: Impedance) -> _Fitted:
    """By a method that estimates it itself."""
    D, K, covariance = (np.asarray(x) for x in (own.D, own.K, own.covariance))
    why = "" if own.converged else LATE if abs(float(own.delay)) >= DELAYS else "did not converge"
    if not np.isfinite([D, K]).all():
        why = "a number is not finite"
    return _Fitted(D, K, covariance, float(own.dof), why, asked=_smallest(K))


def _fitted(joint: JointDeviations, moved: Sequence[Array], linearised: bool) -> _Fitted:
    """All trials with the given inertia and with others, and both halves of the trials, in one batch."""
    trials, samples = joint.torque.shape[:2]
    triangles = _triangles(joint, moved, np.ones(samples, bool))
    halves = np.arange(trials) % 2 == np.arange(2)[:, None]
    counts = np.concatenate([np.ones((4, trials), bool), halves])
    batch = jnp.concatenate([triangles, triangles[:1], triangles[:1]])
    fit = _fit_batch(batch, np.full(len(counts), samples), counts, linearised)
    D, K, own = np.asarray(fit.D), np.asarray(fit.K), np.asarray(triangles[0])
    singular = isinstance(fit, StiffnessFit) and bool(fit.on_boundary[0])
    unseen = [_left_over(own[~half], D[4 + k], K[4 + k]) for k, half in enumerate(halves)]
    return _Fitted(
        D=D[0],
        K=K[0],
        covariance=np.asarray(fit.covariance)[0] + _of_inertia(np.asarray(fit.theta)[:4]),
        dof=float(fit.dof[0]),
        why=str(fit.why()[0]),
        on_boundary=singular,
        explained=_share_explained(*_left_over(own, D[0], K[0])),
        held_out=_share_explained(*np.sum(unseen, axis=0)),
        asked=_asked_for(triangles, samples) if singular else _smallest(K[0]),
    )


def _of_inertia(theta: Numbers) -> Numbers:
    """(..., p, p) covariance that the standard errors of the inertia add to the first of estimates (..., 4, p)."""
    moves = theta[..., 1:, :] - theta[..., :1, :]
    return np.asarray(np.swapaxes(moves, -1, -2) @ moves)


def _fit_batch(
    triangles: Float[AnyArray, "B T 6 6"], samples: NDArray[np.int64], counts: NDArray[np.bool_], linearised: bool
) -> LinearFit:
    """Fits of a batch, which is filled up to one size: all of them share their compiled code."""
    filled = np.resize(np.arange(len(samples)), BATCH)
    fit = fit_triangles_linear if linearised else fit_triangles
    found = fit(jnp.asarray(triangles)[filled], samples[filled, None], counts=counts[filled])
    return jax.tree.map(lambda x: x[: len(samples)], found)


def _left_over(triangles: Numbers, D: Numbers, K: Numbers) -> tuple[float, float]:
    """Sums of squares of the torque that is not explained, and of all of it, over the trials of (T, 6, 6)."""
    torque = triangles[..., 4:]
    left = torque - triangles[..., :2] @ D.T - triangles[..., 2:4] @ K.T
    return float((left**2).sum()), float((torque**2).sum())


def _share_explained(left: float, torque: float) -> float:
    return float(1 - left / torque) if torque > 0 else np.nan


# --- whether to believe it --------------------------------------------------------------------------------------------


def _asked_for(triangles: Float[Array, "4 T 6 6"], samples: int) -> float:
    """Smaller eigenvalue of the stiffness that the data ask for, without the demand that it be definite [N m/rad]."""
    trials = triangles.shape[1]
    free = _fit_batch(triangles[:1], np.array([samples]), np.ones((1, trials), bool), True)
    return _smallest(np.asarray(free.K)[0])


def _smallest(K: Numbers) -> float:
    """Smaller eigenvalue of its symmetric part."""
    return float(np.linalg.eigvalsh((K + K.T) / 2)[0]) if np.isfinite(K).all() else np.nan


def _judge(result: ArmImpedance, fitted: _Fitted, limits: TrustLimits, perturbed: Movements) -> tuple[str, str]:
    """Verdict and reason: the first rule that is broken names them."""
    if fitted.why:
        verdict, remedy = FAILURES.get(fitted.why, (WEAK, ""))
        return verdict, f"there is no estimate: {fitted.why}" + (f": {remedy}" if remedy else "")
    rules: list[Rule] = [
        (
            result.trials < FEWEST_TRIALS or not np.isfinite(result.covariance).all(),
            WEAK,
            lambda: (
                f"the estimate cannot be judged: {result.trials} perturbed "
                f"{'trial is' if result.trials == 1 else 'trials are'} too few to contradict each other; record at "
                f"least {FEWEST_TRIALS}, better 20"
            ),
        ),
        (
            result.dof < limits.min_dof,
            WEAK,
            lambda: (
                f"{result.dof:.2g} degrees of freedom are too few to know the standard errors: record more movements"
            ),
        ),
        *_rest_rule(result, perturbed),
        *_misfit_rule(result),
        *_error_rules(result, limits),
        *_matrix_rules(result, limits, fitted.asked),
        *_share_rules(result, limits),
        _body_rule(result, limits),
    ]
    return next(((verdict, reason()) for broken, verdict, reason in rules if broken), (TRUSTED, ""))


def _rest_rule(result: ArmImpedance, perturbed: Movements) -> list[Rule]:
    """Of methods that take the hand to be at rest."""
    if not METHODS[result.method].at_rest:
        return []
    speed = float(np.linalg.norm(np.asarray(in_window(perturbed, 1).velocity)[:, 0], axis=-1).mean())
    farthest = np.linalg.norm(np.asarray(result.deviations.position)[:, -1], axis=-1)
    way, deviation = speed * result.window, float(np.sqrt((farthest**2).mean()))
    return [
        (
            way > PASSING * deviation,
            POOR,
            lambda: (
                f"the hand moves at {speed:.2g} m/s at the onset, {1e3 * way:.3g} mm in the window, and this method "
                "takes it to be at rest: use output_error, or gomi_kawato"
            ),
        )
    ]


def _error_rules(result: ArmImpedance, limits: TrustLimits) -> list[Rule]:
    """Standard errors, as shares of the norm of their matrix."""
    shares = relative_stderr(result)
    name = max(shares, key=lambda name: shares[name]) if shares else ""
    return [
        (
            not all(share <= limits.max_relative_stderr for share in shares.values()),
            WEAK,
            lambda: (
                f"the standard error of {name} is {_percent(shares[name])} of the size of the {MATRICES[name[0]]}, "
                f"above {_percent(limits.max_relative_stderr)}: perturb more movements, or harder, or know the "
                "inertia better"
            ),
        )
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if share < 10 else "more than 1000 %"


def relative_stderr(result: ArmImpedance) -> dict[str, float]:
    """Standard error of each element over the norm of its matrix."""
    norms = {"D": float(np.linalg.norm(result.D)), "K": float(np.linalg.norm(result.K))}
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = [np.divide(error, norms[name[0]]) for name, error in zip(result.names, result.stderr, strict=True)]
    return {name: float(share) for name, share in zip(result.names, shares, strict=True)}


def _matrix_rules(result: ArmImpedance, limits: TrustLimits, asked: float) -> list[Rule]:
    """Stiffness and damping that no passive arm has."""
    stiffness, damping = criteria(result, "stiffness"), criteria(result, "damping")
    low, error = damping.eigenvalues[0, 0], damping.eigenvalue_stderr[0, 0]
    indefinite = not result.on_boundary and bool(stiffness.surely_indefinite(limits.errors_apart)[0])
    return [
        (
            result.on_boundary or indefinite,
            POOR,
            lambda: (
                f"the data ask for an indefinite stiffness (an eigenvalue of {asked:.3g} N m/rad), one that in "
                "some direction pushes the hand on instead of back: check the onsets, the signs of force and command, "
                "the handle, the inertia and the arm's lengths, or perturb more movements"
            ),
        ),
        (
            bool(damping.surely_indefinite(limits.errors_apart)[0]),
            POOR,
            lambda: (
                f"the damping is not positive definite: an eigenvalue of {low:.3g} ± {error:.2g} N m s/rad would "
                "drive the hand; check whether force and position are of the same instant, and the inertia"
            ),
        ),
    ]


def criteria(result: ArmImpedance, which: str) -> MatrixCriteria:
    """Eigenvalues and asymmetry of `damping` or `stiffness`, with their standard errors."""
    letter = next(letter for letter, word in MATRICES.items() if word == which)
    full = np.zeros((4, len(result.names)))
    for k, name in enumerate(f"{letter}{i}{j}" for i in (1, 2) for j in (1, 2)):
        full[k, result.names.index(name if name in result.names else "K12")] = 1.0
    covariance = full @ result.covariance @ full.T
    theta, stderr = full @ result.theta, np.sqrt(np.maximum(np.diagonal(covariance), 0))
    names = [f"{which}_{i}{j}" for i in (1, 2) for j in (1, 2)]
    found = matrix_criteria(names, which, theta[None], stderr[None], covariance[None])
    assert found is not None
    return found


def _misfit_rule(result: ArmImpedance) -> list[Rule]:
    """Of a method that estimates the impedance itself."""
    if result.misfit is None:
        return []
    few = f", or {result.unperturbed} unperturbed movements are too few" if result.unperturbed < ENOUGH else ""
    return [
        (
            not result.misfit <= MISFIT,
            POOR,
            lambda: (
                f"the residuals are {result.misfit:.3g} times what the unperturbed movements let expect (mean squares; "
                f"at most {MISFIT:g}): the timing of command and position, the handle's mass, a calibration, or the "
                f"noise level is wrong{few}"
            ),
        )
    ]


def _share_rules(result: ArmImpedance, limits: TrustLimits) -> list[Rule]:
    """How much of the torque is told, by the other methods."""
    if result.own is not None:
        return []
    return [
        (
            not result.explained >= limits.min_vaf,
            POOR,
            lambda: (
                f"damping and stiffness explain {_percent(result.explained)} of the isolated torque, less than "
                f"{_percent(limits.min_vaf)}: check onsets, inertia, lengths of the arm and the handle's "
                "mass, or shorten the window"
            ),
        ),
        (
            not result.held_out >= limits.min_vaf,
            POOR,
            lambda: (
                f"half of the trials predicts {_percent(result.held_out)} of the torque of the others, less than "
                f"{_percent(limits.min_vaf)}: the trials contradict each other; leave out those that went wrong, "
                "or record more"
            ),
        ),
    ]


def _body_rule(result: ArmImpedance, limits: TrustLimits) -> Rule:
    """The inertia was given, and may be that of no body."""
    xi = np.asarray(result.arm.xi)
    given = np.zeros(3) if result.inertia_stderr is None else result.inertia_stderr
    to_xi = np.array([[1.0, 1, 0], [0, 0, 1], [0, 1, 0]])
    covariance = to_xi @ np.diag(np.maximum(given, 1e-9) ** 2) @ to_xi.T
    names = [f"inertia_{k}" for k in (1, 2, 3)]
    broken = impossible_body(
        names, xi[None], np.sqrt(np.diagonal(covariance))[None], limits.errors_apart, covariance[None]
    )
    return (
        bool(broken[0]),
        POOR,
        lambda: (
            f"no rigid body has the inertia {', '.join(f'{x:.3g}' for x in result.inertia)} kg m^2: check their order "
            "(I_1 + m_2 l1^2, I_2, m_2 c_2 l1), the unit of the force, and the arm's lengths"
        ),
    )


def _warnings(result: ArmImpedance, limits: TrustLimits, of_handle: str) -> tuple[str, ...]:
    """What does not change the verdict."""
    found = [window_warning(result.window), of_handle, BIASES.get(result.method, "")]
    if result.own is not None and float(result.own.misfit) <= MISFIT:
        found += _limits_of_own(result, result.own)
    if result.inertia_stderr is None:
        found.append(
            "the inertia was given without standard errors: "
            + (
                "the intervals are those of an arm whose inertia is known exactly"
                if result.own is None
                else "those that the static task usually leaves are assumed, 1.2, 2.5 and 2.2 %"
            )
            + "; give model.arm.inertia_stderr, or [trials.posture]"
        )
    if np.isfinite(result.covariance).all():
        found += _asymmetry(result, limits)
    return tuple(filter(None, found))


def _limits_of_own(result: ArmImpedance, own: Impedance) -> list[str]:
    """Where the intervals of a method's own estimate are known to be too narrow."""
    bent = float(np.abs(np.asarray(own.trend)).max())
    warnings = []
    if result.unperturbed < ENOUGH:
        warnings.append(
            f"{result.unperturbed} unperturbed movements teach little of how a movement goes on: with 10, intervals of "
            "95 % held K11 in 79 to 92 % of simulated groups; record 30 or more"
        )
    if bent > BENT:
        warnings.append(
            f"the stiffness seems to change by {100 * bent:.0f} % within the window: in simulated movements as fast as "
            "that, intervals of 95 % held K11 in 84 %; shorten the window to see"
        )
    return warnings


def _asymmetry(result: ArmImpedance, limits: TrustLimits) -> list[str]:
    stiffness = criteria(result, "stiffness")
    if not stiffness.surely_asymmetric(limits)[0]:
        return []
    return [
        f"the stiffness is not symmetric: its antisymmetric part is {_percent(stiffness.asymmetry[0])} of the "
        "symmetric one, as muscles alone do not make it"
    ]


# --- other windows ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class OtherWindows:
    """Estimates of one method from windows of L lengths."""

    window: Numbers
    """(L,) [s]"""
    names: tuple[str, ...]
    theta: Numbers
    """(L, p)"""
    stderr: Numbers
    """(L, p)"""
    dof: Numbers
    """(L,)"""

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(L, p) lower and upper end."""
        return confidence_interval(self.theta, self.stderr, self.dof, level)


def at_other_windows(
    perturbed: Movements,
    unperturbed: Movements | None,
    arm: KnownArm,
    method: str,
    window: float = VOLUNTARY_DELAY,
    cutoff: Num[AnyArray, "2"] | None = None,
) -> OtherWindows | None:
    """Estimates from windows between 40 ms and half as much again as the window, where the trials last so long.

    **Returns:** None for methods that estimate the impedance themselves: they would have to run for each length.
    """
    rate, way = perturbed.sample_rate, METHODS[method]
    last = int(np.min(perturbed.position.shape[-2] - np.asarray(perturbed.onset))) - 1
    longest = max(window, min(BEYOND * window, last / rate))
    found = isolate(perturbed, unperturbed, arm, method, longest, cutoff)
    if found.impedance is not None:
        return None
    joint, moved = _joint_deviations(perturbed, found.deviations, arm, way.linearised)
    lengths = np.linspace(min(SHORTEST, window / 2), longest, LENGTHS)
    lengths = np.unique(np.append(lengths[np.abs(lengths - window) > 1e-3], window))
    inside = np.arange(joint.torque.shape[-2]) <= np.round(lengths * rate)[:, None]
    return OtherWindows(lengths, *_fitted_at(joint, moved, inside, way.linearised))


def _fitted_at(
    joint: JointDeviations, moved: Sequence[Array], inside: NDArray[np.bool_], linearised: bool
) -> tuple[tuple[str, ...], Numbers, Numbers, Numbers]:
    """Names, estimates, standard errors and degrees of freedom for windows of the (L, S) samples `inside`."""
    trials = joint.torque.shape[0]
    batch = jax.vmap(lambda some: _triangles(joint, moved, some))(jnp.asarray(inside)).reshape(-1, trials, 6, 6)
    samples = np.repeat(inside.sum(axis=1), 4)
    fit = _fit_batch(batch, samples, np.ones((len(samples), trials), bool), linearised)
    theta = np.asarray(fit.theta).reshape(len(inside), 4, -1)
    added = np.diagonal(_of_inertia(theta), axis1=1, axis2=2)
    variance = np.asarray(fit.stderr)[::4] ** 2 + added
    names = tuple(name for name in ELEMENTS if linearised or name != "K21")
    return names, theta[:, 0], np.sqrt(variance), np.asarray(fit.dof)[::4]


# --- jobs -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class TrialsResult:
    """What a job with `[trials]` gives."""

    estimates: tuple[ArmImpedance, ...]
    """By every method that was asked for, the main one first."""
    windows: OtherWindows | None
    """By the main method, from other windows."""
    spectra: tuple[Numbers, Numbers, Numbers] | None
    """Of the jerk, where there are unperturbed trials: `energy_spectra`."""
    static: StaticFit | None
    """What `[trials.posture]` tells."""
    postures: int = 0
    """Trials of it."""

    @property
    def main(self) -> ArmImpedance:
        return self.estimates[0]


def identify_trials(job: Job, progress: Progress = lambda share: None) -> TrialsResult:
    """Run a job with `[trials]`.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    require_float64()
    trials = job.trials
    if trials is None:
        raise ValueError("this job has no [trials]: identify() is for recordings with windows")
    check_trials(job)
    known = _Known(job)
    progress(0.1)
    read: dict[bool, Any] = {}
    estimates: list[ArmImpedance] = []
    for k, method in enumerate(trials.methods):
        smooth = METHODS[method].smooth
        if smooth not in read:
            read[smooth] = trials.load(smooth)
        perturbed, unperturbed, notes = read[smooth]
        progress(0.1 + 0.6 * (k + 0.5) / len(trials.methods))
        arm = known.arm(METHODS[method].linearised)
        estimates.append(
            identify_impedance(
                perturbed, unperturbed, arm, method, trials.window, _cutoff(trials), job.trust, (*notes, *known.notes)
            )
        )
        progress(0.1 + 0.6 * (k + 1) / len(trials.methods))
    main = estimates[0]
    perturbed, unperturbed, _ = read[METHODS[main.method].smooth]
    windows = at_other_windows(perturbed, unperturbed, main.arm, main.method, trials.window, _cutoff(trials))
    progress(0.9)
    wanted = unperturbed is not None and any(one.cutoff is not None for one in estimates)
    spectra = energy_spectra(*read[True][:2]) if wanted and True in read else None
    progress(1.0)
    return TrialsResult(tuple(estimates), windows, spectra, known.static(False), known.postures)


def check_trials(job: Job) -> None:
    """**Raises:** `ValueError` for a job whose trials cannot be identified."""
    trials, arm = job.trials, job.model.hand_arm
    assert trials is not None
    assert arm is not None
    for method in trials.methods:
        if method not in METHODS:
            raise ValueError(f"trials.method is '{method}': {nearest(method, list(METHODS))}")
    if trials.task == "posture":
        raise ValueError(
            "a job of postures alone tells the inertia and no impedance in motion: put their file into "
            "[trials.posture] of the job with the movements"
        )
    if arm.inertia is None and trials.posture is None:
        raise ValueError(
            "the arm's inertia is not known: add [trials.posture] with trials of the static task, or "
            "model.arm.inertia = [I_1 + m_2 l1^2, I_2, m_2 c_2 l1] in kg m^2"
        )


def _cutoff(trials: TrialsSettings) -> Numbers | None:
    return None if trials.cutoff is None else np.array(trials.cutoff)


@contextmanager
def _in_postures() -> Iterator[None]:
    """Errors say which of the two tables is meant."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"[trials.posture]: {error}") from None


class _Known:
    """What a job knows of the arm, read once."""

    def __init__(self, job: Job):
        assert job.trials is not None
        assert job.model.hand_arm is not None
        self._settings, self._handle = job.model.hand_arm, job.trials.known_handle()
        self._table = job.trials.posture
        self._found: dict[bool, StaticFit] = {}
        self.notes: tuple[str, ...] = ()
        self.postures = 0
        if self._table is not None:
            with _in_postures():
                self._movements, _, notes = self._table.load()
            self.notes = tuple(f"postures: {note}" for note in notes)
            self.postures = len(self._movements)

    def static(self, linearised: bool) -> StaticFit | None:
        """What the postures tell, where there are some."""
        if self._table is None:
            return None
        if linearised not in self._found:
            geometry = self._settings.geometry()
            with _in_postures():
                self._found[linearised] = static_inertia(self._movements, geometry, self._table.window, linearised)
        return self._found[linearised]

    def arm(self, linearised: bool) -> KnownArm:
        geometry, static = self._settings.geometry(), self.static(linearised)
        if static is not None:
            return KnownArm(geometry, static.inertia, self._handle, static.inertia_stderr)
        given, stderr = self._settings.inertia, self._settings.inertia_stderr
        assert given is not None
        return KnownArm(geometry, np.array(given), self._handle, None if stderr is None else np.array(stderr))
