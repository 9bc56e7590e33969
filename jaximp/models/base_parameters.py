"""Base parameters: what a motion can tell of the parameters of a chain (Gautier 1991; Khalil and Dombre 2002, 9.4).

Most of a robot's inertial parameters move the torque together with others, or not at all. A basis of the columns is
found by orthogonalising them one after the other on random motions; each column that the ones before it already make
is left out, and its parameter counts with theirs. As the columns come from the base to the tip, parameters are
regrouped towards the base.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaximp.types import AnyArray, Numbers

INDEPENDENT = 1e-9
"""Share of a column that the columns before it do not make, above which it is one of the base."""
SHOWN = 1e-5
"""Smallest factor that a sum shows: smaller ones are what files round."""
ROUNDING = 1e-12
"""Share of a column below which the part of another in it is rounding."""


class BaseParameters(eqx.Module):
    """Which of P standard parameters are the p base columns, and what sum each of them stands for."""

    standard_names: tuple[str, ...] = eqx.field(static=True)
    kept: tuple[int, ...] = eqx.field(static=True)
    """Places of the base columns among the standard ones."""
    map: Float[AnyArray, "p P"]
    """`base = map @ standard`, and `standard_columns = base_columns @ map`. The identity in the kept columns."""
    residual: float = eqx.field(static=True)
    """The largest share of a column that the base columns do not make: what the file's geometry rounds, as a share of
    the torque of one parameter."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the base columns."""
        return tuple(self.standard_names[k] for k in self.kept)

    @property
    def null_space(self) -> Numbers:
        """(P, P - p) changes of the standard parameters that no motion shows."""
        matrix = np.asarray(self.map, float)
        left = [k for k in range(matrix.shape[1]) if k not in self.kept]
        basis = np.zeros((matrix.shape[1], len(left)))
        basis[left, range(len(left))] = 1.0
        basis[list(self.kept)] = -matrix[:, left]
        return basis

    @property
    def sums(self) -> dict[str, str]:
        """What the parameter of each base column stands for, such as `link2.mc_x + 0.612 link3.mass`."""
        return {name: self._sum(row) for name, row in zip(self.names, np.asarray(self.map, float), strict=True)}

    def _sum(self, row: Numbers) -> str:
        own = int(np.flatnonzero(np.isin(range(len(row)), self.kept) & (row == 1.0))[0])
        text = self.standard_names[own]
        for k in np.flatnonzero(np.abs(row) > SHOWN):
            factor = "" if abs(abs(row[k]) - 1) < SHOWN else f"{abs(row[k]):.3g} "
            if k != own:
                text += f" {'-' if row[k] < 0 else '+'} {factor}{self.standard_names[k]}"
        return text


def find_base(
    W: Float[AnyArray, "N P"],
    names: Sequence[str],
    order: Sequence[int] | None = None,
    tidy: Float[AnyArray, "N P"] | None = None,
) -> BaseParameters:
    """The base of a regressor's columns, by rows of many random motions (in double precision).

    **Arguments:** `names` (P,) of the columns; the `order` in which they are tried (as they stand), so that the first
    of those that depend on each other are kept. `tidy` are the rows of the same motions for the geometry that was meant
    where a file rounds it: a column whose independence comes from the rounding alone is none of the base.
    """
    W = np.asarray(W, float)
    meant = W if tidy is None else np.asarray(tidy, float)
    size: Numbers = np.linalg.norm(meant, axis=0)
    alive = size > INDEPENDENT * np.max(size, initial=0.0)
    kept = _independent(meant, [k for k in (range(len(size)) if order is None else order) if alive[k]])
    scaled = np.where(alive, W / np.where(alive, size, 1.0), 0.0)
    Q, R = np.linalg.qr(scaled[:, kept])
    shares: Numbers = np.linalg.solve(R, Q.T @ scaled)
    residual = float(np.linalg.norm(scaled - scaled[:, kept] @ shares, axis=0).max(initial=0.0))
    shares[np.abs(shares) < ROUNDING] = 0.0
    shares[:, kept] = np.eye(len(kept))
    return BaseParameters(tuple(names), tuple(kept), shares * size / size[np.array(kept, int)][:, None], residual)


def _independent(W: Numbers, order: Sequence[int]) -> list[int]:
    """Columns that those before them, in this order, do not make; sorted."""
    R: Numbers = np.linalg.qr(W / np.maximum(np.linalg.norm(W, axis=0), np.finfo(float).tiny))[1]
    basis = np.zeros((len(R), 0))
    kept = []
    for k in order:
        rest = R[:, k]
        for _ in range(2):  # once more takes out what rounding left
            rest = rest - basis @ (basis.T @ rest)
        length = np.linalg.norm(rest)
        if length > INDEPENDENT:
            kept.append(int(k))
            basis = np.column_stack([basis, rest / length])
    return sorted(kept)
