"""A robot of n joints from its URDF, as a model with base parameters: Tout et al. 2023, eqs. (1) to (5), (9)."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models import rigid_body
from jaximp.models.base import Model, Role
from jaximp.models.base_parameters import BaseParameters, find_base
from jaximp.models.friction import Speed, Term, friction_terms
from jaximp.models.joint import parameter_units
from jaximp.models.rigid_body import KinematicTree
from jaximp.models.spatial import PARAMETERS, moved
from jaximp.models.urdf import Bodies, Frame, Joint, Urdf, following, moving_bodies, read_urdf, require_known
from jaximp.types import AnyArray, Numbers, listed

GRAVITY = (0.0, 0.0, -9.81)
ROWS, FEWEST_MOTIONS = 1200, 40
"""By which base columns are chosen: rows of random motions, and at least so many motions."""
PREFERRED = ("mc_x", "mc_y", "mc_z", "Ixx", "Ixy", "Iyy", "Ixz", "Iyz", "Izz", "mass")
"""Within a link, what is kept of parameters that only act together: the first."""

SHARED = ("ddq", "dq", "sign(dq)", "1")
"""Columns that other models of a joint have, too, under the same names."""

PerJoint = float | Mapping[str, float] | Sequence[float] | Num[AnyArray, " n"]
"""One number for all joints, one for each, or those of some by name."""


class JointLimits(NamedTuple):
    """What the URDF allows each of n joints, infinite where it says nothing. At the joints, not at their motors."""

    lower: Numbers
    """(n,) positions [rad or m]."""
    upper: Numbers
    velocity: Numbers
    """(n,) [rad/s or m/s]."""
    effort: Numbers
    """(n,) [N m or N]."""


class Chain(Model):
    """A robot's rigid bodies with friction and rotors, linear in base parameters: `M ddq + C dq + g + f(dq)`.

    The columns are the base columns alone: what no motion shows has none, and what only acts together has one. `sums`
    says what each stands for. Bodies are numbered from the base: `link2` is what the second joint moves with all that
    is fixed to it (`link_names`), and its parameters belong to the frame of that joint's link in the URDF: `mass`,
    `mc_x` (mass times centre of mass) to `mc_z`, and `Ixx` to `Izz` about the origin. `joint2` is the second of
    `joint_names`. Branches follow each other in the order of the file.

    **Arguments:**

    - `robot`: the URDF, as `read_urdf` gives it; `Chain.from_urdf(path, ...)` reads it.
    - `tip`: link whose pose and Jacobian are meant; by default the one that the last joint moves, if there are no
      branches. `base`: link from which the chain starts and that does not move, the root by default.
    - `gravity` (3,) in the base's frame [m/s^2].
    - `locked`: joints that stay, by their positions [rad or m], or just their names for zero.
    - `friction`: names of `friction.FRICTION`, or True for `("viscous", "coulomb")`; `rotor` for the inertia of each
      motor's rotor, times its gear ratio squared where positions are those of joints; `offset` for a constant torque.
    - `gear`: turns of the motor for one of the joint. `coupling` (n, n): where motors share joints,
      `joints = coupling @ (motors / gear)`. With `side = "motor"` positions and torques are those of the motors, by
      `side = "joint"` those of the joints; friction and rotors are the motors' in both cases.
    - `zero` and `sign`: the URDF's joints are at `sign * position + zero`, and torques have the same sign.
    - `stribeck`: velocity [rad/s or m/s] and exponent of Stribeck's curve, for friction that has it; or `"estimate"`,
      by which an identification looks for both first.
    - `min_velocity`: below it [rad/s or m/s] friction is not that of the model; `moving` tells such rows.
    - `rounding`: components of rotations and axes closer to zero are what the file rounded. Base columns are chosen
      with zeros in their place, or 1.5708 for a quarter turn would make a dozen columns that nothing excites. All
      else takes the file at its word, and `base.residual` says how much torque the base columns then lack.
    - `strict=False` takes links without `<inertial>` for massless and limits of zero for none.

    Joints that follow others (`mimic`) move with them, and their torque counts at the one they follow.

    **Raises:** `ValueError` in one line for what does not fit the URDF; see `urdf.moving_bodies`.
    """

    tree: KinematicTree
    """What the functions of `rigid_body` take."""
    links: Float[AnyArray, "n_b 10"]
    """The URDF's inertial parameters of each body, in the order of `spatial.PARAMETERS`."""
    base: BaseParameters
    """The base columns, the map to their parameters from the standard ones, and what no motion shows."""
    standard_parameters: Float[AnyArray, " P"]
    """The URDF's values of `base.standard_names`: what it does not have (rotors, constants) is zero."""
    motors: Float[AnyArray, "n n"]
    """Motion of the motors for that of the coordinates: the identity, unless joints are recorded and motors geared."""
    stribeck: tuple[Float[AnyArray, " n"], Float[AnyArray, " n"]]
    """Velocity [rad/s or m/s] and exponent of Stribeck's curve."""
    width: Array | None
    """(n,) velocity around which its sign changes gradually; None where the sign jumps."""
    _min_velocity: Float[AnyArray, " n"]
    """Slower motion says nothing of friction [rad/s or m/s]."""
    robot: str = eqx.field(static=True)
    """Its name in the URDF."""
    joint_names: tuple[str, ...] = eqx.field(static=True)
    """The URDF's names of the joints, in the order of the torques."""
    joint_kinds: tuple[str, ...] = eqx.field(static=True)
    """`revolute` or `prismatic`."""
    link_names: tuple[tuple[str, ...], ...] = eqx.field(static=True)
    """The URDF's links of each body."""
    notes: tuple[str, ...] = eqx.field(static=True)
    """What is strange about the URDF's own values."""
    tip: str | None = eqx.field(static=True)
    stribeck_unknown: bool = eqx.field(static=True)
    """Whether `stribeck` is but a beginning, and is to be found."""
    terms: tuple[Term, ...] = eqx.field(static=True)
    """Of the friction."""
    rotor: bool = eqx.field(static=True)
    offset: bool = eqx.field(static=True)
    _limits: tuple[tuple[float, ...], ...] = eqx.field(static=True)
    _leaders: tuple[int, ...] = eqx.field(static=True)
    _frames: tuple[tuple[str, int, tuple[float, ...], tuple[float, ...], str], ...] = eqx.field(static=True)
    _digest: str = eqx.field(static=True)

    def __init__(
        self,
        robot: Urdf,
        tip: str | None = None,
        base: str | None = None,
        gravity: Sequence[float] | Num[AnyArray, "3"] = GRAVITY,
        locked: Mapping[str, float] | Iterable[str] | None = None,
        *,
        friction: bool | str | Sequence[str] = False,
        rotor: bool = False,
        offset: bool = False,
        gear: PerJoint = 1.0,
        coupling: Num[AnyArray, "n n"] | Sequence[Sequence[float]] | None = None,
        side: str = "motor",
        zero: PerJoint = 0.0,
        sign: PerJoint = 1.0,
        stribeck: tuple[PerJoint, PerJoint] | str = (0.1, 2.0),
        min_velocity: PerJoint = 0.0,
        rounding: float = 1e-5,
        strict: bool = True,
    ):
        held = dict(locked) if isinstance(locked, Mapping) else dict.fromkeys(locked or (), 0.0)
        found = moving_bodies(robot, base, held, strict)
        leaders = [body.joint for body in found.bodies if body.joint.mimic is None]
        self.joint_names = names = tuple(joint.name for joint in leaders)
        self.joint_kinds = tuple("prismatic" if joint.kind == "prismatic" else "revolute" for joint in leaders)
        self.n_joints, self.robot, self.label = len(names), robot.robot, "robot"
        self.link_names = tuple(body.links for body in found.bodies)
        self.notes = _strange(robot, [link for links in self.link_names for link in links])
        self._limits = tuple(tuple(getattr(joint.limits, key) for joint in leaders) for key in JointLimits._fields)
        self._leaders = tuple(k for k, body in enumerate(found.bodies) if body.joint.mimic is None)
        self._frames = tuple(
            (link, at.body, tuple(at.rotation.ravel().tolist()), tuple(at.position.tolist()), at.parent)
            for link, at in found.frames.items()
        )
        self.terms, self.rotor, self.offset = friction_terms(friction), rotor, offset

        ratio = _per_joint("gear", gear, 1.0, names, np.not_equal, "not zero")
        signs = _per_joint("sign", sign, 1.0, names, lambda x, _: np.abs(x) == 1, "1 or -1")
        drive = _drive(coupling, ratio)
        if side not in ("motor", "joint"):
            raise ValueError(f"side is '{side}': positions and torques are those of the 'motor' or of the 'joint'")
        joints = signs[:, None] * (drive if side == "motor" else np.eye(len(names)))
        self.motors = np.eye(len(names)) if side == "motor" else np.linalg.inv(drive)
        zeros = _per_joint("zero", zero, 0.0, names)
        self.stribeck_unknown = isinstance(stribeck, str)
        stribeck = _curve(stribeck, self.terms)
        self.stribeck = (
            _per_joint("velocity of stribeck", stribeck[0], 0.1, names, np.greater, "above zero"),
            _per_joint("exponent of stribeck", stribeck[1], 2.0, names, np.greater, "above zero"),
        )
        self._min_velocity = _per_joint("min_velocity", min_velocity, 0.0, names, np.greater_equal, "at least zero")
        self.width = None

        self.tip = _tip(robot, found, tip)
        self.tree = _tree(robot, found, self.tip, joints, zeros, gravity)
        self.links = np.array([body.inertia for body in found.bodies])
        self._digest = _digest(self.tree, self.motors, *self.stribeck)
        known = _friction_at_motors(leaders, drive)
        own = [known.get(name, np.zeros(len(names))) for name, _, _ in self._groups()]
        self.standard_parameters = np.concatenate([self.links.ravel(), *own])
        self.base = self._base(joints, rounding)
        _, units, columns = zip(*self._standard(), strict=True)
        self.names = self.base.names
        self.units = tuple(units[k] for k in self.base.kept)
        self.columns = tuple(columns[k] for k in self.base.kept)

    @classmethod
    def from_urdf(cls, path: str | Path, **settings: Any) -> Chain:
        """The chain of a URDF file, with the keywords of `Chain`: `tip`, `base`, `gravity`, `locked`, `friction`, ...

        **Raises:** `ValueError` in one line that names cause and remedy; see also `urdf.read_urdf`.
        """
        return cls(read_urdf(path), **settings)

    def __hash__(self) -> int:
        """Compiled programs are kept by their model."""
        return hash((self._digest, self.names))

    @property
    def digest(self) -> str:
        """A few letters that differ between robots whose columns do."""
        return self._digest

    @property
    def regroups(self) -> bool:
        return True

    @property
    def min_velocity(self) -> Any:
        return self._min_velocity

    @property
    def roles(self) -> tuple[Role, ...]:
        kinds = ["link_mass", *["first_moment"] * 3, *["link_inertia"] * 6] * self.tree.n_bodies
        roles = [Role(kind, (k // 10 + 1,)) for k, kind in enumerate(kinds)]
        of_motors = ["rotor_inertia"] * self.rotor + ["friction"] * len(self.terms) + ["offset"] * self.offset
        roles += [Role(kind, (joint + 1,)) for kind in of_motors for joint in range(self.n_joints)]
        return tuple(roles[k] for k in self.base.kept)

    @property
    def standard_units(self) -> tuple[str, ...]:
        """Of `base.standard_names`."""
        return tuple(unit for _, unit, _ in self._standard())

    @property
    def parameters(self) -> Numbers:
        """(p,) base parameters of the URDF: with them the torque is that of `inverse_dynamics` and its friction."""
        return np.asarray(self.base.map, float) @ np.asarray(self.standard_parameters, float)

    @property
    def sums(self) -> dict[str, str]:
        """What each base parameter stands for, such as `link2.mc_x + 0.612 link3.mass`."""
        return self.base.sums

    @property
    def load_in_link(self) -> Numbers:
        """(10, 10) what a body at the tip, by its parameters in the tip's frame, adds to those of the link that bears
        it."""
        frame = np.asarray(self.tree.tip_rotation, float), np.asarray(self.tree.tip_position, float)
        return np.stack([moved(one, *frame) for one in np.eye(10)], axis=1)

    @property
    def limits(self) -> JointLimits:
        """What the URDF allows each joint."""
        return JointLimits(*(np.array(values) for values in self._limits))

    @property
    def recorded_limits(self) -> JointLimits:
        """The same for positions, velocities and torques as they are recorded: at the motors, with their signs and
        zeros.

        **Raises:** `ValueError` where motors share joints: then the limits of one depend on the position of another.
        """
        turns, zero = (np.asarray(x)[list(self._leaders)] for x in (self.tree.coordinates, self.tree.zero))
        each = np.diag(turns)
        if np.count_nonzero(turns) > self.n_joints:
            raise ValueError(f"{self.robot} has motors that share joints: give the limits of the motors' motion")
        at_joints = self.limits
        ends = [(end - zero) / each for end in (at_joints.lower, at_joints.upper)]
        return JointLimits(
            np.minimum(*ends), np.maximum(*ends), at_joints.velocity / abs(each), at_joints.effort * abs(each)
        )

    @property
    def frames(self) -> dict[str, Frame]:
        """Where each of the URDF's links is fixed: to which body (-1 for the base), how turned and where."""
        return {
            link: Frame(body, np.reshape(rotation, (3, 3)), np.array(position), parent)
            for link, body, rotation, position, parent in self._frames
        }

    def smoothed(self, width: Num[ArrayLike, "*n"]) -> Model:
        widths = jnp.broadcast_to(jnp.asarray(width), (self.n_joints,))
        return eqx.tree_at(lambda chain: chain.width, self, widths, is_leaf=lambda x: x is None)

    def with_sign_width(self, width: PerJoint) -> Chain:
        """The same with signs that change gradually around zero, by a hyperbolic tangent of this width; jumps where it
        is zero."""
        given = _per_joint("sign_width", width, 0.0, self.joint_names, np.greater_equal, "zero or more")
        return eqx.tree_at(lambda chain: chain.width, self, jnp.asarray(given), is_leaf=lambda x: x is None)

    def with_stribeck(self, velocity: Num[ArrayLike, "*n"], exponent: Num[ArrayLike, "*n"]) -> Chain:
        """The same with another Stribeck curve, which is known; the regressor is differentiable in both numbers."""
        curve = tuple(jnp.broadcast_to(jnp.asarray(x, float), (self.n_joints,)) for x in (velocity, exponent))
        known = eqx.tree_at(lambda chain: chain.stribeck, self, curve)
        object.__setattr__(known, "stribeck_unknown", False)  # a new object, which nobody else has yet
        return known

    def sign_of(self, speed: Num[AnyArray, "... n"]) -> Array:
        """Sign of the motors' velocities, gradual where the model is smoothed."""
        speed = jnp.asarray(speed)
        return jnp.sign(speed) if self.width is None else _gradual_sign(speed, self.width, jnp)

    def moving(self, dq: Num[ArrayLike, "... n"]) -> Array:
        """(..., n) whether each joint's motor is at least at `min_velocity`, so that its row counts for friction."""
        return self.speed(dq) >= jnp.asarray(self.min_velocity)

    def speed(self, dq: Num[ArrayLike, "*N n"]) -> Float[Array, "*N n"]:
        """Of the motors."""
        motors, dq = jnp.asarray(self.motors), jnp.asarray(dq)
        return jnp.abs(dq @ motors.T if self.n_joints > 1 else dq * motors[0, 0])

    def joint_positions(self, q: Num[ArrayLike, "... n"]) -> Float[Array, "... n_b"]:
        """Positions of all joints that move, as the URDF means them, from the recorded ones."""
        return jnp.asarray(q) @ jnp.asarray(self.tree.coordinates).T + jnp.asarray(self.tree.zero)

    def limited_positions(self, q: Num[ArrayLike, "... n"]) -> Float[Array, "... n"]:
        """Positions of `joint_names` as the URDF counts them, and as its `limits` hold for them."""
        return self.joint_positions(q)[..., list(self._leaders)]

    def inverse_dynamics(
        self, q: Num[ArrayLike, "..."], dq: Num[ArrayLike, "..."], ddq: Num[ArrayLike, "..."]
    ) -> Float[Array, "..."]:
        """Torque [N m or N] of the URDF's rigid bodies, without friction and rotors: (..., n)."""
        if self.n_joints > 1:
            return rigid_body.inverse_dynamics(self.tree, self.links, q, dq, ddq)
        motion = (jnp.asarray(x)[..., None] for x in (q, dq, ddq))
        return rigid_body.inverse_dynamics(self.tree, self.links, *motion)[..., 0]

    def mass_matrix(self, q: Num[ArrayLike, "... n"]) -> Float[Array, "... n n"]:
        """Mass matrix of the URDF's rigid bodies, without rotors."""
        return rigid_body.mass_matrix(self.tree, self.links, q)

    def coriolis_matrix(self, q: Num[ArrayLike, "... n"], dq: Num[ArrayLike, "... n"]) -> Float[Array, "... n n"]:
        """`C` of `M ddq + C dq + g`, of Christoffel's symbols."""
        return rigid_body.coriolis_matrix(self.tree, self.links, q, dq)

    def gravity_torque(self, q: Num[ArrayLike, "... n"]) -> Float[Array, "... n"]:
        """Torque [N m or N] that holds the URDF's rigid bodies still."""
        return rigid_body.gravity_torque(self.tree, self.links, q)

    def forward_kinematics(self, q: Num[ArrayLike, "... n"]) -> tuple[Float[Array, "... 3 3"], Float[Array, "... 3"]]:
        """Rotation and position [m] of the tip in the base's frame.

        **Raises:** `ValueError` for a chain with branches of which no link was named as the tip.
        """
        self._require_tip()
        return rigid_body.forward_kinematics(self.tree, q)

    def jacobian(self, q: Num[ArrayLike, "... n"]) -> Float[Array, "... 6 n"]:
        """Velocity of the tip (first three rows) and its angular velocity for each coordinate, in the base's frame.

        **Raises:** as `forward_kinematics`.
        """
        self._require_tip()
        return rigid_body.jacobian(self.tree, q)

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        return self.regressor(q, dq, ddq)

    def regressor(
        self, q: Num[ArrayLike, "..."], dq: Num[ArrayLike, "..."], ddq: Num[ArrayLike, "..."]
    ) -> Float[Array, "... p"]:
        """The base columns alone; shapes and errors as for every `Model`."""
        return rigid_body.rows_of_model(_lanes, self.n_joints, self, *self._checked(q, dq, ddq))

    def torque(
        self,
        theta: Num[ArrayLike, " p"],
        q: Num[ArrayLike, "..."],
        dq: Num[ArrayLike, "..."],
        ddq: Num[ArrayLike, "..."],
    ) -> Float[Array, "..."]:
        """Torque [N m or N] that base parameters `theta` give: `regressor @ theta`, without its columns."""
        if jnp.shape(theta) != (len(self.names),):
            raise ValueError(f"theta has the shape {jnp.shape(theta)}: give {len(self.names)} base parameters")
        motion = self._checked(q, dq, ddq)
        if self.n_joints > 1:
            return rigid_body.over_samples(_own_torque_lanes, self.n_joints, (self, jnp.asarray(theta)), *motion)
        one = (x[..., None] for x in motion)
        return rigid_body.over_samples(_own_torque_lanes, 1, (self, jnp.asarray(theta)), *one)[..., 0]

    def _require_tip(self) -> None:
        if self.tip is None:
            raise ValueError(f"{self.robot} branches, and no tip was named: set tip to one of its links")

    def _groups(self) -> list[tuple[str, str, str]]:
        """Name, unit and column of the parameters that every joint has one of."""
        rotor = [("rotor_inertia", "inertia", "ddq")] * self.rotor
        offset = [("offset_torque", "offset_torque", "1")] * self.offset
        return [*rotor, *((term.name, term.unit, term.column) for term in self.terms), *offset]

    def _standard(self) -> list[tuple[str, str, str]]:
        """Name, unit and column of every standard parameter: links, then rotors, friction and constants."""
        this = f"of {self.robot} {self._digest}"
        bodies = [(f"link{k + 1}.{name}", unit) for k in range(self.tree.n_bodies) for name, unit in PARAMETERS.items()]
        found = [(name, unit, f"{name} {this}") for name, unit in bodies]
        at_motors = bool((np.asarray(self.motors) != np.eye(self.n_joints)).any())
        for name, unit, column in self._groups():
            for k, kind in enumerate(self.joint_kinds):
                tag = f"joint{k + 1}." if self.n_joints > 1 else ""
                special = (at_motors and column != "1") or column not in SHARED
                text = f"joint{k + 1}.{name} {this}" if special else tag + column
                found.append((f"joint{k + 1}.{name}", parameter_units(kind)[unit], text))
        return found

    def _base(self, joints: Numbers, rounding: float) -> BaseParameters:
        """From random motions, which move the `joints` (n, n) alike whatever their gears."""
        random = np.random.default_rng(0)
        shape = (self.n_joints, max(FEWEST_MOTIONS, ROWS // self.n_joints))
        reach = np.where(np.array(self.joint_kinds) == "revolute", np.pi, 1.0)[:, None]
        fast = random.choice([-1.0, 1.0], shape) * 10 ** random.uniform(-2, 0.5, shape)
        motion = (reach * random.uniform(-1, 1, shape), fast, random.uniform(-10, 10, shape))
        q, dq, ddq = (np.linalg.solve(joints, x) for x in motion)
        bodies = [10 * k + list(PARAMETERS).index(name) for k in range(self.tree.n_bodies) for name in PREFERRED]
        names = [name for name, _, _ in self._standard()]
        rows = []
        # Whatever its velocity, Stribeck's curve is a column of its own: here it is met by half of the motions.
        curve = (np.median(np.abs(self.motors @ dq), axis=1), self.stribeck[1])
        for tree in (self.tree, _tidied(self.tree, rounding)):
            W = _columns(self, tree, curve, range(len(names)), q, dq, ddq, np)
            W = W / np.maximum(np.linalg.norm(W, axis=(0, 2)), np.finfo(float).tiny)[:, None]
            rows.append(W.reshape(len(W), -1).T)
        return find_base(rows[0], names, [*bodies, *range(len(bodies), len(names))], rows[1])


def _strange(robot: Urdf, links: Sequence[str]) -> tuple[str, ...]:
    """That links have an inertia without a mass, which no body has."""
    own = {link: robot.links[link] for link in links}
    found = [link for link, x in own.items() if x is not None and x[0] == 0 and x[4:].any()]
    if not found:
        return ()
    have = "has" if len(found) == 1 else "have"
    return (f"by {robot.source} {listed(found)} {have} an inertia but no mass, as no body has: correct the file",)


def _lanes(chain: Chain, q: Array, dq: Array, ddq: Array) -> Array:
    """(n, p, N) of the base columns."""
    return _columns(chain, chain.tree, chain.stribeck, chain.base.kept, q, dq, ddq, jnp).swapaxes(0, 1)


def _own_torque_lanes(parts: tuple[Chain, Array], q: Array, dq: Array, ddq: Array) -> Array:
    """(n, N) of base parameters."""
    chain, theta = parts
    links = 10 * chain.tree.n_bodies
    standard = jnp.zeros(len(chain.base.standard_names), theta.dtype).at[jnp.array(chain.base.kept)].set(theta)
    torque = rigid_body.torque_lanes((chain.tree, standard[:links].reshape(-1, 10)), q, dq, ddq)
    groups = _joint_columns(chain, chain.stribeck, dq, ddq, jnp)
    for (share, value), own in zip(groups, standard[links:].reshape(-1, chain.n_joints), strict=True):
        torque = torque + share.T @ (own[:, None] * value)
    return torque


def _columns(
    chain: Chain,
    tree: KinematicTree,
    curve: tuple[AnyArray, AnyArray],
    kept: Iterable[int],
    q: AnyArray,
    dq: AnyArray,
    ddq: AnyArray,
    xp: ModuleType,
) -> AnyArray:
    """(p, n, N) of the standard columns that are kept, for motions (n, N) and a Stribeck `curve`."""
    n, rigid = chain.n_joints, rigid_body.regressor_columns(tree, q, dq, ddq, xp)
    groups = _joint_columns(chain, curve, dq, ddq, xp)

    def column(k: int) -> AnyArray:
        if k < 10 * tree.n_bodies:
            return rigid[k % 10][k // 10]
        group, joint = divmod(k - 10 * tree.n_bodies, n)
        share, value = groups[group]
        return share[joint][:, None] * value[joint]

    return xp.stack([column(k) for k in kept])


def _joint_columns(
    chain: Chain, curve: tuple[AnyArray, AnyArray], dq: AnyArray, ddq: AnyArray, xp: ModuleType
) -> list[tuple[AnyArray, AnyArray]]:
    """Of every parameter that each joint has one of: row k is what the torque of motor k does to the coordinates, and
    (n, N) the motors' torques for a parameter of one."""
    speed, change = chain.motors @ dq, chain.motors @ ddq
    sign = xp.sign(speed) if chain.width is None else _gradual_sign(speed, chain.width[:, None], xp)
    at = Speed(speed, sign, (curve[0][:, None], curve[1][:, None]), xp)
    values = [change] * chain.rotor + [term.value(at) for term in chain.terms]
    return [(chain.motors, value) for value in values] + [(xp.eye(chain.n_joints), xp.ones_like(dq))] * chain.offset


def _gradual_sign(speed: AnyArray, width: AnyArray, xp: ModuleType) -> AnyArray:
    """Within the width of zero; it jumps where that is zero."""
    return xp.where(width > 0, xp.tanh(speed / xp.where(width > 0, width, 1)), xp.sign(speed))


def _curve(given: tuple[PerJoint, PerJoint] | str, terms: Sequence[Term]) -> tuple[PerJoint, PerJoint]:
    """Velocity and exponent of Stribeck's curve, or those to begin with where they are to be found."""
    if not isinstance(given, str):
        return given
    if given != "estimate":
        raise ValueError(f"stribeck is '{given}': give velocity and exponent of the curve, or \"estimate\"")
    if not any(term.name == "stribeck_friction" for term in terms):
        raise ValueError('stribeck = "estimate" needs friction that has a curve: add "stribeck" to friction')
    return 0.1, 2.0


def _per_joint(
    keyword: str,
    values: PerJoint,
    default: float,
    names: Sequence[str],
    allowed: Callable[[Numbers, float], Any] | None = None,
    bound: str = "",
) -> Numbers:
    """(n,) finite numbers, for all joints alike, for each, or by name with the default for the others."""
    if isinstance(values, Mapping):
        for name in values:
            require_known(keyword, "a joint", "joint that moves", name, names)
        values = [values.get(name, default) for name in names]
    array = np.asarray(values, float)
    if array.shape not in ((), (len(names),)):
        raise ValueError(
            f"{keyword} has the shape {array.shape}: give one number, one for each of {len(names)} joints, or those of "
            "some joints by name"
        )
    if not np.isfinite(array).all() or (allowed is not None and not np.all(allowed(array, 0.0))):
        raise ValueError(f"{keyword} is {np.array2string(array)}: it must be finite{f' and {bound}' if bound else ''}")
    return np.broadcast_to(array, (len(names),)).copy()


def _drive(coupling: Any, ratio: Numbers) -> Numbers:
    """(n, n) motion of the joints for that of the motors."""
    matrix = np.eye(len(ratio)) if coupling is None else np.asarray(coupling, float)
    if matrix.shape != (len(ratio), len(ratio)) or not np.isfinite(matrix).all():
        raise ValueError(f"coupling has the shape {matrix.shape}: give {len(ratio)} by {len(ratio)} finite numbers")
    if np.linalg.cond(matrix) > 1e9:
        raise ValueError("coupling is singular: every joint needs a motor of its own, or shares of several")
    return matrix / ratio


def _friction_at_motors(joints: Sequence[Joint], drive: Numbers) -> dict[str, Numbers]:
    """What the file gives its joints, as parameters of their motors; nothing where motors share joints."""
    if np.count_nonzero(drive) > len(joints):
        return {}
    viscous = drive.T**2 @ [joint.damping for joint in joints]
    dry = np.abs(drive.T) @ [joint.friction for joint in joints]
    return {"viscous_friction": viscous} | dict.fromkeys(
        ("coulomb_friction", "coulomb_forward", "coulomb_backward"), dry
    )


def _tip(robot: Urdf, found: Bodies, tip: str | None) -> str | None:
    """The link that is meant: the one named, or what the last joint moves if there are no branches."""
    if tip is not None:
        require_known(robot.source, "tip", "link", tip, robot.links)
        if tip not in found.frames:
            raise ValueError(f"{robot.source}: tip '{tip}' is not above the base: choose a link that hangs on it")
        return tip
    serial = all(body.parent == k - 1 for k, body in enumerate(found.bodies))
    return found.bodies[-1].links[0] if serial else None


def _tree(robot: Urdf, found: Bodies, tip: str | None, joints: Numbers, zeros: Numbers, gravity: Any) -> KinematicTree:
    """**Arguments:** `joints` (n, n) and `zeros` (n,): positions of the joints that follow no other, by coordinates."""
    weight = np.asarray(gravity, float)
    if weight.shape != (3,) or not np.isfinite(weight).all():
        raise ValueError(f"gravity is {gravity}: it must be three finite numbers [m/s^2], such as (0, 0, -9.81)")
    by_name = {joint.name: joint for joint in robot.joints}
    leading = [body.joint.name for body in found.bodies if body.joint.mimic is None]
    coordinates, zero = [], []
    for body in found.bodies:
        leader, multiplier, shift = following(robot.source, by_name, body.joint)
        if leader not in leading:
            raise ValueError(
                f"{robot.source}: joint '{body.joint.name}' follows '{leader}', which does not move here: "
                "name it in locked"
            )
        k = leading.index(leader)
        coordinates.append(multiplier * joints[k])
        zero.append(multiplier * zeros[k] + shift)
    end = Frame(-1, np.eye(3), np.zeros(3)) if tip is None else found.frames[tip]
    return KinematicTree(
        rotation=np.array([body.rotation for body in found.bodies]),
        position=np.array([body.position for body in found.bodies]),
        axis=np.array([body.joint.axis for body in found.bodies]),
        coordinates=np.array(coordinates),
        zero=np.array(zero),
        gravity=weight,
        tip_rotation=end.rotation,
        tip_position=end.position,
        parents=tuple(body.parent for body in found.bodies),
        prismatic=tuple(body.joint.kind == "prismatic" for body in found.bodies),
        tip_body=end.body,
    )


def _tidied(tree: KinematicTree, rounding: float) -> KinematicTree:
    """With the geometry that was meant where a file rounds a quarter turn or a zero."""
    zeroed = np.where(np.abs(tree.rotation) < rounding, 0.0, tree.rotation)
    left, _, right = np.linalg.svd(zeroed)
    axis = np.where(np.abs(tree.axis) < rounding, 0.0, tree.axis)
    small = rounding * np.abs(tree.position).max(initial=0.0)
    position = np.where(np.abs(tree.position) < small, 0.0, tree.position)
    tidy = (left @ right, axis / np.linalg.norm(axis, axis=1, keepdims=True), position)
    return eqx.tree_at(lambda tree: (tree.rotation, tree.axis, tree.position), tree, tidy)


def _digest(tree: KinematicTree, *others: Numbers) -> str:
    """A few letters that differ between chains whose columns do."""
    arrays = [*jax.tree.leaves(tree), *others]
    return hashlib.sha256(b"".join(np.ascontiguousarray(x).tobytes() for x in arrays)).hexdigest()[:8]
