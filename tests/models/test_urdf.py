"""The reader of URDF files: what is wrong with one is said in one line, with the remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from factories.robots import TREE, joint, link, planar, robot
from jaximp.models import urdf
from jaximp.models.chain import Chain
from jaximp.models.spatial import about, from_pseudo_inertia, moved, pseudo_inertia, rotation, rotation_about
from jaximp.models.urdf import moving_bodies, parse_urdf, read_urdf

TWO = planar()
MALFORMED = {
    "not XML": ("position,velocity\n1,2\n", "not XML"),
    "cut off": (TWO[:200], "not XML"),
    "another format": ("<sdf version='1.7'><model/></sdf>", "no URDF: it begins with <sdf>"),
    "xacro": (
        '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:include filename="x"/></robot>',
        "run `xacro",
    ),
    "xacro in a number": (TWO.replace('value="2.0"', 'value="${mass}"'), "that is xacro"),
    "document type": ('<!DOCTYPE robot SYSTEM "file:///etc/passwd">' + TWO, "document type"),
    "entities": ('<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aa">]><robot name="&a;"/>', "delete it"),
    "no links": ('<robot name="r"/>', "no <link>"),
    "no joints": (robot(link("alone")), "no <joint>"),
    "two links of one name": (TWO.replace('"fore"', '"upper"'), "two links are called 'upper'"),
    "two joints of one name": (TWO.replace('joint name="elbow"', 'joint name="shoulder"'), "two joints are called"),
    "a nameless joint": (TWO.replace('joint name="elbow" ', "joint "), "a <joint> has no name"),
    "an unknown parent": (TWO.replace('parent link="upper"', 'parent link="uper"'), "did you mean 'upper'"),
    "no parent": (TWO.replace('<parent link="upper"/>', ""), "joint 'elbow' has no parent link"),
    "an unknown kind": (TWO.replace('type="revolute"', 'type="rotary"'), "is of type 'rotary'"),
    "a zero axis": (TWO.replace('axis xyz="0 0 1"', 'axis xyz="0 0 0"'), "has a zero axis: give the direction"),
    "two numbers for three": (TWO.replace('xyz="0.4 0 0"', 'xyz="0.4 0"'), "must be 3 finite numbers"),
    "not a number": (TWO.replace('value="2.0"', 'value="heavy"'), "must be one finite number"),
    "infinite": (TWO.replace('value="2.0"', 'value="inf"'), "must be one finite number"),
    "below zero": (TWO.replace('value="2.0"', 'value="-2"'), "must not be below zero"),
    "no mass": (TWO.replace('<mass value="2.0"/>', ""), "has no 'value': add it"),
    "no inertial": (
        TWO.replace(link("fore", 1.3, "0.12 -0.01 0"), '<link name="fore"/>'),
        "has no <inertial>: add one",
    ),
    "a velocity of zero": (TWO.replace('velocity="3"', 'velocity="0"'), "has a limit of 0 for the velocity; correct"),
    "an effort of zero": (TWO.replace('effort="40"', 'effort="0"'), "has a limit of 0 for the effort; correct"),
    "no room": (TWO.replace('lower="-2" upper="2.5"', 'lower="0" upper="0"'), "cannot move: both limits are 0"),
    "swapped limits": (TWO.replace('lower="-2" upper="2.5"', 'lower="2.5" upper="-2"'), "swap them"),
    "two roots": (
        TWO.replace("</robot>", '<link name="loose"/></robot>'),
        "moves the links ground and loose: only one",
    ),
    "two movers": (
        TWO.replace("</robot>", joint("strut", "ground", "fore") + "</robot>"),
        "moved by two joints, 'elbow' and 'strut': closed loops",
    ),
    "a loop": (
        TWO.replace(
            "</robot>", link("hub") + link("rim") + joint("a", "hub", "rim") + joint("b", "rim", "hub") + "</robot>"
        ),
        "the joints a and b form a loop",
    ),
    "a loop alone": (
        robot(link("hub"), link("rim"), joint("a", "hub", "rim"), joint("b", "rim", "hub")),
        "the joints a and b form a loop",
    ),
    "floating": (
        TWO.replace('"elbow" type="revolute"', '"elbow" type="floating"'),
        "name it in locked, or start above it with the base",
    ),
    "following nobody": (
        TWO.replace("</joint></robot>", "<mimic/></joint></robot>").replace(
            "</joint><link", '<mimic joint="wrist"/></joint><link'
        ),
        "what joint 'shoulder' follows is 'wrist'",
    ),
    "following itself": (TREE.replace('mimic joint="right_elbow"', 'mimic joint="right_finger"'), "follows itself"),
}


@pytest.mark.parametrize("name", MALFORMED)
def test_what_is_wrong_is_said_in_one_line(name: str) -> None:
    text, words = MALFORMED[name]
    with pytest.raises(ValueError, match=r"^robot\.urdf") as caught:
        Chain(parse_urdf(text, "robot.urdf"))
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"tip": "fist"}, "tip is 'fist', but no link is called so"),
        ({"base": "grond"}, "base is 'grond', but no link is called so: did you mean 'ground'?"),
        ({"base": "upper", "tip": "ground"}, "tip 'ground' is not above the base"),
        ({"base": "fore"}, "no joint above link 'fore' moves"),
        ({"locked": ["shoulder", "elbow"]}, "no joint above link 'ground' moves"),
        ({"locked": {"ellbow": 1.0}}, "did you mean 'elbow'?"),
        ({"locked": {"elbow": np.nan}}, "locked joint 'elbow' is at nan"),
        ({"gravity": (0, 9.81)}, "it must be three finite numbers"),
        ({"gear": 0.0}, "gear is 0.*must be finite and not zero"),
        ({"gear": {"wrist": 2.0}}, "gear: a joint is 'wrist'"),
        ({"gear": [1.0, 2.0, 3.0]}, "gear has the shape"),
        ({"sign": 2}, "sign is 2.*must be finite and 1 or -1"),
        ({"coupling": [[1.0, 2.0], [2.0, 4.0]]}, "coupling is singular"),
        ({"coupling": np.eye(3)}, "give 2 by 2"),
        ({"side": "link"}, "side is 'link'"),
        ({"friction": "viscose"}, "did you mean 'viscous'"),
        ({"friction": ["coulomb", "asymmetric_coulomb"]}, "choose one of the two"),
        ({"friction": "stribeck", "stribeck": (0.0, 2.0)}, "velocity of stribeck is 0"),
        ({"min_velocity": -1}, "min_velocity is -1"),
    ],
    ids=str,
)
def test_settings_that_do_not_fit_are_refused(settings: dict[str, object], words: str, unchecked: None) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        Chain(parse_urdf(TWO), **settings)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "robot.urdf"
    with pytest.raises(ValueError, match=r"robot.urdf cannot be read: No such file"):
        Chain.from_urdf(file)
    file.write_bytes(b"\xff\xfe<\x00r\x00")
    with pytest.raises(ValueError, match="no text in UTF-8"):
        read_urdf(file)
    file.write_text(TWO, encoding="utf-8-sig")
    read = read_urdf(file)
    assert read.robot == "planar"
    monkeypatch.setattr(urdf, "LARGEST_FILE", 100)
    with pytest.raises(ValueError, match="a URDF has at most 100"):
        read_urdf(file)
    monkeypatch.setattr(urdf, "MOST_LINKS", 2)
    with pytest.raises(ValueError, match="there are 3 <link>s: at most 2"):
        parse_urdf(TWO)
    monkeypatch.setattr(urdf, "MOST_MOVING", 1)
    with pytest.raises(ValueError, match="lock some"):
        moving_bodies(read)


def test_the_encoding_that_a_file_claims_hides_nothing() -> None:
    """The text is decoded before it is searched, so that nothing can be said in an encoding that only XML knows."""
    claimed = '<?xml version="1.0" encoding="cp037"?>'
    assert parse_urdf(claimed + TWO).robot == "planar"


def test_a_deep_tree_is_no_recursion() -> None:
    parts = [link(f"l{k}") for k in range(900)]
    joints = [joint(f"j{k}", f"l{k}", f"l{k + 1}", "fixed") for k in range(898)]
    deep = parse_urdf(robot(*parts, *joints, joint("last", "l898", "l899")))
    (body,) = moving_bodies(deep).bodies
    assert body.links == ("l899",)


@pytest.mark.parametrize(
    "left",
    [
        '<xacro:property name="M_PI" value="3.14159"/>',
        '<xacro:arg name="prefix" default=""/>',
        '<xacro:macro name="arm" params="prefix"><link name="${prefix}arm"/><xacro:arm2/></xacro:macro>',
    ],
)
def test_definitions_that_xacro_left_behind_do_not_matter(left: str) -> None:
    head = '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" '
    text = TWO.replace("<robot ", head).replace("</robot>", f"{left}</robot>")
    np.testing.assert_array_equal(Chain(parse_urdf(text)).links, Chain(parse_urdf(TWO)).links)
    for open_yet in ('<xacro:arm prefix="a"/>', "<xacro:if value='1'/>", '<xacro:include filename="x"/>'):
        with pytest.raises(ValueError, match="is a xacro file: run"):
            parse_urdf(text.replace("</robot>", f"{open_yet}</robot>"))
    with pytest.raises(ValueError, match=r"is called .*that is xacro"):
        parse_urdf(text.replace("</robot>", '<link name="${prefix}arm"/></robot>'))


def test_an_inertia_without_a_mass_is_noted() -> None:
    assert Chain(parse_urdf(TWO)).notes == ()
    text = TWO.replace('<mass value="2.0"/>', '<mass value="0"/>')
    (note,) = Chain(parse_urdf(text, "robot.urdf")).notes
    assert note == "by robot.urdf upper has an inertia but no mass, as no body has: correct the file"


def test_what_strict_refuses_is_said_for_job_files_as_for_python() -> None:
    massless = TWO.replace(TWO[TWO.index("<inertial>") : TWO.rindex("</inertial>") + 11], "")
    still = TWO.replace('lower="-2" upper="2.5"', 'lower="0" upper="0"')
    for text in (massless, still):
        with pytest.raises(ValueError, match="or set strict to false, which takes"):
            Chain(parse_urdf(text))


def test_less_strict_takes_zeros_for_unknown() -> None:
    text = TWO.replace('velocity="3"', 'velocity="0"').replace('lower="-2" upper="2.5"', 'lower="0" upper="0"')
    massless = text.replace(link("upper", 2.0, "0.17 0.02 0"), '<link name="upper"/>')
    chain = Chain(parse_urdf(massless), strict=False)
    assert np.isinf([chain.limits.lower, chain.limits.upper, chain.limits.velocity]).all()
    np.testing.assert_array_equal(chain.limits.effort, 40)
    np.testing.assert_array_equal(chain.links[0], 0)


def test_limits_and_names_are_those_of_the_file() -> None:
    chain = Chain(parse_urdf(TREE))
    assert chain.joint_names == ("waist", "left_slide", "left_wrist", "right_elbow")
    assert chain.joint_kinds == ("revolute", "prismatic", "revolute", "revolute")
    assert chain.link_names[0] == ("torso", "box")
    np.testing.assert_array_equal(chain.limits.lower, [-2, -2, -np.inf, -2])
    np.testing.assert_array_equal(chain.limits.velocity, 3)
    assert chain.tip is None
    with pytest.raises(ValueError, match="tree branches, and no tip was named: set tip"):
        chain.jacobian(np.zeros(4))


def test_parameters_of_a_body_move_with_its_frame() -> None:
    """Against the parallel-axis theorem, by the mass matrix of the body's own motion."""
    random = np.random.default_rng(0)
    tensor = random.normal(size=(3, 3))
    tensor = tensor @ tensor.T
    centre, p = random.normal(size=(2, 3))
    R = rotation(np.array([0.3, -1.2, 2.1]))
    elsewhere = about(2.5, R @ centre + p, R @ tensor @ R.T)
    np.testing.assert_allclose(moved(about(2.5, centre, tensor), R, p), elsewhere, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(from_pseudo_inertia(pseudo_inertia(elsewhere)), elsewhere, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(rotation_about(np.array([0, 0, 1.0]), 0.7), rotation(np.array([0, 0, 0.7])), atol=1e-15)
    np.testing.assert_allclose(rotation_about(np.array([1.0, 0, 0]), 0.7), rotation(np.array([0.7, 0, 0])), atol=1e-15)
