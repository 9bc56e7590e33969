"""Which windows to believe: the threshold for fake changes, and a verdict with its reason for every window."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num
from numpy.typing import NDArray

from jaximp.least_squares.window import Fit, SlidingFit, WindowFit
from jaximp.types import AnyArray, Numbers, nearest

TRUSTED, WEAK, POOR, NO_DATA, FAKE = "trusted", "weak excitation", "poor fit", "no data", "fake change"
NEGATIVE = "is negative, as no mass can be"
"""Part of the reason that a wrong sign of the torque leads to."""
Rule = tuple[NDArray[np.bool_], str, Callable[[int], str]]
"""Which windows break it, the verdict, and the reason of a window."""
VERDICTS = (TRUSTED, WEAK, FAKE, POOR, NO_DATA)


@dataclass(frozen=True)
class TrustLimits:
    """What a window must keep to be trusted."""

    min_vaf: float = 0.75
    """Share of the torque's variance that the model must explain."""
    max_residual_ratio: float = 4.0
    """Largest residual and largest unexplained share of the torque's variance, as multiples of their lower quartiles
    over the excited windows: where both are above, something happened that the model does not know, such as a parameter
    that changes inside the window."""
    min_dof: float = 3.0
    """Fewest degrees of freedom: with less a standard error is itself a matter of luck."""
    max_negative_inertia: float = 5.0
    """How far below zero an inertia or a friction may come out, in standard errors; beyond, torque's sign or model is
    wrong."""
    max_relative_stderr: float = 0.2
    """Largest standard error, as a share of the parameter or of what would explain the whole torque by itself."""
    min_excitation_ratio: float = 5.0
    """How far each column must rise above what noise in the position alone would build: a ratio r biases the
    estimate by about 1/r^2, four percent at 5."""
    min_valid_share: float = 0.5
    """Share of a window's samples that must have been measured and moving."""
    max_asymmetry: float = 0.2
    """Of an arm's stiffness: antisymmetric over symmetric part (Lakatos et al. 2011, eq. 22), if it is beyond error."""
    errors_apart: float = 2.0
    """A window's matrix is not positive definite, or not symmetric, if that is so by so many standard errors; and it is
    surely positive definite (`confidence`) by so many."""
    max_condition: float | None = None
    """Largest condition number (eq. 19 there); it depends on the units, and the paper knows no limit."""
    parameters: tuple[str, ...] = ()
    """The parameters that matter: only their standard errors and excitation are judged. Empty for all of them."""


def fake_change_threshold(
    W_reference: Num[AnyArray, "N p"], period_samples: int, window_samples: int
) -> Float[AnyArray, ""]:
    """Threshold on a window's condition number beyond which a change of its parameters is not real.

    **Arguments:** `W_reference` (N, p), the model's observation matrix on one period of the reference trajectory, of
    `period_samples`; `window_samples` the window's length at the same sample rate.

    **Source:** Tout et al. 2023, eqs. (16), (17).
    """
    # A library call by itself is left to numpy: two compiled programs with LAPACK can block each other on few cores.
    svd = np.linalg.svd if isinstance(W_reference, np.ndarray) else jnp.linalg.svd
    singular = svd(W_reference, compute_uv=False)
    return singular[0] / singular[-1] * period_samples / window_samples


@dataclass(frozen=True)
class MatrixCriteria:
    """What an impedance matrix must be to be believed, of M windows: eqs. (20), (22) of Lakatos et al. 2011.

    Standard errors are of first order: `v' dK v` for an eigenvalue.
    """

    eigenvalues: Numbers
    """(M, 2) of the symmetric part, smallest first."""
    eigenvalue_stderr: Numbers
    """(M, 2)."""
    asymmetry: Numbers
    """(M,) norm of the antisymmetric over that of the symmetric part."""
    asymmetry_stderr: Numbers
    """(M,)."""

    def surely_definite(self, errors: float) -> NDArray[np.bool_]:
        """(M,) positive definite, eq. (20), by so many standard errors."""
        return self.eigenvalues[:, 0] > errors * self.eigenvalue_stderr[:, 0]

    def surely_indefinite(self, errors: float) -> NDArray[np.bool_]:
        """(M,) not positive definite by so many standard errors."""
        return self.eigenvalues[:, 0] < -errors * self.eigenvalue_stderr[:, 0]

    def quasi_symmetric(self, limits: TrustLimits = TrustLimits()) -> NDArray[np.bool_]:
        """(M,) eq. (22), up to `limits.max_asymmetry`."""
        return self.asymmetry <= limits.max_asymmetry

    def surely_asymmetric(self, limits: TrustLimits) -> NDArray[np.bool_]:
        """(M,) beyond `limits.max_asymmetry`, and from zero by so many standard errors."""
        return ~self.quasi_symmetric(limits) & (self.asymmetry > limits.errors_apart * self.asymmetry_stderr)


def matrix_criteria(
    names: Sequence[str],
    which: str,
    theta: Num[AnyArray, "M p"],
    stderr: Num[AnyArray, "M p"],
    covariance: Num[AnyArray, "M p p"] | None = None,
) -> MatrixCriteria | None:
    """Criteria of the matrix `which`, `stiffness` or `damping`, whose elements are called `stiffness_11` and so on.

    **Arguments:** without the `covariance` the errors of the elements are taken as independent.

    **Returns:** None for a model without such a matrix.
    """
    elements = [f"{which}_{i}{j}" for i in (1, 2) for j in (1, 2)]
    if not set(elements) <= set(names):
        return None
    index = np.array([list(names).index(element) for element in elements])
    values, spread = np.asarray(theta)[:, index], _spread(stderr, covariance, index)
    symmetric = values.reshape(-1, 2, 2)
    symmetric = (symmetric + symmetric.swapaxes(1, 2)) / 2
    known = np.isfinite(symmetric).all(axis=(1, 2))
    eigenvalues, v = np.linalg.eigh(np.where(known[:, None, None], symmetric, 0.0))
    slopes = np.einsum("mik,mjk->mkij", v, v).reshape(-1, 2, 4)
    variance = np.einsum("mki,mij,mkj->mk", slopes, spread, slopes)
    with np.errstate(invalid="ignore", divide="ignore"):
        # The norm of [[0, d], [-d, 0]] with d half the difference is |difference| / sqrt(2).
        size = np.sqrt(2) * np.linalg.norm(symmetric, axis=(1, 2))
        asymmetry = np.abs(values[:, 1] - values[:, 2]) / size
        asymmetry_stderr = np.sqrt(spread[:, 1, 1] + spread[:, 2, 2] - 2 * spread[:, 1, 2]) / size
    gone = np.where(known, 0.0, np.nan)
    return MatrixCriteria(
        eigenvalues + gone[:, None], np.sqrt(variance) + gone[:, None], asymmetry + gone, asymmetry_stderr + gone
    )


def impossible_body(
    names: Sequence[str],
    theta: Num[AnyArray, "M p"],
    stderr: Num[AnyArray, "M p"],
    errors: float,
    covariance: Num[AnyArray, "M p p"] | None = None,
) -> NDArray[np.bool_]:
    """(M,) whether an arm's base inertial parameters belong to no rigid body, by so many standard errors.

    With `inertia_1 = I_1 + m_2 l1^2 + I_2`, `inertia_2 = m_2 c_2 l1`, `inertia_3 = I_2`: the last is above zero, so is
    the second (a forearm lies beyond the elbow), and `(inertia_1 - inertia_3) inertia_3 > inertia_2^2`, without which
    the mass matrix is not positive definite. Without the `covariance` the errors are taken as independent.
    """
    wanted = [f"inertia_{k}" for k in (1, 2, 3)]
    if not set(wanted) <= set(names):
        return np.zeros(len(theta), bool)
    index = np.array([list(names).index(name) for name in wanted])
    (first, second, third), error = np.asarray(theta)[:, index].T, np.asarray(stderr)[:, index].T
    spread = _spread(stderr, covariance, index)
    margin = (first - third) * third - second**2
    slope = np.stack([third, -2 * second, first - 2 * third], axis=1)
    margin_error = np.sqrt(np.einsum("mi,mij,mj->m", slope, spread, slope))
    with np.errstate(invalid="ignore"):
        found = np.stack([third / error[2], second / error[1], margin / margin_error])
        return np.asarray((found < -errors).any(axis=0))


def _spread(stderr: AnyArray, covariance: AnyArray | None, index: NDArray[np.int64]) -> Numbers:
    """(M, k, k) covariance of some parameters; of independent ones where it is not known."""
    if covariance is not None:
        return np.asarray(np.asarray(covariance)[:, index[:, None], index])
    return np.asarray(stderr)[:, index, None] ** 2 * np.eye(len(index))


@dataclass(frozen=True)
class Confidence:
    """Whether to trust the impedance of an arm, of M estimates: one verdict and its parts.

    It does not know where the shoulder is, how long the arm is, or when the perturbation began: wrong ones of these
    give matrices that look as good as any.

    **Source:** Lakatos et al. 2011, III-C, eqs. (19), (20), (22); standard errors and the prediction of unseen torque
    go beyond it.
    """

    condition: Numbers
    """(M,) eq. (19)."""
    stiffness: MatrixCriteria
    damping: MatrixCriteria
    relative_stderr: Numbers
    """(M,) largest standard error of an element, as a share of its matrix's norm."""
    dof: Numbers
    """(M,) degrees of freedom of the standard errors."""
    body: NDArray[np.bool_]
    """(M,) a rigid body can have this inertia (`impossible_body`)."""
    vaf: Numbers
    """(M,) share of the torque's variance that the estimate explains."""
    held_out_vaf: Numbers
    """(M,) share of the variance of unseen torque that is predicted."""
    limits: TrustLimits

    @property
    def parts(self) -> dict[str, NDArray[np.bool_]]:
        """(M,) which criterion is met."""
        most = np.inf if self.limits.max_condition is None else self.limits.max_condition
        return {
            "condition": self.condition <= most,
            "inertia of a rigid body": self.body,
            "stiffness positive definite": self.stiffness.surely_definite(self.limits.errors_apart),
            "damping positive definite": self.damping.surely_definite(self.limits.errors_apart),
            "stiffness quasi-symmetric": self.stiffness.quasi_symmetric(self.limits),
            "damping quasi-symmetric": self.damping.quasi_symmetric(self.limits),
            "standard errors": (self.relative_stderr <= self.limits.max_relative_stderr)
            & (self.dof >= self.limits.min_dof),
            "explained torque": self.vaf >= self.limits.min_vaf,
            "held-out torque": self.held_out_vaf >= self.limits.min_vaf,
        }

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """(M,) every criterion is met."""
        return np.all(list(self.parts.values()), axis=0)

    def in_words(self, k: int = 0) -> list[str]:
        """The parts of one estimate, a line each."""
        lines = [f"condition number {self.condition[k]:.3g}"]
        for which, found in (("stiffness", self.stiffness), ("damping", self.damping)):
            low, error = found.eigenvalues[k, 0], found.eigenvalue_stderr[k, 0]
            lines.append(f"{which}: smallest eigenvalue {low:.3g} ± {error:.2g}")
            share, error = found.asymmetry[k], found.asymmetry_stderr[k]
            lines.append(f"{which}: antisymmetric part {share:.1%} ± {error:.1%} of the symmetric one")
        lines.append(f"largest standard error {self.relative_stderr[k]:.1%} of the matrix")
        lines.append(f"torque explained to {self.vaf[k]:.1%}, unseen torque predicted to {self.held_out_vaf[k]:.1%}")
        failed = [name for name, kept in self.parts.items() if not kept[k]]
        if self.stiffness.eigenvalues[k, 1] < 0 and self.damping.eigenvalues[k, 1] < 0:
            failed.append("everything is negative (does the force need sign = -1?)")
        return [*lines, f"not met: {', '.join(failed)}" if failed else "trusted"]


def confidence(
    names: Sequence[str],
    fit: Fit,
    held_out_vaf: float | Num[AnyArray, "*M"],
    limits: TrustLimits = TrustLimits(),
) -> Confidence:
    """Judge the estimates of an arm with damping and stiffness, of one window or of M.

    **Arguments:** `names` (p) of the parameters; `held_out_vaf`, variance accounted for in trials or windows that the
    estimates have not seen, as `predict_trials` and `identify` measure it.

    **Raises:** `ValueError` for a model without an arm's damping and stiffness.
    """
    p = len(names)
    theta, stderr = (np.asarray(x).reshape(-1, p) for x in (fit.theta, fit.stderr))
    covariance = np.asarray(fit.covariance).reshape(-1, p, p) if isinstance(fit, WindowFit) else None
    K, D = (matrix_criteria(names, which, theta, stderr, covariance) for which in ("stiffness", "damping"))
    if K is None or D is None:
        raise ValueError(
            f"these are the criteria of an arm's damping and stiffness, but the model has {', '.join(names)}"
        )
    shares = []
    for which in ("stiffness", "damping"):
        index = [k for k, name in enumerate(names) if name.startswith(f"{which}_")]
        shares.append(stderr[:, index].max(axis=1) / np.linalg.norm(theta[:, index], axis=1))
    cond, dof, vaf, unseen = (
        np.broadcast_to(np.asarray(x), len(theta)) for x in (fit.cond, fit.dof, fit.vaf, held_out_vaf)
    )
    body = ~impossible_body(names, theta, stderr, limits.errors_apart, covariance)
    return Confidence(cond, K, D, np.max(shares, axis=0), dof, body, vaf, unseen, limits)


@dataclass(frozen=True)
class Verdicts:
    """One plain word per window, and the measured number behind it."""

    verdict: NDArray[Any]
    """(M,) one of `VERDICTS`."""
    reason: NDArray[Any]
    """(M,) a sentence; empty where the window is trusted."""

    @property
    def trusted(self) -> NDArray[np.bool_]:
        return self.verdict == TRUSTED

    def counts(self) -> dict[str, int]:
        """How many windows got each verdict."""
        return {verdict: int((self.verdict == verdict).sum()) for verdict in VERDICTS}

    def complaint(self) -> str:
        """Where no window can be trusted, what is said of the first that has the most frequent verdict; else empty."""
        if self.trusted.any() or not len(self.verdict):
            return ""
        counts = self.counts()
        first = int(np.argmax(self.verdict == max(counts, key=lambda name: counts[name])))
        return f"no window can be trusted, for example: {self.reason[first]}"


def worst(several: Sequence[Verdicts], labels: Sequence[str]) -> Verdicts:
    """The worst verdict of several on the same windows, its reason behind a label."""
    severity = {verdict: rank for rank, verdict in enumerate((TRUSTED, POOR, FAKE, WEAK, NO_DATA))}
    ranks = np.array([[severity[name] for name in one.verdict] for one in several])
    chosen = ranks.argmax(axis=0)
    verdict = [several[j].verdict[k] for k, j in enumerate(chosen)]
    reason = ["" if verdict[k] == TRUSTED else labels[j] + several[j].reason[k] for k, j in enumerate(chosen)]
    return Verdicts(np.array(verdict), np.array(reason))


def judge(
    fit: SlidingFit,
    names: tuple[str, ...],
    window_samples: int,
    parameter_scale: NDArray[np.float64],
    column_noise: NDArray[np.float64],
    threshold: float | None = None,
    limits: TrustLimits = TrustLimits(),
) -> Verdicts:
    """Give every window its verdict; the first rule that a window breaks names it.

    1. *no data*: too few samples were measured (and moving).
    2. *weak excitation*: columns are collinear, or no larger than noise in the position makes them, or a standard
       error is too large. The condition number alone cannot tell: on a still arm, noise builds a well conditioned
       regressor.
    3. *fake change*: the condition number is above the threshold of eqs. (16), (17), where one is given.
    4. *poor fit*: the model explains too little of the torque, or much less than in other windows, or gives a negative
       inertia or friction, or an arm's inertia, stiffness or damping that cannot be (`impossible_body`,
       `matrix_criteria`).

    **Arguments:** `names` (p) of the parameters; `window_samples` torque samples in a full window;
    `parameter_scale` (p,) the size of each parameter that would explain the whole recording's torque by itself;
    `column_noise` (p,) root mean square of each column that noise in the position alone gives.
    """
    # One row per parameter: what is worked out over the parameters then runs along the windows.
    theta, stderr, excitation = (np.ascontiguousarray(np.asarray(x).T) for x in (fit.theta, fit.stderr, fit.excitation))
    samples, cond, vaf, residual = (np.asarray(x) for x in (fit.samples, fit.cond, fit.vaf, fit.residual_rms))
    dof = np.asarray(fit.dof)
    with np.errstate(invalid="ignore", divide="ignore"):
        error = stderr / np.maximum(np.abs(theta), parameter_scale[:, None])
        built_by_noise = np.sqrt(samples) * column_noise[:, None]
        ratio = np.where(built_by_noise > 0, excitation / built_by_noise, np.inf)
        negative = -theta / stderr
    judged = _judged(names, limits.parameters)[:, None]
    error, ratio = np.where(judged, error, 0.0), np.where(judged, ratio, np.inf)
    noisiest, loosest = ratio.argmin(axis=0), error.argmax(axis=0)
    ratio, error = ratio.min(axis=0), error.max(axis=0)
    rules: list[Rule] = [
        (
            (samples < limits.min_valid_share * window_samples) | (samples < len(names)),
            NO_DATA,
            lambda k: f"{samples[k]} of {window_samples} samples can be used",
        ),
        (
            ~np.isfinite(theta).all(axis=0),
            WEAK,
            lambda k: "columns are zero or collinear: the parameters cannot be told apart",
        ),
        (
            ratio < limits.min_excitation_ratio,
            WEAK,
            lambda k: (
                f"{names[noisiest[k]]}: its column is {ratio[k]:.2g} times what position noise alone builds: "
                "move more, or filter more (filter.position_cutoff)"
            ),
        ),
        (
            dof < limits.min_dof,
            WEAK,
            lambda k: f"{dof[k]:.2g} degrees of freedom are too few to know its own errors",
        ),
        (
            ~(error <= limits.max_relative_stderr),
            WEAK,
            lambda k: f"{names[loosest[k]]}: its standard error is {error[k]:.0%} of its size",
        ),
        (
            cond > (np.inf if limits.max_condition is None else limits.max_condition),
            WEAK,
            lambda k: f"the condition number {cond[k]:.3g} is above {limits.max_condition:.3g}",
        ),
        (
            np.full(len(cond), False) if threshold is None else ~(cond < threshold),
            FAKE,
            lambda k: f"the condition number {cond[k]:.3g} is not below the threshold {threshold:.3g}",
        ),
        (
            ~(vaf >= limits.min_vaf),
            POOR,
            lambda k: f"the model explains {vaf[k]:.0%} of the torque's variance",
        ),
    ]
    excited = ~np.any([mask for mask, verdict, _ in rules if verdict in (NO_DATA, WEAK)], axis=0)
    usual, usual_share = (_lower_quartile(values[excited]) for values in (residual, 1 - vaf))
    rules.append(
        (
            # Both: a larger motion has a larger residual, a smaller one explains a smaller share, and neither is wrong.
            (residual > limits.max_residual_ratio * usual) & (1 - vaf > limits.max_residual_ratio * usual_share),
            POOR,
            lambda k: (
                f"the residual is {residual[k] / usual:.2g} times that of other windows: did the joint change here?"
            ),
        )
    )
    mass = np.array([name.endswith(("inertia", "inertia_1", "inertia_3")) for name in names])
    below_zero = np.where(mass[:, None], negative, -np.inf).max(axis=0)
    rules.append(
        (
            below_zero > limits.max_negative_inertia,
            POOR,
            lambda k: (
                f"the inertia {NEGATIVE}, by {below_zero[k]:.2g} standard errors: does the torque need sign = -1?"
            ),
        )
    )
    friction = np.array([name.rstrip("_12").endswith(("viscous_friction", "coulomb_friction")) for name in names])
    drives = np.where(friction[:, None], negative, -np.inf)
    rules.append(
        (
            drives.max(axis=0) > limits.max_negative_inertia,
            POOR,
            lambda k: f"{names[int(drives[:, k].argmax())]} is negative, by {drives[:, k].max():.2g} standard errors",
        )
    )
    rules += _matrix_rules(fit, names, limits)
    broken = np.stack([mask for mask, _, _ in rules])
    first = np.where(broken.any(axis=0), broken.argmax(axis=0), len(rules))
    verdict = np.array([name for _, name, _ in rules] + [TRUSTED])[first]
    reason = [""] * len(first)
    for k in np.flatnonzero(first < len(rules)):
        reason[k] = rules[first[k]][2](k)
    return Verdicts(verdict, np.array(reason))


def _matrix_rules(fit: SlidingFit, names: tuple[str, ...], limits: TrustLimits) -> list[Rule]:
    """An arm's stiffness and damping store and take energy, and its stiffness has a potential."""

    def indefinite(which: str, found: MatrixCriteria) -> Rule:
        return (
            found.surely_indefinite(limits.errors_apart),
            POOR,
            lambda k: f"the {which} is not positive definite: its smallest eigenvalue is {found.eigenvalues[k, 0]:.3g}",
        )

    stiffness, damping = (matrix_criteria(names, which, fit.theta, fit.stderr) for which in ("stiffness", "damping"))
    rules: list[Rule] = [
        (
            impossible_body(names, fit.theta, fit.stderr, limits.errors_apart),
            POOR,
            lambda k: "no rigid body has this inertia: are the joints swapped, or the angles in other units?",
        )
    ]
    if damping is not None:
        rules.append(indefinite("damping", damping))
    if stiffness is not None:
        rules.append(indefinite("stiffness", stiffness))
        rules.append(
            (
                stiffness.surely_asymmetric(limits),
                POOR,
                lambda k: f"the stiffness is not symmetric: its antisymmetric part is {stiffness.asymmetry[k]:.0%}",
            )
        )
    return rules


def _lower_quartile(values: Numbers) -> float:
    """Of the values above zero: a window without any torque has no residual to compare with."""
    known = values[np.isfinite(values) & (values > 0)]
    return float(np.quantile(known, 0.25)) if len(known) else np.inf


def _judged(names: tuple[str, ...], chosen: tuple[str, ...]) -> NDArray[np.bool_]:
    """Which parameters the verdict looks at."""
    for name in chosen:
        if name not in names:
            raise ValueError(f"trust.parameters has an unknown parameter '{name}': {nearest(name, list(names))}")
    return np.array([not chosen or name in chosen for name in names])
