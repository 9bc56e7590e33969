"""The estimate with every sample: against scipy and numpy, against itself in pieces, and with samples missing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.signal import sosfilt, sosfilt_zi

from factories.live import PIPELINE, RATE, calibration, live, samples, some
from jaximp.identification.filter_settings import FilterSettings
from jaximp.live.calibration import (
    live_of,
    live_pipeline,
    load_calibration,
    load_state,
    save_calibration,
    state_arrays,
)
from jaximp.live.estimator import Estimate, State, Stepper, compiled_run, init, rows
from jaximp.live.front import Sample, front_of, nothing_held
from jaximp.models.base import Joints
from jaximp.models.joint import HumanJoint
from jaximp.tracking.causal import filtered
from jaximp.tracking.state_space import PRIOR

Numbers = NDArray[np.float64]


def assert_same(one: Any, other: Any, rtol: float = 1e-9) -> None:
    for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        a, b = np.asarray(a, float), np.asarray(b, float)
        np.testing.assert_allclose(a, b, rtol=rtol, atol=rtol * max(np.nanmax(np.abs(b), initial=0), 1e-300))


@pytest.fixture(scope="module", params=[False, True], ids=["no jumps", "jumps"])
def whole(request: pytest.FixtureRequest) -> tuple[bool, State, Estimate]:
    """All samples at once."""
    return (request.param, *compiled_run(live(request.param), init(live(request.param)), samples()))


# ---- By another way.


def rows_by_scipy(given: Sample) -> tuple[Numbers, Numbers]:
    """Columns and torque of all rows that count: valid convolutions, and scipy's sections twice."""
    pipeline = live_pipeline(PIPELINE)
    front, sos = front_of(pipeline), np.asarray(pipeline.filters.parallel)
    taps = np.asarray(front.derivatives.taps)
    q, dq, ddq = (np.correlate(given.position, weights, "valid") for weights in taps)
    torque = given.torque[front.derivatives.late :][: len(q)]
    z = np.column_stack([ddq, dq, q, np.ones(len(q)), torque])
    for _ in range(2):
        z = sosfilt(sos, z, axis=0, zi=sosfilt_zi(sos)[..., None] * z[0])[0]
    first = front.derivatives.samples - 1 + front.bridge  # the sample that makes the first of these
    index = first + np.arange(len(z))
    due = (index % front.decimate == 0) & (index - first + 1 >= front.causal.settles) & (index < len(given.position))
    return z[due][:, :4], z[due][:, 4]


def white_by_hand(z: Numbers) -> Numbers:
    """Through both autoregressions: a row less what its past predicts, over the size of what it does not."""
    for noise in (calibration().filtered, calibration().noise):
        covariance = noise.autocovariance(len(z))
        order, last = noise.order, np.prod(1 - noise.reflections**2)
        found = np.empty_like(z)
        for k in range(len(z)):
            m = min(k, order)
            past = covariance[np.abs(np.subtract.outer(np.arange(m), np.arange(m)))]
            weights = np.linalg.solve(past, covariance[1 : m + 1]) if m else np.zeros(0)
            left = 1 - weights @ covariance[1 : m + 1]
            found[k] = (z[k] - weights @ z[k - m : k][::-1]) / np.sqrt(left / last)
        z = found
    return z


def filtered_by_hand(W: Numbers, y: Numbers) -> tuple[Numbers, Numbers]:
    """Kalman's filter of covariances, for both models, and what a mixture of them says in the end."""
    frozen = calibration().frozen
    theta, rows = np.asarray(frozen.theta), len(y) // frozen.grid * frozen.grid
    W, y = W[:rows] * theta / float(frozen.noise), y[:rows] / float(frozen.noise)
    each = []
    for lane in range(2):
        mean, P = np.zeros(4), PRIOR**2 * np.eye(4)
        for k in range(0, rows, frozen.grid):
            P = P + np.diag(frozen.kind.walk[:, lane])
            for row, torque in zip(W[k : k + frozen.grid], y[k : k + frozen.grid], strict=True):
                gain = P @ row / (row @ P @ row + 1)
                keep = np.eye(4) - np.outer(gain, row)
                mean, P = mean + gain * (torque - row @ mean), keep @ P @ keep.T + np.outer(gain, gain)
        each.append((mean, P * frozen.kind.scale[lane]))
    means = np.array([mean for mean, _ in each])
    spread = np.mean([np.diag(P) for _, P in each], axis=0) + means.var(axis=0)
    return means.mean(axis=0) * theta, np.sqrt(spread) * theta


def test_the_path_is_that_of_scipy_and_a_filter_of_covariances() -> None:
    estimate = compiled_run(live(), init(live()), samples())[1]
    W, y = rows_by_scipy(samples())
    z = white_by_hand(np.column_stack([W, y]))
    theta, stderr = filtered_by_hand(z[:, :4], z[:, 4])
    np.testing.assert_allclose(estimate.theta[-1], theta, rtol=1e-7)
    np.testing.assert_allclose(estimate.stderr[-1], stderr, rtol=1e-7)


def test_the_window_is_that_of_numpy() -> None:
    estimate = compiled_run(live(), init(live()), samples())[1]
    window, fit = live().window, jax.tree.map(lambda x: np.asarray(x)[-1], estimate.window)
    W, y = rows_by_scipy(samples())
    z = white_by_hand(np.column_stack([W, y]))
    # Blocks began with the first row of all, before any counted.
    made = -(-len(samples().position) // live_pipeline(PIPELINE).filters.decimate)
    behind = made % window.rows
    last = slice(len(y) - behind - window.length, len(y) - behind)
    theta, squares = np.linalg.lstsq(z[last, :4], z[last, 4])[:2]
    np.testing.assert_allclose(fit.theta, theta, rtol=1e-8)
    covariance = np.linalg.inv(z[last, :4].T @ z[last, :4]) * squares / (window.length - 4)
    np.testing.assert_allclose(fit.stderr, np.sqrt(np.diag(covariance)), rtol=1e-7)
    left = y[last] - W[last] @ theta
    np.testing.assert_allclose(fit.vaf, 1 - left.var() / y[last].var(), rtol=1e-9)
    assert fit.samples == window.length


def test_with_jumps_the_path_is_that_of_the_record() -> None:
    estimate = compiled_run(live(True), init(live(True)), samples())[1]
    frozen = live(True).frozen
    W, y = rows_by_scipy(samples())
    white = white_by_hand(np.column_stack([W, y])) * np.append(frozen.theta, 1) / frozen.noise
    # The filter takes points of the grid from the first row on, and steps before any row counted.
    made = -(-len(samples().position) // live_pipeline(PIPELINE).filters.decimate)
    whole = np.concatenate([np.zeros((made - len(white), 5)), white])
    points = whole[: made // frozen.grid * frozen.grid].reshape(-1, frozen.grid, 5)
    given = (jnp.asarray(x) for x in (frozen.kind.scale, frozen.kind.log_jump, np.ones(4, bool)))
    theta, covariance = filtered(jnp.asarray(points), frozen.kind.motion, *given, frozen.every)
    mean = np.asarray(theta[-1])
    spread = np.asarray(covariance[-1]).diagonal(axis1=0, axis2=1).mean(axis=0) + mean.var(axis=1)
    np.testing.assert_allclose(estimate.theta[-1], mean.mean(axis=1) * frozen.theta, rtol=1e-8)
    np.testing.assert_allclose(estimate.stderr[-1], np.sqrt(spread) * frozen.theta, rtol=1e-8)


# ---- In pieces.


def test_pieces_and_single_samples_give_the_numbers_of_the_whole(whole: tuple[bool, State, Estimate]) -> None:
    jumps, state, estimate = whole
    one = live(jumps)
    middle, first = compiled_run(one, init(one), some(samples(), 0, 600))
    last, second = compiled_run(one, middle, some(samples(), 600, 1200))
    assert_same(last, state)
    assert_same(jax.tree.map(lambda *x: np.concatenate(x), first, second), estimate)
    by_step = Stepper(one, middle)
    for k in range(600, 1200):
        found = by_step(*(x[k].item() for x in samples()))
        if k % 50 == 0:
            assert_same(found, jax.tree.map(lambda x, k=k: x[k], estimate))
    assert_same(by_step.state, state)


def test_a_state_goes_on_after_it_was_kept(tmp_path: Any, whole: tuple[bool, State, Estimate]) -> None:
    jumps, state, _ = whole
    middle = compiled_run(live(jumps), init(live(jumps)), some(samples(), 0, 600))[0]
    save_calibration(calibration(jumps), tmp_path / "kept.npz", state_arrays(middle))
    again = live_of(PIPELINE, load_calibration(tmp_path / "kept.npz"))
    resumed, resumes_at = load_state(tmp_path / "kept.npz", again)
    assert np.isnan(resumes_at)
    assert resumed is not None
    assert_same(compiled_run(again, resumed, some(samples(), 600, 1200))[0], state, rtol=0)


# ---- Samples that are missing.


def known(first: int, last: int) -> Sample:
    """Without some samples, and with numbers in their place that must not matter."""
    q, torque, valid = (x.copy() for x in samples())
    q[first:last], torque[first:last], valid[first:last] = np.nan, 1e9, False
    return Sample(q, torque, valid)


def rows_of(given: Sample) -> tuple[Numbers, NDArray[np.bool_]]:
    front = live().front
    row = jax.jit(lambda held, x: rows(front, held, x))(nothing_held(front), given)[1]
    return np.asarray(row.values), np.asarray(row.valid | ~row.due)


def test_what_a_long_gap_reaches_does_not_count_and_the_rest_is_as_before() -> None:
    front, (plain, counted) = live().front, rows_of(samples())
    values, valid = rows_of(known(500, 540))
    first = 500 + front.bridge  # the newest samples are not looked at yet
    settled = 540 + front.bridge + front.derivatives.samples - 1 + front.causal.settles - 1
    due = np.arange(1200) % front.decimate == 0
    assert not valid[first:settled][due[first:settled]].any()
    np.testing.assert_array_equal(valid[settled + 1 :], counted[settled + 1 :])
    np.testing.assert_array_equal(values[:first], plain[:first])
    assert np.isfinite(values).all()
    # The filter has forgotten how it began.
    np.testing.assert_allclose(values[-1], plain[-1], rtol=1e-6)


def test_a_short_gap_is_bridged_by_a_straight_line() -> None:
    front = live().front
    assert front.bridge >= 1
    values, valid = rows_of(known(500, 500 + front.bridge))
    at = np.arange(1200)
    there = (at < 500) | (at >= 500 + front.bridge)
    q, torque = (np.interp(at, at[there], x[there]) for x in (samples().position, samples().torque))
    wanted, counted = rows_of(Sample(q, torque, np.ones(1200, bool)))
    np.testing.assert_array_equal(valid, counted)
    np.testing.assert_allclose(values, wanted, rtol=1e-9, atol=1e-9)


def test_bands_widen_where_nothing_is_measured_and_stay_finite(whole: tuple[bool, State, Estimate]) -> None:
    jumps, _, plain = whole
    estimate = compiled_run(live(jumps), init(live(jumps)), known(500, 1100))[1]
    stderr = np.asarray(estimate.stderr)
    assert np.isfinite(stderr[400:]).all()
    assert np.isfinite(np.asarray(estimate.theta)[400:]).all()
    assert (stderr[1090] > 1.5 * np.asarray(plain.stderr)[1090])[2]


# ---- What cannot be done.


def test_what_cannot_be_identified_live_is_refused_in_one_line(unchecked: None) -> None:
    with pytest.raises(ValueError, match="one joint without a reflex"):
        front_of(replace(PIPELINE, model=Joints(HumanJoint(), HumanJoint())))
    with pytest.raises(ValueError, match="another model, other filters or another sample rate"):
        live_of(replace(PIPELINE, sample_rate=2 * RATE), calibration())


@pytest.mark.parametrize(
    ("cutoff", "order", "seconds"), [(10.0, 8, 0.514), (40.0, 8, 0.133), (40.0, 4, 0.071), (None, 8, 0.016)]
)
def test_the_delay_is_the_one_that_the_documentation_says(cutoff: float | None, order: int, seconds: float) -> None:
    filters = FilterSettings(position_cutoff=cutoff, position_order=order)
    front = front_of(replace(PIPELINE, sample_rate=1000.0, filter=filters))
    assert front.late / 1000 == pytest.approx(seconds)
    # An impulse comes out that much later, and not before.
    assert front.late == np.abs(np.asarray(front.derivatives.taps)[0]).argmax() + front.bridge
