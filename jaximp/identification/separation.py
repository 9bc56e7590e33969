"""Four ways to tell the human from the robot: methods 1 to 4 of Tout et al. 2023, III-C, eqs. (12) to (15).

All need two recordings: the robot alone (R) and the robot with the human (RH). Both come here filtered alike and as
regressions: rows of the robot's and the human's model, and the motor's torque.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import Partial
from jaxtyping import Array, Bool, Float, Num

from jaximp.identification.whitening import White, from_filtered, from_white, with_sizes_of_one
from jaximp.least_squares.sliding import sliding_least_squares
from jaximp.least_squares.window import SlidingFit, WindowFit, least_squares
from jaximp.types import AnyArray

SAME_MOTION = 0.05
"""Method 3 needs one motion twice. The robot's own torque may differ by this share of the human's torque."""

METHODS = {
    1: "robot first, then the human from the rest of the torque, eq. (12)",
    2: "robot first, then both together, and the difference",
    3: "difference of the two torques on the same motion, eq. (13)",
    4: "robot and human together from both recordings, eqs. (14), (15)",
}


class Regression(eqx.Module):
    """A filtered recording of one joint, ready for least squares."""

    robot: Float[Array, "N r"]
    """Rows of the robot's model."""
    human: Float[Array, "N h"]
    """Rows of the human's model."""
    torque: Float[Array, " N"]
    """Motor torque [N m]."""
    valid: Bool[Array, " N"]
    """False for rows that must not count."""


class Separation(eqx.Module):
    """The human's parameters in every window by one method, and what the method wants to say of itself."""

    fit: SlidingFit
    """Estimates; the standard errors include the uncertainty of the robot's parameters."""
    white: White | None = eqx.field(static=True)
    """The rows that estimates come from, of the recording with the human last; None where they are those given."""
    torque: Float[Array, " N"]
    """The torque that the human's model had to explain [N m] (for methods 2 and 4 that of method 1)."""
    valid: AnyArray
    """(N, *n) which of the rows that were solved count."""
    human: tuple[int, ...] = eqx.field(static=True)
    """Which of the parameters that were solved for are the human's."""
    warning: str = eqx.field(static=True, default="")
    """Why the method should not be believed here, or nothing."""


Whiten = Callable[[AnyArray, AnyArray, AnyArray], White]
"""White rows of columns, torque and which of them count."""


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
) -> Separation:
    """Identify the human by one of the four methods.

    **Arguments:** `robot`, the fit of the robot alone (`fit_robot`); `alone` (R) and `loaded` (RH); `merge`, the map
    of `models.combine(robot, human)` that method 2 needs; `window`, `step`, `noise` and `room`
    as in `sliding_least_squares`, in rows of the regressions; `whiten` where the noise's shape is to be estimated.
    """
    if method not in METHODS:
        raise ValueError(f"method is {method!r}: the paper has methods 1, 2, 3 and 4")
    slide = _Slide(Partial(sliding_least_squares, window=window, step=step, noise=noise, room=room), whiten)
    torque, n_human = loaded.torque - loaded.robot @ robot.theta, loaded.human.shape[1]
    if method == 1:
        return Separation(*_robot_first(robot, loaded, torque, slide), torque, loaded.valid, tuple(range(n_human)))
    if method == 2:
        human = tuple(np.argmax(np.asarray(merge), axis=0)[-n_human:].tolist())
        return Separation(*_difference_of_parameters(robot, loaded, merge, slide), torque, loaded.valid, human)
    alone, loaded, shorter = _same_length(alone, loaded)
    if method == 3:
        torque = loaded.torque - alone.torque
        valid = alone.valid & loaded.valid
        fit, white = slide(loaded.human, torque, valid)
        warning = "; ".join(filter(None, [_motions_differ(robot, alone, loaded, torque), shorter]))
        return Separation(fit, white, torque, valid, tuple(range(n_human)), warning)
    n_robot, valid = loaded.robot.shape[1], jnp.stack([alone.valid, loaded.valid], axis=1)
    human, torque = tuple(range(n_robot, n_robot + n_human)), torque[: len(loaded.torque)]
    return Separation(*_augmented(alone, loaded, slide), torque, valid, human, shorter)


def robot_columns(
    method: int, missing: tuple[AnyArray, AnyArray], weights: AnyArray, loaded: Regression
) -> dict[int, AnyArray]:
    """What columns that the robot's model lacks leave in the rows of a method, by the output on which they act.

    **Arguments:** `missing` (N, g) in the recordings R and RH; `weights` (r, g) with which the robot's own parameters
    imitate them in R, as methods 1 and 2 begin; `loaded` RH.
    """
    alone, held = missing
    if method in (1, 2):
        return {-1: held - np.asarray(loaded.robot) @ weights}
    n = min(len(alone), len(held))
    return {-1: held[:n] - alone[:n]} if method == 3 else {0: alone[:n], 1: held[:n]}


@dataclass(frozen=True)
class _Slide:
    """How all windows are solved: as the rows are, or in white rows."""

    plain: Callable[..., SlidingFit]
    whiten: Whiten | None

    def __call__(self, W: Array, y: Array, valid: Array) -> tuple[SlidingFit, White | None]:
        """Estimates, with the condition number of the rows as they are."""
        ordinary = self.plain(W, y, valid=valid)
        if self.whiten is None:
            return ordinary, None
        white = self.whiten(W, y, valid)
        fit = self.plain(jnp.asarray(white.W), jnp.asarray(white.torque), valid=valid)
        if white.as_filtered is not None:
            return from_filtered(fit, ordinary, white), white
        return from_white(fit, ordinary, white), white


def _robot_first(robot: WindowFit, loaded: Regression, torque: Array, slide: _Slide) -> tuple[SlidingFit, White | None]:
    """Method 1. An error of the robot's parameters moves the human's by minus the fit of the robot's columns."""
    fit, white = slide(loaded.human, torque, loaded.valid)
    human, columns = loaded.human, loaded.robot
    if white is not None and white.as_filtered is None:
        human, columns = jnp.asarray(white.W), jnp.asarray(white.apply(columns, loaded.valid))
    passed_on = _explained_by_the_human(slide.plain, human, columns, loaded.valid)
    inherited = jnp.einsum("rmh,rs,smh->mh", passed_on, robot.covariance, passed_on)
    return _with_inherited_variance(fit, inherited, robot.dof), white


@eqx.filter_jit
def _explained_by_the_human(slide: Callable[..., SlidingFit], human: Array, columns: Array, valid: Array) -> Array:
    """The human's parameters that imitate each of the robot's columns, (r, M, h); the noise has no part in them."""

    def response(column: Array) -> Array:
        return slide(human, column, valid=valid, noise=None).theta

    return jax.lax.map(response, columns.T)


def _difference_of_parameters(
    robot: WindowFit,
    loaded: Regression,
    merge: tuple[tuple[float, ...], ...],
    slide: _Slide,
) -> tuple[SlidingFit, White | None]:
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
    return _with_inherited_variance(human, inherited, robot.dof), white


def _augmented(alone: Regression, loaded: Regression, slide: _Slide) -> tuple[SlidingFit, White | None]:
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
    return human, white


def _with_inherited_variance(fit: SlidingFit, inherited: Array, robot_dof: Array) -> SlidingFit:
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


def _motions_differ(robot: WindowFit, alone: Regression, loaded: Regression, human_torque: Array) -> str:
    """Method 3 takes the robot's torque from the other recording: say so where that is not the torque of this one."""
    both = np.asarray(alone.valid & loaded.valid)
    mismatch = np.asarray((loaded.robot - alone.robot) @ robot.theta)[both]
    size, human = float(np.sqrt(np.mean(mismatch**2))), float(np.std(np.asarray(human_torque)[both]))
    if size <= SAME_MOTION * human:
        return ""
    share = size / human if human > 0 else np.inf
    return (
        f"the two motions differ: the robot's own torque differs between them by {share:.0%} of the human's torque "
        f"(at most {SAME_MOTION:.0%} is meant), so method 3 does not hold here"
    )
