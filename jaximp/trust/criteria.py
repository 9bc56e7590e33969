"""What can be asked of a condition number, of an impedance matrix and of an arm's inertia, as measured numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Num
from numpy.typing import NDArray

from jaximp.least_squares.window import Fit, WindowFit
from jaximp.trust.limits import TrustLimits
from jaximp.types import AnyArray, Numbers

USUAL = TrustLimits()


def fake_change_threshold(
    W_reference: Num[AnyArray, "N p"], period_samples: int, window_samples: int
) -> Float[AnyArray, ""]:
    """Threshold on a window's condition number beyond which a change of its parameters is not real.

    **Arguments:** `W_reference` (N, p), the model's observation matrix on one period of the reference trajectory, of
    `period_samples`; `window_samples` the window's length at the same sample rate.

    **Source:** Tout et al. 2023, eqs. (16), (17).
    """
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

    def quasi_symmetric(self, limits: TrustLimits = USUAL) -> NDArray[np.bool_]:
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
    values, covariances = np.asarray(theta)[:, index], _spread(stderr, covariance, index)
    symmetric = values.reshape(-1, 2, 2)
    symmetric = (symmetric + symmetric.swapaxes(1, 2)) / 2
    known = np.isfinite(symmetric).all(axis=(1, 2))
    eigenvalues, v = np.linalg.eigh(np.where(known[:, None, None], symmetric, 0.0))
    # d eigenvalue_k / d K_ij = v_ik v_jk
    slopes = np.einsum("mik,mjk->mkij", v, v).reshape(-1, 2, 4)
    variance = np.einsum("mki,mij,mkj->mk", slopes, covariances, slopes)
    with np.errstate(invalid="ignore", divide="ignore"):
        # The norm of [[0, d], [-d, 0]] with d half the difference is |difference| / sqrt(2).
        size = np.sqrt(2) * np.linalg.norm(symmetric, axis=(1, 2))
        asymmetry = np.abs(values[:, 1] - values[:, 2]) / size
        asymmetry_stderr = np.sqrt(covariances[:, 1, 1] + covariances[:, 2, 2] - 2 * covariances[:, 1, 2]) / size
    unknown = np.where(known, 0.0, np.nan)
    return MatrixCriteria(
        eigenvalues + unknown[:, None],
        np.sqrt(variance) + unknown[:, None],
        asymmetry + unknown,
        asymmetry_stderr + unknown,
    )


def impossible_body(
    names: Sequence[str],
    theta: Num[AnyArray, "M p"],
    stderr: Num[AnyArray, "M p"],
    errors: float,
    covariance: Num[AnyArray, "M p p"] | None = None,
) -> NDArray[np.bool_]:
    """(M,) whether an arm's base inertial parameters belong to no rigid body, by so many standard errors."""
    return body_margin(names, theta, stderr, covariance) < -errors


def body_margin(
    names: Sequence[str],
    theta: Num[AnyArray, "M p"],
    stderr: Num[AnyArray, "M p"],
    covariance: Num[AnyArray, "M p p"] | None = None,
) -> Numbers:
    """(M,) how far inside of what a rigid body can have an arm's base inertial parameters lie, in standard errors;
    infinite for a model without them.

    With `inertia_1 = I_1 + m_2 l1^2 + I_2`, `inertia_2 = m_2 c_2 l1`, `inertia_3 = I_2`: the last is above zero, so is
    the second (a forearm lies beyond the elbow), and `(inertia_1 - inertia_3) inertia_3 > inertia_2^2`, without which
    the mass matrix is not positive definite. Without the `covariance` the errors are taken as independent.
    """
    wanted = [f"inertia_{k}" for k in (1, 2, 3)]
    if not set(wanted) <= set(names):
        return np.full(len(theta), np.inf)
    index = np.array([list(names).index(name) for name in wanted])
    (first, second, third), error = np.asarray(theta)[:, index].T, np.asarray(stderr)[:, index].T
    spread = _spread(stderr, covariance, index)
    margin = (first - third) * third - second**2
    slope = np.stack([third, -2 * second, first - 2 * third], axis=1)
    margin_error = np.sqrt(np.einsum("mi,mij,mj->m", slope, spread, slope))
    with np.errstate(invalid="ignore"):
        found = np.stack([third / error[2], second / error[1], margin / margin_error])
    return np.asarray(np.where(np.isnan(found), np.inf, found).min(axis=0))


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
            "explained torque": self.vaf >= self.limits.usual_vaf,
            "held-out torque": self.held_out_vaf >= self.limits.usual_vaf,
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
    limits: TrustLimits = USUAL,
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
