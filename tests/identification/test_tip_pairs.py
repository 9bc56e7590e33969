"""A human at the end of a robot, told from it by four methods."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from factories.chains import HELD, HUMAN, SIZES, motion, truth_of
from jaximp.identification.separation import Regression
from jaximp.identification.solving import Placement
from jaximp.identification.tip_pairs import TipFit, TipPair, fit_tip, robot_of
from jaximp.models import Chain, TipImpedance, combine
from jaximp.models.base import Combined

EVERY, SEEDS = 10, 12
TRUTH = np.array(list(HUMAN.values()))


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> tuple[Chain, TipImpedance, Combined]:
    path = tmp_path_factory.mktemp("tip") / "held.urdf"
    path.write_text(HELD, encoding="utf-8")
    chain = Chain.from_urdf(path, tip="hand", friction=True)
    human = TipImpedance(chain, "xz")
    return chain, human, combine(chain, human)


def regression(
    models: tuple[Chain, TipImpedance, Combined], seed: int, moves: int, theta: np.ndarray, robot: np.ndarray
) -> Regression:
    chain, human, _ = models
    sample = [x[::EVERY] for x in motion(moves)[1:]]
    W, H = chain.observation_matrix(*sample), human.observation_matrix(*sample)
    noise = SIZES * np.random.default_rng(seed).normal(size=W.shape[:2])
    torque = W @ robot + H @ theta + noise
    return Regression(W, H, jnp.asarray(torque), jnp.ones(W.shape[:2], bool))


def pair_of(
    models: tuple[Chain, TipImpedance, Combined],
    seed: int,
    moves: int | None = None,
    robot: np.ndarray | None = None,
    change: np.ndarray | None = None,
    gains: np.ndarray | None = None,
) -> TipPair:
    """The robot alone, and with the human; perhaps on another motion, or another robot by then."""
    own = truth_of(models[0])
    alone = regression(models, 1000 + seed, seed, 0 * TRUTH, own)
    loaded = regression(models, 2000 + seed, seed if moves is None else moves, TRUTH, own if robot is None else robot)
    known = robot_of(alone)
    change = np.zeros((len(own), len(own))) if change is None else change
    return TipPair(alone, loaded, known, change, gains, len(alone.torque))


def place(rows: int, step: int, count: int) -> Placement:
    starts = step * np.arange(count)
    return Placement(rows, step, rows, rows, False, starts, starts + rows, separate=False)


def whole(pair: TipPair, method: int, both: Combined) -> TipFit:
    n = len(pair.loaded.torque)
    return fit_tip(method, pair, both, place(n, n, 1))


@pytest.mark.parametrize("method", [1, 2, 3, 4])
def test_intervals_hold_the_truth(models: tuple[Chain, TipImpedance, Combined], method: int) -> None:
    """In about 95 of 100 cases: 96 intervals, of which 7 % more or less are chance."""
    from scipy.special import stdtrit

    holds, errors = [], []
    for seed in range(SEEDS):
        fit = whole(pair_of(models, seed), method, models[2]).fit
        theta, stderr, dof = (np.asarray(x)[0] for x in (fit.theta, fit.stderr, fit.dof))
        holds.append(np.abs(theta - TRUTH) < stdtrit(dof, 0.975) * stderr)
        errors.append((theta - TRUTH) / stderr)
        assert (stderr < 0.2 * np.abs(TRUTH)).all()
    assert 0.88 <= np.mean(holds) <= 1
    assert 0.6 < np.sqrt(np.mean(np.square(errors))) < 1.5


def test_windows_see_their_own_rows_and_all_of_the_robots(models: tuple[Chain, TipImpedance, Combined]) -> None:
    pair = pair_of(models, 0)
    late = np.arange(len(pair.loaded.torque)) >= 120
    stiffer = TRUTH * np.where(np.arange(8) == 4, 2.0, 1.0)
    more = late[:, None] * np.asarray(pair.loaded.human @ (stiffer - TRUTH))
    loaded = Regression(pair.loaded.robot, pair.loaded.human, pair.loaded.torque + more, pair.loaded.valid)
    changed = TipPair(pair.alone, loaded, pair.robot, pair.change, None, pair.first)
    for method in (1, 2, 3, 4):
        fit = fit_tip(method, changed, models[2], place(80, 120, 2)).fit
        for k, truth in enumerate((150.0, 300.0)):
            assert abs(fit.theta[k, 4] - truth) < 5 * fit.stderr[k, 4]
            assert fit.stderr[k, 4] < 10


def test_a_window_without_motion_tells_nothing(models: tuple[Chain, TipImpedance, Combined]) -> None:
    pair = pair_of(models, 0)
    valid = jnp.asarray(np.arange(len(pair.loaded.torque)) >= 100)[:, None] & pair.loaded.valid
    loaded = Regression(pair.loaded.robot, pair.loaded.human, pair.loaded.torque, valid)
    half_blind = TipPair(pair.alone, loaded, pair.robot, pair.change, None, pair.first)
    fit = fit_tip(1, half_blind, None, place(100, 100, 2)).fit
    assert np.isnan(np.asarray(fit.theta[0])).all()
    assert np.isnan(np.asarray(fit.stderr[0])).all()
    assert np.isfinite(np.asarray(fit.theta[1])).all()


@pytest.mark.parametrize("method", [1, 2, 3, 4])
def test_errors_hold_a_change_of_the_robot(models: tuple[Chain, TipImpedance, Combined], method: int) -> None:
    """By as much as such a change moves the human."""
    own = truth_of(models[0])
    k = models[0].names.index("joint2.viscous_friction")
    apart = np.where(np.arange(len(own)) == k, 1e-4, 0.0)  # so small that the joints' weights stay
    plain = whole(pair_of(models, 3), method, models[2]).fit
    moved = whole(pair_of(models, 3, robot=own + apart), method, models[2]).fit
    held = whole(pair_of(models, 3, change=np.outer(3e3 * apart, 3e3 * apart)), method, models[2]).fit
    expected = np.hypot(plain.stderr, 3e3 * (moved.theta - plain.theta))
    np.testing.assert_allclose(held.stderr, expected, rtol=5e-2)  # weights settle to some thousandths
    # Method 2 lets the friction be what it is in each recording: only links are the robot's and the human's together.
    assert bool(np.asarray(held.stderr / plain.stderr).max() > 2) is (method != 2)


@pytest.mark.parametrize("method", [1, 2, 3, 4])
def test_gains_scale_all(models: tuple[Chain, TipImpedance, Combined], method: int) -> None:
    """What gains have in common scales robot and human alike."""
    plain = whole(pair_of(models, 4), method, models[2]).fit
    scaled = whole(pair_of(models, 4, gains=np.full((2, 2), 0.1**2)), method, models[2]).fit
    expected = np.hypot(np.asarray(plain.stderr), 0.1 * np.abs(np.asarray(plain.theta)))
    np.testing.assert_allclose(np.asarray(scaled.stderr), expected, rtol=1e-6)


def test_two_motions_are_refused_by_method_3(models: tuple[Chain, TipImpedance, Combined]) -> None:
    one = whole(pair_of(models, 5), 3, models[2])
    assert one.doubts is None
    assert "differs by" in one.note
    two = whole(pair_of(models, 5, moves=6), 3, models[2])
    assert two.doubts is not None
    assert set(two.doubts) == set(range(8))
    assert "two motions and not one" in two.note
