"""Damping and stiffness of two joints from how they answer to perturbations, the stiffness symmetric and definite.

The model of Börner et al. 2020, eqs. (36) to (38): `torque = D velocity + K displacement`, of what a perturbation adds
to the motion and to the torque of an outside force, less what the inertia takes. K = L L' (Cholesky), which
`numerics.definite` keeps definite while it is fitted.

Least squares problems with these residuals need no samples once the triangle R of a thin QR decomposition of
`[velocity, displacement, torque]` is known: the sum of squares is that of `R [D'; K'; -I]`. So the triangles of trials
are computed once, merged in any selection, and fitted by the thousand.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Num, Shaped
from numpy.typing import NDArray

from jaximp.numerics.definite import Semidefinite, semidefinite_least_squares
from jaximp.numerics.linear_algebra import back_substitute, triangle
from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray

FEWEST_TRIALS = 5
"""From fewer the scatter of trials cannot be judged, and there is no covariance."""
LANES = 256
"""So many fits go together: all of them wait for the slowest, and their numbers stay in the cache."""
REASONS = (
    "",
    "a number is not finite",
    "fewer samples than parameters",
    "velocities and displacements are co-linear: perturb the joints in at least two directions",
    "did not converge",
)
"""Why a fit failed, by its `reason`."""

MATRICES = {"damping": "N m s/rad", "stiffness": "N m/rad"}
"""What the torque of a deviation is made of, and its unit."""
PARTS = tuple((matrix, i, j) for matrix in MATRICES for i in (1, 2) for j in (1, 2))
ELEMENTS = tuple(f"{matrix}_{i}{j}" for matrix, i, j in PARTS)
"""`damping_11` to `stiffness_22`, row by row: the torque of joint i for the motion of joint j, as in `PlanarArm`."""
MATRIX_OF = dict(zip(ELEMENTS, (matrix for matrix, _, _ in PARTS), strict=True))
SYMMETRIC_ELEMENTS = tuple(name for name in ELEMENTS if name != "stiffness_21")
"""Where the stiffness is symmetric: its elements 11, 12 and 22."""
# Each row an element, each column a parameter; where K is constrained its parameters are the last three.
SYMMETRIC = np.array([[1.0, 0, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]])
EIGHT = np.eye(8)
SEVEN = np.block([[np.eye(4), np.zeros((4, 3))], [np.zeros((4, 4)), SYMMETRIC]])
SIX = np.kron(np.eye(2), SYMMETRIC)
DAMPING = {"free": (SEVEN, 3), "symmetric": (SIX, 3), "positive definite": (SIX, 6)}
"""For each kind of damping the elements as parameters, and how many of these are in definite matrices."""


class LinearFit(eqx.Module):
    """Damping and stiffness of a batch of fits. One that failed is NaN throughout, `samples` apart."""

    D: Float[Array, "*B 2 2"]
    """Damping [N m s/rad]."""
    K: Float[Array, "*B 2 2"]
    """Stiffness [N m/rad]."""
    covariance: Float[Array, "*B p p"]
    """Of the elements `theta`, by leaving out one trial at a time; NaN with fewer than `FEWEST_TRIALS` trials."""
    dof: Float[Array, "*B"]
    """Trials less one: a quantile of Student's t with so many degrees of freedom makes an interval."""
    residual_rms: Float[Array, "*B"]
    """Root of the mean squared residual [N m]."""
    samples: Int[Array, "*B"]
    """How many samples counted, each of them two torques."""
    reason: Int[Array, "*B"]
    """Why the fit failed, as an index of `REASONS`; zero if it did not."""

    @property
    def ok(self) -> Bool[Array, "*B"]:
        """Whether there is an estimate."""
        return self.reason == 0

    @property
    def theta(self) -> Float[Array, "*B p"]:
        """`ELEMENTS`, or where K is symmetric `SYMMETRIC_ELEMENTS`."""
        return _elements(self.D, self.K, self.covariance.shape[-1])

    @property
    def stderr(self) -> Float[Array, "*B p"]:
        """Standard errors of `theta`."""
        return _standard_errors(self.covariance)

    def why(self) -> np.ndarray:
        """In words why each fit failed; empty where it did not."""
        return np.array(REASONS)[np.asarray(self.reason)]


class StiffnessFit(LinearFit):
    """Damping, and a stiffness that is symmetric and positive semidefinite.

    The covariance, of `SYMMETRIC_ELEMENTS`, is that of the estimate without the demand of definiteness.
    Where this holds the estimate (`on_boundary`) it is too large rather than too small: the estimate is the other one's
    projection onto a convex set, which brings no two points further apart.
    """

    L: Float[Array, "*B 2 2"]
    """Lower triangular, its diagonal of at least zero: K = L L'."""
    on_boundary: Bool[Array, "*B"]
    """K (or D, where it must be definite too) is singular, since the optimum would be indefinite without the demand."""


def residual_triangle(
    displacement: Num[AnyArray, "*B N 2"],
    velocity: Num[AnyArray, "*B N 2"],
    torque: Num[AnyArray, "*B N 2"],
    valid: Shaped[AnyArray, "*B N"] | None = None,
) -> Float[Array, "*B 6 6"]:
    """Upper triangles R of thin QR decompositions of `[velocity, displacement, torque]`, each of one trial.

    **Arguments:** displacements [rad], velocities [rad/s] and torques [N m] of two joints; `valid` False for samples
    that must not count, whatever they hold.

    **Raises:** ValueError where float64 is off.
    """
    require_float64(displacement, velocity, torque)
    columns = [jnp.asarray(x) for x in (velocity, displacement, torque)]
    return _triangles_of(columns, np.ones(columns[0].shape[:-1], bool) if valid is None else jnp.asarray(valid, bool))


def merge_triangles(
    triangles: Float[AnyArray, "*B T 6 6"], counts: Shaped[AnyArray, "*B T"] | None = None
) -> Float[Array, "*B 6 6"]:
    """The triangles of all T trials together; `counts` False for trials that must not count, whatever they hold."""
    triangles = jnp.asarray(triangles)
    rows = triangles.reshape(*triangles.shape[:-3], -1, 6)
    counts = jnp.ones(triangles.shape[:-2], bool) if counts is None else jnp.asarray(counts, bool)
    return _triangles(rows, jnp.repeat(counts, 6, axis=-1))


def fit_stiffness(
    displacement: Num[AnyArray, "*T N 2"],
    velocity: Num[AnyArray, "*T N 2"],
    torque: Num[AnyArray, "*T N 2"],
    *,
    damping: str = "free",
    valid: Shaped[AnyArray, "*T N"] | None = None,
) -> StiffnessFit:
    """Fit `torque = D velocity + L L' displacement` to one trial (N, 2) or to T trials (T, N, 2) together.

    **Arguments:** what the perturbation adds to the angles [rad], the angular velocities [rad/s] and the torques of the
    outside force [N m], the inertial torque subtracted; `damping` is `free` (four numbers), `symmetric`, or
    `positive definite` (and symmetric); `valid` False for samples that must not count.

    **Raises:** ValueError for arrays of other or unequal shapes, a kind of damping that does not exist, or float64 that
    is off. Data that leave parameters undetermined, or are not finite, give a fit that is not `ok`.

    **Source:** Börner et al. 2020, eqs. (36) to (38).

    **Example:**

    ```pycon
    >>> x, v = np.random.default_rng(0).normal(size=(2, 500, 2))
    >>> torque = v @ [[2, 0.5], [0.5, 1]] + x @ [[30, 10], [10, 20]]
    >>> fit = jaximp.fit_stiffness(x, v, torque)
    >>> print(fit.K.round(1))
    [[30. 10.]
     [10. 20.]]

    ```
    """
    return fit_triangles(*_trials(displacement, velocity, torque, valid), damping=damping)


def fit_stiffness_linear(
    displacement: Num[AnyArray, "*T N 2"],
    velocity: Num[AnyArray, "*T N 2"],
    torque: Num[AnyArray, "*T N 2"],
    *,
    valid: Shaped[AnyArray, "*T N"] | None = None,
) -> LinearFit:
    """As `fit_stiffness` by linear least squares, with four free numbers of stiffness: Börner et al. 2020, eq. (35)."""
    return fit_triangles_linear(*_trials(displacement, velocity, torque, valid))


def fit_triangles(
    triangles: Float[AnyArray, "*B T 6 6"],
    samples: int | Int[AnyArray, "*b"],
    *,
    damping: str = "free",
    counts: Shaped[AnyArray, "*B T"] | None = None,
) -> StiffnessFit:
    """Fit the T trials of each element of a batch together, from the triangles of the trials (`residual_triangle`).

    A pure function, for `jit`, `vmap` and `grad`: D and K have exact derivatives along the triangles, also where K is
    singular, other than zero.

    **Arguments:** `samples` of each trial, of a shape that broadcasts to (*B, T); `counts` False for trials that must
    not count; `damping` as in `fit_stiffness`.

    **Returns:** a `StiffnessFit`. Residuals within a trial are anything but independent, so its covariance is that of
    whole trials: the jackknife `(T - 1)/T sum d d'`, d by how much the estimate moves without one of the trials.

    **Raises:** ValueError for a kind of damping that does not exist, or float64 that is off.
    """
    if damping not in DAMPING:
        raise ValueError(f"damping is '{damping}': it must be {', '.join(repr(kind) for kind in DAMPING)}")
    n = DAMPING[damping][1]
    problem = _linear_problem(*_batch(triangles, samples, counts), damping)
    found = _definite(problem.R[..., -n:, -n:], problem.right[..., -n:])
    return _constrained_fit(problem, found, damping)


def fit_triangles_linear(
    triangles: Float[AnyArray, "*B T 6 6"],
    samples: int | Int[AnyArray, "*b"],
    *,
    counts: Shaped[AnyArray, "*B T"] | None = None,
) -> LinearFit:
    """As `fit_triangles` by linear least squares, with four free numbers of stiffness."""
    return _linear_fit(_linear_problem(*_batch(triangles, samples, counts), None))


def _trials(displacement: AnyArray, velocity: AnyArray, torque: AnyArray, valid: AnyArray | None) -> tuple[Array, Any]:
    """Triangle and number of samples of each trial."""
    arrays = [jnp.asarray(x) for x in (displacement, velocity, torque)]
    shapes = [x.shape for x in arrays]
    if len(set(shapes)) > 1 or len(shapes[0]) not in (2, 3) or shapes[0][-1] != 2:
        raise ValueError(
            f"displacement, velocity and torque have the shapes {shapes[0]}, {shapes[1]} and {shapes[2]}: all must be "
            "(samples, 2), or (trials, samples, 2)"
        )
    valid = jnp.ones(shapes[0][:-1], bool) if valid is None else jnp.asarray(valid, bool)
    if valid.shape != shapes[0][:-1]:
        raise ValueError(f"valid has the shape {valid.shape}: one for each sample is {shapes[0][:-1]}")
    triangles = residual_triangle(arrays[0], arrays[1], arrays[2], valid)
    return triangles.reshape(-1, 6, 6), valid.sum(axis=-1).reshape(-1)


def _batch(triangles: AnyArray, samples: AnyArray, counts: AnyArray | None) -> tuple[Array, Array, Array]:
    require_float64(triangles)
    triangles = jnp.asarray(triangles)
    shape = triangles.shape[:-2]
    counts = jnp.ones(shape, bool) if counts is None else jnp.asarray(counts, bool)
    return triangles, jnp.broadcast_to(jnp.asarray(samples), shape), counts


@jax.jit
def _triangles_of(columns: list[Array], valid: Array) -> Array:
    return _triangles(jnp.concatenate(columns, axis=-1), valid)


@jax.jit
def _triangles(rows: Array, valid: Array) -> Array:
    """Triangles of (*B, N, 6), of the rows that count."""
    rows = jnp.where(valid[..., None], rows, 0).swapaxes(-1, -2)
    return jax.vmap(triangle)(rows.reshape(-1, *rows.shape[-2:])).reshape(*rows.shape[:-2], 6, 6)


class _Problem(eqx.Module):
    """Linear least squares problems, with what they say of the estimate without any constraint."""

    R: Float[Array, "*B p p"]
    """Upper triangle of the columns of the parameters."""
    right: Float[Array, "*B p"]
    """The torque along them."""
    left: Float[Array, "*B"]
    """Norm of the torque across them all [N m]."""
    linear: Float[Array, "*B p"]
    covariance: Float[Array, "*B e e"]
    """Of the elements that stand for the matrices."""
    trials: Int[Array, "*B"]
    samples: Int[Array, "*B"]
    reason: Int[Array, "*B"]


@partial(jax.jit, static_argnums=3)
def _linear_problem(triangles: Array, samples: Array, counts: Array, damping: str | None) -> _Problem:
    elements = EIGHT if damping is None else DAMPING[damping][0]
    one = partial(_one_problem, elements=elements)
    for _ in counts.shape[:-1]:
        one = jax.vmap(one)
    return one(triangles, samples, counts)


def _one_problem(triangles: Array, samples: Array, counts: Array, elements: NDArray[np.float64]) -> _Problem:
    """The problem of T trials together."""
    p, n_samples = elements.shape[1], jnp.where(counts, samples, 0).sum()
    finite = (jnp.isfinite(triangles).all(axis=(1, 2)) | ~counts).all()
    triangles = jnp.where((counts & finite)[:, None, None], triangles, 0)
    whole = triangle(element_columns(triangle(triangles.reshape(-1, 6).T), elements))
    R, right = whole[:p, :p], whole[:p, p]
    negligible = jnp.maximum(n_samples, 12) * jnp.finfo(R.dtype).eps
    determined = (jnp.diagonal(R) > negligible * jnp.sqrt((R**2).sum(axis=0))).all()
    R = jnp.where(determined, R, jnp.eye(p, dtype=R.dtype))
    linear, given = back_substitute(R, right), elements[_given(8 if elements is EIGHT else 7)]
    covariance = _jackknife(R, jax.vmap(partial(element_columns, elements=elements))(triangles), linear, counts)
    return _Problem(
        R=R,
        right=right,
        left=whole[p, p],
        linear=linear,
        covariance=_times(_times(given, covariance), given.T),
        trials=counts.sum(),
        samples=n_samples,
        reason=jnp.select([~finite, 2 * n_samples < p, ~determined], [1, 2, 3], 0),
    )


def _definite(C: Array, right: Array) -> Semidefinite:
    """Batches of constrained problems, filled up to a few sizes that are compiled once."""
    *batch, n = right.shape
    C, right = C.reshape(-1, n, n), right.reshape(-1, n)
    n_fits = len(right)
    whole = n_fits if n_fits < 2 else -(-n_fits // LANES) * LANES
    found = _definite_lanes(jnp.resize(C, (whole, n, n)), jnp.resize(right, (whole, n)))
    return jax.tree.map(lambda x: x[:n_fits].reshape(*batch, *x.shape[1:]), found)


@jax.jit
def _definite_lanes(C: Array, right: Array) -> Semidefinite:
    return jax.lax.map(lambda one: semidefinite_least_squares(*one), (C, right), batch_size=LANES)


@jax.jit
def _linear_fit(problem: _Problem) -> LinearFit:
    return _over_batch(lambda one: LinearFit(**_results(one, one.linear, EIGHT)), problem)


@partial(jax.jit, static_argnums=2)
def _constrained_fit(problem: _Problem, found: Semidefinite, damping: str) -> StiffnessFit:
    elements, constrained = DAMPING[damping]
    free = elements.shape[1] - constrained

    def fit(problem: _Problem, found: Semidefinite) -> StiffnessFit:
        theta = found.k.reshape(-1)
        if free:
            rest = problem.right[:free] - (problem.R[:free, free:] * theta).sum(axis=1)
            theta = jnp.concatenate([back_substitute(problem.R[:free, :free], rest), theta])
        failed = jnp.where(found.optimal, 0, REASONS.index("did not converge"))
        reason = jnp.where(problem.reason > 0, problem.reason, failed)
        problem = eqx.tree_at(lambda problem: problem.reason, problem, reason)
        return StiffnessFit(
            **_results(problem, theta, elements),
            L=jnp.where(reason == 0, found.L[-1], jnp.nan),
            on_boundary=found.singular.any() & (reason == 0),
        )

    return _over_batch(fit, problem, found)


def _over_batch(fit: Callable[..., Any], problem: _Problem, *others: Any) -> Any:
    for _ in problem.reason.shape:
        fit = jax.vmap(fit)
    return fit(problem, *others)


def _results(problem: _Problem, theta: Array, elements: NDArray[np.float64]) -> dict[str, Array]:
    """What both kinds of fit have in common."""

    def or_nan(value: Array) -> Array:
        return jnp.where(problem.reason == 0, value, jnp.nan)

    D, K = or_nan(_times(elements, theta)).reshape(2, 2, 2)
    residual = jnp.append(problem.right - (problem.R * theta).sum(axis=1), problem.left)
    return {
        "D": D,
        "K": K,
        "covariance": or_nan(problem.covariance),
        "dof": or_nan(problem.trials - 1.0),
        "residual_rms": or_nan(jnp.sqrt((residual**2).sum() / (2 * jnp.maximum(problem.samples, 1)))),
        "samples": problem.samples,
        "reason": problem.reason,
    }


def symmetric_matrix(elements: Num[AnyArray, "*N 3"]) -> Any:
    """(*N, 2, 2) of its elements 11, 12 and 22."""
    return elements[..., np.array([[0, 1], [1, 2]])]


def _given(n: int) -> NDArray[np.int64]:
    """Which of `ELEMENTS` stand for the matrices."""
    return np.arange(8) if n == 8 else np.array([ELEMENTS.index(name) for name in SYMMETRIC_ELEMENTS])


@partial(jax.jit, static_argnums=2)
def _elements(D: Array, K: Array, n: int) -> Array:
    """(*B, n) elements of the matrices (*B, 2, 2)."""
    return jnp.concatenate([x.reshape(*x.shape[:-2], 4) for x in (D, K)], axis=-1)[..., _given(n)]


@jax.jit
def _standard_errors(covariance: Array) -> Array:
    return jnp.sqrt(jnp.diagonal(covariance, axis1=-2, axis2=-1))


def _times(a: AnyArray, b: AnyArray) -> Array:
    """Small products of matrices, or with a vector, in full precision: accelerators would round others to ten bits."""
    return jnp.matmul(jnp.asarray(a), jnp.asarray(b), precision="highest")


def element_columns(R: Array, elements: NDArray[np.float64]) -> Array:
    """(p + 1, 12) columns of the parameters and of the torque: six rows for each joint."""
    zero = jnp.zeros_like(R[:, 0])
    column = {
        f"{matrix}_{joint + 1}{other + 1}": jnp.concatenate(
            [zero] * joint + [R[:, start + other]] + [zero] * (1 - joint)
        )
        for matrix, start in (("damping", 0), ("stiffness", 2))
        for joint in (0, 1)
        for other in (0, 1)
    }
    full = jnp.stack([column[name] for name in ELEMENTS])
    return jnp.concatenate([_times(elements.T, full), R[:, 4:].T.reshape(1, 12)])


def _jackknife(R: Array, designs: Array, theta: Array, counts: Array) -> Array:
    """Covariance of the linear estimate `theta`, from its triangle and the (T, p + 1, 12) designs of trials.

    How far the estimate moves without a trial is exact, and found in coordinates in which R is the unit matrix.
    """
    p, n_trials = len(R), counts.sum()
    if counts.shape[0] < FEWEST_TRIALS:
        return jnp.full((p, p), jnp.nan)
    unit = jnp.eye(p, dtype=R.dtype)
    inverse = jax.vmap(partial(back_substitute, R), out_axes=1)(unit)

    def moved_without(design: Array) -> Array:
        residual = design[p] - (theta[:, None] * design[:p]).sum(axis=0)
        Z = _times(inverse.T, design[:p])
        system = jnp.concatenate([unit - _times(Z, Z.T), _times(Z, residual)[None]])
        Q = triangle(system)
        return _times(inverse, back_substitute(Q[:p, :p], Q[:p, p]))

    moves = jnp.where(counts[:, None], jax.vmap(moved_without)(designs), 0)
    factor = jnp.where(n_trials >= FEWEST_TRIALS, 1 - 1 / n_trials, jnp.nan)
    return factor * _times(moves.T, moves)
