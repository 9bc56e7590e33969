"""The first sentences of a report: what changed, when, how sure, and what nobody can tell."""

from __future__ import annotations

from typing import Any

import pytest

from jaximp.reports.headline import headline, headline_of_arm, headline_of_posterior
from jaximp.trust.verdicts import TRUSTED, WEAK


def parameter(mean: float | None, **more: Any) -> dict[str, Any]:
    plain = {"unit": "N m/rad", "half_width_95": 0.5, "determined": True, "steady": False, "changed": None}
    plain |= {"from_to_90": None}
    return plain | {"mean": mean} | more


def course(*values: float, at: tuple[float, ...] = ()) -> dict[str, Any]:
    return {"values": list(values), "at_s": list(at), "evidence": "p < 0.001"}


def result(count: int = 20, kind: str = "window", joint: Any = None, **parameters: Any) -> dict[str, Any]:
    return {"kind": kind, "windows": {"count": count}, "parameters": parameters, "at_joint": joint}


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (course(60.2, 119, at=(12,)), "Stiffness rises from 60.2 to 119 N m/rad at 12 s (p < 0.001)."),
        (course(-60, -40, at=(3.5,)), "Stiffness falls from −60 to −40 N m/rad at 3.5 s (p < 0.001)."),
        (course(-3, 4, at=(3,)), "Stiffness changes from −3 to 4 N m/rad at 3 s (p < 0.001)."),
        (course(1, 2, 3, at=(4, 8)), "Stiffness is 1 until 4 s, then 2 until 8 s, then 3 N m/rad (p < 0.001)."),
        (course(40, 80), "Stiffness moves between 40 and 80 N m/rad (p < 0.001)."),
    ],
)
def test_what_changed_is_said_first(found: dict[str, Any], said: str) -> None:
    content = result(stiffness=parameter(89.7, changed=found), damping=parameter(1.0, steady=True))
    assert headline(content) == f"{said} No change beyond error and 5 % was found of damping."


def test_where_nothing_changes_one_value_stands_for_all() -> None:
    steady = {"inertia": parameter(0.02, steady=True), "stiffness": parameter(60.0, steady=True)}
    said = "No change beyond error and 5 % was found of inertia and stiffness."
    one = "Stiffness is 60 N m/rad (± 0.5"
    assert headline(result(**steady)) == f"{one} in one window, 95 %). {said}"


def test_what_was_not_compared_and_is_no_one_value_is_told_as_a_range() -> None:
    found = {"stiffness": parameter(60.0, steady=True), "offset_torque": parameter(-4.5, from_to_90=[-6.0, -3.0])}
    said = headline(result(**found))
    assert "Offset torque is between −6 and −3 N m/rad in nine of ten windows." in said


def test_of_a_path_it_is_said_what_is_open() -> None:
    found = {"inertia": parameter(0.02, steady=True), "damping": parameter(1.0), "stiffness": parameter(60.0)}
    found["stiffness"]["changed"] = course(40, 80)
    assert headline(result(kind="point", **found)) == (
        "Stiffness moves between 40 and 80 N m/rad (p < 0.001). No change was found of inertia. Whether "
        "damping changes cannot be told."
    )


def test_of_too_few_windows_no_change_is_denied() -> None:
    assert headline(result(1, stiffness=parameter(60.0))) == "Stiffness is 60 N m/rad (± 0.5, 95 %)."
    assert headline(result(2, stiffness=parameter(60.0))).endswith("too few windows share no samples.")


def test_what_is_not_known_is_said_and_never_told() -> None:
    loose = parameter(0.02, determined=False, steady=True, changed=course(1, 2))
    said = headline(result(inertia=loose, damping=parameter(None), stiffness=parameter(60.0, steady=True)))
    assert said.endswith("This motion does not determine inertia. Not to be trusted: damping.")
    assert "inertia moves" not in said
    assert headline(result(stiffness=parameter(None))) == ""


def test_a_geared_joint_is_told_at_the_joint() -> None:
    at_joint = {"parameters": {"stiffness": parameter(60.0)}}
    assert "60 N m/rad" in headline(result(1, joint=at_joint, stiffness=parameter(0.6)))


def test_of_many_parameters_the_determined_are_counted() -> None:
    chain = {f"link{k}.mass": parameter(1.0, stands_for="", determined=k < 7) for k in range(15)}
    said = headline(result(1, **chain))
    assert said.startswith("7 of 15 parameters are determined.")
    assert said.endswith("link7 mass, link8 mass, link9 mass, link10 mass, link11 mass and 3 more.")


def test_a_posterior_tells_when_the_parameter_surely_changed() -> None:
    row = {"name": "stiffness", "unit": "N m/rad", "2.5%": 58.0, "50%": 60.0, "97.5%": 62.0}
    steps = [{"to_s": 1.0 * k, "probability": {"stiffness": p}} for k, p in enumerate((0.5, 0.9999, None, 0.0, 0.99))]
    content = {"why": "", "parameters": [row], "changes": steps}
    assert headline_of_posterior(content) == (
        "Stiffness is 60 N m/rad (95 % credible interval 58 to 62). It rises from the window before to that at 1 s "
        "(probability above 99.9 %). It falls from the window before to that at 3 s (probability above 99.9 %)."
    )
    assert headline_of_posterior(content | {"why": "draws have not converged"}) == ""


def test_of_an_arm_the_stiffest_direction_is_told_if_it_is_trusted() -> None:
    found = {"major": 400.0, "minor": 120.0, "orientation": 1.0471975511965976}
    error = {"major": 10.0, "minor": 6.0, "orientation": 0.017453292519943295}
    content = {"verdict": TRUSTED, "endpoint": {"stiffness_ellipse": found, "stiffness_ellipse_stderr": error}}
    said = "400 ± 20 N/m along the stiffest direction, 60° from the x axis (standard error 1°), and 120 ± 12 N/m across"
    assert said in headline_of_arm(content)
    assert headline_of_arm(content | {"verdict": WEAK}) == ""
