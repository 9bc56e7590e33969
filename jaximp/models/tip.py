"""A human (or any impedance) at the end of a robot: mass, damping and stiffness of the tip in chosen directions.

With J the linear part of the tip's Jacobian, x its position and v = J dq its velocity, the joints feel
`J' (M dv/dt + D v + K x + f)`: Tout et al. 2023, eqs. (1) and (9), with the human's force at the tip. The spring is at
rest where K x = -f.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models import rigid_body
from jaximp.models.base import Model, Role
from jaximp.models.chain import Chain
from jaximp.models.rigid_body import KinematicTree
from jaximp.types import AnyArray, Numbers, nearest

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
UNITS = {"mass": "kg", "damping": "N s/m", "stiffness": "N/m", "force": "N"}
ROLES = {"mass": "inertia", "damping": "damping", "stiffness": "stiffness", "force": "offset"}


class TipImpedance(Model):
    """Mass, damping and stiffness against motion of a chain's tip, and a constant force, in directions of the base.

    Stack it on the robot, `chain + TipImpedance(chain)`, or merge what cannot be told apart with `combine`: the mass of
    all directions together acts like mass in the last link.

    **Arguments:**

    - `chain`: the robot, with a tip.
    - `directions`: names of axes of the base's frame, such as `("x", "z")` or `"xyz"`, or vectors (k, 3) that are
      orthogonal to each other; they are made of length one.
    - `full`: whether matrices have elements off the diagonal, such as `stiffness_xy`, which are symmetric.
    - `mass`, `damping`, `stiffness`, `force`: which columns there are.

    Parameters are called `mass_x`, `damping_x`, `stiffness_x`, `force_x`, by number where vectors were given. `force`
    is that of the spring where the tip is at the base's origin [N], so that it rests at `equilibrium`.

    **Raises:** `ValueError` for a chain without a tip, and directions that are none or not orthogonal.
    """

    tree: KinematicTree
    directions: Float[AnyArray, "k 3"]
    """Of length one."""
    pairs: tuple[tuple[int, int], ...] = eqx.field(static=True)
    """Directions of each element of a matrix."""
    kinds: tuple[str, ...] = eqx.field(static=True)
    joint_kinds: tuple[str, ...] = eqx.field(static=True)
    """`revolute` or `prismatic`, of the robot's joints."""
    labels: tuple[str, ...] = eqx.field(static=True)
    """Of the directions, as they stand in the names."""
    _digest: str = eqx.field(static=True)

    def __init__(
        self,
        chain: Chain,
        directions: str | Sequence[str] | Num[AnyArray, "k 3"] = "xyz",
        *,
        full: bool = False,
        mass: bool = True,
        damping: bool = True,
        stiffness: bool = True,
        force: bool = True,
    ):
        if chain.tip is None:
            raise ValueError(f"{chain.robot} has no tip: set tip to one of its links when it is read")
        labels, vectors = _directions(directions)
        k, self.labels = len(labels), tuple(labels)
        self.tree, self.directions, self._digest = chain.tree, vectors, f"{chain.robot} {chain.digest}"
        self.pairs = tuple((i, j) for i in range(k) for j in range(i, k) if full or i == j)
        wanted = {"mass": mass, "damping": damping, "stiffness": stiffness, "force": force}
        self.kinds = tuple(kind for kind, is_wanted in wanted.items() if is_wanted)
        self.n_joints, self.label, self.joint_kinds = chain.n_joints, "human", chain.joint_kinds
        names = [(kind, pair) for kind in self.kinds for pair in self._elements(kind)]
        self.names = tuple(f"{kind}_{_label(labels, pair)}" for kind, pair in names)
        self.units = tuple(UNITS[kind] for kind, _ in names)
        at = np.array2string(vectors, precision=12)
        self.columns = tuple(f"{kind} {pair} at the tip of {self._digest} along {at}" for kind, pair in names)

    def __hash__(self) -> int:
        """Compiled programs are kept by their model."""
        return hash((self.columns, self.names))

    @property
    def regroups(self) -> bool:
        return True

    @property
    def roles(self) -> tuple[Role, ...]:
        return tuple(
            Role(ROLES[kind], pair if kind != "force" else pair[:1])
            for kind in self.kinds
            for pair in ((i + 1, j + 1) for i, j in self._elements(kind))
        )

    def _elements(self, kind: str) -> tuple[tuple[int, int], ...]:
        """A force has no matrix."""
        return tuple((i, j) for i, j in self.pairs if i == j) if kind == "force" else self.pairs

    def equilibrium(self, theta: Num[ArrayLike, "*M p"]) -> Float[Array, "*M k"]:
        """Where the spring is at rest, along each direction [m].

        **Raises:** `ValueError` without stiffness and force.
        """
        if not {"stiffness", "force"} <= set(self.kinds):
            raise ValueError("an equilibrium needs stiffness and force: make the model with both")
        theta, k = jnp.asarray(theta), len(self.directions)
        K = jnp.zeros((*theta.shape[:-1], k, k))
        first = len(self.pairs) * self.kinds.index("stiffness")
        for place, (i, j) in enumerate(self.pairs):
            K = K.at[..., i, j].set(theta[..., first + place]).at[..., j, i].set(theta[..., first + place])
        return -jnp.linalg.solve(K, theta[..., -k:, None])[..., 0]

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        return self.regressor(q, dq, ddq)

    def regressor(
        self, q: Num[ArrayLike, "..."], dq: Num[ArrayLike, "..."], ddq: Num[ArrayLike, "..."]
    ) -> Float[Array, "... p"]:
        """As for every `Model`."""
        return rigid_body.rows_of_model(_lanes, self.n_joints, self, *self._checked(q, dq, ddq))


def _lanes(model: TipImpedance, q: Array, dq: Array, ddq: Array) -> Array:
    """(n, p, N)"""
    tree, along = model.tree, jnp.asarray(model.directions, q.dtype)

    def jacobian(q: Array) -> Array:
        """(k, n, N) along the directions."""
        return jnp.einsum("ka,anN->knN", along, rigid_body.jacobian_lanes(tree, q)[:3])

    def velocity(q: Array) -> Array:
        return jnp.einsum("knN,nN->kN", jacobian(q), dq)

    J = jacobian(q)
    v, turning = jax.jvp(velocity, (q,), (dq,))
    motion = {
        "mass": jnp.einsum("knN,nN->kN", J, ddq) + turning,
        "damping": v,
        "stiffness": along @ rigid_body.pose_lanes(tree, q)[1],
        "force": jnp.ones_like(v),
    }

    def column(kind: str, i: int, j: int) -> Array:
        x = motion[kind]
        return J[i] * x[j] if i == j else J[i] * x[j] + J[j] * x[i]

    return jnp.stack([column(kind, i, j) for kind in model.kinds for i, j in model._elements(kind)], axis=1)


def _directions(given: str | Sequence[str] | Num[AnyArray, "k 3"]) -> tuple[list[str], Numbers]:
    """Labels and (k, 3) vectors of length one."""
    names = list(given)
    if names and all(isinstance(name, str) for name in names):
        for name in names:
            if name not in AXES:
                raise ValueError(f"directions has '{name}': {nearest(str(name), list(AXES))}")
        if len(set(names)) < len(names):
            raise ValueError(f"directions has an axis twice: {', '.join(map(str, names))}")
        return [str(name) for name in names], np.array([AXES[str(name)] for name in names])
    vectors = np.asarray(given, float)
    size = np.linalg.norm(vectors, axis=-1) if vectors.ndim == 2 else np.zeros(1)
    if vectors.ndim != 2 or vectors.shape[-1] != 3 or not np.isfinite(vectors).all() or not (size > 0).all():
        raise ValueError("directions must be axes such as 'xz', or vectors of three numbers each, not all zero")
    vectors = vectors / size[:, None]
    if np.abs(vectors @ vectors.T - np.eye(len(vectors))).max() > 1e-6:
        raise ValueError(
            "directions must be orthogonal to each other: the stiffness between them is an element of its own"
        )
    return [str(k + 1) for k in range(len(vectors))], vectors


def _label(labels: Sequence[str], pair: tuple[int, int]) -> str:
    i, j = pair
    return labels[i] if i == j else labels[i] + labels[j]
