"""Whether `identify` refuses what a wrong model gives, and trusts what a right one does.

Joints that do what the model does not know (`ankles.WRONG`), in pink torque noise, windows of 2 s, records of 60 s: how
far off the estimates are, in how many records most windows are not trusted, whether the words name what is missing, and
what they say of each parameter. Good joints in noise of every kind, motions, rates and windows: how many windows
are trusted, and in how many records any test of the model raises an alarm.
Writes experiments/results/false_trust.json and false_trust.md.

    python experiments/false_trust.py [--records 200]
"""

from __future__ import annotations

import argparse
import json
from collections import Counter
from pathlib import Path
from typing import Any

import ankles
import jax
import numpy as np

from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import estimate
from jaximp.identification.misfit import culprits
from jaximp.identification.suspects import SUSPECTS
from jaximp.trust.score_tests import FAMILYWISE, SHARE, significant
from jaximp.trust.verdicts import NO_DATA
from jaximp.trust.window_rules import NOTHING_MISSING

jax.config.update("jax_enable_x64", True)

RECORDS = 200
MOTIONS = ("random", "multisine")
"""In which every wrong joint is looked at."""
PARAMETERS = ("inertia", "damping", "stiffness")
TARGET = 0.95
"""Of wrong joints that are found, and of good windows that are trusted."""
GOOD: dict[str, dict[str, Any]] = {
    **{noise: {"noise": noise} for noise in ankles.NOISES},
    **{motion: {"motion": motion} for motion in ankles.MOTIONS if motion != "random"},
    "encoder of 0.3 mrad": {"encoder": 3e-4},
    "12 bit of 100 N m, little noise": {"converter": 100 / 4096, "noise": "white", "level": 0.1},
    "noise as large as the torque, 5 s": {"noise": "white", "level": 16.0, "window": 5.0},
    "100 Hz": {"rate": 100.0},
    "200 Hz": {"rate": 200.0},
    "500 Hz": {"rate": 500.0},
    "2000 Hz": {"rate": 2000.0},
    "0.5 s": {"window": 0.5},
    "5 s": {"window": 5.0},
    "high-pass of 0.3 Hz": {"high_pass": 0.3},
}
"""What differs from pink noise, a random motion, 1 kHz and windows of 2 s."""


def identified(seed: tuple[int, ...], settings: dict[str, Any]) -> Estimates:
    """One record."""
    settings = {"window": 2.0, "rate": ankles.RATE, "high_pass": None} | settings
    pipeline = ankles.pipeline(*(settings.pop(name) for name in ("rate", "window", "high_pass")))
    recording = ankles.record(np.random.default_rng(seed), rate=pipeline.sample_rate, **settings)
    return estimate(pipeline, recording)[0]


def wrong_cell(wrong: ankles.Wrong, motion: str, records: int, seed: int) -> dict[str, Any]:
    """What is found of a wrong joint."""
    all_found = [identified((seed, k), {"wrong": wrong, "motion": motion}) for k in range(records)]
    right = {SUSPECTS[group].what for group in wrong.culprits}
    named = [{one.what for one in SUSPECTS.values() if one.what in culprits(e.misfits)} for e in all_found]
    best = [significant(e.misfits)[:1] for e in all_found]
    parameters = {}
    for k, name in enumerate(PARAMETERS):
        usual = np.array([np.median(e.value[:, k]) for e in all_found])
        said = [one[0].move[k] / e.value[:, k].mean() for one, e in zip(best, all_found, strict=True) if one]
        parameters[name] = {
            "off": float(usual.mean() / ankles.TRUTH[name] - 1),
            "said to be off": float(np.mean([name in e.lacking for e in all_found])),
            "mean change that is said": float(np.mean(said)) if said else 0.0,
            "trusted in it": float(np.mean([e.trusted_in(name).mean() for e in all_found])),
        }
    words = Counter("; ".join(e.lacking.values()) for e in all_found)
    example = next((text for text, _ in words.most_common() if text), "")
    return {
        "records": records,
        "harmful": max(abs(one["off"]) for one in parameters.values()) > SHARE,
        "noticed": float(np.mean([bool(significant(e.misfits)) or depends(e) for e in all_found])),
        "found": float(np.mean([e.trusted.mean() < 0.5 for e in all_found])),
        "named rightly": float(np.mean([bool(one & right) for one in named])),
        "named rightly and nothing else": float(np.mean([bool(one) and one <= right for one in named])),
        "vaf": float(np.mean([np.nanmedian(np.asarray(e.fit.vaf)) for e in all_found])),
        "parameters": parameters,
        "example": example,
    }


def depends(estimates: Estimates) -> bool:
    """Whether any parameter is said to depend on the frequency."""
    bands = estimates.bands
    return bands is not None and any(bands.apart(k) for k in range(len(PARAMETERS)))


def good_cell(settings: dict[str, Any], records: int, seed: int) -> dict[str, Any]:
    """How many good windows are trusted, of those that the filters left enough samples."""
    all_found = [identified((seed, k), settings) for k in range(records)]
    alarms = [[one.group for one in significant(e.misfits)] + ["frequency"] * depends(e) for e in all_found]
    refused = Counter(rule for e in all_found for rule in np.asarray(e.verdicts.rule)[~e.trusted].tolist())
    return {
        "records": records,
        "windows trusted": float(np.mean([e.trusted[e.verdicts.verdict != NO_DATA].mean() for e in all_found])),
        "alarms": float(np.mean([bool(one) for one in alarms])),
        "records refused by an alarm": float(
            np.mean([bool((np.asarray(e.verdicts.rule) == NOTHING_MISSING).any()) for e in all_found])
        ),
        "alarms by group": dict(Counter(group for one in alarms for group in one)),
        "rules that refused windows": dict(refused.most_common(3)),
        "vaf": float(np.mean([np.nanmedian(np.asarray(e.fit.vaf)) for e in all_found])),
    }


def wrong_table(cells: dict[str, dict[str, Any]]) -> list[str]:
    """A row a wrong joint."""
    lines = [
        "| the joint | motion | VAF | off % (I / B / K) | noticed | not trusted | named | only that | "
        "said to be off (I / B / K) | change said % | trusted in (I / B / K) |",
        "| --- | --- |" + " --- |" * 9,
    ]
    for name, row in cells.items():
        for motion, cell in row.items():
            each = [cell["parameters"][parameter] for parameter in PARAMETERS]
            off, said, change, trusted = (
                " / ".join(f"{100 * one[key]:{form}}" for one in each)
                for key, form in (
                    ("off", "+.1f"),
                    ("said to be off", ".0f"),
                    ("mean change that is said", "+.0f"),
                    ("trusted in it", ".0f"),
                )
            )
            shares = " | ".join(
                f"{cell[key]:.0%}" for key in ("noticed", "found", "named rightly", "named rightly and nothing else")
            )
            lines.append(
                f"| {name} | {motion} | {cell['vaf']:.3f} | {off} | {shares} | {said} | {change} | {trusted} |"
            )
    return lines


def good_table(cells: dict[str, dict[str, Any]]) -> list[str]:
    """A row a kind of good record."""
    lines = [
        "| good records | VAF | windows trusted | alarms | refused by an alarm | other rules that refused windows |",
        "| --- |" + " --- |" * 5,
    ]
    for name, cell in cells.items():
        rules = {rule: n for rule, n in cell["rules that refused windows"].items() if rule != NOTHING_MISSING}
        shares = (f"{cell[key]:.1%}" for key in ("windows trusted", "alarms", "records refused by an alarm"))
        lines.append(f"| {name} | {cell['vaf']:.3f} | {' | '.join(shares)} | {', '.join(rules)} |")
    return lines


def missed(wrong: dict[str, dict[str, Any]], good: dict[str, dict[str, Any]]) -> list[str]:
    """Which targets are missed."""
    found = []
    for name, row in wrong.items():
        for motion, cell in row.items():
            if not cell["harmful"]:
                continue
            if cell["found"] < TARGET:
                found.append(f"- {name}, {motion}: found in {cell['found']:.0%}")
            for parameter, one in cell["parameters"].items():
                if abs(one["off"]) > SHARE and one["trusted in it"] > 1 - TARGET:
                    found.append(
                        f"- {name}, {motion}: {parameter} is {one['off']:+.1%} off and trusted in "
                        f"{one['trusted in it']:.0%} of the windows"
                    )
    for name, cell in good.items():
        if cell["windows trusted"] < TARGET:
            found.append(f"- good, {name}: {cell['windows trusted']:.1%} of the windows are trusted")
    return found


def report(wrong: dict[str, dict[str, Any]], good: dict[str, dict[str, Any]], records: int) -> str:
    alarms = f"{np.mean([cell['alarms'] for cell in good.values()]):.1%}" if good else "unknown"
    misses = missed(wrong, good)
    lines = [f"{records} records a row. Shares of records, but for `trusted in`, which counts windows.", ""]
    lines += [*wrong_table(wrong), "", *good_table(good), ""]
    lines += [f"Alarms in good records: {alarms} on the mean; {FAMILYWISE:.0%} is the level.", ""]
    lines += [
        f"Missed of the target of {TARGET:.0%}, for wrong joints with a parameter off by {SHARE:.0%}:",
        "",
        *misses,
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("--records", type=int, default=RECORDS, help="of every row")
    records = arguments.parse_args().records
    folder = Path(__file__).parent / "results"
    wrong = {
        name: {motion: wrong_cell(joint, motion, records, 1000 + 10 * k + m) for m, motion in enumerate(MOTIONS)}
        for k, (name, joint) in enumerate(ankles.WRONG.items())
    }
    good = {name: good_cell(settings, records, 2000 + k) for k, (name, settings) in enumerate(GOOD.items())}
    (folder / "false_trust.json").write_text(json.dumps({"wrong": wrong, "good": good}, indent=1) + "\n")
    (folder / "false_trust.md").write_text(report(wrong, good, records))
    print(report(wrong, good, records))
