"""URDFs that are written: read again they move as the parameters say, and all else in them is as it was."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from factories.real_robots import PENDULUM, another
from factories.robots import TREE, joint, link, robot
from jaximp.consistency import export_urdf
from jaximp.models import rigid_body
from jaximp.models.chain import Chain
from jaximp.models.spatial import pseudo_inertia
from jaximp.models.urdf import SIX_JOINT_ARM

MESH = '<visual><geometry><mesh filename="package://a>b/hand.stl"/></geometry></visual><!-- a comment -->'
REAL_TREE = TREE.replace('iyy="0.03"', 'iyy="0.024"').replace('name="left_hand">', f'name="left_hand">{MESH}')
BARE = robot(
    '<link name="base"/>',
    joint("one", "base", "empty"),
    "<link name='empty' />",
    joint("two", "empty", "hand", axis="0 1 0"),
    link("hand", inertia="0.02 0 0 0.025 0 0.015").replace("</link>", f"{MESH}<inertial2/></link>"),
)
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    "arm": (SIX_JOINT_ARM.read_text(encoding="utf-8"), {"tip": "tool", "rotor": True, "friction": True}),
    "tree": ('<?xml version="1.0"?>\n<!-- <robot> of ü -->\n' + REAL_TREE, {"locked": {"left_wrist": 0.7}}),
    "bare": (BARE, {"strict": False}),
}


@pytest.mark.parametrize("case", CASES)
def test_the_file_read_again_moves_as_the_parameters_say(case: str, tmp_path: Path) -> None:
    text, settings = CASES[case]
    source, out = tmp_path / "own.urdf", tmp_path / "identified.urdf"
    source.write_text(text, encoding="utf-8")
    chain = Chain.from_urdf(source, **settings)
    standard = np.array(chain.standard_parameters)
    real = Chain.from_urdf(SIX_JOINT_ARM)
    bodies = chain.tree.n_bodies
    standard[: 10 * bodies] = another(real, 4)[: 10 * bodies]
    determined = np.arange(len(standard)) % 3 == 0
    found = export_urdf(source, chain, standard, determined, out)

    again = Chain.from_urdf(out, **settings)
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 7, chain.n_joints))
    torque = rigid_body.inverse_dynamics(chain.tree, standard[: 10 * bodies].reshape(-1, 10), q, dq, ddq)
    np.testing.assert_allclose(again.inverse_dynamics(q, dq, ddq), torque, rtol=0, atol=1e-9 * np.abs(torque).max())

    written = out.read_text(encoding="utf-8")
    comment = re.search(r"\n  <!-- Inertial parameters by jaximp.*?-->", written, re.DOTALL)
    assert comment is not None
    for names in chain.link_names:
        assert names[0] in comment[0]
    left = [
        re.sub(r"<inertial>.*?</inertial>", "", x, flags=re.DOTALL) for x in (written.replace(comment[0], ""), text)
    ]
    assert left[0].replace("<link name='empty' ></link>", "<link name='empty' />") == left[1]

    table = {column.name: column.values for column in found.columns()}
    assert table["parameter"] == list(chain.base.standard_names)
    np.testing.assert_array_equal(table["value"], standard)
    np.testing.assert_array_equal(table["file"], chain.standard_parameters)
    assert table["source"][:4] == ["data", "prior", "prior", "data"]
    assert set(table["source"][10 * bodies :]) <= {"not written"}


def test_links_that_are_fixed_to_another_are_in_its_sum(tmp_path: Path) -> None:
    out = tmp_path / "arm.urdf"
    chain = Chain.from_urdf(SIX_JOINT_ARM)
    export_urdf(SIX_JOINT_ARM, chain, chain.standard_parameters, np.zeros(60, bool), out)
    written = out.read_text(encoding="utf-8")
    assert written.count("<inertial>") == SIX_JOINT_ARM.read_text(encoding="utf-8").count("<inertial>") - 1
    assert "flange (with tool, whose inertial is in this sum): data none; prior mass, mc_x," in written


HAND = robot(
    "<link name='base' />",
    joint("turn", "base", "arm", axis="0 1 0"),
    link("arm", 2.0, inertia="0.02 0 0 0.025 0 0.015"),
    joint("mount", "arm", "palm", "fixed", "0.1 0 0.3", "0.2 0.1 0"),
    link("palm", 0.5, inertia="0.002 0 0 0.0025 0 0.0015"),
    joint("grip", "palm", "finger", "prismatic", "0 0 0.1", axis="0 1 0"),
    link("finger", 0.2, inertia="0.002 0 0 0.0025 0 0.0015"),
    joint("pad_mount", "finger", "pad", "fixed", "0 0 0.05"),
    link("pad", 0.1, inertia="0.0002 0 0 0.00025 0 0.00015"),
    joint(
        "follow", "palm", "thumb", "prismatic", "0 0 0.1", axis="0 1 0", more='<mimic joint="grip" multiplier="-1"/>'
    ),
    link("thumb", 0.2, inertia="0.002 0 0 0.0025 0 0.0015"),
)
"""A hand whose finger and thumb are locked."""


@pytest.mark.parametrize("lighter", [1.0, 0.2])
def test_the_file_can_be_read_without_locking_what_was_locked(lighter: float, tmp_path: Path) -> None:
    """And at the locked position it moves as before; where the whole is lighter than its fingers, these give way."""
    source, out = tmp_path / "own.urdf", tmp_path / "identified.urdf"
    source.write_text(HAND, encoding="utf-8")
    chain = Chain.from_urdf(source, locked={"grip": 0.02})
    standard = lighter * np.array(chain.standard_parameters)
    export_urdf(source, chain, standard, np.zeros(10, bool), out)

    free = Chain.from_urdf(out)
    assert free.joint_names == ("turn", "grip")
    q, dq, ddq = np.random.default_rng(0).normal(size=(3, 7, 1))
    torque = rigid_body.inverse_dynamics(chain.tree, standard.reshape(-1, 10), q, dq, ddq)
    motion = (np.concatenate([x, np.full((7, 1), held)], axis=1) for x, held in ((q, 0.02), (dq, 0), (ddq, 0)))
    np.testing.assert_allclose(free.inverse_dynamics(*motion)[:, :1], torque, rtol=0, atol=1e-12)
    assert all(np.linalg.eigvalsh(pseudo_inertia(one))[0] > 0 for one in free.links)
    written = out.read_text(encoding="utf-8")
    assert ('mass value="0.1"' in written) == (lighter == 1)
    assert "(with palm, whose inertial is in this sum, and finger, pad and thumb behind locked joints, which" in written


@pytest.mark.usefixtures("unchecked")
def test_what_is_wrong_is_said_in_one_line(tmp_path: Path) -> None:
    source, out = tmp_path / "arm.urdf", tmp_path / "out.urdf"
    source.write_bytes(SIX_JOINT_ARM.read_bytes())
    chain = Chain.from_urdf(source)
    right = source, chain, chain.standard_parameters, np.zeros(60, bool), out
    impossible = np.array(chain.standard_parameters)
    impossible[14] = 0
    for place, wrong, message in (
        (2, np.zeros(3), "there are 3 standard parameters and 60 marks: for this chain there are 60"),
        (2, impossible, "link2 is no real body: find the nearest robot that can be with consistent_fit"),
        (1, PENDULUM, "there are 60 standard parameters and 60 marks: for this chain there are 11"),
        (4, source, "is the original: give another file"),
        (4, tmp_path / "no" / "where.urdf", "cannot be written: No such file or directory; choose another place"),
        (0, tmp_path / "no.urdf", "cannot be read: No such file or directory"),
    ):
        given = list(right)
        given[place] = wrong
        with pytest.raises(ValueError, match=re.escape(message)):
            export_urdf(*given)
        assert not out.exists()
    other = tmp_path / "pendulum.urdf"
    other.write_text(BARE, encoding="utf-8")
    with pytest.raises(ValueError, match="has no link 'column': give the URDF that the chain was made of"):
        export_urdf(other, *right[1:])
