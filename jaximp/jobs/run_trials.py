"""Run a job with `[trials]`: read the trials, know the arm, and identify its impedance by every method asked for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from jaximp.jobs.job import Job, TrialsJob
from jaximp.numerics.precision import require_float64
from jaximp.perturbation.deviations import KnownArm
from jaximp.perturbation.impedance import ArmImpedance, identify_impedance
from jaximp.perturbation.isolation.feedback_jerk import energy_spectra
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.perturbation.static import StaticFit, static_inertia
from jaximp.perturbation.trials import Trials
from jaximp.perturbation.trials_result import TrialsResult
from jaximp.perturbation.window_lengths import at_other_windows
from jaximp.posterior.arm import ArmInference
from jaximp.posterior.densities import estimate_density
from jaximp.posterior.draws import derive
from jaximp.posterior.ensemble import sample_posterior
from jaximp.types import Progress, nearest


def identify_trials(job: Job, progress: Progress = lambda share: None) -> TrialsResult:
    """Run a job with `[trials]`. It writes no files.

    **Raises:** `ValueError` with one line that names the cause and the remedy.

    **Example:**

    ```pycon
    >>> job = jaximp.read_job("arm/job.toml")  # by `jaximp simulate arm --out arm`  # doctest: +SKIP
    >>> found = jaximp.identify_trials(job).main  # doctest: +SKIP
    >>> print(found.K, found.verdict, found.reason)  # doctest: +SKIP

    ```
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
