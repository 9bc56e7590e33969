"""Windows that contradict each other beyond their errors: against the analysis of variance, its level, its ends."""

from __future__ import annotations

import numpy as np
import pytest
from statsmodels.stats.oneway import anova_oneway

from jaximp.trust.changes import common_gain, find_changes, levels, same_in_all
from jaximp.trust.score_tests import FAMILYWISE


def test_with_errors_well_known_it_is_the_analysis_of_variance_of_welch() -> None:
    random = np.random.default_rng(1)
    groups = [random.normal(0.01 * k, 1 + k, 20_000 + 3000 * k) for k in range(5)]
    mean, stderr, dof = np.transpose([(x.mean(), x.std(ddof=1) / np.sqrt(len(x)), len(x) - 1) for x in groups])
    expected = anova_oneway(groups, use_var="unequal", welch_correction=True)
    assert 1e-3 < expected.pvalue < 0.2
    assert same_in_all(mean, stderr, dof).p == pytest.approx(expected.pvalue, rel=1e-2)


@pytest.mark.parametrize(("windows", "dof"), [(4, 50.0), (30, 4.0), (300, 8.0)])
def test_constant_parameters_are_called_so(windows: int, dof: float) -> None:
    """Errors with few degrees of freedom are themselves uncertain."""
    random, records = np.random.default_rng(2), 2000
    true = random.lognormal(0, 0.3, (records, windows))
    value, stderr = true * random.normal(size=true.shape), true * np.sqrt(random.chisquare(dof, true.shape) / dof)
    p = np.array([same_in_all(x, s, np.full(windows, dof)).p for x, s in zip(value, stderr, strict=True)])
    for level in (0.01, 0.05):
        assert (p < level).mean() == pytest.approx(level, abs=0.2 * level + 3.5 * np.sqrt(level / records))


def test_the_ends_leave_out_what_the_errors_add() -> None:
    random = np.random.default_rng(3)
    truth = np.repeat([40.0, 80.0], 200)
    for error in (0.1, 5.0):
        found = same_in_all(truth + error * random.normal(size=400), np.full(400, error), np.full(400, 100.0))
        assert found.p < 1e-6
        assert found.low == pytest.approx(40, abs=3 * error)
        assert found.high == pytest.approx(80, abs=3 * error)
    same = same_in_all(60 + 5 * random.normal(size=400), np.full(400, 5.0), np.full(400, 100.0))
    assert same.high - same.low < 4


def test_what_changes_is_found_by_its_column() -> None:
    random = np.random.default_rng(4)
    stderr = np.full((20, 3), 0.1)
    value = 10 + 0.1 * random.normal(size=(20, 3))
    value[10:, 1] += 2
    value[0] = np.nan
    dof = np.full(20, 50.0)
    found = find_changes(value, stderr, dof)
    assert list(found) == [1]
    assert found[1].p < FAMILYWISE
    assert find_changes(value[:3], stderr[:3], dof[:3]) == {}


def test_a_change_that_is_sure_but_small_is_not_told() -> None:
    value = 10 + 0.01 * np.repeat([-1.0, 1.0], 10)[:, None]
    found = same_in_all(value[:, 0], np.full(20, 1e-3), np.full(20, 50.0))
    assert found.p < 1e-6
    assert not found.matters
    assert find_changes(value, np.full((20, 1), 1e-3), np.full(20, 50.0)) == {}


@pytest.mark.parametrize("values", [[40.0, 80.0], [1.0, 2.0, 1.5], [3.0]])
def test_levels_are_found(values: list[float]) -> None:
    truth = np.repeat(values, 30)
    found = levels(truth + 0.05 * np.random.default_rng(len(values)).normal(size=len(truth)), np.full(len(truth), 0.05))
    np.testing.assert_allclose([one.value for one in found], values, atol=0.05)
    assert [one.first for one in found] == [30 * k for k in range(len(values))]
    assert [one.last for one in found] == [30 * k + 29 for k in range(len(values))]


def test_a_steady_change_has_no_levels() -> None:
    assert levels(np.linspace(1, 2, 60), np.full(60, 0.01)) == []


def test_of_many_windows_some_are_compared() -> None:
    truth = np.repeat([1.0, 2.0], 500)
    found = levels(truth + 0.1 * np.random.default_rng(0).normal(size=1000), np.full(1000, 0.1))
    assert [one.last for one in found] == [499, 999]


@pytest.mark.parametrize(
    ("name", "course"),
    [
        ("the gain of a sensor", [1.0, 1.0, 1.0]),
        ("nothing", [0.0, 0.0, 0.0]),
        ("stiffness alone", [0.0, 0.0, 1.0]),
        ("damping and stiffness", [0.0, 1.0, 1.0]),
        ("the body, and more than it the muscles", [0.5, 1.5, 1.5]),
    ],
)
def test_a_gain_that_changes_changes_all_parameters_alike(name: str, course: list[float]) -> None:
    found = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        truth = np.array([0.015, 0.7, 60.0]) * (1 + 0.2 * np.outer(np.linspace(0, 1, 30), course))
        stderr = truth * [0.02, 0.03, 0.02]
        found.append(common_gain(truth + stderr * random.normal(size=truth.shape), stderr, np.full(30, 80.0), 0))
    if name != "the gain of a sensor":
        assert not any(found)
        return
    assert sum(one is not None for one in found) >= 19
    gains = [(one.low, one.high) for one in found if one is not None]
    np.testing.assert_allclose(np.mean(gains, axis=0), [1 - 0.2 / 2.6, 1 + 0.2 / 2.6], atol=0.02)
