"""Sliding windows of many columns, such as the lags of a reflex or the links of a robot.

As in `engine`, windows share the sums of products of their columns, in coordinates in which squaring loses no digits.
There every formula is written out over windows side by side, which takes half a minute to compile for thirty columns;
here small matrices go to a library, and nothing is compiled. Sums are only added, never taken out again.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jaximp.least_squares.fits import DOUBT
from jaximp.least_squares.window import SlidingFit
from jaximp.types import Numbers

FEWEST_COLUMNS, FEWEST_WINDOWS = 9, 8
"""From so many on these sums pay."""
MOST_NUMBERS = 30_000_000
"""So many sums are kept at a time."""


def pays(n_windows: int, p: int, n: int) -> bool:
    """Whether windows with p columns and n outputs should be solved here."""
    return p >= FEWEST_COLUMNS and FEWEST_WINDOWS <= n_windows <= MOST_NUMBERS // (p + n + 2) ** 2


class _Features(NamedTuple):
    """Columns whose products are summed, and the triangle of the whole record."""

    values: Numbers
    """(N, n, p + 2 + n): W and y in the record's coordinates, the torque less its mean, and which output it is."""
    triangle: Numbers
    """(p + 1, p + 1) `R`, by which [W y] was divided."""


def solve_wide(
    W: Numbers, y: Numbers, scale: NDArray[Any], window: int, starts: NDArray[np.int64]
) -> tuple[SlidingFit, NDArray[np.bool_]]:
    """Fit every window, white noise.

    **Arguments:** `W` (N, n, p), `y` (N, n), `scale` (N, n) what each equation is multiplied by, zero where it does not
    count; `starts` (M,) of windows, all one step apart.

    **Returns:** the fits, and (M,) which of them are to be decomposed one by one: those whose motion differs in kind
    from the record's, or determines nothing.
    """
    p = W.shape[-1]
    counts, scale = scale > 0, scale.astype(W.dtype)
    step = int(starts[1] - starts[0])
    features = _features(W, y, counts, scale)
    sums = _window_sums(features.values, window, step, len(starts))
    samples = _moving_sum(counts.sum(axis=1), window)[starts]
    triangle, pivots = _triangles(sums[:, : p + 1, : p + 1])
    peak = np.einsum("mii->mi", sums)[:, :p]
    share = np.min(pivots[:, :p] / np.where(peak > 0, peak, 1), axis=1)
    good = (share > DOUBT) & (samples >= p)
    alone = np.where(good[:, None, None], triangle[:, :p, :p], np.eye(p))
    fit = _estimates(features.triangle, alone, triangle[:, :, p], sums, samples)
    each = {name: np.where(good.reshape(-1, *(1,) * (x.ndim - 1)), x, np.nan) for name, x in fit.items()}
    return SlidingFit(**each, samples=samples, first=starts, last=starts + window - 1), ~good & (samples >= p)


def _features(W: Numbers, y: Numbers, counts: NDArray[np.bool_], scale: Numbers) -> _Features:
    from scipy.linalg import solve_triangular

    N, n, p = W.shape
    columns = np.where(counts[..., None], np.concatenate([W, y[..., None]], axis=-1), 0) * scale[..., None]
    flat = columns.reshape(-1, p + 1)
    R = np.linalg.qr(flat, mode="r") if len(flat) > p else np.eye(p + 1)
    size = np.linalg.norm(R, axis=0)
    floor = len(flat) * np.finfo(W.dtype).eps * np.where(size > 0, size, 1)
    diagonal = np.diagonal(R)
    R = R + np.diag(np.where(np.abs(diagonal) > floor, 0, floor - diagonal))
    divided = solve_triangular(R.T, flat.T, lower=True).T.reshape(N, n, p + 1)
    weight = (scale**2).sum(axis=0)
    mean = (columns[..., -1] * scale).sum(axis=0) / np.where(weight > 0, weight, 1)
    centred = columns[..., -1] - mean * scale
    members = scale[..., None] * np.eye(n)
    return _Features(np.concatenate([divided, centred[..., None], members], axis=-1), R)


def _window_sums(values: Numbers, window: int, step: int, n_windows: int) -> Numbers:
    """(M, f, f) sums of products of features over every window: runs of whole steps by doubling, then the rest."""
    f, (whole, rest) = values.shape[-1], divmod(window, step)
    blocks = n_windows + whole
    padded = np.zeros((blocks * step, *values.shape[1:]))
    padded[: len(values)] = values[: len(padded)]
    rows = padded.reshape(blocks, -1, f)
    run = rows.transpose(0, 2, 1) @ rows
    total, done = np.zeros((n_windows, f, f)), 0
    for bit in range(whole.bit_length()):
        if whole >> bit & 1:
            total += run[done : done + n_windows]
            done += 1 << bit
        if whole >> bit > 1:
            run = run[: -(1 << bit)] + run[1 << bit :]
    if rest:
        behind = rows[whole : whole + n_windows, : rest * values.shape[1]]
        total += behind.transpose(0, 2, 1) @ behind
    return total


def _moving_sum(counts: NDArray[np.int64], window: int) -> NDArray[np.int64]:
    """Of whole numbers, so that differences are exact."""
    total = np.concatenate([[0], np.cumsum(counts)])
    return total[window:] - total[:-window]


def _triangles(gram: Numbers) -> tuple[Numbers, Numbers]:
    """Upper triangles (M, k, k) of Gram matrices, and their squared diagonal (M, k); finite whatever the pivots are."""
    rest, k = gram.copy(), gram.shape[-1]
    triangle, pivots = np.zeros_like(gram), np.zeros(gram.shape[:2])
    for j in range(k):
        pivots[:, j] = rest[:, j, j]
        row = rest[:, j, j:] / np.sqrt(np.where(pivots[:, j] > 0, pivots[:, j], 1))[:, None]
        triangle[:, j, j:] = row
        rest[:, j + 1 :, j + 1 :] -= row[:, 1:, None] * row[:, None, 1:]
    return triangle, pivots


def _estimates(
    R: Numbers, alone: Numbers, right: Numbers, sums: Numbers, samples: NDArray[np.int64]
) -> dict[str, Numbers]:
    """What a `SlidingFit` holds, from triangles (M, p, p) and their right-hand sides (M, p + 1)."""
    from scipy.linalg import solve_triangular

    M, p, _ = alone.shape
    own = np.linalg.inv(alone)
    inner = (own @ right[:, :p, None])[..., 0]
    theta = solve_triangular(R[:p, :p], (R[:p, p] + R[p, p] * inner).T).T
    inverse = solve_triangular(R[:p, :p], own.transpose(1, 0, 2).reshape(p, -1)).reshape(p, M, p).transpose(1, 0, 2)
    singular = np.linalg.svd(alone @ R[:p, :p], compute_uv=False)
    rss = (R[p, p] * right[:, p]) ** 2
    norm, dof = np.linalg.norm(inverse, axis=2), (samples - p).astype(float)
    spread = np.sqrt(np.where(dof > 0, rss / np.where(dof > 0, dof, 1), np.nan))
    # Sums over the rows of each output (M, n, ...): its torque and its residual, less their means.
    members = sums[:, p + 2 :]
    weight = np.einsum("mii->mi", members[:, :, p + 2 :])
    over = 1 / np.where(weight > 0, weight, 1)
    total = sums[:, p + 1, p + 1] - (members[:, :, p + 1] ** 2 * over).sum(axis=1)
    residual = R[p, p] * (members[:, :, p] - (members[:, :, :p] @ inner[..., None])[..., 0])
    left = rss - (residual**2 * over).sum(axis=1)
    whole = weight.sum(axis=1)
    return {
        "theta": theta,
        "stderr": norm * spread[:, None],
        "dof": dof,
        "cond": singular[:, 0] / singular[:, -1],
        "sigma_min": singular[:, -1],
        "excitation": 1 / norm,
        "residual_rms": np.sqrt(rss / np.where(whole > 0, whole, 1)),
        "vaf": np.where(total > 0, 1 - left / np.where(total > 0, total, 1), np.nan),
    }
