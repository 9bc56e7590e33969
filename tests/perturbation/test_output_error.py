"""Impedance by output error: the simulated deviation, what is found from it, and what is refused."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaximp.models import ArmGeometry
from jaximp.perturbation.isolation import output_error as module
from jaximp.perturbation.isolation.output_error import OutputErrorFit, output_error
from jaximp.perturbation.trials import Trials
from jaximp.simulation.neuromuscular import RATE, NeuromuscularArm, Reach, neural_noise, perturbing_forces, reach

ARM = NeuromuscularArm()
GEOMETRY = ArmGeometry((0.29, 0.34))
PERTURBED, OTHERS = 20, 40


class Simulated(eqx.Module):
    """20 perturbed trials, the same without the perturbation, 40 others, and the true stiffness (20, 3)."""

    perturbed: Trials
    twins: Trials
    unperturbed: Trials
    K: Any


@pytest.fixture(scope="module")
def trials() -> Simulated:
    task, keys = Reach(duration=1.0), jax.random.split(jax.random.key(5), 3)
    noise = jnp.concatenate([neural_noise(k, n, 3400) for k, n in zip(keys, (PERTURBED, OTHERS), strict=False)])
    forces = jnp.concatenate([perturbing_forces(keys[2], 1), jnp.zeros((PERTURBED + OTHERS, 2))])
    found = eqx.filter_jit(reach)(ARM, task, forces, jnp.concatenate([noise[:PERTURBED], noise]))
    parts = [jax.tree.map(lambda x, s=s: np.asarray(x[s]), found) for s in np.split(np.arange(80), [20, 40])]
    K = [
        k[first : first + 461].mean(axis=0)
        for k, first in zip(parts[1].stiffness, parts[1].movements.onset, strict=True)
    ]
    return Simulated(*(part.movements for part in parts), np.array(K))


def fit_of(trials: Simulated, **options: Any) -> OutputErrorFit:
    return output_error(trials.perturbed, trials.unperturbed, GEOMETRY, ARM.handle, ARM.inertia, **options)


@pytest.fixture(scope="module")
def fit(trials: Simulated) -> OutputErrorFit:
    return fit_of(trials, groups=np.arange(20).reshape(2, 10))


def lanes_of(perturbed: Trials) -> Any:
    return module._in_lanes(perturbed, GEOMETRY, ARM.handle, module._Bins.of(RATE, 0.115))


THETA = np.array(
    [
        2.4,
        1.2,
        1.1,
        1.4,
        29.0,
        14.0,
        17.0,
        *np.linspace(-0.3, 0.3, 7),
        *np.linspace(-0.03, 0.03, 6),
        0.19,
        0.074,
        0.084,
        3.3e-4,
    ]
)


@pytest.mark.slow
def test_the_derivative_of_the_deviation_is_its_difference(trials: Simulated) -> None:
    lanes = lanes_of(trials.perturbed)
    of = eqx.filter_jit(module._deviation_in_bins)
    _, S = module._linearised(jnp.asarray(THETA), lanes, GEOMETRY, ARM.handle)
    for k in range(24):
        h = 1e-5 if k < module.PLACES.delay else 1e-7
        ahead, behind = (of(jnp.asarray(THETA + step * np.eye(24)[k]), lanes, GEOMETRY, ARM.handle) for step in (h, -h))
        np.testing.assert_allclose(
            S[..., k], (ahead - behind) / (2 * h), rtol=1e-5, atol=1e-6 * np.abs(S[..., k]).max()
        )


def without_noise(theta: np.ndarray, trials: Simulated) -> Trials:
    """Trials of which the deviation is exactly that of an arm with the parameters theta, found by iteration."""
    found, twins = trials.perturbed, trials.twins
    rows = np.arange(PERTURBED)[:, None], np.asarray(twins.onset)[:, None] + np.arange(461)
    for _ in range(6):
        lanes = lanes_of(found)
        d = module._full_rate(jnp.asarray(theta), lanes, GEOMETRY, ARM.handle, found)
        x, v, a = (np.array(getattr(twins, s)) for s in ("position", "velocity", "acceleration"))
        for signal, change in zip((x, v, a), (d.position, d.velocity, d.acceleration), strict=True):
            signal[rows] -= np.asarray(change)
        found = eqx.tree_at(lambda m: (m.position, m.velocity, m.acceleration), found, (x, v, a))
    return found


@pytest.mark.slow
@pytest.mark.compiles
def test_an_impedance_without_noise_is_given_back(trials: Simulated, monkeypatch: pytest.MonkeyPatch) -> None:
    theta = THETA.copy()
    theta[module.PLACES.delay], theta[module.PLACES.inertia] = 0.0, ARM.inertia
    perturbed = without_noise(theta, trials)
    measured = module._flat(module._binned(trials.twins, 0, 23, module._Bins.of(RATE, 0.115)))
    # The movement that would have been is known, so that nothing but the fit is left to err.
    monkeypatch.setattr(module.Continuation, "predict", lambda prior, past: measured)
    monkeypatch.setattr(module, "TREND", (1e4, 1e4, 1e4))
    monkeypatch.setattr(module, "BEND", 1e4)
    monkeypatch.setattr(module, "SMALL_STEP", 1e-9)
    fit = output_error(perturbed, trials.unperturbed, GEOMETRY, ARM.handle, ARM.inertia)
    np.testing.assert_allclose(fit.D.ravel(), theta[:4], rtol=1e-6)
    np.testing.assert_allclose(fit.K.ravel(), theta[[4, 5, 5, 6]], rtol=1e-6)
    np.testing.assert_allclose(fit.kappa, theta[module.PLACES.kappa], atol=1e-5)
    np.testing.assert_allclose(fit.bend, theta[module.PLACES.bend], atol=1e-5)
    assert abs(fit.delay) < 1e-8


@pytest.mark.slow
@pytest.mark.compiles
def test_the_deviation_is_that_of_the_twins(trials: Simulated, fit: OutputErrorFit) -> None:
    """To what the trials' own impedance differs from their mean: within 1 % in position, and zero at the onset."""
    rows = np.arange(PERTURBED)[:, None], np.asarray(trials.twins.onset)[:, None] + np.arange(461)
    for signal, share in (("position", 0.01), ("velocity", 0.01), ("acceleration", 0.01), ("force", 0.02)):
        true = getattr(trials.twins, signal)[rows] - getattr(trials.perturbed, signal)[rows]
        found = np.asarray(getattr(fit.deviations, signal))
        assert found.shape == true.shape == (PERTURBED, 461, 2)
        assert np.sqrt(((found - true) ** 2).mean()) < share * np.abs(true).max(), signal
    assert np.abs(fit.deviations.position[:, 0]).max() < 1e-12


def test_the_impedance_is_found(trials: Simulated, fit: OutputErrorFit) -> None:
    """In a movement of 1 s, where feedback jerk isolation errs by 15 %, from 10 trials a group."""
    assert fit.K.shape == fit.D.shape == (2, 2, 2)
    assert fit.covariance.shape == (2, 24, 24)
    assert fit.ok.all()
    assert (fit.chi2 > 0.3).all()
    for k, group in enumerate(np.arange(20).reshape(2, 10)):
        K = trials.K[group].mean(axis=0)[[0, 1, 1, 2]].reshape(2, 2)
        assert np.abs(fit.K[k] - K).max() < 0.06 * K.max()
        assert np.abs(fit.D[k] - K / 12).max() < 0.05 * K.max() / 12
        of_D, of_K = (margin[k] for margin in fit.margin())
        assert (np.abs(fit.K[k] - K) < of_K).all()
        assert (of_K < 0.15 * K.max()).all()
        assert (of_D < 0.15 * K.max() / 12).all()


@pytest.mark.slow
@pytest.mark.compiles
def test_a_steep_course_may_bend(trials: Simulated, fit: OutputErrorFit, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a movement of 1 s K11 changes by 70 %, unevenly: a straight course finds it too small, and too surely."""
    monkeypatch.setattr(module, "BEND", 1e-9)
    straight = fit_of(trials, groups=np.arange(20).reshape(2, 10))
    assert (np.abs(fit.kappa[:, 4]) > 0.5).all()
    assert (fit.K[:, 0, 0] > straight.K[:, 0, 0]).all()
    assert (fit.stderr[:, 4] > 1.1 * straight.stderr[:, 4]).all()


def test_weights_do_not_hide_the_residuals_that_they_are_made_of() -> None:
    """From 40 residuals in 20 directions; by weights that know all of them, variances come out at less than half."""
    random, n, b, T = np.random.default_rng(0), 40, 20, 8
    S, members = random.normal(size=(T, b, 24)), np.arange(T)
    known = module._Known(np.zeros(24), 1e-6 * np.eye(24))
    squares, claimed, careless = [], [], []
    for _ in range(60):
        R = random.normal(size=(n, b))
        r = random.normal(size=(T, b)) + random.normal(size=b) / np.sqrt(n)

        def weighed(unseen: np.ndarray, of: np.ndarray, r: np.ndarray = r) -> Any:
            return module._Weighed.of(r, S, np.zeros(24), unseen, np.linalg.cholesky(of.T @ of / len(of)))

        out = [np.arange(n) % 10 == k for k in range(10)]
        folds = tuple(weighed(R[some], R[~some]) for some in out)
        step = module._Linear(np.zeros(24), r, weighed(R[:0], R), folds).solve(members, known)
        squares.append(step.theta**2)
        claimed.append(np.diag(step.covariance))
        within = module._Linear(np.zeros(24), r, weighed(R[:0], R), (weighed(R, R),)).solve(members, known)
        careless.append(np.diag(within.covariance) / max(1.0, float(within.chi2)))
    assert 0.8 < np.mean(claimed) / np.mean(squares) < 1.25
    assert np.mean(careless) / np.mean(squares) < 0.5


@pytest.mark.slow
def test_one_group_has_no_leading_axis(trials: Simulated, fit: OutputErrorFit) -> None:
    alone = fit_of(trials)
    assert alone.K.shape == (2, 2)
    assert alone.stderr.shape == (24,)
    assert bool(alone.ok)
    np.testing.assert_allclose(alone.K, fit.K.mean(axis=0), rtol=0.05)
    assert (alone.stderr[4:7] < fit.stderr[:, 4:7]).all()


@pytest.mark.slow
@pytest.mark.parametrize("late", [-3, 2, 32])
def test_motion_that_lags_its_command_is_found(trials: Simulated, late: int) -> None:
    early = eqx.tree_at(lambda m: m.command, trials.perturbed, np.roll(trials.perturbed.command, -late, axis=1))
    fit = fit_of(eqx.tree_at(lambda t: t.perturbed, trials, early))
    assert abs(fit.delay - late / RATE) < 2e-5
    np.testing.assert_allclose(fit.K, fit_of(trials).K, rtol=2e-3)


def test_a_slower_recording_is_integrated_in_the_same_steps(trials: Simulated) -> None:
    fast = eqx.tree_at(lambda m: m.onset, trials.perturbed, trials.perturbed.onset // 4 * 4)
    m, every = fast, slice(None, None, 4)
    signals = (jnp.asarray(x[:, every]) for x in (m.position, m.velocity, m.acceleration, m.force, m.command))
    slow = Trials(*signals, jnp.asarray(m.onset // 4), RATE / 4)
    found = module._in_lanes(slow, GEOMETRY, ARM.handle, module._Bins.of(RATE / 4, 0.115))
    expected = lanes_of(fast)
    assert (found.rate, found.finer, found.width) == (RATE, 4, 5)
    for name in ("q", "dq", "ddq", "carried", "command"):
        size = np.abs(getattr(expected, name)).max()
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), atol=2e-3 * size, err_msg=name)


@pytest.mark.slow
def test_a_command_in_another_frame_is_noticed(trials: Simulated) -> None:
    """Turned by 0.1 rad: no impedance explains the motion."""
    turn = np.array([[np.cos(0.1), np.sin(0.1)], [-np.sin(0.1), np.cos(0.1)]])
    fit = fit_of(eqx.tree_at(lambda t: t.perturbed.command, trials, trials.perturbed.command @ turn))
    assert fit.chi2 > module.MISFIT
    assert not fit.ok


def broken(trials: Simulated, where: str) -> Simulated:
    """Trials of which one thing is wrong."""
    nothing = np.where(np.arange(PERTURBED) == 3, np.nan, 0)[:, None, None]
    at = {
        "few": (lambda t: t.unperturbed, jax.tree.map(lambda x: x[:4], trials.unperturbed)),
        "nan": (lambda t: t.perturbed.velocity, trials.perturbed.velocity + nothing),
        "early": (lambda t: t.unperturbed.onset, np.full(OTHERS, 900, np.int32)),
        "late": (lambda t: t.perturbed.onset, np.full(PERTURBED, 3200, np.int32)),
        "still": (lambda t: t.perturbed.command, np.zeros_like(trials.perturbed.command)),
        "shape": (lambda t: t.perturbed.command, trials.perturbed.command[:, :-1]),
        "rate": (lambda t: t.perturbed, slower(trials.perturbed)),
    }  # fmt: skip
    return eqx.tree_at(at[where][0], trials, at[where][1])


def slower(m: Trials) -> Trials:
    return Trials(m.position, m.velocity, m.acceleration, m.force, m.command, m.onset, 2000.0)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("few", "4 unperturbed trials cannot tell how a movement goes on: at least 5"),
        ("nan", "the velocity of perturbed trial 3 is not finite near its onset: fill the gap"),
        ("early", "unperturbed trial 0 has 0.22525 s before its onset, and 0.3 s are needed"),
        ("late", "perturbed trial 0 ends 0.04975 s after its onset, before the window of 0.115 s does"),
        ("still", "perturbed trial 0 has no command in its window"),
        ("shape", "all signals must be"),
        ("rate", "bring them to one rate"),
    ],
)
def test_trials_that_cannot_be_used_are_refused(trials: Simulated, where: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_of(broken(trials, where))


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"groups": np.array([[0, 20]])}, "groups name trials 0 to 20, and there are trials 0 to 19"),
        ({"groups": np.arange(20)}, "one row for each group"),
        ({"window": 0.01}, "it must have at least 4"),
        ({"inertia_stderr": np.zeros(3)}, "inertia_stderr is .* three finite numbers above zero"),
    ],
)
def test_options_that_make_no_sense_are_refused(trials: Simulated, options: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit_of(trials, **options)
