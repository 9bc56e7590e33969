"""The nearest robot and ranges over robots: against closed forms of a pendulum, and a six-joint arm."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

from factories.real_robots import PENDULUM, PLANAR, another, estimated, is_real
from factories.robots import joint, link, robot
from jaximp.consistency import barrier, cone_of, consistent_fit, consistent_ranges, programs
from jaximp.consistency.cone import pose
from jaximp.models.chain import Chain
from jaximp.models.urdf import SIX_JOINT_ARM, parse_urdf

pytest.importorskip("cvxpy", reason="the programs need cvxpy: pip install 'jaximp[robots]'")

ARM = Chain.from_urdf(SIX_JOINT_ARM, friction=True, rotor=True)


@pytest.mark.parametrize("seed", range(20))
def test_the_cone_holds_real_robots_alone(seed: int) -> None:
    cone = cone_of(PLANAR)
    random = np.random.default_rng(seed)
    standard = PLANAR.standard_parameters * (1 + 0.6 * random.normal(size=len(cone.names)))
    assert cone.holds(standard) == is_real(PLANAR, standard)
    assert cone.holds(another(PLANAR, seed))


@pytest.mark.parametrize("chain", [PENDULUM, PLANAR, ARM], ids=["pendulum", "planar", "arm"])
def test_a_real_robots_estimate_is_kept(chain: Chain) -> None:
    truth = another(chain, 3, 0.2)
    theta, C = estimated(chain, truth, 0.02)
    found = consistent_fit(chain, theta, C)
    assert found.distance < 0.1
    np.testing.assert_allclose(found.base, theta, rtol=0, atol=0.1 * np.sqrt(np.diag(C)).max())
    np.testing.assert_allclose(chain.base.map @ found.standard, found.base)
    assert is_real(chain, found.standard)
    assert found["link1.mass"].value == found.standard[0]


def test_the_urdfs_own_values_come_back() -> None:
    _, C = estimated(ARM, ARM.standard_parameters, 0.02)
    standard = np.where(np.char.endswith(ARM.base.standard_names, "rotor_inertia"), 0.01, ARM.standard_parameters)
    found = consistent_fit(ARM, ARM.base.map @ standard, C)
    np.testing.assert_allclose(found.standard[:60:10], ARM.links[:, 0], rtol=0.05)


def test_an_impossible_estimate_gives_the_nearest_robot() -> None:
    """Below zero friction goes to zero, and the others follow by their covariance with it."""
    theta, C = estimated(PENDULUM, PENDULUM.standard_parameters, 0.02)
    own = C[3, 3]
    theta[3] = -3 * np.sqrt(own)
    found = consistent_fit(PENDULUM, theta, C)
    np.testing.assert_allclose(found.base, theta - C[:, 3] / own * theta[3], atol=1e-2 * np.sqrt(own))
    assert found.distance == pytest.approx(3, rel=1e-3)
    assert is_real(PENDULUM, found.standard)


def test_noisy_estimates_of_an_arm_become_real() -> None:
    theta, C = estimated(ARM, ARM.standard_parameters, 0.1, seed=2)
    found = consistent_fit(ARM, theta, C)
    assert is_real(ARM, found.standard)
    d = found.base - theta
    assert found.distance == pytest.approx(np.sqrt(d @ np.linalg.solve(C, d)), rel=1e-6)
    assert 0.1 < found.distance < 8
    masses = consistent_fit(ARM, theta, C, masses={"link2": (6, 7), "total": (21, 22)}).standard[:60:10]
    assert 6 - 1e-6 <= masses[1] <= 7 + 1e-6
    assert 21 - 1e-6 <= masses.sum() <= 22 + 1e-6


def test_ranges_of_a_pendulum_are_those_of_closed_forms() -> None:
    """With moments known exactly, the mass is least where all of it is at one distance: `|mc|^2 / Iyy`."""
    standard = PENDULUM.standard_parameters
    theta, C = estimated(PENDULUM, standard, 1e-5)
    found = consistent_ranges(PENDULUM, theta, C)
    at = {name: k for k, name in enumerate(found.names)}
    mx, mz, inertia = (standard[at[f"link1.{name}"]] for name in ("mc_x", "mc_z", "Iyy"))
    assert found.low[at["link1.mass"]] == pytest.approx((mx**2 + mz**2) / inertia, rel=1e-3)
    assert found.high[at["link1.mass"]] == np.inf
    limited = consistent_ranges(PENDULUM, theta, C, ["link1.mass", "link1.mc_y", "link1.Izz"], masses={"link1": (0, 3)})
    assert limited.high[0] == pytest.approx(3, rel=1e-6)
    # What is spread along the axis is not seen: its first moment and its inertia have no end.
    np.testing.assert_array_equal(np.isinf([limited.low, limited.high]), [[False, True, False], [False, True, True]])
    assert limited.low[2] == pytest.approx(mx**2 / 3, rel=2e-2)
    words = found.in_words()
    assert words[0] == f"mass of link 1: {(mx**2 + mz**2) / inertia:.3g} kg or more: not determined"
    assert next(line for line in words if "mc_x" in line).startswith("mc_x of link 1: 0.0")


@pytest.mark.parametrize("simultaneous", [False, True])
def test_determined_parameters_have_the_intervals_of_estimates(simultaneous: bool) -> None:
    theta, C = estimated(PENDULUM, PENDULUM.standard_parameters + 0.3, 0.01)
    names = ["joint1.viscous_friction", "link1.mc_x"]
    found = consistent_ranges(PENDULUM, theta, C, names, level=0.9, simultaneous=simultaneous)
    index = [PENDULUM.names.index(name) for name in names]
    half = np.sqrt(stats.chi2(4 if simultaneous else 1).ppf(0.9) * np.diag(C)[index])
    np.testing.assert_allclose(
        [found.low, found.high], [theta[index] - half, theta[index] + half], atol=1e-4 * half.min()
    )
    assert found.determined.all()
    assert not any("not determined" in line for line in found.in_words())


@pytest.mark.parametrize("seed", range(3))
def test_ranges_hold_the_truth_and_are_wide_where_the_base_is_blind(seed: int) -> None:
    truth = another(ARM, seed, 0.15)
    theta, C = estimated(ARM, truth, 0.03, seed=seed)
    names = [name for name in ARM.base.standard_names if name.endswith((".mass", "viscous_friction"))]
    found = consistent_ranges(ARM, theta, C, names, masses={"total": (0, 40)}, simultaneous=True)
    own = truth[[ARM.base.standard_names.index(name) for name in names]]
    assert ((found.low <= own) & (own <= found.high)).all()
    assert not found.determined[:6].any()
    assert found.high[0] > 20
    assert found.low[0] < 0.1
    assert found.in_words()[0].startswith("mass of link 1: 0 to ")


def test_an_estimate_far_from_every_robot_is_said_to_be() -> None:
    theta, C = estimated(PENDULUM, PENDULUM.standard_parameters, 0.01)
    theta[3] = -4 * np.sqrt(C[3, 3])
    found = consistent_ranges(PENDULUM, theta, C, ["joint1.viscous_friction"])
    assert found.low == 0
    assert found.high > 0
    assert found.in_words()[0].startswith("no real robot lies within the errors of the estimate: the nearest is ")
    theta[3] = -2.5 * np.sqrt(C[3, 3])  # as happens to one of so many parameters
    assert not consistent_ranges(PENDULUM, theta, C, ["joint1.viscous_friction"]).notes


def test_what_was_not_estimated_is_left_open() -> None:
    theta, C = estimated(PENDULUM, PENDULUM.standard_parameters, 0.01)
    theta[3] = np.nan
    C[3] = C[:, 3] = np.nan
    found = consistent_ranges(PENDULUM, theta, C, ["joint1.viscous_friction"])
    assert (found.low, found.high) == (0, np.inf)
    assert found.in_words() == ["viscous friction of joint 1: 0 N m s/rad or more: not determined"]
    assert consistent_fit(PENDULUM, theta, C).base[3] == pytest.approx(PENDULUM.parameters[3], abs=1e-3)


def test_links_of_the_urdf_that_are_no_bodies_are_named() -> None:
    thin = robot(
        '<link name="base"/>',
        joint("one", "base", "rod"),
        link("rod", 2.0, inertia="0.1 0 0 0.01 0 0.01"),
        joint("two", "rod", "ghost"),
        link("ghost", 0.0, inertia="0 0 0 0 0 0"),
    )
    chain = Chain(parse_urdf(thin))
    cone = cone_of(chain)
    assert cone.notes[0].startswith("in the URDF no real bodies: link1 (rod) and link2 (ghost)")
    assert cone.holds(cone.reference)
    assert not cone.holds(chain.standard_parameters)


WRONG: list[tuple[dict[str, Any], str]] = [
    ({"estimate": np.zeros(3)}, r"the 4 base parameters of this chain they are \(4,\) and \(4, 4\)"),
    ({"covariance": np.zeros((4, 4))}, "the variance of .* is 0: it must be above zero; pass NaN"),
    ({"covariance": np.ones((4, 4))}, "is not positive definite: pass that of the estimate"),
    ({"masses": {"link2": (0, 1)}}, "masses has 'link2': did you mean 'link1'"),
    ({"masses": {"link1": (2, 1)}}, r"masses has link1 = \(2, 1\) kg: give the least and the most"),
    ({"masses": {"link1": (0, 1), "total": (2, 3)}}, "no robot was found near the estimate .*: widen the masses"),
]


@pytest.mark.parametrize(("wrong", "message"), WRONG, ids=lambda x: x if isinstance(x, str) else "")
@pytest.mark.usefixtures("unchecked")
def test_what_is_wrong_is_said_in_one_line(wrong: dict[str, Any], message: str) -> None:
    right: dict[str, Any] = {"estimate": PENDULUM.parameters, "covariance": np.eye(4)}
    with pytest.raises(ValueError, match=message) as caught:
        consistent_fit(PENDULUM, **(right | wrong))
    assert "\n" not in str(caught.value)


def test_ranges_say_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    given = PENDULUM, PENDULUM.parameters, np.eye(4)
    with pytest.raises(ValueError, match=r"no standard parameter 'link1\.mas': did you mean 'link1\.mass'"):
        consistent_ranges(*given, ["link1.mas"])
    with pytest.raises(ValueError, match=r"level is 95\.0: it must lie between 0 and 1"):
        consistent_ranges(*given, level=95.0)
    monkeypatch.setattr(programs, "find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"pip install 'jaximp\[robots\]'"):
        consistent_ranges(*given)


@pytest.mark.parametrize("chain", [PENDULUM, PLANAR, ARM], ids=["pendulum", "planar", "arm"])
@pytest.mark.parametrize("errors", [0.0, 3.0, 30.0])
def test_how_far_robots_are_is_known_without_a_solver(chain: Chain, errors: float) -> None:
    """From below, so that nothing is called impossible that is not."""
    theta, C = estimated(chain, another(chain, 3, 0.2), 0.02)
    theta = theta + errors * np.sqrt(np.diag(C)) * np.random.default_rng(5).choice([-1, 1], len(theta))
    nearest, found = consistent_fit(chain, theta, C).distance, barrier.distance_to_robots(pose(chain, theta, C))
    assert found <= nearest + 1e-6
    assert found == pytest.approx(nearest, rel=0.01, abs=0.1)
