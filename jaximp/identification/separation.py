"""Four ways to tell the human from the robot: methods 1 to 4 of Tout et al. 2023, III-C, eqs. (12) to (15).

All need two recordings: the robot alone (R) and the robot with the human (RH). Both come here filtered alike and as
regressions: rows of the robot's and the human's model, and the motor's torque.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Num

from jaximp.identification.whitening import White, from_filtered, from_white, with_sizes_of_one
from jaximp.least_squares.sliding import sliding_least_squares
from jaximp.least_squares.window import SlidingFit, WindowFit, least_squares
from jaximp.numerics.compilation import is_traced
from jaximp.trust.score_tests import ERRORS, SHARE
from jaximp.types import AnyArray

OTHER_MOTION = 0.5
"""Method 3 needs one motion twice: where the robot's own torque differs by such a share of itself, it is another."""

METHODS = {
    1: "robot first, then the human from the rest of the torque, eq. (12)",
    2: "robot first, then both together, and the difference",
    3: "difference of the two torques on the same motion, eq. (13)",
    4: "robot and human together from both recordings, eqs. (14), (15)",
}


class Regression(eqx.Module):
    """A filtered recording, ready for least squares; n joints where a human holds the end of a robot of so many."""

    robot: Float[Array, "N *n r"]
    """Rows of the robot's model."""
    human: Float[Array, "N *n h"]
    """Rows of the human's model."""
    torque: Float[Array, "N *n"]
    """Motor torque [N m]."""
    valid: Bool[Array, "N *n"]
    """False for rows that must not count."""


class Separation(eqx.Module):
    """The human's parameters in every window by one method, and what the method wants to say of itself."""

    fit: SlidingFit
    """Estimates; the standard errors include the uncertainty of the robot's parameters."""
    own: AnyArray
    """(M, h) standard errors without that."""
    white: White | None = eqx.field(static=True)
    """The rows that estimates come from, of the recording with the human last; None where they are those given."""
    torque: Float[Array, " N"]
    """The torque that the human's model had to explain [N m] (for methods 2 and 4 that of method 1)."""
    valid: AnyArray
    """(N, *n) which of the rows that were solved count."""
    human: tuple[int, ...] = eqx.field(static=True)
    """Which of the parameters that were solved for are the human's."""
    passed_on: Array | None
    """(r, M, h) what a change by one of each of the robot's parameters in the recording with the human adds to the
    human's; None where nobody asked."""
    warning: str = eqx.field(static=True, default="")
    """What is to be known of the method here, or nothing."""
    doubts: Mapping[int, str] = eqx.field(static=True, default_factory=dict)
    """The human's parameters that the method cannot tell here, and why."""
    shared: AnyArray = 0.0
    """() or (h,) what of the human's columns is the robot's own, and was taken off."""


Whiten = Callable[..., White]
"""White rows of columns, torque and which of them count, and where wanted further columns: `whiten`."""


def fit_robot(alone: Regression, noise: Num[AnyArray, " L"] | None = None, white: White | None = None) -> WindowFit:
    """Parameters of the robot from the whole recording R, as methods 1 and 2 begin.

    **Arguments:** `noise` its autocovariance by lag in rows; `white` rows of it where its shape was estimated.
    """
    # Compiled in one piece: every operation for itself takes many times as long to compile.
    solve = jax.jit(least_squares)
    if white is None:
        fit = solve(alone.robot, alone.torque, alone.valid, noise)
    else:
        fit = with_sizes_of_one(solve(white.W, white.torque, alone.valid, None), white)
    if not bool(jnp.isfinite(fit.theta).all()):
        raise ValueError(
            "the recording of the robot alone does not determine the robot's parameters: "
            "it needs a motion that excites every column, or a smaller robot model"
        )
    return fit


def separate(
    method: int,
    robot: WindowFit,
    alone: Regression,
    loaded: Regression,
    merge: tuple[tuple[float, ...], ...],
    window: int,
    step: int = 1,
    noise: Num[AnyArray, "..."] | None = None,
    room: int | None = None,
    whiten: Whiten | None = None,
    change: Num[AnyArray, "r r"] | None = None,
    follow: bool = False,
) -> Separation:
    """Identify the human by one of the four methods.

    **Arguments:** `robot`, the fit of the robot alone (`fit_robot`); `alone` (R) and `loaded` (RH); `merge`, the map
    of `models.combine(robot, human)` that method 2 needs; `window`, `step`, `noise` and `room`
    as in `sliding_least_squares`, in rows of the regressions; `whiten` where the noise's shape is to be estimated;
    `change`, the covariance of what the robot's parameters may differ by in RH, beyond the errors of their estimates;
    `follow` whether `Separation.passed_on` is wanted where no `change` needs it.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}: the paper has methods 1, 2, 3 and 4")
    slide = _Slide(Partial(sliding_least_squares, window=window, step=step, noise=noise, room=room), whiten)
    differs = change is not None and bool(np.any(np.asarray(change)))
    if method == 1:
        found = _robot_first(robot, loaded, slide)
    elif method == 2:
        found = _difference_of_parameters(robot, loaded, merge, slide)
    else:
        alone, loaded, shorter = _same_length(alone, loaded)
        by_method = _same_motion if method == 3 else _augmented
        found = by_method(robot, alone, loaded, slide, differs or follow)
        found = replace(found, warning="; ".join(filter(None, [found.warning, shorter])))
    if not differs:
        return found
    inherited = jnp.einsum("rmh,rs,smh->mh", found.passed_on, jnp.asarray(change), found.passed_on)
    return replace(found, fit=_with_inherited_variance(found.fit, inherited, jnp.inf))


def robot_columns(
    method: int,
    missing: tuple[AnyArray, AnyArray],
    weights: AnyArray,
    alone: Regression,
    loaded: Regression,
) -> dict[int, AnyArray]:
    """What columns that the robot's model lacks leave in the rows of a method, by the output on which they act.

    **Arguments:** `missing` (N, g) in the recordings R and RH; `weights` (r, g) with which the robot's own parameters
    imitate them in R, as methods 1 to 3 begin; `alone` R; `loaded` RH.
    """
    in_alone, held = missing
    if method in (1, 2):
        return {-1: held - np.asarray(loaded.robot) @ weights}
    n = min(len(in_alone), len(held))
    if method == 4:
        return {0: in_alone[:n], 1: held[:n]}
    moved = np.asarray(loaded.robot)[:n] - np.asarray(alone.robot)[:n]
    return {-1: held[:n] - in_alone[:n] - moved @ weights}


@dataclass(frozen=True)
class _Slide:
    """How all windows are solved: as the rows are, or in white rows."""

    plain: Callable[..., SlidingFit]
    whiten: Whiten | None

    def __call__(
        self, W: Array, y: Array, valid: Array, beside: Array | None = None
    ) -> tuple[SlidingFit, White | None]:
        """Estimates, with the condition number of the rows as they are. `beside` as in `whiten`."""
        ordinary = self.plain(W, y, valid=valid)
        if self.whiten is None:
            return ordinary, None
        white = self.whiten(W, y, valid, beside)
        fit = self.plain(jnp.asarray(white.W), jnp.asarray(white.torque), valid=valid)
        if white.as_filtered is not None:
            return from_filtered(fit, ordinary, white), white
        return from_white(fit, ordinary, white), white


def _robot_first(robot: WindowFit, loaded: Regression, slide: _Slide) -> Separation:
    """Method 1. An error of the robot's parameters moves the human's by minus the fit of the robot's columns."""
    torque, n_human = loaded.torque - loaded.robot @ robot.theta, loaded.human.shape[1]
    fit, white = slide(loaded.human, torque, loaded.valid, loaded.robot)
    passed_on = _imitated(slide, white, loaded.human, loaded.robot, loaded.valid)
    inherited, own = jnp.einsum("rmh,rs,smh->mh", passed_on, robot.covariance, passed_on), fit.stderr
    fit = _with_inherited_variance(fit, inherited, robot.dof)
    return Separation(fit, own, white, torque, loaded.valid, tuple(range(n_human)), passed_on)


def _imitated(slide: _Slide, white: White | None, W: Array, columns: Array, valid: Array) -> Array:
    """(r, M, p) the parameters that imitate each of the columns (N, r), which act on the last output."""
    if white is not None and white.as_filtered is None:
        W, columns = jnp.asarray(white.W), jnp.asarray(white.apply(columns, valid if valid.ndim == 1 else valid[:, -1]))
    if W.ndim == 3:
        columns = jnp.stack([jnp.zeros_like(columns), columns], axis=1)
    return _explained_by_the_human(slide.plain, W, columns, valid)


@eqx.filter_jit
def _explained_by_the_human(slide: Callable[..., SlidingFit], human: Array, columns: Array, valid: Array) -> Array:
    """The human's parameters that imitate each of the robot's columns, (r, M, h); the noise has no part in them."""

    def response(column: Array) -> Array:
        return slide(human, column, valid=valid, noise=None).theta

    return jax.lax.map(response, jnp.moveaxis(columns, -1, 0))


def _difference_of_parameters(
    robot: WindowFit,
    loaded: Regression,
    merge: tuple[tuple[float, ...], ...],
    slide: _Slide,
) -> Separation:
    """Method 2. `merge` says which column of the merged model each parameter went into."""
    place = np.argmax(np.asarray(merge), axis=0)
    n_robot = loaded.robot.shape[1]
    robot_place, human_place = place[:n_robot], place[n_robot:]
    both = jnp.concatenate([loaded.robot, loaded.human], axis=1)
    first_member = jnp.array([np.flatnonzero(row)[0] for row in np.asarray(merge)])
    fit, white = slide(both[:, first_member], loaded.torque, loaded.valid)

    shared = np.asarray(human_place)[:, None] == np.asarray(robot_place)[None, :]  # (h, r)
    robot_variance = jnp.diagonal(robot.covariance)
    human = eqx.tree_at(
        lambda f: (f.theta, f.stderr, f.excitation),
        fit,
        (
            fit.theta[:, human_place] - shared @ robot.theta,
            fit.stderr[:, human_place],
            fit.excitation[:, human_place],
        ),
    )
    inherited = jnp.broadcast_to(shared @ robot_variance, human.theta.shape)
    passed_on = jnp.broadcast_to(jnp.asarray(shared.T[:, None, :], float), (n_robot, *human.theta.shape))
    fit, torque = _with_inherited_variance(human, inherited, robot.dof), loaded.torque - loaded.robot @ robot.theta
    return Separation(
        fit, human.stderr, white, torque, loaded.valid, tuple(human_place.tolist()), passed_on,
        shared=shared @ robot.theta,
    )  # fmt: skip


def _same_motion(
    robot: WindowFit, alone: Regression, loaded: Regression, slide: _Slide, follow: bool = False
) -> Separation:
    """Method 3. What the robot's torque differs by, since no motion is quite the same twice, is that of its model."""
    moved, human = loaded.robot - alone.robot, loaded.human
    torque, valid = loaded.torque - alone.torque - moved @ robot.theta, alone.valid & loaded.valid
    fit, white = slide(human, torque, valid)
    imitated = _imitated(slide, white, human, moved, valid)
    inherited, own = jnp.einsum("rmh,rs,smh->mh", imitated, robot.covariance, imitated), fit.stderr
    fit = _with_inherited_variance(fit, inherited, robot.dof)
    warning, doubts = _motions_differ(robot, alone, loaded, fit, jnp.einsum("rmh,r->mh", imitated, robot.theta))
    passed_on = _imitated(slide, white, human, loaded.robot, valid) if follow else None
    return Separation(fit, own, white, torque, valid, tuple(range(human.shape[1])), passed_on, warning, doubts)


def _augmented(
    robot: WindowFit, alone: Regression, loaded: Regression, slide: _Slide, follow: bool = False
) -> Separation:
    """Method 4: the two recordings are two outputs that share the robot's parameters."""
    upper = jnp.concatenate([alone.robot, jnp.zeros_like(loaded.human)], axis=1)
    lower = jnp.concatenate([loaded.robot, loaded.human], axis=1)
    W = jnp.stack([upper, lower], axis=1)
    y = jnp.stack([alone.torque, loaded.torque], axis=1)
    valid = jnp.stack([alone.valid, loaded.valid], axis=1)
    fit, white = slide(W, y, valid)
    n_robot = loaded.robot.shape[1]
    human = eqx.tree_at(
        lambda f: (f.theta, f.stderr, f.excitation),
        fit,
        (fit.theta[:, n_robot:], fit.stderr[:, n_robot:], fit.excitation[:, n_robot:]),
    )
    passed_on = _imitated(slide, white, W, loaded.robot, valid)[..., n_robot:] if follow else None
    torque = loaded.torque - loaded.robot @ robot.theta
    return Separation(human, human.stderr, white, torque, valid, tuple(range(n_robot, W.shape[-1])), passed_on)


def _with_inherited_variance(fit: SlidingFit, inherited: Array, robot_dof: Array | float) -> SlidingFit:
    """Add the variance that comes from the robot's parameters; degrees of freedom by Welch and Satterthwaite."""
    own = fit.stderr**2
    total = own + inherited
    per_parameter = total**2 / (own**2 / fit.dof[:, None] + inherited**2 / robot_dof)
    return eqx.tree_at(lambda f: (f.stderr, f.dof), fit, (jnp.sqrt(total), per_parameter.min(axis=1)))


def _same_length(alone: Regression, loaded: Regression) -> tuple[Regression, Regression, str]:
    n_alone, n_loaded = len(alone.torque), len(loaded.torque)
    n = min(n_alone, n_loaded)
    note = "" if n_alone == n_loaded else f"the recordings differ in length and were cut to the shorter, {n} rows"
    return (*(jax.tree.map(lambda x: x[:n], part) for part in (alone, loaded)), note)


def _motions_differ(
    robot: WindowFit, alone: Regression, loaded: Regression, fit: SlidingFit, taken_off: Num[AnyArray, "M h"]
) -> tuple[str, dict[int, str]]:
    """What a difference of the motions does to method 3: a note, and which parameters it leaves in doubt.

    **Arguments:** `taken_off`, what the difference of the robot's torque would add to the human's parameters.

    What the robot's model leaves of its torque goes with the motion too, and is not taken off: it is taken for the same
    share of what is. While tracing nothing is known yet.
    """
    if is_traced(alone.torque, loaded.torque, taken_off):
        return "", {}
    taken_off = np.asarray(taken_off)
    both = np.asarray(alone.valid & loaded.valid)
    theta, of_alone, of_loaded = (np.asarray(x) for x in (robot.theta, alone.robot, loaded.robot))
    differs, own = (_rms((x @ theta)[both]) for x in (of_loaded - of_alone, of_loaded))
    left, whole = (_rms(x[both]) for x in (np.asarray(alone.torque) - of_alone @ theta, np.asarray(alone.torque)))
    n_human = taken_off.shape[1]
    if differs > OTHER_MOTION * own:
        why = (
            f"the two motions differ: they are two motions and not one, as method 3 needs it (the robot's own torque "
            f"differs by {differs / max(own, np.finfo(float).tiny):.0%})"
        )
        return why, dict.fromkeys(range(n_human), why)
    known = np.isfinite(taken_off).all(axis=1) & np.isfinite(np.asarray(fit.theta)).all(axis=1)
    if not known.any():
        return "", {}
    usual, error, off = (np.median(np.abs(np.asarray(x)[known]), axis=0) for x in (fit.theta, fit.stderr, taken_off))
    beyond = off * left / max(whole, np.finfo(float).tiny)
    doubts = {
        k: f"the two motions differ: the robot's own torque would change it by {off[k] / usual[k]:.0%}, and the "
        f"robot's model, which takes that off, leaves {left / whole:.0%} of the robot's torque unexplained"
        for k in range(n_human)
        if usual[k] > 0 and beyond[k] > max(ERRORS * error[k], SHARE * usual[k])
    }
    if not (off > error).any():
        return "", doubts
    return (
        f"the two motions differ: by the robot's model its own torque differs by {differs / own:.1%}, which was taken "
        "off; standard errors hold what is not known of it"
    ), doubts


def _rms(x: Num[AnyArray, " N"]) -> float:
    return float(np.sqrt(np.mean(x**2))) if len(x) else 0.0
