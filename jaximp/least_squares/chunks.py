"""Chunked, multi-threaded evaluation of sliding windows: `engine` works on a recording of any length in pieces.

A chunk is the rows of some thousand windows. Chunks lie on a grid that begins with the recording, so that one that is
read piece by piece gives the same numbers, to the last bit, as one that lies in memory.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import fields
from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array
from numpy.typing import NDArray

from jaximp.least_squares.engine import Wanted, solve_chunk, solve_shortest
from jaximp.least_squares.fits import ChunkFit, Statistics
from jaximp.least_squares.sums import BLOCK, FEWEST_LANES, Plan
from jaximp.least_squares.window import SlidingFit, WindowFit, solve_window
from jaximp.numerics.compilation import compiled, is_traced
from jaximp.numerics.cores import cores
from jaximp.numerics.linear_algebra import root
from jaximp.types import AnyArray

LANES = {True: 500, False: 800}
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
    scale: Numbers
    """What a row is multiplied by: False where it does not count, or the root of its weight."""

    def part(self, start: int, stop: int) -> Piece:
        """Rows from start to stop."""
        return Piece(self.W[start:stop], self.y[start:stop], self.scale[start:stop])


class Task(NamedTuple):
    """What is asked of every chunk."""

    plan: Plan
    window: int
    """Rows of a window, or of the longest."""
    noise: Any = None
    """(lags,) autocovariance of the noise."""
    wanted: Wanted | None = None
    """What the shortest window must meet, where each is to be as long as it needs."""

    @property
    def before(self) -> int:
        """Rows before the recording that the first chunk looks at: windows grow back in time from their end."""
        return 0 if self.wanted is None else self.window - self.plan.block

    def windows(self, rows: int) -> int:
        """How many windows lie in so many rows, those before the recording among them."""
        return (rows - self.window) // self.plan.step + 1

    def of_chunk(self, first: Any) -> Task:
        """The task of the chunk whose windows begin with the `first`."""
        if self.wanted is None:
            return self
        xp: Any = jnp if is_traced(first, self.wanted.level) else np
        level = self.wanted.level
        at = xp.minimum(first + np.arange(self.plan.windows), len(level) - 1)
        return self._replace(wanted=self.wanted._replace(level=level[at]))


def make_task(
    window: int,
    step: int,
    outputs: int,
    noise: Any = None,
    statistics: bool = True,
    weighted: bool = False,
    n_windows: int | None = None,
) -> Task:
    """Sizes of a chunk for windows of so many rows, so many rows apart."""
    per_block = max(1, min(BLOCK // step, window // step))
    room = _rounded(-(-window // (step * per_block)))
    lanes = max(LANES[statistics], room)
    if n_windows is not None:  # a short recording needs no long chunk, but few lengths share compiled code
        enough = -(-n_windows // per_block)
        lanes = min(lanes, next((size for size in (FEWEST_LANES, 120, 480) if size >= enough), lanes))
    lags = 0 if noise is None else len(noise)
    return Task(Plan(step, per_block, lanes, room, outputs, statistics, weighted, lags), window, noise)


def make_adaptive_task(
    lengths: NDArray[np.int64], step: int, outputs: int, wanted: tuple[Any, Any, Any], noise: Any, weighted: bool
) -> Task:
    """Sizes of a chunk for windows that each are as long as they need; lengths in steps.

    **Arguments:** `wanted` as the last fields of `Wanted`, with the level for every step of the recording.
    """
    room = _rounded(int(lengths[-1]))
    lags = 0 if noise is None else len(noise)
    plan = Plan(step, 1, max(LANES[True], room), room, outputs, True, weighted, lags)
    return Task(plan, room * step, noise, Wanted(lengths, *wanted))


def _rounded(n: int) -> int:
    """The next number with three binary digits: lengths that are alike share compiled code."""
    grain = 1 << max(n.bit_length() - 3, 0)
    return -(-n // grain) * grain


def lags_for_sums(noise: Numbers | Array | None, window: int, outputs: int) -> int | None:
    """How many lags of the noise's autocovariance the shared sums take in; None where they cannot."""
    if noise is None:
        return 0
    if noise.ndim != 1 or is_traced(noise):
        return None
    size = np.abs(np.asarray(noise))
    lags = 1 + int(np.flatnonzero(size > NEGLIGIBLE_NOISE * size[0]).max(initial=0))
    reach = (lags - 1) * outputs
    return lags if lags > 1 and reach <= LONGEST_REACH and 2 * reach <= window else None


def solve_all(recording: Piece, task: Task) -> Any:
    """Every window of a recording in memory: a `SlidingFit`, or theta alone where the plan wants no statistics."""
    plan, n_rows = task.plan, len(recording.y)
    n_windows = task.windows(task.before + n_rows)
    found = _empty(n_windows, recording.W.shape[1], recording.W.dtype, plan.statistics)

    def solve(first: int) -> None:
        start = first * plan.step - task.before
        solved = _solve_rows(task, first, [recording.part(max(start, 0), start + plan.rows)], max(-start, 0))
        for whole, some in zip(jax.tree.leaves(found), jax.tree.leaves(solved), strict=True):
            whole[first : first + plan.windows] = some

    with ThreadPoolExecutor(cores()) as pool:
        list(pool.map(solve, range(0, n_windows, plan.windows)))
    return found


def _empty(n_windows: int, p: int, dtype: Any, statistics: bool) -> Any:
    theta = np.empty((n_windows, p), dtype)
    if not statistics:
        return theta
    each = {field.name: np.empty(n_windows, dtype) for field in fields(SlidingFit)}
    wide = {name: np.empty((n_windows, p), dtype) for name in ("stderr", "excitation")}
    whole = {name: np.empty(n_windows, int) for name in ("samples", "first", "last")}
    return SlidingFit(**each | wide | whole | {"theta": theta})


def solve_pieces(pieces: Iterable[Piece], task: Task) -> Iterator[SlidingFit]:
    """Every window of a recording that comes piece by piece; as many pieces are held as a few chunks need."""
    waiting: deque[Future[SlidingFit]] = deque()
    with ThreadPoolExecutor(cores()) as pool:
        for count, rows in enumerate(_chunks_of(pieces, task)):
            waiting.append(pool.submit(_solve_rows, task, count * task.plan.windows, rows))
            if len(waiting) > 2 * cores():
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def solve_traced(recording: Any, task: Task) -> Any:
    """As `solve_all` inside of `jit`, `vmap` or `grad`, or on an accelerator, all chunks at a time."""
    plan, (W, y, scale), task = task.plan, recording, task._replace(noise=jax.tree.map(jnp.asarray, task.noise))
    n_windows = task.windows(task.before + len(y))
    n_chunks = -(-n_windows // plan.windows)
    columns = jnp.where(scale > 0, jnp.concatenate([W.T, y[None]]), 0) * scale
    behind = max(0, (n_chunks - 1) * plan.advance + plan.rows - len(y) - task.before)
    columns, scale = jnp.pad(columns, ((0, 0), (task.before, behind))), jnp.pad(scale, (task.before, behind))

    def solve(chunk: Array) -> tuple[ChunkFit, Array]:
        start = chunk * plan.advance
        rows = lax.dynamic_slice_in_dim(columns, start, plan.rows, axis=1)
        return _solve_chunk(
            task.of_chunk(chunk * plan.windows), rows, lax.dynamic_slice_in_dim(scale, start, plan.rows)
        )

    batch = 1 if jax.default_backend() == "cpu" else n_chunks
    solved = lax.map(solve, jnp.arange(n_chunks), batch_size=batch)
    fit, length = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:n_windows], solved)
    return _finished(_repaired_traced(fit, length, task, columns, scale), length, task, 0)


def _solve_chunk(task: Task, columns: Any, scale: Any) -> tuple[ChunkFit, Any]:
    """Fits of a chunk, and how many rows each window has."""
    plan = task.plan
    if task.wanted is None:
        return solve_chunk(plan, columns, scale, task.window, task.noise), jnp.full(plan.windows, task.window)
    fit, blocks = solve_shortest(plan, columns, scale, task.wanted, task.noise)
    return fit, jnp.where(blocks > 0, blocks, task.wanted.blocks[-1]) * plan.block


def _repaired_traced(fit: ChunkFit, length: Array, task: Task, columns: Array, scale: Array) -> ChunkFit:
    """As `_repaired`. Values are those of the QR decomposition, derivatives those of the chunk's triangle."""
    n = task.plan.outputs
    fixed, columns = lax.stop_gradient((fit, columns))
    which = jnp.nonzero(fixed.doubtful, size=len(fixed.doubtful), fill_value=0)[0]
    count = fixed.doubtful.sum()

    def finite_or(old: Array, new: Array) -> Array:
        # Where there is no solution, NaN comes last: before, it would make derivatives of other windows NaN.
        return new if new.dtype == bool else jnp.where(jnp.isfinite(new), new, old)

    def decompose(state: tuple[Array, ChunkFit]) -> tuple[Array, ChunkFit]:
        done, found = state
        k = which[done]
        rows = lax.dynamic_slice_in_dim(columns, k * task.plan.step, task.window, axis=1)
        shape = (task.window // n, n)
        kept = lax.dynamic_slice_in_dim(scale, k * task.plan.step, task.window)
        kept = kept * (jnp.arange(task.window) >= task.window - length[k])
        exact = _decomposed(rows.T.reshape(*shape, -1), kept.reshape(shape), task.noise, task.plan.statistics)
        return done + 1, jax.tree.map(lambda all_, one: all_.at[k].set(finite_or(all_[k], one)), found, exact)

    exact = lax.while_loop(lambda state: state[0] < count, decompose, (jnp.zeros((), int), fixed))[1]

    def with_derivative(x: Array, old: Array, new: Array) -> Array:
        if x.dtype == bool:
            return new
        return jnp.where(new == old, x, jnp.where(jnp.isfinite(old), x - old, 0) + new)

    return jax.tree.map(with_derivative, fit, fixed, exact)


def _decomposed(columns: Array, scale: Array, noise: Array | None, statistics: bool) -> ChunkFit:
    """QR decomposition of one window, (samples, outputs, p + 1) that were multiplied by `scale`."""
    given = jnp.where(scale > 0, scale, 1).astype(columns.dtype)[..., None]
    exact = solve_window(columns[..., :-1] / given, columns[..., -1] / given[..., 0], scale, noise)
    return _as_chunk_fit(exact, statistics)


def _as_chunk_fit(exact: WindowFit, statistics: bool) -> ChunkFit:
    """One QR decomposition in the form of a chunk's results."""
    solvable, sure = jnp.isfinite(exact.theta).all(), jnp.ones((), exact.theta.dtype)
    if not statistics:
        return ChunkFit(exact.theta, solvable, sure)
    samples = exact.samples.astype(exact.theta.dtype)
    found = Statistics(
        stderr=exact.stderr,
        dof=exact.dof,
        inverse_norm=1 / exact.excitation,
        sigma_max=exact.cond * exact.sigma_min,
        sigma_min=exact.sigma_min,
        mean_square=exact.residual_rms**2,
        vaf=exact.vaf,
        samples=samples,
    )
    return ChunkFit(exact.theta, solvable, sure, found)


def _chunks_of(pieces: Iterable[Piece], task: Task) -> Iterator[list[Piece]]:
    """Rows of one chunk after another, as parts of the pieces that they come from; the last ones may be fewer."""
    plan = task.plan
    held: list[Piece] = []
    for piece in pieces:
        held.append(piece)
        while sum(len(part.y) for part in held) >= plan.rows:
            yield _cut(held, 0, plan.rows)
            held = _cut(held, plan.advance, None)
    while sum(len(part.y) for part in held) >= task.window:
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


def _solve_rows(task: Task, first: int, parts: list[Piece], skipped: int = 0) -> Any:
    """The windows of one chunk, `first` of which is the first, whose first rows lie before the recording."""
    plan, p = task.plan, parts[0].W.shape[1]
    dtype = np.result_type(*(part.W for part in parts))
    columns, scale = _scratch(plan.rows, p + 1, dtype.str, np.result_type(*(part.scale for part in parts)).str)
    columns[:, :skipped], scale[:skipped], at = 0, 0, skipped
    for part in parts:
        rows = slice(at, at + len(part.y))
        columns[:p, rows], columns[p, rows], scale[rows] = part.W.T, part.y, part.scale
        at = rows.stop
    columns[:, at:], scale[at:] = 0, 0
    if plan.weighted:
        columns *= scale
    if not scale[skipped:at].all():
        columns[:, scale == 0] = 0  # whatever a masked sample holds
    n_windows = min(plan.windows, task.windows(at))
    solved = _compiled(plan)(columns, scale, *task.of_chunk(first)[1:])
    fit, length = jax.tree.map(lambda x: np.asarray(x)[:n_windows], solved)
    return _finished(_repaired(fit, length, task, columns, scale), length, task, first)


def finish(fit: ChunkFit, task: Task, columns: Callable[[], tuple[Numbers, Numbers]]) -> SlidingFit:
    """Fits of all windows of a recording that is one chunk, in numpy; `columns` makes its rows if one is doubtful."""
    length = np.full(len(fit.theta), task.window)
    if fit.doubtful.any():
        fit = _repaired(fit, length, task, *columns())
    found: SlidingFit = _finished(fit, length, task, 0)
    return found


class _Memory(threading.local):
    """Arrays of a thread, used again for the next chunk: fresh memory takes longer to come by than to fill."""

    columns: Numbers = np.empty((0, 0))
    scale: Numbers = np.empty(0)


_memory = _Memory()


def _scratch(rows: int, n_columns: int, dtype: str, scale_dtype: str) -> tuple[Numbers, Numbers]:
    if _memory.columns.shape != (n_columns, rows) or _memory.columns.dtype != np.dtype(dtype):
        _memory.columns = np.empty((n_columns, rows), dtype)
    if _memory.scale.shape != (rows,) or _memory.scale.dtype != np.dtype(scale_dtype):
        _memory.scale = np.empty(rows, scale_dtype)
    return _memory.columns, _memory.scale


@cache
def _compiled(plan: Plan) -> Any:
    def solve(columns: Array, scale: Array, window: Array, noise: Any, wanted: Any) -> tuple[ChunkFit, Array]:
        return _solve_chunk(Task(plan, window, noise, wanted), columns, scale)  # type: ignore[arg-type]

    return compiled(solve)


def _repaired(fit: ChunkFit, length: Numbers, task: Task, columns: Numbers, scale: Numbers) -> ChunkFit:
    """The doubtful windows by a QR decomposition each."""
    doubtful = np.flatnonzero(fit.doubtful)
    if not len(doubtful):
        return fit
    plan, window = task.plan, task.window
    fit = jax.tree.map(np.array, fit)
    at_once = max(1, REPAIR_NUMBERS // (window * len(columns)))
    # A column that is zero throughout decides at once, and a still arm leaves many such windows.
    nonzero = np.pad(np.cumsum(columns[:-1] != 0, axis=1), ((0, 0), (1, 0)))
    end = doubtful * plan.step + window
    fit.solvable[doubtful] = (nonzero[:, end] > nonzero[:, end - length[doubtful]]).all(axis=0)
    doubtful = doubtful[fit.solvable[doubtful]]
    for first in range(0, len(doubtful), at_once):
        some = doubtful[first : first + at_once]
        filled = np.pad(some, (0, at_once - len(some)), mode="edge")  # one size, compiled once
        rows = (filled * plan.step)[:, None] + np.arange(window)
        kept = scale[rows] * (np.arange(window) >= window - length[filled][:, None])
        shape = (at_once, window // plan.outputs, plan.outputs)
        given = np.moveaxis(columns[:, rows], 0, -1).reshape(*shape, -1)
        exact = _decompose(given, kept.reshape(shape), task.noise, plan.statistics)
        for whole, part in zip(jax.tree.leaves(fit), jax.tree.leaves(exact), strict=True):
            whole[some] = np.asarray(part)[: len(some)]
    return fit


@partial(compiled, static_argnames="statistics")
def _decompose(columns: AnyArray, scale: AnyArray, noise: AnyArray | None, statistics: bool) -> ChunkFit:
    """`_decomposed` of several windows."""
    return jax.vmap(lambda rows, kept: _decomposed(rows, kept, noise, statistics))(columns, scale)


def _finished(fit: ChunkFit, length: Any, task: Task, first: int) -> Any:
    """Estimates as the user sees them; works on arrays of numpy and of jax alike."""
    xp: Any = np if isinstance(fit.theta, np.ndarray) else jnp

    def or_nan(x: Any) -> Any:
        if xp is np and fit.solvable.all():
            return x
        return xp.where(fit.solvable.reshape(-1, *(1,) * (x.ndim - 1)), x, xp.nan)

    if fit.statistics is None:
        return or_nan(fit.theta)
    plan = task.plan
    end = (first + np.arange(len(length))) * plan.step + task.window - task.before
    with np.errstate(all="ignore"):  # where there is no solution
        stderr, dof, norm, high, low, mean_square, vaf, n = fit.statistics
        return SlidingFit(
            theta=or_nan(fit.theta),
            stderr=or_nan(stderr),
            dof=or_nan(dof),
            cond=or_nan(high / xp.where(low > 0, low, 1)),
            sigma_min=or_nan(low),
            excitation=or_nan(1 / norm),
            residual_rms=or_nan(np.sqrt(mean_square) if xp is np else root(mean_square)),
            vaf=or_nan(vaf),
            samples=n.astype(int),
            first=xp.maximum(end - length, 0) // plan.outputs,
            last=xp.asarray(end // plan.outputs - 1),
        )
