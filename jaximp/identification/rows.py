"""From a recording to rows: low-pass of torque and columns, derivatives, decimation. Nothing is solved here.

Tout et al. 2023, III-B. Recordings come in stacks, padded to one length, and pass the filters once: together with a
copy to which noise was added, which tells what noise of the position leaves in every column. One recording is a stack
of one. What it gets does not depend on what it is stacked with, to the last bit, nor on what it is padded by, to
rounding. The compiled program depends on the padded length, on the model and on the decimation alone: filters and
sample rates are arrays.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from threading import Lock
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, PartitionSpec
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp import signals
from jaximp.identification.filter_settings import Filters, FilterSettings
from jaximp.identification.pipeline import Pipeline
from jaximp.models.base import Model
from jaximp.numerics.compilation import compiled
from jaximp.numerics.precision import require_float64
from jaximp.types import AnyArray, Numbers, Recording

T = TypeVar("T")

FINEST = 1e-6
"""No sensor is finer than this share of what it measured: less is no motion."""


@dataclass(frozen=True)
class Rows:
    """A filtered recording as least squares sees it; (N, ...) rows after decimation."""

    W: AnyArray
    """(N, *n, p)"""
    torque: AnyArray
    """(N, *n) [N m]"""
    valid: NDArray[np.bool_]
    """(N, *n)"""
    time: NDArray[np.float64]
    """(N,) [s]"""
    noisy: AnyArray | None = None
    """(N, *n, p) what noise of the position leaves in every column; None for the rows of windows that were filtered one
    by one."""
    clean: NDArray[np.bool_] | None = None
    """(N,) whose filtered values come from measurements; those that count also move. None where nobody asked."""

    def of_joint(self, j: int, columns: slice) -> Rows:
        """The share of one joint, whose parameters stand in these columns."""
        noisy = None if self.noisy is None else self.noisy[:, j, columns]
        return Rows(self.W[:, j, columns], self.torque[:, j], self.valid[:, j], self.time, noisy)


class Motion(NamedTuple):
    """What a recording measured, with straight lines across its gaps."""

    position: NDArray[np.float64]
    """(N, n)"""
    torque: NDArray[np.float64]
    """(N, n)"""
    velocity: NDArray[np.float64] | None = None
    """(N, n) where it is to serve in place of a derivative, and the acceleration too."""
    acceleration: NDArray[np.float64] | None = None


@dataclass(frozen=True)
class Measured:
    """One recording before it is stacked: what is worked out on the host."""

    recording: Recording
    pipeline: Pipeline
    model: Model
    """Whose columns are wanted."""
    motion: Motion
    noisy: Motion
    jumps: NDArray[np.bool_]
    """(N,) where the position jumps."""
    clean: NDArray[np.bool_]
    """(N,) samples whose filtered value comes from measurements."""


def measure(pipeline: Pipeline, recording: Recording, model: Model | None = None) -> Measured:
    """Look for a recording's gaps, jumps and noise; by default for the model that is identified.

    **Raises:** `ValueError` for a recording that is too short for the filters, or of another sample rate than a model
    with memory. Whether its windows fit is another question (`Pipeline.check`).
    """
    require_float64(recording.position)
    pipeline.check_memory(recording)
    model, filters = pipeline.model if model is None else model, pipeline.filters
    for sos in (filters.position, filters.parallel):
        if sos is not None:
            signals.check_long_enough(sos, len(recording))
    motion = measured_motion(pipeline.filter, recording)
    levels = recording.position_noise
    if levels is None:
        levels = np.array([signals.noise_level(q) for q in motion.position.T])
    jumps = jumped(recording, levels)
    levels = _with_stated(levels, recording, pipeline.filter.position_cutoff)
    clean = undisturbed(recording, filters, memory=model.memory, jumps=jumps)
    return Measured(recording, pipeline, model, motion, with_noise(motion, levels.tolist()), jumps, clean)


def _with_stated(seen: Numbers, recording: Recording, cutoff: float | None) -> Numbers:
    """(n,) standard deviation of white noise as dense as that of the position inside its filter.

    What is stated and not seen in the samples lies inside the filter's band: where it does most harm.
    """
    if recording.stated_noise is None:
        return seen
    half = recording.sample_rate / 2
    hidden = np.maximum(recording.stated_noise**2 - seen**2, 0)
    return np.sqrt(seen**2 + hidden * half / (half if cutoff is None else min(cutoff, half)))


def regress(measured: Measured) -> tuple[Rows, NDArray[np.float64]]:
    """Rows of one recording, and root mean square (p,) of what noise of the position leaves in every column."""
    return rows_of(measured, regress_stack([measured], len(measured.recording), 1), 0)


def column_noise(measured: Measured) -> NDArray[np.float64]:
    """(p,) root mean square of what noise of the position leaves in every column."""
    return _noise_of(measured, regress_stack([measured], len(measured.recording), 1), 0)[1]


class Filtered(eqx.Module):
    """A stack of recordings behind the filters; axis 0 counts them, and padded rows mean nothing."""

    W: AnyArray
    y: AnyArray
    speed: AnyArray
    noisy: AnyArray
    """As `Rows.noisy`, zero in padded rows."""


class _Stack(eqx.Module):
    """What goes into the filters; axis 0 counts the recordings."""

    motion: tuple[Any, ...]
    noisy: tuple[Any, ...]
    samples: AnyArray
    sample_rate: AnyArray
    position: signals.PaddedFilter | None
    parallel: signals.PaddedFilter | None
    differentiator: signals.Differentiator


def regress_stack(several: Sequence[Measured], padded: int, stacked: int) -> Filtered:
    """Filter recordings of one model and decimation, padded to so many samples; a stack that is not full is filled with
    copies of the first."""
    first = several[0]
    filled = [*several, *[first] * (stacked - len(several))]
    return _filter_stack(first.pipeline.filters.decimate, first.model, _stacked(filled, padded))


def rows_of(measured: Measured, found: Filtered, k: int) -> tuple[Rows, NDArray[np.float64]]:
    """The share of one recording of a stack, and root mean square (p,) of the noise in its columns.

    **Raises:** `ValueError` where no sample is left.
    """
    recording, pipeline = measured.recording, measured.pipeline
    decimate = pipeline.filters.decimate
    n = -(-len(recording) // decimate)
    W, y, speed = (x[k][:n] for x in (found.W, found.y, found.speed))
    clean, moving = measured.clean[::decimate], speed >= pipeline.min_velocity
    valid = clean & moving if recording.n_joints == 1 else clean[:, None] & moving
    if not valid.any():
        found_before = "".join(f"; {fault.text}" for fault in recording.faults)
        raise ValueError(
            f"no sample is left after filtering ({np.mean(~recording.valid):.0%} cannot be used): the recording is too "
            "short for the filters (and the lags of a reflex), has too many gaps, or never moves faster than "
            f"window.min_velocity{found_before}"
        )
    noisy, level = _noise_of(measured, found, k)
    return Rows(W, y, valid, recording.time[::decimate], noisy, clean), level


def _noise_of(measured: Measured, found: Filtered, k: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What noise of the position leaves in every column (N, *n, p), and its root mean square (p,)."""
    n = -(-len(measured.recording) // measured.pipeline.filters.decimate)
    noisy = without_jumps(measured.model, found.noisy[k][:n])
    return noisy, np.sqrt((noisy.reshape(-1, noisy.shape[-1]) ** 2).mean(axis=0))


def _stacked(several: Sequence[Measured], padded: int) -> _Stack:
    def together(arrays: Sequence[AnyArray | None]) -> AnyArray | None:
        if arrays[0] is None:
            return None
        whole = np.zeros((len(arrays), padded, *arrays[0].shape[1:]), arrays[0].dtype)
        for k, array in enumerate(arrays):
            assert array is not None
            whole[k, : len(array)] = array
        return whole

    def filters(which: str) -> Any:
        sos = [getattr(one.pipeline.filters, which) for one in several]
        return None if sos[0] is None else jax.tree.map(lambda *x: np.stack(x), *map(signals.padded_filter, sos))

    return _Stack(
        motion=tuple(together(x) for x in zip(*(one.motion for one in several), strict=True)),
        noisy=tuple(together(x) for x in zip(*(one.noisy for one in several), strict=True)),
        samples=np.array([len(one.recording) for one in several]),
        sample_rate=np.array([one.recording.sample_rate for one in several]),
        position=filters("position"),
        parallel=filters("parallel"),
        differentiator=jax.tree.map(lambda *x: np.stack(x), *(one.pipeline.filters.differentiator for one in several)),
    )


def _filter_stack(decimate: int, model: Model, stack: _Stack) -> Filtered:
    with first_call("filter", decimate, model, *(x.shape for x in jax.tree.leaves(stack))):
        found: Filtered = jax.tree.map(np.asarray, _program(decimate, model, stack))
    return found


@partial(compiled, static_argnums=(0, 1))
def _program(decimate: int, model: Model, stack: _Stack) -> Filtered:
    """One recording after another, so that its numbers stay at hand, with and without noise side by side."""

    def columns(one: _Stack, motion: tuple[Any, ...]) -> tuple[Array, Array, Array]:
        def passing(filters: signals.PaddedFilter | None) -> Callable[[AnyArray], Array]:
            return jnp.asarray if filters is None else partial(_filter_columns, filters, one.samples)

        differences = partial(
            signals.differentiate_padded, sample_rate=one.sample_rate, n=one.samples, by=one.differentiator
        )
        return _columns_of(model, (passing(one.position), passing(one.parallel)), differences, decimate, motion)

    def solve(one: _Stack) -> Filtered:
        both = jax.tree.map(lambda *x: jnp.stack(x), one.motion, one.noisy)
        found = jax.vmap(partial(columns, one))(both)
        W, y, speed = (x[0] for x in found)
        inside = jnp.arange(len(W)) * decimate < one.samples
        return Filtered(W, y, speed, jnp.where(inside.reshape(-1, *(1,) * (W.ndim - 1)), found[0][1] - W, 0))

    return on_every_device(partial(lax.map, solve), stack, len(stack.samples))


@eqx.filter_jit
def filtered(
    model: Model, filters: Filters, sample_rate: float, q: AnyArray, torque: AnyArray
) -> tuple[Array, Array, Array]:
    """Regressor, torque and speed of one stretch of samples (N, n) that is neither padded nor stacked."""

    def passing(sos: signals.Sections | None) -> Callable[[AnyArray], Array]:
        return jnp.asarray if sos is None else partial(signals.filter_zero_phase, sos)

    passes = passing(filters.position), passing(filters.parallel)
    differences = partial(signals.differentiate, sample_rate=sample_rate, by=filters.differentiator)
    return _columns_of(model, passes, differences, filters.decimate, (q, torque, None, None))


def _filter_columns(filters: signals.PaddedFilter, n: Array, x: AnyArray) -> Array:
    columns = jnp.asarray(x).reshape(x.shape[0], -1)
    return signals.filter_zero_phase_padded(filters, columns, n).reshape(x.shape)


def _columns_of(
    model: Model,
    passes: tuple[Callable[[AnyArray], Array], Callable[[AnyArray], Array]],
    differences: Callable[[AnyArray], tuple[Array, Array]],
    decimate: int,
    measured: tuple[Any, ...],
) -> tuple[Array, Array, Array]:
    """Regressor, torque and speed by given filters (of the position; of all columns) and differences."""
    smooth, parallel = passes
    q, torque, velocity, acceleration = measured
    q = smooth(q)
    dq, ddq = differences(q)
    if velocity is not None:
        dq = smooth(velocity)
        ddq = differences(dq)[0]
    if acceleration is not None:
        ddq = smooth(acceleration)
    one_joint = q.shape[1] == 1
    motion = tuple(x[:, 0] if one_joint else x for x in (q, dq, ddq))
    W = model.observation_matrix(*motion)
    if model.memory:  # the filters need numbers; `undisturbed` lets none of these count
        W = W.at[: model.memory].set(jnp.nan_to_num(W[: model.memory]))
    y = jnp.asarray(torque)[:, 0] if one_joint else jnp.asarray(torque)
    both = parallel(jnp.concatenate([W, y[..., None]], axis=-1))
    return both[::decimate, ..., :-1], both[::decimate, ..., -1], model.speed(motion[1])[::decimate]


# --- programs that several threads and devices share ------------------------------------------------------------------


def on_every_device(solve: Callable[[Any], T], stack: Any, stacked: int) -> T:
    """The recordings of a stack, shared out to the devices of this host."""
    count = math.gcd(stacked, jax.local_device_count())
    if count == 1:
        return solve(stack)
    mesh, share = Mesh(np.array(jax.local_devices()[:count]), ("recordings",)), PartitionSpec("recordings")
    found: T = jax.shard_map(solve, mesh=mesh, in_specs=share, out_specs=share, check_vma=False)(stack)
    return found


_lock, _known = Lock(), set[Any]()


@contextmanager
def first_call(*program: Any) -> Iterator[None]:
    """A program is compiled once, however many threads need it at the same time."""
    if program in _known:
        yield
        return
    with _lock:
        yield
        _known.add(program)


# --- what can be seen on the host -------------------------------------------------------------------------------------


def jumped(recording: Recording, noise: Numbers | None = None) -> NDArray[np.bool_]:
    """(N,) True where the position of some joint jumps; `noise` (n,) of each position, where it is known."""
    levels = recording.position_noise if noise is None else noise
    known = [None] * recording.n_joints if levels is None else levels.tolist()
    return np.any([signals.jumps(q, level) for q, level in zip(recording.position.T, known, strict=True)], axis=0)


def undisturbed(
    recording: Recording,
    filters: Filters,
    ends: bool = True,
    memory: int = 0,
    jumps: NDArray[np.bool_] | None = None,
) -> NDArray[np.bool_]:
    """(N,) samples whose filtered value comes from measurements, and not from a gap, a jump or (`ends`) an end.

    A gap that is short against the filters is bridged: the straight line across it is as good as a measurement, but
    where the torque was cut off at a limit. What a gap, a jump or the beginning spoils, a model with a `memory` of so
    many samples remembers. `jumps` is what `jumped` finds, where that is known.
    """
    missing = signals.long_gaps(recording.valid, filters.bridge)
    if recording.clipped is not None:
        missing |= recording.clipped
    known = signals.lengthen_gaps(~missing, memory)
    known[: memory if ends else 0] = False
    valid = signals.widen_gaps(known, filters.reach, ends)
    jumps = jumped(recording) if jumps is None else jumps
    if not jumps.any():
        return valid
    return valid & signals.widen_gaps(signals.lengthen_gaps(~jumps, memory), filters.ringing, ends=False)


def measured_motion(settings: FilterSettings, recording: Recording) -> Motion:
    """What goes into the filters; the velocity only where the settings ask for it."""
    q, torque = (signals.fill_gaps(x, recording.valid) for x in (recording.position, recording.torque))
    if not settings.measured_derivatives:
        return Motion(q, torque)
    if recording.velocity is None:
        raise ValueError("filter.measured_derivatives needs a velocity column in [recording]")
    if settings.mode == "window":
        raise ValueError("filter.measured_derivatives works with filter.mode = 'once'")
    velocity, acceleration = (
        None if x is None else signals.fill_gaps(x, recording.valid)
        for x in (recording.velocity, recording.acceleration)
    )
    return Motion(q, torque, velocity, acceleration)


def without_jumps(model: Model, noise: NDArray[np.float64]) -> NDArray[np.float64]:
    """Zero for the columns that jump (the sign of the velocity), which say nothing of the joint's excitation."""
    jumping = ["sign" in column for column in model.columns]
    return np.where(jumping, 0.0, noise) if any(jumping) else noise


def with_noise(motion: Motion, levels: Sequence[float] | None = None) -> Motion:
    """The motion with as much noise again as is in it; `levels` of the positions' noise, where they are known."""
    moving = [motion.velocity, motion.acceleration, motion.position]
    numbers = _normal_numbers(sum(x.size for x in moving if x is not None))
    spoilt, used = [], 0
    for x, known in zip(moving, (None, None, levels), strict=True):
        if x is not None:
            sizes = [signals.noise_level(column) for column in x.T] if known is None else known
            white = numbers[used : used + x.size].reshape(x.shape[::-1]).T
            x, used = x + np.maximum(sizes, FINEST * np.nanstd(x, axis=0)) * white, used + x.size
        spoilt.append(x)
    velocity, acceleration, position = spoilt
    assert position is not None
    return Motion(position, motion.torque, velocity, acceleration)


def _normal_numbers(n: int) -> NDArray[np.float64]:
    """The first n of a sequence that is always the same."""
    return _normal_sequence(1 << max(n - 1, 1).bit_length())[:n]


@lru_cache(maxsize=2)
def _normal_sequence(n: int) -> NDArray[np.float64]:
    return np.random.default_rng(0).standard_normal(n)


def once(pipeline: Pipeline) -> Pipeline:
    """The same with filters that run over the recording once."""
    return replace(pipeline, filter=replace(pipeline.filter, mode="once"))
