"""What of a robot is to be identified, where the rest is known: some of its columns, or a load at its tip."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models import rigid_body
from jaximp.models.base import Model, Role
from jaximp.models.chain import Chain
from jaximp.models.spatial import PARAMETERS
from jaximp.types import AnyArray, nearest


class Selected(Model):
    """Some of the columns of a model, in its own order.

    **Raises:** `ValueError` for a name that the model has not.
    """

    of: Model
    kept: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, model: Model, names: Sequence[str]):
        for name in names:
            if name not in model.names:
                raise ValueError(f"columns has '{name}': {nearest(name, list(model.names))}")
        if not names:
            raise ValueError("columns is empty: name at least one parameter of the model")
        self.of, self.n_joints, self.label = model, model.n_joints, model.label
        self.kept = tuple(k for k, name in enumerate(model.names) if name in names)
        self.names, self.units, self.columns = (
            tuple(values[k] for k in self.kept) for values in (model.names, model.units, model.columns)
        )

    @property
    def roles(self) -> tuple[Role, ...]:
        return tuple(self.of.roles[k] for k in self.kept)

    @property
    def memory(self) -> int:
        return self.of.memory

    @property
    def sample_rate(self) -> float | None:
        return self.of.sample_rate

    def sampled_at(self, sample_rate: float) -> Model:
        return eqx.tree_at(lambda model: model.of, self, self.of.sampled_at(sample_rate))

    def smoothed(self, width: Num[ArrayLike, "*n"]) -> Model:
        return eqx.tree_at(lambda model: model.of, self, self.of.smoothed(width))

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        return self.of.row(q, dq, ddq)[..., np.array(self.kept)]

    def regressor(
        self, q: Num[ArrayLike, "..."], dq: Num[ArrayLike, "..."], ddq: Num[ArrayLike, "..."]
    ) -> Float[Array, "... p"]:
        return self.of.regressor(q, dq, ddq)[..., np.array(self.kept)]

    def observation_matrix(
        self, q: Num[ArrayLike, "N *n"], dq: Num[ArrayLike, "N *n"], ddq: Num[ArrayLike, "N *n"]
    ) -> Float[Array, "N *n p"]:
        return self.of.observation_matrix(q, dq, ddq)[..., np.array(self.kept)]


class Load(Model):
    """The ten inertial parameters of a body that is fixed to the tip of a chain, on top of the robot's own.

    They belong to the frame of the tip, as those of `identification.identify_payload`.

    **Raises:** `ValueError` for a chain with branches of which no link was named as the tip.
    """

    robot: Chain
    in_link: Float[AnyArray, "10 10"]
    """`Chain.load_in_link`."""

    def __init__(self, robot: Chain):
        if robot.tip is None or robot.tree.tip_body < 0:
            raise ValueError(f"{robot.robot} has no moving tip that bears a load: set tip to one of its links")
        self.robot, self.n_joints, self.label, self.in_link = robot, robot.n_joints, "load", robot.load_in_link
        self.names, self.units = tuple(f"load.{name}" for name in PARAMETERS), tuple(PARAMETERS.values())
        self.columns = tuple(f"{name} at {robot.tip} of {robot.robot}" for name in PARAMETERS)

    @property
    def roles(self) -> tuple[Role, ...]:
        return tuple(Role(kind) for kind in ("link_mass", *["first_moment"] * 3, *["link_inertia"] * 6))

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        return self.regressor(q, dq, ddq)

    def regressor(
        self, q: Num[ArrayLike, "..."], dq: Num[ArrayLike, "..."], ddq: Num[ArrayLike, "..."]
    ) -> Float[Array, "... p"]:
        motion = self._checked(q, dq, ddq)
        return rigid_body.rows_of_model(_link_lanes, self.n_joints, self.robot.tree, *motion) @ self.in_link


def _link_lanes(tree: rigid_body.KinematicTree, q: Array, dq: Array, ddq: Array) -> Array:
    """(n, 10, N) of the link that bears the load."""
    return jnp.stack([column[tree.tip_body] for column in rigid_body.regressor_columns(tree, q, dq, ddq)], axis=1)
