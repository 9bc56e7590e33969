"""What every model is: a pure regressor with named parameters, `torque = regressor(q, dq, ddq) @ theta`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models.base_parameters import find_base
from jaximp.types import Numbers

MOTION = ("q", "dq", "ddq", "1")
"""Columns of one joint that are linear in its motion: position, velocity, acceleration, and a constant one."""
FEWEST_ROWS = 1200
"""Of random motions, by which it is told what columns depend on each other."""


class Role(NamedTuple):
    """What a parameter is, so that nobody must read it from a name."""

    kind: str
    """`inertia`, `base_inertia` (of an arm, in Lakatos's order), `damping`, `stiffness`, `friction`, `offset` (a
    constant torque), or `other`; of a chain `link_mass`, `first_moment` and `link_inertia` (with what counts with
    them, so that they may be negative), and `rotor_inertia`."""
    element: tuple[int, ...] = ()
    """Which of several: the joint or link, or row and column of a matrix."""


class Model(eqx.Module):
    """A model that is linear in its parameters.

    A subclass sets the attributes below and writes `row` for **one** sample; batches and whole recordings follow. A
    model with memory writes `observation_matrix` in its place, and says how long the memory is.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    """Name of each parameter, in the order of the columns."""
    units: tuple[str, ...] = eqx.field(static=True)
    """SI unit of each parameter."""
    columns: tuple[str, ...] = eqx.field(static=True)
    """What each column is made of, such as `ddq` or `sin(q/15)`: equal text means equal numbers. Those in `MOTION` are
    the motion itself, and a constant."""
    label: str = eqx.field(static=True)
    """The prefix of the parameters' names when models are stacked, such as `robot`."""
    n_joints: int = eqx.field(static=True)
    """How many joints the regressor has rows for."""

    @property
    def roles(self) -> tuple[Role, ...]:
        """What each parameter is."""
        return tuple(Role("other") for _ in self.names)

    @property
    def memory(self) -> int:
        """How many samples of the past a row needs. As many rows at the beginning of a recording are not known."""
        return 0

    @property
    def regroups(self) -> bool:
        """Whether columns may be sums of several of another model's, so that `combine` must look at numbers."""
        return False

    @property
    def sample_rate(self) -> float | None:
        """Sample rate of the recordings that a model with memory is made for [Hz]; None without memory."""
        return None

    def sampled_at(self, sample_rate: float) -> Model:
        """The model for recordings of another sample rate [Hz]."""
        return self

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        """Regressor of one sample: `(p,)` for one joint, `(n, p)` for several."""
        raise TypeError(f"{type(self).__name__} has no regressor")

    def regressor(
        self, q: Num[ArrayLike, "..."], dq: Num[ArrayLike, "..."], ddq: Num[ArrayLike, "..."]
    ) -> Float[Array, "... p"]:
        """Regressor `w` with `torque = w @ theta`, for one sample or any batch of samples.

        **Arguments:** joint position `q` [rad or m], velocity `dq`, acceleration `ddq`, all of one shape: `(...)` for
        a model of one joint, `(..., n)` for n joints.

        **Returns:** `(..., p)` for one joint, `(..., n, p)` for n joints; the units of the columns are those that
        make `units` come out.

        **Raises:** `ValueError` for shapes that differ, and for a model with memory, which needs a whole recording.
        """
        if self.memory:
            raise ValueError(
                "a model with a reflex needs the past of every sample: pass a whole recording to observation_matrix"
            )
        q, dq, ddq = self._checked(q, dq, ddq)
        function = self.row
        for _ in range(q.ndim - (self.n_joints > 1)):
            function = jax.vmap(function)
        return function(q, dq, ddq)

    def _checked(self, q: ArrayLike, dq: ArrayLike, ddq: ArrayLike) -> tuple[Array, Array, Array]:
        """Motions of one shape, with the joints on the last axis if there are several."""
        q, dq, ddq = jnp.asarray(q), jnp.asarray(dq), jnp.asarray(ddq)
        if not q.shape == dq.shape == ddq.shape:
            raise ValueError(
                f"position {q.shape}, velocity {dq.shape} and acceleration {ddq.shape} differ in shape: pass one of "
                "each for every sample"
            )
        if self.n_joints > 1 and (q.ndim == 0 or q.shape[-1] != self.n_joints):
            raise ValueError(f"the model has {self.n_joints} joints, but the last axis of the position is {q.shape}")
        return q, dq, ddq

    def observation_matrix(
        self, q: Num[ArrayLike, "N *n"], dq: Num[ArrayLike, "N *n"], ddq: Num[ArrayLike, "N *n"]
    ) -> Float[Array, "N *n p"]:
        """Regressor of every sample of a recording; models with memory override it.

        **Returns:** `(N, p)` or `(N, n, p)`; NaN where the past that a column needs is before the first sample.
        """
        return self.regressor(q, dq, ddq)

    def over_period(
        self, q: Num[ArrayLike, "N *n"], dq: Num[ArrayLike, "N *n"], ddq: Num[ArrayLike, "N *n"], sample_rate: float
    ) -> Float[Array, "N *n p"]:
        """`observation_matrix` of one period of a periodic motion: what was before is the end of the period.

        **Arguments:** `sample_rate` [Hz] of the period's samples, which need not be that of the recordings.
        """
        if not self.memory:
            return self.observation_matrix(q, dq, ddq)
        model, n = self.sampled_at(sample_rate), len(jnp.asarray(q))
        periods = 1 + -(-model.memory // n)
        motion = (jnp.concatenate([jnp.asarray(x)] * periods) for x in (q, dq, ddq))
        return model.observation_matrix(*motion)[-n:]

    @property
    def min_velocity(self) -> Any:
        """() or (n,): slower rows of a joint say nothing of its friction [rad/s or m/s]."""
        return 0.0

    def speed(self, dq: Num[ArrayLike, "*N n"]) -> Float[Array, "*N n"]:
        """How fast what makes the friction of each joint moves, for joints that move at `dq`."""
        return jnp.abs(jnp.asarray(dq))

    def smoothed(self, width: Num[ArrayLike, "*n"]) -> Model:
        """The model with signs of the velocity that change gradually, within some `width` [rad/s or m/s] of zero."""
        return self

    def torque(
        self,
        theta: Num[ArrayLike, " p"],
        q: Num[ArrayLike, "..."],
        dq: Num[ArrayLike, "..."],
        ddq: Num[ArrayLike, "..."],
    ) -> Float[Array, "..."]:
        """Torque [N m] (force [N] for prismatic joints) that the parameters `theta` give.

        A model with memory takes a whole recording, and returns NaN where its past is not known.
        """
        if self.memory:
            return self.observation_matrix(q, dq, ddq) @ theta
        return self.regressor(q, dq, ddq) @ theta

    def __add__(self, other: Model) -> Model:
        return Stacked(self, other)

    def _prefixed(self) -> tuple[str, ...]:
        return tuple(f"{self.label}.{name}" if self.label else name for name in self.names)


class _Pair(Model):
    """Two models that share the motion; the first says how fast what makes the friction moves."""

    first: Model
    second: Model

    @property
    def regroups(self) -> bool:
        return self.first.regroups or self.second.regroups

    @property
    def min_velocity(self) -> Any:
        return jnp.maximum(self.first.min_velocity, self.second.min_velocity)

    def speed(self, dq: Num[ArrayLike, "*N n"]) -> Float[Array, "*N n"]:
        return self.first.speed(dq)

    @property
    def memory(self) -> int:
        return max(self.first.memory, self.second.memory)

    @property
    def sample_rate(self) -> float | None:
        return _shared_rate(self.first, self.second)

    def sampled_at(self, sample_rate: float) -> Model:
        return _pair(self, lambda model: model.sampled_at(sample_rate))

    def smoothed(self, width: Num[ArrayLike, "*n"]) -> Model:
        return _pair(self, lambda model: model.smoothed(width))


class Stacked(_Pair):
    """Two models that share the motion and add their torques: Tout et al. 2023, eq. (10)."""

    def __init__(self, first: Model, second: Model):
        _check_joints(first, second)
        self.first, self.second = first, second
        self.names = first._prefixed() + second._prefixed()
        if len(set(self.names)) < len(self.names):
            raise ValueError(
                f"both models are called '{first.label}': stack two different things, such as robot + human"
            )
        self.units = first.units + second.units
        self.columns = first.columns + second.columns
        self.label = ""
        self.n_joints = first.n_joints

    @property
    def roles(self) -> tuple[Role, ...]:
        return self.first.roles + self.second.roles

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        return jnp.concatenate([self.first.row(q, dq, ddq), self.second.row(q, dq, ddq)], axis=-1)

    def observation_matrix(
        self, q: Num[ArrayLike, "N *n"], dq: Num[ArrayLike, "N *n"], ddq: Num[ArrayLike, "N *n"]
    ) -> Float[Array, "N *n p"]:
        both = [model.observation_matrix(q, dq, ddq) for model in (self.first, self.second)]
        return jnp.concatenate(both, axis=-1)


class Combined(_Pair):
    """Two models whose equal columns are merged, so that all parameters can be told apart: eq. (11).

    `merge` (p, p_first + p_second) maps the parameters of both onto the merged ones,
    `theta = merge @ concatenate([theta_first, theta_second])`. It is of zeros and ones, but where a robot's columns are
    sums of several: these are told by random motions, and `sums` says what each parameter then stands for.
    """

    merge: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    _sums: tuple[tuple[str, str], ...] = eqx.field(static=True)
    _places: tuple[int, ...] = eqx.field(static=True)
    """Of the columns that are kept among all."""

    def __init__(self, first: Model, second: Model):
        stacked = Stacked(first, second)
        self.first, self.second = first, second
        columns = list(dict.fromkeys(stacked.columns))
        members = [[i for i, other in enumerate(stacked.columns) if other == column] for column in columns]
        names = ["+".join(stacked.names[i] for i in group) for group in members]
        merge = np.array([[float(column == other) for other in stacked.columns] for column in columns])
        kept, sums = list(range(len(columns))), {name: name.replace("+", " + ") for name in names}
        if first.regroups or second.regroups:
            base = find_base(_rows(stacked)[:, [group[0] for group in members]], names)
            merge, kept, sums = np.asarray(base.map) @ merge, list(base.kept), base.sums
        self.merge, self._sums = tuple(map(tuple, merge.tolist())), tuple(sums.items())
        self._places = tuple(members[k][0] for k in kept)
        self.names = tuple(names[k] for k in kept)
        self.columns = tuple(columns[k] for k in kept)
        self.units = tuple(stacked.units[place] for place in self._places)
        self.label = ""
        self.n_joints = first.n_joints

    @property
    def sums(self) -> dict[str, str]:
        """What each parameter stands for, by its name."""
        return dict(self._sums)

    @property
    def places(self) -> tuple[int, ...]:
        """Of each parameter's column among those of both models."""
        return self._places

    @property
    def roles(self) -> tuple[Role, ...]:
        """Of merged parameters that of the first."""
        both = self.first.roles + self.second.roles
        return tuple(both[place] for place in self._places)

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        return self._kept(Stacked(self.first, self.second).row(q, dq, ddq))

    def observation_matrix(
        self, q: Num[ArrayLike, "N *n"], dq: Num[ArrayLike, "N *n"], ddq: Num[ArrayLike, "N *n"]
    ) -> Float[Array, "N *n p"]:
        return self._kept(Stacked(self.first, self.second).observation_matrix(q, dq, ddq))

    def _kept(self, W: Array) -> Array:
        return W[..., jnp.array(self._places)]


class Joints(Model):
    """Independent joints side by side: the regressors stack on the diagonal, joint after joint."""

    models: tuple[Model, ...]

    def __init__(self, *models: Model):
        if not models or any(model.n_joints != 1 for model in models):
            raise ValueError("Joints needs one model of one joint for each joint")
        self.models = models
        tagged = [(f"joint{i + 1}.", model) for i, model in enumerate(models)]
        self.names = tuple(tag + name for tag, model in tagged for name in model.names)
        self.units = tuple(unit for model in models for unit in model.units)
        self.columns = tuple(tag + column for tag, model in tagged for column in model.columns)
        self.label = models[0].label
        self.n_joints = len(models)
        _shared_rate(*models)

    @property
    def roles(self) -> tuple[Role, ...]:
        return tuple(role for model in self.models for role in model.roles)

    @property
    def memory(self) -> int:
        return max(model.memory for model in self.models)

    @property
    def sample_rate(self) -> float | None:
        return _shared_rate(*self.models)

    def sampled_at(self, sample_rate: float) -> Model:
        models = tuple(model.sampled_at(sample_rate) for model in self.models)
        return eqx.tree_at(lambda joints: joints.models, self, models)

    def smoothed(self, width: Num[ArrayLike, "*n"]) -> Model:
        widths = jnp.atleast_1d(jnp.asarray(width))
        models = tuple(model.smoothed(one) for model, one in zip(self.models, widths, strict=True))
        return eqx.tree_at(lambda joints: joints.models, self, models)

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        if self.n_joints == 1:
            return self.models[0].row(q, dq, ddq)
        rows = [model.row(q[i], dq[i], ddq[i]) for i, model in enumerate(self.models)]
        return jax.scipy.linalg.block_diag(*[row[None, :] for row in rows])

    def observation_matrix(
        self, q: Num[ArrayLike, "N *n"], dq: Num[ArrayLike, "N *n"], ddq: Num[ArrayLike, "N *n"]
    ) -> Float[Array, "N *n p"]:
        if not self.memory:
            return self.regressor(q, dq, ddq)
        if self.n_joints == 1:
            return self.models[0].observation_matrix(q, dq, ddq)
        motion = [jnp.asarray(x) for x in (q, dq, ddq)]
        blocks = [model.observation_matrix(*(x[:, i] for x in motion)) for i, model in enumerate(self.models)]
        W = jnp.zeros((len(motion[0]), self.n_joints, len(self.names)), blocks[0].dtype)
        first = 0
        for i, block in enumerate(blocks):
            W = W.at[:, i, first : first + block.shape[1]].set(block)
            first += block.shape[1]
        return W


def combine(first: Model, second: Model) -> Combined:
    """Stack two models and merge the columns they share: Tout et al. 2023, eq. (11). See `Combined`."""
    return Combined(first, second)


def _rows(model: Model) -> Numbers:
    """(rows, p) of random motions, which tell what depends on each other."""
    random, n = np.random.default_rng(0), model.n_joints
    shape = (FEWEST_ROWS // n + 1, n) if n > 1 else (FEWEST_ROWS,)
    fast = random.choice([-1.0, 1.0], shape) * 10 ** random.uniform(-2, 0.5, shape)
    motion = (np.pi * random.uniform(-1, 1, shape), fast, random.uniform(-10, 10, shape))
    with jax.enable_x64(True):
        return np.asarray(model.observation_matrix(*motion), float).reshape(-1, len(model.names))


def _pair(pair: Model, change: Callable[[Model], Model]) -> Model:
    both = change(pair.first), change(pair.second)  # type: ignore[attr-defined]
    return eqx.tree_at(lambda pair: (pair.first, pair.second), pair, both)


def _shared_rate(*models: Model) -> float | None:
    """The sample rate of all models that have memory."""
    rates = {model.sample_rate for model in models if model.sample_rate is not None}
    if len(rates) > 1:
        raise ValueError(f"models for sample rates of {sorted(rates)} Hz cannot be stacked: give both the recording's")
    return next(iter(rates), None)


def _check_joints(first: Model, second: Model) -> None:
    if first.n_joints != second.n_joints:
        raise ValueError(
            f"models of {first.n_joints} and {second.n_joints} joints cannot be stacked: give both the same"
        )
    _shared_rate(first, second)
