"""Least squares in windows side by side, each with parameters of its own; what several tests ask of them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Num, Shaped
from numpy.typing import NDArray

from jaximp.types import AnyArray, Numbers

DEPENDENT = 1e-10
"""Columns are dependent where the smallest of their excitations is such a share of the largest."""


class DisjointFit(NamedTuple):
    """Of K windows of S rows; what stands in windows that are not `sound` means nothing."""

    inverse: Numbers
    """(K, p, p) times which the columns are orthonormal."""
    excitation: Numbers
    """(K, p) size of each column, beside those before it."""
    residual: Numbers
    """(K, S) zero in rows that do not count."""
    rows: NDArray[np.int64]
    """(K,) that count."""
    sound: NDArray[np.bool_]
    """(K,) whether the columns are independent, and leave something of the torque."""

    @property
    def rss(self) -> Numbers:
        """(K,) residual sum of squares."""
        return (self.residual**2).sum(axis=1)

    def orthonormal(self, W: Numbers, some: slice = slice(None)) -> Numbers:
        """(M, S, p) orthonormal columns of some windows of W (N, p), zero in rows that do not count."""
        windows, size = self.residual.shape
        return W[: self.residual.size].reshape(windows, size, -1)[some] @ self.inverse[some]


def fit_disjoint(
    W: Num[AnyArray, "N p"], y: Num[AnyArray, " N"], valid: Shaped[AnyArray, " N"], window: int
) -> DisjointFit:
    """Least squares in windows of so many rows. Rows that are not `valid` are zero, in W and in y."""
    count, p = len(y) // window, W.shape[1]
    W, y = W[: count * window].reshape(count, window, p), y[: count * window].reshape(count, window)
    rows = np.asarray(valid, bool)[: count * window].reshape(count, window).sum(axis=1)
    R = np.linalg.qr(W, mode="r") if window >= p else np.zeros((count, p, p))
    excitation = np.abs(np.diagonal(R, axis1=1, axis2=2))
    sound = (rows >= p) & (excitation.min(axis=1, initial=np.inf) > DEPENDENT * excitation.max(axis=1, initial=0))
    inverse = np.linalg.inv(np.where(sound[:, None, None], R, np.eye(p)))
    Q = W @ inverse
    residual = y - (Q @ (Q.swapaxes(1, 2) @ y[..., None]))[..., 0]
    return DisjointFit(inverse, excitation, residual, rows, sound & (np.abs(residual).max(axis=1, initial=0) > 0))
