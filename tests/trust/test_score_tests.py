"""Tests of added columns: against the regression that has them, their level in white rows, and Holm's rule."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import block_diag

from jaximp.trust.score_tests import FAMILYWISE, Misfit, score_groups, significant

Numbers = NDArray[np.float64]

WINDOW, WINDOWS = 40, 6
THETA = np.array([2.0, -1.0, 0.5])


def rows(random: np.random.Generator, windows: int = WINDOWS) -> tuple[Numbers, Numbers, Numbers]:
    """Columns (N, 3), the last a constant, further columns (N, 3), and a torque without these."""
    n = windows * WINDOW
    W = np.column_stack([random.normal(size=(n, 2)), np.ones(n)])
    further = random.normal(size=(n, 3)) + 0.5 * W[:, :1] + 0.3
    return W, further, W @ THETA + random.normal(size=n)


@pytest.mark.parametrize("every", [1, 2])
def test_weights_and_moves_are_those_of_the_fit_with_the_columns(every: int) -> None:
    random = np.random.default_rng(1)
    W, Z, y = rows(random)
    y = y + Z @ [0.5, 0.0, -0.2] + np.repeat(random.normal(size=WINDOWS), WINDOW)
    y[: 2 * WINDOW] *= 3  # other windows weigh more
    valid = np.ones(len(y), bool)
    valid[[5, 50, 51, 52]] = False
    (found,) = score_groups(W, y, {"further": Z}, valid, WINDOW, every)

    parts = [k * WINDOW + np.flatnonzero(valid[k * WINDOW : (k + 1) * WINDOW]) for k in range(WINDOWS)]
    alone = np.array([np.linalg.lstsq(W[part], y[part])[0] for part in parts])
    left = [y[part] - W[part] @ theta for part, theta in zip(parts, alone, strict=True)]
    sd = [np.sqrt(e @ e / (len(e) - every * W.shape[1])) for e in left]
    own = block_diag(*(W[part] / s for part, s in zip(parts, sd, strict=True)))
    shared = np.concatenate([Z[part] / s for part, s in zip(parts, sd, strict=True)])
    torque = np.concatenate([y[part] / s for part, s in zip(parts, sd, strict=True)])
    everything = np.column_stack([own, shared])
    theta = np.linalg.lstsq(everything, torque)[0]
    moved = theta[:-3].reshape(WINDOWS, -1) - alone
    np.testing.assert_allclose(found.weights, theta[-3:], rtol=1e-8)
    np.testing.assert_allclose(found.move, moved.mean(axis=0), rtol=1e-8, atol=1e-10)

    hat = np.concatenate([np.diag(W[part] @ np.linalg.pinv(W[part])) for part in parts])
    scaled = np.concatenate([e / s for e, s in zip(left, sd, strict=True)]) / np.sqrt(1 - hat)
    bread = np.linalg.inv(everything.T @ everything)
    meat = everything.T @ (everything * scaled[:, None] ** 2) * every
    covariance = (bread @ meat @ bread)[-3:, -3:]
    assert found.statistic == pytest.approx(theta[-3:] @ np.linalg.solve(covariance, theta[-3:]), rel=1e-8)
    passed = -np.mean([np.linalg.pinv(W[part]) @ Z[part] for part in parts], axis=0)
    np.testing.assert_allclose(found.stderr, np.sqrt(np.diag(passed @ covariance @ passed.T)), rtol=1e-8)


def test_beside_a_group_others_have_the_weights_of_the_fit_with_both() -> None:
    W, Z, y = rows(np.random.default_rng(8))
    y, valid = y + 0.4 * Z[:, 0] + 0.3 * Z[:, 1], np.ones(len(y), bool)
    groups = {"one": Z[:, :1], "other": Z[:, 1:]}
    (best, _) = score_groups(W, y, groups, valid, WINDOW)
    rest = y - groups["one"] @ best.weights
    (both,) = score_groups(W, rest, {"both": Z}, valid, WINDOW)
    (other,) = score_groups(W, rest, groups, valid, WINDOW, beside="one")
    np.testing.assert_allclose(other.weights, both.weights[1:], rtol=1e-8)
    np.testing.assert_allclose(other.weights_stderr, both.weights_stderr[1:], rtol=1e-8)


def test_the_unit_of_a_column_changes_nothing() -> None:
    W, Z, y = rows(np.random.default_rng(2))
    valid = np.ones(len(y), bool)
    one, other = (score_groups(W, y, {"further": x}, valid, WINDOW)[0] for x in (Z, Z * [1e6, 1e-6, -1]))
    np.testing.assert_allclose(other.weights * [1e6, 1e-6, -1], one.weights, rtol=1e-6)
    np.testing.assert_allclose([*other.move, other.p], [*one.move, one.p], rtol=1e-6)


@pytest.mark.slow
def test_good_data_raise_as_many_alarms_as_the_level_says() -> None:
    random, records = np.random.default_rng(3), 600
    p, alarms = [], 0
    for _ in range(records):
        W, Z, y = rows(random, windows=20)
        groups = {"one": Z[:, :1], "two": Z[:, 1:], "all": Z, "square": W[:, :1] ** 2}
        found = score_groups(W, y, groups, np.ones(len(y), bool), WINDOW)
        p.append([one.p for one in found])
        alarms += bool(significant(found))
    for level in (0.01, 0.05, 0.5):
        below = (np.array(p) < level).mean(axis=0)
        assert np.abs(below - level).max() < 3.5 * np.sqrt(level * (1 - level) / records), (level, below)
    assert alarms / records < FAMILYWISE + 3.5 * np.sqrt(FAMILYWISE / records)


def test_what_is_missing_raises_one() -> None:
    W, Z, y = rows(np.random.default_rng(4))
    groups = {"innocent": Z[:, :1], "missing": Z[:, 1:2]}
    found = significant(score_groups(W, y + 0.5 * Z[:, 1], groups, np.ones(len(y), bool), WINDOW))
    assert found[0].group == "missing"
    assert found[0].weights[0] == pytest.approx(0.5, abs=0.3)


def test_columns_that_the_model_has_are_no_test() -> None:
    W, _, y = rows(np.random.default_rng(5))
    valid = np.ones(len(y), bool)
    assert score_groups(W, y, {"same": W[:, :2] @ [[1.0], [2.0]]}, valid, WINDOW) == []
    assert score_groups(W, y, {"further": W[:, :1] ** 2}, np.zeros(len(y), bool), WINDOW) == []
    assert score_groups(W, W @ THETA * 0, {"further": W[:, :1] ** 2}, valid, WINDOW) == []


def test_a_window_that_hardly_moves_has_no_say() -> None:
    """Its parameters are free to go anywhere, and would take the mean of all moves along."""
    W, Z, y = rows(np.random.default_rng(6))
    valid = np.ones(len(y), bool)
    kept = score_groups(W[WINDOW:], y[WINDOW:], {"further": Z[WINDOW:]}, valid[WINDOW:], WINDOW)[0]
    W[:WINDOW, 0] *= 1e-3
    with_still = score_groups(W, y, {"further": Z}, valid, WINDOW)[0]
    np.testing.assert_allclose(with_still.move, kept.move, rtol=1e-8)


def misfit(group: str, p: float, evidence: float = 0.0) -> Misfit:
    nothing = np.zeros(1)
    return Misfit(group, p, 0.0, evidence, nothing, nothing, nothing, nothing)


@pytest.mark.parametrize(
    ("p", "found"),
    [
        ((0.002, 0.004, 0.2), "ab"),
        ((0.004, 0.004, 0.2), ""),
        ((0.001, 0.02, 0.001), "ac"),
        ((0.001, 0.006, 0.001), "abc"),
    ],
)
def test_the_level_is_shared_by_the_rule_of_holm(p: tuple[float, ...], found: str) -> None:
    """Each has what is left: a third, a half, all of 1 %; after the first that fails no other counts."""
    tests = [misfit(name, value) for name, value in zip("abc", p, strict=True)]
    assert sorted(one.group for one in significant(tests)) == list(found)


def test_what_explains_most_comes_first() -> None:
    found = significant([misfit("little", 1e-9, 10.0), misfit("much", 1e-5, 80.0)])
    assert [one.group for one in found] == ["much", "little"]
