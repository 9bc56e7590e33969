"""Exciting trajectories by gradient: what a motion is worth to an estimate, within the limits of joint and robot.

Tout et al. 2023, III-A, after Swevers et al. 1997: the coefficients of a finite Fourier series that make the regressor
of one period, or of its worst window, as well conditioned as can be. The regressor is differentiable, so the gradient
is exact, and all starts descend at once (`motions.py`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaximp.design.bounds import condition_bound
from jaximp.design.clearance import Clearance
from jaximp.design.columns import Selected
from jaximp.design.limits import NO_LIMITS, SYMMETRIC, Limits, completed, per_joint, room, unlimited
from jaximp.design.motions import (
    FINER,
    PER_CYCLE,
    Encoder,
    Problem,
    descend,
    judged,
    random_starts,
    shares_reached,
    sliding_sums,
    torque_share,
)
from jaximp.design.objectives import MANY
from jaximp.design.search import search
from jaximp.models.base import Model
from jaximp.models.chain import Chain
from jaximp.motion.trajectories import FourierSeries
from jaximp.numerics.optimise import METHODS
from jaximp.numerics.precision import require_float64
from jaximp.types import Numbers, Progress, listed, nearest

OBJECTIVES = {
    "condition": "condition number of the regressor",
    "determinant": "volume of the confidence ellipsoid",
    "sigma_min": "smallest singular value of the regressor",
    "stderr": "standard error of one parameter",
}
ACTIVE = 0.999
"""A limit is active where the motion reaches such a share of it."""
COLLINEAR = 1e6
"""From this condition number on, parameters cannot be told apart."""


@dataclass(frozen=True)
class Design:
    """A motion that excites a model, and how good it is.

    **Example:**

    ```pycon
    >>> model = jaximp.models.HumanJoint(offset=False)  # doctest: +SKIP
    >>> limits = jaximp.Limits(position=(-0.3, 0.3), velocity=2)  # doctest: +SKIP
    >>> design = jaximp.design_excitation(model, limits=limits, harmonics=3, starts=2)  # doctest: +SKIP
    >>> motion = design.sampled(100)  # doctest: +SKIP
    >>> print(sorted(motion), motion["position"].shape)  # doctest: +SKIP

    ```
    """

    trajectory: FourierSeries
    model: Model
    """The model that is to be identified."""
    condition: float
    """Condition number of the regressor over one period."""
    worst_condition: float
    """Condition number of the worst sliding window if windows were designed for, otherwise that of the period."""
    lower_bound: float
    """No motion has a smaller condition number over a period; NaN where no bound is known."""
    bound_source: str
    """Where the lower bound comes from, or why none is known."""
    period: float
    """[s]."""
    objective: str
    value: float
    """The objective: a condition number, a singular value, a standard error in units of the torque's noise at
    `sample_rate` samples per second, or the determinant of the Gram matrix to the power -1/(2p)."""
    limits: Limits
    active: tuple[str, ...]
    """The limits that the motion reaches, in words."""
    conditions: Numbers
    """Condition number, over the period or of the worst window, that every start has reached; best first."""
    parameters: Numbers | None = None
    """Parameters of the model of everything that is moved, where they were given."""
    window: float | None = None
    """Length of the windows that were designed for [s]."""
    moved: Model | None = None
    """The model of everything that is moved, which may be more than what is identified."""
    parameter: str | None = None
    """The parameter whose standard error was made small."""
    unit_condition: float | None = None
    """Condition number over the period of columns of unit norm, where it was computed."""
    clearance: Clearance | None = None
    """What the motion keeps its distance from."""

    def in_words(self) -> list[str]:
        """The result in words, one line for each fact."""
        lines = [f"condition number over a period of {self.period:g} s: {self.condition:.4g}"]
        if self.unit_condition is not None:
            lines[0] += f" of columns in SI units, {self.unit_condition:.4g} of columns of unit norm"
        if self.objective != "condition":
            lines.insert(0, self._objective_in_words())
        if math.isnan(self.lower_bound):
            lines.append(f"how far above the least possible: not known ({self.bound_source})")
        else:
            source = f"{self.bound_source}; it knows no limits"
            lines.append(
                f"{_above(self.condition, self.lower_bound)} the lower bound {self.lower_bound:.4g} ({source})"
            )
        if self.window is not None:
            lines.append(f"condition number in the worst window of {self.window:.4g} s: {self.worst_condition:.4g}")
        if not self.worst_condition < COLLINEAR:
            lines.append("not all parameters can be told apart: use another objective, or a smaller model")
        lines.append(f"limits reached: {self.limits_reached()}")
        if self.objective == "condition" and not self.active and len(unlimited(self.limits)) < 5:
            lines.append(
                "a larger motion would keep the limits: the condition number does not ask for size, stderr does"
            )
        moved = self.moved or self.model
        lines += moved.notes if isinstance(moved, Chain) else ()
        return lines + ([] if self.clearance is None else list(self.clearance.notes))

    def limits_reached(self) -> str:
        """In words, joints that reach the same limit together: `velocity of joints 1, 2 and 5`."""
        joints: dict[str, list[str]] = {}
        for text in self.active:
            what, _, joint = text.rpartition(" of joint ")
            joints.setdefault(what or text, []).extend([joint] if what else [])
        several = {what: "s" if len(of) > 1 else "" for what, of in joints.items()}
        return (
            ", ".join(what + (f" of joint{several[what]} {listed(of)}" if of else "") for what, of in joints.items())
            or "none"
        )

    def _objective_in_words(self) -> str:
        where = f"over a period of {self.period:g} s" if self.window is None else f"in windows of {self.window:.4g} s"
        if self.objective != "stderr":
            return f"{OBJECTIVES[self.objective]} {where}: {self.value:.4g}"
        unit = self.model.units[self.model.names.index(self.parameter or "")]
        noise = "white torque noise of 1 N m in every sample"
        return f"standard error of {self.parameter} {where}, for {noise}: {self.value:.4g} {unit}"

    def sliding_condition(self, length: float) -> tuple[Numbers, Numbers]:
        """Condition number of the regressor in every window of `length` seconds.

        **Returns:** the end of each window (M,) [s], evenly spread over one period, and its condition number (M,),
        infinite where the window does not determine the parameters. Windows that reach back beyond the beginning of
        the period see the end of the one before.
        """
        count = FINER * max(200, PER_CYCLE * np.shape(self.trajectory.sine)[-1])
        motion = self.sampled(count / self.period)
        q, dq, ddq = (motion[name] for name in ("position", "velocity", "acceleration"))
        rows = self.model.over_period(q, dq, ddq, count / self.period)
        products = np.einsum("tni,tnj->tij", *[np.asarray(rows).reshape(count, self.model.n_joints, -1)] * 2)
        n = min(count, max(1, round(length / self.period * count)))
        values = np.linalg.eigvalsh(sliding_sums(products, n))
        low, high = np.maximum(values[:, 0], 0), values[:, -1]
        known = low > np.finfo(float).eps * high
        cond = np.sqrt(np.divide(high, low, out=np.full(count, np.inf), where=known))
        return motion["time"], np.roll(cond, n - 1)

    def sampled(self, sample_rate: float) -> dict[str, Numbers]:
        """One period at a controller's sample rate [Hz]: `time`, `position`, `velocity`, `acceleration` (N, n), and
        `torque` of everything that is moved, where its parameters are known."""
        time = np.arange(round(self.period * sample_rate)) / sample_rate
        q, dq, ddq = (np.asarray(x) for x in self.trajectory(time))
        found = {"time": time, "position": q, "velocity": dq, "acceleration": ddq}
        if self.parameters is not None:
            rows = np.asarray((self.moved or self.model).over_period(q, dq, ddq, sample_rate))
            found["torque"] = rows @ np.asarray(self.parameters)
        return found


def _above(condition: float, bound: float) -> str:
    """Say in words how far a condition number is above its bound."""
    share = condition / bound - 1
    if share < 1e-4:
        return "at"
    return f"{100 * share:.2g} % above" if share < 1 else f"{share + 1:.2g} times"


def design_excitation(
    model: Model,
    *,
    harmonics: int = 5,
    period: float = 10.0,
    limits: Limits = NO_LIMITS,
    objective: str = "condition",
    parameter: str | None = None,
    window: float | None = None,
    rest: bool = False,
    mean: Any = None,
    scale: Any = None,
    parameters: Any = None,
    moved: Model | None = None,
    encoder: Encoder | None = None,
    columns: Sequence[str] | None = None,
    clearance: Clearance | None = None,
    sample_rate: float = 1000.0,
    starts: int | None = None,
    seed: int = 0,
    method: str | None = None,
    progress: Progress = lambda share: None,
) -> Design:
    """Design a periodic motion, a finite Fourier series, that excites every parameter of a model.

    **Arguments:** `harmonics` and `period` [s]: the highest frequency is their ratio. `objective` one of `OBJECTIVES`
    (`stderr` is that of `parameter`, by its name), over the whole period, or over the worst of all sliding windows of
    `window` seconds. `rest` makes the period begin and end at rest. `mean` position [rad or m], for all joints or for
    each; where it is not given, it is designed as well. `scale` (p,) the size of each parameter: columns are compared
    by the torque that they make; with `"unit"` they are compared at unit norm. `parameters` (p,) of the model, which a
    limit of the torque needs. Where more is moved than is to be identified, such as a known robot with the human in it,
    `moved` is the model of it all, and the `parameters` and the limit of the torque are its. `columns` are the names of
    those parameters of the model that are not known yet; `columns.Load(robot)` is a load at its tip.
    `encoder` brings the quantised position into the objective. `sample_rate` [Hz] of the measurements that a standard
    error counts. `starts` random motions are improved by `method` (`optimise.METHODS`); `seed` draws them. By default
    the method is `bfgs` from 32 starts, and `python` from 16 for many columns and where a `clearance` is to be kept.

    A robot from a URDF (`models.Chain`) keeps the file's limits of position, velocity and torque where `limits` says
    nothing else, and its `parameters` are the file's.

    **Returns:** a `Design`: the best motion. It keeps the limits on a grid of at least 240 instants in every period of
    the highest harmonic.

    **Raises:** `ValueError` for limits that no motion can keep (it names them), and for settings that make no sense.

    **Source:** Tout et al. 2023, III-A; the series of Swevers et al. 1997.

    **Example:**

    ```pycon
    >>> model = jaximp.models.HumanJoint(offset=False)  # doctest: +SKIP
    >>> limits = jaximp.Limits(position=(-0.3, 0.3), velocity=2)  # doctest: +SKIP
    >>> design = jaximp.design_excitation(model, limits=limits, harmonics=3, starts=2)  # doctest: +SKIP
    >>> print(round(design.condition, 1), round(design.lower_bound, 1))  # doctest: +SKIP

    ```
    """
    require_float64()
    if moved is None:
        moved = model
    if columns is not None:
        model = Selected(model, columns)
    if isinstance(moved, Chain) and parameters is None:
        parameters = moved.parameters
    if method is None:
        method = "bfgs" if clearance is None and len(model.names) < MANY else "python"
    if method not in METHODS:
        raise ValueError(f"method is '{method}': there are {', '.join(METHODS)}")
    if method == "python" and encoder is not None:
        raise ValueError("the method 'python' knows no encoder: leave one of them out")
    if method != "python" and clearance is not None:
        raise ValueError(f"the method '{method}' keeps no clearance: leave out the method, or the clearance")
    limits = completed(limits, moved)
    problem = _problem(
        model, moved, harmonics=harmonics, period=period, limits=limits, objective=objective,
        parameter=parameter, window=window, rest=rest, mean=mean, scale=scale, parameters=parameters,
        encoder=encoder, clearance=clearance, sample_rate=sample_rate,
    )  # fmt: skip
    if method == "python":
        found = search(problem, 16 if starts is None else starts, seed, progress)
    else:
        x = random_starts(problem, 32 if starts is None else starts, seed)
        x = descend(problem, x, method, progress)
        found = [judged(problem, one) for one in x]
    values = np.array([one.value for one in found])
    conditions = np.sort([one.worst for one in found])
    best = found[int(np.nanargmin(values))]
    if not math.isfinite(best.value):
        raise ValueError(
            "no motion of so few harmonics tells all parameters apart: give more harmonics, wider limits, or a smaller "
            "model"
        )
    bound, source = condition_bound(model, harmonics, period)
    return Design(
        best.series, model, best.condition, best.worst, bound, source, period, objective,
        _in_units(problem, best.value), limits, _active(problem, best.series), conditions,
        None if parameters is None else np.asarray(parameters, float), window, moved, parameter, best.unit, clearance,
    )  # fmt: skip


def _problem(
    model: Model,
    moved: Model,
    *,
    harmonics: int,
    period: float,
    limits: Limits,
    objective: str,
    parameter: str | None = None,
    window: float | None = None,
    rest: bool = False,
    mean: Any = None,
    scale: Any = None,
    parameters: Any = None,
    encoder: Encoder | None = None,
    clearance: Clearance | None = None,
    sample_rate: float = 1000.0,
) -> Problem:
    """The settings, checked."""
    if model.n_joints != moved.n_joints:
        raise ValueError(
            f"the model has {model.n_joints} joints, but that of what is moved has {moved.n_joints}: give both the "
            "same joints"
        )
    _check_motion(harmonics, period, sample_rate, window, rest, encoder)
    _check_objective(model, objective, parameter)
    low, high, most = room(limits, model.n_joints)
    if mean is not None:
        mean = jnp.asarray(per_joint("mean", mean, model.n_joints))
        if not ((low < mean) & (mean < high)).all():
            raise ValueError(f"mean is {mean.tolist()}: it must be inside limits.position")
    if np.isfinite(most[-1]).any() and parameters is None:
        raise ValueError(
            f"limits.torque needs the parameters of the model, here {', '.join(moved.names)}: pass parameters=..., or "
            "write a [parameters] table"
        )
    unit = isinstance(scale, str)
    if unit and scale != "unit":
        raise ValueError(f"scale is '{scale}': write 'unit' for columns of unit norm, or give a size of each parameter")
    scale = jnp.ones(len(model.names)) if scale is None or unit else _per_parameter("scale", scale, model)
    if not (scale > 0).all():
        raise ValueError("scale must be above zero: it is the size of each parameter")
    return Problem(
        model=model,
        moved=moved,
        period=float(period),
        harmonics=harmonics,
        rest=rest,
        low=jnp.asarray(low),
        high=jnp.asarray(high),
        most=jnp.asarray(most),
        parameters=None if parameters is None else _per_parameter("parameters", parameters, moved),
        scale=scale,
        mean=mean,
        objective=objective,
        parameter=-1 if parameter is None else model.names.index(parameter),
        window=None if window is None else window / period,
        encoder=encoder,
        samples=period * (sample_rate if encoder is None else encoder.sample_rate),
        unit=unit,
        whole=model is moved,
        clearance=clearance,
    )


def _check_motion(
    harmonics: int, period: float, sample_rate: float, window: float | None, rest: bool, encoder: Encoder | None
) -> None:
    if harmonics < (3 if rest else 1):
        raise ValueError(f"harmonics is {harmonics}: give at least {3 if rest else 1}")
    for name, number in (("period", period), ("sample_rate", sample_rate)):
        if not (math.isfinite(number) and number > 0):
            raise ValueError(f"{name} is {number}: it must be a number above zero")
    if window is not None and not 0 < window <= period:
        raise ValueError(f"window is {window:g} s: it must be above zero and no longer than the period of {period:g} s")
    if encoder is not None and not round(period * encoder.sample_rate) >= 2 * harmonics:
        raise ValueError(
            "the encoder takes fewer than two samples in a period of the highest harmonic: raise its sample rate, or "
            "give fewer harmonics"
        )


def _check_objective(model: Model, objective: str, parameter: str | None) -> None:
    if objective not in OBJECTIVES:
        raise ValueError(f"objective is '{objective}': {nearest(objective, list(OBJECTIVES))}")
    if (objective == "stderr") != (parameter is not None):
        raise ValueError(
            "the objective 'stderr' needs a parameter, and no other objective takes one: parameter may be "
            + ", ".join(model.names)
        )
    if parameter is not None and parameter not in model.names:
        raise ValueError(f"parameter is '{parameter}': {nearest(parameter, list(model.names))}")


def _per_parameter(name: str, values: Any, model: Model) -> Array:
    if np.shape(values) != (len(model.names),) or not np.isfinite(values).all():
        raise ValueError(f"{name} must be {len(model.names)} finite numbers, one for each of {', '.join(model.names)}")
    return jnp.asarray(values, float)


def _in_units(problem: Problem, value: float) -> float:
    """The objective in the unit in which the user knows it."""
    return math.exp(-value if problem.objective == "sigma_min" else value)


def _active(problem: Problem, series: FourierSeries) -> tuple[str, ...]:
    """The limits that the motion reaches, in words."""
    n, t = problem.n, problem.instants(FINER)
    sine, cosine = (jnp.reshape(x, (n, -1)) for x in (series.sine, series.cosine))
    several = FourierSeries(sine, cosine, jnp.reshape(series.offset, n), series.period)
    names = ["highest position", "lowest position", *SYMMETRIC]
    reached = list(np.asarray(shares_reached(problem, several, t)))
    if problem.parameters is not None:
        reached.append(np.asarray(torque_share(problem, several, t, None)))
    of = [f" of joint {j + 1}" if n > 1 else "" for j in range(n)]
    active = [
        name + of[j] for name, shares in zip(names, reached, strict=False) for j in range(n) if shares[j] >= ACTIVE
    ]
    if problem.clearance is not None:
        shares = np.asarray(problem.clearance.shares(several(t)[0])).max(axis=0)
        close = [name for name, share in zip(problem.clearance.names, shares, strict=True) if share >= ACTIVE]
        active += [f"clearance of {name}" for name in dict.fromkeys(close)]
    return tuple(active)
