"""What is found in the windows of one recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from jaximp.identification.residuals import Residuals
from jaximp.least_squares.window import SlidingFit, WindowFit, confidence_interval
from jaximp.models.base import Joints, Model
from jaximp.models.chain import Chain
from jaximp.models.determined import DETERMINED, openness, sizes_of_chain
from jaximp.models.joint import HumanJoint, parameter_units
from jaximp.models.tip import TipImpedance
from jaximp.results import Column, Result
from jaximp.tracking.results import Track
from jaximp.trust.changes import Course
from jaximp.trust.frequencies import ByFrequency
from jaximp.trust.limits import TrustLimits
from jaximp.trust.score_tests import Bands, Misfit
from jaximp.trust.verdicts import Verdicts, worst
from jaximp.trust.window_rules import NOTHING_MISSING, Windows, judge_windows


@dataclass(frozen=True)
class Reflex:
    """The reflex of one joint in all windows."""

    name: str
    """`reflex`; with several joints `joint1.reflex`."""
    unit: str
    """Of the gain and of the weights."""
    lags: NDArray[np.float64]
    """(k,) [s]."""
    columns: NDArray[np.int64]
    """(k,) where their weights stand among the parameters."""
    gain: NDArray[np.float64]
    """(M,) sum of the weights; above zero where the reflex resists the stretch."""
    gain_stderr: NDArray[np.float64]
    """(M,)."""
    delay: NDArray[np.float64]
    """(M,) mean lag by weight [s]; NaN where the gain is within two standard errors of zero."""


SCATTERED = 0.25
"""Share of intervals of 95 % beside a value from which on it does not stand for all of them: windows overlap, and where
one interval misses the truth by chance its neighbours do."""


@dataclass(frozen=True)
class HumanPart:
    """One human joint among the parameters of an `Estimates`."""

    model: HumanJoint
    theta: NDArray[np.float64]
    """(M, k) the joint's own parameters."""
    columns: slice
    """Where they stand among all parameters."""
    prefix: str
    """What their names begin with where there are several joints."""
    position_unit: str

    def equilibrium(self) -> NDArray[np.float64]:
        """(M,) position at which the elastic torque vanishes."""
        return np.asarray(self.model.equilibrium(self.theta))

    @property
    def factor(self) -> NDArray[np.float64]:
        """(k,) what takes each parameter from the motor's to the joint's side of the gear."""
        return np.asarray(self.model.at_joint(jnp.ones(self.theta.shape[1])))


@dataclass(frozen=True)
class Estimates(Result):
    """One model in all windows of one recording: M estimates of p parameters.

    **Example:**

    ```pycon
    >>> recording = jaximp.read_job("examples/ankle.toml").load()
    >>> model, filters = jaximp.models.HumanJoint(), {"position_cutoff": 90, "decimation_cutoff": 45}
    >>> (found,) = jaximp.identify(recording, model=model, window_s=2, **filters)
    >>> low, high = found["stiffness"].interval()
    >>> print(found.names[2], found.units[2], low[0] < 60 < high[0], found.trusted[0])
    stiffness N m/rad True True

    ```
    """

    model: Model
    """What was identified."""
    names: tuple[str, ...]
    units: tuple[str, ...]
    window: float
    """Length of the windows [s]."""
    start: NDArray[np.float64]
    """(M,) time of each window's first sample [s]."""
    end: NDArray[np.float64]
    """(M,) time of each window's last sample [s]."""
    fit: SlidingFit
    """Parameters, standard errors and condition of every window."""
    held_out_vaf: NDArray[np.float64]
    """(M,) how well each window's parameters predict the torque of the window after it."""
    measured: tuple[Windows, ...]
    """What the rules look at, of every joint that is judged by itself."""
    limits: TrustLimits
    threshold: float | None
    """Threshold on the condition number, eq. (16), where a reference trajectory was given."""
    time: NDArray[np.float64]
    """(N,) time of the torque samples below [s]."""
    torque: NDArray[np.float64]
    """(N, n) torque that the model had to explain, filtered [N m]; NaN where it did not count."""
    reconstructed: NDArray[np.float64]
    """(N, n) the model's torque with the parameters of the window around each sample."""
    predicted: NDArray[np.float64]
    """(N, n) the model's torque with parameters that have not seen the sample: those of the last window that ended
    before the block of one window's length in which the sample lies."""
    method: int | None = None
    """Which of the four methods told the human from the robot."""
    robot: WindowFit | None = None
    """The robot's parameters, where a method needed them."""
    robot_names: tuple[str, ...] = ()
    robot_change: NDArray[np.float64] | None = None
    """(r,) standard deviation of what the robot's parameters may differ by in the recording with the human, beyond the
    errors of their estimates, as far as this is known."""
    notes: tuple[str, ...] = ()
    """What a reader must know of these numbers, in plain words."""
    misfits: tuple[Misfit, ...] = ()
    """Tests of the model over the whole record, where its noise was estimated."""
    noise: tuple[NDArray[np.float64], ...] = ()
    """Of each joint (or, for an arm, in one array) frequency [Hz] and density of the noise that was estimated."""
    bands: Bands | None = None
    """Ordinary least squares beside the estimates, where these are others."""
    frequencies: tuple[ByFrequency, ...] = ()
    """Of each joint the estimates by bands of frequencies, where curves were wanted and there is enough to compare."""
    lacking: Mapping[str, str] = field(default_factory=dict)
    """Parameters that what the model lacks moves beyond error and a share that matters, and why, in words."""
    changed: Mapping[str, Course] = field(default_factory=dict)
    """Parameters that are not the same in windows that share no rows (or surely move along a path), and how."""
    steady: tuple[str, ...] = ()
    """Parameters of which no change beyond error and 5 % was found, though it was looked for."""
    reflexes: tuple[Reflex, ...] = ()
    """Of every joint that has one."""
    residuals: Residuals | None = None
    """What the parameters of the whole recording leave of its torque, of each joint."""
    held_out: Residuals | None = None
    """What they leave of a recording that they have not seen, where there is one."""
    doubted: Mapping[str, NDArray[Any]] = field(default_factory=dict)
    """Of a model whose parameters are judged one by one, (M,) why each cannot be trusted; empty text where it can."""
    tracks: tuple[Track, ...] = ()
    """Of each joint the path of its parameters, where they were followed: the M estimates are its points then, and
    `window` is the length of the stretch around each in which its motion is judged."""

    @property
    def value(self) -> NDArray[np.float64]:
        """(M, p) estimates."""
        return np.asarray(self.fit.theta)

    @property
    def stderr(self) -> NDArray[np.float64]:
        """(M, p) standard errors."""
        return np.asarray(self.fit.stderr)

    @property
    def dof(self) -> NDArray[np.float64]:
        """(M,) degrees of freedom of the standard errors."""
        return np.asarray(self.fit.dof)

    @property
    def covariance(self) -> None:
        """Windows keep none: one for each of them would fill the memory."""
        return None

    def interval(self, level: float = 0.95) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(M, p) lower and upper ends of the intervals that hold the truth with probability `level`."""
        return confidence_interval(self.value, self.stderr, self.dof, level)

    @property
    def trusted(self) -> NDArray[np.bool_]:
        """(M,) which windows break no rule."""
        return self.verdicts.trusted

    @property
    def kind(self) -> str:
        """What each of the M estimates belongs to: a `window`, or a `point` of a path."""
        return "point" if self.tracks else "window"

    @property
    def unpredictive(self) -> NDArray[np.bool_]:
        """(M,) trusted windows whose parameters predict the torque of the next one worse than a constant would; of a
        path those where what was known before does."""
        return np.asarray(self.trusted & (self.held_out_vaf < 0))

    def trusted_in(self, name: str) -> NDArray[np.bool_]:
        """(M,) which windows can be trusted in one parameter: what the model lacks may spare it."""
        if name in self.doubted:
            return np.asarray(self.verdicts.trusted & (self.doubted[name] == ""))
        spared = name not in self.lacking and self.verdicts.rule == NOTHING_MISSING
        return np.asarray(self.verdicts.trusted | spared)

    @property
    def human_joints(self) -> list[HumanPart]:
        """The human joints among the parameters."""
        parts, first = [], 0
        for model in self.model.models if isinstance(self.model, Joints) else (self.model,):
            if isinstance(model, HumanJoint):
                columns = slice(first, first + len(model.names))
                prefix = self.names[first].removesuffix(model.names[0])
                unit = "rad" if "rad" in model.units[model.names.index("stiffness")] else "m"
                parts.append(HumanPart(model, self.value[:, columns], columns, prefix, unit))
            first += len(model.names)
        return parts

    @property
    def torque_unit(self) -> str:
        """`N m` of revolute joints, `N` of prismatic ones, `mixed` of both."""
        if isinstance(self.model, Chain | TipImpedance):
            kinds = set(self.model.joint_kinds)
            return "mixed" if len(kinds) > 1 else "N" if kinds == {"prismatic"} else "N m"
        prismatic = set(parameter_units("prismatic").values())
        units = {
            "N" if set(part.units) <= prismatic else "N m"
            for part in (self.model.models if isinstance(self.model, Joints) else (self.model,))
        }
        return units.pop() if len(units) == 1 else "mixed"

    def on_held_out(self) -> Estimates:
        """With the torque of the recording that was held out in place of its own, for figures."""
        found = self.held_out
        if found is None:
            raise ValueError("no recording was held out: pass held_out to estimate")
        unseen = np.full_like(found.predicted, np.nan)
        return replace(
            self, time=found.time, torque=found.torque, reconstructed=found.predicted, predicted=unseen, notes=()
        )

    def columns(self) -> list[Column]:
        """A row for each window: as in `estimates.parquet`."""
        fit = self.fit
        columns = [Column("start_s", "s", self.start), Column("end_s", "s", self.end)]
        for k, (name, unit) in enumerate(zip(self.names, self.units, strict=True)):
            columns += [Column(name, unit, self.value[:, k]), Column(f"{name}_stderr", unit, self.stderr[:, k])]
        columns += [
            Column(f"{part.prefix}equilibrium", part.position_unit, part.equilibrium())
            for part in self.human_joints
            if part.model.offset
        ]
        for reflex in self.reflexes:
            columns += [
                Column(f"{reflex.name}_gain", reflex.unit, reflex.gain),
                Column(f"{reflex.name}_gain_stderr", reflex.unit, reflex.gain_stderr),
                Column(f"{reflex.name}_delay", "s", reflex.delay),
            ]
        columns += self._columns_of_path()
        return [
            *columns,
            Column("condition", "1", fit.cond),
            Column("sigma_min", "mixed", fit.sigma_min),
            Column("residual_rms", self.torque_unit, fit.residual_rms),
            Column("vaf", "1", fit.vaf),
            Column("held_out_vaf", "1", self.held_out_vaf),
            Column("dof", "1", fit.dof),
            Column("samples", "1", fit.samples),
            Column("verdict", "", self.verdicts.verdict),
            Column("reason", "", self.verdicts.reason),
        ]

    def _columns_of_path(self) -> list[Column]:
        """Where parameters were followed: what was known up to each point, and how probable a jump before it is."""
        columns, k = [], 0
        for track in self.tracks:
            theta, stderr = np.asarray(track.filtered.theta), np.asarray(track.filtered.stderr)
            for i in range(theta.shape[1]):
                name, unit = self.names[k], self.units[k]
                columns += [
                    Column(f"{name}_filtered", unit, theta[:, i]),
                    Column(f"{name}_filtered_stderr", unit, stderr[:, i]),
                    Column(f"{name}_jump", "1", np.asarray(track.jumped)[:, i]),
                ]
                k += 1
        return columns

    @cached_property
    def verdicts(self) -> Verdicts:
        """Made by `trust.window_rules.RULES` and by nothing else; a window is as good as its worst joint."""
        each = [judge_windows(windows, self.limits) for windows in self.measured]
        return each[0] if len(each) == 1 else worst(each, [f"joint {j + 1}: " for j in range(len(each))])

    @property
    def intrinsic(self) -> NDArray[np.int64]:
        """Which parameters are no weights of a reflex."""
        weights = [reflex.columns for reflex in self.reflexes]
        return np.setdiff1d(np.arange(len(self.names)), np.concatenate([[], *weights]))

    def summarised(self) -> Estimates:
        """With the gain of every reflex in place of its weights: what a person wants to see of all parameters."""
        if not self.reflexes:
            return self
        kept, gone = self.intrinsic, np.full((len(self.end), len(self.reflexes)), np.nan)
        found = (
            (self.fit.theta, np.stack([reflex.gain for reflex in self.reflexes], axis=1)),
            (self.fit.stderr, np.stack([reflex.gain_stderr for reflex in self.reflexes], axis=1)),
            (self.fit.excitation, gone),
        )
        columns = tuple(np.concatenate([np.asarray(x)[:, kept], gain], axis=1) for x, gain in found)
        return replace(
            self,
            names=(*(self.names[k] for k in kept), *(f"{reflex.name}_gain" for reflex in self.reflexes)),
            units=(*(self.units[k] for k in kept), *(reflex.unit for reflex in self.reflexes)),
            fit=eqx.tree_at(lambda f: (f.theta, f.stderr, f.excitation), self.fit, columns),
            reflexes=(),
        )

    def mean_over_trusted(self) -> NDArray[np.float64]:
        """(p,) mean of each parameter over the windows that can be trusted in it; NaN if there are none."""
        return np.array([column.mean() if len(column) else np.nan for column in self._trusted_columns()])

    def sd_over_trusted(self) -> NDArray[np.float64]:
        """(p,) standard deviation of each parameter over the same windows; NaN if there are none."""
        return np.array([column.std() if len(column) else np.nan for column in self._trusted_columns()])

    def range_of(self, name: str) -> tuple[float, float] | None:
        """Between which values nine of ten of the trusted estimates of a parameter are, where no value lies within
        nearly all of their intervals, so that a mean would stand for none; None where one does."""
        k = self.names.index(name)
        trusted = self.trusted_in(name)
        value, (low, high) = self.value[trusted, k], (end[trusted, k] for end in self.interval())
        half = np.maximum((high - low) / 2, np.finfo(float).tiny)
        if len(value) < 2 or not np.isfinite(half).all():
            return None
        mean = (value / half**2).sum() / (1 / half**2).sum()
        if np.mean(np.abs(value - mean) > half) < SCATTERED:
            return None
        ends = np.quantile(value, [0.05, 0.95])
        return float(ends[0]), float(ends[1])

    def undetermined(self) -> dict[str, float]:
        """Parameters that the data do not determine, and how far from it they are.

        Of a robot from its URDF those by `models.determined`, with half of their interval (the median over all windows)
        as a share of their size. Of other models those whose standard error in one window is, in the median over those
        that can be trusted in it, a larger share of their size in all windows than `limits.max_relative_stderr`; and
        that share. The rules of a window are milder: they compare with what would explain the whole torque by itself.
        """
        if isinstance(self.model, Chain):
            middle = np.array([self._size(k) for k in range(len(self.names))])
            low, high = self.interval()
            half = np.array([np.nan if not len(x) else np.median(x) for x in _finite_columns((high - low) / 2)])
            open_by = openness(middle - half, middle + half, sizes_of_chain(self.model))
            return {name: float(by) for name, by in zip(self.names, open_by, strict=True) if by > DETERMINED}
        found: dict[str, float] = {}
        for k, name in enumerate(self.names):
            errors, size = self.stderr[self.trusted_in(name), k], self._size(k)
            share = float(np.median(errors) / size) if len(errors) and size else 0.0
            if share > self.limits.max_relative_stderr:
                found[name] = share
        return found

    def _size(self, k: int) -> float:
        """Of a parameter: its mean over all windows, each by how sure it is. Windows that are trusted because it comes
        out large in them do not speak for it."""
        value, stderr = self.value[:, k], self.stderr[:, k]
        known = np.isfinite(value) & (stderr > 0)
        weight = 1 / stderr[known] ** 2
        return abs(float((weight * value[known]).sum() / weight.sum())) if known.any() else 0.0

    def _trusted_columns(self) -> list[NDArray[np.float64]]:
        return [self.value[self.trusted_in(name), k] for k, name in enumerate(self.names)]


def _finite_columns(values: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    return [column[np.isfinite(column)] for column in values.T]
