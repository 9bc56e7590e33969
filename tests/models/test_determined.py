"""What first moments and products of inertia can be, and whether intervals determine a parameter."""

from __future__ import annotations

import numpy as np
import pytest

from factories.real_robots import PLANAR
from jaximp.models.determined import determined, openness, sizes_of_body, sizes_of_chain
from jaximp.models.spatial import PARAMETERS, about, from_pseudo_inertia, largest

NAMES = list(PARAMETERS)


def of_points(mass: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(10,) of points (N, 3) with masses (N,)."""
    moments = np.column_stack([points, np.ones(len(points))])
    return from_pseudo_inertia(moments.T @ (mass[:, None] * moments))


def test_no_body_has_larger_moments_than_are_said() -> None:
    random = np.random.default_rng(0)
    for _ in range(200):
        points = random.normal(size=(5, 3)) * 10 ** random.uniform(-2, 1, 3) + random.normal(size=3)
        body = of_points(random.uniform(0, 1, 5), points)
        assert (np.abs(body) <= largest(body) * (1 + 1e-12)).all()


def test_the_largest_moments_are_those_of_a_point() -> None:
    for point, reached in (((0.2, 0, 0), ["mc_x"]), ((0.3, 0.3, 0), ["Ixy"]), ((0, 0.1, 0.1), ["Iyz"])):
        body = about(2.0, np.array(point), np.zeros((3, 3)))
        at = [NAMES.index(name) for name in reached]
        np.testing.assert_allclose(np.abs(body[at]), largest(body)[at])


def test_what_is_not_known_bounds_nothing() -> None:
    body = of_points(np.ones(3), np.random.default_rng(1).normal(size=(3, 3)))
    some = np.where(np.isin(NAMES, ["mass", "Iyy"]), body, np.nan)
    found = largest(some)
    assert found[NAMES.index("mc_x")] == pytest.approx(np.sqrt(body[0] * body[NAMES.index("Iyy")]))
    assert found[NAMES.index("mc_y")] == found[NAMES.index("Ixy")] == 0


def test_masses_compare_with_themselves_and_first_moments_with_what_they_can_be() -> None:
    body = about(2.0, np.array([0, 0, 0.1]), np.diag([0.02, 0.02, 0.01]))
    size = sizes_of_body(body)
    assert size[0] == 0
    half = 0.2 * np.where(size > 0, size, body)
    assert determined(body - half, body + half, size).all()
    assert not determined(body - 1.3 * half, body + 1.3 * half, size).any()
    np.testing.assert_array_equal(openness(np.array([np.nan, 0]), np.array([1, np.inf]), np.ones(2)), np.inf)


def test_a_sum_compares_with_its_parts_unless_it_cannot_be_negative() -> None:
    standard = PLANAR.base.standard_names
    size = dict(zip(PLANAR.names, sizes_of_chain(PLANAR), strict=True))
    own = dict(zip(standard, sizes_of_chain(PLANAR, np.eye(len(standard))), strict=True))
    assert PLANAR.sums["link2.mc_y"] == "link2.mc_y"
    assert size["link2.mc_y"] == own["link2.mc_y"] > 0
    assert PLANAR.sums["link1.mc_x"] == "link1.mc_x + 0.4 link2.mass"
    assert size["link1.mc_x"] == pytest.approx(own["link1.mc_x"] + 0.4 * PLANAR.links[1, 0])
    assert size["joint1.viscous_friction"] == own["link1.mass"] == own["link2.Izz"] == 0
