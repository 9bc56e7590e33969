"""Whatever comes: every sample has a place on the grid, or is counted."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
from numpy.typing import NDArray

from jaximp.live.clock import Batch, Clock, Counts, rate_of

RATE, FLUSH = 100.0, 40
N = 300


def stamps(count: int = N) -> NDArray[np.float64]:
    return 5 + np.arange(count) / RATE


def placed(
    time: NDArray[np.float64], **changes: NDArray[np.float64]
) -> tuple[NDArray[np.bool_], Counts, NDArray[np.float64]]:
    """Validity, counts, and positions, which are the number of the sample."""
    clock = Clock(RATE, FLUSH)
    position = changes.get("position", np.arange(len(time), dtype=float))
    slots = clock.place(Batch(time, position, np.ones(len(time))))
    counts = clock.counts
    assert counts.received == len(time)
    assert counts.used + counts.not_finite + counts.late + counts.duplicate == counts.received
    assert slots.sample.valid.sum() == counts.used
    return slots.sample.valid, counts, slots.sample.position


def only(counts: Counts, **found: int) -> None:
    """These are counted, and nothing else but what was received and used."""
    others = {one.name: getattr(counts, one.name) for one in fields(counts) if one.name not in ("received", "used")}
    assert {name: value for name, value in others.items() if value} == found


def test_even_samples_take_one_place_each_whatever_the_batches() -> None:
    valid, counts, position = placed(stamps())
    assert valid.all()
    np.testing.assert_array_equal(position, np.arange(N))
    only(counts)
    clock = Clock(RATE, FLUSH)
    pieces = [
        clock.place(Batch(stamps()[k : k + 7], np.arange(N)[k : k + 7], np.ones(N)[k : k + 7])) for k in range(0, N, 7)
    ]
    np.testing.assert_array_equal(np.concatenate([one.sample.position for one in pieces]), position)


def test_jitter_and_a_clock_that_runs_fast_lose_nothing() -> None:
    random = np.random.default_rng(0)
    valid, counts, _ = placed(stamps() + random.uniform(-0.3, 0.3, N) / RATE)
    assert valid.all()
    only(counts)
    valid, counts, _ = placed(5 + np.arange(N) * 1.01 / RATE)
    assert valid.all()
    only(counts)


def test_missing_samples_leave_places() -> None:
    valid, counts, _ = placed(np.delete(stamps(), slice(100, 110)))
    assert len(valid) == N
    np.testing.assert_array_equal(np.flatnonzero(~valid), np.arange(100, 110))
    only(counts, missing=10)


def test_what_comes_twice_or_late_is_left_out() -> None:
    time = np.insert(stamps(), 50, stamps()[49])
    only(placed(time)[1], duplicate=1)
    time = stamps()
    time[[60, 61]] = time[[61, 60]]
    valid, counts, _ = placed(time)
    assert (~valid).sum() == 1
    only(counts, late=1, missing=1)


def test_numbers_that_are_none_leave_places_too() -> None:
    position, time = np.arange(N, dtype=float), stamps()
    position[20], time[30] = np.nan, np.inf
    valid, counts, found = placed(time, position=position)
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(np.flatnonzero(~valid), [20, 30])
    only(counts, not_finite=2, missing=1)


def test_a_source_that_returns_after_an_hour_does_not_fill_the_memory() -> None:
    time = stamps()
    time[150:] += 3600
    valid, counts, _ = placed(time)
    assert len(valid) == N + FLUSH
    only(counts, missing=360000, interruptions=1)


@pytest.mark.parametrize("back", [0.5, 2.0, 1e6])
def test_a_clock_that_is_set_back_is_followed(back: float) -> None:
    time = stamps()
    time[150:] -= back
    valid, counts, _ = placed(time)
    assert counts.clock_jumps == 1
    assert counts.used >= N - 10  # as many of the first ones could have been late
    assert valid[-100:].all()


def test_the_rate_is_told_from_stamps_with_gaps_and_jitter() -> None:
    random = np.random.default_rng(1)
    time = np.delete(stamps() + random.uniform(-0.2, 0.2, N) / RATE, slice(50, 80))
    assert rate_of(time) == pytest.approx(RATE, rel=5e-3)
    with pytest.raises(ValueError, match="do not increase"):
        rate_of(np.full(10, 3.0))
