"""Float64, on which identification depends."""

from __future__ import annotations

import jax
import numpy as np


def require_float64(*arrays: object) -> None:
    """Raise where float64 numbers would silently become float32; without arrays, wherever float64 is off."""
    if jax.config.read("jax_enable_x64"):
        return
    if not arrays or any(np.dtype(getattr(array, "dtype", np.float64)) != np.float32 for array in arrays):
        raise ValueError(
            "float64 is off, and identification needs it: call jax.config.update('jax_enable_x64', True) before "
            "the first computation (or pass float32 arrays if you mean it)"
        )
