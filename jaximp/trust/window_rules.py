"""Which windows to believe: what is measured of them, and the table of rules.

The condition number alone cannot tell: on a still arm, noise builds a well conditioned regressor.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from jaximp.least_squares.window import Fit, SlidingFit
from jaximp.models.base import Model, Role
from jaximp.trust import plausibility
from jaximp.trust.criteria import USUAL, MatrixCriteria, body_margin, matrix_criteria
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import FAKE, NO_DATA, POOR, WEAK, Rule, Verdicts, judge_all
from jaximp.types import Numbers, nearest

POSITIVE_INERTIA = "an inertia above zero"
"""The rule that a wrong sign of the torque breaks."""
PLAUSIBLE = "an impedance that the joint can have"
"""The rule that wrong units break."""
NOTHING_MISSING = "a model that lacks nothing"
"""The rule that a test of the model breaks, for all windows of a record."""
TOGETHER = 3.0
"""Standard errors by which all windows together may find a negative inertia."""
FEWEST_TOGETHER = 3
"""Windows that are judged together."""
OF_LINKS = ("link_mass", "first_moment", "link_inertia")
MASSES = (Role("inertia"), Role("base_inertia", (1,)), Role("base_inertia", (3,)))
"""What cannot be below zero."""


@dataclass(frozen=True)
class Windows:
    """What is measured of M windows and their estimates. Numbers of all windows stand in arrays (M,); of one window,
    which is what reasons are made of, they are scalars."""

    parameters: int
    """How many there are."""
    full: int
    """Torque samples in a complete window."""
    samples: Any
    """That counted."""
    determined: Any
    """Whether all parameters are finite."""
    above_noise: Any
    """How far the least excited column rises above what position noise alone would build."""
    least_excited: Any
    """The parameter of that column."""
    dof: Any
    relative_stderr: Any
    """The largest standard error, as a share of the parameter or of what would explain the whole torque by itself."""
    loosest: Any
    """The parameter that has it."""
    cond: Any
    threshold: float
    """Of eq. (16) on the condition number; infinite where it does not apply."""
    vaf: Any
    residual: Any
    """[N m]"""
    usual_residual: float
    """Lower quartile over the windows that are excited; infinite until these are known."""
    usual_unexplained: float
    """The same of `1 - vaf`."""
    negative_inertia: Any
    """How far the inertia is below zero, in standard errors; minus infinity without one."""
    negative_friction: Any
    """The same of the friction that is farthest below."""
    driving: Any
    """Which friction that is."""
    body_margin: Any
    """How far inside of what a rigid body can have an arm's inertia lies, in standard errors."""
    stiffness: MatrixCriteria | None
    """Of an arm."""
    damping: MatrixCriteria | None
    worse_than_nothing: bool = False
    """Whether most windows predict the torque of the next one worse than a constant would."""
    mass_below_zero: float = -np.inf
    """How far the mean inertia of windows side by side is below zero, in standard errors."""
    at_limit: Any = 0.0
    """The share of a window's samples whose torque was cut off at a limit."""
    impedance: Any = None
    """(M, 3) inertia, damping and stiffness at a human joint; None of anything else."""
    outside: Any = 1.0
    """(M, 3) by what factor these lie outside of what the joint can have, see `plausibility.times_outside`."""
    of_robot: bool = False
    """Whether the parameters are those of the links of a robot from a URDF."""
    unreal: float = 0.0
    """By what share the squares grow that its model leaves, if it must be a robot that can be; 0 within the errors."""
    unforeseen: float = 0.0
    """The share of the squared torque of a held-out recording that a robot's model leaves."""
    opposed: str = ""
    """Which joint of a robot carries its weight the other way round than by the URDF's own masses."""
    out_of_reach: str = ""
    """Which joint of a robot was recorded where the URDF says that it cannot be."""
    tested: bool = False
    """Whether the model of the whole record was tested for what it lacks."""
    missing: str = ""
    """What the model of the whole record lacks, and what that does to the parameters; empty where nothing is known."""
    remedy: str = ""
    """Against that."""

    def one(self, k: int) -> Windows:
        """What is measured of one window."""
        return self._map(lambda x: x[k])

    def some(self, which: NDArray[np.int64]) -> Windows:
        """What is measured of some windows."""
        return self._map(lambda x: x[which])

    def _map(self, pick: Callable[[Any], Any]) -> Windows:
        def picked(value: Any) -> Any:
            if isinstance(value, MatrixCriteria):
                return MatrixCriteria(*(np.atleast_1d(pick(getattr(value, field.name))) for field in fields(value)))
            return pick(value) if isinstance(value, np.ndarray) else value

        return type(self)(**{field.name: picked(getattr(self, field.name)) for field in fields(self)})


Measured = TypeVar("Measured", bound=Windows)


def measure_windows(
    fit: Fit,
    names: Sequence[str],
    roles: Sequence[Role],
    window_samples: int,
    parameter_scale: NDArray[np.float64],
    column_noise: NDArray[np.float64],
    threshold: float | None = None,
    limits: TrustLimits = USUAL,
) -> Windows:
    """What the rules look at.

    **Arguments:** `names` and `roles` (p) of the parameters; `window_samples` torque samples in a full window;
    `parameter_scale` (p,) the size of each parameter that would explain the whole recording's torque by itself;
    `column_noise` (p,) root mean square of each column that noise in the position alone gives; `threshold` of eq. (16).

    **Raises:** `ValueError` for `limits.parameters` that do not exist.
    """
    # One row per parameter: what is worked out over the parameters then runs along the windows.
    theta, stderr, excitation = (np.ascontiguousarray(np.asarray(x).T) for x in (fit.theta, fit.stderr, fit.excitation))
    samples, cond, vaf, residual, dof = (
        np.asarray(x) for x in (fit.samples, fit.cond, fit.vaf, fit.residual_rms, fit.dof)
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        error = stderr / np.maximum(np.abs(theta), parameter_scale[:, None])
        built_by_noise = np.sqrt(samples) * column_noise[:, None]
        ratio = np.where(built_by_noise > 0, excitation / built_by_noise, np.inf)
        below_zero = -theta / stderr
    judged = _judged(names, roles, limits.parameters)[:, None]
    error, ratio = np.where(judged, error, 0.0), np.where(judged, ratio, np.inf)
    mass = np.array([role in MASSES for role in roles])
    friction = np.array([role.kind == "friction" for role in roles])
    negative_friction = np.where(friction[:, None], below_zero, -np.inf)
    named, called = np.asarray(names), [_element(role) for role in roles]
    stiffness, damping = (matrix_criteria(called, which, fit.theta, fit.stderr) for which in ("stiffness", "damping"))
    return Windows(
        parameters=len(names),
        full=window_samples,
        samples=samples,
        determined=np.isfinite(theta).all(axis=0),
        above_noise=ratio.min(axis=0),
        least_excited=named[ratio.argmin(axis=0)],
        dof=dof,
        relative_stderr=error.max(axis=0),
        loosest=named[error.argmax(axis=0)],
        cond=cond,
        threshold=np.inf if threshold is None else threshold,
        vaf=vaf,
        residual=residual,
        usual_residual=np.inf,
        usual_unexplained=np.inf,
        negative_inertia=np.where(mass[:, None], below_zero, -np.inf).max(axis=0),
        negative_friction=negative_friction.max(axis=0),
        driving=named[negative_friction.argmax(axis=0)],
        body_margin=body_margin(called, fit.theta, fit.stderr),
        stiffness=stiffness,
        damping=damping,
    )


def judge_windows(windows: Windows, limits: TrustLimits = USUAL) -> Verdicts:
    """The verdict on every window: that of the first of `RULES` that it breaks."""
    return judge_all(RULES, with_usual(windows, limits), limits)


def with_usual(windows: Measured, limits: TrustLimits) -> Measured:
    """With the residuals that are usual where the motion determines the parameters."""
    excited = ~np.any([rule.broken(windows, limits) for rule in EXCITATION], axis=0)
    return replace(
        windows,
        usual_residual=_lower_quartile(windows.residual[excited]),
        usual_unexplained=_lower_quartile(1 - windows.vaf[excited]),
    )


def judge_together(
    windows: Windows, fit: SlidingFit, roles: Sequence[Role], held_out: Numbers, apart: int, limits: TrustLimits = USUAL
) -> Windows:
    """With what only many windows can tell, of those whose motion says something.

    **Arguments:** `held_out` (M,) how each window predicts the next; windows `apart` of each other share no rows.
    """
    excited = judge_all(MOTION, windows, limits).trusted
    known = held_out[excited & np.isfinite(held_out)]
    worse = len(known) >= FEWEST_TOGETHER and float(np.median(known)) < 0
    below = -np.inf
    for k, role in enumerate(roles):
        theta, stderr = (np.asarray(x)[::apart, k] for x in (fit.theta, fit.stderr))
        counts = excited[::apart] & np.isfinite(theta) & (stderr > 0)
        # In most of them: a single window whose model is wrong must not speak for all.
        if role in MASSES and counts.sum() >= FEWEST_TOGETHER and np.mean(theta[counts] < 0) > 0.5:
            weight = 1 / stderr[counts] ** 2
            below = max(below, float(-(weight * theta[counts]).sum() / np.sqrt(weight.sum())))
    return replace(windows, worse_than_nothing=worse, mass_below_zero=below)


def excited_windows(windows: Windows, limits: TrustLimits = USUAL) -> NDArray[np.bool_]:
    """(M,) whose motion determines the parameters; the torque may still contradict the model."""
    return judge_all(EXCITATION, windows, limits).trusted


def judged_names(model: Model, limits: TrustLimits = USUAL) -> list[str]:
    """The parameters that the verdict looks at."""
    judged = _judged(model.names, model.roles, limits.parameters)
    return [name for name, looked_at in zip(model.names, judged, strict=True) if looked_at]


def _judged(names: Sequence[str], roles: Sequence[Role], chosen: Sequence[str]) -> NDArray[np.bool_]:
    """Which parameters the verdict looks at: the chosen, or all but a constant torque, which slow noise hides first.

    Of a robot from a URDF none, unless some are chosen: hardly any motion determines all of its parameters, and each
    has a verdict of its own.
    """
    for name in chosen:
        if name not in names:
            raise ValueError(f"trust.parameters has an unknown parameter '{name}': {nearest(name, list(names))}")
    all_but = {role.kind for role in roles} if is_chain(roles) else {"offset"}
    return np.array(
        [name in chosen if chosen else role.kind not in all_but for name, role in zip(names, roles, strict=True)]
    )


def is_chain(roles: Sequence[Role]) -> bool:
    """Whether parameters are those of the links of a robot from a URDF."""
    return any(role.kind in OF_LINKS for role in roles)


def _element(role: Role) -> str:
    """As the criteria call it: `stiffness_12` for the stiffness between joints 1 and 2."""
    kind = "inertia" if role.kind == "base_inertia" else role.kind
    return f"{kind}_{''.join(map(str, role.element))}" if role.element else kind


def _lower_quartile(values: Numbers) -> float:
    """Of the values above zero: a window without any torque has no residual to compare with."""
    known = values[np.isfinite(values) & (values > 0)]
    return float(np.quantile(known, 0.25)) if len(known) else np.inf


def _indefinite(which: str) -> Rule[Windows]:
    """An arm's stiffness and damping store and take energy."""

    def found(w: Windows) -> MatrixCriteria | None:
        return w.stiffness if which == "stiffness" else w.damping

    def broken(w: Windows, limits: TrustLimits) -> Any:
        matrix = found(w)
        return np.zeros(len(w.cond), bool) if matrix is None else matrix.surely_indefinite(limits.errors_apart)

    def reason(w: Windows, limits: TrustLimits) -> str:
        matrix = found(w)
        assert matrix is not None
        return f"the {which} is not positive definite: its smallest eigenvalue is {matrix.eigenvalues[0]:.3g}"

    return Rule(f"a {which} that is positive definite", POOR, broken, reason)


def _implausible(w: Windows, limits: TrustLimits) -> str:
    k = int(plausibility.worst(w.outside))
    times, ranges, value = w.outside[k], plausibility.ranges_of(limits.one_joint_name), w.impedance[k]
    assert ranges is not None
    whose = "any human joint" if limits.one_joint_name is None else f"the {limits.one_joint_name}"
    low, high = ranges.bounds[k]
    size = f"{times:.3g} times too large" if times > 1 else f"{1 / times:.3g} times too small"
    if value <= 0:
        size = "not above zero, and too small"
    return (
        f"{plausibility.PARAMETERS[k]} is {value:.3g} {plausibility.UNITS[k]}, {size} for {whose} ({low:g} to {high:g})"
    )


def _question(w: Windows, limits: TrustLimits) -> str:
    ranges = plausibility.ranges_of(limits.one_joint_name)
    assert ranges is not None
    return plausibility.question(w.impedance, ranges)


def _least_vaf(w: Windows, limits: TrustLimits) -> float:
    """Tests of the model say more than the share of the variance, which noise lowers too; of a robot, whose model may
    be wrong in all its joints at once, they do not."""
    tells_more = w.tested and not w.of_robot
    return -np.inf if tells_more and limits.min_vaf is None else limits.usual_vaf


def _asymmetric(w: Windows, limits: TrustLimits) -> Any:
    return np.zeros(len(w.cond), bool) if w.stiffness is None else w.stiffness.surely_asymmetric(limits)


def _asymmetry(w: Windows, limits: TrustLimits) -> str:
    assert w.stiffness is not None
    return f"the stiffness is not symmetric: its antisymmetric part is {w.stiffness.asymmetry[0]:.0%}"


MOTION: tuple[Rule[Windows], ...] = (
    Rule(
        "a torque inside its limits",
        NO_DATA,
        # What is left of a torque that was cut off is no fair sample of it.
        lambda w, limits: np.broadcast_to(w.at_limit > limits.max_at_limit, np.shape(w.samples)),
        lambda w, limits: f"the torque is cut off, or stays at one value, in {w.at_limit:.1%} of the samples",
        lambda w, limits: "use a larger range of the sensor or the motor, or move less",
    ),
    Rule(
        "enough samples",
        NO_DATA,
        lambda w, limits: (w.samples < limits.min_valid_share * w.full) | (w.samples < w.parameters),
        lambda w, limits: f"{w.samples} of {w.full} samples can be used",
    ),
    Rule(
        "columns that differ",
        WEAK,
        lambda w, limits: ~w.determined,
        lambda w, limits: "columns are zero or collinear: the parameters cannot be told apart",
    ),
    Rule(
        "columns above the position's noise",
        WEAK,
        lambda w, limits: w.above_noise < limits.min_excitation_ratio,
        lambda w, limits: (
            f"{w.least_excited}: its column is {w.above_noise:.2g} times what position noise alone builds"
        ),
        lambda w, limits: "move more, or filter more (filter.position_cutoff)",
    ),
)
"""There are samples, and the joint moves."""
EXCITATION: tuple[Rule[Windows], ...] = (
    *MOTION,
    Rule(
        "enough degrees of freedom",
        WEAK,
        lambda w, limits: w.dof < limits.min_dof,
        lambda w, limits: f"{w.dof:.2g} degrees of freedom are too few to know its own errors",
    ),
    Rule(
        "small standard errors",
        WEAK,
        lambda w, limits: ~(w.relative_stderr <= limits.max_relative_stderr),
        lambda w, limits: f"{w.loosest}: its standard error is {w.relative_stderr:.0%} of its size",
    ),
    Rule(
        "a small condition number",
        WEAK,
        lambda w, limits: w.cond > (np.inf if limits.max_condition is None else limits.max_condition),
        lambda w, limits: f"the condition number {w.cond:.3g} is above {limits.max_condition:.3g}",
    ),
)
"""What the motion must be for an estimate to say something."""

RULES: tuple[Rule[Windows], ...] = (
    *EXCITATION,
    Rule(
        "no fake change, eqs. (16), (17) of Tout et al. 2023",
        FAKE,
        lambda w, limits: np.isfinite(w.threshold) & ~(w.cond < w.threshold),
        lambda w, limits: f"the condition number {w.cond:.3g} is not below the threshold {w.threshold:.3g}",
    ),
    Rule(
        "variance accounted for",
        POOR,
        lambda w, limits: ~(w.vaf >= _least_vaf(w, limits)),
        lambda w, limits: f"the model explains {w.vaf:.0%} of the torque's variance",
    ),
    Rule(
        "a residual as in other windows",
        POOR,
        # Both: a larger motion has a larger residual, a smaller one explains a smaller share, and neither is wrong.
        lambda w, limits: (
            (w.residual > limits.max_residual_ratio * w.usual_residual)
            & (1 - w.vaf > limits.max_residual_ratio * w.usual_unexplained)
        ),
        lambda w, limits: f"the residual is {w.residual / w.usual_residual:.2g} times that of other windows",
        lambda w, limits: "did the joint change here?",
    ),
    Rule(
        "positions that the robot can reach",
        POOR,
        lambda w, limits: np.full(np.shape(w.vaf), bool(w.out_of_reach)),
        lambda w, limits: w.out_of_reach,
        lambda w, limits: "is the unit of the position the right one, and the order of the joints that of the URDF?",
    ),
    Rule(
        "weight that is carried as the URDF's masses ask for",
        POOR,
        lambda w, limits: np.full(np.shape(w.vaf), bool(w.opposed)),
        lambda w, limits: w.opposed,
        lambda w, limits: "are gravity's direction and the signs of torque and position right?",
    ),
    Rule(
        "a robot that can be",
        POOR,
        lambda w, limits: np.full(np.shape(w.vaf), w.unreal > limits.max_unreal),
        lambda w, limits: (
            "these are not the parameters of a robot: if its links are to be real bodies, and its friction above "
            f"zero, the squares that the model leaves are {w.unreal:.0%} more"
        ),
        lambda w, limits: (
            "are order, signs and units of the joints those of the URDF, for positions and for torques, is gravity's "
            "direction right, and does the model have the friction that the robot has?"
        ),
    ),
    Rule(
        "a held-out recording that is predicted",
        POOR,
        lambda w, limits: np.full(np.shape(w.vaf), not 1 - w.unforeseen >= limits.usual_vaf),
        lambda w, limits: f"the model leaves {w.unforeseen:.0%} of the squared torque of the held-out recording",
        lambda w, limits: "were both recorded alike, and is the model the right one?",
    ),
    Rule(
        POSITIVE_INERTIA,
        POOR,
        lambda w, limits: w.negative_inertia > limits.max_negative_inertia,
        lambda w, limits: f"the inertia is negative, as no mass can be, by {w.negative_inertia:.2g} standard errors",
        lambda w, limits: "does the torque need sign = -1?",
    ),
    Rule(
        PLAUSIBLE,
        POOR,
        lambda w, limits: np.broadcast_to((np.atleast_1d(w.outside) != 1).any(axis=-1), np.shape(w.samples)),
        _implausible,
        _question,
    ),
    Rule(
        "friction above zero",
        POOR,
        lambda w, limits: w.negative_friction > limits.max_negative_inertia,
        lambda w, limits: f"{w.driving} is negative, by {w.negative_friction:.2g} standard errors",
    ),
    Rule(
        "an inertia that a body can have",
        POOR,
        lambda w, limits: w.body_margin < -limits.errors_apart,
        lambda w, limits: "no rigid body has this inertia",
        lambda w, limits: "are the joints swapped, or the angles in other units?",
    ),
    _indefinite("damping"),
    _indefinite("stiffness"),
    Rule("a stiffness that is symmetric", POOR, _asymmetric, _asymmetry),
    Rule(
        "an inertia above zero in windows together",
        POOR,
        lambda w, limits: np.full(np.shape(w.vaf), w.mass_below_zero > TOGETHER),
        lambda w, limits: (
            f"the inertia of all windows together is negative, as no mass can be, by {w.mass_below_zero:.2g} standard "
            "errors"
        ),
        lambda w, limits: "does the torque need sign = -1, or does the model lack something?",
    ),
    Rule(
        "predictions better than nothing",
        POOR,
        lambda w, limits: np.full(np.shape(w.vaf), w.worse_than_nothing),
        lambda w, limits: "most windows predict the torque of the next one worse than a constant does",
        lambda w, limits: "is the torque that of this joint, and the model the right one?",
    ),
    Rule(
        NOTHING_MISSING,
        POOR,
        lambda w, limits: np.full(np.shape(w.vaf), bool(w.missing)),
        lambda w, limits: w.missing,
        lambda w, limits: w.remedy,
    ),
)
"""From what leaves nothing to judge to what makes an estimate doubtful: the first that is broken gives the verdict. The
last spares some parameters. What a rule looks at is a field of `Windows`, from `measure_windows` or `judging.judge`."""
