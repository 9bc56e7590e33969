"""Results of perturbation trials on disk: table, summary, figures, and one HTML report that says it all."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaximp import plots
from jaximp.jobs.job import TrialsJob
from jaximp.models.endpoint import Ellipse, ellipse, endpoint_damping, endpoint_stiffness, propagated_stderr
from jaximp.models.inertia import BASE_INERTIA
from jaximp.models.kinematics import ArmGeometry
from jaximp.perturbation.impedance import ArmImpedance
from jaximp.perturbation.isolation.methods import METHODS
from jaximp.perturbation.isolation.output_error import MISFIT
from jaximp.perturbation.stiffness import MATRICES, MATRIX_OF
from jaximp.perturbation.trials_result import TrialsResult
from jaximp.plots.wording import number, percent, pretty_unit
from jaximp.reports.headline import headline_of_arm
from jaximp.reports.pages import (
    Alert,
    Column,
    Page,
    Part,
    Prose,
    Section,
    Table,
    capitalised,
    closing_sections,
    digits,
    figure_sections,
    table_of,
    versions,
    without_nan,
    write_page,
    write_table,
)
from jaximp.trust.verdicts import TRUSTED

if TYPE_CHECKING:
    import pyarrow as pa

    from jaximp.plots.interactive import Live

TITLES = {
    "deviations": "What the perturbations changed",
    "spectra": "Where the movement ends and the perturbation begins",
    "torques": "Joint torques",
    "ellipses": "Impedance at the hand",
    "windows": "Lengths of the window",
    "methods": "Methods",
}
CAPTIONS = {
    "deviations": "The movement that would have been less the perturbed one, at the hand, from the onset on. Trials "
    "that leave the others are worth a look: was the onset found, did the hand hold the handle?",
    "spectra": "Mean energy of the jerk by frequency. The high-pass begins where perturbed trials have more energy on "
    "top than unperturbed ones have at all; what the movement has beyond it passes for an answer to the perturbation.",
    "torques": "Torque of the handle on the joints, less what the inertia takes, against what damping and stiffness "
    "make of the deviations.",
    "ellipses": "Stiffness, damping and inertia that are felt at the hand, where it was at the onset. (A force that "
    "the hand exerts meanwhile adds to its stiffness; that part is left out.)",
    "windows": "The same trials from shorter and longer windows. Where estimates go on changing up to the window that "
    "was chosen, they depend on it; beyond the voluntary delay the arm may answer at will.",
    "methods": "The same trials by other methods; hollow and pale where the estimate is not trusted.",
}
"""Figures in the order of the report, and how to read them."""


def live_figures(result: TrialsResult) -> dict[str, Live]:
    """What a reader can zoom and ask. Figures know no `ArmImpedance`: what they need of it is read here alone."""
    from jaximp.plots import interactive_arm

    main = result.main
    position, force = np.asarray(main.curves.deviations.position), np.asarray(main.curves.deviations.force)
    hands = {METHODS[one.method].short: one.at_hand for one in result.estimates}
    return {
        "deviations": interactive_arm.deviations(position, force, main.curves.sample_rate),
        "ellipses": interactive_arm.ellipses(main.arm.geometry, main.angles, hands),
    }


def write_trials_results(folder: str | Path, result: TrialsResult, job: TrialsJob) -> None:
    """Write `estimates.parquet`, `summary.json`, `report.html` and every figure as a PNG file into a folder."""
    folder, content = Path(folder), summary(result, job)
    write_table(folder / "estimates.parquet", estimates_table(result, job))
    write_page(folder, page(result, content), content)


def pictures(result: TrialsResult) -> dict[str, bytes]:
    """All figures of a report as PNG files."""
    main = result.main
    figures = {"deviations": plots.deviations(main)}
    if main.misfit is None:  # a method that need not know the acceleration well has no torques to show
        figures["torques"] = plots.joint_torques(main)
    figures["ellipses"] = plots.ellipses(
        main.arm.geometry, main.angles, {METHODS[one.method].short: one.at_hand for one in result.estimates}
    )
    if result.spectra is not None:
        cutoff = next((one.curves.cutoff for one in result.estimates if one.curves.cutoff is not None), None)
        figures["spectra"] = plots.jerk_spectra(result.spectra, cutoff)
    if result.windows is not None:
        figures["windows"] = plots.impedance_windows(result.windows, main.window)
    if len(result.estimates) > 1:
        figures["methods"] = plots.impedance_methods(result.estimates)
    return {name: plots.png(figure) for name, figure in figures.items()}


def page(result: TrialsResult, content: dict[str, Any]) -> Page:
    """The report on a `summary`."""
    images, trusted = pictures(result), content["verdict"] == TRUSTED
    alerts = []
    if not trusted:
        heading = f"This estimate cannot be trusted: {content['verdict']}."
        alerts.append(Alert("refusal", heading, [f"{capitalised(content['reason'])}."]))
    if content["warnings"]:
        alerts.append(Alert("caution", items=content["warnings"]))
    notes = [Alert("notes", items=content["notes"])] if content["notes"] else []
    return Page(
        title=content["recording"]["name"],
        subtitle=f"Damping and stiffness of an arm's joints from {content['trials']} perturbed movements, "
        f"{number(1000 * content['window_s'])} ms after the onset, by {content['method_description']}",
        headline=content["headline"],
        sections=[
            Section("", alerts),
            Section("", [_answer(content), *_explained(content)], void=not trusted),
            Section("", notes),
            *figure_sections(images, TITLES, CAPTIONS, {"methods": [_methods(content)]}),
            *closing_sections("Trials, arm and limits", _settings(content), content["job"]),
        ],
        pictures=images,
        live=live_figures(result),
    )


def _answer(content: dict[str, Any]) -> Table:
    rows = []
    for name, value in content["parameters"].items():
        low, high = value["low_95"], value["high_95"]
        interval = "–" if low is None else f"{digits(low, 3)} to {digits(high, 3)}"
        error, unit = digits(value["stderr"], 2), pretty_unit(value["unit"])
        rows.append([f"{MATRIX_OF[name]} {name[-2:]}", digits(value["value"]), error, interval, unit])
    for name, made_of in BASE_INERTIA.items():
        value, error = content["inertia_kgm2"][name], content["inertia_stderr_kgm2"][name]
        rows.append([f"{in_words(name)}, {made_of} (known)", digits(value), digits(error, 2), "", "kg m²"])
    columns = [Column("Parameter", "text"), Column("Estimate", "answer"), Column("Standard error")]
    return Table([*columns, Column("95 % interval"), Column("Unit", "text")], rows)


def _explained(content: dict[str, Any]) -> list[Part]:
    """What the numbers above are, and how well they explain the trials."""
    symmetric = "" if "stiffness_21" in content["parameters"] else "; stiffness 21 is stiffness 12"
    known = any(error is not None for error in content["inertia_stderr_kgm2"].values())
    errors = " and from the standard errors of the inertia" if known else ""
    remark = (
        f"Indices 1 and 2 are shoulder and elbow{symmetric}. The intervals come from how much the trials contradict "
        f"each other{errors}; they do not know what all trials have in common, such as a wrong length of the arm."
    )
    if content["misfit"] is None:
        vaf, held_out = percent(content["vaf"]), percent(content["held_out_vaf"])
        text = (
            f"Damping and stiffness account for {vaf} of the torque that the perturbations make; from half of the "
            f"trials, {held_out} of the torque of the others is predicted."
        )
    else:
        text = f"The residuals are {number(content['misfit'], 3)} times as large as expected (mean squares)."
    return [Prose(remark, remark=True), Prose(text)]


def _methods(content: dict[str, Any]) -> Table:
    several = [content, *content["further_methods"]]
    rows = [
        [
            f"{one['method_short']}: {one['method_description']}",
            one["verdict"],
            percent(one["vaf"]),
            percent(one["held_out_vaf"]),
            one["reason"],
        ]
        for one in several
    ]
    columns = [Column("Method", "text"), Column("Verdict", "text"), Column("VAF"), Column("Held-out VAF")]
    void = [k for k, one in enumerate(several) if one["verdict"] != TRUSTED]
    return Table([*columns, Column("Why", "text")], rows, void)


def summary(result: TrialsResult, job: TrialsJob) -> dict[str, Any]:
    """Everything worth knowing, as plain dictionaries, lists, numbers and text; None where there is no number.

    The main method's results stand at the top level, those of further methods under `further_methods`.
    """
    handle = result.main.arm.handle
    content = {
        **_result(result.main),
        "notes": list(result.notes),
        "further_methods": [_result(one) for one in result.estimates[1:]],
        "window_lengths": _windows(result),
        "endpoint": endpoint(result.main),
        "recording": {
            "name": _name(job),
            "sample_rate_hz": result.main.curves.sample_rate,
            "perturbed": result.main.trials,
            "unperturbed": result.main.unperturbed,
            "postures": result.postures,
        },
        "arm": {
            "lengths_m": list(result.main.arm.geometry.lengths),
            "handle_mass_kg": None if handle is None else np.asarray(handle.mass, float).tolist(),
            "handle_damping_Ns_per_m": None if handle is None else np.asarray(handle.damping, float).tolist(),
            "inertia_from": "given" if result.static is None else "the static task",
        },
        "trust_limits": asdict(job.trust) | {"min_vaf": job.trust.usual_vaf},
        "versions": versions(),
        "job": job.text,
    }
    content = without_nan(content)
    return {"headline": headline_of_arm(content), **content}


def endpoint(found: ArmImpedance) -> dict[str, Any]:
    """Impedance at the hand where it was at the onset, and its ellipses, with the standard errors of D and K."""
    hand = found.at_hand
    content: dict[str, Any] = {"position_m": found.position.tolist(), "angles_rad": found.angles.tolist()}
    for name, unit in (("inertia", "kg"), ("damping", "Ns_per_m"), ("stiffness", "N_per_m")):
        matrix = getattr(hand, name)
        content[f"{name}_{unit}"] = np.asarray(matrix).tolist()
        content[f"{name}_ellipse"] = _in_plain_numbers(ellipse(matrix))
        if name in MATRICES:
            angles, theta, covariance = (jnp.asarray(x) for x in (found.angles, found.theta, found.covariance))
            spread = _ellipse_stderr(found.arm.geometry, angles, theta, covariance, found.names, name)
            content[f"{name}_ellipse_stderr"] = _in_plain_numbers(spread)
    return content


@eqx.filter_jit
def _ellipse_stderr(
    geometry: ArmGeometry, q: Array, theta: Array, covariance: Array, names: tuple[str, ...], matrix: str
) -> Ellipse:
    """At the hand, of the damping or stiffness among estimates."""
    of_hand = endpoint_damping if matrix == "damping" else endpoint_stiffness

    def ellipse_of(theta: Array) -> Ellipse:
        at = {name: theta[k] for k, name in enumerate(names)}
        rows = [[at.get(f"{matrix}_{i}{j}", at[f"{matrix}_12"]) for j in (1, 2)] for i in (1, 2)]
        return ellipse(of_hand(geometry, q, jnp.array(rows)))

    return propagated_stderr(ellipse_of, theta, covariance)


def in_words(name: str) -> str:
    """A parameter as a person reads it: `upper_arm_inertia` is the upper arm's inertia."""
    return name.replace("_", " ")


def _in_plain_numbers(one: Ellipse) -> dict[str, float]:
    return {name: float(value) for name, value in vars(one).items()}


def estimates_table(result: TrialsResult, job: TrialsJob | None = None) -> pa.Table:
    """One row per method. A column's unit is its field's metadata `unit`; the job's text is in the schema's."""
    columns = [
        (same[0].name, same[0].unit, [column.values for column in same])
        for same in zip(*(one.columns() for one in result.estimates), strict=True)
    ]
    return table_of(columns, "" if job is None else job.text)


def _result(found: ArmImpedance) -> dict[str, Any]:
    """What one method found."""
    low, high = found.interval()
    return {
        "method": found.method,
        "method_short": METHODS[found.method].short,
        "method_description": found.title,
        "window_s": found.window,
        "trials": found.trials,
        "verdict": found.verdict,
        "reason": found.reason,
        "warnings": list(found.warnings),
        "parameters": {
            name: {
                "unit": found.units[k],
                "value": float(found.theta[k]),
                "stderr": float(found.stderr[k]),
                "low_95": float(low[k]),
                "high_95": float(high[k]),
                "half_width_95": float(high[k] - low[k]) / 2,
            }
            for k, name in enumerate(found.names)
        },
        "covariance": found.covariance.tolist(),
        "dof": found.dof,
        "damping_Nms_per_rad": found.D.tolist(),
        "stiffness_Nm_per_rad": found.K.tolist(),
        "stiffness_on_boundary": found.evidence.on_boundary,
        "inertia_kgm2": found.inertia,
        "inertia_stderr_kgm2": found.inertia_stderr,
        "vaf": found.vaf,
        "held_out_vaf": found.held_out_vaf,
        "misfit": found.misfit,
        "delay_s": None if found.own is None else float(found.own.delay),
        "improved_inertia_kgm2": found.improved_inertia,
        "cutoff_hz": None if found.curves.cutoff is None else found.curves.cutoff.tolist(),
        "hand_at_onset_m": found.position.tolist(),
        "angles_at_onset_rad": found.angles.tolist(),
    }


def _windows(result: TrialsResult) -> list[dict[str, Any]]:
    """Estimates of the main method from other windows."""
    found = result.windows
    if found is None:
        return []
    return [
        {
            "window_s": float(length),
            "parameters": {
                name: {"value": float(found.theta[row, k]), "stderr": float(found.stderr[row, k])}
                for k, name in enumerate(found.names)
            },
        }
        for row, length in enumerate(found.window)
    ]


def _name(job: TrialsJob) -> str:
    """What the recordings are called."""
    if job.trials.file is not None:
        return job.trials.file
    files = job.trials.files
    return files if isinstance(files, str) else ", ".join(files or [])


def _settings(content: dict[str, Any]) -> dict[str, str]:
    """What was read, known and demanded, as a person reads it."""
    recording, arm, limits = content["recording"], content["arm"], content["trust_limits"]

    def numbers(values: list[float], unit: str) -> str:
        return f"{', '.join(number(value) for value in values)} {unit}"

    def known_inertia(name: str) -> str:
        error = content["inertia_stderr_kgm2"][name]
        value = number(content["inertia_kgm2"][name])
        return f"{value} kg m²" if error is None else f"{value} ± {number(error, 2)} kg m²"

    cutoff = content["cutoff_hz"]
    whence = "as given" if arm["inertia_from"] == "given" else f"from {arm['inertia_from']}"
    trials = f"{recording['perturbed']} perturbed, {recording['unperturbed']} unperturbed"
    return {
        "trials": trials + (f", {recording['postures']} perturbed postures" if recording["postures"] else ""),
        "sample rate": f"{recording['sample_rate_hz']:.6g} Hz",
        "method": content["method_description"],
        "window": f"{1e3 * content['window_s']:.4g} ms after the onset",
        "high-pass of the jerk": "none" if cutoff is None else numbers(cutoff, "Hz"),
        "mean place of the hand at the onset": f"{', '.join(f'{x:.3f}' for x in content['hand_at_onset_m'])} m",
        "lengths of the arm": numbers(arm["lengths_m"], "m"),
        **{f"{in_words(name)}, {whence}": known_inertia(name) for name in BASE_INERTIA},
        "mass and damping of the handle": "not stated"
        if arm["handle_mass_kg"] is None
        else f"{numbers(arm['handle_mass_kg'], 'kg')}; {numbers(arm['handle_damping_Ns_per_m'], 'N s/m')}",
        "to be trusted, an estimate needs": f"standard errors below {percent(limits['max_relative_stderr'])} of its "
        "matrix, a stiffness and a damping that are not indefinite, "
        + (
            f"{percent(limits['min_vaf'])} of the torque accounted for and predicted"
            if content["misfit"] is None
            else f"residuals at most {MISFIT:g} times as large as expected"
        ),
    }
