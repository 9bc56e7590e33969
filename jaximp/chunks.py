"""Who works on which rows: a recording goes through `engine` in chunks, several at a time, however long it is.

A chunk is the rows of some thousand windows. Chunks lie on a grid that begins with the recording, so that one that is
read piece by piece gives the same numbers, to the last bit, as one that lies in memory.
"""

from __future__ import annotations

import os
import threading
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp.compilation import compiled
from jaximp.engine import BLOCK, ChunkFit, Plan, Statistics, solve_chunk
from jaximp.least_squares import WindowFit, least_squares
from jaximp.types import AnyArray

LANES = {True: 500, False: 1000}
"""Blocks in a chunk, with and without statistics; no power of two, which would crowd the cache."""
REPAIR_NUMBERS = 150_000
"""How many numbers of doubtful windows are decomposed at a time: so many fit into the cache."""

LONGEST_REACH = 128
"""Rows over which noise may be correlated for shared sums to be cheaper than a decomposition of every window."""
NEGLIGIBLE_NOISE = 1e-6
"""Autocovariance that is no longer counted, as a share of the variance: standard errors feel as little of it."""

Numbers = NDArray[Any]


class Piece(NamedTuple):
    """Some rows of a recording; the rows of several outputs in turn."""

    W: Numbers
    y: Numbers
    valid: NDArray[np.bool_]

    def part(self, start: int, stop: int) -> Piece:
        """Rows from start to stop."""
        return Piece(self.W[start:stop], self.y[start:stop], self.valid[start:stop])


class Estimated(NamedTuple):
    """Numbers of consecutive windows, NaN where there is no unique solution; without statistics theta alone."""

    theta: Any
    stderr: Any = None
    dof: Any = None
    cond: Any = None
    sigma_min: Any = None
    excitation: Any = None
    residual_rms: Any = None
    vaf: Any = None
    samples: Any = None


def make_plan(
    window: int, step: int, outputs: int, statistics: bool, n_windows: int | None = None, lags: int = 0
) -> Plan:
    """Sizes of a chunk for windows of so many rows, so many rows apart."""
    per_block = max(1, min(BLOCK // step, window // step))
    block = step * per_block
    room = _rounded(-(-window // block))
    lanes = max(LANES[statistics], room)
    if n_windows is not None:  # a short recording needs no long chunk, but few lengths share compiled code
        wanted = -(-n_windows // per_block)
        lanes = min(lanes, next((size for size in (30, 120, 480) if size >= wanted), lanes))
    return Plan(step, per_block, lanes, room, outputs, statistics, lags)


def _rounded(n: int) -> int:
    """The next number with three binary digits: lengths that are alike share compiled code."""
    grain = 1 << max(n.bit_length() - 3, 0)
    return -(-n // grain) * grain


def lags_for_sums(noise: Numbers | Array | None, window: int, outputs: int) -> int | None:
    """How many lags of the noise's autocovariance the shared sums take in; None where they cannot."""
    if noise is None:
        return 0
    if noise.ndim != 1 or isinstance(noise, jax.core.Tracer):
        return None
    size = np.abs(np.asarray(noise))
    lags = 1 + int(np.flatnonzero(size > NEGLIGIBLE_NOISE * size[0]).max(initial=0))
    reach = (lags - 1) * outputs
    return lags if lags > 1 and reach <= LONGEST_REACH and 2 * reach <= window else None


def solve_all(recording: Piece, plan: Plan, window: int, noise: Numbers | None = None) -> Estimated:
    """Every window of a recording in memory."""
    n_windows = (len(recording.y) - window) // plan.step + 1

    def solve(first: int) -> Estimated:
        start = first * plan.step
        return _solve_rows(plan, window, noise, [recording.part(start, start + plan.rows)])

    found = _empty(n_windows, recording.W.shape[1], recording.W.dtype, plan.statistics)

    def put(first: int) -> None:
        for whole, some in zip(jax.tree.leaves(found), jax.tree.leaves(solve(first)), strict=True):
            whole[first : first + plan.windows] = some

    with ThreadPoolExecutor(_cores()) as pool:
        list(pool.map(put, range(0, n_windows, plan.windows)))
    return found


def _empty(n_windows: int, p: int, dtype: Any, statistics: bool) -> Estimated:
    theta = np.empty((n_windows, p), dtype)
    if not statistics:
        return Estimated(theta)
    each = {name: np.empty(n_windows, dtype) for name in Estimated._fields}
    wide = {name: np.empty((n_windows, p), dtype) for name in ("stderr", "excitation")}
    return Estimated(**each | wide | {"theta": theta, "samples": np.empty(n_windows, int)})


def solve_pieces(pieces: Iterable[Piece], plan: Plan, window: int, noise: Numbers | None = None) -> Iterator[Estimated]:
    """Every window of a recording that comes piece by piece; as many pieces are held as a few chunks need."""
    waiting: deque[Future[Estimated]] = deque()
    with ThreadPoolExecutor(_cores()) as pool:
        for rows in _chunks_of(pieces, plan, window):
            waiting.append(pool.submit(_solve_rows, plan, window, noise, rows))
            if len(waiting) > 2 * _cores():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def solve_traced(recording: Any, plan: Plan, window: int, noise: Array | None = None) -> Estimated:
    """Every window inside of `jit`, `vmap` or `grad`, or on an accelerator, all chunks at a time."""
    W, y, valid = recording
    n_windows = (len(y) - window) // plan.step + 1
    n_chunks = -(-n_windows // plan.windows)
    columns = jnp.where(valid, jnp.concatenate([W.T, y[None]]), 0)
    behind = max(0, (n_chunks - 1) * plan.advance + plan.rows - len(y))
    columns, valid = jnp.pad(columns, ((0, 0), (0, behind))), jnp.pad(valid, (0, behind))

    def solve(start: Array) -> ChunkFit:
        rows = lax.dynamic_slice_in_dim(columns, start, plan.rows, axis=1)
        return solve_chunk(plan, rows, lax.dynamic_slice_in_dim(valid, start, plan.rows), window, noise)

    starts = jnp.arange(n_chunks) * plan.advance
    batch = 1 if jax.default_backend() == "cpu" else n_chunks
    fit = lax.map(solve, starts, batch_size=batch)
    fit = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n_windows], fit)
    return _finished(_repaired_traced(fit, plan, window, columns, valid, noise))


def _repaired_traced(
    fit: ChunkFit, plan: Plan, window: int, columns: Array, valid: Array, noise: Array | None
) -> ChunkFit:
    """As `_repaired`. Values are those of the QR decomposition, derivatives those of the chunk's triangle."""
    n = plan.outputs
    fixed, columns = lax.stop_gradient((fit, columns))
    which = jnp.nonzero(fixed.doubtful, size=len(fixed.doubtful), fill_value=0)[0]
    count = fixed.doubtful.sum()

    def decompose(state: tuple[Array, ChunkFit]) -> tuple[Array, ChunkFit]:
        done, found = state
        k = which[done]
        rows = lax.dynamic_slice_in_dim(columns, k * plan.step, window, axis=1).T.reshape(-1, n, len(columns))
        counts = lax.dynamic_slice_in_dim(valid, k * plan.step, window).reshape(-1, n)
        exact = _as_chunk_fit(least_squares(rows[..., :-1], rows[..., -1], counts, noise), plan.statistics)
        return done + 1, jax.tree.map(lambda all_, one: all_.at[k].set(one), found, exact)

    exact = lax.while_loop(lambda state: state[0] < count, decompose, (jnp.zeros((), int), fixed))[1]

    def with_derivative(x: Array, old: Array, new: Array) -> Array:
        if x.dtype == bool:
            return new
        return jnp.where(new == old, x, jnp.where(jnp.isfinite(old), x - old, 0) + new)

    return jax.tree.map(with_derivative, fit, fixed, exact)


def _as_chunk_fit(exact: WindowFit, statistics: bool) -> ChunkFit:
    """One QR decomposition in the form of a chunk's results."""
    solvable = jnp.isfinite(exact.theta).all()
    if not statistics:
        return ChunkFit(exact.theta, solvable, jnp.array(True))
    samples = exact.samples.astype(exact.theta.dtype)
    found = Statistics(
        stderr=exact.stderr,
        dof=exact.dof,
        inverse_norm=1 / exact.excitation,
        sigma_max=exact.cond * exact.sigma_min,
        sigma_min=exact.sigma_min,
        rss=exact.residual_rms**2 * samples,
        vaf=exact.vaf,
        samples=samples,
    )
    return ChunkFit(exact.theta, solvable, jnp.array(True), found)


def _chunks_of(pieces: Iterable[Piece], plan: Plan, window: int) -> Iterator[list[Piece]]:
    """Rows of one chunk after another, as parts of the pieces that they come from; the last ones may be fewer."""
    held: list[Piece] = []
    for piece in pieces:
        held.append(piece)
        while sum(len(part.y) for part in held) >= plan.rows:
            yield _cut(held, 0, plan.rows)
            held = _cut(held, plan.advance, None)
    while sum(len(part.y) for part in held) >= window:
        yield _cut(held, 0, plan.rows)
        held = _cut(held, plan.advance, None)


def _cut(pieces: list[Piece], start: int, stop: int | None) -> list[Piece]:
    parts, first = [], 0
    for piece in pieces:
        end = len(piece.y) if stop is None else min(len(piece.y), stop - first)
        if end > max(start - first, 0):
            parts.append(piece.part(max(start - first, 0), end))
        first += len(piece.y)
    return parts


def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _solve_rows(plan: Plan, window: int, noise: Numbers | None, parts: list[Piece]) -> Estimated:
    """The windows of one chunk."""
    p = parts[0].W.shape[1]
    columns, valid = _scratch(plan.rows, p + 1, np.result_type(*(part.W for part in parts)).str)
    at = 0
    for part in parts:
        rows = slice(at, at + len(part.y))
        columns[:p, rows], columns[p, rows], valid[rows] = part.W.T, part.y, part.valid
        at = rows.stop
    columns[:, at:], valid[at:] = 0, False
    if not valid[:at].all():
        columns[:, ~valid] = 0  # whatever a masked sample holds
    n_windows = min(plan.windows, (at - window) // plan.step + 1)
    fit = jax.tree.map(lambda x: np.asarray(x)[:n_windows], _compiled(plan)(columns, valid, window, noise))
    return _finished(_repaired(fit, plan, window, columns, valid, noise))


class _Memory(threading.local):
    """Arrays of a thread, used again for the next chunk: fresh memory takes longer to come by than to fill."""

    columns: Numbers = np.empty((0, 0))
    valid: NDArray[np.bool_] = np.empty(0, bool)


_memory = _Memory()


def _scratch(rows: int, n_columns: int, dtype: str) -> tuple[Numbers, NDArray[np.bool_]]:
    if _memory.columns.shape != (n_columns, rows) or _memory.columns.dtype != np.dtype(dtype):
        _memory.columns, _memory.valid = np.empty((n_columns, rows), dtype), np.empty(rows, bool)
    return _memory.columns, _memory.valid


@cache
def _compiled(plan: Plan) -> Any:
    return compiled(partial(solve_chunk, plan))


def _repaired(
    fit: ChunkFit, plan: Plan, window: int, columns: Numbers, valid: NDArray[np.bool_], noise: Numbers | None
) -> ChunkFit:
    """The doubtful windows by a QR decomposition each."""
    doubtful = np.flatnonzero(fit.doubtful)
    if not len(doubtful):
        return fit
    fit = jax.tree.map(np.array, fit)
    at_once = max(1, REPAIR_NUMBERS // (window * len(columns)))
    # A column that is zero throughout decides at once, and a still arm leaves many such windows.
    nonzero = np.pad(np.cumsum(columns[:-1] != 0, axis=1), ((0, 0), (1, 0)))
    start = doubtful * plan.step
    fit.solvable[doubtful] = (nonzero[:, start + window] > nonzero[:, start]).all(axis=0)
    doubtful = doubtful[fit.solvable[doubtful]]
    for first in range(0, len(doubtful), at_once):
        some = doubtful[first : first + at_once]
        filled = np.pad(some, (0, at_once - len(some)), mode="edge")  # one size, compiled once
        rows = (filled * plan.step)[:, None] + np.arange(window)
        shape = (at_once, window // plan.outputs, plan.outputs)
        exact = _decompose(
            np.moveaxis(columns[:, rows], 0, -1).reshape(*shape, -1), valid[rows].reshape(shape), noise, plan.statistics
        )
        for whole, part in zip(jax.tree.leaves(fit), jax.tree.leaves(exact), strict=True):
            whole[some] = np.asarray(part)[: len(some)]
    return fit


@partial(compiled, static_argnames="statistics")
def _decompose(columns: AnyArray, valid: AnyArray, noise: AnyArray | None, statistics: bool) -> ChunkFit:
    """QR decompositions of windows (m, samples, outputs, p + 1)."""

    def one(rows: Array, counts: Array) -> ChunkFit:
        return _as_chunk_fit(least_squares(rows[..., :-1], rows[..., -1], counts, noise), statistics)

    return jax.vmap(one)(columns, valid)


def _finished(fit: ChunkFit) -> Estimated:
    """Estimates as the user sees them; works on arrays of numpy and of jax alike."""
    xp: Any = np if isinstance(fit.theta, np.ndarray) else jnp

    def or_nan(x: Any) -> Any:
        if xp is np and fit.solvable.all():
            return x
        return xp.where(fit.solvable.reshape(-1, *(1,) * (x.ndim - 1)), x, xp.nan)

    if fit.statistics is None:
        return Estimated(or_nan(fit.theta))
    with np.errstate(all="ignore"):  # where there is no solution
        stderr, dof, norm, high, low, rss, vaf, n = fit.statistics
        return Estimated(
            theta=or_nan(fit.theta),
            stderr=or_nan(stderr),
            dof=or_nan(dof),
            cond=or_nan(high / low),
            sigma_min=or_nan(low),
            excitation=or_nan(1 / norm),
            residual_rms=or_nan(xp.sqrt(rss / n)),
            vaf=or_nan(vaf),
            samples=n.astype(int),
        )
