"""Run a job with `[trials]`: read the trials, know the arm, and identify its impedance by every method asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from jaximp.jobs.job import Job, TrialsJob
from jaximp.numerics.precision import require_float64
from jaximp.perturbation.deviations import KnownArm
from jaximp.perturbation.impedance import ArmImpedance, identify_impedance
from jaximp.perturbation.isolation.feedback_jerk import energy_spectra
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.perturbation.static import StaticFit, static_inertia
from jaximp.perturbation.trials import Trials
from jaximp.perturbation.window_lengths import OtherWindows, at_other_windows
from jaximp.posterior.densities import estimate_density
from jaximp.posterior.draws import Posterior, credible_interval, derive
from jaximp.posterior.ensemble import sample_posterior
from jaximp.results import Column, Result
from jaximp.trust.verdicts import TRUSTED, UNCONVERGED
from jaximp.types import Numbers, Progress, nearest


@dataclass(frozen=True)
class TrialsResult:
    """What a job with `[trials]` gives."""

    estimates: tuple[ArmImpedance, ...]
    """By every method that was asked for, the main one first."""
    windows: OtherWindows | None
    """By the main method, from other windows."""
    spectra: tuple[Numbers, Numbers, Numbers] | None
    """Of the jerk, where there are unperturbed trials: `energy_spectra`."""
    static: StaticFit | None
    """What `[trials.posture]` tells."""
    postures: int = 0
    """Trials of it."""
    notes: tuple[str, ...] = ()
    """What reading the trials says."""

    @property
    def main(self) -> ArmImpedance:
        return self.estimates[0]

    def __len__(self) -> int:
        return len(self.estimates)

    def __getitem__(self, k: int) -> ArmImpedance:
        """By the k-th method."""
        return self.estimates[k]

    def __iter__(self) -> Iterator[ArmImpedance]:
        return iter(self.estimates)


@dataclass(frozen=True)
class ArmInference(Result):
    """An arm's impedance in draws around its main estimate."""

    identified: TrialsResult
    """What the draws stand around."""
    posterior: Posterior
    """Of damping, stiffness and all that follows from them."""

    @property
    def names(self) -> tuple[str, ...]:
        return self.posterior.names

    @property
    def units(self) -> tuple[str, ...]:
        return self.posterior.units

    @property
    def value(self) -> Numbers:
        """(p,) means of the draws."""
        return self.posterior.mean

    @property
    def stderr(self) -> Numbers:
        """(p,) standard deviations of the draws."""
        return np.sqrt(np.diagonal(self.posterior.covariance))

    @property
    def covariance(self) -> Numbers:
        """(p, p) of the draws."""
        return self.posterior.covariance

    @property
    def dof(self) -> float:
        """Intervals are quantiles of the draws: no distribution is assumed."""
        return np.inf

    def interval(self, level: float = 0.95) -> tuple[Numbers, Numbers]:
        """(p,) lower and upper ends of credible intervals, with equal probability on both sides."""
        return credible_interval(self.posterior.samples, level)

    @property
    def why(self) -> str:
        """Why the draws, or the estimate that they stand around, cannot be trusted; empty where they can."""
        found = self.identified.main
        return self.posterior.why or ("" if found.verdict == TRUSTED else f"{found.verdict}: {found.reason}")

    @property
    def trusted(self) -> bool:
        """Whether nothing speaks against the draws, see `why`."""
        return not self.why

    def columns(self) -> list[Column]:
        """One row: mean and standard deviation of the draws, verdict and reason."""
        columns = [
            Column(f"{name}{tail}", unit, number)
            for name, unit, *numbers in zip(self.names, self.units, self.value, self.stderr, strict=True)
            for tail, number in zip(("", "_stderr"), numbers, strict=True)
        ]
        verdict = self.identified.main.verdict if not self.posterior.why else UNCONVERGED
        return [*columns, Column("verdict", "", verdict), Column("reason", "", self.why)]


def identify_trials(job: Job, progress: Progress = lambda share: None) -> TrialsResult:
    """Run a job with `[trials]`. It writes no files.

    **Raises:** `ValueError` with one line that names the cause and the remedy.
    """
    require_float64()
    if not isinstance(job, TrialsJob):
        raise ValueError("this job has no [trials]: identify() is for recordings with windows")
    check_trials(job)
    trials, known = job.trials, _Known(job)
    progress(0.1)
    cutoff = None if trials.cutoff is None else np.array(trials.cutoff)
    read: dict[bool, tuple[Trials, Trials | None, tuple[str, ...]]] = {}
    estimates: list[ArmImpedance] = []
    for k, method in enumerate(trials.methods):
        smooth = METHODS[method].smooth
        if smooth not in read:
            read[smooth] = trials.load(smooth)
        progress(0.1 + 0.6 * (k + 0.5) / len(trials.methods))
        perturbed, unperturbed, _ = read[smooth]
        arm = known.arm(METHODS[method].linearised)
        estimates.append(identify_impedance(perturbed, unperturbed, arm, method, trials.window, cutoff, job.trust))
        progress(0.1 + 0.6 * (k + 1) / len(trials.methods))
    main = estimates[0]
    perturbed, unperturbed, notes = read[METHODS[main.method].smooth]
    windows = at_other_windows(perturbed, unperturbed, main.arm, main.method, trials.window, cutoff)
    progress(0.9)
    spectra = None
    if unperturbed is not None and True in read and any(one.curves.cutoff is not None for one in estimates):
        smoothed, free, _ = read[True]
        assert free is not None
        spectra = energy_spectra(smoothed, free)
    progress(1.0)
    said = tuple(note for note in dict.fromkeys((*notes, *known.notes)) if note not in main.warnings)
    return TrialsResult(tuple(estimates), windows, spectra, known.static(False), known.postures, said)


def infer_trials(job: Job, progress: Progress = lambda share: None) -> ArmInference:
    """An arm's damping and stiffness from a job with `[trials]`.

    Student's t with the estimate's covariance and degrees of freedom, within positive definite stiffnesses.

    **Raises:** `ValueError` for an estimate without standard errors, and as `identify_trials`.
    """
    result = identify_trials(job, lambda share: progress(0.8 * share))
    found = result.main
    if not np.isfinite(found.covariance).all():
        raise ValueError(f"the impedance has no standard errors, and so no posterior: {found.reason}")
    density = estimate_density(found.names, found.units, found.theta, found.covariance, found.dof)
    drawn = sample_posterior(density, ess=job.posterior.ess, seed=job.posterior.seed)
    progress(1.0)
    return ArmInference(result, derive(drawn, density.elements, density.element_names, density.element_units))


def check_trials(job: TrialsJob) -> None:
    """**Raises:** `ValueError` for a job whose trials cannot be identified."""
    trials = job.trials
    for method in trials.methods:
        if method not in METHODS:
            raise ValueError(f"trials.method is '{method}': {nearest(method, list(METHODS))}")
    if trials.task == "posture":
        raise ValueError(
            "a job of postures alone tells the inertia and no impedance in motion: put their file into "
            "[trials.posture] of the job with the movements"
        )
    if job.arm.known_inertia is None and trials.posture is None:
        raise ValueError(
            "the arm's inertia is not known: add [trials.posture] with trials of the static task, or "
            "model.arm.inertia = { upper_arm = I_1 + m_2 l1^2, forearm = I_2, coupling = m_2 c_2 l1 } in kg m^2"
        )


class _Known:
    """What a job knows of the arm, read once."""

    def __init__(self, job: TrialsJob):
        self._settings, self._handle = job.arm, job.trials.known_handle()
        self._table = job.trials.posture
        self._found: dict[bool, StaticFit] = {}
        self.notes: tuple[str, ...] = ()
        self.postures = 0
        if self._table is not None:
            with _in_postures():
                self._trials, _, notes = self._table.load()
            self.notes = tuple(f"postures: {note}" for note in notes)
            self.postures = len(self._trials)

    def static(self, linearised: bool) -> StaticFit | None:
        """What the postures tell, where there are some."""
        if self._table is None:
            return None
        if linearised not in self._found:
            geometry = self._settings.geometry()
            with _in_postures():
                self._found[linearised] = static_inertia(self._trials, geometry, self._table.window, linearised)
        return self._found[linearised]

    def arm(self, linearised: bool) -> KnownArm:
        geometry, static = self._settings.geometry(), self.static(linearised)
        if static is not None:
            return KnownArm(geometry, static.inertia, self._handle, static.inertia_stderr)
        given, stderr = self._settings.known_inertia, self._settings.known_stderr
        assert given is not None
        return KnownArm(geometry, given, self._handle, None if stderr is None else stderr.borner)


@contextmanager
def _in_postures() -> Iterator[None]:
    """Errors say which of the two tables is meant."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"[trials.posture]: {error}") from None
