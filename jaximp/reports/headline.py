"""What a report says first, in words: what changed, from what to what, when, how sure, and what is not determined."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from jaximp.plots.wording import main_parameter, number, pretty_unit, words
from jaximp.trust.verdicts import TRUSTED
from jaximp.types import listed

MOST_NAMED = 5
"""Parameters, or moments, that a sentence names."""
SURELY = 0.999
"""How probable a rise or fall is that the headline of a posterior tells of."""


def headline(result: Mapping[str, Any]) -> str:
    """A few sentences on what one method found, at the joint where there is a gear; empty where nothing is trusted."""
    parameters = (result["at_joint"] or result)["parameters"]
    known = {name: one for name, one in parameters.items() if one["mean"] is not None and one["determined"]}
    if not known:
        return ""
    sums = any("stands_for" in one for one in parameters.values())
    told = [_changes(name, one) for name, one in known.items() if one["changed"] is not None]
    steady = [name for name, one in known.items() if one["steady"]]
    if sums:
        told.append(f"{len(known)} of {len(parameters)} parameters are determined.")
    elif not told:
        told.append(_one_value(result, known))
    told += [_range(name, one, result["kind"]) for name, one in known.items() if _is_open(one)]
    unsure = [name for name, one in known.items() if not one["steady"] and one["changed"] is None]
    if result["kind"] == "point":
        told += [f"No change was found of {_named(steady)}."] if steady else []
        told += [f"Whether {_named(unsure)} changes cannot be told."] if unsure else []
    elif steady:
        told.append(f"No change beyond error and 5 % was found of {_named(steady)}.")
    elif result["windows"]["count"] > 1:
        told.append("Whether parameters change cannot be told: too few windows share no samples.")
    loose = [name for name, one in parameters.items() if one["mean"] is not None and not one["determined"]]
    doubted = [name for name, one in parameters.items() if one["mean"] is None]
    told += [f"This motion does not determine {_named(loose)}."] if loose else []
    told += [f"Not to be trusted: {_named(doubted)}."] if doubted else []
    return " ".join(told)


def headline_of_posterior(content: Mapping[str, Any]) -> str:
    """The parameter that stands for all, and when it surely rises or falls; empty where draws cannot be trusted."""
    if content["why"]:
        return ""
    rows = {row["name"]: row for row in content["parameters"] if not row["name"].startswith("log_noise")}
    name = main_parameter(list(rows))
    row = rows[name]
    middle, low, high = (number(row[key], 4) for key in ("50%", "2.5%", "97.5%"))
    told = f"{_capital(words(name))} is {middle} {pretty_unit(row['unit'])} (95 % credible interval {low} to {high})."
    steps = [(one["to_s"], one["probability"].get(name)) for one in content["changes"]]
    moments = {
        "rises": [when for when, p in steps if p is not None and p > SURELY],
        "falls": [when for when, p in steps if p is not None and p < 1 - SURELY],
    }
    for how, times in moments.items():
        if times:
            more = [f"{len(times) - MOST_NAMED} more"] if len(times) > MOST_NAMED else []
            at = listed([*(f"{time:.4g} s" for time in times[:MOST_NAMED]), *more])
            told += f" It {how} from the window before to that at {at} (probability above {100 * SURELY:g} %)."
    return told


def headline_of_arm(content: Mapping[str, Any]) -> str:
    """How stiff the hand is along which direction; empty where the estimate is not trusted."""
    if content["verdict"] != TRUSTED:
        return ""
    found, error = content["endpoint"]["stiffness_ellipse"], content["endpoint"]["stiffness_ellipse_stderr"]
    major, minor = (f"{number(found[axis], 3)} ± {number(2 * error[axis], 2)} N/m" for axis in ("major", "minor"))
    turn, off = (number(math.degrees(one["orientation"]), 2) for one in (found, error))
    return (
        f"At the hand the stiffness is {major} along the stiffest direction, {turn}° from the x axis (standard error "
        f"{off}°), and {minor} across it (± two standard errors)."
    )


def course_in_words(found: Mapping[str, Any]) -> str:
    """`60.2 until 12 s, then 119`, or between which ends a parameter moves."""
    values = [number(value, 3) for value in found["values"]]
    if not found["at_s"]:
        return f"between {values[0]} and {values[1]}"
    until = [f"{value} until {time:.4g} s" for value, time in zip(values, found["at_s"], strict=False)]
    return ", then ".join([*until, values[-1]])


def _changes(name: str, one: Mapping[str, Any]) -> str:
    found, unit = one["changed"], pretty_unit(one["unit"])
    values, at = found["values"], found["at_s"]
    if len(at) == 1:
        before, after = values
        how = "changes" if before * after < 0 else "rises" if abs(after) > abs(before) else "falls"
        how += f" from {number(before, 3)} to {number(after, 3)} {unit} at {at[0]:.4g} s"
    else:
        how = f"{'is' if at else 'moves'} {course_in_words(found)} {unit}"
    return f"{_capital(words(name))} {how} ({found['evidence']})."


def _is_open(one: Mapping[str, Any]) -> bool:
    """Whether no value stands for a parameter that was not asked for changes, such as a constant torque."""
    return one["changed"] is None and not one["steady"] and one["from_to_90"] is not None


def _range(name: str, one: Mapping[str, Any], kind: str) -> str:
    low, high = (number(value, 3) for value in one["from_to_90"])
    return f"{_capital(words(name))} is between {low} and {high} {pretty_unit(one['unit'])} in nine of ten {kind}s."


def _one_value(result: Mapping[str, Any], known: Mapping[str, Mapping[str, Any]]) -> str:
    """Of the parameter that a person looks for, where none changes."""
    name = main_parameter(list(known))
    one, kind = known[name], result["kind"]
    where = "" if result["windows"]["count"] == 1 else f" at one {kind}" if kind == "point" else " in one window"
    half = "" if one["half_width_95"] is None else f" (± {number(one['half_width_95'], 2)}{where}, 95 %)"
    return f"{_capital(words(name))} is {number(one['mean'], 4)} {pretty_unit(one['unit'])}{half}."


def _named(names: Sequence[str]) -> str:
    more = [f"{len(names) - MOST_NAMED} more"] if len(names) > MOST_NAMED else []
    return listed([*map(words, names[:MOST_NAMED]), *more])


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
