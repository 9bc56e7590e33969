"""A human at the end of a robot of n joints, by methods 1 to 4 of Tout et al. 2023 (III-C), in every window.

The robot's own recordings count as a whole, and the one with the human window by window. What is left of a robot's
torque is more than noise: joints are weighed by it, and standard errors come from the scores by blocks of time, as
those of a load do (`additions`, `block_errors`). They hold what is not known of the robot, how far it is stated or seen
to have changed, and the errors of the gains behind the torques.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.additions import Separated, from_the_rest, together
from jaximp.identification.block_errors import BlockFit, block_fit
from jaximp.identification.quantities import freedom
from jaximp.identification.rows import Rows
from jaximp.identification.separation import OTHER_MOTION, Regression
from jaximp.identification.solving import Placement
from jaximp.identification.weighted import by_size, sizes_of_joints
from jaximp.least_squares.sliding import score, sliding_least_squares
from jaximp.least_squares.window import SlidingFit, WindowFit
from jaximp.models.base import Combined, Model
from jaximp.models.tip import TipImpedance
from jaximp.types import Numbers, listed


@dataclass(frozen=True)
class TipPair:
    """Rows of the robot alone and of the robot with the human, and the robot by its own."""

    alone: Regression
    """All recordings of the robot alone, one behind the other; (N, n, r) and (N, n, h)."""
    loaded: Regression
    robot: BlockFit
    change: Numbers
    """(r, r) covariance of what the robot may differ by in the recording with the human."""
    gains: Numbers | None
    """(n, n) covariance of the relative errors of the gains, where the recordings state it."""
    first: int
    """Rows of the first recording of the robot alone, which method 3 compares."""


@dataclass(frozen=True)
class TipFit:
    """The human in all windows by one method."""

    fit: SlidingFit
    torque: Numbers
    """(N, n) that the human's model had to explain; for methods 2 and 4 that of method 1."""
    rows: int
    """How many rows there are: method 3 needs as many of both recordings."""
    note: str = ""
    doubts: Mapping[int, str] | None = None
    """Which parameters cannot be told here, and why."""


def window_fit_of(robot: BlockFit) -> WindowFit:
    """The robot's parameters with their covariance; nothing is said of how well its recording is explained."""
    covariance, unknown = robot.scatter.covariance, jnp.asarray(np.nan)
    stderr = np.sqrt(np.maximum(np.diagonal(covariance), 0))
    dof = float(robot.scatter.dof(np.eye(len(robot.theta))).min())
    nothing = jnp.full(len(stderr), jnp.nan)
    return WindowFit(
        theta=jnp.asarray(robot.theta), stderr=jnp.asarray(stderr), dof=jnp.asarray(dof), cond=unknown,
        sigma_min=unknown, excitation=nothing, residual_rms=unknown, vaf=unknown, samples=jnp.asarray(0),
        covariance=jnp.asarray(covariance),
    )  # fmt: skip


def robot_of(alone: Regression) -> BlockFit:
    """The robot's parameters from all rows of it alone.

    **Raises:** `ValueError` where they are not determined.
    """
    return block_fit(_rows(alone.robot, alone.torque, alone.valid))


def fit_tip(method: int, pair: TipPair, both: Combined | None, place: Placement) -> TipFit:
    """The human by one of the four methods. `both`: robot and human combined, which method 2 fits."""
    loaded, note, doubts = pair.loaded, "", None
    torque = np.asarray(loaded.torque - loaded.robot @ jnp.asarray(pair.robot.theta))
    valid, moved = np.asarray(loaded.valid), np.asarray(loaded.robot)
    if method == 3:
        n = min(pair.first, len(torque))
        moved = np.asarray(loaded.robot)[:n] - np.asarray(pair.alone.robot)[:n]
        valid = valid[:n] & np.asarray(pair.alone.valid)[:n]
        difference = np.asarray(loaded.torque)[:n] - np.asarray(pair.alone.torque)[:n]
        torque = difference - moved @ pair.robot.theta
        note, doubts = _motions_differ(pair, moved, valid)
        loaded = Regression(loaded.robot[:n], loaded.human[:n], loaded.torque[:n], jnp.asarray(valid))
    base = _as_one_model(_rows(loaded.human, torque, valid), place)
    M, h = np.asarray(base.theta).shape
    theta, stderr, dof = np.full((M, h), np.nan), np.full((M, h), np.nan), np.full(M, np.nan)
    for k, start in enumerate(place.starts[:M].tolist()):
        part = slice(start, start + place.window)
        window = jax.tree.map(lambda x, part=part: x[part], loaded)
        try:
            found, passed_on = _of_window(method, pair, both, window, moved[part], torque[part])
        except ValueError:  # the window does not determine the human
            continue
        theta[k], stderr[k], dof[k] = _with_errors(found, passed_on, pair)
    unknown = ~np.isfinite(theta).all(axis=1)
    theta[unknown], stderr[unknown], dof[unknown] = np.nan, np.nan, np.nan
    fit = eqx.tree_at(lambda f: (f.theta, f.stderr, f.dof), base, (*map(jnp.asarray, (theta, stderr, dof)),))
    return TipFit(fit, torque, len(torque), note, doubts)


def _rows(W: object, torque: object, valid: object) -> Rows:
    counted: NDArray[np.bool_] = np.asarray(valid, bool)
    return Rows(np.asarray(W), np.asarray(torque), counted, np.zeros(len(counted)))


def _as_one_model(rows: Rows, place: Placement) -> SlidingFit:
    """Conditions, excitation and samples of all windows, of the human's columns with the robot known."""
    weighted = by_size(rows, sizes_of_joints(rows))
    valid = jnp.asarray(rows.valid)
    slide = partial(sliding_least_squares, window=place.window, step=place.step, valid=valid)
    fit = slide(jnp.asarray(weighted.W), jnp.asarray(weighted.torque))
    starts = place.starts[: len(fit.last)]
    seen = score(jnp.asarray(rows.W), jnp.asarray(rows.torque), valid, fit.theta, starts, place.window, place.step)
    return eqx.tree_at(lambda f: (f.vaf, f.residual_rms), fit, (seen.vaf, seen.residual_rms))


def _of_window(
    method: int, pair: TipPair, both: Combined | None, window: Regression, moved: Numbers, torque: Numbers
) -> tuple[Separated, Numbers]:
    """The human in one window, and (h, r) what a change of the robot's parameters in this recording adds to it."""
    robot, human = np.asarray(window.robot), np.asarray(window.human)
    if method == 2:
        assert both is not None
        return _difference_of_parameters(pair.robot, both, _rows(_stacked(window), window.torque, window.valid))
    if method == 4:
        empty = _rows(pair.alone.robot, pair.alone.torque, pair.alone.valid)
        full = _rows(robot, window.torque, window.valid)
        found, fit = together(empty, full, human)
        nothing = np.zeros((len(empty.time), *robot.shape[1:]))
        return found, fit.solve(np.concatenate([nothing, robot]))[-human.shape[-1] :]
    rows = _rows(robot, torque + moved @ pair.robot.theta, window.valid)
    found, fit = from_the_rest(human, rows, moved, pair.robot)
    return found, fit.solve(robot)


def _stacked(window: Regression) -> Numbers:
    return np.concatenate([np.asarray(window.robot), np.asarray(window.human)], axis=-1)


def _difference_of_parameters(robot: BlockFit, both: Combined, rows: Rows) -> tuple[Separated, Numbers]:
    """Method 2: from the parameters of robot and human combined, as far as the human is in them."""
    fit = block_fit(replace(rows, W=rows.W[..., list(both.places)]))
    of_robot, of_human = np.split(np.array(both.merge), [len(robot.theta)], axis=1)
    shared = np.abs(of_human).max(axis=1) > 0
    spread = np.linalg.inv(fit.information) + of_robot @ np.linalg.inv(robot.information) @ of_robot.T
    columns = of_human[shared]
    weighted = np.linalg.solve(spread[np.ix_(shared, shared)], columns)
    G = np.zeros((columns.shape[1], len(fit.theta)))
    G[:, shared] = np.linalg.solve(columns.T @ weighted, weighted.T)
    sources = (G, fit), (-G @ of_robot, robot)
    by_joint = G @ (fit.by_joint - of_robot @ robot.by_joint)
    return Separated(G @ (fit.theta - of_robot @ robot.theta), sources, by_joint, fit.size), G @ of_robot


def _with_errors(found: Separated, passed_on: Numbers, pair: TipPair) -> tuple[Numbers, Numbers, float]:
    """Parameters (h,), their standard errors, and the fewest degrees of freedom of any."""
    known = passed_on @ pair.change @ passed_on.T
    if pair.gains is not None:
        known = known + found.by_joint @ pair.gains @ found.by_joint.T
    parts = [(rows @ fit.scatter.covariance @ rows.T, fit.scatter.dof(rows)) for rows, fit in found.sources]
    covariance = known + sum(part for part, _ in parts)
    dof = freedom((np.diagonal(known), np.inf), *((np.diagonal(part), one) for part, one in parts))
    return found.u, np.sqrt(np.maximum(np.diagonal(covariance), 0)), float(dof.min())


def _motions_differ(pair: TipPair, moved: Numbers, valid: NDArray[np.bool_]) -> tuple[str, dict[int, str] | None]:
    """What is to be known of method 3, and why nothing can be told where the motions are two."""
    theta, whole = pair.robot.theta, np.asarray(pair.loaded.robot)[: len(moved)]
    differs, own = (float(np.sqrt(np.mean((x @ theta)[valid] ** 2))) for x in (moved, whole))
    if not differs > OTHER_MOTION * own:
        told = f"the two motions differ: by the robot's model its own torque differs by {differs / own:.1%}"
        return f"{told}, which was taken off; standard errors hold what is not known of it", None
    why = (
        "the two motions differ: they are two motions and not one, as method 3 needs it (the robot's own torque "
        f"differs by {differs / own:.0%})"
    )
    return why, dict.fromkeys(range(pair.loaded.human.shape[-1]), why)


def rest_note(model: Model, fit: SlidingFit) -> str:
    """Where the human's spring is at rest, of all windows that are known; nothing for a model that does not say it."""
    theta = np.asarray(fit.theta)
    theta = theta[np.isfinite(theta).all(axis=1)]
    if not isinstance(model, TipImpedance) or not {"stiffness", "force"} <= set(model.kinds) or not len(theta):
        return ""
    place = np.median(np.asarray(model.equilibrium(theta)), axis=0)
    several = [f"{label} {one:.4g} m" for label, one in zip(model.labels, place, strict=True)]
    return f"the human's spring is at rest at {listed(several)} (median over windows)"
