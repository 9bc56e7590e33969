"""An arm of two links in a plane: inertia, gravity and friction, and the impedance of its muscles.

Angles: `q1` of the upper arm from the x axis, `q2` of the forearm from the upper arm, both counterclockwise [rad].
Where there is gravity it acts along -y, or along x (`zero = "hanging"`: at zero the arm hangs down).

The rigid body is known by three base inertial parameters. All functions of this file take them as `xi`, in the order of
Lakatos et al. 2011: `xi = (I_1 + m_2 l1^2 + I_2, m_2 c_2 l1, I_2)` [kg m^2]. `inertia.py` has the other order that is
in use, and `BaseInertia`, which has names in place of an order: `BaseInertia(...).lakatos` is an `xi`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from jaximp.models.base import Model, Role
from jaximp.models.joint import parameter_units, sine_and_cosine
from jaximp.types import AnyArray

LONGEST = 10.0
"""No arm is longer [m]; a greater length was surely given in other units."""


class PlanarArm(Model):
    """Rigid body, damping and stiffness of an arm of two links: eqs. (9), (10), (13) of Lakatos et al. 2011.

    `torque = M(q) ddq + C(q, dq) dq + D dq + K (q - equilibrium)`, the torque that an outside force applies to the
    joints, and after it, where asked for, gravity, friction and constants:

    - `inertia_1` to `inertia_3`: the base inertial parameters xi in Lakatos's order, `I_1 + m_2 l1^2 + I_2`,
      `m_2 c_2 l1` and `I_2` [kg m^2];
    - `damping_11`, `_12`, `_21`, `_22` [N m s/rad] and `stiffness_11` to `_22` [N m/rad], row by row;
    - `gravity_1 = m_1 c_1 + m_2 l1` and `gravity_2 = m_2 c_2` [kg m], on `g cos q1` and `g cos(q1 + q2)`, for an arm
      in the vertical plane with `q1` from the horizontal (sines where it is from the vertical, `zero = "hanging"`): the
      second joint bears `gravity_2` alone;
    - `rotor_inertia_2 * ddq_2` on the second joint alone: its motor's rotor, times its gear ratio squared [kg m^2]
      (that of the first joint is a part of `inertia_1`);
    - `viscous_friction_i * dq_i`, `coulomb_friction_i * sign(dq_i)` and `offset_torque_i`, of joint i.

    **Arguments:** `equilibrium` (2,) the angles [rad] at which the elastic torque vanishes; `inertia`, `impedance`,
    `gravity`, `rotor`, `viscous`, `coulomb`, `offset` choose the columns. With gravity, the `length` of the upper arm
    [m] says that `inertia_2 = length * gravity_2` and leaves only the latter. The regressor takes absolute angles.
    Without inertia it is the reduced one of eqs. (23) to (25), for the torque less `rigid_body_torque`; without
    impedance it is a robot's or a limp arm's. `g` is the gravitational acceleration [m/s^2].

    **Raises:** ValueError for impedance without an equilibrium, or with viscous friction, whose columns it has already,
    and for a length without inertia or gravity.
    """

    equilibrium: tuple[float, float] | None
    """Angles [rad] at which the elastic torque vanishes; None without impedance."""
    g: float
    zero: str = eqx.field(static=True)
    length: float | None
    """Length of the upper arm [m], where it ties the inertia to the gravity."""
    width: Array | None
    """(2,) velocity [rad/s] around which its sign changes gradually; None where the sign jumps."""

    def __init__(
        self,
        equilibrium: Sequence[float] | Num[AnyArray, "2"] | None = None,
        inertia: bool = True,
        impedance: bool = True,
        gravity: bool = False,
        viscous: bool = False,
        coulomb: bool = False,
        offset: bool = False,
        rotor: bool = False,
        g: float = 9.81,
        zero: str = "horizontal",
        length: float | None = None,
    ):
        if zero not in ("horizontal", "hanging"):
            raise ValueError(f"zero is '{zero}': at zero the arm is 'horizontal' or 'hanging'")
        if length is not None and not (inertia and gravity and 0 < length < LONGEST):
            raise ValueError(
                f"length is {length}: it must be metres, above zero, and needs inertia and gravity, which it ties"
            )
        if impedance and viscous:
            raise ValueError("damping_11 and damping_22 are viscous friction already: leave out viscous or impedance")
        self.equilibrium = _equilibrium(equilibrium, impedance)
        self.g, self.zero, self.length = g, zero, length
        chosen = (
            _inertia_columns(inertia)
            | (_impedance_columns(self.equilibrium) if self.equilibrium else {})
            | _gravity_columns(gravity, g, zero)
            | ({"rotor_inertia_2": "joint2.ddq"} if rotor else {})
            | _joint_columns("viscous_friction", viscous, "dq")
            | _joint_columns("coulomb_friction", coulomb, "sign(dq)")
            | _joint_columns("offset_torque", offset, "1")
        )
        if length is not None:
            chosen["gravity_2"] += f" + {length:g} {chosen.pop('inertia_2')}"
        if not chosen:
            raise ValueError("the arm has no parameter left: switch at least one column on")
        self.names, self.columns = tuple(chosen), tuple(chosen.values())
        unit = parameter_units("revolute") | {"gravity": "kg m", "rotor_inertia": "kg m^2"}
        self.units = tuple(unit[name.rsplit("_", 1)[0]] for name in self.names)
        self.label = "arm"
        self.n_joints = 2
        self.width = None

    @property
    def roles(self) -> tuple[Role, ...]:
        return tuple(_role(name) for name in self.names)

    def at(self, equilibrium: Num[AnyArray, "2"]) -> PlanarArm:
        """The same arm with the elastic torque vanishing elsewhere [rad]; under `vmap`, a posture for every trial. (The
        text of the columns stays.)"""
        return eqx.tree_at(lambda arm: arm.equilibrium, self, (equilibrium[0], equilibrium[1]))

    def smoothed(self, width: Num[ArrayLike, "*n"]) -> Model:
        """The arm with signs of the velocities that change gradually, within `width` [rad/s] of zero, one per joint."""
        widths = jnp.broadcast_to(jnp.asarray(width), (2,))
        return eqx.tree_at(lambda arm: arm.width, self, widths, is_leaf=lambda x: x is None)

    def row(self, q: Array, dq: Array, ddq: Array) -> Array:
        sine, cosine = sine_and_cosine(q[1])
        weight = 0 if self.zero == "hanging" else 1
        of_first, of_both = (self.g * sine_and_cosine(angle)[weight] for angle in (q[0], q[0] + q[1]))
        sign = jnp.sign(dq) if self.width is None else jnp.tanh(dq / self.width)
        zero = jnp.zeros_like(cosine)
        # Every column that an arm can have; the compiler drops those that are not stacked.
        column = {
            "inertia_1": (ddq[0], zero),
            "inertia_2": (
                (2 * ddq[0] + ddq[1]) * cosine - (2 * dq[0] * dq[1] + dq[1] ** 2) * sine,
                ddq[0] * cosine + dq[0] ** 2 * sine,
            ),
            "inertia_3": (ddq[1], ddq[0] + ddq[1]),
            "rotor_inertia_2": (zero, ddq[1]),
            "gravity_1": (of_first, zero),
            "gravity_2": (of_both, of_both),
        }
        for name, each in {"viscous_friction": dq, "coulomb_friction": sign, "offset_torque": jnp.ones_like(q)}.items():
            column |= {f"{name}_1": (each[0], zero), f"{name}_2": (zero, each[1])}
        if self.equilibrium is not None:
            away = jnp.stack([q[i] - rest for i, rest in enumerate(self.equilibrium)])
            for name, each in {"damping": dq, "stiffness": away}.items():
                column |= {f"{name}_1{j + 1}": (each[j], zero) for j in (0, 1)}
                column |= {f"{name}_2{j + 1}": (zero, each[j]) for j in (0, 1)}
        if self.length is not None:
            first, second = column["inertia_2"]
            column["gravity_2"] = (of_both + self.length * first, of_both + self.length * second)
        return jnp.stack([jnp.stack(column[name]) for name in self.names], axis=-1)


@dataclass(frozen=True)
class ArmLinks:
    """Upper arm and forearm as rigid bodies; every field has the upper arm first.

    **Raises:** ValueError for a length or a mass that is not positive, or a negative moment of inertia.
    """

    lengths: tuple[float, float]
    """Lengths of the links [m]: from shoulder to elbow, and from elbow to hand."""
    masses: tuple[float, float]
    """Masses of the links [kg]."""
    centres: tuple[float, float]
    """Distance of each link's centre of mass from its own joint, towards the next joint [m]."""
    inertias: tuple[float, float]
    """Moment of inertia of each link about its centre of mass [kg m^2]."""

    def __post_init__(self) -> None:
        two_numbers("lengths", self.lengths, lowest=0.0, above=True)
        two_numbers("masses", self.masses, lowest=0.0, above=True)
        two_numbers("centres", self.centres)
        two_numbers("inertias", self.inertias, lowest=0.0)

    def base_parameters(self) -> Float[Array, "3"]:
        """Base inertial parameters xi [kg m^2] in the convention of Lakatos et al. 2011."""
        first, second = (
            inertia + mass * centre**2
            for inertia, mass, centre in zip(self.inertias, self.masses, self.centres, strict=True)
        )
        l1, m2 = self.lengths[0], self.masses[1]
        return jnp.array([first + m2 * l1**2 + second, m2 * self.centres[1] * l1, second])

    def gravity_parameters(self) -> Float[Array, "2"]:
        """`gravity_1 = m_1 c_1 + m_2 l1` and `gravity_2 = m_2 c_2` [kg m]."""
        (m1, m2), (c1, c2) = self.masses, self.centres
        return jnp.array([m1 * c1 + m2 * self.lengths[0], m2 * c2])


def mass_matrix(q: Num[ArrayLike, "... 2"], xi: Num[AnyArray, "3"]) -> Float[Array, "... 2 2"]:
    """Mass matrix M [kg m^2] at the angles `q` [rad], from base parameters `xi` in Lakatos's order: eq. (13) there."""
    _, cosine = sine_and_cosine(jnp.asarray(q)[..., 1])
    coupled = xi[2] + xi[1] * cosine
    return _matrix(xi[0] + 2 * xi[1] * cosine, coupled, coupled, jnp.full_like(coupled, xi[2]))


def coriolis_matrix(
    q: Num[ArrayLike, "... 2"], dq: Num[ArrayLike, "... 2"], xi: Num[AnyArray, "3"]
) -> Float[Array, "... 2 2"]:
    """Coriolis and centrifugal matrix C [N m s/rad] with `dM/dt - 2 C` skew symmetric, from base parameters `xi` in
    Lakatos's order [kg m^2]: eq. (1) there."""
    dq = jnp.asarray(dq)
    sine, _ = sine_and_cosine(jnp.asarray(q)[..., 1])
    h = xi[1] * sine
    return _matrix(-h * dq[..., 1], -h * (dq[..., 0] + dq[..., 1]), h * dq[..., 0], jnp.zeros_like(h))


def gravity_torque(q: Num[ArrayLike, "... 2"], gravity: Num[AnyArray, "2"], g: float = 9.81) -> Float[Array, "... 2"]:
    """Torque [N m] that holds the arm against gravity, from `gravity_1` and `gravity_2` [kg m] and `g` [m/s^2]."""
    q = jnp.asarray(q)
    first = gravity[0] * g * sine_and_cosine(q[..., 0])[1]
    second = gravity[1] * g * sine_and_cosine(q[..., 0] + q[..., 1])[1]
    return jnp.stack([first + second, second], axis=-1)


def rigid_body_torque(
    q: Num[ArrayLike, "... 2"],
    dq: Num[ArrayLike, "... 2"],
    ddq: Num[ArrayLike, "... 2"],
    xi: Num[AnyArray, "3"],
    gravity: Num[AnyArray, "2"] | None = None,
    g: float = 9.81,
) -> Float[Array, "... 2"]:
    """Inverse dynamics `M ddq + C dq` [N m], and the gravity torque where `gravity` [kg m] is given.

    Where the inertia is known, the torque less this one is what damping and stiffness explain, for
    `PlanarArm(equilibrium, inertia=False)`.

    **Arguments:** angles `q` [rad], velocities `dq`, accelerations `ddq`; `xi` base parameters in Lakatos's order
    [kg m^2], as `PlanarArm` estimates them, and `gravity` [kg m] of the arm; `g` [m/s^2].

    **Source:** Lakatos et al. 2011, eqs. (1) and (24).
    """
    dq, ddq = jnp.asarray(dq), jnp.asarray(ddq)
    # Products of 2 by 2 written out: as matrix products, accelerators would round them to ten bits in single precision.
    inertial = mass_matrix(q, xi) * ddq[..., None, :] + coriolis_matrix(q, dq, xi) * dq[..., None, :]
    torque = inertial.sum(axis=-1)
    return torque if gravity is None else torque + gravity_torque(q, gravity, g)


def two_numbers(
    name: str, values: Sequence[float] | AnyArray, lowest: float = -np.inf, above: bool = False
) -> tuple[float, float]:
    """`values` as two finite numbers of at least `lowest`, or `above` it; an error calls them by their `name`."""
    array = np.asarray(values, float)
    allowed = array > lowest if above else array >= lowest
    if array.shape != (2,) or not (np.isfinite(array) & allowed).all():
        bound = "" if lowest == -np.inf else f" {'above' if above else 'of at least'} {lowest:g}"
        raise ValueError(f"{name} is {np.array2string(array)}: it must be two finite numbers{bound}, one for each link")
    return float(array[0]), float(array[1])


def _equilibrium(equilibrium: Sequence[float] | AnyArray | None, impedance: bool) -> tuple[float, float] | None:
    if not impedance:
        if equilibrium is not None:
            raise ValueError("only the stiffness has an equilibrium: leave it out, or impedance=True")
        return None
    if equilibrium is None:
        raise ValueError(
            "impedance needs the angles at which the elastic torque vanishes: pass equilibrium=(q1, q2) [rad], or "
            "impedance=False for the dynamics alone"
        )
    angles = two_numbers("equilibrium", equilibrium)
    if max(abs(angle) for angle in angles) > 2 * np.pi:
        raise ValueError(f"equilibrium is {angles}: these are radians, and more than a turn; were degrees meant?")
    return angles


def _role(name: str) -> Role:
    """Of an arm's parameter, whose name ends in its indices."""
    thing, _, index = name.rpartition("_")
    kinds = {
        "inertia": "base_inertia",
        "damping": "damping",
        "stiffness": "stiffness",
        "viscous_friction": "friction",
        "coulomb_friction": "friction",
        "offset_torque": "offset",
    }
    return Role(kinds.get(thing, "other"), tuple(map(int, index)))


# What the columns are made of, by parameter. A column that only joint i feels is called as in `Joints`, so that those
# a robot shares with the arm can be merged.


def _inertia_columns(wanted: bool) -> dict[str, str]:
    if not wanted:
        return {}
    coupling = "(2 ddq1 + ddq2) cos q2 - (2 dq1 dq2 + dq2^2) sin q2; ddq1 cos q2 + dq1^2 sin q2"
    return {"inertia_1": "joint1.ddq", "inertia_2": f"[{coupling}]", "inertia_3": "[ddq2; ddq1 + ddq2]"}


def _impedance_columns(equilibrium: tuple[float, float]) -> dict[str, str]:
    away = ["" if rest == 0 else f"{-rest:+}" for rest in equilibrium]
    return {
        f"{name}_{i}{j}": f"joint{i}.{motion}{'' if i == j else j}{away[j - 1] * (motion == 'q')}"
        for name, motion in (("damping", "dq"), ("stiffness", "q"))
        for i in (1, 2)
        for j in (1, 2)
    }


def _gravity_columns(wanted: bool, g: float, zero: str) -> dict[str, str]:
    function = "sin" if zero == "hanging" else "cos"
    both = f"{g:g} {function}(q1 + q2)"
    return {"gravity_1": f"joint1.{g:g} {function}(q/1)", "gravity_2": f"[{both}; {both}]"} if wanted else {}


def _joint_columns(name: str, wanted: bool, column: str) -> dict[str, str]:
    return {f"{name}_{i}": f"joint{i}.{column}" for i in (1, 2) if wanted}


def _matrix(m11: Array, m12: Array, m21: Array, m22: Array) -> Array:
    return jnp.stack([jnp.stack([m11, m12], axis=-1), jnp.stack([m21, m22], axis=-1)], axis=-2)
