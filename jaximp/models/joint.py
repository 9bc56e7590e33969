"""One joint: the robot that drives it and the human in it. Tout et al. 2023, eqs. (6), (7), (18) to (20)."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models.base import Model, Role
from jaximp.models.reflex import ReflexPathway
from jaximp.types import AnyArray

_REVOLUTE = {
    "inertia": "kg m^2",
    "damping": "N m s/rad",
    "stiffness": "N m/rad",
    "offset_torque": "N m",
    "viscous_friction": "N m s/rad",
    "coulomb_friction": "N m",
    "gravity_x": "kg m",
    "gravity_y": "kg m",
}
_PRISMATIC = {
    "inertia": "kg",
    "damping": "N s/m",
    "stiffness": "N/m",
    "offset_torque": "N",
    "viscous_friction": "N s/m",
    "coulomb_friction": "N",
}


def parameter_units(joint: str) -> dict[str, str]:
    """Unit of every parameter that a model of one `revolute` or `prismatic` joint can have."""
    if joint not in ("revolute", "prismatic"):
        raise ValueError(f"joint is '{joint}': it must be 'revolute' or 'prismatic'")
    return _REVOLUTE if joint == "revolute" else _PRISMATIC


class HumanJoint(Model):
    """Inertia, damping, stiffness and the torque at angle zero: eqs. (6), (7) of Tout et al. 2023.

    `torque = inertia * ddq + damping * dq + stiffness * q + offset_torque`, with
    `offset_torque = -stiffness * equilibrium`, which is minus the paper's Gamma_0.

    **Arguments:** `offset` adds the last column (eq. 7). `gear_ratio` N1 other than one says that position and torque
    are those of the motor (eqs. 19, 20); `at_joint` then gives the parameters of the joint itself. `joint` is
    `revolute` or `prismatic`. With a `reflex` its torque is added, the parameters of it stand last, and the joint has a
    memory (`models.ReflexPathway`).
    """

    gear_ratio: float
    offset: bool = eqx.field(static=True)
    reflex: ReflexPathway | None

    def __init__(
        self,
        offset: bool = True,
        gear_ratio: float = 1.0,
        joint: str = "revolute",
        reflex: ReflexPathway | None = None,
    ):
        unit = parameter_units(joint)
        self.gear_ratio = _positive(gear_ratio)
        self.offset = offset
        self.names = ("inertia", "damping", "stiffness") + ("offset_torque",) * offset
        self.units = tuple(unit[name] for name in self.names)
        self.columns = ("ddq", "dq", "q") + ("1",) * offset
        self.label = "human"
        self.n_joints = 1
        self.reflex = reflex
        if reflex is not None:
            self.names += reflex.names
            self.units += (unit["damping"],) * len(reflex.names)
            self.columns += reflex.columns

    @property
    def roles(self) -> tuple[Role, ...]:
        kinds = {"inertia": "inertia", "damping": "damping", "stiffness": "stiffness", "offset_torque": "offset"}
        return tuple(Role(kinds.get(name, "other")) for name in self.names)

    @property
    def memory(self) -> int:
        return 0 if self.reflex is None else self.reflex.memory

    @property
    def sample_rate(self) -> float | None:
        return None if self.reflex is None else self.reflex.sample_rate

    def sampled_at(self, sample_rate: float) -> Model:
        if self.reflex is None:
            return self
        return eqx.tree_at(lambda joint: joint.reflex, self, self.reflex.sampled_at(sample_rate))

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        if self.reflex is not None:
            return self.reflex.row(q, dq, ddq)  # which says why there is none
        return jnp.stack([ddq, dq, q] + [jnp.ones_like(q)] * self.offset)

    def observation_matrix(
        self, q: Num[ArrayLike, "N *n"], dq: Num[ArrayLike, "N *n"], ddq: Num[ArrayLike, "N *n"]
    ) -> Float[Array, "N *n p"]:
        if self.reflex is None:
            return self.regressor(q, dq, ddq)
        intrinsic = HumanJoint(self.offset).regressor(q, dq, ddq)
        return jnp.concatenate([intrinsic, self.reflex.observation_matrix(q, dq, ddq)], axis=-1)

    def at_joint(self, theta: Num[AnyArray, "*M p"]) -> Float[Array, "*M p"]:
        """Parameters on the joint's side of the gear from those on the motor's side.

        With `theta_joint = q/N1` and `torque_joint = N1 * torque`, the inertia, damping and stiffness are N1^2 times
        those at the motor (as the weights of a reflex are) and the offset torque N1 times. (Eqs. 19, 20; the paper
        divides the whole vector by N1^2, yet defines the offset as stiffness * N1 * equilibrium, which divides it by
        N1: the latter is right.)
        """
        n = self.gear_ratio
        lags = 0 if self.reflex is None else len(self.reflex.lags)
        return jnp.asarray(theta) * jnp.array([n**2] * 3 + [n] * self.offset + [n**2] * lags)

    def equilibrium(self, theta: Num[AnyArray, "*M p"]) -> Float[AnyArray, "*M"]:
        """Position [rad or m] at which the elastic torque vanishes, on the side of the gear that `theta` belongs to.

        That of a numpy array is a numpy array.
        """
        theta = theta if isinstance(theta, np.ndarray) else jnp.asarray(theta)
        if not self.offset:
            return 0 * theta[..., 0]
        with np.errstate(divide="ignore", invalid="ignore"):
            return -theta[..., 3] / theta[..., 2]


class RobotJoint(Model):
    """A geared motor with a handle under gravity: eq. (18) of Tout et al. 2023, on the motor's side.

    `torque = gravity_x * g sin(q/N1) + gravity_y * g cos(q/N1) + viscous_friction * dq + coulomb_friction * sign(dq)
    + inertia * ddq + offset_torque`, each term only where it is asked for.

    **Arguments:** `gear_ratio` N1 is the motor's angle for one radian of the handle; `gravity`, `viscous`, `coulomb`,
    `inertia`, `offset` choose the columns; `joint` is `revolute` or `prismatic` (which has no gravity columns); `g` is
    the gravitational acceleration [m/s^2].
    """

    gear_ratio: float
    g: float
    joint: str = eqx.field(static=True)
    width: Array | None
    """Velocity [rad/s or m/s] around which its sign changes gradually; None where the sign jumps."""

    def __init__(
        self,
        gear_ratio: float = 1.0,
        gravity: bool | None = None,
        viscous: bool = True,
        coulomb: bool = True,
        inertia: bool = True,
        offset: bool = False,
        joint: str = "revolute",
        g: float = 9.81,
    ):
        unit = parameter_units(joint)
        gravity = joint == "revolute" if gravity is None else gravity
        if gravity and joint == "prismatic":
            raise ValueError("a prismatic joint has no gravity columns: use offset=True for its constant weight")
        self.gear_ratio, self.g, self.joint = _positive(gear_ratio), g, joint
        ratio = f"{self.gear_ratio:g}"
        chosen = {
            "gravity_x": (gravity, f"{g:g} sin(q/{ratio})"),
            "gravity_y": (gravity, f"{g:g} cos(q/{ratio})"),
            "viscous_friction": (viscous, "dq"),
            "coulomb_friction": (coulomb, "sign(dq)"),
            "inertia": (inertia, "ddq"),
            "offset_torque": (offset, "1"),
        }
        self.names = tuple(name for name, (wanted, _) in chosen.items() if wanted)
        if not self.names:
            raise ValueError("the robot joint has no parameter left: switch at least one column on")
        self.columns = tuple(column for wanted, column in chosen.values() if wanted)
        self.units = tuple(unit[name] for name in self.names)
        self.label = "robot"
        self.n_joints = 1
        self.width = None

    @property
    def roles(self) -> tuple[Role, ...]:
        kinds = {
            "inertia": "inertia",
            "viscous_friction": "friction",
            "coulomb_friction": "friction",
            "offset_torque": "offset",
        }
        return tuple(Role(kinds.get(name, "other")) for name in self.names)

    def smoothed(self, width: Num[ArrayLike, "*n"]) -> Model:
        return eqx.tree_at(lambda robot: robot.width, self, jnp.asarray(width), is_leaf=lambda x: x is None)

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        sine, cosine = sine_and_cosine(q / self.gear_ratio)
        column = {
            "gravity_x": self.g * sine,
            "gravity_y": self.g * cosine,
            "viscous_friction": dq,
            "coulomb_friction": jnp.sign(dq) if self.width is None else jnp.tanh(dq / self.width),
            "inertia": ddq,
            "offset_torque": jnp.ones_like(q),
        }
        return jnp.stack([column[name] for name in self.names])


QUARTER_TURN = (1.57079632673412561417, 6.07710050630396597660e-11, 2.02226624879595063154e-21)
"""A quarter turn in parts of 33 binary digits (the last is what is left), so that their multiples are exact."""
SINE = (
    1.58969099521155010221e-10,
    -2.50507602534068634195e-08,
    2.75573137070700676789e-06,
    -1.98412698298579493134e-04,
    8.33333333332248946124e-03,
    -1.66666666666666324348e-01,
)
"""Coefficients of the C library (fdlibm), `sin(r) = r + r^3 * polynomial(r^2)` within an eighth of a turn."""
COSINE = (
    -1.13596475577881948265e-11,
    2.08757232129817482790e-09,
    -2.75573143513906633035e-07,
    2.48015872894767294178e-05,
    -1.38888888888741095749e-03,
    4.16666666666666019037e-02,
)
"""And `cos(r) = 1 - r^2/2 + r^4 * polynomial(r^2)`."""


@jax.custom_jvp
def sine_and_cosine(x: Num[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Sine and cosine of an angle [rad], to 2e-16 up to a million; on a CPU in a tenth of the time of `jnp`'s.

    XLA has the sines of doubles computed one by one by the C library, but evaluates polynomials eight at a time. In
    windows that are filtered each by itself nearly all of the time went there.
    """
    return _by_polynomials(x) if x.dtype == jnp.float64 else (jnp.sin(x), jnp.cos(x))


@sine_and_cosine.defjvp
def _derivative(at: tuple[Array], direction: tuple[Array]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    sine, cosine = sine_and_cosine(*at)
    return (sine, cosine), (cosine * direction[0], -sine * direction[0])


@jax.jit
def _by_polynomials(x: Array) -> tuple[Array, Array]:
    quarters = jnp.round(x / (np.pi / 2))
    r = x
    for part in QUARTER_TURN:
        r = r - quarters * part
    sine, cosine = jnp.zeros_like(r), jnp.zeros_like(r)
    for of_sine, of_cosine in zip(SINE, COSINE, strict=True):
        sine, cosine = sine * r**2 + of_sine, cosine * r**2 + of_cosine
    sine, cosine = r + r**3 * sine, 1 - r**2 / 2 + r**4 * cosine
    quarter = quarters - 4 * jnp.floor(quarters / 4)
    odd = (quarter == 1) | (quarter == 3)
    sine, cosine = jnp.where(odd, cosine, sine), jnp.where(odd, sine, cosine)
    return jnp.where(quarter >= 2, -sine, sine), jnp.where((quarter == 1) | (quarter == 2), -cosine, cosine)


def _positive(gear_ratio: float) -> float:
    if not (np.isfinite(gear_ratio) and gear_ratio > 0):
        raise ValueError(f"gear_ratio is {gear_ratio}: it must be a positive number, motor angle over joint angle")
    return float(gear_ratio)
