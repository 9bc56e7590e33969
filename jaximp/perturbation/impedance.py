"""Impedance of an arm from perturbed movements: isolated deviations, the fit, and whether to believe it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Num

from jaximp.models.inertia import BASE_INERTIA
from jaximp.perturbation.deviations import Deviations, KnownArm
from jaximp.perturbation.estimate import ArmEstimate, Curves, Evidence
from jaximp.perturbation.isolation.methods import METHODS, isolate
from jaximp.perturbation.rules import judge, warnings_of
from jaximp.perturbation.sensors import handle_disagreement
from jaximp.perturbation.stiffness import ELEMENTS, MATRICES, MATRIX_OF
from jaximp.perturbation.trial_fits import as_given, fit_deviations, with_torques
from jaximp.perturbation.trials import VOLUNTARY_DELAY, Trials, in_window
from jaximp.results import Column
from jaximp.trust.limits import TrustLimits
from jaximp.trust.verdicts import TRUSTED, Verdict
from jaximp.types import AnyArray, Numbers

USUAL = TrustLimits()


@dataclass(frozen=True)
class ArmImpedance(ArmEstimate):
    """Damping and stiffness of an arm's joints by one method, and whether to believe them.

    The verdict is no field: the rules make it of the numbers that stand beside it, whoever puts them there.

    **Example:**

    ```pycon
    >>> found = jaximp.identify_trials(jaximp.read_job("arm/job.toml")).main  # doctest: +SKIP
    >>> print(found.D, found.K, found.trusted, found.reason)  # doctest: +SKIP

    ```
    """

    limits: TrustLimits

    @cached_property
    def judged(self) -> Verdict:
        """By `rules.RULES`."""
        return judge(self, self.limits)

    @property
    def verdict(self) -> str:
        """One of `trust.VERDICTS`."""
        return self.judged.label

    @property
    def reason(self) -> str:
        """Cause with its measured number, and remedy; empty where the estimate is trusted."""
        return self.judged.in_words()

    @property
    def trusted(self) -> bool:
        return self.verdict == TRUSTED

    def columns(self) -> list[Column]:
        """One row: as the method's in `estimates.parquet`, whatever symmetry it assumes."""
        columns = [
            Column("method", "", self.method),
            Column("window_s", "s", self.window),
            Column("trials", "1", self.trials),
        ]
        for name in sorted(ELEMENTS):
            k = self.names.index(name if name in self.names else "stiffness_12")
            unit = MATRICES[MATRIX_OF[name]]
            columns += [Column(name, unit, self.theta[k]), Column(f"{name}_stderr", unit, self.stderr[k])]
        for name in BASE_INERTIA:
            columns += [
                Column(name, "kg m^2", self.inertia[name]),
                Column(f"{name}_stderr", "kg m^2", self.inertia_stderr[name]),
            ]
        return [
            *columns,
            Column("unperturbed", "1", self.unperturbed),
            Column("delay_s", "s", np.nan if self.own is None else float(self.own.delay)),
            Column("misfit", "1", np.nan if self.misfit is None else self.misfit),
            Column("dof", "1", self.dof),
            Column("vaf", "1", self.vaf),
            Column("held_out_vaf", "1", self.held_out_vaf),
            Column("verdict", "", self.verdict),
            Column("reason", "", self.reason),
        ]

    @cached_property
    def warnings(self) -> tuple[str, ...]:
        """What does not change the verdict, and must be known with it."""
        return warnings_of(self, self.limits)


def identify_impedance(
    perturbed: Trials,
    unperturbed: Trials | None,
    arm: KnownArm,
    method: str,
    window: float = VOLUNTARY_DELAY,
    cutoff: Num[AnyArray, "2"] | None = None,
    limits: TrustLimits = USUAL,
) -> ArmImpedance:
    """Isolate what the perturbations changed, fit damping and stiffness of the joints to it, and judge the estimate.

    A method that estimates the impedance itself is taken at its word; to the deviations of the others D and a
    symmetric, positive semidefinite K are fitted (to those of a linearised one a K of four free numbers). Standard
    errors come from how much the trials contradict each other, and from those of the inertia.

    **Arguments:** trials as `read_trials` makes them; `method` is a key of `isolation.METHODS`; `window` [s] after the
    onset; `cutoff` (2,) [Hz] for methods that have a high-pass; `limits` of what is trusted.

    **Raises:** `ValueError` for a method that does not exist, and what the method raises.

    **Example:**

    ```pycon
    >>> perturbed, unperturbed, notes = jaximp.read_job("arm/job.toml").trials.load()  # doctest: +SKIP
    >>> geometry = jaximp.models.ArmGeometry(lengths=(0.29, 0.34))  # doctest: +SKIP
    >>> arm = jaximp.perturbation.KnownArm(geometry, (0.35, 0.08, 0.07))  # doctest: +SKIP
    >>> found = jaximp.identify_impedance(perturbed, unperturbed, arm, "gomi_kawato")  # doctest: +SKIP

    ```
    """
    found = isolate(perturbed, unperturbed, arm, method, window, cutoff)
    own, linearised = found.impedance, METHODS[method].linearised
    body = arm if own is None else arm.with_inertia(own.inertia)
    joint, moved = with_torques(perturbed, found.deviations, body, linearised)
    fitted = fit_deviations(joint, moved, linearised) if own is None else as_given(own)
    at_onset = in_window(perturbed, 1)
    disagreement, about_handle = handle_disagreement(perturbed, arm.handle)
    return ArmImpedance(
        method=method,
        window=window,
        trials=len(perturbed),
        unperturbed=0 if unperturbed is None else len(unperturbed),
        theta=fitted.theta,
        covariance=fitted.covariance,
        dof=fitted.dof,
        vaf=fitted.vaf,
        held_out_vaf=fitted.held_out_vaf,
        arm=arm,
        own=own,
        position=np.asarray(at_onset.position).reshape(-1, 2).mean(axis=0),
        evidence=Evidence(
            failure=fitted.failure,
            on_boundary=fitted.on_boundary,
            asked=fitted.asked,
            disagreement=disagreement,
            about_handle=about_handle,
            speed=float(np.linalg.norm(np.asarray(at_onset.velocity)[:, 0], axis=-1).mean()),
            deviation=_at_the_end(found.deviations),
        ),
        curves=Curves(found.deviations, joint, _numbers(found.cutoff), perturbed.sample_rate),
        limits=limits,
    )


def _at_the_end(deviations: Deviations) -> float:
    """Root mean square of the hand's deviation at the end of the window [m]."""
    farthest = np.linalg.norm(np.asarray(deviations.position)[:, -1], axis=-1)
    return float(np.sqrt((farthest**2).mean()))


def _numbers(cutoff: AnyArray | None) -> Numbers | None:
    return None if cutoff is None else np.asarray(cutoff, float)
