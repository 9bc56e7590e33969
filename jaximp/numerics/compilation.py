"""How XLA compiles: `compiled` is `jax.jit` with the settings that suit this project's loops on a CPU.

XLA would compute numbers again wherever they are used; `keep` makes it write them once.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax

P = ParamSpec("P")
R = TypeVar("R")

FAST = "xla_cpu_use_fusion_emitters"
WANTED: dict[str, Any] = {
    "xla_disable_hlo_passes": "cse_barrier_expander",  # `lax.optimization_barrier` holds until loops are cut
    FAST: False,  # as fast, and compiled in half of the time
}


@cache
def options() -> dict[str, Any]:
    """The settings, where this version of XLA knows and needs them; none of them changes a result.

    From jax 0.12 on it is as fast without them, and can break off where barriers are kept.
    """
    if jax.default_backend() != "cpu" or jax.__version_info__ >= (0, 11):
        return {}
    try:
        jax.jit(lambda x: x, compiler_options=WANTED).lower(0).compile()
    except Exception:  # whatever a version raises for a name that it does not know
        return {}
    return WANTED


def is_traced(*trees: Any) -> bool:
    """Whether `jit`, `vmap` or `grad` is at work on any of these: then their values are not known."""
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


def require_numbers(name: str, instead: str, *trees: Any) -> None:
    """Refuse what is traced, in one line, where a function needs values.

    **Raises:** `ValueError` with what to do `instead`.
    """
    if is_traced(*trees):
        raise ValueError(f"{name} needs numbers, which are not known inside jit, vmap and grad: {instead}")


@cache
def filter_compiled(function: Callable[P, R]) -> Callable[P, R]:
    """`equinox.filter_jit` of a function, made when it is first asked for, with what makes it compile fast."""
    fast = {name: value for name, value in options().items() if name == FAST}
    return eqx.filter_jit(function, compiler_options=fast)  # type: ignore[call-overload]


def compiled(function: Callable[P, R], **settings: Any) -> Callable[P, R]:
    """`jax.jit(function, **settings)`, made when it is first called: only then the device is known.

    Within other compiled code the settings are those of that code.
    """
    plain = jax.jit(function, **settings)

    @cache
    def tuned() -> Callable[P, R]:
        return jax.jit(function, compiler_options=options(), **settings)

    refused = False

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        nonlocal refused
        # Within `jit` every new array is traced, within `vmap` or `grad` the arguments are.
        if refused or is_traced(jnp.zeros(()), args, kwargs):
            return plain(*args, **kwargs)
        try:
            return tuned()(*args, **kwargs)
        except jax.errors.JaxRuntimeError as error:
            if "opt-barrier" not in str(error):
                raise
            refused = True  # some versions cannot keep a barrier inside of a small loop
            return plain(*args, **kwargs)

    return call


def keep(x: Any) -> Any:
    """Write these numbers to memory: whoever needs them must not compute them again.

    Under `compiled`; otherwise the result is the same, slower.
    """
    return lax.optimization_barrier(x)
