"""Kinematics and dynamics of trees of rigid bodies: pure functions of a `KinematicTree` and the motion of its joints.

All of them take one sample or any batch: motions are `(..., n)`, and `(n,)` for one sample. The recursion over the
bodies is that of Featherstone 2008, *Rigid Body Dynamics Algorithms* (ch. 5), in the frames of the bodies; the
regressor is that of Atkeson, An and Hollerbach 1986. `jit`, `vmap` and `grad` work on every function, also with respect
to the geometry.

Inside, samples are on the last axis, where a processor takes eight at a time, and vectors are tuples of three arrays.
One `lax.scan` over the bodies compiles in the same time whatever their number. Two things keep it fast on a CPU: it
emits the state that came in (had it to emit the one that goes out, XLA would compute everything again while it writes
that), and rotations are nine arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models.joint import sine_and_cosine
from jaximp.numerics.compilation import compiled
from jaximp.types import AnyArray

AT_ONCE = 128
"""Samples of a block: what so many need stays in the cache."""
ONE_BLOCK = 1024
"""So many are computed without blocks: as fast, and their gradient in half of the time."""

Vector = tuple[Any, Any, Any]
"""Components, each with the samples on its last axis."""


class KinematicTree(eqx.Module):
    """Frames and axes of n_b bodies, each moved by one joint, and the n coordinates that move these.

    Most trees have a coordinate for each joint. With joints that follow others, gears and coupled wrists the joints are
    at `coordinates @ q + zero`, and the torques of the coordinates follow by virtual work.
    """

    rotation: Float[AnyArray, "n_b 3 3"]
    """From each body's frame to its parent's, with the joint at zero."""
    position: Float[AnyArray, "n_b 3"]
    """Origin of each body's frame in its parent's [m]."""
    axis: Float[AnyArray, "n_b 3"]
    """Of length one, in the body's frame."""
    coordinates: Float[AnyArray, "n_b n"]
    """Motion of the joints for each coordinate."""
    zero: Float[AnyArray, " n_b"]
    """Joint positions where all coordinates are zero [rad or m]."""
    gravity: Float[AnyArray, "3"]
    """Gravitational acceleration in the base's frame [m/s^2]."""
    tip_rotation: Float[AnyArray, "3 3"]
    """From the tip's frame to that of the body it is fixed to."""
    tip_position: Float[AnyArray, "3"]
    """Of the tip in the frame of its body [m]."""
    parents: tuple[int, ...] = eqx.field(static=True)
    """Of each body, a body before it; -1 for the base."""
    prismatic: tuple[bool, ...] = eqx.field(static=True)
    """Whether the joint moves along its axis, not about it."""
    tip_body: int = eqx.field(static=True)
    """Which the tip is fixed to; -1 for the base."""

    @property
    def n_bodies(self) -> int:
        return len(self.parents)

    @property
    def n_joints(self) -> int:
        """Coordinates, which torques belong to."""
        return self.coordinates.shape[1]


class Axes(NamedTuple):
    """How the body of row j moves with coordinate i, in its own frame: three arrays `(n_b, n, N)` each."""

    angular: Vector
    """Angular velocity for each unit of the coordinate's velocity."""
    linear: Vector
    """Velocity of the frame's origin."""


class Motion(NamedTuple):
    """Of every body, in its own frame: three arrays `(n_b, N)` each."""

    velocity: Vector
    """Angular velocity."""
    acceleration: Vector
    """Angular acceleration."""
    linear: Vector
    """Acceleration of the frame's origin, less gravity."""


def forward_kinematics(
    tree: KinematicTree, q: Num[ArrayLike, "... n"]
) -> tuple[Float[Array, "... 3 3"], Float[Array, "... 3"]]:
    """Where the tip is: rotation from its frame to the base's `(..., 3, 3)`, and position `(..., 3)` [m]."""
    return over_samples(pose_lanes, tree.n_joints, tree, q)


def body_frames(
    tree: KinematicTree, q: Num[ArrayLike, "... n"]
) -> tuple[Float[Array, "... n_b 3 3"], Float[Array, "... n_b 3"]]:
    """Where all bodies are: rotations from their frames to the base's, and their origins [m]."""
    return over_samples(_frame_lanes, tree.n_joints, tree, q)


def jacobian(tree: KinematicTree, q: Num[ArrayLike, "... n"]) -> Float[Array, "... 6 n"]:
    """Velocity of the tip (rows 1 to 3) and its angular velocity (4 to 6) for each coordinate's velocity.

    In the base's frame: `jacobian(tree, q) @ dq`. Zero in the columns of joints that do not move the tip.
    """
    return over_samples(jacobian_lanes, tree.n_joints, tree, q)


def inverse_dynamics(
    tree: KinematicTree,
    theta: Num[ArrayLike, "n_b 10"],
    q: Num[ArrayLike, "... n"],
    dq: Num[ArrayLike, "... n"],
    ddq: Num[ArrayLike, "... n"],
) -> Float[Array, "... n"]:
    """Torque [N m] (force [N]) of each coordinate for a motion: `M(q) ddq + C(q, dq) dq + g(q)`.

    **Arguments:** `theta` ten parameters of each body about the origin of its frame, in the order of
    `spatial.PARAMETERS`; positions, velocities and accelerations.
    """
    return over_samples(torque_lanes, tree.n_joints, (tree, jnp.asarray(theta)), q, dq, ddq)


def mass_matrix(
    tree: KinematicTree, theta: Num[ArrayLike, "n_b 10"], q: Num[ArrayLike, "... n"]
) -> Float[Array, "... n n"]:
    """Mass matrix M(q), symmetric and for real bodies positive definite; `theta` as for `inverse_dynamics`."""
    return over_samples(_mass_lanes, tree.n_joints, (tree, jnp.asarray(theta)), q)


def coriolis_matrix(
    tree: KinematicTree, theta: Num[ArrayLike, "n_b 10"], q: Num[ArrayLike, "... n"], dq: Num[ArrayLike, "... n"]
) -> Float[Array, "... n n"]:
    """Matrix C(q, dq) of Christoffel's symbols: `C @ dq` is the torque of Coriolis and centrifugal forces, and
    `dM/dt - 2 C` is skew (Siciliano et al. 2009, *Robotics*, eqs. 7.44 to 7.49)."""
    return over_samples(_coriolis_lanes, tree.n_joints, (tree, jnp.asarray(theta)), q, dq)


def gravity_torque(
    tree: KinematicTree, theta: Num[ArrayLike, "n_b 10"], q: Num[ArrayLike, "... n"]
) -> Float[Array, "... n"]:
    """Torque that holds the tree still against gravity [N m or N]; `theta` as for `inverse_dynamics`."""
    still = jnp.zeros_like(jnp.asarray(q), dtype=jnp.result_type(q, 1.0))
    return inverse_dynamics(tree, theta, q, still, still)


def regressor(
    tree: KinematicTree, q: Num[ArrayLike, "... n"], dq: Num[ArrayLike, "... n"], ddq: Num[ArrayLike, "... n"]
) -> Float[Array, "... n p"]:
    """Regressor of all `p = 10 n_b` inertial parameters, body after body: `regressor @ theta.ravel()` is the torque."""
    return over_samples(_regressor_lanes, tree.n_joints, tree, q, dq, ddq)


def regressor_columns(
    tree: KinematicTree, q: AnyArray, dq: AnyArray, ddq: AnyArray, xp: ModuleType = jnp
) -> tuple[AnyArray, ...]:
    """Ten arrays (n_b, n, N), one for each inertial parameter: its torque at each coordinate, for each body.

    **Arguments:** motions (n, N) with the samples on the last axis; `xp` is `numpy` to compute at once, without any
    compilation.
    """
    w, v = _axes(tree, q, xp)
    o, b, a = (tuple(x[:, None] for x in of) for of in _motion(tree, q, dq, ddq, xp))
    # Torque of a body at a coordinate is v . force + w . couple, with force and couple as in `inverse_dynamics`.
    moment = _plus(_cross(v, b), _scaled(_dot(o, v), o), _scaled(-_dot(o, o), v), _cross(a, w))
    x = _cross(w, o)

    def product(m: int, n: int) -> AnyArray:
        return w[m] * b[n] + w[n] * b[m] + x[m] * o[n] + x[n] * o[m]

    def square(m: int) -> AnyArray:
        return w[m] * b[m] + x[m] * o[m]

    second = (square(0), product(0, 1), square(1), product(0, 2), product(1, 2), square(2))
    return (_dot(v, a), *moment, *second)


# The same for motions (n, N) with the samples on the last axis, of what is returned as well.


def pose_lanes(tree: KinematicTree, q: Array) -> tuple[Array, Array]:
    """`forward_kinematics` (3, 3, N) and (3, N)."""
    R, p = _tip(tree, *body_poses(tree, q))
    return jnp.stack([jnp.stack(row) for row in R]), jnp.stack(p)


def _frame_lanes(tree: KinematicTree, q: Array) -> tuple[Array, Array]:
    """(n_b, 3, 3, N) and (n_b, 3, N)."""
    R, p = body_poses(tree, q)
    return jnp.stack([jnp.stack(row, axis=1) for row in R], axis=1), jnp.stack(p, axis=1)


def jacobian_lanes(tree: KinematicTree, q: Array) -> Array:
    """`jacobian` (6, n, N)."""
    if tree.tip_body < 0:
        return jnp.zeros((6, *q.shape), q.dtype)
    axes = _axes(tree, q, jnp)
    R, _ = body_poses(tree, q)
    turn = [[R[a][b][tree.tip_body] for b in range(3)] for a in range(3)]
    angular, linear = (tuple(x[tree.tip_body] for x in of) for of in axes)
    linear = _plus(linear, _cross(angular, tuple(tree.tip_position)))
    return jnp.stack([*_turned(turn, linear), *_turned(turn, angular)])


def torque_lanes(parts: tuple[KinematicTree, Array], q: Array, dq: Array, ddq: Array) -> Array:
    tree, theta = parts
    axes, (o, b, a) = _axes(tree, q, jnp), _motion(tree, q, dq, ddq, jnp)
    mass, moment, inertia = _split(theta[:, :, None])
    force = _plus(_scaled(mass, a), _cross(b, moment), _cross(o, _cross(o, moment)))
    couple = _plus(_cross(moment, a), _times(inertia, b), _cross(o, _times(inertia, o)))
    force, couple = (tuple(x[:, None] for x in of) for of in (force, couple))
    return (_dot(axes.linear, force) + _dot(axes.angular, couple)).sum(axis=0)


def _coriolis_lanes(parts: tuple[KinematicTree, Array], q: Array, dq: Array) -> Array:
    def slope(direction: Array) -> Array:
        return jax.jvp(lambda q: _mass_lanes(parts, q), (q,), (jnp.broadcast_to(direction[:, None], q.shape),))[1]

    slopes = jax.vmap(slope)(jnp.eye(len(q), dtype=q.dtype))  # [k, i, j]: of M_ij along q_k
    along = jnp.einsum("kijN,kN->ijN", slopes, dq)
    across = jnp.einsum("jikN,kN->ijN", slopes, dq)
    return (along + across - across.swapaxes(0, 1)) / 2


def _regressor_lanes(tree: KinematicTree, q: Array, dq: Array, ddq: Array) -> Array:
    columns = jnp.stack(regressor_columns(tree, q, dq, ddq), axis=1)
    return columns.reshape(-1, *q.shape).swapaxes(0, 1)


def _mass_lanes(parts: tuple[KinematicTree, Array], q: Array) -> Array:
    """(n, n, N)"""
    tree, theta = parts
    w, v = _axes(tree, q, jnp)
    mass, moment, inertia = _split(theta[:, :, None, None])
    momentum = _plus(_scaled(mass, v), _cross(w, moment))
    angular = _plus(_cross(moment, v), _times(inertia, w))
    return jnp.einsum("cjiN,cjkN->ikN", jnp.stack([*v, *w]), jnp.stack([*momentum, *angular]))


class _Joint(NamedTuple):
    """Every joint at its position: arrays whose first axis counts the bodies, as `_down` takes them."""

    R: tuple[Vector, Vector, Vector]
    """From the body's frame to its parent's, row by row."""
    p: Vector
    """Origin of the body's frame in its parent's."""
    turns: Vector | None
    """The axis, where the joint turns about it, and zero elsewhere; None if no joint turns."""
    slides: Vector | None
    """The axis, where the joint moves along it."""


def _joints(tree: KinematicTree, q: AnyArray, xp: ModuleType) -> _Joint:
    q = tree.coordinates @ q + tree.zero[:, None]
    sine, cosine = (np.sin(q), np.cos(q)) if xp is np else sine_and_cosine(q)
    prismatic = np.array(tree.prismatic)
    A, u = tree.rotation, tree.axis
    K = xp.cross(u[:, None, :], xp.eye(3, dtype=u.dtype)[None]).swapaxes(1, 2)  # K @ v is u x v
    K = xp.where(prismatic[:, None, None], 0.0, K).astype(u.dtype)
    AK = A @ K
    AKK = AK @ K
    R = tuple(
        tuple(A[:, i, j, None] + AK[:, i, j, None] * sine + AKK[:, i, j, None] * (1 - cosine) for j in range(3))
        for i in range(3)
    )
    p: Vector = tuple(tree.position.T)
    if prismatic.any():
        slide = xp.where(prismatic[:, None], (A @ u[:, :, None])[:, :, 0], 0.0).astype(u.dtype)
        p = tuple(p[i][:, None] + slide[:, i, None] * q for i in range(3))
    turns, slides = (
        tuple(xp.where(which, component, 0.0).astype(u.dtype) for component in u.T) if which.any() else None
        for which in (~prismatic, prismatic)
    )
    return _Joint(R, p, turns, slides)  # type: ignore[arg-type]


def _axes(tree: KinematicTree, q: AnyArray, xp: ModuleType) -> Axes:
    zero = xp.zeros(q.shape, q.dtype)

    def step(state: Axes, x: tuple[_Joint, AnyArray]) -> Axes:
        (w, v), (joint, own) = state, x
        own = own[:, None]
        return Axes(
            _plus(_back(joint.R, w), _scaled(own, joint.turns)),
            _plus(_back(joint.R, _plus(v, _cross(w, joint.p))), _scaled(own, joint.slides)),
        )

    start = Axes((zero, zero, zero), (zero, zero, zero))
    return _down(tree, step, start, (_joints(tree, q, xp), tree.coordinates), xp)


def _motion(tree: KinematicTree, q: AnyArray, dq: AnyArray, ddq: AnyArray, xp: ModuleType) -> Motion:
    zero = xp.zeros(q.shape[1:], q.dtype)

    def step(state: Motion, x: tuple[_Joint, AnyArray, AnyArray]) -> Motion:
        (o, b, a), (joint, dq, ddq) = state, x
        came = _back(joint.R, o)
        turning, sliding = _scaled(dq, joint.turns), _scaled(dq, joint.slides)
        carried = _plus(a, _cross(b, joint.p), _cross(o, _cross(o, joint.p)))
        coriolis = None if sliding is None else _scaled(2.0, _cross(came, sliding))
        return Motion(
            _plus(came, turning),
            _plus(_back(joint.R, b), None if turning is None else _cross(came, turning), _scaled(ddq, joint.turns)),
            _plus(_back(joint.R, carried), coriolis, _scaled(ddq, joint.slides)),
        )

    weight: Vector = tuple(zero - g for g in tree.gravity)
    start = Motion((zero, zero, zero), (zero, zero, zero), weight)
    rates = (tree.coordinates @ x for x in (dq, ddq))
    return _down(tree, step, start, (_joints(tree, q, xp), *rates), xp)


Pose = tuple[tuple[Vector, Vector, Vector], Vector]


def body_poses(tree: KinematicTree, q: Array) -> Pose:
    """Of every body in the base: nine arrays (n_b, N) of rotations, three of positions."""

    def step(state: Pose, joint: _Joint) -> Pose:
        (R, p), transposed = state, tuple(zip(*joint.R, strict=True))
        return tuple(tuple(_dot(row, column) for column in transposed) for row in R), _plus(p, _turned(R, joint.p))  # type: ignore[return-value]

    zero = jnp.zeros(q.shape[1:], q.dtype)
    start = tuple(tuple(zero + float(i == j) for j in range(3)) for i in range(3)), (zero, zero, zero)
    return _down(tree, step, start, _joints(tree, q, jnp), jnp)


def _down(tree: KinematicTree, step: Callable[[Any, Any], Any], start: Any, xs: Any, xp: ModuleType) -> Any:
    """State of every body by `step(state of its parent, its part of xs)`, with the base's at the `start`."""
    if xp is np:
        states = [start]
        for k, parent in enumerate(tree.parents):
            states.append(step(states[parent + 1], jax.tree.map(lambda x: x[k], xs)))  # noqa: B023
        return jax.tree.map(lambda *bodies: np.stack(bodies), *states[1:])
    if tree.parents == tuple(range(-1, tree.n_bodies - 1)):
        last, before = jax.lax.scan(lambda state, x: (step(state, x), state), start, xs)
        return jax.tree.map(lambda b, end: jnp.concatenate([b[1:], end[None]]), before, last)

    def into(states: Any, x: tuple[Array, Array, Any]) -> tuple[Any, None]:
        k, parent, own = x
        new = step(jax.tree.map(lambda s: s[parent], states), own)
        return jax.tree.map(lambda s, one: s.at[k].set(one), states, new), None

    base_first = jax.tree.map(lambda s: jnp.zeros((tree.n_bodies + 1, *s.shape), s.dtype).at[0].set(s), start)
    order = jnp.arange(1, tree.n_bodies + 1), jnp.array(tree.parents) + 1
    states, _ = jax.lax.scan(into, base_first, (*order, xs))
    return jax.tree.map(lambda s: s[1:], states)


def over_samples(lanes: Callable[..., Any], n: int, parts: Any, *motion: Num[ArrayLike, "... n"]) -> Any:
    """A function of `parts` and motions (n, N), with the samples on the last axis of what it returns, for any batch
    (..., n).

    Very many samples are computed some at a time, so that what lies between stays in the cache. `lanes` must be a
    function of a module: what is compiled for it is kept by it.
    """
    arrays = [jnp.asarray(x) for x in motion]
    shape, dtype = arrays[0].shape, jnp.result_type(*arrays, 1.0)
    if any(x.shape != shape for x in arrays) or not shape or shape[-1] != n:
        raise ValueError(
            f"the motion has the shapes {', '.join(str(x.shape) for x in arrays)}: all must be equal, with the "
            f"{n} joints on the last axis"
        )
    found = _in_blocks(lanes, parts, [x.astype(dtype).reshape(-1, n) for x in arrays])
    return jax.tree.map(lambda x: x.reshape(*shape[:-1], *x.shape[1:]), found)


def rows_of_model(lanes: Callable[..., Any], n: int, parts: Any, *motion: Num[ArrayLike, "..."]) -> Any:
    """`over_samples` of a regressor (n, p, N), for the motion of a `Model`: one joint has no axis of joints."""
    if n > 1:
        return over_samples(lanes, n, parts, *motion)
    return over_samples(lanes, 1, parts, *(jnp.asarray(x)[..., None] for x in motion))[..., 0, :]


@partial(compiled, static_argnums=0)
def _in_blocks(lanes: Callable[..., Any], parts: Any, rows: list[Array]) -> Any:
    """Of motions (N, n), in their precision."""
    parts = jax.tree.map(lambda x: jnp.asarray(x, rows[0].dtype), parts)

    def some(rows: list[Array]) -> Any:
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), lanes(parts, *(x.T for x in rows)))

    count = len(rows[0])
    if count <= ONE_BLOCK:
        return some(rows)

    # Each block is written to its place; the last one goes back so far that it is full. (To fill up the samples, and to
    # cut off what was too much, would copy everything once more.)
    def into(whole: Any, start: Array) -> tuple[Any, None]:
        block = some([jax.lax.dynamic_slice_in_dim(x, start, AT_ONCE) for x in rows])
        write = partial(jax.lax.dynamic_update_slice_in_dim, start_index=start, axis=0)
        return jax.tree.map(write, whole, block), None

    shapes = jax.eval_shape(some, [x[:1] for x in rows])
    empty = jax.tree.map(lambda x: jnp.zeros((count, *x.shape[1:]), x.dtype), shapes)
    starts = jnp.minimum(jnp.arange(0, count, AT_ONCE), count - AT_ONCE)
    return jax.lax.scan(into, empty, starts)[0]


def _tip(tree: KinematicTree, R: Any, p: Vector) -> tuple[Any, Vector]:
    """Pose of the tip from those of the bodies."""
    at = tree.tip_body
    fixed = tuple(map(tuple, tree.tip_rotation.T))
    R = [[R[i][j][at] for j in range(3)] for i in range(3)]
    return [[_dot(row, column) for column in fixed] for row in R], _plus(
        tuple(x[at] for x in p), _turned(R, tuple(tree.tip_position))
    )


def _split(theta: AnyArray) -> tuple[AnyArray, Vector, tuple[AnyArray, ...]]:
    """Mass, first moments, and the six of the inertia."""
    columns = tuple(theta[:, k] for k in range(10))
    return columns[0], columns[1:4], columns[4:]


def _cross(a: Any, b: Any) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _plus(*vectors: Any) -> Vector:
    """Their sum; None is zero."""
    first, *others = [vector for vector in vectors if vector is not None]
    for other in others:
        first = tuple(x + y for x, y in zip(first, other, strict=True))
    return first


def _scaled(by: Any, vector: Any) -> Any:
    return None if vector is None else tuple(by * x for x in vector)


def _turned(R: Any, v: Any) -> Vector:
    return _dot(R[0], v), _dot(R[1], v), _dot(R[2], v)


def _back(R: Any, v: Any) -> Vector:
    """By the transpose."""
    return tuple(R[0][i] * v[0] + R[1][i] * v[1] + R[2][i] * v[2] for i in range(3))


def _times(inertia: Any, v: Any) -> Vector:
    xx, xy, yy, xz, yz, zz = inertia
    return _dot((xx, xy, xz), v), _dot((xy, yy, yz), v), _dot((xz, yz, zz), v)
