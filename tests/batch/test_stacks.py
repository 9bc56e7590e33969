"""What a stack of recordings gives: what each gives alone, from few programs."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.typing import NDArray

from factories.studies import JOB, beside, joint, spoilt, still
from jaximp.batch import plan as batch_plan
from jaximp.batch import results as batch_results
from jaximp.batch import run as batch
from jaximp.batch.plan import padded_sizes
from jaximp.identification import rows as identification_rows
from jaximp.identification.estimates import Estimates
from jaximp.identification.identify import in_windows, solve_windows
from jaximp.identification.prepared import Prepared, columns_by_joint, prepare, share_of_stack
from jaximp.identification.solving import Solved, place_windows
from jaximp.identification.whitening import from_filtered, from_white
from jaximp.jobs.job import Job, parse_job
from jaximp.jobs.run import identify_recording
from jaximp.least_squares.sliding import Score, score, sliding_least_squares
from jaximp.least_squares.window import SlidingFit
from jaximp.numerics import compilation
from jaximp.recordings.save import save_recording
from jaximp.types import Recording

pytestmark = pytest.mark.optimised  # programs of the same sums are equal in bits only where users' compiler made them


def assert_same(found: Estimates, expected: Estimates, rtol: float = 0) -> None:
    """To the last bit, unless a tolerance is given."""
    assert found.names == expected.names
    np.testing.assert_array_equal(found.verdicts.verdict, expected.verdicts.verdict)
    for ours, theirs in zip(jax.tree.leaves(found.fit), jax.tree.leaves(expected.fit), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol)
    np.testing.assert_allclose(found.held_out_vaf, expected.held_out_vaf, rtol)
    np.testing.assert_array_equal(found.start, expected.start)
    np.testing.assert_array_equal(found.end, expected.end)
    assert found.threshold == expected.threshold
    assert found.notes == expected.notes


def assert_near(found: Solved, expected: SlidingFit, unseen: Score, trusted: NDArray[np.bool_]) -> None:
    """To rounding; where the windows hardly determine the parameters, rounding is what conditioning makes of it."""
    for name in ("theta", "stderr", "dof", "cond", "sigma_min", "excitation", "residual_rms", "vaf", "samples"):
        ours, theirs = (np.asarray(getattr(fit, name)) for fit in (found.fit, expected))
        np.testing.assert_allclose(ours[trusted], theirs[trusted], 1e-9, 0, err_msg=name)
        np.testing.assert_allclose(ours, theirs, 1e-4, 1e-9, err_msg=name)
    np.testing.assert_array_equal(found.fit.first, expected.first)
    np.testing.assert_array_equal(found.fit.last, expected.last)
    ours, theirs = np.asarray(found.unseen.vaf), np.asarray(unseen.vaf)
    np.testing.assert_allclose(ours[trusted], theirs[trusted], 1e-9, 1e-9)
    np.testing.assert_array_equal(np.isnan(ours), np.isnan(theirs))


CASES = {
    "lengths and rates": ([joint(1321, 1, 251.3), joint(1390, 2)], "", ""),
    "white noise": ([joint(1321)], "decimation_cutoff = 10", ""),
    "noise with a long memory": ([joint(1321, 2)], "decimation_cutoff = 10", "decimation_cutoff = 8\ndecimate = 1"),
    "steps that miss the next window": ([joint(1321)], "step = 0.05", "step = 0.036"),
    "gaps": ([spoilt(spoilt(joint(1321, 3), slice(600, 700)), slice(10, 12))], "", ""),
    "a still stretch": ([still(joint(1321, 5), slice(500, 1000))], "", ""),
    "slow samples": ([joint(1321, 6)], "step = 0.05", "step = 0.05\nmin_velocity = 0.3"),
    "two joints": ([beside(joint(1321, 8), joint(1321, 9))], "", ""),
    "ordinary": ([spoilt(joint(1321, 10), slice(600, 700))], "step = 0.05", "step = 0.05\nestimates = 'ordinary'"),
    "robot": ([joint(1321, 12)], "human = true", "robot = { gravity = true, offset = true }"),
}


LONGEST = (
    "lengths and rates", "robot", "white noise", "steps that miss the next window", "noise with a long memory", "gaps",
)  # fmt: skip
"""To compile: they are left to `make test-all`."""


def stacked(job: Job, recordings: list[Recording], padded: int, size: int) -> list[Prepared]:
    """Filtered and solved as a batch does it."""
    measured = [identification_rows.measure(job.pipeline_for(recording), recording) for recording in recordings]
    found = identification_rows.regress_stack(measured, padded, size)
    rows = -(-padded // measured[0].pipeline.filters.decimate)
    return solve_windows([share_of_stack(one, found, k) for k, one in enumerate(measured)], rows, size)


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_windows_of_a_stack_are_those_that_are_decomposed_one_by_one(case: str) -> None:
    recordings, old, new = CASES[case]
    job = parse_job(JOB.replace(old, new) if old else JOB)
    job = replace(job, window=replace(job.window, noise="filtered"))
    prepared = stacked(job, recordings[:1], 1400, 2)[0]
    trusted = in_windows(prepared, curves=False)[0].verdicts.trusted
    assert trusted.any()
    for joint_columns, found in zip(columns_by_joint(prepared.model), prepared.solved, strict=True):
        rows = prepared.rows if joint_columns is None else prepared.rows.of_joint(*joint_columns)
        place = place_windows(prepared.pipeline, rows)
        given = rows.W, rows.torque
        fit = sliding_least_squares(*given, place.window, place.step, valid=rows.valid, noise=prepared.noise)
        unseen = score(*given, rows.valid, fit.theta, place.next_starts, place.window, place.step)
        assert_near(found, fit, unseen, trusted)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["slow samples", "two joints", "ordinary"])
def test_white_rows_of_a_stack_are_solved_as_one_by_one(case: str) -> None:
    recordings, old, new = CASES[case]
    prepared = stacked(parse_job(JOB.replace(old, new) if old else JOB), recordings[:1], 1400, 2)[0]
    trusted = in_windows(prepared, curves=False)[0].verdicts.trusted
    assert trusted.any()
    for j, (joint_columns, found) in enumerate(zip(columns_by_joint(prepared.model), prepared.solved, strict=True)):
        rows, white = (
            prepared.rows if joint_columns is None else prepared.rows.of_joint(*joint_columns),
            prepared.white[j],
        )
        place = place_windows(prepared.pipeline, rows)
        slide = partial(sliding_least_squares, window=place.window, step=place.step, valid=rows.valid)
        hold = partial(score, rows.W, rows.torque, rows.valid, window=place.window, step=place.step)
        fit, ordinary = slide(white.W, white.torque), slide(rows.W, rows.torque)
        if prepared.pipeline.ordinary:
            fit = from_filtered(fit, ordinary, white)
        else:
            fit = from_white(fit, ordinary, white, hold(fit.theta, start=place.starts))
        assert_near(found, fit, hold(fit.theta, start=place.next_starts), trusted)


@pytest.mark.parametrize(
    "case", [pytest.param(case, marks=[pytest.mark.slow] if case in LONGEST else []) for case in CASES]
)
def test_a_padded_recording_gives_what_it_gives_alone(case: str) -> None:
    """In a stack of its own length to the last bit, padded to rounding."""
    recordings, old, new = CASES[case]
    job = parse_job(JOB.replace(old, new) if old else JOB)
    for recording in recordings:
        alone = identify_recording(job, recording)[0]
        assert_same(in_windows(stacked(job, [recording], len(recording), 2)[0], curves=False)[0], alone)
        assert_same(in_windows(stacked(job, [recording], 1400, 2)[0], curves=False)[0], alone, 1e-8)


def test_the_members_of_a_stack_do_not_touch_each_other() -> None:
    job = parse_job(JOB)
    recordings = [joint(n, n) for n in (1390, 1000)]
    together = stacked(job, recordings, 1400, 2)
    alone = [stacked(job, [one], 1400, 2)[0] for one in recordings]
    for one, other in zip(together, alone, strict=True):
        np.testing.assert_array_equal(one.solved[0].fit.theta, other.solved[0].fit.theta)
        np.testing.assert_array_equal(one.solved[0].fit.stderr, other.solved[0].fit.stderr)


@pytest.mark.slow
def test_one_window_as_long_as_the_recording() -> None:
    """A program of a few windows only once made XLA break off the process."""
    job = parse_job(JOB.replace("decimation_cutoff = 10", "").replace("length = 1", "length = 4\nnoise = 'filtered'"))
    recording = joint(1000)
    prepared = prepare(job.pipeline_for(recording), recording)
    theta, rows = in_windows(prepared)[0].fit.theta, prepared.rows
    assert len(theta) == 1
    expected = np.linalg.lstsq(rows.W[rows.valid], rows.torque[rows.valid])[0]
    np.testing.assert_allclose(theta[0], expected, 1e-9)


@pytest.mark.slow
def test_many_lengths_are_few_programs(tmp_path: Path) -> None:
    """A thousand lengths are planned; of these a few dozen are run, at least one for each size."""
    compiled: list[str] = []

    def listen(event: str, seconds: float, **about: object) -> None:
        if event == "/jax/core/compile/backend_compile_duration":
            compiled.append(event)

    assert len(padded_sizes(range(1000, 2000))) <= 6
    for k in range(24):
        save_recording(joint(1003 + 17 * k, k), tmp_path / f"r{k:02d}.parquet")
    jax.clear_caches()
    identification_rows._known.clear()
    compilation.options()
    jnp.zeros(())  # small programs that no length has a part in
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        outcome = batch.run(parse_job(JOB, tmp_path), [tmp_path], tmp_path / "out")
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert outcome.exit_status == 0
    assert 0 < len(compiled) <= 7  # six sizes, and the torque of a piece


def test_what_stops_a_stack_is_said_of_its_recordings(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: object) -> object:
        raise ValueError("no such window")

    monkeypatch.setattr(batch_results, "solve_windows", refuse)
    job, recording = parse_job(JOB), joint(1000)
    measured = identification_rows.measure(job.pipeline_for(recording), recording)
    result = batch_results.Result(batch_plan.Item("x", Path("x")), recording=recording)
    result.stacked = (1000, 1, "kind"), measured
    batch_results._solve_stacks(batch_results.Task(job, Path(), (), (), (), 1), [result])
    assert (result.status, result.reason) == (batch_results.FAILED, "no such window")
