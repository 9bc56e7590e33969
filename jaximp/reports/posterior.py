"""Posteriors of a job on disk: draws as NetCDF, a summary, figures, and one HTML report that says it all."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaximp import plots
from jaximp.jobs.job import Job, TrialsJob, WindowJob
from jaximp.least_squares.noise import ATTENUATION
from jaximp.plots.wording import pretty_unit, words
from jaximp.posterior.arm import ArmInference
from jaximp.posterior.densities import stiffness_matrices
from jaximp.posterior.draws import Posterior, summarise
from jaximp.posterior.files import save_posterior
from jaximp.posterior.inference import LEVELS, Inference, sentences
from jaximp.reports.headline import headline_of_posterior
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
    versions,
    without_nan,
    write_page,
)
from jaximp.trust.verdicts import TRUSTED, UNCONVERGED
from jaximp.types import Numbers

if TYPE_CHECKING:
    from jaximp.plots.interactive import Live

"""What is said of a window that `identify` trusts, and whose draws have not converged."""
TITLES = {
    "bands": "Parameters over time",
    "torque": "Torque that the posterior predicts",
    "ellipses": "Stiffness and damping of the joints",
    "corner": "All parameters, two by two",
}
CAPTIONS = {
    "bands": "Median, and bands that hold 50 and 95 %, of windows that share no samples, each by itself.",
    "torque": "The filtered torque (in print that of the middle of the record), and the band that should hold 95 % of "
    "it, by the posterior of the whole record. Where the torque leaves it for long, the model lacks something, or a "
    "parameter has changed.",
    "ellipses": "Bands that hold 50 and 95 % of the draws in every direction.",
    "corner": "Of every pair the regions of highest density that hold 50 and 95 %. Narrow slanting ones: the data tell "
    "a combination of the two, and neither well.",
}
"""Figures in the order of the report, and how to read them."""
SHOWN = 10.0
"""Torque that is shown [s], or two windows of it if they are longer."""
CORNER = 12
"""Parameters that are shown two by two, at most: the last ones, which are the stiffnesses."""


def live_figures(found: Inference, shown: Sequence[str], changes: Sequence[dict[str, Any]]) -> dict[str, Live]:
    """What a reader can zoom and ask. Figures know no `Inference`: what they need of it is read here alone."""
    from jaximp.plots.interactive_windows import Torque, Windows, over_time

    windows = found.summarised[1]
    if windows is None or not len(found.end):
        return {}
    names = [name for name in shown if name in windows.names]
    samples = windows.samples[..., [windows.names.index(name) for name in names]]
    low, lower, middle, upper, high = np.quantile(samples, LEVELS, axis=1)
    reasons = [found.reason(k) for k in range(len(found.end))]
    verdict = np.where(found.good, TRUSTED, np.where(found.verdicts.trusted, UNCONVERGED, found.verdicts.verdict))
    rise = np.full(middle.shape, np.nan)
    for change in changes:
        rise[np.flatnonzero(found.end == change["to_s"])[0]] = [change["probability"].get(name) for name in names]
    over = Windows(
        names, [windows.units[windows.names.index(name)] for name in names], found.start, found.end, middle, low, high,
        verdict, reasons, inner=[(lower, upper)], rise=rise if changes else None, interval="95 % credible interval",
        remark=[_rises(dict(zip(names, row, strict=True))) for row in rise.tolist()],
    )  # fmt: skip
    outputs = found.torque.shape[1]
    torques = [f"torque{f' of output {k + 1}' if outputs > 1 else ''} (N m)" for k in range(outputs)]
    median = found.bands[len(LEVELS) // 2]
    torque = Torque(found.time, torques, found.torque, {"predicted": median}, (found.bands[0], found.bands[-1]))
    drawn = over_time(over, torque)
    return {"bands": drawn["parameters"], "torque": drawn["torque"]}


def _rises(probability: Mapping[str, float]) -> str:
    known = [f"{words(name)} {chance:.3f}" for name, chance in probability.items() if np.isfinite(chance)]
    return f"Greater than in the window before, with probability: {', '.join(known)}." if known else ""


def write_posterior_results(folder: str | Path, found: Inference, job: WindowJob) -> dict[str, Any]:
    """Write `posterior.nc` (whole record), `windows.nc`, `summary.json`, `report.html` and the figures.

    **Returns:** the summary.
    """
    folder, (whole, windows) = Path(folder), found.summarised
    human = [name for name in whole.names if name.startswith("human.")]  # the robot's are those of its own recording
    shown = human or [name for name in whole.names if not name.startswith("log_noise")]
    save_posterior(folder / "posterior.nc", found.whole)
    figures = {
        "corner": plots.corner(whole, shown[-CORNER:]),
        "torque": _torque(found, max(SHOWN, 2 * job.window.length)),
    }
    if found.windows is not None and windows is not None:
        save_posterior(folder / "windows.nc", found.windows, found.end)
        if found.good.any():
            figures["bands"] = plots.bands((found.start + found.end) / 2, windows, shown, trusted=found.good)
    content = _content(job, whole, "the whole record", shown, _remarks(found, job.posterior.heavy_tails), found.why)
    changes = _changes(found, shown)
    content["changes"] = changes
    content["held_out_log_score"] = None if found.score is None else list(found.score)
    content["share_of_torque_in_95_percent_band"] = found.inside
    content["windows"] = _windows(found)
    return _write(folder, content, figures, live_figures(found, shown, changes))


def write_arm_posterior(folder: str | Path, inference: ArmInference, job: TrialsJob) -> dict[str, Any]:
    """The same for an arm's damping and stiffness from perturbed movements."""
    folder, posterior, found = Path(folder), inference.posterior, inference.identified
    save_posterior(folder / "posterior.nc", posterior)
    D, K = stiffness_matrices(posterior.samples)
    ellipses = {"stiffness": {"arm": K}, "damping": {"arm": D}}
    units = {"stiffness": "N m/rad", "damping": "N m s/rad"}
    figures = {"corner": plots.corner(posterior), "ellipses": plots.ellipse_bands(ellipses, units)}
    of = f"the impedance of {found.main.trials} perturbed movements"
    remarks = [*found.main.warnings, *found.notes]
    content = _content(job, posterior, of, list(posterior.names), remarks, inference.why)
    return _write(folder, content | {"changes": []}, figures, {})


def _content(
    job: Job, posterior: Posterior, of: str, shown: Sequence[str], remarks: Sequence[str], why: str
) -> dict[str, Any]:
    return {
        "name": ", ".join(path.name for path in job.files()[:1]),
        "of": of,
        "sampler": posterior.sampler,
        "why": why,
        "heading": f"{'These draws' if posterior.why else 'What is behind these draws'} cannot be trusted.",
        "parameters": summarise(posterior),
        "sentences": sentences(posterior, shown),
        "remarks": list(remarks),
        "versions": versions(),
        "job": job.text,
    }


def _remarks(found: Inference, heavy_tails: bool) -> list[str]:
    """What a reader must know of the noise, the prior and the bands."""
    remarks = []
    orders = [len(one) for one in found.noise.autoregression]
    if any(orders):
        remarks.append(
            "the residuals are not the white noise that the filters were given: an autoregression of order "
            f"{', '.join(map(str, orders))} stands for what is left, which may also be something that the model lacks"
        )
    for k, test in enumerate(found.whiteness):
        if test.p < 0.01:
            remarks.append(
                f"the residuals of output {k + 1} are still not white (Ljung-Box p = {test.p:.1g}): intervals may be "
                "too narrow"
            )
    remarks.append(f"{100 * found.inside:.3g} % of the torque lie within the band that should hold 95 %")
    biased = [(name, one) for name, one in zip(found.whole.names, found.bias, strict=False) if abs(one) > ATTENUATION]
    if biased:
        name, one = max(biased, key=lambda pair: abs(pair[1]))
        remarks.append(
            f"noise of the position biases least squares, {name} most, by {one:.2g} standard errors; "
            + ("with heavy tails it stays" if heavy_tails else "it is corrected for")
        )
    low, middle, high = found.prior.ratio
    alone = all(name.startswith("log_noise") for name in found.prior.flat)  # else flat parameters make the rest
    if np.isfinite(middle) and ((alone and high < 0.1) or low > 10):
        remarks.append(
            f"the prior expects {low:.2g} to {high:.2g} times the torque that was measured: they contradict each other"
        )
    distrusted = np.flatnonzero(~found.good)
    if len(distrusted):
        k = distrusted[len(distrusted) // 2]
        remarks.append(
            f"{len(distrusted)} of {len(found.end)} windows are not to be trusted; the one at {found.start[k]:.4g} s: "
            f"{found.reason(int(k))}"
        )
    return [*remarks, *(f"no posterior of the window at {line}" for line in found.left_out), *found.notes]


def _changes(found: Inference, shown: Sequence[str]) -> list[dict[str, Any]]:
    """From window to window, how probable it is that each parameter rose, and the Monte Carlo standard error."""
    table: dict[tuple[int, int], dict[str, Any]] = {}
    for one in (one for one in found.changes if one.parameter in shown):
        before, after = one.windows
        row = table.setdefault(
            one.windows,
            {"from_s": found.end[before], "to_s": found.end[after], "probability": {}, "error": {}},
        )
        row["probability"][one.parameter], row["error"][one.parameter] = one.probability, one.error
    return list(table.values())


def _windows(found: Inference) -> list[dict[str, Any]]:
    windows = found.summarised[1]
    return [
        {
            "start_s": found.start[k],
            "end_s": found.end[k],
            "verdict": found.verdicts.verdict[k],
            "why": found.reason(k),
            "parameters": summarise(one),
        }
        for k, one in enumerate(windows or ())
    ]


def _torque(found: Inference, length: float) -> Any:
    """Of the first joint, so much time [s] in the middle of what counted."""
    counted = np.isfinite(found.torque[:, 0])
    middle = found.time[counted][counted.sum() // 2]
    shown = np.abs(found.time - middle) <= length / 2
    bands: Numbers = np.where(counted, found.bands[:, :, 0], np.nan)
    return plots.torque_bands(found.time[shown], found.torque[shown, 0], bands[:, shown])


def _write(folder: Path, content: dict[str, Any], figures: dict[str, Any], live: Mapping[str, Live]) -> dict[str, Any]:
    content = without_nan(content)
    content = {"headline": headline_of_posterior(content), **content}
    images = {name: plots.png(figure) for name, figure in figures.items()}
    write_page(folder, _page(content, images, {name: one for name, one in live.items() if name in images}), content)
    return content


def _page(content: dict[str, Any], images: dict[str, bytes], live: Mapping[str, Live]) -> Page:
    """The report on a summary."""
    why = content["why"]
    alerts = [Alert("refusal", content["heading"], [f"{capitalised(why)}."])] if why else []
    paper = [] if why else [Prose(f"For a paper: {'; '.join(content['sentences'])}.")]
    notes = [Alert("notes", items=content["remarks"])] if content["remarks"] else []
    return Page(
        title=content["name"],
        subtitle=f"Posterior of {content['of']}: {content['sampler']}",
        headline=content["headline"],
        sections=[
            Section("", alerts),
            Section("", [_parameter_table(content["parameters"]), *paper], void=bool(why)),
            Section("", notes),
            *figure_sections(images, TITLES, CAPTIONS, {"bands": _change_table(content["changes"])}),
            *closing_sections("", {}, content["job"]),
        ],
        pictures=images,
        live=live,
    )


def _parameter_table(parameters: Sequence[dict[str, Any]]) -> Table:
    heads = [Column("Median", "answer"), Column("Standard deviation"), Column("95 % credible interval")]
    heads += [Column("Effective samples"), Column("R-hat"), Column("Unit", "text")]
    rows = [
        [
            words(row["name"]),
            digits(row["50%"]),
            digits(row["sd"], 2),
            f"{digits(row['2.5%'])} to {digits(row['97.5%'])}",
            digits(row["ess"], 3),
            digits(row["rhat"], 3),
            pretty_unit(row["unit"]),
        ]
        for row in parameters
    ]
    return Table([Column("Parameter", "text"), *heads], rows)


def _change_table(changes: Sequence[dict[str, Any]]) -> list[Part]:
    """From window to window, how probable it is that each parameter rose."""
    if not changes:
        return []
    names = list(changes[0]["probability"])
    heads = [
        Column("From the window that ends at", "text"),
        Column("To that at"),
        *(Column(words(name)) for name in names),
    ]
    rows = [
        [
            f"{digits(one['from_s'], 3)} s",
            f"{digits(one['to_s'], 3)} s",
            *(f"{p:.3f}" for p in one["probability"].values()),
        ]
        for one in changes
    ]
    remark = (
        "The probability that each parameter is greater in the later window, from each to the next that can be "
        "trusted; they share no samples. Near one half nothing has changed that the data can tell, near zero or one it "
        "has."
    )
    return [Table(heads, rows, remark=remark)]
