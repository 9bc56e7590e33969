"""What an estimate must keep to be trusted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any


@dataclass(frozen=True)
class TrustLimits:
    """What a window must keep to be trusted.

    **Example:**

    ```pycon
    >>> limits = jaximp.TrustLimits(max_relative_stderr=0.1)
    >>> print(limits.max_relative_stderr, limits.max_residual_ratio)
    0.1 4.0

    ```
    """

    min_vaf: float | None = None
    """Share of the torque's variance that the model must explain. By default 0.75, and any where the model is tested
    for what it lacks: noise lowers the share and leaves estimates right, and a wrong model may explain most of it."""
    max_residual_ratio: float = 4.0
    """Largest residual and largest unexplained share of the torque's variance, as multiples of their lower quartiles
    over the excited windows: where both are above, something happened that the model does not know, such as a parameter
    that changes inside the window."""
    min_dof: float = 3.0
    """Fewest degrees of freedom: with less a standard error is itself a matter of luck."""
    max_negative_inertia: float = 5.0
    """How far below zero an inertia or a friction may come out, in standard errors; beyond, torque's sign or model is
    wrong."""
    max_relative_stderr: float = 0.2
    """Largest standard error, as a share of the parameter or of what would explain the whole torque by itself."""
    min_excitation_ratio: float = 5.0
    """How far each column must rise above what noise in the position alone would build: a ratio r biases the
    estimate by about 1/r^2, four percent at 5."""
    max_unreal: float = 0.05
    """Share by which the squares that a robot's model leaves may grow, if all its links must be real bodies and its
    friction above zero: joints in another order, a wrong sign or the wrong gravity ask for a robot that cannot be."""
    max_at_limit: float = 0.02
    """Share of a window's samples whose torque was cut off at a limit of its sensor or motor; they are left out."""
    min_valid_share: float = 0.5
    """Share of a window's samples that must have been measured and moving."""
    max_asymmetry: float = 0.2
    """Of an arm's stiffness: antisymmetric over symmetric part (Lakatos et al. 2011, eq. 22), if it is beyond error."""
    errors_apart: float = 2.0
    """A window's matrix is not positive definite, or not symmetric, if that is so by so many standard errors; and it is
    surely positive definite (`confidence`) by so many."""
    max_condition: float | None = None
    """Largest condition number (Lakatos et al. 2011, eq. 19); it depends on the units, and the paper knows no limit."""
    joint_name: str | list[str] | None = None
    """Which human joint it is (finger, wrist, elbow, shoulder, ankle, knee, hip; of several joints a list), or `other`
    for what is none: an impedance that it cannot have is not trusted. By default what any human joint can have."""
    parameters: tuple[str, ...] = ()
    """The parameters that matter: only their standard errors and excitation are judged. Empty for all but a constant
    torque."""

    @property
    def one_joint_name(self) -> str | None:
        """`joint_name` of the first joint."""
        return self.joint_name[0] if isinstance(self.joint_name, list) else self.joint_name

    def of_joint(self, j: int, **settings: Any) -> TrustLimits:
        """Of one joint of several."""
        name = self.joint_name[j] if isinstance(self.joint_name, list) else self.joint_name
        return replace(self, joint_name=name, **settings)

    @property
    def usual_vaf(self) -> float:
        """`min_vaf`, or what it is by default."""
        return 0.75 if self.min_vaf is None else self.min_vaf
