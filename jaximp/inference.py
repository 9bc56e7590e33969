"""Posteriors of a job: of its whole record, and of windows that share no sample with each other.

A model of one output whose noise is Gaussian and whose prior is flat has an exact posterior; others are sampled. The
noise is what the filters make of white noise, with an autoregression where the residuals demand one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import equinox as eqx
import jax
import numpy as np
from scipy.signal import lfilter
from scipy.stats import chi2

from jaximp.identify import Prepared, prepare
from jaximp.impedance import ArmImpedance, identify_trials
from jaximp.job import Job
from jaximp.likelihood import estimate_density, linear_density, noise_names, window_densities
from jaximp.models import Model
from jaximp.noise import Noise, Whiteness, WhiteRows, fit_noise, optimum, residuals, whiten, whiteness
from jaximp.posterior import Posterior, PosteriorMany, derive, exact_posterior, probability_greater, stacked
from jaximp.predictive import PriorPredictive, log_score, prior_predictive, torque_bands
from jaximp.priors import MultivariateNormal, Prior, make_prior
from jaximp.regression import windows_in_rows
from jaximp.samplers import sample_many, sample_posterior
from jaximp.signals import require_float64
from jaximp.types import Numbers, Progress, Recording

CONTRADICTION = 1e-3
"""Windows whose parameters differ more than this is probable contradict each other."""
REACH = 2000
"""Rows after which an autoregression has forgotten."""
LEVELS = (0.025, 0.25, 0.5, 0.75, 0.975)
"""Of the bands of torque."""


@dataclass(frozen=True)
class Change:
    """How probable it is that a parameter is greater in a later window than in the one before."""

    parameter: str
    windows: tuple[int, int]
    probability: float
    error: float
    """Monte Carlo standard error."""


@dataclass(frozen=True)
class Inference:
    """What a recording tells of the parameters, in draws."""

    whole: Posterior
    """Of the whole record, as if nothing changed in it."""
    windows: PosteriorMany | None
    """Of the windows that determine all parameters; None where there is none."""
    start: Numbers
    """(M,) of each of them [s]."""
    end: Numbers
    """(M,) [s]"""
    left_out: tuple[str, ...]
    """Why other windows have none."""
    changes: tuple[Change, ...]
    noise: Noise
    whiteness: tuple[Whiteness, ...]
    """Of the whitened residuals of each output."""
    score: tuple[float, float] | None
    """Mean log predictive density of the second half of the record from the first, per independent row, and its
    standard error; None where it was not tried."""
    prior: PriorPredictive
    time: Numbers
    """(N,) [s]"""
    torque: Numbers
    """(N, n), filtered; NaN where it did not count [N m]."""
    bands: Numbers
    """(5, N, n) quantiles `LEVELS` of the torque that the whole record's posterior predicts."""
    notes: tuple[str, ...] = ()

    @property
    def why(self) -> str:
        """Why the posterior of the whole record cannot be trusted; empty where it can.

        The windows must not contradict each other: the squares of their differences from the common mean, in standard
        deviations, are those of chi-squared where nothing changes (Cochran 1954).
        """
        if self.whole.why or self.windows is None or self.windows.ok.sum() < 2:
            return self.whole.why
        samples = self.windows.samples[self.windows.ok]
        mean, variance = samples.mean(axis=1), samples.var(axis=1)
        common = (mean / variance).sum(axis=0) / (1 / variance).sum(axis=0)
        squares = ((mean - common) ** 2 / variance).sum(axis=0)
        p = chi2.sf(squares, len(samples) - 1)
        told = [k for k, name in enumerate(self.whole.names) if not name.startswith("log_noise")]
        worst = min(told, key=lambda k: float(p[k]))
        if p[worst] >= CONTRADICTION:
            return ""
        return (
            f"the windows contradict each other in {self.whole.names[worst]} (p = {p[worst]:.1g}): it changes, or the "
            "model lacks something, and the whole record's draws are those of an average; look at the windows"
        )

    @property
    def inside(self) -> float:
        """Share of the torque within the 95 % band."""
        counted = np.isfinite(self.torque)
        within = (self.torque >= self.bands[0]) & (self.torque <= self.bands[-1])
        return float(within[counted].mean())


def infer(job: Job, progress: Progress = lambda share: None) -> Inference:
    """Posteriors of a job with a recording.

    **Raises:** `ValueError` with one line that names the cause and the remedy: filters inside every window, parameters
    that the data leave undetermined, an impossible prior, and as `prepare`.
    """
    return infer_recording(job, job.load(), job.load_robot_alone(), progress)


def infer_recording(
    job: Job, recording: Recording, alone: Recording | None = None, progress: Progress = lambda share: None
) -> Inference:
    """As `infer`, for recordings that are in memory."""
    require_float64(recording.position)
    if job.filter.mode != "once":
        raise ValueError("posteriors need filters that run over the recording once: set filter.mode = 'once'")
    prepared = prepare(job, recording, alone)
    rows, model = prepared.rows, _model(prepared)
    W, y, valid = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid))
    noise = fit_noise(W, y, prepared.noise, valid)
    prior = _prior(job, prepared, model, 1 if y.ndim == 1 else y.shape[1])
    white = whiten(W, y, noise, valid)
    progress(0.2)
    whole = _whole(job, model, white, prior)
    progress(0.6)
    windows, start, end, left_out = _windows(job, prepared, model, noise, prior)
    progress(0.9)
    left = residuals(white, optimum(white))
    bands = torque_bands(_of_rows(whole.samples, noise, len(model.names)), W, LEVELS)
    return Inference(
        whole=whole,
        windows=windows,
        start=start,
        end=end,
        left_out=left_out,
        changes=_changes(windows, start, end, model),
        noise=noise,
        whiteness=tuple(whiteness(left[:, k], white.valid[:, k]) for k in range(left.shape[1])),
        score=_score(job, model, W, y, valid, noise, prior),
        prior=prior_predictive(prior, W[valid], y[valid]),
        time=rows.time,
        torque=np.where(valid, y, np.nan).reshape(len(y), -1),
        bands=bands.reshape(len(LEVELS), len(y), -1),
        notes=recording.notes,
    )


def infer_trials(job: Job, progress: Progress = lambda share: None) -> tuple[ArmImpedance, Posterior]:
    """An arm's damping and stiffness from a job with `[trials]`: the estimate, and draws of D11 to K22 around it.

    Student's t with the estimate's covariance and degrees of freedom, within positive definite stiffnesses.

    **Raises:** `ValueError` for an estimate without standard errors, and as `identify_trials`.
    """
    found = identify_trials(job, lambda share: progress(0.8 * share)).main
    if not np.isfinite(found.covariance).all():
        raise ValueError(f"the impedance has no standard errors, and so no posterior: {found.reason}")
    density = estimate_density(found.names, found.units, found.theta, found.covariance, found.dof)
    drawn = sample_posterior(density, ess=job.posterior.ess, seed=job.posterior.seed)
    progress(1.0)
    return found, derive(drawn, density.elements, density.element_names, density.element_units)


def _model(prepared: Prepared) -> Model:
    """Of the columns of the rows: robot and human stand side by side in those of both."""
    return prepared.model if prepared.pair is None else prepared.pair.robot + prepared.model


def _prior(job: Job, prepared: Prepared, model: Model, outputs: int) -> Prior:
    """As the job gives it; and of the robot, what its own recording tells."""
    blocks = []
    if prepared.pair is not None:
        robot, fit = prepared.pair.robot, prepared.pair.robot_fit
        names = model.names[: len(robot.names)]
        blocks = [MultivariateNormal(names, np.asarray(fit.theta), np.asarray(fit.covariance))]
    return make_prior((*model.names, *noise_names(outputs)), job.posterior.prior, blocks)


def _is_exact(job: Job, prior: Prior, outputs: int) -> bool:
    return outputs == 1 and not any(prior.proper) and not job.posterior.heavy_tails


def _whole(job: Job, model: Model, white: WhiteRows, prior: Prior) -> Posterior:
    """Exact where it can be; else by emcee."""
    settings = job.posterior
    density = linear_density(model.names, model.units, white, prior, heavy_tails=settings.heavy_tails)
    if not _is_exact(job, prior, len(white.count)):
        return sample_posterior(density, ess=settings.ess, seed=settings.seed)
    exact = exact_posterior(white.triangles()[0], float(white.count[0]), model.names, model.units)
    return exact.posterior(jax.random.key(settings.seed), round(4 * settings.ess))


def _windows(
    job: Job, prepared: Prepared, model: Model, noise: Noise, prior: Prior
) -> tuple[PosteriorMany | None, Numbers, Numbers, tuple[str, ...]]:
    """Posteriors of windows one behind the other, where each begins and ends, and why others have none."""
    rows = prepared.rows
    W, y, valid = (np.asarray(x) for x in (rows.W, rows.torque, rows.valid))
    length = windows_in_rows(job, prepared.recording, rows, prepared.filters).window
    starts = np.arange(0, len(y) - length + 1, length)
    settings, found, reasons = job.posterior, [], []
    key = jax.random.key(settings.seed + 1)
    outputs = 1 if y.ndim == 1 else y.shape[1]
    if _is_exact(job, prior, outputs):
        for k, first in enumerate(starts):
            cut = slice(first, first + length)
            try:
                white = whiten(W[cut], y[cut], noise, valid[cut])
                exact = exact_posterior(white.triangles()[0], float(white.count[0]), model.names, model.units)
            except ValueError as error:
                reasons.append(str(error))
                continue
            reasons.append("")
            found.append(exact.posterior(jax.random.fold_in(key, k), round(4 * settings.ess)))
        windows = stacked(found) if found else None
    else:
        densities, why = window_densities(model.names, model.units, W, y, starts, length, noise, valid, prior)
        modes, covariances = eqx.filter_vmap(lambda density: density.laplace())(densities)
        windows = sample_many(densities, np.asarray(modes), np.asarray(covariances), key, ess=settings.ess)
        reasons = list(why)
    usable = starts[[not why for why in reasons]]
    if windows is not None:
        usable_reasons = iter(windows.why)
        reasons = [why or next(usable_reasons) for why in reasons]
    left_out = tuple(f"{rows.time[first]:.4g} s: {why}" for first, why in zip(starts, reasons, strict=True) if why)
    return windows, rows.time[usable], rows.time[usable + length - 1], left_out


def _of_rows(samples: Numbers, noise: Noise, p: int) -> Numbers:
    """Samples whose noise is that of a row, where an autoregression makes it larger than what is new in it."""
    samples = samples.copy()
    for k, coefficients in enumerate(noise.autoregression):
        answer = lfilter([1.0], [1.0, *-np.asarray(coefficients)], np.eye(1, REACH)[0])
        samples[:, p + k] += np.log(answer @ answer) / 2
    return samples


def _changes(windows: PosteriorMany | None, start: Numbers, end: Numbers, model: Model) -> tuple[Change, ...]:
    """Of every parameter, from each window that can be trusted to the next."""
    if windows is None:
        return ()
    good = [int(k) for k in np.flatnonzero(windows.ok)]
    changes = []
    for before, after in pairwise(good):
        spans = ((start[after], end[after]), (start[before], end[before]))
        for name in model.names:
            found = probability_greater(windows[after], windows[before], name, spans=spans)
            changes.append(Change(name, (before, after), *found))
    return tuple(changes)


def _score(
    job: Job, model: Model, W: Numbers, y: Numbers, valid: Numbers, noise: Noise, prior: Prior
) -> tuple[float, float] | None:
    """How well the first half of the record predicts the second, where that costs nothing."""
    if not _is_exact(job, prior, 1 if y.ndim == 1 else y.shape[1]):
        return None
    half = len(y) // 2
    try:
        first, second = (whiten(W[part], y[part], noise, valid[part]) for part in (slice(half), slice(half, None)))
        exact = exact_posterior(first.triangles()[0], float(first.count[0]), model.names, model.units)
    except ValueError:
        return None
    return log_score(np.asarray(exact.samples(jax.random.key(job.posterior.seed), 2000)), second)


def sentences(posterior: Posterior, names: Sequence[str]) -> list[str]:
    """What a paper says of each parameter: median and 95 % credible interval."""
    lines = []
    for name in names:
        low, middle, high = np.quantile(posterior[name], [0.025, 0.5, 0.975])
        unit = posterior.units[posterior.names.index(name)]
        lines.append(f"{name} {middle:.4g} {unit} (95 % credible interval {low:.4g} to {high:.4g})")
    return lines
