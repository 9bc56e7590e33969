"""How XLA compiles: `compiled` is `jax.jit` with the settings that suit this project's loops on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp

P = ParamSpec("P")
R = TypeVar("R")

WANTED: dict[str, Any] = {
    "xla_disable_hlo_passes": "cse_barrier_expander",  # `lax.optimization_barrier` holds until loops are cut
    "xla_cpu_use_fusion_emitters": False,  # as fast, and compiled in half of the time
}


@cache
def options() -> dict[str, Any]:
    """The settings that this version of XLA knows; none of them changes a result."""
    known = {}
    for name, value in WANTED.items() if jax.default_backend() == "cpu" else ():
        try:
            jax.jit(lambda x: x, compiler_options={name: value}).lower(0).compile()
        except Exception:  # whatever a version raises for a name that it does not know
            continue
        known[name] = value
    return known


def compiled(function: Callable[P, R], **settings: Any) -> Callable[P, R]:
    """`jax.jit(function, **settings)`, made when it is first called: only then the device is known.

    Within other compiled code the settings are those of that code.
    """
    nested = jax.jit(function, **settings)

    @cache
    def outermost() -> Callable[P, R]:
        return jax.jit(function, compiler_options=options(), **settings)

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        # Within `jit` every new array is traced, within `vmap` or `grad` the arguments are.
        seen = (jnp.zeros(()), *jax.tree.leaves((args, kwargs)))
        inside = any(isinstance(leaf, jax.core.Tracer) for leaf in seen)
        return (nested if inside else outermost())(*args, **kwargs)

    return call
