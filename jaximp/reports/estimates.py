"""Results on disk: the table of windows, the summary, the figures, and one HTML report that says it all.

The report gives the answer first and never a number that no trusted window stands behind.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from jaximp import plots
from jaximp.identification.drive_gains import DriveGains
from jaximp.identification.estimates import Estimates
from jaximp.identification.suspects import what
from jaximp.jobs.job import WindowJob
from jaximp.jobs.payload import Weighed
from jaximp.least_squares.window import confidence_interval
from jaximp.models.chain import Chain
from jaximp.models.tip import TipImpedance
from jaximp.plots.wording import main_parameter, number, percent, pretty_unit, words
from jaximp.reports.contents import estimates_table, summary
from jaximp.reports.headline import course_in_words
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
    write_page,
    write_table,
)
from jaximp.reports.payload import load_pictures, load_sections, write_load
from jaximp.trust.frequencies import ByFrequency
from jaximp.trust.score_tests import p_in_words
from jaximp.trust.verdicts import FAKE, NO_DATA, POOR, TRUSTED, WEAK
from jaximp.types import Recording, listed

if TYPE_CHECKING:
    from jaximp.plots.interactive import Live

DERIVATIVES = {
    "wideband": "of the position, right to 0.1 % up to its cut-off",
    "central": "central differences of the position",
}
LACKING = "the model lacks"
"""How a doubt begins that the tests of the model raise."""
MOST_SAID, MOST_MOVED = 5, 3
"""Sentences of what the model lacks, and parameters in each row of the table of a robot's tests."""
REMEDIES = {
    TRUSTED: "",
    WEAK: "Excite the joint more, with larger and faster motion of several frequencies, or lengthen window.length.",
    FAKE: "Lengthen window.length or use a richer reference trajectory: the motion in these windows is too poor to "
    "tell a change of the parameters from an artefact.",
    POOR: "Look at the residual's spectrum, then check the torque's sign and unit, the filters, and whether the model "
    "lacks something (an offset, friction, gravity, a reflex).",
    NO_DATA: "Record without gaps, lower window.min_velocity, or lengthen window.length; windows at the very ends of "
    "the recording are lost to the filters.",
}
"""What to do about windows with a verdict, in one sentence."""

CAPTIONS = {
    "parameters": "Each estimate is an average over its window and stands at the window's middle; what changes faster "
    "is blurred. The interval holds the truth with probability 95 % if model and noise are as assumed and "
    "nothing changes inside the window. Shaded stretches must not be believed.",
    "against_urdf": "Each parameter with its interval of 95 %, beside the value of the URDF, which knows no friction "
    "and no rotors. Of several windows their mean.",
    "torque": "The torque that the model had to explain, the model's torque with the parameters of the window around "
    "each sample (fitted), and with those of a window that had not seen it (held out).",
    "held_out": "A recording that the parameters have not seen: its torque, and the model's.",
    "condition": "A large condition number or a small singular value means that the motion does not tell the "
    "parameters apart. Where the held-out VAF falls below the other, the parameters change or fit noise.",
    "residual_spectrum": "What the model leaves over, by frequency. A peak that the torque has as well is something "
    "that the model lacks. The estimated noise is what tells how far each frequency can be relied on.",
    "by_frequency": "Each parameter by bands of frequencies that excite the model equally. Ordinary least squares of "
    "filtered rows counts bands with much torque more, generalised least squares those with little noise: where the "
    "parameter is the same at all frequencies both agree with every band. Hatched bands do not determine it. Inside "
    "a band inertia and stiffness are harder to tell apart than over all of them. A parameter that changes from window "
    "to window makes no interval longer.",
    "reflex": "What a stretch does to the torque as time goes by: the weight of every lag of the rectified velocity. "
    "Their sum is the gain. Where the last ones are not zero the bank is too short, and the stiffness takes the rest.",
    "window_lengths": "The same recording at several window lengths. Short windows scatter, long ones hide changes: a "
    "spread well above the standard error is a true change, or something that the model lacks.",
    "methods": "The same by several methods of telling the human from the robot, with intervals of 95 %.",
}
"""Figures in the order of the report, and how to read them."""
OF_PATH = {
    "parameters": "Each parameter at every point of the path, from the whole recording. The band holds the truth with "
    "probability 95 % if model and noise are as assumed; what is not known of how fast parameters move, and of when "
    "they jump, is in it. Dashed: what was known up to each point. Shaded stretches must not be believed.",
    "torque": "The torque that the model had to explain, the model's torque with the parameters of the path (fitted), "
    "and with what was known of them before.",
    "condition": "Of the stretch around each point: a large condition number or a small singular value means that its "
    "motion does not tell the parameters apart. Bands of the path are wide there.",
}
"""What is said of them where parameters were followed."""

TITLES = {
    "parameters": "Parameters over time",
    "against_urdf": "Parameters against the URDF",
    "torque": "Torque",
    "held_out": "Torque of the recording that was held out",
    "condition": "Condition of the windows",
    "residual_spectrum": "Spectrum of the residual",
    "by_frequency": "Estimates by frequency",
    "reflex": "Reflex",
    "window_lengths": "Window lengths",
    "methods": "Methods",
}


def live_figures(estimates: Estimates) -> dict[str, Live]:
    """What a reader can zoom and ask. Figures know no `Estimates`: what they need of it is read here alone."""
    from jaximp.plots.interactive_windows import Quality, Torque, Windows, over_time

    shown, fit, verdicts = estimates.summarised(), estimates.fit, estimates.verdicts
    value = np.asarray(shown.fit.theta)
    low, high = (np.asarray(end) for end in confidence_interval(value, np.asarray(shown.fit.stderr), shown.fit.dof))
    condition, vaf, held_out = np.asarray(fit.cond), np.asarray(fit.vaf), np.asarray(estimates.held_out_vaf)
    told, path = zip(condition.tolist(), vaf.tolist(), held_out.tolist(), strict=True), bool(estimates.tracks)
    unseen = "by what was known before" if path else "next window"
    remarks = [
        f"Condition number {number(cond, 3)}, VAF {number(share, 3)}, {unseen} {number(ahead, 3)}."
        for cond, share, ahead in told
    ]
    start, end = estimates.start, estimates.end
    if path:  # whoever picks a point sees the stretch around it
        middle = (start + end) / 2
        start, end = (middle + side * estimates.window / 2 for side in (-1, 1))
    windows = Windows(
        shown.names, shown.units, start, end, value, low, high, verdicts.verdict, verdicts.reason, remark=remarks
    )
    joints = range(estimates.torque.shape[1])
    efforts = [plots.effort(estimates, joint) for joint in joints]
    names = [
        f"{what}{f' of joint {k + 1}' if len(efforts) > 1 else ''} ({unit})" for k, (what, unit) in enumerate(efforts)
    ]
    models = {
        "model, fitted": estimates.reconstructed,
        "model, by what was known before" if path else "model, held out (window before)": estimates.predicted,
    }
    quality = Quality(condition, np.asarray(fit.sigma_min), vaf, held_out, estimates.threshold)
    quality = replace(quality, unseen=unseen) if path else quality
    live = over_time(windows, Torque(estimates.time, names, estimates.torque, models), quality)
    return {"torque": live["torque"]} if _is_one_window(estimates) and "torque" in live else live


def _is_one_window(estimates: Estimates) -> bool:
    """Whether a robot's recording is one window, so that nothing is to be shown over windows."""
    return isinstance(estimates.model, Chain | TipImpedance) and len(estimates.end) == 1


def write_results(
    folder: str | Path,
    estimates_list: Sequence[Estimates],
    lengths: Sequence[Estimates],
    job: WindowJob,
    recording: Recording,
    load: Weighed | DriveGains | None = None,
) -> None:
    """Write everything into an existing folder.

    `estimates.parquet` (and `estimates_method3.parquet` for a further method 3), `summary.json`, `report.html`, and
    every figure of the report as a PNG file; of a load `payload.json`, of gains by a known load `gains.json`.

    **Arguments:** `estimates_list` one for each method, the main one first; `lengths` the same data at several window
    lengths, or nothing; `load` what a job with `[payload]` found.
    """
    folder = Path(folder)
    for k, estimates in enumerate(estimates_list):
        name = "estimates" if k == 0 else f"estimates_method{estimates.method}"
        write_table(folder / f"{name}.parquet", estimates_table(estimates, job))
    content = summary(estimates_list, job, recording, lengths)
    if load is not None:
        write_load(folder, load)
    write_page(folder, page(estimates_list, lengths, content, load), content)


def pictures(estimates_list: Sequence[Estimates], lengths: Sequence[Estimates]) -> dict[str, bytes]:
    """All figures of a report as PNG files."""
    main = estimates_list[0]
    figures = {"torque": plots.torque(main), "residual_spectrum": plots.residual_spectrum(main)}
    if isinstance(main.model, Chain):
        figures["against_urdf"] = plots.parameters_against_urdf(main)
    if not _is_one_window(main):
        figures["parameters"] = plots.parameters_over_time(main.summarised())
        figures["condition"] = plots.condition_over_time(main)
    if main.held_out is not None:
        figures["held_out"] = plots.torque(main.on_held_out(), "model, from the other recordings")
    if main.frequencies:
        figures["by_frequency"] = plots.by_frequency(main)
    if main.reflexes:
        figures["reflex"] = plots.reflex_weights(main)
    if lengths:
        figures["window_lengths"] = plots.window_lengths(lengths)
    if len(estimates_list) > 1:
        one_window = _is_one_window(main)
        figures["methods"] = plots.parameters_by_method(estimates_list) if one_window else plots.methods(estimates_list)
    return {name: plots.png(figure) for name, figure in figures.items()}


def page(
    estimates_list: Sequence[Estimates],
    lengths: Sequence[Estimates],
    content: dict[str, Any],
    load: Weighed | DriveGains | None = None,
) -> Page:
    """The report on a `summary`, which begins with the load where there is one."""
    images, recording = pictures(estimates_list, lengths), content["recording"]
    heading = "" if load is None else "The robot with its load"
    main = main_parameter(estimates_list[0].names)
    below: dict[str, list[Part]] = {
        "by_frequency": [Prose(said) for said in map(frequencies_in_words, estimates_list[0].frequencies)],
        "methods": [_comparison("Method", main, {str(one["method"]): one for one in _all_methods(content)})],
        "window_lengths": [
            _comparison("Window", main, {f"{number(one['window_s'])} s": one for one in content["window_lengths"]})
        ],
    }
    method = f", method {content['method']}" if content["method"] else ""
    return Page(
        title=recording["name"],
        subtitle=f"{digits(recording['duration_s'])} s at {digits(recording['sample_rate_hz'])} Hz, "
        f"{_estimates_in_words(content)}{method}",
        headline=content["headline"],
        sections=[
            *load_sections(load),
            Section(heading, [*_warning(estimates_list[0], content), *_answer(content)], void=not _any_answer(content)),
            _verdicts(estimates_list[0], content),
            *_moving(content),
            *_tests(content),
            *_residuals(content),
            *figure_sections(images, TITLES, CAPTIONS | (OF_PATH if content["kind"] == "point" else {}), below),
            *_robot_alone(content),
            *closing_sections("Sampling, filters and limits", _settings(content), content["job"]),
        ],
        pictures=images | load_pictures(load),
        live=live_figures(estimates_list[0]),
    )


def _estimates_in_words(content: dict[str, Any]) -> str:
    """How many windows of which length, or points how far apart."""
    count = content["windows"]["count"]
    if content["kind"] == "point":
        return f"{count} points, {digits(content['step_s'], 2)} s apart"
    return f"{count} window{'s' * (count != 1)} of {digits(content['window_s'])} s"


def _warning(estimates: Estimates, content: dict[str, Any]) -> list[Alert]:
    """What is said before any number where few windows are trusted."""
    windows = content["windows"]
    count, trusted, kind = windows["count"], windows["trusted"], content["kind"]
    if not trusted:
        lines = [
            f"{of['count']} of {count} {kind}s: {verdict}, such as: {_example(estimates, verdict)}."
            for verdict, of in windows["verdicts"].items()
            if of["count"]
        ]
        answered = [words(name) for name, value in content["parameters"].items() if value["mean"] is not None]
        heading = (
            f"Only {listed(answered)} can be trusted."
            if answered
            else f"No {kind} can be trusted: there is no answer to report."
        )
        return [Alert("refusal", heading, lines)]
    if windows["trusted_share"] < 0.5:
        share = percent(windows["trusted_share"])
        heading = f"Only {trusted} of {count} {kind}s ({share}) can be trusted."
        return [Alert("caution", heading, ["The numbers below come from these alone."])]
    return []


def _any_answer(content: dict[str, Any]) -> bool:
    """Whether some parameter can be trusted in some window."""
    return any(value["trusted_share"] for value in content["parameters"].values())


def _answer(content: dict[str, Any]) -> list[Part]:
    """The parameters, of a geared joint on both sides of the gear."""
    kind = content["kind"]
    remark = [
        Prose(
            f"Where intervals of {kind}s exclude each other no mean stands for all of them: the table says between "
            "which values nine of ten are, or what the parameter is when.",
            remark=True,
        )
    ]
    if not any(map(_spreads, content["parameters"].values())):
        remark = []
    if content["at_joint"] is None:
        return [_parameter_table(content), *remark]
    also = Prose("These are at the joint. The same on the motor's side of the gear, as in the table and the figures:")
    return [_parameter_table(content["at_joint"]), *remark, also, _parameter_table(content)]


def _spreads(value: Mapping[str, Any]) -> bool:
    """Whether the mean of a parameter stands for no single moment."""
    return value["changed"] is not None or value["from_to_90"] is not None


def _in_words(value: Mapping[str, Any]) -> str:
    """The mean of a parameter; what it is when, or between which values, where it changes."""
    if value["changed"] is not None:
        return course_in_words(value["changed"])
    if _spreads(value):
        low, high = value["from_to_90"]
        return f"{digits(low, 3)} to {digits(high, 3)}"
    return digits(value["mean"])


def _parameter_table(found: dict[str, Any]) -> Table:
    if any("stands_for" in value for value in found["parameters"].values()):
        return _table_of_sums(found["parameters"])
    rows = []
    for name, value in found["parameters"].items():
        half, mean = value["half_width_95"], value["mean"]
        interval = "–"
        if half is not None:
            zero = mean is not None and abs(mean) < half and not _spreads(value)
            loose = "" if value["determined"] else ", not determined"
            interval = f"± {number(half, 2)}" + (", holds zero" if zero else loose)
        rows.append([words(name), _in_words(value), interval, digits(value["sd"], 2), pretty_unit(value["unit"])])
    medians = {f"{words(name)} (median)": value for name, value in found["equilibrium"].items()}
    medians |= {f"{words(name)} mean delay (median)": value["delay"] for name, value in found["reflex"].items()}
    for name, value in medians.items():
        rows.append([name, digits(value["median"]), "", digits(value["sd"], 2), pretty_unit(value["unit"])])
    kind = found["kind"]
    heads = (
        (f"Mean over trusted {kind}s", "answer"),
        (f"95 % interval of one {kind}", "number"),
        ("Spread (sd)", "number"),
    )
    return Table([Column("Parameter", "text"), *(Column(*head) for head in heads), Column("Unit", "text")], rows)


def _table_of_sums(parameters: dict[str, Any]) -> Table:
    """Of a robot from its URDF, with what each parameter stands for and what the file says it is."""
    rows = []
    for name, value in parameters.items():
        known = value["mean"] is not None
        interval = f"± {number(value['half_width_95'], 2)}" if known else "–"
        why = value["doubt"].removeprefix(f"{name}: ")
        if why.startswith(LACKING):  # what it lacks stands under the tests
            why = f"what the model lacks: {why.rpartition(': ')[2].removeprefix(name).strip()}"
        told = why or ("" if value["determined"] else "not determined")
        numbers = digits(value["mean"]), interval, digits(value["urdf"], 3), pretty_unit(value["unit"])
        rows.append([name, value["stands_for"], *numbers, told])
    columns = [
        Column("Parameter", "text"),
        Column("Stands for", "text"),
        Column("Estimate", "answer"),
        Column("95 % interval"),
        Column("By the URDF"),
        Column("Unit", "text"),
        Column("Why not to be trusted", "text"),
    ]
    remark = (
        "A link's mass, first moments (mc) and inertia move the torque together with those of links further out: each "
        "row is the sum that the motion shows. The URDF knows no friction and no rotors. A parameter is not determined "
        "where half of its interval is more than a quarter of its size: of itself, or of what first moments and "
        "products of inertia can be in links of the URDF's mass and moments of inertia."
    )
    return Table(columns, rows, [k for k, row in enumerate(rows) if row[-1]], remark)


def _residuals(content: dict[str, Any]) -> list[Section]:
    """What is left of the torque of each joint, of a robot or where a recording was held out."""
    shown = {"in the recording": content["residuals"], "held out": content["held_out"]}
    several = len(content["recording"]["joints"]) > 1 or content["held_out"] is not None
    parts = [_residual_table(f"Residual {of}", found) for of, found in shown.items() if found is not None]
    return [Section("Residuals of each joint", parts)] if several and parts else []


def _residual_table(head: str, found: dict[str, Any]) -> Table:
    names = *(f"joint {k + 1}" for k in range(len(found["moving"]))), "all joints"
    by_joint = zip(found["moving"], found["still"], strict=True)
    sizes = [*([digits(moving, 3), digits(still, 3)] for moving, still in by_joint), ["", ""]]
    shares = zip([*found["relative_moving"], found["total_moving"]], [*found["relative"], found["total"]], strict=True)
    rows = [
        [name, *size, *(percent(share) for share in both)]
        for name, size, both in zip(names, sizes, shares, strict=True)
    ]
    heads = "Moving", "Near standstill", "Moving, share of the torque", "Share of all rows"
    remark = (
        "Root mean squares, in the unit of the torque. Rows of a joint that is slower than min_velocity do not count "
        "in the fit, and are near standstill here."
    )
    return Table([Column(head, "text"), *map(Column, heads)], rows, remark=remark)


def _verdicts(estimates: Estimates, content: dict[str, Any]) -> Section:
    """How many windows have which verdict, why, and what to do; and what their model explains."""
    windows = content["windows"]
    rows = [
        [verdict, str(of["count"]), percent(of["share"]), _example(estimates, verdict), REMEDIES[verdict]]
        for verdict, of in windows["verdicts"].items()
        if of["count"]
    ]
    kind = content["kind"]
    columns = [Column("Verdict", "text"), Column(capitalised(f"{kind}s")), Column("Share")]
    columns += [Column("For example", "text"), Column("What to do", "text")]
    parts: list[Part] = [Table(columns, rows), Prose(_explained(content))]
    notes = _notes(content)
    if notes:
        parts.append(Alert("notes", items=notes))
    return Section(f"{windows['trusted']} of {windows['count']} {kind}s can be trusted", parts)


def _explained(content: dict[str, Any]) -> str:
    kind = content["kind"]
    if not content["windows"]["trusted"]:
        share = percent(content["mean_vaf_of_all_windows"])
        return f"Over all {kind}s the model explains {share} of the torque's variance."
    vaf, held_out = content["mean_vaf"], content["mean_held_out_vaf"]
    text = f"In trusted windows the model explains {percent(vaf)} of the torque's variance"
    if kind == "point":
        text = f"Around trusted points the path explains {percent(vaf)} of the torque's variance"
    if held_out is not None:
        where = "by what was known before" if kind == "point" else "in the window that follows, which it has not seen"
        text += f", and {percent(held_out)} {where}"
        if vaf - held_out > 0.1:
            text += ". That is much less: the parameters change from window to window, or follow the noise"
    unpredictive = content["windows"]["unpredictive"]
    if unpredictive and kind == "window":
        text += f". Of these windows {unpredictive} predict the torque of the next one worse than a constant would"
    return f"{text}."


def _comparison(head: str, main: str, results: Mapping[str, dict[str, Any]]) -> Table:
    """One parameter of several results; grey where fewer than half of the windows are trusted."""
    rows = []
    for name, result in results.items():
        value = result["parameters"][main]
        shares = percent(result["windows"]["trusted_share"]), percent(result["mean_held_out_vaf"])
        rows.append([name, digits(value["mean"]), digits(value["sd"], 2), digits(value["median_stderr"], 2), *shares])
    heads = (f"{words(main)}, mean", "answer"), ("Spread (sd)", "number"), ("Standard error", "number")
    columns = [
        Column(head, "text"),
        *(Column(*one) for one in heads),
        Column("Trusted windows"),
        Column("Held-out VAF"),
    ]
    void = [k for k, result in enumerate(results.values()) if result["windows"]["trusted_share"] < 0.5]
    return Table(columns, rows, void, "Means over trusted windows; grey where these are fewer than half.")


def _robot_alone(content: dict[str, Any]) -> list[Section]:
    if not content["robot"]:
        return []
    heads = "Estimate", "Standard error", "May have changed by"
    columns = [Column("Parameter", "text"), *map(Column, heads), Column("Unit", "text")]
    rows = [
        [
            words(name),
            digits(value["value"]),
            *(digits(value[key], 2) for key in ("stderr", "may_change")),
            pretty_unit(value["unit"]),
        ]
        for name, value in content["robot"].items()
    ]
    told = (
        "What the robot may have changed by until the recording with the human is one standard deviation, by a second "
        "recording of the robot alone or by robot_drift; the human's standard errors hold it."
    )
    return [Section("Robot alone", [Table(columns, rows, remark=told)])]


def _moving(content: dict[str, Any]) -> list[Section]:
    """How parameters move, where they were followed."""
    if content["path"] is None:
        return []
    rows = []
    for name, one in content["path"].items():
        jumps = [f"{digits(jump['time_s'])} s ({percent(jump['probability'])})" for jump in one["jumps"]]
        more = [f"and {len(jumps) - MOST_SAID} more"] if len(jumps) > MOST_SAID else []
        ends = digits(one["lowest"]), digits(one["highest"])
        told = listed([*jumps[:MOST_SAID], *more]) if jumps else ""
        rows.append([words(name), percent(one["moves"]), *ends, pretty_unit(one["unit"]), told])
    columns = [Column("Parameter", "text"), Column("Moves, probability"), Column("Lowest"), Column("Highest")]
    columns += [Column("Unit", "text"), Column("Jumps at (probability)", "text")]
    remark = (
        "Over trusted points. How fast each parameter drifts, whether it does, and where it jumps, comes from the "
        "likelihood of the recording; before anything is measured, staying is as probable as drifting."
    )
    return [Section("How parameters move", [Table(columns, rows, remark=remark)])]


def _tests(content: dict[str, Any]) -> list[Section]:
    """What the model was asked for, and what it would change."""
    if not content["tests"]:
        return []
    of_sums = any("stands_for" in value for value in content["parameters"].values())
    columns, rows = _moves_most(content) if of_sums else _moves(content)
    lacking = list(content["lacking"].values())
    more = [f"and {len(lacking) - MOST_SAID} more parameters"] if len(lacking) > MOST_SAID else []
    said = "; ".join([*lacking[:MOST_SAID], *more])
    said = said or "Nothing that moves a parameter beyond error and 5 % was found."
    told = (
        "Each row adds columns to the model, over all windows at once, in rows whose noise is white. p is the "
        "probability that so much would be found where nothing is missing; of all rows together 1 % is allowed."
    )
    if of_sums:
        told += " Evidence compares suspects: the largest explains most. Moves count in intervals of the parameters."
    return [Section("Tests of the model", [Prose(said), Table(columns, rows, remark=told)])]


def _moves(content: dict[str, Any]) -> tuple[list[Column], list[list[str]]]:
    """By how much what may be missing would move each parameter."""
    weights = [name for reflex in content["reflex"].values() for name in reflex["weights"]["names"]]
    names = [name for name in content["tests"][0]["move"] if name not in weights]
    columns = [Column("Is this missing?", "text"), Column("p"), *(Column(f"moves {words(name)} by") for name in names)]
    rows = []
    for one in content["tests"]:
        moves = [f"{number(one['move'][name], 2)} ± {number(one['move_stderr'][name], 1)}" for name in names]
        rows.append([what(one["group"]), number(one["p"], 2), *moves])
    return columns, rows


def _moves_most(content: dict[str, Any]) -> tuple[list[Column], list[list[str]]]:
    """The same for a robot of many parameters: the three that would move farthest, counted in their intervals."""
    halves = {name: value["half_width_95"] for name, value in content["parameters"].items()}
    columns = [Column("Is this missing?", "text"), Column("p"), Column("Evidence"), Column("Moves most", "text")]
    rows = []
    for one in content["tests"]:
        share = {name: abs(move) / halves[name] for name, move in one["move"].items() if halves.get(name)}
        most = sorted(share, key=lambda name: -share[name])[:MOST_MOVED]
        moves = [f"{name} by {number(one['move'][name], 2)} ± {number(one['move_stderr'][name], 1)}" for name in most]
        rows.append([what(one["group"]), number(one["p"], 2), number(one["evidence"], 2), ", ".join(moves)])
    return columns, rows


def frequencies_in_words(found: ByFrequency) -> str:
    """Which parameters of a joint depend on the frequency, and where they are not determined."""
    depend, same, open_ones, left_out = [], [], [], []
    for k, (name, unit) in enumerate(zip(found.names, found.units, strict=True)):
        known = np.flatnonzero(np.isfinite(found.value[:, k]))
        if len(known) < len(found.middle):
            left_out.append(f"{words(name)} at {listed(_ranges(found.edges, known))} Hz")
        if not np.isfinite(found.p[k]):
            open_ones.append(words(name))
        elif found.depends(k):
            farthest = sorted(known[[found.value[known, k].argmin(), found.value[known, k].argmax()]])
            values = (f"{digits(found.value[b, k], 3)} around {digits(found.middle[b], 2)} Hz" for b in farthest)
            depend.append(f"{words(name)} ({' and '.join(values)}, in {pretty_unit(unit)}; {p_in_words(found.p[k])})")
        else:
            same.append(words(name))
    said = [
        f"{listed(depend)} {'depends' if len(depend) == 1 else 'depend'} on the frequency." if depend else "",
        f"No dependence on the frequency beyond error and 5 % was found of {listed(same)}." if same else "",
        f"Whether {listed(open_ones)} does cannot be told: fewer than two bands determine it." if open_ones else "",
        f"Left out, since the band does not determine it: {listed(left_out)}." if left_out else "",
    ]
    text = " ".join(filter(None, said))
    return capitalised(text)


def _ranges(edges: NDArray[np.float64], known: NDArray[np.int64]) -> list[str]:
    """The bands that are not known, neighbours together."""
    others = np.setdiff1d(np.arange(len(edges) - 1), known)
    runs = np.split(others, np.flatnonzero(np.diff(others) > 1) + 1)
    return [f"{digits(edges[run[0]], 2)} to {digits(edges[run[-1] + 1], 2)}" for run in runs]


def _all_methods(content: dict[str, Any]) -> list[dict[str, Any]]:
    return [content, *content["further_methods"]]


def _example(estimates: Estimates, verdict: str) -> str:
    """The reason of the middle one of the windows with this verdict."""
    reasons = estimates.verdicts.reason[estimates.verdicts.verdict == verdict]
    return str(reasons[len(reasons) // 2])


def _notes(content: dict[str, Any]) -> list[str]:
    """What the results say of themselves; what a further method repeats is told once."""
    told: dict[str, str] = {}
    for result in _all_methods(content):
        for note in result["notes"]:
            whose = result is not content or note == result["method_description"]
            told.setdefault(note, f"method {result['method']}: {note}" if whose else note)
    return list(told.values())


def _settings(content: dict[str, Any]) -> dict[str, str]:
    """Sampling, filters, windows and limits, as a person reads them."""
    recording, filters, limits = content["recording"], content["filters"], content["trust_limits"]

    def cutoff(kind: str, order: str) -> str:
        return "none" if filters[kind] is None else f"{filters[kind]:g} Hz, Butterworth of order {filters[order]}"

    vaf, tested = limits["min_vaf"], content["tests"]
    needed = "a model that lacks nothing" if tested and vaf is None else f"a VAF of {0.75 if vaf is None else vaf:g}"
    threshold = content["threshold"]
    speed = "m/s" if set(recording["joints"]) == {"prismatic"} else "rad/s"
    return {
        "recording": f"{recording['samples']} samples, {percent(recording['valid_share'])} of them valid",
        "sample rate": f"{recording['sample_rate_hz']:.6g} Hz",
        "joints": ", ".join(recording["joints"]),
        "low-pass of the position": cutoff("position_cutoff", "position_order"),
        "low-pass of torque and regressor": cutoff("decimation_cutoff", "decimation_order"),
        "high-pass of torque and regressor": cutoff("high_pass", "high_pass_order"),
        "samples kept after the filters": "all" if filters["decimate"] == 1 else f"one of {filters['decimate']}",
        "filters run": "once, over the whole recording" if filters["mode"] == "once" else "inside every window",
        "derivatives": "measured" if filters["measured_derivatives"] else DERIVATIVES[filters["derivatives"]],
        **_windows_in_words(content),
        "slowest motion that counts": f"{content['min_velocity']:g} {speed}" if content["min_velocity"] else "any",
        "threshold on the condition number": "none" if threshold is None else f"{threshold:.4g}",
        f"to be trusted, a {content['kind']} needs": f"{needed}, standard errors below "
        f"{percent(limits['max_relative_stderr'])}, columns {limits['min_excitation_ratio']:g} times above position "
        f"noise, {percent(limits['min_valid_share'])} of its samples",
    }


def _windows_in_words(content: dict[str, Any]) -> dict[str, str]:
    """Windows, or points and the stretches around them."""
    step = content["step_s"]
    if content["kind"] == "point":
        stretch = f"motion and noise judged in stretches of {content['window_s']:g} s"
        return {"path": f"a point every {step:.3g} s, {stretch}"}
    return {"window": f"{content['window_s']:g} s" + ("" if step is None else f", one every {step:.3g} s")}
