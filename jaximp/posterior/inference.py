"""Posteriors of a job: of its whole record, and of windows that share no sample with each other.

A model of one output whose noise is Gaussian and whose prior is flat has an exact posterior; others are sampled. The
noise is what the filters make of white noise, with an autoregression where the residuals demand one; noise of the
position is corrected for where it matters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib.util import find_spec
from itertools import pairwise

import equinox as eqx
import jax
import numpy as np

from jaximp.identification.identify import in_windows
from jaximp.identification.pipeline import Pipeline
from jaximp.identification.prepared import Prepared, prepare
from jaximp.identification.solving import Placement, place_windows
from jaximp.least_squares.noise import (
    LAGS,
    Noise,
    Whiteness,
    WhiteRows,
    attenuation,
    disagreement,
    fit_noise,
    optimum,
    residuals,
    triangles,
    whiten,
    whitened_covariance,
    whiteness,
)
from jaximp.models.base import Joints, Model
from jaximp.models.reflex import pathway_of
from jaximp.numerics.precision import require_float64
from jaximp.posterior.densities import (
    Density,
    linear_density,
    noise_names,
    undetermined,
    window_densities,
)
from jaximp.posterior.draws import (
    Posterior,
    PosteriorMany,
    credible_interval,
    derive,
    exact_posterior,
    labels,
    probability_greater,
    stacked,
)
from jaximp.posterior.ensemble import sample_posterior
from jaximp.posterior.hamiltonian import sample_many
from jaximp.posterior.laplace import normal_many
from jaximp.posterior.predictive import PriorPredictive, log_scores, mean_score, prior_predictive, torque_bands
from jaximp.posterior.priors import LogNormal, MultivariateNormal, Normal, Prior, make_prior
from jaximp.results import Column, Result
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import POOR, TRUSTED, UNCONVERGED, WEAK, Rule, Verdict, Verdicts, judge_one
from jaximp.types import AnyArray, Numbers, Progress, Recording, RobotAlone

CONTRADICTION = 1e-3
"""Windows, or estimates, that differ more than this is probable contradict each other."""
LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)
"""Of the bands of torque."""


@dataclass(frozen=True)
class PosteriorSettings:
    """`[posterior]`: what posteriors are drawn with."""

    seed: int = 0
    """Seed of the random numbers: the same seed gives the same draws."""
    ess: float = 1000.0
    """Effective samples that are drawn of every parameter."""
    heavy_tails: bool = False
    """Noise of Student's t with four degrees of freedom, in place of Gaussian noise."""
    prior: Mapping[str, Normal | LogNormal] = field(default_factory=dict)
    """Of parameters by name: `{ mean = 60, sd = 20 }`, or `{ median = 0.7, factor = 2 }` of one that is positive."""


@dataclass(frozen=True)
class Change:
    """How probable it is that a parameter is greater in a later window than in the one before."""

    parameter: str
    windows: tuple[int, int]
    probability: float
    error: float
    """Monte Carlo standard error."""


@dataclass(frozen=True)
class Inference(Result):
    """What a recording tells of the parameters, in draws.

    As a result it is that of the whole record: means and standard deviations of the draws, and credible intervals.

    **Example:**

    ```pycon
    >>> found = jaximp.infer(jaximp.read_job("examples/ankle.toml"))  # doctest: +SKIP
    >>> print(found.whole.names, found.windows is not None)  # doctest: +SKIP

    ```
    """

    whole: Posterior
    """Of the whole record, as if nothing changed in it."""
    windows: PosteriorMany | None
    """Of the windows that determine all parameters; None where there is none."""
    start: Numbers
    """(M,) of each of them [s]."""
    end: Numbers
    """(M,) [s]"""
    verdicts: Verdicts
    """(M,) of `identify` on them: what their model explains, and how their motion excites it."""
    left_out: tuple[str, ...]
    """Why other windows have none."""
    gains: dict[str, Numbers]
    """Of every reflex what makes its gain of the parameters (p,); none without a reflex."""
    noise: Noise
    whiteness: tuple[Whiteness, ...]
    """Of the whitened residuals of each output."""
    bias: Numbers
    """(p,) of least squares by noise of the position, in standard errors; draws are free of it beyond 0.25."""
    shift: Numbers
    """(p,) by which the noise that the residuals demand moves the estimate, in standard errors of the difference."""
    constant: np.ndarray
    """(p,) which parameters are a constant torque: slow noise hides it first, and no rule looks at it."""
    held_out: Numbers | None
    """(R, n) log predictive density of the second half of the record by its motion and the first half, row by row, NaN
    where it does not count; None where the first half alone determines nothing."""
    prior: PriorPredictive
    time: Numbers
    """(N,) [s]"""
    torque: Numbers
    """(N, n), filtered; NaN where it did not count [N m]."""
    bands: Numbers
    """(5, N, n) quantiles `LEVELS` of the torque that the whole record's posterior predicts."""
    notes: tuple[str, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """(p,) of the parameters and of the noise; of a reflex its gain."""
        return self.summarised[0].names

    @property
    def units(self) -> tuple[str, ...]:
        return self.summarised[0].units

    @property
    def value(self) -> Numbers:
        """(p,) means of the whole record's draws."""
        return self.summarised[0].mean

    @property
    def stderr(self) -> Numbers:
        """(p,) standard deviations of the draws."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def covariance(self) -> Numbers:
        """(p, p) of the draws."""
        return self.summarised[0].covariance

    @property
    def dof(self) -> float:
        """Intervals are quantiles of the draws: no distribution is assumed."""
        return np.inf

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(p,) lower and upper ends of credible intervals, with equal probability on both sides."""
        return credible_interval(self.summarised[0].samples, level)

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the whole record's draws, see `why`."""
        return not self.why

    def columns(self) -> list[Column]:
        """A row for each window: mean and standard deviation of the draws, verdict and reason."""
        windows = self.summarised[1]
        if windows is None:
            return [Column("start_s", "s", self.start), Column("end_s", "s", self.end)]
        samples, columns = windows.samples, [Column("start_s", "s", self.start), Column("end_s", "s", self.end)]
        for k, (name, unit) in enumerate(zip(windows.names, windows.units, strict=True)):
            columns += [
                Column(name, unit, samples[..., k].mean(axis=1)),
                Column(f"{name}_stderr", unit, samples[..., k].std(axis=1)),
            ]
        reasons = [self.reason(k) for k in range(len(self.end))]
        return [
            *columns,
            Column("verdict", "", self.verdicts.verdict),
            Column("reason", "", np.array(reasons)),
        ]

    @cached_property
    def verdict(self) -> Verdict:
        """Of the whole record's draws, by `RULES`."""
        return judge_one(RULES, self, TrustLimits())

    @property
    def why(self) -> str:
        """Why the posterior of the whole record cannot be trusted; empty where it can."""
        return self.verdict.in_words()

    @property
    def good(self) -> np.ndarray:
        """(M,) windows whose draws and whose verdict can be trusted."""
        windows = self.summarised[1]
        return np.zeros(0, bool) if windows is None else windows.ok & self.verdicts.trusted

    def reason(self, k: int) -> str:
        """Why a window cannot be trusted, by its draws or by what else is known of it; empty where it can."""
        windows, verdict = self.summarised[1], self.verdicts.verdict[k]
        assert windows is not None
        return windows[k].why or ("" if verdict == TRUSTED else f"{verdict}, {self.verdicts.reason[k]}")

    @cached_property
    def summarised(self) -> tuple[Posterior, PosteriorMany | None]:
        """Of the whole record and of the windows, with the gain of every reflex in place of its weights."""
        if not self.gains:
            return self.whole, self.windows
        names, p = self.whole.names, len(self.bias)
        weights = np.any([gain != 0 for gain in self.gains.values()], axis=0)
        kept = [k for k in range(len(names)) if k >= p or not weights[k]]
        matrix = np.vstack([np.eye(len(names))[kept], *(np.pad(g, (0, len(names) - p)) for g in self.gains.values())])
        units = (*(self.whole.units[k] for k in kept), *("N m s/rad",) * len(self.gains))
        named = (*(names[k] for k in kept), *self.gains)

        def summary(theta: jax.Array) -> jax.Array:
            return (matrix * theta).sum(axis=1)

        whole, windows = self.whole, self.windows
        return (
            derive(whole, summary, named, units),
            None if windows is None else derive(windows, summary, named, units),
        )

    @cached_property
    def changes(self) -> tuple[Change, ...]:
        """Of every parameter (of a reflex its gain), from each window that can be trusted to the next."""
        windows = self.summarised[1]
        if windows is None:
            return ()
        found, start, end = [], self.start, self.end
        for before, after in pairwise(int(k) for k in np.flatnonzero(self.good)):
            spans = ((start[after], end[after]), (start[before], end[before]))
            for name in (name for name in windows.names if not name.startswith("log_noise")):
                chance = probability_greater(windows[after], windows[before], name, spans=spans)
                found.append(Change(name, (before, after), *chance))
        return tuple(found)

    @property
    def score(self) -> tuple[float, float] | None:
        """Mean log predictive density of the second half of the record from the first, per row, and its standard error;
        to compare models see `compare_models`."""
        return None if self.held_out is None else mean_score(_counted(self.held_out))

    @property
    def inside(self) -> float:
        """Share of the torque within the 95 % band."""
        counted = np.isfinite(self.torque)
        within = (self.torque >= self.bands[0]) & (self.torque <= self.bands[-1])
        return float(within[counted].mean())

    @cached_property
    def contradiction(self) -> tuple[str, float]:
        """The parameter in which windows differ most, and how probable so large a difference is where nothing changes.

        The squares of differences from the common mean, in standard deviations, are then those of chi-squared.

        **Source:** Cochran 1954.
        """
        from scipy.stats import chi2

        windows = self.summarised[1]
        if windows is None or self.good.sum() < 2:
            return "", 1.0
        samples = windows.samples[self.good]
        mean, variance = samples.mean(axis=1), samples.var(axis=1)
        common = (mean / variance).sum(axis=0) / (1 / variance).sum(axis=0)
        squares = ((mean - common) ** 2 / variance).sum(axis=0)
        p = chi2.sf(squares, len(samples) - 1)
        told = [k for k, name in enumerate(windows.names) if not name.startswith("log_noise")]
        worst = min(told, key=lambda k: float(p[k]))
        return windows.names[worst], float(p[worst])

    @cached_property
    def shifted(self) -> tuple[str, float, float]:
        """The parameter that the noise which the residuals demand moves most, by how many standard errors of the move,
        and how probable that is of noise (`noise.disagreement`)."""
        from scipy.stats import norm

        judged = np.where(self.constant, 0.0, np.abs(self.shift))
        k = int(judged.argmax())
        size = float(judged[k])
        return self.whole.names[k], size, float(2 * norm.sf(size) * len(self.shift))


def _untrusted_windows(found: Inference, limits: TrustLimits) -> str:
    k = len(found.verdicts) // 2
    return f"no window can be trusted; that in the middle: {found.verdicts.verdict[k]}, {found.verdicts.reason[k]}"


RULES: tuple[Rule[Inference], ...] = (
    Rule(
        "draws that can be believed",
        UNCONVERGED,
        lambda found, limits: bool(found.summarised[0].why),
        lambda found, limits: found.summarised[0].why,
    ),
    Rule(
        "a window that can be trusted",
        WEAK,
        lambda found, limits: found.windows is not None and not found.verdicts.trusted.any(),
        _untrusted_windows,
    ),
    Rule(
        "windows that agree",
        POOR,
        lambda found, limits: found.windows is not None and not found.contradiction[1] >= CONTRADICTION,
        lambda found, limits: (
            f"the windows contradict each other in {found.contradiction[0]} (p = {found.contradiction[1]:.1g}): it "
            "changes, or the model lacks something, and the whole record's draws are those of an average; look at the "
            "windows"
        ),
    ),
    Rule(
        "noise that is noise",
        POOR,
        lambda found, limits: found.windows is not None and not found.shifted[2] >= CONTRADICTION,
        lambda found, limits: (
            f"what the residuals have in common, taken for noise, moves {found.shifted[0]} by {found.shifted[1]:.2g} "
            "standard errors: it is no noise, but something that the model lacks"
        ),
    ),
)
"""What the draws of a whole record must be to be trusted."""


def posterior_of(
    pipeline: Pipeline,
    settings: PosteriorSettings,
    recording: Recording,
    alone: RobotAlone = None,
    progress: Progress = lambda share: None,
) -> Inference:
    """Posteriors of a recording: of its whole record, and of windows that share no sample.

    **Raises:** `ValueError` with one line that names the cause and the remedy: filters inside every window, parameters
    that the data leave undetermined, an impossible prior, and as `prepare`.
    """
    require_float64(recording.position)
    if not pipeline.once:
        raise ValueError("posteriors need filters that run over the recording once: set filter.mode = 'once'")
    prepared = prepare(pipeline, recording, alone)
    data = _data(settings, prepared)
    progress(0.2)
    whole = data.posterior()
    progress(0.5)
    place, verdicts = _judged(prepared)
    windows, start, left_out = data.windows(place.starts, place.window)
    progress(0.9)
    left = residuals(data.white, optimum(data.white))
    time, y, kept = prepared.rows.time, data.y.reshape(len(data.y), -1), np.isin(place.starts, start)
    return Inference(
        whole=whole,
        windows=windows,
        start=time[start],
        end=time[start + place.window - 1],
        verdicts=verdicts[kept],
        left_out=tuple(f"{time[first]:.4g} s: {why}" for first, why in left_out),
        gains=_gains(data.model),
        noise=data.noise,
        whiteness=tuple(_whiteness(data, left[:, k], k) for k in range(left.shape[1])),
        bias=data.bias,
        shift=disagreement(data.W, data.y, data.noise, data.valid, data.difference),
        constant=np.array([role.kind == "offset" for role in data.model.roles]),
        held_out=data.held_out(),
        prior=prior_predictive(data.prior, data.W[data.valid], data.y[data.valid]),
        time=time,
        torque=np.where(data.valid.reshape(y.shape), y, np.nan),
        bands=torque_bands(whole.samples, data.W, LEVELS, heavy_tails=settings.heavy_tails).reshape(
            len(LEVELS), *y.shape
        ),
        notes=recording.notes,
    )


def _whiteness(data: _Data, left: Numbers, k: int) -> Whiteness:
    """Of an output's residuals, over more lags than its autoregression was fitted to."""
    fitted = len(data.noise.autoregression[k]) if data.noise.autoregression else 0
    return whiteness(left, data.white.valid[:, k], max(LAGS, fitted + 10) if fitted else None, fitted)


def compare_models(first: Inference, second: Inference) -> tuple[float, float]:
    """By how much the first model predicts the held-out torque better than the second, and its standard error.

    The mean difference of the log predictive density per row, over rows that count for both: of the same recording
    through the same filters. Every model has its own size of noise, and no autoregression.

    **Example:**

    ```pycon
    >>> from pathlib import Path  # doctest: +SKIP
    >>> text = Path("examples/ankle.toml").read_text()  # doctest: +SKIP
    >>> without = text.replace("human = true", "human = { offset = false }")  # doctest: +SKIP
    >>> first = jaximp.infer(jaximp.parse_job(text, Path("examples")))  # doctest: +SKIP
    >>> second = jaximp.infer(jaximp.parse_job(without, Path("examples")))  # doctest: +SKIP
    >>> gain, stderr = jaximp.compare_models(first, second)  # doctest: +SKIP
    >>> print(gain > 2 * stderr)  # doctest: +SKIP

    ```
    """
    if first.held_out is None or second.held_out is None:
        raise ValueError("half of the record does not determine one of the models: there is no score to compare")
    if first.held_out.shape != second.held_out.shape:
        raise ValueError("scores compare between models of the same torque, through the same filters: these are others")
    return mean_score(_counted(first.held_out - second.held_out))


def _counted(scores: Numbers) -> Numbers:
    """Of every row in which some output counts."""
    return np.nansum(scores[np.isfinite(scores).any(axis=1)], axis=1)


def sentences(posterior: Posterior, names: Sequence[str]) -> list[str]:
    """What a paper says of each parameter: median and 95 % credible interval."""
    lines = []
    for name in names:
        low, middle, high = np.quantile(posterior[name], [0.025, 0.5, 0.975])
        unit = posterior.units[posterior.names.index(name)]
        lines.append(f"{name} {middle:.4g} {unit} (95 % credible interval {low:.4g} to {high:.4g})")
    return lines


@dataclass(frozen=True)
class _Data:
    """Rows of one model, and what is known besides them."""

    settings: PosteriorSettings
    model: Model
    W: Numbers
    """(N, *n, p)"""
    y: Numbers
    """(N, *n) [N m]"""
    valid: AnyArray
    """(N, *n)"""
    difference: Numbers
    """(N, *n, p) what noise of the position makes of the columns."""
    filtered: AnyArray | None
    """What the filters make of white noise, by lag."""
    stretch: int
    """Rows of a window."""
    prior: Prior
    autoregressive: bool = True
    """Whether the noise may follow from itself, where the residuals demand it."""

    @cached_property
    def noise(self) -> Noise:
        if not self.autoregressive:
            return Noise() if self.filtered is None else Noise(np.asarray(self.filtered))
        return fit_noise(self.W, self.y, self.filtered, self.valid, self.stretch)

    @cached_property
    def white(self) -> WhiteRows:
        return whiten(self.W, self.y, self.noise, self.valid)

    @cached_property
    def column_noise(self) -> Numbers:
        """(n, p, p) covariance of what noise of the position leaves in the whitened columns."""
        return whitened_covariance(self.difference, self.noise, self.valid)

    @cached_property
    def bias(self) -> Numbers:
        return attenuation(self.white, self.column_noise)

    @property
    def is_exact(self) -> bool:
        return len(self.white.count) == 1 and not any(self.prior.proper) and not self.settings.heavy_tails

    def within(self, rows: slice) -> _Data:
        """A part of the record, with noise of its own."""
        W, y, valid, difference = (x[rows] for x in (self.W, self.y, self.valid, self.difference))
        return replace(self, W=W, y=y, valid=valid, difference=difference)

    def posterior(self) -> Posterior:
        """Of all rows."""
        if self.is_exact:
            return self._exact(self.white, jax.random.key(self.settings.seed))
        density = self._density(self.white)
        return sample_posterior(density, ess=self.settings.ess, seed=self.settings.seed)

    def _exact(self, rows: WhiteRows, key: jax.Array) -> Posterior:
        given, names, units = triangles(rows, self.column_noise)[0], self.model.names, self.model.units
        why = undetermined(given[None], rows.count, make_prior((*names, *noise_names(1))))
        if why:
            raise ValueError(why)
        exact = exact_posterior(given, float(rows.count[0]), names, units)
        return exact.posterior(key, round(4 * self.settings.ess))

    def _density(self, rows: WhiteRows) -> Density:
        heavy = self.settings.heavy_tails
        column_noise = None if heavy else self.column_noise
        names, units = self.model.names, self.model.units
        return linear_density(names, units, rows, self.prior, heavy_tails=heavy, column_noise=column_noise)

    def windows(self, starts: AnyArray, length: int) -> tuple[PosteriorMany | None, AnyArray, list[tuple[int, str]]]:
        """Posteriors of windows, the first row of each, and why others have none."""
        parts = [slice(first, first + length) for first in starts]
        white = [whiten(self.W[part], self.y[part], self.noise, self.valid[part]) for part in parts]
        drawn, reasons = self._exact_windows(white) if self.is_exact else self._sampled_windows(white)
        without = [(int(first), why) for first, why in zip(starts, reasons, strict=True) if why]
        kept = np.array([first for first, why in zip(starts, reasons, strict=True) if not why], int)
        return drawn, kept, without

    def _exact_windows(self, parts: Sequence[WhiteRows]) -> tuple[PosteriorMany | None, list[str]]:
        key, drawn, reasons = jax.random.key(self.settings.seed + 1), [], [""] * len(parts)
        for k, rows in enumerate(parts):
            try:
                drawn.append(self._exact(rows, jax.random.fold_in(key, k)))
            except ValueError as error:
                reasons[k] = str(error)
        return (stacked(drawn) if drawn else None), reasons

    def _sampled_windows(self, parts: Sequence[WhiteRows]) -> tuple[PosteriorMany | None, list[str]]:
        settings = self.settings
        column_noise = None if settings.heavy_tails else self.column_noise
        key = jax.random.key(settings.seed + 1)
        try:
            densities, reasons = window_densities(
                self.model.names, self.model.units, parts, self.prior,
                heavy_tails=settings.heavy_tails, column_noise=column_noise,
            )  # fmt: skip
            starts, covariances = (np.asarray(x) for x in _laplace(densities))
            if find_spec("blackjax") is None:
                names, units = labels(densities, starts.shape[1], None, None)
                return normal_many(starts, covariances, key, ess=settings.ess, names=names, units=units), list(reasons)
            return sample_many(densities, starts, covariances, key, ess=settings.ess), list(reasons)
        except ValueError as error:
            return None, [str(error)] * len(parts)

    def held_out(self) -> Numbers | None:
        """Scores of the second half by the first.

        The noise is the filters' alone: with an autoregression the torque just before would predict what the model does
        not, and models that lack something would score as well as others.
        """
        half, plain = len(self.y) // 2, replace(self, autoregressive=False)
        first, second = plain.within(slice(half)), plain.within(slice(half, None))
        try:
            samples = first.posterior().samples
        except ValueError:
            return None
        rows = whiten(second.W, second.y, first.noise, second.valid)
        heavy = self.settings.heavy_tails
        scores = np.where(rows.valid, log_scores(samples, rows, heavy_tails=heavy), np.nan)
        return scores if rows.valid.sum() > 1 else None


@eqx.filter_jit
@eqx.filter_vmap
def _laplace(density: Density) -> tuple[jax.Array, jax.Array]:
    return density.laplace()


def _data(settings: PosteriorSettings, prepared: Prepared) -> _Data:
    """Rows and prior; robot and human stand side by side in those of both."""
    rows, model = prepared.rows, prepared.model if prepared.pair is None else prepared.pair.robot + prepared.model
    W, y, valid, noisy = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid, rows.noisy))
    prior = _prior(settings, prepared, model, 1 if y.ndim == 1 else y.shape[1])
    window = place_windows(prepared.pipeline, rows).window
    return _Data(settings, model, W, y, valid, noisy, prepared.noise, window, prior)


def _prior(settings: PosteriorSettings, prepared: Prepared, model: Model, outputs: int) -> Prior:
    """As it is given; and of the robot, what its own recordings tell, and how far it may have changed."""
    blocks = []
    if prepared.pair is not None:
        robot, fit = prepared.pair.robot, prepared.pair.robot_fit
        names = model.names[: len(robot.names)]
        covariance = np.asarray(fit.covariance) + prepared.pair.change
        blocks = [MultivariateNormal(names, np.asarray(fit.theta), covariance)]
    return make_prior((*model.names, *noise_names(outputs)), settings.prior, blocks)


def _gains(model: Model) -> dict[str, Numbers]:
    """Of every reflex, joint by joint, what makes its gain of the parameters."""
    found, parts = {}, model.models if isinstance(model, Joints) else (model,)
    for j, part in enumerate(parts):
        if part.memory:
            pathway, tag = pathway_of(part), f"joint{j + 1}." if len(parts) > 1 else ""
            weights = [f"{tag}{column}" for column in pathway.columns]
            of_weights = np.array([column in weights for column in model.columns])
            named = model.names[int(np.argmax(of_weights))]  # of a weight, with the prefix of robot or human
            prefix = named[: named.index("reflex_")]
            found[f"{prefix}reflex_gain"] = np.where(of_weights, float(pathway.direction), 0.0)
    return found


def _judged(prepared: Prepared) -> tuple[Placement, Verdicts]:
    """Windows one behind the other, and what `identify` says of each."""
    length = prepared.pipeline.window.length
    apart = replace(prepared.pipeline.with_window(length, length), methods=(1,))  # whose rows are the posterior's
    prepared = replace(prepared, pipeline=apart)
    return place_windows(apart, prepared.rows), in_windows(prepared)[0].verdicts
