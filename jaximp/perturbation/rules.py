"""Whether to believe an arm's impedance: one table of rules, and one of what must be known with an estimate.

The first rule that an estimate breaks gives its verdict, with cause and remedy; one that breaks none is trusted.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from jaximp.models.inertia import BASE_INERTIA
from jaximp.perturbation.estimate import ArmEstimate
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.perturbation.isolation.output_error import MISFIT, USUAL_STDERR
from jaximp.perturbation.stiffness import FEWEST_TRIALS, MATRIX_OF
from jaximp.perturbation.trial_fits import LATE, NOT_CONVERGED, NOT_FINITE
from jaximp.perturbation.trials import window_warning
from jaximp.trust.criteria import MatrixCriteria, impossible_body, matrix_criteria
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import NO_DATA, POOR, WEAK, Rule, Verdict, judge_one

ENOUGH = 30
"""Unperturbed movements from which output error learns well how they go on."""
BENT = 0.4
"""Change of the stiffness within the window, as a share of its mean, from which on that is said."""
DISAGREEMENT = (0.02, 0.05)
"""Share of the recorded force by which it differs from what command and handle make: from the first on that is a
warning, from the second on the estimate is not believed. (With the handle's damping 5 % too small they differ by 4 %,
and output error finds 9 % too much damping of the arm, and fits as well as with the right one.)"""
PASSING = 0.2
"""Way that the hand would go in the window, as a share of its deviations, up to which it passes for being at rest."""
BIASES = {
    "feedback_jerk": (
        "the stiffness of feedback jerk isolation has a bias that its standard errors do not know: it came out 8 to "
        "23 % too large on simulated recordings, where intervals of 95 % held it in 88 % (those of the damping in "
        "95 %)",
        "use output_error, or gomi_kawato; the filter of the derivatives blurs the onset, from which the jerk is "
        "integrated, and on motion that is known exactly the stiffness is 5 to 10 % too small",
    ),
}
"""By method, what is known to be wrong with it from 20 recordings of `simulate arm` and from simulated subjects, and
what to do about it."""


def judge(estimate: ArmEstimate, limits: TrustLimits) -> Verdict:
    """The verdict of the first of `RULES` that the estimate breaks."""
    return judge_one(RULES, estimate, limits)


def warnings_of(estimate: ArmEstimate, limits: TrustLimits) -> tuple[str, ...]:
    """What does not change the verdict, and must be known with it."""
    return tuple(filter(None, (words(estimate, limits) for words in WARNINGS)))


# --- what the rules measure -------------------------------------------------------------------------------------------


def relative_stderr(estimate: ArmEstimate) -> dict[str, float]:
    """Standard error of each element over the norm of its matrix."""
    norms = {"damping": np.linalg.norm(estimate.D), "stiffness": np.linalg.norm(estimate.K)}
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = [
            np.divide(error, norms[MATRIX_OF[name]])
            for name, error in zip(estimate.names, estimate.stderr, strict=True)
        ]
    return {name: float(share) for name, share in zip(estimate.names, shares, strict=True)}


def criteria(estimate: ArmEstimate, which: str) -> MatrixCriteria:
    """Eigenvalues and asymmetry of `damping` or `stiffness`, with their standard errors."""
    names = [f"{which}_{i}{j}" for i in (1, 2) for j in (1, 2)]
    full = np.zeros((4, len(estimate.names)))
    for k, name in enumerate(names):
        full[k, estimate.names.index(name if name in estimate.names else f"{which}_12")] = 1.0
    covariance = full @ estimate.covariance @ full.T
    theta, stderr = full @ estimate.theta, np.sqrt(np.maximum(np.diagonal(covariance), 0))
    found = matrix_criteria(names, which, theta[None], stderr[None], covariance[None])
    assert found is not None
    return found


def _loosest(estimate: ArmEstimate) -> tuple[str, float]:
    """The element with the largest relative standard error."""
    return max(relative_stderr(estimate).items(), key=lambda item: item[1])


def _way(estimate: ArmEstimate) -> float:
    """Of a hand that went on as it moved at the onset, in the window [m]."""
    return estimate.evidence.speed * estimate.window


def _no_body(estimate: ArmEstimate, limits: TrustLimits) -> bool:
    """The inertia was given, and may be that of no body."""
    given = np.nan_to_num(list(estimate.inertia_stderr.values()))
    to_xi = np.array([[1.0, 1, 0], [0, 0, 1], [0, 1, 0]])
    covariance = to_xi @ np.diag(np.maximum(given, 1e-9) ** 2) @ to_xi.T
    names, xi = [f"inertia_{k}" for k in (1, 2, 3)], np.asarray(estimate.arm.xi)
    stderr = np.sqrt(np.diagonal(covariance))
    return bool(impossible_body(names, xi[None], stderr[None], limits.errors_apart, covariance[None])[0])


def _indefinite_stiffness(estimate: ArmEstimate, limits: TrustLimits) -> bool:
    if estimate.evidence.on_boundary:
        return True
    return bool(criteria(estimate, "stiffness").surely_indefinite(limits.errors_apart)[0])


def _driving(estimate: ArmEstimate) -> str:
    damping = criteria(estimate, "damping")
    return f"an eigenvalue of {damping.eigenvalues[0, 0]:.3g} ± {damping.eigenvalue_stderr[0, 0]:.2g} N m s/rad"


def _percent(share: float) -> str:
    return f"{100 * share:.3g} %" if share < 10 else "more than 1000 %"


def _always(words: str) -> Callable[[ArmEstimate, TrustLimits], str]:
    return lambda e, limits: words


def _failed(label: str, failure: str, remedy: str) -> Rule[ArmEstimate]:
    return Rule(
        "there is an estimate",
        label,
        lambda e, limits: e.evidence.failure == failure,
        lambda e, limits: f"there is no estimate: {e.evidence.failure}",
        _always(remedy),
    )


# --- the tables -------------------------------------------------------------------------------------------------------

RULES: tuple[Rule[ArmEstimate], ...] = (
    Rule(
        "the force is that of command and handle",
        POOR,
        lambda e, limits: e.evidence.disagreement > DISAGREEMENT[1],
        lambda e, limits: e.evidence.about_handle,
    ),
    _failed(NO_DATA, NOT_FINITE, "look for gaps and absurd values in the recordings"),
    _failed(NO_DATA, "fewer samples than parameters", "lengthen the window"),
    _failed(POOR, NOT_CONVERGED, "shorten the window, or check the units of position, force and command"),
    _failed(POOR, LATE, "record force and position by one clock, or shift the command beforehand"),
    Rule(
        "there is an estimate",
        WEAK,
        lambda e, limits: bool(e.evidence.failure),
        lambda e, limits: f"there is no estimate: {e.evidence.failure}",
    ),
    Rule(
        "trials that can contradict each other",
        WEAK,
        lambda e, limits: e.trials < FEWEST_TRIALS or not np.isfinite(e.covariance).all(),
        lambda e, limits: (
            f"the estimate cannot be judged: {e.trials} perturbed {'trial is' if e.trials == 1 else 'trials are'} too "
            "few to contradict each other"
        ),
        _always(f"record at least {FEWEST_TRIALS}, better 20"),
    ),
    Rule(
        "degrees of freedom",
        WEAK,
        lambda e, limits: e.dof < limits.min_dof,
        lambda e, limits: f"{e.dof:.2g} degrees of freedom are too few to know the standard errors",
        _always("record more movements"),
    ),
    Rule(
        "at rest, where the method says so",
        POOR,
        lambda e, limits: METHODS[e.method].at_rest and _way(e) > PASSING * e.evidence.deviation,
        lambda e, limits: (
            f"the hand moves at {e.evidence.speed:.2g} m/s at the onset, {1e3 * _way(e):.3g} mm in the window, and "
            "this method takes it to be at rest"
        ),
        _always("use output_error, or gomi_kawato"),
    ),
    Rule(
        "residuals as expected",
        POOR,
        lambda e, limits: e.misfit is not None and not e.misfit <= MISFIT,
        lambda e, limits: (
            f"the residuals are {e.misfit:.3g} times what the unperturbed movements let expect (mean squares; at most "
            f"{MISFIT:g})"
        ),
        lambda e, limits: (
            "the timing of command and position, the handle's mass, a calibration, or the noise level is wrong"
            + (f", or {e.unperturbed} unperturbed movements are too few" if e.unperturbed < ENOUGH else "")
        ),
    ),
    Rule(
        "small standard errors",
        WEAK,
        lambda e, limits: not all(share <= limits.max_relative_stderr for share in relative_stderr(e).values()),
        lambda e, limits: (
            f"the standard error of {_loosest(e)[0]} is {_percent(_loosest(e)[1])} of the size of the "
            f"{MATRIX_OF[_loosest(e)[0]]}, above {_percent(limits.max_relative_stderr)}"
        ),
        _always("perturb more movements, or harder, or know the inertia better"),
    ),
    Rule(
        "a stiffness that pushes back",
        POOR,
        _indefinite_stiffness,
        lambda e, limits: (
            f"the data ask for an indefinite stiffness (an eigenvalue of {e.evidence.asked:.3g} N m/rad), one that in "
            "some direction pushes the hand on instead of back"
        ),
        _always(
            "check the onsets, the signs of force and command, the handle, the inertia and the arm's lengths, or "
            "perturb more movements"
        ),
    ),
    Rule(
        "a damping that takes energy",
        POOR,
        lambda e, limits: bool(criteria(e, "damping").surely_indefinite(limits.errors_apart)[0]),
        lambda e, limits: f"the damping is not positive definite: {_driving(e)} would drive the hand",
        _always("check whether force and position are of the same instant, and the inertia"),
    ),
    Rule(
        "variance accounted for",
        POOR,
        lambda e, limits: e.own is None and not e.vaf >= limits.usual_vaf,
        lambda e, limits: (
            f"damping and stiffness account for {_percent(e.vaf)} of the isolated torque, less than "
            f"{_percent(limits.usual_vaf)}"
        ),
        _always("check onsets, inertia, lengths of the arm and the handle's mass, or shorten the window"),
    ),
    Rule(
        "unseen trials are predicted",
        POOR,
        lambda e, limits: e.own is None and not e.held_out_vaf >= limits.usual_vaf,
        lambda e, limits: (
            f"half of the trials predicts {_percent(e.held_out_vaf)} of the torque of the others, less than "
            f"{_percent(limits.usual_vaf)}"
        ),
        _always("the trials contradict each other; leave out those that went wrong, or record more"),
    ),
    Rule(
        "an inertia that a body can have",
        POOR,
        _no_body,
        lambda e, limits: (
            "no rigid body has the inertia "
            + ", ".join(f"{name} = {value:.3g}" for name, value in e.inertia.items())
            + f" kg m^2 ({', '.join(BASE_INERTIA.values())})"
        ),
        _always("check which is which, the unit of the force, and the arm's lengths"),
    ),
    Rule(
        "standard errors that know all biases",
        POOR,
        lambda e, limits: e.method in BIASES,
        lambda e, limits: BIASES[e.method][0],
        lambda e, limits: BIASES[e.method][1],
    ),
)
"""From what makes an estimate meaningless to what makes it doubtful."""


def _of_handle(e: ArmEstimate, limits: TrustLimits) -> str:
    low, high = DISAGREEMENT
    return e.evidence.about_handle if low < e.evidence.disagreement <= high else ""


def _biased(e: ArmEstimate, limits: TrustLimits) -> str:
    """Where another rule comes first."""
    words = BIASES.get(e.method, ("",))[0]
    return "" if words in judge(e, limits).in_words() else words


def _few_unperturbed(e: ArmEstimate, limits: TrustLimits) -> str:
    if e.misfit is None or e.misfit > MISFIT or e.unperturbed >= ENOUGH:
        return ""
    return (
        f"{e.unperturbed} unperturbed movements teach little of how a movement goes on: with 10, intervals of the "
        "stiffness are a third wider than with 120; record 30 or more"
    )


def _bends(e: ArmEstimate, limits: TrustLimits) -> str:
    if e.own is None:
        return ""
    bent = float(np.abs(np.asarray(e.own.trend)).max())
    if not bent > BENT:
        return ""
    return (
        f"the stiffness seems to change by {100 * bent:.0f} % within the window: the estimate is its mean, and the "
        "intervals are wider since so steep a course may bend; shorten the window to see"
    )


def _exact_inertia(e: ArmEstimate, limits: TrustLimits) -> str:
    if e.arm.inertia_stderr is not None:
        return ""
    usual = ", ".join(f"{100 * share:g}" for share in USUAL_STDERR)
    meant = (
        "the intervals are those of an arm whose inertia is known exactly"
        if e.own is None
        else f"those that the static task usually leaves are assumed, {usual} %"
    )
    return f"the inertia was given without standard errors: {meant}; give model.arm.inertia_stderr, or [trials.posture]"


def _asymmetric(e: ArmEstimate, limits: TrustLimits) -> str:
    if not np.isfinite(e.covariance).all():
        return ""
    stiffness = criteria(e, "stiffness")
    if not stiffness.surely_asymmetric(limits)[0]:
        return ""
    return (
        f"the stiffness is not symmetric: its antisymmetric part is {_percent(stiffness.asymmetry[0])} of the "
        "symmetric one, as muscles alone do not make it"
    )


WARNINGS: tuple[Callable[[ArmEstimate, TrustLimits], str], ...] = (
    lambda e, limits: window_warning(e.window),
    _of_handle,
    _biased,
    _few_unperturbed,
    _bends,
    _exact_inertia,
    _asymmetric,
)
"""Each in words, or empty where there is nothing to say."""
