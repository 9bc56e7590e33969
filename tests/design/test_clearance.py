"""Capsules around links: their distances against a bounded least-squares solver, and what they are made from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from factories.robots import joint, link, robot
from jaximp.design.clearance import Clearance, Plane, segment_distance
from jaximp.models import SIX_JOINT_ARM, Chain
from jaximp.models.spatial import rotation_about

ARM = Chain.from_urdf(SIX_JOINT_ARM, tip="tool")


def between(one: np.ndarray, other: np.ndarray) -> float:
    """Distance of two segments (2, 3) by another solver."""
    A = np.stack([one[1] - one[0], other[0] - other[1]], axis=1)
    found = lsq_linear(A, other[0] - one[0], bounds=(0, 1), tol=1e-14)
    return float(np.sqrt(2 * found.cost))


def bodies(chain: Chain, q: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation and position in the base of every body of a chain whose joints turn, one after the other."""
    R, p, found, tree = np.eye(3), np.zeros(3), [], chain.tree
    for k, angle in enumerate(q):
        p = p + R @ tree.position[k]
        R = R @ tree.rotation[k] @ rotation_about(np.asarray(tree.axis[k]), angle)
        found.append((R, p))
    return found


def test_distances_of_segments_are_those_of_a_solver() -> None:
    random = np.random.default_rng(0)
    ends = random.normal(size=(2, 2, 3, 200))
    ends[1, :, :, :40] *= 0.2  # some cross, some are far from each other
    ends[1, 1, :, 40:60] = ends[1, 0, :, 40:60] + ends[0, 1, :, 40:60] - ends[0, 0, :, 40:60]  # parallel
    ends[1, 1, :, 60:80] = ends[1, 0, :, 60:80]  # a point
    ends[:, 1, :, 80:90] = ends[:, 0, :, 80:90]  # two points
    found = np.asarray(jax.jit(segment_distance)(*jnp.asarray(ends)))
    expected = [between(ends[0, :, :, k], ends[1, :, :, k]) for k in range(200)]
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_segments_that_touch_have_a_distance_of_zero_and_a_finite_slope() -> None:
    one = jnp.array([[-1.0, 0, 0], [1, 0, 0]])
    other = jnp.array([[0.0, -1, 0], [0, 1, 0]])
    value, slope = jax.jit(jax.value_and_grad(segment_distance))(one, other)
    assert float(value) < 1e-70
    assert np.isfinite(slope).all()


def test_distances_of_links_are_those_of_their_frames() -> None:
    """Every pose by the product of its joints' turns, every distance by the solver."""
    clearance = Clearance.of(ARM, radius=0.04, radii={"forearm": 0.05}, planes=[Plane(offset=0.1)])
    q = np.random.default_rng(1).uniform(-2, 2, (6, 6))
    found = np.asarray(clearance.distances(q))
    assert found.shape == (6, len(clearance.names))
    poses = [bodies(ARM, pose) for pose in q]

    def world(k: int, sample: int) -> np.ndarray:
        ends, body = np.asarray(clearance.ends[k]), clearance.bodies[k]
        if body < 0:
            return ends
        R, p = poses[sample][body]
        return ends @ R.T + p

    for sample in range(len(q)):
        pairs = [
            between(world(i, sample), world(k, sample)) - clearance.radii[i] - clearance.radii[k]
            for i, k in clearance.pairs
        ]
        heights = [world(i, sample)[:, 2].min() - clearance.radii[i] - 0.1 for i, _ in clearance.over]
        np.testing.assert_allclose(found[sample], pairs + heights, atol=1e-6)


def test_the_slope_of_a_distance_is_its_difference() -> None:
    clearance = Clearance.of(ARM)
    q, direction = np.random.default_rng(2).uniform(-2, 2, (2, 5, 6))
    slope = jax.jit(lambda q: jax.jvp(clearance.distances, (q,), (jnp.asarray(direction),))[1])(q)
    before, after = (clearance.distances(q + step * direction) for step in (-1e-6, 1e-6))
    np.testing.assert_allclose(slope, (after - before) / 2e-6, atol=1e-6)


def test_neighbours_and_what_touches_at_zero_are_left_out_with_a_note() -> None:
    names = Clearance.of(ARM, radius=0.04).names
    assert "base and forearm" in names
    assert not {"base and column", "column and upper_arm", "upper_arm and forearm"} & set(names)
    fat = Clearance.of(ARM, radius=0.15)
    assert "left out, as they touch at zero or in the mean pose: " in fat.notes[-1]
    assert "base and forearm" in fat.names
    assert not any(name in fat.notes[-1] for name in fat.names)
    folded = np.array([0, 0, 2.6, 0, 2.0, 0])
    assert len(Clearance.of(ARM, radius=0.1, mean=folded).names) < len(Clearance.of(ARM, radius=0.1).names)
    assert "base and forearm" not in Clearance.of(ARM, radius=0.04, ignore=[("forearm", "base")]).names


SHAPES = {
    "box": ('<box size="0.1 0.4 0.06"/>', np.hypot(0.1, 0.06) / 2, 0.4),
    "cylinder": ('<cylinder radius="0.05" length="0.3"/>', 0.05, 0.3),
    "sphere": ('<sphere radius="0.07"/>', 0.07, 0.0),
}


def with_shape(shape: str, kind: str = "collision") -> str:
    place = '<origin xyz="0.01 0.02 0.1" rpy="0.3 0.2 -0.4"/>'
    element = f"<{kind}>{place}<geometry>{shape}</geometry></{kind}>"
    return robot(
        link("ground"), joint("a", "ground", "one", axis="0 1 0"), link("one"), joint("b", "one", "two", axis="0 1 0"),
        link("two").replace("</link>", f"{element}</link>"),
    )  # fmt: skip


@pytest.mark.parametrize("kind", ["collision", "visual"])
@pytest.mark.parametrize("name", SHAPES)
def test_shapes_of_the_file_are_covered(tmp_path: Path, name: str, kind: str) -> None:
    shape, radius, length = SHAPES[name]
    path = tmp_path / "robot.urdf"
    path.write_text(with_shape(shape, kind), encoding="utf-8")
    clearance = Clearance.of(Chain.from_urdf(path), path)
    k = clearance.bodies.index(1)
    assert clearance.radii[k] == pytest.approx(radius)
    assert np.linalg.norm(np.diff(clearance.ends[k], axis=0)) == pytest.approx(length)
    np.testing.assert_allclose(clearance.ends[k].mean(axis=0), [0.01, 0.02, 0.1])
    assert not any("two" in note for note in clearance.notes)


def test_meshes_cannot_be_read_and_are_noted(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(with_shape('<mesh filename="two.stl"/>'), encoding="utf-8")
    chain = Chain.from_urdf(path)
    assert "two have a radius of 0.06 m" in Clearance.of(chain, path).notes[0]
    known = Clearance.of(chain, path, radii={"ground": 0.1, "one": 0.05, "two": 0.05})
    assert known.notes == ()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"distance": -0.1}, "clearance.distance is -0.1: it must be zero or more"),
        ({"radius": 0.0}, "clearance.radius is 0.0: it must be above zero"),
        ({"radii": {"forearm": np.nan}}, "clearance.radii.forearm is nan"),
        ({"radii": {"fore_arm": 0.1}}, "did you mean 'forearm'"),
        ({"ignore": [("base", "hand")]}, "no link is called so"),
        ({"planes": [Plane((0, 0, 0))]}, "a normal that is not zero"),
        ({"urdf": "nowhere.urdf"}, "nowhere.urdf cannot be read"),
    ],
)
def test_errors_name_the_cause(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Clearance.of(ARM, **settings)


def test_a_shape_without_numbers_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(with_shape('<sphere radius="big"/>'), encoding="utf-8")
    with pytest.raises(ValueError, match="a collision of link 'two' has radius='big': it must be 1 finite"):
        Clearance.of(Chain.from_urdf(path), path)


GRIPPER = robot(
    link("ground"), joint("a", "ground", "arm", axis="0 1 0"), link("arm"), joint("b", "arm", "wrist", axis="0 1 0"),
    link("wrist"), joint("mount", "wrist", "palm", "fixed", "0 0 0.1"),
    link("palm").replace("</link>", '<visual><geometry><mesh filename="palm.stl"/></geometry></visual></link>'),
    joint("grip", "palm", "finger", "prismatic", "0 0.05 0.1", axis="0 1 0"), link("finger"),
    joint("point", "palm", "centre", "fixed", "0 0 0.25"), '<link name="centre"/>',
)  # fmt: skip
"""A palm with a finger that is locked, and the point between the fingers, behind the link that the last joint moves."""


@pytest.mark.parametrize("tip", [None, "centre"])
@pytest.mark.parametrize("known", [True, False])
def test_what_hangs_on_the_last_link_is_covered_whatever_the_tip(tmp_path: Path, known: bool, tip: str | None) -> None:
    path = tmp_path / "robot.urdf"
    path.write_text(GRIPPER, encoding="utf-8")
    chain = Chain.from_urdf(path, tip=tip, locked={"grip": 0.03})
    clearance = Clearance.of(chain, path if known else None, radius=0.01, planes=[Plane(offset=-0.2)])
    q = np.random.default_rng(0).uniform(-3, 3, (20, 2))
    reach = {"palm": [0, 0, 0.1], "finger": [0, 0.08, 0.2], "centre": [0, 0, 0.35]}
    heights = [[p + R @ point for point in reach.values()] for R, p in (bodies(chain, pose)[1] for pose in q)]
    lowest = np.array(heights)[:, :, 2].min(axis=1)
    over = np.array([name.endswith(" and table") for name in clearance.names])
    found = np.asarray(clearance.distances(q))[:, over].min(axis=1)
    assert (found <= lowest + 0.2 - 0.01 + 1e-12).all()
    assert "ground, arm, wrist, palm" in clearance.notes[0]
    assert "finger" in clearance.notes[0]
