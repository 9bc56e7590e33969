"""Least-squares problems with a known solution."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Numbers = NDArray[np.float64]

THETA = np.array([0.1, 1.5, 20.0, -3.0])


def regression(n: int, p: int = 3, outputs: tuple[int, ...] = (), seed: int = 0) -> tuple[Numbers, Numbers]:
    """Rows (n, *outputs, p) with columns of unlike size, and noisy torque (n, *outputs) of the first p of THETA."""
    random = np.random.default_rng(seed)
    W = random.normal(size=(n, *outputs, p)) * np.array([30.0, 3.0, 0.3, 1.0])[:p]
    return W, W @ THETA[:p] + 0.1 * random.normal(size=(n, *outputs))
