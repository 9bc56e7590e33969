"""A load that changes, weighed while the robot moves: the last seconds of a stream, sample by sample.

The robot is known. What it leaves of the torque is summed in blocks of time, which are added and never taken off again:
the window is the sum of the last blocks, so rounding cannot pile up. The scores of the blocks give standard errors that
know what samples have in common over a block's time, corrected by each block's leverage as in `block_errors`. Loads
before and after each instant are compared, so that a load that changes inside of the window is noticed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import ArrayLike, Float, Num

from jaximp.identification.payload import KnownRobot, load_columns, require_end
from jaximp.identification.quantities import Quantities, freedom
from jaximp.identification.weighted import LEAST_LEFT
from jaximp.models.chain import Chain
from jaximp.models.spatial import PARAMETERS
from jaximp.results import Parameter
from jaximp.types import AnyArray

BLOCKS = 20
"""Of a window."""
CHANCE = 1e-3
"""Probability of a change where there is none, for each estimate."""
KNOWN = 0.1
"""Standard error, as a share of the largest load, up to which a parameter is known."""
FILLED = 0.5
"""Share of the window's blocks that must hold samples."""


class WindowState(NamedTuple):
    """Sums of the last blocks of time; all that the window remembers."""

    information: Float[Array, "B 10 10"]
    """Of the load's weighted columns."""
    with_robot: Float[Array, "B 10 p"]
    """Products of the load's columns and the robot's."""
    with_torque: Float[Array, "B 10 n"]
    """Products of the load's columns and the torque of each joint."""
    rows: Float[Array, " B"]
    """How many rows count."""
    samples: Array
    """() seen so far, valid or not."""


@dataclass(frozen=True, eq=False)
class WeighedNow(Quantities):
    """The load in the last seconds: ten parameters as those of `Payload`, NaN for what is not known."""

    changed: bool
    """Whether the load is another one before and after some instant inside of the window: then the estimate is a
    mixture of both."""
    changed_ago: float
    """How long ago [s], to a twentieth of the window; NaN without a change."""

    @property
    def mass(self) -> Parameter:
        """[kg], with `value`, `stderr` and `interval()`."""
        return self["load.mass"]


class PayloadWindow:
    """The load on the last link of a known robot over the last seconds.

    ```python
    weigh = PayloadWindow.of(identify_robot(pipeline, alone), window=4.0, rate=500.0)
    state = weigh.start()
    state = weigh.update(state, q, dq, ddq, torque)  # one sample (n,), or several (S, n)
    weigh.estimate(state).mass
    ```

    **Arguments:**

    - `chain`; its base parameters `theta` (p,) with their `covariance` (p, p), such as `identify_robot` gives.
    - `window` [s] and `rate` of the samples [Hz]. The window ends with the last sample; what is older is forgotten in
      steps of a twentieth.
    - `size` (n,) of the noise of each torque, for the weights of the joints: one for all by default.
    - `gain_covariance` (n, n) of the relative errors of the drives' gains, as `Recording.gain_covariance`; `by_joint`
      (p, n) what the torques of each joint made of `theta`, where it comes from the same drives.
    - `largest` load that is thought of [kg], and how far from the tip its mass may `reach` [m]. Both only hold what the
      motion does not show: where nothing turns fast, mass and centre are found as if the inertia were known to be of
      some `largest * reach^2`.

    Samples that are not finite, and rows of joints slower than `chain.min_velocity`, do not count. Motion and torque
    must have passed the same filter. A noise that remembers longer than a twentieth of the window makes standard errors
    too small: take a longer window.

    **Raises:** `ValueError` in one line for shapes that do not fit, and windows of fewer than twenty samples.
    """

    def __init__(
        self,
        chain: Chain,
        theta: Num[AnyArray, " p"],
        covariance: Num[AnyArray, "p p"],
        window: float,
        rate: float,
        *,
        size: Num[AnyArray, " n"] | None = None,
        gain_covariance: Num[AnyArray, "n n"] | None = None,
        by_joint: Num[AnyArray, "p n"] | None = None,
        largest: float = 20.0,
        reach: float = 0.3,
    ):
        n, p = chain.n_joints, len(chain.names)
        if np.shape(theta) != (p,) or np.shape(covariance) != (p, p):
            raise ValueError(
                f"theta has the shape {np.shape(theta)} and covariance {np.shape(covariance)}: the chain has {p} base "
                "parameters"
            )
        if not window * rate >= BLOCKS:
            raise ValueError(
                f"a window of {window:g} s has {window * rate:.3g} samples at {rate:g} Hz: it needs {BLOCKS} at least"
            )
        if not (largest > 0 and reach > 0):
            raise ValueError(f"largest is {largest:g} kg and reach {reach:g} m: both must be above zero")
        require_end(chain)
        self.chain, self.window, self.rate = chain, window, rate
        self._seconds = round(window * rate / BLOCKS) / rate
        powers = largest * reach ** np.repeat([0, 1, 2], [1, 3, 6])
        gains = np.zeros((n, n)) if gain_covariance is None else np.asarray(gain_covariance, float)
        weights = np.ones(n) if size is None else 1 / np.asarray(size, float)
        known = (theta, covariance, gains, np.zeros((p, n)) if by_joint is None else by_joint, 1 / powers**2)
        self._known = _Known(*(jnp.asarray(x, float) for x in known))
        self._weights = jnp.asarray(weights)
        self._update, self._estimate = _programs(chain, round(window * rate / BLOCKS))
        self._most = KNOWN * powers

    @classmethod
    def of(
        cls, robot: KnownRobot, window: float, rate: float, largest: float = 20.0, reach: float = 0.3
    ) -> PayloadWindow:
        """For a robot by `identify_robot`."""
        return cls(
            robot.chain,
            robot.theta,
            robot.covariance,
            window,
            rate,
            size=robot.size,
            gain_covariance=robot.gain_covariance,
            by_joint=robot.by_joint,
            largest=largest,
            reach=reach,
        )

    def start(self) -> WindowState:
        """An empty window."""
        n, p = self.chain.n_joints, len(self.chain.names)
        shapes = (BLOCKS, 10, 10), (BLOCKS, 10, p), (BLOCKS, 10, n), (BLOCKS,)
        information, robot, torque, rows = map(jnp.zeros, shapes)
        return WindowState(information, robot, torque, rows, jnp.zeros((), jnp.int32))

    def update(
        self,
        state: WindowState,
        q: Num[ArrayLike, "*S n"],
        dq: Num[ArrayLike, "*S n"],
        ddq: Num[ArrayLike, "*S n"],
        torque: Num[ArrayLike, "*S n"],
    ) -> WindowState:
        """With one more sample (n,), or several (S, n), one after the other."""
        # Each operation on JAX's arrays outside of compiled code takes as long as a tenth of an update.
        samples = (x if isinstance(x, Array) else np.asarray(x, float) for x in (q, dq, ddq, torque))
        return self._update(self._weights, state, *(x.reshape(-1, self.chain.n_joints) for x in samples))

    def estimate(self, state: WindowState) -> WeighedNow:
        """The load in the window."""
        from scipy.special import stdtrit

        found = jax.tree.map(np.asarray, self._estimate(self._known, state))
        covariance = found.own + found.inherited
        dof = freedom((np.diagonal(found.own), found.dof), (np.diagonal(found.inherited), np.inf))
        unknown = ~(np.sqrt(np.diagonal(covariance)) <= self._most) | (found.filled < FILLED)
        theta = np.where(unknown, np.nan, found.theta)
        covariance[unknown] = covariance[:, unknown] = np.nan
        beyond = np.where(found.freedom > 0, found.apart / stdtrit(found.freedom, 1 - CHANCE / 2 / len(SPLITS)), 0)
        best, changed = int(beyond.argmax()), bool(beyond.max() > 1) and not unknown[0]
        ago = self._seconds * (BLOCKS - SPLITS[best]) if changed else np.nan
        names, units = tuple(f"load.{name}" for name in PARAMETERS), tuple(PARAMETERS.values())
        return WeighedNow(names, units, theta, covariance, np.where(unknown, np.nan, dof), changed, ago)


NEIGHBOURS = ((1, 2 / 3), (2, 1 / 3))
"""How much blocks so far apart count together where loads before and after an instant are compared (Bartlett)."""
SPLITS = tuple(range(3, BLOCKS - 2))
"""Blocks before an instant at which the load may change."""


class _Sums(NamedTuple):
    """Of one sample or block, see `WindowState`."""

    information: Array
    with_robot: Array
    with_torque: Array
    rows: Array


class _Known(NamedTuple):
    """Beside the window."""

    theta: Array
    covariance: Array
    gains: Array
    by_joint: Array
    """(p, n) what the torques of each joint made of `theta`."""
    precision: Array
    """(10,) of what the load is thought to be beforehand."""


class _Estimate(NamedTuple):
    theta: Array
    own: Array
    """(10, 10) covariance by the window's own scores, and what was thought beforehand."""
    dof: Array
    inherited: Array
    """(10, 10) of the robot and the gains."""
    apart: Array
    """(k,) masses before and after each instant, in standard errors."""
    freedom: Array
    """(k,) of this."""
    filled: Array
    """Share of the blocks that hold samples."""


def _sample_rows(chain: Chain, columns: Array, weights: Array, *sample: Array) -> tuple[Array, Array, Array]:
    """Weighted rows of robot (S, n, p) and load (S, n, 10), and torques (S, n); zero where they do not count."""
    *motion, torque = sample
    finite = jnp.stack([jnp.isfinite(x).all(axis=-1) for x in motion]).all(axis=0)[:, None] & jnp.isfinite(torque)
    q, dq, ddq, torque = (jnp.nan_to_num(x, posinf=0, neginf=0) for x in sample)
    counted = jnp.where(finite & chain.moving(dq), weights, 0)
    robot = chain.regressor(*(x[:, 0] if chain.n_joints == 1 else x for x in (q, dq, ddq)))
    robot = robot.reshape(*q.shape, -1) * counted[..., None]
    return robot, robot @ columns, torque * counted


@lru_cache(maxsize=8)
def _programs(chain: Chain, samples: int) -> tuple[Callable[..., WindowState], Callable[..., _Estimate]]:
    """What is compiled for blocks of so many samples of a chain, whatever is known of it."""
    rows = partial(_sample_rows, chain, jnp.asarray(load_columns(chain)))
    return jax.jit(partial(_update, rows, samples)), jax.jit(partial(_estimate, samples))


def _update(rows: Callable[..., Any], samples: int, weights: Array, state: WindowState, *several: Array) -> WindowState:
    def step(state: WindowState, one: tuple[Array, Array, Array]) -> tuple[WindowState, None]:
        robot, load, torque = one
        place = (state.samples // samples) % BLOCKS
        new = _Sums(load.T @ load, load.T @ robot, load.T * torque, (jnp.abs(load).max(axis=1) > 0).sum())
        begins = state.samples % samples == 0

        def added(old: Array, more: Array) -> Array:
            return old.at[place].set(jnp.where(begins, 0.0, old[place]) + more)

        summed = {key: added(getattr(state, key), getattr(new, key)) for key in _Sums._fields}
        return state._replace(**summed, samples=state.samples + 1), None

    stepped: WindowState = lax.scan(step, state, rows(weights, *several))[0]
    return stepped


def _estimate(samples: int, known: _Known, state: WindowState) -> _Estimate:
    filled = (state.rows > 0).mean()
    # From the oldest block to the newest, which may be filled in part.
    newest = (state.samples - 1) // samples
    blocks = _Sums(*(jnp.roll(x, -(newest + 1), axis=0) for x in state[:-1]))
    early = jnp.arange(BLOCKS)[None, :] < jnp.array(SPLITS)[:, None]
    masks = jnp.concatenate([early, ~early]).astype(blocks.rows.dtype)
    sides = jax.vmap(partial(_side, known, blocks))(masks)
    before, after = (_Side(*halves) for halves in zip(*(jnp.split(x, 2) for x in sides), strict=True))
    # How much more the noise leaves than white noise of its size would, is one number for both sides.
    freedom = before.freedom + after.freedom
    inflation = (before.freedom * before.inflation + after.freedom * after.inflation) / freedom
    robot, gains = before.robot - after.robot, before.gains - after.gains
    inherited = jnp.einsum("ki,ij,kj->k", robot, known.covariance, robot)
    inherited += jnp.einsum("ki,ij,kj->k", gains, known.gains, gains)
    apart = jnp.abs(before.mass - after.mass) / jnp.sqrt(inflation * (before.white + after.white) + inherited)
    return _fit(known, blocks)._replace(apart=apart, freedom=freedom, filled=filled)


def _solved(known: _Known, information: Array, scores: Array) -> tuple[Array, Array]:
    """(10,) the load that explains the products `scores` of its columns with what the robot leaves; and the matrix in
    whose coordinates the information, with what was thought beforehand, is the identity."""
    root = jnp.sqrt(jnp.diagonal(information) + known.precision)
    L = jnp.linalg.cholesky((information + jnp.diag(known.precision)) / jnp.outer(root, root))
    back = jax.scipy.linalg.solve_triangular(L, jnp.eye(10), lower=True).T / root[:, None]
    return back @ (back.T @ scores), back


class _Side(NamedTuple):
    """What the blocks on one side of an instant say of the mass."""

    mass: Array
    white: Array
    """Its variance if the noise were white, and of the size that the weights take it for."""
    inflation: Array
    """How many times as much the scores say, of blocks and of neighbours."""
    freedom: Array
    robot: Array
    """(p,) what errors of the robot add to it, and what those of gains do (n,)."""
    gains: Array


def _side(known: _Known, blocks: _Sums, mask: Array) -> _Side:
    left = blocks.with_torque.sum(axis=2) - blocks.with_robot @ known.theta
    information = jnp.tensordot(mask, blocks.information, 1)
    theta, back = _solved(known, information, mask @ left)
    row = back @ back[0]
    seen = blocks.information @ row
    scores = mask * ((left - blocks.information @ theta) @ row)
    white = row @ information @ row
    # What a block's white noise adds to the mass, less what the estimate took of it.
    expected = mask @ (seen @ row - ((seen @ back) ** 2).sum(axis=1))
    alone, together = scores @ scores, sum(2 * w * (scores[k:] @ scores[:-k]) for k, w in NEIGHBOURS)
    inflation = jnp.maximum(alone, alone + together) / expected
    robot = row @ jnp.tensordot(mask, blocks.with_robot, 1)
    gains = row @ jnp.tensordot(mask, blocks.with_torque, 1) - robot @ known.by_joint
    return _Side(
        theta[0], white + row @ (known.precision * row), inflation, mask.sum() * expected / white, robot, gains
    )


def _fit(known: _Known, blocks: _Sums) -> _Estimate:
    """The load from all blocks, with errors by their scores."""
    information, with_robot, with_torque = (x.sum(axis=0) for x in blocks[:3])
    left = blocks.with_torque.sum(axis=2) - blocks.with_robot @ known.theta
    theta, back = _solved(known, information, left.sum(axis=0))
    by_joint, imitated = back @ (back.T @ with_torque), back @ (back.T @ with_robot)
    leverage = back.T @ blocks.information @ back
    values, axes = jnp.linalg.eigh(jnp.eye(10) - leverage)
    correction = (axes / jnp.sqrt(jnp.maximum(values, LEAST_LEFT))[:, None, :]) @ axes.swapaxes(1, 2)
    scores = jnp.einsum("bij,bj->bi", correction, (left - blocks.information @ theta) @ back)
    of_prior = back @ (back.T * known.precision) @ back @ back.T
    own = back @ (scores.T @ scores) @ back.T + of_prior
    by_gain = by_joint - imitated @ known.by_joint
    carried = by_gain @ known.gains @ by_gain.T + imitated @ known.covariance @ imitated.T
    seen = jnp.einsum("bij,kj->kbi", correction, back)
    weighed = jnp.einsum("bij,kbj->kbi", leverage, seen)
    between = (seen * weighed).sum(axis=2)[:, :, None] * jnp.eye(BLOCKS) - weighed @ weighed.swapaxes(1, 2)
    dof = jnp.trace(between, axis1=1, axis2=2) ** 2 / (between**2).sum(axis=(1, 2))
    nothing = jnp.zeros(())
    return _Estimate(theta, own, dof, carried, nothing, nothing, nothing)
